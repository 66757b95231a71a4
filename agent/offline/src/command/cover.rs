//! `agent cover`: the driven area of a scene head, stored in the head's file.

use std::path::PathBuf;

use dataset::LeftOut;
use localization::pgc::driven_area::DrivenArea;
use localization::pgc::head_files::{head_config, head_file};
use support::cli::{BadInput, Outcome};
use support::output;

use super::retrieval::positions;
use super::scene_heads::{check_place, generated_maps};

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
    let (weights, config) = head_config(&head).map_err(BadInput::of)?;
    let maps = generated_maps(&args.dataset)?;
    let poses = positions(&args.dataset, &mut left_out)?;
    let places = poses.iter().map(|pose| pose.translation.vector);
    let places = Vec::from_iter(places.map(|place| [place.x, place.y]));
    check_place((&head, &config), &maps, &places)?;
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
