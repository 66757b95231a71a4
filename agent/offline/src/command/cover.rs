//! `agent cover`: the driven area of a scene head, stored in the head's file.

use std::path::PathBuf;

use dataset::{GeneratedMap, LeftOut, Scenario};
use localization::pgc::driven_area::DrivenArea;
use localization::pgc::head_files::head_file;
use localization::pgc::{SceneHead, SceneHeadConfig};
use perception::weights::Weights;
use support::cli::{BadInput, Outcome};
use support::output;

use super::retrieval::positions;

/// State in a scene head where the drives were that it was trained on. Heads of `agent map` and `agent train scene` have it.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Data sets, splits or scenarios that the head was trained on, all of them.
    #[arg(long, value_name = "DIR", num_args = 1.., required = true)]
    dataset: Vec<PathBuf>,
    /// Weights of the head; its parameters stay as they are.
    #[arg(long, value_name = "FILE")]
    head: PathBuf,
}

/// Reads the poses, stores the area and prints it.
pub(crate) fn run(args: &Args) -> anyhow::Result<Outcome> {
    let mut left_out = LeftOut::default();
    let head = head_file(&args.head).map_err(BadInput::of)?;
    // Another kind of file is not changed.
    let weights = Weights::load(&head).map_err(BadInput::of)?;
    weights.check_kind(SceneHead::KIND).map_err(BadInput::of)?;
    let config: SceneHeadConfig = weights.config().map_err(BadInput::of)?;
    let mut maps = Vec::new();
    for folder in &args.dataset {
        let scenarios = dataset::open(folder).map_err(BadInput::of)?.scenarios;
        maps.extend(scenarios.iter().flat_map(Scenario::generated_map));
    }
    let poses = positions(&args.dataset, &mut left_out)?;
    let places = poses.iter().map(|pose| pose.translation.vector);
    let places = Vec::from_iter(places.map(|place| [place.x, place.y]));
    if let Some(reason) = other_place(&maps, &places, &config) {
        return Err(BadInput::new(format!("{}: {reason}", head.display())).into());
    }
    let area = DrivenArea::of(&places);
    if let Some(before) = DrivenArea::of_head(&weights) {
        let (cells, before) = (area.cells.len(), before.cells.len());
        output::note(format!(
            "an area of {before} cells is replaced by one of {cells}"
        ));
    }
    let sha256 = area.state_in(&head).map_err(BadInput::of)?;
    let (text, picture) = (area.text(), area.picture());
    output::text(format!(
        "{picture}{}: driven {text}, SHA-256 {sha256}\n",
        head.display()
    ))?;
    Ok(left_out.print())
}

/// Why drives are not those of a head, if they are not: a generated map has another name, or more than a tenth of the
/// positions (metres) lie outside its place.
fn other_place(
    maps: &[GeneratedMap],
    places: &[[f64; 2]],
    config: &SceneHeadConfig,
) -> Option<String> {
    let name = &config.scene_name;
    if let Some(map) = maps.iter().find(|map| map.name != *name) {
        return Some(format!("a head of {name}, the drives are through {map}"));
    }
    let [low_m, high_m] = config.corners_m()?;
    let ([west, south], [east, north]) = (low_m, high_m);
    let is_within = |[x, y]: &&[f64; 2]| (west..=east).contains(x) && (south..=north).contains(y);
    let inside = places.iter().filter(is_within);
    let (inside, count) = (inside.count(), places.len());
    (10 * inside < 9 * count).then(|| {
        format!("{inside} of {count} positions lie within its place, {low_m:.0?} to {high_m:.0?} m")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positions_outside_the_place_of_a_head_are_refused_with_their_number() {
        let config = r#"{"town":"a","encoder_sha256":"","cell_channels":1,"sweep_channels":1,"classes":1,"centres":1,
            "width":1,"blocks":1,"origin_m":[100.0,50.0,0.0],"max_cells":1,"refiner":{"local_channels":1,
            "low_m":[-10.0,-10.0],"high_m":[10.0,10.0],"spacing_m":1.0,"reach":1,"keys":1,"width":1}}"#;
        let config: SceneHeadConfig = serde_json::from_str(config).unwrap();
        let reason = |outside: usize| {
            let mut places = vec![[100.0, 55.0]; 10 - outside];
            places.resize(10, [0.0, 5.0]);
            other_place(&[], &places, &config)
        };
        assert_eq!(reason(1), None);
        let message = reason(2).unwrap();
        assert!(
            message.contains("8 of 10") && message.contains("[90, 40] to [110, 60] m"),
            "{message}"
        );
    }
}
