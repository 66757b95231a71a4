//! Choice of the scene-specific head of a scenario.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::Context;
use dataset::{self, GeneratedMap, Scenario};
use localization::pgc::head_files::{head_file, surfel_map_file};

use support::cli::BadInput;

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
        let Some((map, weights)) = text.split_once('=') else {
            return Ok(Self {
                map: None,
                weights: text.into(),
            });
        };
        let (name, seed) = map.split_once(':').unwrap_or((map, "0"));
        let seed = seed
            .parse()
            .map_err(|_| format!("{seed:?} is no seed of a map"))?;
        Ok(Self {
            map: Some(GeneratedMap {
                name: name.to_owned(),
                seed,
            }),
            weights: weights.into(),
        })
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

#[cfg(test)]
mod tests {
    use simulator::generate::{Subset, SynthOptions, generate};

    use super::*;

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
    }
}
