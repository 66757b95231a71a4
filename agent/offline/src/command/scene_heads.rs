//! Scene-specific heads and their places: the head of a scenario, and drives that are not of a head's place.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::Context;
use dataset::{self, GeneratedMap, Scenario};
use localization::pgc::SceneHeadConfig;
use localization::pgc::head_files::{head_file, surfel_map_file};

use support::cli::BadInput;

/// Names of the places that the generator makes without a file. A head of drives there may have a name of its own: only one
/// with the name of another such place is certainly not of theirs.
const GENERATED_PLACES: [&str; 2] = ["town1", "town4"];

/// Weights and their scene: `FILE` for all scenes, `MAP=FILE` and `MAP:SEED=FILE` for generated ones; a file may be the
/// name of a released head.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct SceneHeadFile {
    map: Option<GeneratedMap>,
    weights: PathBuf,
}

impl FromStr for SceneHeadFile {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (mut map, mut weights) = (None, text);
        if let Some((of, file)) = text.split_once('=') {
            let (name, seed) = of.split_once(':').unwrap_or((of, "0"));
            let parsed = seed.parse();
            let seed = parsed.map_err(|_| format!("{seed:?} is no seed of a map"))?;
            let name = name.to_owned();
            (map, weights) = (Some(GeneratedMap { name, seed }), file);
        }
        let weights = weights.into();
        Ok(Self { map, weights })
    }
}

/// The heads with their files, where released ones are named.
///
/// # Errors
/// [`BadInput`] for a head that does not exist.
pub(crate) fn with_files(heads: &[SceneHeadFile]) -> Result<Vec<SceneHeadFile>, BadInput> {
    let mut found = heads.to_vec();
    for head in &mut found {
        head.weights = head_file(&head.weights).map_err(BadInput::of)?;
    }
    Ok(found)
}

/// The file of a surfel map, where released ones are named; empty without one.
///
/// # Errors
/// [`BadInput`] for a map that does not exist.
pub(crate) fn surfel_map(named: Option<&Path>) -> Result<PathBuf, BadInput> {
    let file = named.map(surfel_map_file).transpose();
    Ok(file.map_err(BadInput::of)?.unwrap_or_default())
}

/// The weights of the head for a scenario.
///
/// # Errors
/// [`BadInput`] when its map cannot be read or has no head, and when one of several heads has no map.
pub(crate) fn head_of<'a>(
    heads: &'a [SceneHeadFile],
    scenario: &Scenario,
) -> Result<&'a Path, BadInput> {
    if let [SceneHeadFile { map: None, weights }] = heads {
        return Ok(weights);
    }
    if let Some(SceneHeadFile { weights, .. }) = heads.iter().find(|head| head.map.is_none()) {
        let (weights, count) = (weights.display(), heads.len());
        return Err(BadInput::new(format!(
            "--head {weights}: of {count} heads each needs its map, MAP={weights}"
        )));
    }
    let map = scenario.generated_map();
    let map = map.with_context(|| format!("the map of scenario {}", scenario.name));
    let map = map.map_err(BadInput::of)?;
    let head = heads.iter().find(|head| head.map.as_ref() == Some(&map));
    Ok(&head
        .ok_or_else(|| BadInput::new(format!("{}: no --head for map {map}", scenario.name)))?
        .weights)
}

/// Each head that scenes need, with those scenes, in the order of their first use.
///
/// # Errors
/// [`BadInput`] as [`head_of`], and when a folder has no scenario, or scenarios of several maps.
pub(crate) fn by_head<'a>(
    heads: &'a [SceneHeadFile],
    scenes: &[PathBuf],
) -> Result<Vec<(&'a Path, Vec<PathBuf>)>, BadInput> {
    if let [SceneHeadFile { map: None, weights }] = heads {
        return Ok(vec![(weights, scenes.to_vec())]);
    }
    let mut groups: Vec<(&Path, Vec<PathBuf>)> = Vec::new();
    for folder in scenes {
        let scenarios = dataset::open(folder).map_err(BadInput::of)?.scenarios;
        let needed = scenarios.iter().map(|scenario| head_of(heads, scenario));
        let needed = needed.collect::<Result<Vec<_>, _>>()?;
        let &head = needed.first().ok_or_else(|| {
            BadInput::new(format!("{}: there is no scenario in it", folder.display()))
        })?;
        if needed.iter().any(|other| *other != head) {
            let reason = format!("{}: scenarios of several maps", folder.display());
            return Err(BadInput::new(reason));
        }
        match groups.iter_mut().find(|(of, _)| *of == head) {
            Some((_, folders)) => folders.push(folder.clone()),
            None => groups.push((head, vec![folder.clone()])),
        }
    }
    Ok(groups)
}

/// The generated map of each scenario in some folders; `None` for a recorded one.
///
/// # Errors
/// [`BadInput`] for a folder that cannot be opened.
pub(crate) fn generated_maps(folders: &[PathBuf]) -> Result<Vec<Option<GeneratedMap>>, BadInput> {
    let mut maps = Vec::new();
    for folder in folders {
        let scenarios = dataset::open(folder).map_err(BadInput::of)?.scenarios;
        let of_folder = scenarios.iter().map(Scenario::generated_map);
        maps.extend(of_folder.map(Result::ok));
    }
    Ok(maps)
}

/// Checks that drives are through one generated map, or recorded.
///
/// # Errors
/// [`BadInput`] names the folders and two maps.
pub(crate) fn check_one_map(folders: &[PathBuf]) -> Result<(), BadInput> {
    let maps = generated_maps(folders)?;
    let mut maps = maps.iter().flatten();
    let first = maps.next();
    match first.zip(maps.find(|map| Some(*map) != first)) {
        None => Ok(()),
        Some((first, other)) => Err(BadInput::new(format!(
            "{folders:?} are drives through {first} and {other}: those through one place are needed"
        ))),
    }
}

/// True if a scenario of this generated map is certainly not of the place of a head.
pub(crate) fn is_elsewhere(map: Option<&GeneratedMap>, config: &SceneHeadConfig) -> bool {
    let name = &config.scene_name;
    GENERATED_PLACES.contains(&name.as_str()) && map.is_some_and(|map| map.name != *name)
}

/// Checks that drives with these maps and positions (metres) are of the place of a head in a file.
///
/// # Errors
/// [`BadInput`] where a generated map has another name, or more than a tenth of the positions lie outside its place.
pub(crate) fn check_place(
    (head, config): (&Path, &SceneHeadConfig),
    maps: &[Option<GeneratedMap>],
    places: &[[f64; 2]],
) -> Result<(), BadInput> {
    let (head, name) = (head.display(), &config.scene_name);
    let mut maps = maps.iter().flatten();
    if let Some(map) = maps.find(|map| is_elsewhere(Some(map), config)) {
        let reason = format!("{head}: a head of {name}, the drives are through {map}");
        return Err(BadInput::new(reason));
    }
    let Some([low_m, high_m]) = config.corners_m() else {
        return Ok(());
    };
    let ([west, south], [east, north]) = (low_m, high_m);
    let is_within = |[x, y]: &&[f64; 2]| (west..=east).contains(x) && (south..=north).contains(y);
    let (inside, count) = (places.iter().filter(is_within).count(), places.len());
    match 10 * inside >= 9 * count {
        true => Ok(()),
        false => Err(BadInput::new(format!(
            "{head}: {inside} of {count} positions lie within its place, {low_m:.0?} to {high_m:.0?} m"
        ))),
    }
}

#[cfg(test)]
mod tests {
    use simulator::generate::{Subset, SynthOptions, generate};
    use simulator::map::RoadMapSource;

    use super::*;

    /// A head of a place with this name, 20 m wide around (100, 50) m.
    fn config(name: &str) -> SceneHeadConfig {
        let config = r#"{"town":"","encoder_sha256":"","cell_channels":1,"sweep_channels":1,"classes":1,"centres":1,
            "width":1,"blocks":1,"origin_m":[100.0,50.0,0.0],"max_cells":1,"refiner":{"local_channels":1,
            "low_m":[-10.0,-10.0],"high_m":[10.0,10.0],"spacing_m":1.0,"reach":1,"keys":1,"width":1}}"#;
        SceneHeadConfig {
            scene_name: name.to_owned(),
            ..serde_json::from_str(config).unwrap()
        }
    }

    #[test]
    fn heads_are_of_one_town_or_of_all() {
        for (text, expected) in [
            ("h.st", None),
            ("town1=h.st", Some(("town1", 0))),
            ("town4:3=h.st", Some(("town4", 3))),
        ] {
            let head: SceneHeadFile = text.parse().unwrap();
            let map = head.map.as_ref().map(|map| (map.name.as_str(), map.seed));
            assert_eq!(
                (map, head.weights.as_path()),
                (expected, Path::new("h.st")),
                "{text}"
            );
        }
        assert!(
            "town1:x=h"
                .parse::<SceneHeadFile>()
                .unwrap_err()
                .contains('x')
        );
    }

    #[test]
    fn scenes_are_taken_together_by_the_head_of_their_town() {
        let folder = tempfile::tempdir().unwrap();
        let [a, b, c] = [
            (Subset::Town1loc, "a"),
            (Subset::Town4loc, "b"),
            (Subset::Town1loc, "c"),
        ]
        .map(|(subset, name)| {
            let out = folder.path().join(name);
            let options = SynthOptions {
                frames: 1,
                ..SynthOptions::new(subset, 11, out.clone())
            };
            generate(&options, &|_| {}).unwrap();
            out
        });
        let scenes = [a.clone(), b.clone(), c.clone()];
        let heads: Vec<SceneHeadFile> = ["town1=1.st", "town4=4.st"]
            .map(|head| head.parse().unwrap())
            .into();
        let groups = by_head(&heads, &scenes).unwrap();
        assert_eq!(
            groups,
            [
                (Path::new("1.st"), vec![a, c]),
                (Path::new("4.st"), vec![b])
            ]
        );
        let error = by_head(&heads[..1], &scenes).unwrap_err().to_string();
        assert!(error.contains("no --head for map town4:0"), "{error}");
        let unclear = ["town1=1.st", "h.st"].map(|head| head.parse().unwrap());
        let error = by_head(&unclear, &scenes).unwrap_err().to_string();
        assert!(
            error.contains("h.st: of 2 heads each needs its map"),
            "{error}"
        );
        let any = ["h.st".parse().unwrap()];
        assert_eq!(
            by_head(&any, &scenes).unwrap(),
            [(Path::new("h.st"), scenes.to_vec())]
        );
        // What is trained on them together is refused.
        check_one_map(&[scenes[0].clone(), scenes[2].clone()]).unwrap();
        let error = check_one_map(&scenes).unwrap_err().to_string();
        assert!(
            error.contains("are drives through town1:0 and town4:0"),
            "{error}"
        );
    }

    #[test]
    fn positions_outside_the_place_of_a_head_are_refused_with_their_number() {
        let config = config("a");
        let reason = |outside: usize| {
            let mut places = vec![[100.0, 55.0]; 10 - outside];
            places.resize(10, [0.0, 5.0]);
            let checked = check_place((Path::new("h.st"), &config), &[], &places);
            checked.err().map(|error| error.to_string())
        };
        assert_eq!(reason(1), None);
        let message = reason(2).unwrap();
        assert!(
            message.contains("8 of 10") && message.contains("[90, 40] to [110, 60] m"),
            "{message}"
        );
    }

    #[test]
    fn drives_through_another_generated_map_are_refused_where_the_head_has_the_name_of_one() {
        for map in [RoadMapSource::Town1, RoadMapSource::Town4] {
            assert!(GENERATED_PLACES.contains(&map.name().as_str()));
        }
        let map = |name: &str| {
            Some(GeneratedMap {
                name: name.to_owned(),
                seed: 0,
            })
        };
        let reason = |head: &str, maps: &[Option<GeneratedMap>]| {
            let checked = check_place((Path::new("h.st"), &config(head)), maps, &[]);
            checked.err().map(|error| error.to_string())
        };
        let mixed = [map("town1"), map("town4"), None];
        let message = reason("town1", &mixed).unwrap();
        assert!(
            message.contains("h.st: a head of town1, the drives are through town4:0"),
            "{message}"
        );
        assert_eq!(reason("town1", &[map("town1"), None]), None);
        let elsewhere = mixed.map(|map| is_elsewhere(map.as_ref(), &config("town1")));
        assert_eq!(elsewhere, [false, true, false]);
        let mixed = [map("town1"), map("town4")];
        // A head of drives through a generated map may have any name.
        assert_eq!(reason("mytown", &mixed), None);
    }
}
