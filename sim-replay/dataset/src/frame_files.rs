//! Files of one agent's folder: complete frames, variants of the sweep, and other files.

use std::collections::BTreeSet;
use std::path::Path;

use super::files::{self, Listing};
use super::{ReadError, camera_files};

/// Text in the names of YAML files that are no frames (OpenCOOD, V2V4Real, the settings of a scenario).
const NOT_FRAMES: [&str; 3] = ["additional", "camera_gt", "data_protocol"];
/// Endings of YAML files; a folder's files have the first of these that any of them has.
const YAMLS: [&str; 4] = [".yaml", ".yml", ".YAML", ".YML"];
pub(super) const RADAR: &str = "radar";
/// Suffixes of sweeps: PCD, and bare floats as V2X-Real stores them.
pub(super) const PCD: &str = ".pcd";
pub(super) const BIN: &str = ".bin";

/// Contents of an agent's folder.
#[derive(Debug, Default)]
pub(super) struct AgentFolder {
    /// Stems with both YAML and sweep; with a sweep alone if there is no YAML at all.
    pub(super) stems: BTreeSet<String>,
    /// Ending of the YAML files; `None` if there are none.
    pub(super) yaml_ending: Option<&'static str>,
    pub(super) variants: BTreeSet<String>,
    pub(super) has_radar: bool,
    /// Numbers of the cameras that have images.
    pub(super) cameras: BTreeSet<u8>,
}

/// True if a folder has a frame's YAML and its sweep of the given suffix.
pub(super) fn holds_pairs(listing: &Listing, suffix: &str) -> bool {
    let ending = yaml_ending(listing).unwrap_or(YAMLS[0]);
    let yamls: BTreeSet<&str> = yaml_stems(listing, ending).collect();
    files::stems(&listing.files, suffix).any(|stem| yamls.contains(stem))
}

/// Ending of a folder's YAML files.
pub(super) fn yaml_ending(listing: &Listing) -> Option<&'static str> {
    let mut endings = YAMLS.into_iter();
    endings.find(|ending| yaml_stems(listing, ending).next().is_some())
}

fn yaml_stems<'a>(listing: &'a Listing, ending: &'a str) -> impl Iterator<Item = &'a str> {
    files::stems(&listing.files, ending)
        .filter(|stem| !NOT_FRAMES.iter().any(|text| stem.contains(text)))
}

/// True for digits: frames are numbered.
fn is_number(stem: &str) -> bool {
    !stem.is_empty() && stem.bytes().all(|byte| byte.is_ascii_digit())
}

/// The stems of frames, and the names of other files with this ending. Copies such as `000070 (1)` beside numbers are
/// not frames; frames may have other names if most have.
pub(super) fn usual_stems<'a>(
    all: BTreeSet<&'a str>,
    ending: &str,
) -> (BTreeSet<&'a str>, Vec<String>) {
    let (numbers, others): (BTreeSet<&str>, BTreeSet<&str>) =
        all.iter().partition(|stem| is_number(stem));
    let names = others.iter().filter(|stem| {
        let rest = stem.trim_start_matches(|letter: char| letter.is_ascii_digit());
        // The removed digits are ASCII, so the cut lies between two characters.
        !numbers.contains(&stem[..stem.len() - rest.len()])
    });
    if numbers.len() >= names.count() && !numbers.is_empty() {
        let strays = others.iter().map(|stem| format!("{stem}{ending}"));
        (numbers, strays.collect())
    } else {
        (all, Vec::new())
    }
}

/// One problem for all files whose names differ from those of frames.
pub(super) fn named_once(dir: &Path, strays: &[String]) -> Option<ReadError> {
    let first = strays.iter().min()?;
    let reason = format!(
        "{} files whose names are no frame numbers are left out, first: {first}",
        strays.len()
    );
    Some(ReadError::malformed(dir, reason))
}

impl AgentFolder {
    /// Sorts the files of `dir`. Parts that have to be left out are added to `problems`.
    pub(super) fn new(
        dir: &Path,
        listing: &Listing,
        suffix: &str,
        problems: &mut Vec<ReadError>,
    ) -> Self {
        let yaml_ending = yaml_ending(listing);
        let yaml = yaml_ending.unwrap_or(YAMLS[0]);
        let mut listed: BTreeSet<&str> = yaml_stems(listing, yaml).collect();
        if listed.is_empty() {
            // Sweeps alone are frames without poses and boxes.
            let sweeps = files::stems(&listing.files, suffix);
            // A name with an underscore is that of a variant, `<stem>_<variant>`, and no frame.
            listed.extend(sweeps.filter(|stem| !stem.contains('_')));
        }
        let (yamls, mut strays) = usual_stems(listed, yaml_ending.unwrap_or(suffix));
        let are_numbers = !yamls.is_empty() && yamls.iter().all(|stem| is_number(stem));
        let mut agent = Self {
            yaml_ending,
            cameras: camera_files::numbers(&listing.files),
            ..Self::default()
        };
        let mut without_yaml = BTreeSet::new();
        for name in files::stems(&listing.files, suffix) {
            // At the first underscore: variants contain more of them, `fog_0.060` for example.
            match name.split_once('_') {
                // First the whole name: a stem may contain an underscore itself.
                _ if yamls.contains(name) => drop(agent.stems.insert(name.to_owned())),
                Some((stem, RADAR)) if yamls.contains(stem) => agent.has_radar = true,
                Some((stem, variant)) if yamls.contains(stem) => {
                    agent.variants.insert(variant.to_owned());
                }
                parts => {
                    let stem = parts.map_or(name, |(stem, _)| stem);
                    if are_numbers && !is_number(stem) {
                        strays.push(format!("{name}{suffix}"));
                    } else {
                        without_yaml.insert(stem);
                    }
                }
            }
        }
        problems.extend(named_once(dir, &strays));
        let without_yaml = without_yaml.into_iter();
        let alone = without_yaml.map(|stem| (stem, yaml, suffix));
        let without_sweep = yamls.iter().filter(|stem| !agent.stems.contains(**stem));
        let alone = alone.chain(without_sweep.map(|&stem| (stem, suffix, yaml)));
        problems.extend(alone.map(|(stem, missing, there)| {
            let reason = format!("does not exist beside {stem}{there}: the frame is left out");
            ReadError::malformed(&dir.join(format!("{stem}{missing}")), reason)
        }));
        agent
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scan(names: &[&str], suffix: &str) -> (AgentFolder, Vec<String>) {
        let listing = Listing {
            folders: vec![],
            files: names.iter().map(|name| (*name).to_owned()).collect(),
        };
        let mut problems = Vec::new();
        let agent = AgentFolder::new(Path::new("1"), &listing, suffix, &mut problems);
        (agent, problems.iter().map(ToString::to_string).collect())
    }

    fn stems(agent: &AgentFolder) -> Vec<&str> {
        agent.stems.iter().map(String::as_str).collect()
    }

    #[test]
    fn copies_and_other_names_are_no_frames_and_are_named_once() {
        let copies = [
            "000070 (1).pcd",
            "000070 (1).yaml",
            "000070.pcd",
            "000070.yaml",
            "000070 copy_radar.pcd",
            "notes.yaml",
        ];
        let (agent, problems) = scan(&copies, PCD);
        assert_eq!(stems(&agent), ["000070"]);
        assert!(!agent.has_radar);
        assert_eq!(
            problems,
            ["1: 4 files whose names are no frame numbers are left out, first: 000070 (1).pcd"]
        );
    }

    #[test]
    fn frames_may_have_names() {
        let (agent, problems) = scan(
            &["a_1.pcd", "a_1.yaml", "a_1_fog.pcd", "b.pcd", "b.yaml"],
            PCD,
        );
        assert_eq!(stems(&agent), ["a_1", "b"]);
        assert_eq!(
            problems,
            ["1/a.yaml: does not exist beside a.pcd: the frame is left out"]
        );
    }

    #[test]
    fn yaml_has_the_ending_that_the_folder_uses() {
        for ending in [".yml", ".YAML"] {
            let names = ["000070.pcd", "000071.pcd", "000070", "000072"];
            let [sweep, alone, first, second] = names;
            let yamls = [first, second].map(|stem| format!("{stem}{ending}"));
            let (agent, problems) = scan(
                &[sweep, alone, &yamls[0], &yamls[1], "000070_additional.yaml"],
                PCD,
            );
            assert_eq!(
                (stems(&agent), agent.yaml_ending),
                (vec!["000070"], Some(ending))
            );
            assert_eq!(
                problems,
                [
                    format!(
                        "1/000071{ending}: does not exist beside 000071.pcd: the frame is left out"
                    ),
                    format!(
                        "1/000072.pcd: does not exist beside 000072{ending}: the frame is left out"
                    ),
                ]
            );
        }
    }

    #[test]
    fn bare_floats_are_sweeps_where_there_is_no_pcd() {
        let names = [
            "000000.bin",
            "000000.yaml",
            "000001.yaml",
            "000000_cam1.jpeg",
            "000000_additional.yaml",
        ];
        let (agent, problems) = scan(&names, BIN);
        assert_eq!(stems(&agent), ["000000"]);
        assert_eq!(
            problems,
            ["1/000001.bin: does not exist beside 000001.yaml: the frame is left out"]
        );
    }
}
