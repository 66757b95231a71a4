//! The folders of the OPV2V family: `<root>/<split>/<scenario>/<agent>/<frame>.{yaml,pcd}`, entered at any level.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use protocol::CavId;

use super::yaml::{self, Field};
use super::{MissingFrame, ReadError, Tick, files};

/// How far below the opened folder scenarios are looked for.
const MAX_DEPTH: usize = 3;
/// Text in the names of YAML files that are no frames (OpenCOOD, V2V4Real).
const NOT_FRAMES: [&str; 2] = ["additional", "camera_gt"];
const RADAR: &str = "radar";

/// A scenario's folder and what lies in it.
#[derive(Debug)]
pub(super) struct ScenarioFolder {
    pub(super) dir: PathBuf,
    /// Ego first, roadside units last.
    pub(super) agents: Vec<CavId>,
    /// Stems that every agent has.
    pub(super) stems: Vec<String>,
    /// Stems that some agent has and this one has not.
    pub(super) missing: Vec<MissingFrame>,
    /// Suffixes of point files beside the plain one and the radar's.
    pub(super) variants: Vec<String>,
    pub(super) has_radar: bool,
    /// Agents that have sweeps and nothing else.
    pub(super) without_yaml: BTreeSet<CavId>,
}

/// What lies in an agent's folder.
#[derive(Debug, Default)]
struct AgentFolder {
    /// Stems with both YAML and PCD; with PCD alone where there is no YAML at all.
    stems: BTreeSet<String>,
    is_without_yaml: bool,
    variants: BTreeSet<String>,
    has_radar: bool,
}

/// Folders of scenarios at or below `dir`.
pub(super) fn find(dir: &Path) -> Result<Vec<PathBuf>, ReadError> {
    let mut found = Vec::new();
    find_below(dir, MAX_DEPTH, &mut found)?;
    Ok(found)
}

fn find_below(dir: &Path, depth: usize, found: &mut Vec<PathBuf>) -> Result<(), ReadError> {
    let folders = files::list(dir)?.folders;
    let mut agents = folders.iter().filter(|name| is_agent_name(name));
    if agents.any(|name| files::list(&dir.join(name)).is_ok_and(|listing| holds_frames(&listing))) {
        found.push(dir.to_owned());
        return Ok(());
    }
    if depth > 0 {
        for folder in &folders {
            find_below(&dir.join(folder), depth - 1, found)?;
        }
    }
    Ok(())
}

/// Whether a folder is an agent's: the likely mistake of opening one level too deep.
pub(super) fn is_agent(dir: &Path) -> bool {
    let name = dir.file_name().and_then(|name| name.to_str());
    name.is_some_and(is_agent_name) && files::list(dir).is_ok_and(|listing| holds_frames(&listing))
}

/// Agents are named by CARLA's actor id; roadside units are negative.
fn is_agent_name(name: &str) -> bool {
    name.parse::<i64>().is_ok()
}

fn holds_frames(listing: &files::Listing) -> bool {
    listing.files.iter().any(|name| name.ends_with(".yaml") || name.ends_with(".pcd"))
}

impl ScenarioFolder {
    /// Looks into every agent's folder. What has to be left out goes to `problems`.
    pub(super) fn scan(dir: &Path, problems: &mut Vec<ReadError>) -> Result<Self, ReadError> {
        let mut by_agent = BTreeMap::new();
        for name in files::list(dir)?.folders.into_iter().filter(|name| is_agent_name(name)) {
            let agent_dir = dir.join(&name);
            let id = CavId::new(&name).map_err(|error| ReadError::malformed(&agent_dir, error.to_string()))?;
            let agent = AgentFolder::scan(&agent_dir, problems)?;
            if agent.stems.is_empty() {
                problems
                    .push(ReadError::malformed(&agent_dir, "no frame with both YAML and PCD: the agent is left out"));
            } else {
                by_agent.insert(id, agent);
            }
        }
        let agents = in_order(by_agent.keys());
        let all: BTreeSet<&String> = by_agent.values().flat_map(|agent| &agent.stems).collect();
        let (mut stems, mut missing) = (Vec::new(), Vec::new());
        for stem in all {
            let without = agents.iter().filter(|id| !by_agent[id].stems.contains(stem));
            let before = missing.len();
            missing.extend(without.map(|id| MissingFrame { agent: id.clone(), stem: stem.clone() }));
            if missing.len() == before {
                stems.push(stem.clone());
            }
        }
        if stems.iter().all(|stem| stem.parse::<u64>().is_ok()) {
            stems.sort_by_key(|stem| stem.parse::<u64>().unwrap_or(u64::MAX));
        }
        let variants: BTreeSet<String> = by_agent.values().flat_map(|agent| agent.variants.iter().cloned()).collect();
        let has_radar = by_agent.values().any(|agent| agent.has_radar);
        let without_yaml =
            by_agent.iter().filter(|(_, agent)| agent.is_without_yaml).map(|(id, _)| id.clone()).collect();
        let variants = variants.into_iter().collect();
        Ok(Self { dir: dir.to_owned(), agents, stems, missing, variants, has_radar, without_yaml })
    }

    /// The metadata file of a frame.
    pub(super) fn yaml(&self, agent: &CavId, stem: &str) -> PathBuf {
        self.dir.join(agent.as_str()).join(format!("{stem}.yaml"))
    }

    /// The plain sweep of a frame, or a variant of it.
    pub(super) fn pcd(&self, agent: &CavId, stem: &str, variant: Option<&str>) -> PathBuf {
        let suffix = variant.map(|variant| format!("_{variant}")).unwrap_or_default();
        self.dir.join(agent.as_str()).join(format!("{stem}{suffix}.pcd"))
    }

    /// The radar's points of a frame.
    pub(super) fn radar(&self, agent: &CavId, stem: &str) -> PathBuf {
        self.pcd(agent, stem, Some(RADAR))
    }

    /// Capture times. Stems count simulator ticks, they are no clock: where `data_protocol.yaml` gives the length of a
    /// tick, time is tick times length; else the smallest step between stems is one `period_nanos`, from 0 on.
    pub(super) fn ticks(&self, period_nanos: u64, problems: &mut Vec<ReadError>) -> Vec<Tick> {
        let tick_nanos = self.tick_nanos().unwrap_or_else(|error| {
            problems.push(error);
            None
        });
        let numbers: Option<Vec<u64>> = self.stems.iter().map(|stem| stem.parse().ok()).collect();
        let times: Vec<u64> = match (numbers, tick_nanos) {
            (Some(numbers), Some(nanos)) => numbers.iter().map(|number| number.saturating_mul(nanos)).collect(),
            (Some(numbers), None) => {
                let step = numbers.windows(2).map(|pair| pair[1] - pair[0]).filter(|&step| step > 0).min().unwrap_or(1);
                let first = numbers.first().copied().unwrap_or(0);
                numbers.iter().map(|number| ((number - first) / step).saturating_mul(period_nanos)).collect()
            }
            (None, _) => (0..self.stems.len() as u64).map(|index| index.saturating_mul(period_nanos)).collect(),
        };
        let tick = |(stem, capture_nanos): (&String, u64)| Tick { stem: stem.clone(), capture_nanos };
        self.stems.iter().zip(times).map(tick).collect()
    }

    /// `world.fixed_delta_seconds` of `data_protocol.yaml` in nanoseconds, where there is such a file and key.
    fn tick_nanos(&self) -> Result<Option<u64>, ReadError> {
        let path = self.dir.join("data_protocol.yaml");
        if !path.is_file() {
            return Ok(None);
        }
        let node = yaml::read(&path)?;
        let Some(world) = Field::root(&path, &node).optional("world")? else { return Ok(None) };
        let Some(delta) = world.optional("fixed_delta_seconds")? else { return Ok(None) };
        let seconds = delta.number()?;
        if !(1e-6..=10.0).contains(&seconds) {
            return Err(delta.error(format!("{seconds} s, expected 1e-6 to 10 s: the tick's length is not used")));
        }
        Ok(Some((seconds * 1e9).round() as u64))
    }
}

/// Text order, as OpenCOOD sorts: `1045` before `650`. Roadside units (negative ids) go last, so that no unit is the ego
/// where there is a vehicle; OpenCOOD moves the first of them only.
fn in_order<'a>(ids: impl Iterator<Item = &'a CavId>) -> Vec<CavId> {
    let (units, mut agents): (Vec<CavId>, Vec<CavId>) = ids.cloned().partition(|id| id.as_str().starts_with('-'));
    agents.extend(units);
    agents
}

impl AgentFolder {
    fn scan(dir: &Path, problems: &mut Vec<ReadError>) -> Result<Self, ReadError> {
        let listing = files::list(dir)?;
        let is_frame = |stem: &&str| !NOT_FRAMES.iter().any(|text| stem.contains(text));
        let mut yamls: BTreeSet<&str> = files::stems(&listing.files, ".yaml").into_iter().filter(is_frame).collect();
        let mut agent = Self { is_without_yaml: yamls.is_empty(), ..Self::default() };
        if agent.is_without_yaml {
            // Sweeps alone are frames without poses and boxes.
            yamls.extend(files::stems(&listing.files, ".pcd").into_iter().filter(|stem| !stem.contains('_')));
        }
        let mut without_yaml = BTreeSet::new();
        for name in files::stems(&listing.files, ".pcd") {
            if yamls.contains(name) {
                agent.stems.insert(name.to_owned());
                continue;
            }
            match name.split_once('_') {
                Some((stem, RADAR)) if yamls.contains(stem) => agent.has_radar = true,
                Some((stem, variant)) if yamls.contains(stem) => {
                    agent.variants.insert(variant.to_owned());
                }
                Some((stem, _)) => {
                    without_yaml.insert(stem);
                }
                None => {
                    without_yaml.insert(name);
                }
            }
        }
        for stem in without_yaml {
            let path = dir.join(format!("{stem}.yaml"));
            problems
                .push(ReadError::malformed(&path, format!("does not exist beside {stem}.pcd: the frame is left out")));
        }
        for stem in yamls.into_iter().filter(|stem| !agent.stems.contains(*stem)) {
            let path = dir.join(format!("{stem}.pcd"));
            problems
                .push(ReadError::malformed(&path, format!("does not exist beside {stem}.yaml: the frame is left out")));
        }
        Ok(agent)
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn touch(root: &Path, names: &[&str]) {
        for name in names {
            let path = root.join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "").unwrap();
        }
    }

    fn scan(root: &Path) -> (ScenarioFolder, Vec<String>) {
        let mut problems = Vec::new();
        let folder = ScenarioFolder::scan(root, &mut problems).unwrap();
        let root = root.to_string_lossy();
        (folder, problems.iter().map(|problem| problem.to_string().replace(&*root, "")).collect())
    }

    fn ids(folder: &ScenarioFolder) -> Vec<&str> {
        folder.agents.iter().map(CavId::as_str).collect()
    }

    #[test]
    fn scenarios_are_found_at_every_level() {
        let dir = tempfile::tempdir().unwrap();
        touch(dir.path(), &["test/a/1/0.yaml", "test/b/1/0.pcd", "train/c/1/0.yaml", "README.md", "empty/x"]);
        let names = |below: &str| {
            let found = find(&dir.path().join(below)).unwrap();
            found.iter().map(|found| files::name_below(dir.path(), found)).collect::<Vec<_>>()
        };
        assert_eq!(names(""), ["test/a", "test/b", "train/c"]);
        assert_eq!(names("test"), ["test/a", "test/b"]);
        assert_eq!(names("test/a"), ["test/a"]);
        assert!(names("empty").is_empty());
        assert!(is_agent(&dir.path().join("test/a/1")) && !is_agent(&dir.path().join("test/a")));
    }

    #[test]
    fn agents_are_in_text_order_with_roadside_units_last() {
        let dir = tempfile::tempdir().unwrap();
        for agent in ["650", "1045", "-1", "-2"] {
            touch(dir.path(), &[&format!("{agent}/0.yaml"), &format!("{agent}/0.pcd")]);
        }
        assert_eq!(ids(&scan(dir.path()).0), ["1045", "650", "-1", "-2"]);
    }

    #[test]
    fn frame_lists_are_intersected_and_what_is_missing_is_said() {
        let dir = tempfile::tempdir().unwrap();
        touch(dir.path(), &["1/000068.yaml", "1/000068.pcd", "1/000070.yaml", "1/000070.pcd"]);
        touch(dir.path(), &["2/000070.yaml", "2/000070.pcd", "2/000072.yaml", "2/000074.pcd", "2/000076_radar.pcd"]);
        touch(dir.path(), &["3/000070.yaml"]);
        let (folder, problems) = scan(dir.path());
        assert_eq!((ids(&folder), folder.stems.as_slice()), (vec!["1", "2"], ["000070".to_owned()].as_slice()));
        assert_eq!(folder.missing, [MissingFrame { agent: CavId::new("2").unwrap(), stem: "000068".into() }]);
        assert_eq!(
            problems,
            [
                "/2/000074.yaml: does not exist beside 000074.pcd: the frame is left out",
                "/2/000076.yaml: does not exist beside 000076.pcd: the frame is left out",
                "/2/000072.pcd: does not exist beside 000072.yaml: the frame is left out",
                "/3/000070.pcd: does not exist beside 000070.yaml: the frame is left out",
                "/3: no frame with both YAML and PCD: the agent is left out",
            ]
        );
    }

    #[test]
    fn variants_radar_and_other_files_are_told_apart() {
        let dir = tempfile::tempdir().unwrap();
        touch(dir.path(), &["1/000010.yaml", "1/000010.pcd", "1/000010_radar.pcd", "1/000010_snow_2.5_2.0.pcd"]);
        touch(dir.path(), &["1/000010_fog_0.060.pcd", "1/000010_camera0.png", "1/000010_additional.yaml", "1/a.json"]);
        let (folder, problems) = scan(dir.path());
        assert_eq!(folder.variants, ["fog_0.060", "snow_2.5_2.0"]);
        assert!(folder.has_radar && problems.is_empty(), "{problems:?}");
    }

    #[test]
    fn capture_times_come_from_ticks_or_the_period() {
        let dir = tempfile::tempdir().unwrap();
        for stem in ["98", "100", "104"] {
            touch(dir.path(), &[&format!("1/{stem}.yaml"), &format!("1/{stem}.pcd")]);
        }
        let times = |expected_problems: usize| {
            let mut problems = Vec::new();
            let ticks = scan(dir.path()).0.ticks(100_000_000, &mut problems);
            assert_eq!(problems.len(), expected_problems, "{problems:?}");
            ticks.into_iter().map(|tick| (tick.stem, tick.capture_nanos / 1_000_000)).collect::<Vec<_>>()
        };
        let expected =
            |millis: [u64; 3]| ["98", "100", "104"].map(str::to_owned).into_iter().zip(millis).collect::<Vec<_>>();
        assert_eq!(times(0), expected([0, 100, 300]));
        fs::write(dir.path().join("data_protocol.yaml"), "world: {fixed_delta_seconds: 0.05}").unwrap();
        assert_eq!(times(0), expected([4900, 5000, 5200]));
        fs::write(dir.path().join("data_protocol.yaml"), "world: {fixed_delta_seconds: -1}").unwrap();
        assert_eq!(times(1), expected([0, 100, 300]));
    }
}
