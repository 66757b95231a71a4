//! Scene cache: reuses generated scenes if they are complete and match the options.

use std::fs;
use std::path::Path;

use serde::Deserialize;

use super::error::SynthError;
use super::layout::{PROTOCOL_FILE, SceneLayout, remove_folder, written};
use super::options::SynthOptions;
use super::scenes::{Summary, generate, sources};
use crate::generate::Result;
use crate::map::RoadMapSource;
use support::file_error::{AtFile, FileError};
use support::{atomic_file, bounded_file};

/// Longer files were not written by this program, bytes.
const MAX_FILE_BYTES: u64 = 1 << 20;

/// Settings recorded in [`PROTOCOL_FILE`].
#[derive(Debug, Deserialize)]
struct MadeWith {
    generator: Generator,
    /// The sensors.
    #[serde(default)]
    vehicle_base: serde_json::Value,
}

#[derive(Debug, Deserialize)]
struct Generator {
    subset: String,
    seed: u64,
    #[serde(rename = "town")]
    map: String,
    #[serde(rename = "town_seed")]
    map_seed: u64,
    agents: usize,
    frames: usize,
    period_seconds: f64,
    weather: String,
    layout: Option<String>,
    /// Size of the images, which stands among the sensors.
    #[serde(skip)]
    cameras: String,
}

/// True if scenes of these options are in their folder already. They may have further weather copies.
///
/// # Errors
/// [`SynthError::Kept`] if the folder holds other scenes, with the first setting in which they differ;
/// [`SynthError::File`] if their settings cannot be read, or they cannot be searched for weather copies.
pub fn are_kept(options: &SynthOptions) -> Result<bool> {
    let folder = options.out.as_path();
    if !folder.exists() {
        return Ok(false);
    }
    let scenarios = read(folder)?;
    let maps: Vec<String> = sources(options).iter().map(RoadMapSource::name).collect();
    for made in &scenarios {
        let opv2v = SceneLayout::Opv2v.name();
        let layout = made.layout.as_deref().unwrap_or(opv2v);
        let settings: [(&str, &dyn ToString, &dyn ToString); 8] = [
            ("subset", &made.subset, &options.subset.name()),
            ("seed", &made.seed, &options.seed),
            ("frames", &made.frames, &options.frames),
            ("period_seconds", &made.period_seconds, &options.period_s),
            ("weather", &made.weather, &options.weather.name()),
            ("map_seed", &made.map_seed, &options.map_seed),
            ("layout", &layout, &options.layout.name()),
            ("cameras", &made.cameras, &options.image_size()),
        ];
        for (setting, found, wanted) in settings {
            let (found, wanted) = (found.to_string(), wanted.to_string());
            if found != wanted {
                return differs(folder, setting, &found, &wanted);
            }
        }
        if !maps.contains(&made.map) {
            return differs(folder, "map", &made.map, &maps.join(" or "));
        }
        if !options.agents.contains(&made.agents) {
            let wanted = format!("{} to {}", options.agents.start(), options.agents.end());
            return differs(folder, "agents", &made.agents.to_string(), &wanted);
        }
    }
    let (found, wanted) = (scenarios.len(), options.scenes);
    if found != wanted {
        return differs(folder, "scenarios", &found.to_string(), &wanted.to_string());
    }
    if options.copies.is_empty() {
        return Ok(true);
    }
    // The recorded settings do not name the copies.
    let dataset = dataset::open(folder).map_err(|error| FileError::new(folder, error))?;
    for scenario in &dataset.scenarios {
        let found = &scenario.lidar_variants;
        let mut wanted = options.copies.iter().filter_map(|copy| copy.variant());
        if let Some(lacking) = wanted.find(|copy| !found.iter().any(|name| name == copy)) {
            return differs(folder, "weather_copies", &format!("{found:?}"), lacking);
        }
    }
    Ok(true)
}

fn differs(folder: &Path, setting: &str, found: &str, wanted: &str) -> Result<bool> {
    let folder = folder.display();
    Err(SynthError::Kept(format!(
        "{folder} holds scenes made with {setting} {found}, not {wanted}; take another folder, or remove it"
    )))
}

/// As [`generate`], but the folder is renamed to its final name when the data set is complete: an interrupted run
/// leaves no partial data set, and the next run starts again.
///
/// # Errors
/// As [`generate`].
pub fn generate_whole(options: &SynthOptions, progress: &(dyn Fn(u64) + Sync)) -> Result<Summary> {
    let unfinished = options.out.with_added_extension("unfinished");
    // What an interrupted run has left.
    remove_folder(&unfinished)?;
    let aside = SynthOptions {
        out: unfinished.clone(),
        ..options.clone()
    };
    let summary = generate(&aside, progress)?;
    // Its files are on the disk by now: a folder with its final name has them all, also after a power cut.
    let renamed = fs::rename(&unfinished, &options.out);
    let renamed = renamed.and_then(|()| atomic_file::sync_name(&options.out));
    written(&options.out, renamed)?;
    Ok(summary)
}

/// Settings with which the scenarios in a folder were made; an error if a scenario has no file with its settings.
fn read(folder: &Path) -> Result<Vec<Generator>> {
    let mut generators = Vec::new();
    for entry in fs::read_dir(folder).at(folder)? {
        let scenario = entry.at(folder)?.path();
        if !scenario.is_dir() {
            continue;
        }
        let file = scenario.join(PROTOCOL_FILE);
        let text = bounded_file::read_text(&file, MAX_FILE_BYTES).map_err(|error| {
            let problem = format!("{error}; generated scenes record their settings in this file");
            FileError::new(&file, problem)
        })?;
        let made: MadeWith = serde_saphyr::from_str(&text).map_err(|error| {
            let text = error.without_snippet().to_string();
            FileError::new(&file, text.lines().next().unwrap_or_default())
        })?;
        let (mut generator, sensors) = (made.generator, made.vehicle_base);
        let size = sensors.pointer("/sensing/perception/camera/image_size");
        generator.cameras = size.and_then(|size| size.as_str()).unwrap_or("none").into();
        generators.push(generator);
    }
    Ok(generators)
}

#[cfg(test)]
mod tests {
    use super::super::{ImageSize, Subset, Weather};
    use super::*;

    #[test]
    fn cached_scenes_are_used_only_for_their_own_options() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("scenes");
        let options = SynthOptions {
            scenes: 2,
            frames: 2,
            agents: 2..=2,
            copies: vec![Weather::Fog],
            cameras: Some(ImageSize {
                width_px: 16,
                height_px: 16,
            }),
            ..SynthOptions::new(Subset::V2vdet, 7, out.clone())
        };
        assert!(!are_kept(&options).unwrap());
        // Left by an interrupted run with another seed.
        fs::create_dir_all(folder.path().join("scenes.unfinished/v2vdet_town1_s8_0000")).unwrap();
        generate_whole(&options, &|_| {}).unwrap();
        assert!(are_kept(&options).unwrap());
        assert!(
            are_kept(&SynthOptions {
                agents: 1..=3,
                threads: 2,
                ..options.clone()
            })
            .unwrap()
        );
        for (asked, words) in [
            (
                SynthOptions {
                    seed: 8,
                    ..options.clone()
                },
                "seed 7, not 8",
            ),
            (
                SynthOptions {
                    frames: 3,
                    ..options.clone()
                },
                "frames 2, not 3",
            ),
            (
                SynthOptions {
                    agents: 3..=4,
                    ..options.clone()
                },
                "agents 2, not 3 to 4",
            ),
            (
                SynthOptions {
                    scenes: 3,
                    ..options.clone()
                },
                "scenarios 2, not 3",
            ),
            (
                SynthOptions {
                    weather: Weather::Fog,
                    ..options.clone()
                },
                "weather sunny, not fog",
            ),
            (
                SynthOptions {
                    map: Some(RoadMapSource::Town1),
                    ..options.clone()
                },
                "map town4, not town1",
            ),
            (
                SynthOptions {
                    cameras: None,
                    ..options.clone()
                },
                "cameras 16x16, not none",
            ),
            (
                SynthOptions {
                    copies: vec![Weather::Snow],
                    ..options.clone()
                },
                r#"weather_copies ["fog_0.060"], not snow"#,
            ),
        ] {
            let problem = are_kept(&asked).unwrap_err().to_string();
            assert!(
                problem.contains(words) && problem.contains(&*out.to_string_lossy()),
                "{problem}"
            );
        }
        fs::create_dir(out.join("other")).unwrap();
        let problem = are_kept(&options).unwrap_err().to_string();
        assert!(problem.contains("other/data_protocol.yaml"), "{problem}");
        fs::write(
            out.join("other/data_protocol.yaml"),
            vec![b' '; MAX_FILE_BYTES as usize + 1],
        )
        .unwrap();
        let problem = are_kept(&options).unwrap_err().to_string();
        assert!(problem.contains("larger than"), "{problem}");
    }
}
