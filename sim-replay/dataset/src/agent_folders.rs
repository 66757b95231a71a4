//! The folders of the OPV2V family: `<root>/<split>/<scenario>/<agent>/<frame>.yaml` with a sweep beside it, entered at
//! any level.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use protocol::CavId;

use super::files::Listing;
use super::frame_files::{AgentFolder, BIN, PCD, holds_pairs, yaml_ending};
use super::keys::{self, Keys};
use super::points::{SweepStorage, Sweeps};
use super::problem::listed;
use super::time_stamps;
use super::yaml::{self, Value, YamlField};
use super::{MissingFrame, OpenOptions, ReadError, Result, Tick, files};
use crate::error::shown;
use support::rounding;

/// Depth below the opened folder to which scenarios are searched.
const MAX_DEPTH: usize = 3;

/// Folder of a scenario and its contents.
#[derive(Debug)]
pub(super) struct ScenarioFolder {
    pub(super) dir: PathBuf,
    /// Ego first, roadside units last.
    pub(super) agents: Vec<CavId>,
    pub(super) roadside_units: Vec<CavId>,
    /// Stems of frames of any agent.
    pub(super) stems: Vec<String>,
    /// Stems of frames of some agents, by the agent that lacks them.
    pub(super) missing: Vec<MissingFrame>,
    /// Contents of the agents' folders.
    pub(super) by_agent: BTreeMap<CavId, AgentFolder>,
    /// Suffix of the sweeps.
    pub(super) suffix: &'static str,
}

/// Folders of scenarios at or below `dir`. Folders below that cannot be listed are left out.
pub(super) fn find(dir: &Path, problems: &mut Vec<ReadError>) -> Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    // A bag may be a single file.
    if dir.is_file() {
        return Ok(found);
    }
    find_below(dir, &files::list(dir)?, MAX_DEPTH, &mut found, problems);
    Ok(files::each_once(found, problems))
}

fn find_below(
    dir: &Path,
    listing: &Listing,
    depth: usize,
    found: &mut Vec<PathBuf>,
    problems: &mut Vec<ReadError>,
) {
    let below: Vec<(PathBuf, Listing)> = files::list_below(dir, listing, problems);
    let mut folders = below.iter();
    if folders.any(|(folder, listing)| is_agent_folder(folder, listing)) {
        found.push(dir.to_owned());
    } else if depth > 0 {
        for (folder, listing) in &below {
            find_below(folder, listing, depth - 1, found, problems);
        }
    }
}

/// True if a folder is an agent's: the likely mistake of opening one level too deep.
pub(super) fn is_agent(dir: &Path) -> bool {
    files::list(dir).is_ok_and(|listing| is_agent_folder(dir, &listing))
}

/// True for names that are CARLA actor ids (negative for roadside units) if there is a complete frame, or a part of one
/// and no frame in a folder below; for other names if there is a complete frame and no folder below has one: a scenario
/// may hold a stray folder.
fn is_agent_folder(dir: &Path, listing: &Listing) -> bool {
    let (mut folders, mut names) = (listing.folders.iter(), listing.files.iter());
    let is_frame = holds_frame(listing);
    let is_named = match is_number(&files::last_name(dir)) {
        true if is_frame => return true,
        true => yaml_ending(listing).is_some() || names.any(|name| name.ends_with(PCD)),
        false => is_frame,
    };
    // In this order: the second test lists every folder below.
    let list = |folder: &String| files::list(&dir.join(folder));
    is_named && !folders.any(|folder| list(folder).is_ok_and(|below| holds_frame(&below)))
}

/// True if there is a complete frame.
fn holds_frame(listing: &Listing) -> bool {
    holds_pairs(listing, PCD) || holds_pairs(listing, BIN)
}

fn is_number(name: &str) -> bool {
    name.parse::<i64>().is_ok()
}

/// The agents of a scenario with the contents of their folders. Copies of folders such as `650 (1)` or `650_old` are
/// not agents.
fn agents_in(dir: &Path, problems: &mut Vec<ReadError>) -> Result<Vec<(CavId, Listing)>> {
    let mut below = files::list_below(dir, &files::list(dir)?, problems);
    below.retain(|(folder, listing)| {
        is_number(&files::last_name(folder)) || is_agent_folder(folder, listing)
    });
    let are_numbers = below.iter().any(|(folder, listing)| {
        is_number(&files::last_name(folder)) && is_agent_folder(folder, listing)
    });
    let mut agents = Vec::new();
    for (folder, listing) in below {
        let name = files::last_name(&folder);
        let reason = match CavId::new(&name) {
            Ok(_) if are_numbers && !is_number(&name) => {
                "no number as the other agents' are".to_owned()
            }
            Ok(id) => {
                agents.push((id, listing));
                continue;
            }
            Err(error) => error.to_string(),
        };
        let reason = format!(
            "it holds frames, but its name is no agent's: {reason}: the folder is left out"
        );
        problems.push(ReadError::malformed(&folder, reason));
    }
    Ok(agents)
}

impl ScenarioFolder {
    /// Lists the folders of all agents. Parts that have to be left out are added to `problems`.
    pub(super) fn scan(dir: &Path, problems: &mut Vec<ReadError>) -> Result<Self> {
        let listed = agents_in(dir, problems)?;
        // Bare floats are used only where no agent has a PCD: a scenario has one kind of sweeps.
        let mut suffixes = [PCD, BIN].into_iter();
        let suffix = suffixes.find(|suffix| {
            let mut listings = listed.iter();
            listings.any(|(_, listing)| holds_pairs(listing, suffix))
        });
        let suffix = suffix.unwrap_or(PCD);
        let mut by_agent = BTreeMap::new();
        for (id, listing) in &listed {
            let agent_dir = dir.join(id.as_str());
            let agent = AgentFolder::new(&agent_dir, listing, suffix, problems);
            if agent.stems.is_empty() {
                let kind = &suffix[1..];
                let reason = format!("no frame with both YAML and {kind}: the agent is left out");
                problems.push(ReadError::malformed(&agent_dir, reason));
            } else {
                by_agent.insert(id.clone(), agent);
            }
        }
        // No unit is the ego if there is a vehicle; OpenCOOD moves the first of them only. Text order, as OpenCOOD
        // sorts: `1045` before `650`.
        let (roadside_units, vehicles): (Vec<CavId>, Vec<CavId>) = (by_agent.keys().cloned())
            .partition(|id| is_roadside_unit(dir, id, &by_agent, problems));
        let agents = [vehicles, roadside_units.clone()].concat();
        let all: BTreeSet<&String> = by_agent.values().flat_map(|agent| &agent.stems).collect();
        let mut missing = Vec::new();
        for stem in &all {
            let without = (by_agent.iter()).filter(|(_, agent)| !agent.stems.contains(*stem));
            missing.extend(without.map(|(id, _)| MissingFrame::new(id, stem)));
        }
        let mut stems: Vec<String> = all.into_iter().cloned().collect();
        problems.extend(without_common_frame(dir, &agents, &by_agent));
        // The set is in text order, where 10 comes before 9.
        stems.sort_by(|first, second| files::natural_order(first, second));
        Ok(Self {
            dir: dir.to_owned(),
            agents,
            roadside_units,
            stems,
            missing,
            by_agent,
            suffix,
        })
    }

    /// The folder of an agent.
    pub(super) fn agent_dir(&self, agent: &CavId) -> PathBuf {
        self.dir.join(agent.as_str())
    }

    fn yaml_ending(&self, agent: &CavId) -> Option<&'static str> {
        self.by_agent.get(agent)?.yaml_ending
    }

    /// True for an agent that has sweeps and nothing else.
    pub(super) fn is_without_yaml(&self, agent: &CavId) -> bool {
        self.yaml_ending(agent).is_none()
    }

    /// The metadata file of a frame.
    pub(super) fn yaml(&self, agent: &CavId, stem: &str) -> PathBuf {
        let ending = self.yaml_ending(agent).unwrap_or(".yaml");
        self.agent_dir(agent).join(format!("{stem}{ending}"))
    }

    /// The plain sweep of a frame, or a variant of it.
    pub(super) fn pcd(&self, agent: &CavId, stem: &str, variant: Option<&str>) -> PathBuf {
        let variant = shown("_", variant, "");
        self.agent_dir(agent)
            .join(format!("{stem}{variant}{}", self.suffix))
    }

    /// The reader of all agents' sweeps.
    pub(super) fn sweeps(&self, options: &OpenOptions) -> Sweeps {
        let mut sweeps = Sweeps::new(SweepStorage::ByName, options);
        for (agent, folder) in &self.by_agent {
            // Missing files are left out first: they would use up the tries.
            let stems = (self.stems.iter()).filter(|stem| folder.stems.contains(*stem));
            let files = stems.map(|stem| self.pcd(agent, stem, None));
            sweeps = sweeps.with_agent(agent.clone(), files);
        }
        sweeps
    }

    /// Capture times of all stems. They count simulator ticks where `data_protocol.yaml` gives the length of a tick:
    /// time is tick times length. Else stems that are times give them, from the first on; of others the median step is
    /// one `period_nanos`, from 0 on. Times that no LiDAR has, equal ones, and names that are dates are a problem.
    pub(super) fn ticks(&self, period_nanos: u64, problems: &mut Vec<ReadError>) -> Vec<Tick> {
        let tick_nanos = self.tick_nanos().unwrap_or_else(|error| {
            problems.push(error);
            None
        });
        let mut stems: Vec<&str> = self.stems.iter().map(String::as_str).collect();
        problems.extend(self.leave_unlike_out(&mut stems));
        let counted = tick_nanos.and_then(|nanos| Keys::of_ticks(&stems, nanos));
        let keys = counted.unwrap_or_else(|| Keys::of_stems(&stems));
        let numbers = match &keys {
            Keys::Times(nanos) => nanos.clone(),
            _ => (0..stems.len()).map(|index| keys.count(index)).collect(),
        };
        problems.extend(match &keys {
            Keys::Times(_) => time_stamps::step_problem(&self.dir, &numbers),
            _ => time_stamps::date_problem(&self.dir, &stems),
        });
        let first = numbers.iter().min().copied().unwrap_or(0);
        let frames: Vec<(&str, u64)> = stems.into_iter().zip(numbers).collect();
        let (first, step, nanos) = match (&keys, tick_nanos) {
            (Keys::Times(_), _) => (first, 1, 1),
            (Keys::Numbers(_), Some(nanos)) => (0, 1, nanos),
            _ => (first, self.usual_step(&frames, problems), period_nanos),
        };
        let ticks = frames.into_iter().map(|(stem, number)| {
            let since = number.saturating_sub(first);
            Tick::new(stem, since.saturating_mul(nanos) / step)
        });
        let mut ticks: Vec<Tick> = ticks.collect();
        // Natural order compares fractions as whole numbers: 1.5 would come before 1.25.
        ticks.sort_by_key(|tick| tick.capture_nanos);
        let mut pairs = ticks.array_windows::<2>();
        let equal = pairs.find(|[a, b]| a.capture_nanos == b.capture_nanos);
        problems.extend(equal.map(|[Tick { stem, .. }, next]| {
            let reason = format!("frames {stem} and {} have one time", next.stem);
            ReadError::malformed(&self.dir, reason)
        }));
        ticks
    }

    /// Leaves out the few frames with a time where the others have numbers, or the other way round.
    fn leave_unlike_out(&self, stems: &mut Vec<&str>) -> Option<ReadError> {
        let strays = keys::strays(stems)?;
        stems.retain(|stem| !strays.contains(stem));
        let strays = listed(strays);
        let reason = format!(
            "frame numbers of another order of magnitude than the others: left out: {strays}"
        );
        Some(ReadError::malformed(&self.dir, reason))
    }

    /// The median step between frames. Where it is rare, as in a random choice of frames, and all others
    /// are multiples of the smallest one, that is used.
    fn usual_step(&self, frames: &[(&str, u64)], problems: &mut Vec<ReadError>) -> u64 {
        let steps = frames.array_windows();
        let steps = steps.map(|[(_, a), (_, b)]| b.saturating_sub(*a));
        let mut steps: Vec<u64> = steps.filter(|&step| step > 0).collect();
        steps.sort_unstable();
        let middle = steps.get(steps.len().saturating_sub(1) / 2);
        let (Some(&least), Some(&usual), Some(most)) = (steps.first(), middle, steps.last()) else {
            return 1;
        };
        let count = steps.iter().filter(|&&step| step == usual).count();
        let is_unit = |unit: u64| steps.iter().all(|step| step % unit == 0);
        if 2 * count <= steps.len() && is_unit(least) {
            return least;
        }
        if !is_unit(usual) {
            let reason = format!(
                "frame numbers in steps of {least} to {most}: {usual}, their median, is taken for one period"
            );
            problems.push(ReadError::malformed(&self.dir, reason));
        }
        usual
    }

    /// The file that may state the length of a tick.
    pub(super) fn tick_length(&self) -> PathBuf {
        self.dir.join("data_protocol.yaml")
    }

    /// `world.fixed_delta_seconds` of `data_protocol.yaml` in nanoseconds, if there is such a file and key.
    fn tick_nanos(&self) -> Result<Option<u64>> {
        let path = self.tick_length();
        if !path.is_file() {
            return Ok(None);
        }
        let node = yaml::read(&path)?;
        let world = YamlField::root(&path, &node).optional("world")?;
        let delta = world.map(|world| world.optional("fixed_delta_seconds"));
        let Some(delta) = delta.transpose()?.flatten() else {
            return Ok(None);
        };
        let seconds = delta.number()?;
        if !(1e-6..=10.0).contains(&seconds) {
            return Err(delta.error(format!(
                "{seconds} s, expected 1e-6 to 10 s: the tick's length is not used"
            )));
        }
        Ok(Some(rounding::to_u64(seconds * 1e9)))
    }
}

/// One problem for every agent that never has a frame at the ego's ticks: odd stems and even ones, for example.
fn without_common_frame(
    dir: &Path,
    agents: &[CavId],
    by_agent: &BTreeMap<CavId, AgentFolder>,
) -> Vec<ReadError> {
    let ids = agents.iter();
    let mut stems = ids.filter_map(|id| Some((id, &by_agent.get(id)?.stems)));
    let Some((ego, of_ego)) = stems.next() else {
        return Vec::new();
    };
    let strangers = stems.filter(|(_, own)| of_ego.is_disjoint(own));
    let problems = strangers.map(|(id, own)| {
        let [own_first, ego_first] =
            [own, of_ego].map(|stems| stems.first().map_or("", String::as_str));
        let reason = format!(
            "no frame of agent {id} (first {own_first}) at a tick of the ego {ego} (first {ego_first}): it takes no part"
        );
        ReadError::malformed(&dir.join(id.as_str()), reason)
    });
    problems.collect()
}

/// True for a negative id, and for an agent whose first frame says so: `RSU: true`. Another value than a boolean is a
/// problem.
fn is_roadside_unit(
    dir: &Path,
    id: &CavId,
    by_agent: &BTreeMap<CavId, AgentFolder>,
    problems: &mut Vec<ReadError>,
) -> bool {
    let mut stated = || {
        let contents = by_agent.get(id)?;
        let name = format!("{}{}", contents.stems.first()?, contents.yaml_ending?);
        let path = dir.join(id.as_str()).join(name);
        let node = yaml::read(&path).ok()?;
        let stated = YamlField::root(&path, &node).optional("RSU").ok()??;
        if !matches!(stated.node.value, Value::Bool(_)) {
            let fault = stated.expected("true or false");
            problems.push(fault.with_consequence("the agent counts as a vehicle"));
        }
        Some(stated.node.value == Value::Bool(true))
    };
    id.as_str().starts_with('-') || stated() == Some(true)
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
        (
            folder,
            problems
                .iter()
                .map(|problem| problem.to_string().replace(&*root, ""))
                .collect(),
        )
    }

    fn ids(folder: &ScenarioFolder) -> Vec<&str> {
        folder.agents.iter().map(CavId::as_str).collect()
    }

    fn scenario_names(root: &Path, below: &str) -> Vec<String> {
        let dirs = find(&root.join(below), &mut Vec::new()).unwrap();
        dirs.iter()
            .map(|dir| files::name_below(root, dir))
            .collect()
    }

    #[test]
    fn scenarios_are_found_at_every_level() {
        let dir = tempfile::tempdir().unwrap();
        touch(
            dir.path(),
            &[
                "test/a/1/0.yaml",
                "test/b/1/0.pcd",
                "train/c/1/0.yaml",
                "README.md",
                "empty/x",
            ],
        );
        let root = dir.path();
        assert_eq!(scenario_names(root, ""), ["test/a", "test/b", "train/c"]);
        assert_eq!(scenario_names(root, "test"), ["test/a", "test/b"]);
        assert_eq!(scenario_names(root, "test/a"), ["test/a"]);
        assert!(scenario_names(root, "empty").is_empty());
        assert!(is_agent(&dir.path().join("test/a/1")) && !is_agent(&dir.path().join("test/a")));
    }

    #[test]
    fn a_numbered_scenario_with_its_settings_is_no_agent() {
        let dir = tempfile::tempdir().unwrap();
        touch(
            dir.path(),
            &[
                "test/17/data_protocol.yaml",
                "test/17/1/0.yaml",
                "test/17/1/0.pcd",
            ],
        );
        touch(
            dir.path(),
            &["test/18/notes.yaml", "test/18/1/0.yaml", "test/18/1/0.pcd"],
        );
        let names = scenario_names(dir.path(), "");
        assert_eq!(names, ["test/17", "test/18"]);
    }

    #[test]
    fn a_unit_is_stated_by_true_or_false() {
        for (value, units, named) in [
            ("true", 1, 0),
            ("1", 0, 1),
            ("'true'", 0, 1),
            ("false", 0, 0),
        ] {
            let dir = tempfile::tempdir().unwrap();
            touch(dir.path(), &["1/0.yaml", "1/0.pcd"]);
            fs::write(dir.path().join("1/0.yaml"), format!("RSU: {value}\n")).unwrap();
            let (folder, problems) = scan(dir.path());
            let found = (folder.roadside_units.len(), problems.len());
            assert_eq!(found, (units, named), "{value}: {problems:?}");
            let reason = "expected true or false: the agent counts as a vehicle";
            assert!(
                problems.iter().all(|problem| problem.ends_with(reason)),
                "{problems:?}"
            );
        }
    }

    #[test]
    fn agents_are_in_text_order_with_roadside_units_last() {
        let dir = tempfile::tempdir().unwrap();
        for agent in ["650", "1045", "-1", "-2"] {
            touch(
                dir.path(),
                &[&format!("{agent}/0.yaml"), &format!("{agent}/0.pcd")],
            );
        }
        assert_eq!(ids(&scan(dir.path()).0), ["1045", "650", "-1", "-2"]);
        fs::write(dir.path().join("1045/0.yaml"), "RSU: true\n").unwrap();
        fs::write(dir.path().join("650/0.yaml"), "RSU: false\n").unwrap();
        let folder = scan(dir.path()).0;
        assert_eq!(ids(&folder), ["650", "-1", "-2", "1045"]);
        let units: Vec<&str> = folder.roadside_units.iter().map(CavId::as_str).collect();
        assert_eq!(units, ["-1", "-2", "1045"], "one of them by its files");
    }

    #[test]
    fn frames_are_listed_and_so_are_missing_ones() {
        let dir = tempfile::tempdir().unwrap();
        touch(
            dir.path(),
            &[
                "1/000068.yaml",
                "1/000068.pcd",
                "1/000070.yaml",
                "1/000070.pcd",
            ],
        );
        touch(
            dir.path(),
            &[
                "2/000070.yaml",
                "2/000070.pcd",
                "2/000072.yaml",
                "2/000074.pcd",
                "2/000076_radar.pcd",
            ],
        );
        touch(dir.path(), &["3/000070.yaml"]);
        let (folder, problems) = scan(dir.path());
        assert_eq!((ids(&folder), folder.stems.len()), (vec!["1", "2"], 2));
        assert_eq!(
            folder.missing,
            [MissingFrame {
                agent: CavId::new("2").unwrap(),
                stem: "000068".into()
            }]
        );
        assert_eq!(
            problems,
            [
                "/2/000074.yaml: does not exist beside 000074.pcd: the frame is left out",
                "/2/000076.yaml: does not exist beside 000076.pcd: the frame is left out",
                "/2/000072.pcd: does not exist beside 000072.yaml: the frame is left out",
                "/3/000070.pcd: does not exist beside 000070.yaml: the frame is left out",
                "/3: no frame with both YAML and pcd: the agent is left out",
            ]
        );
    }

    #[test]
    fn an_agent_without_a_common_tick_is_reported() {
        let dir = tempfile::tempdir().unwrap();
        touch(
            dir.path(),
            &[
                "1/000068.yaml",
                "1/000068.pcd",
                "1/000070.yaml",
                "1/000070.pcd",
            ],
        );
        touch(dir.path(), &["2/000069.yaml", "2/000069.pcd"]);
        let (folder, problems) = scan(dir.path());
        assert_eq!((folder.agents.len(), folder.stems.len()), (2, 3));
        let expected = "/2: no frame of agent 2 (first 000069) at a tick of the ego 1 (first 000068): it takes no part";
        assert_eq!(problems, [expected]);
    }

    #[test]
    fn variants_radar_and_other_files_are_distinguished() {
        let dir = tempfile::tempdir().unwrap();
        touch(
            dir.path(),
            &[
                "1/000010.yaml",
                "1/000010.pcd",
                "1/000010_radar.pcd",
                "1/000010_snow_2.5_2.0.pcd",
            ],
        );
        touch(
            dir.path(),
            &[
                "1/000010_fog_0.060.pcd",
                "1/000010_camera0.png",
                "1/000010_additional.yaml",
                "1/a.json",
            ],
        );
        let (folder, problems) = scan(dir.path());
        let agent = &folder.by_agent[&folder.agents[0]];
        let variants: Vec<&String> = agent.variants.iter().collect();
        assert_eq!(variants, ["fog_0.060", "snow_2.5_2.0"]);
        assert!(agent.has_radar && problems.is_empty(), "{problems:?}");
    }

    #[test]
    fn capture_times_are_those_of_the_stems_where_these_are_times() {
        for (stems, expected) in [
            (
                [
                    "1626155123000000000",
                    "1626155123092000000",
                    "1626155125200000000",
                ],
                [0, 92, 2200],
            ),
            (
                ["1626155123.25", "1626155123.5", "1626155124"],
                [0, 250, 750],
            ),
        ] {
            let dir = tempfile::tempdir().unwrap();
            for stem in stems {
                touch(
                    dir.path(),
                    &[&format!("1/{stem}.yaml"), &format!("1/{stem}.pcd")],
                );
            }
            let mut problems = Vec::new();
            let ticks = scan(dir.path()).0.ticks(100_000_000, &mut problems);
            let times = ticks.iter();
            let times = times.map(|tick| (tick.capture_nanos + 500_000) / 1_000_000);
            assert_eq!(times.collect::<Vec<u64>>(), expected, "{stems:?}");
            let found: Vec<&str> = ticks.iter().map(|tick| tick.stem.as_str()).collect();
            assert_eq!((found, problems.len()), (stems.to_vec(), 0));
        }
    }

    #[test]
    fn a_stated_tick_counts_stems_of_any_size_that_are_no_times() {
        for (stems, tick_s, expected) in [
            (
                ["132603000010", "132603000011", "132603000013"],
                "0.01",
                [0, 10, 30],
            ),
            (
                ["1600000000000000", "1600000000100000", "1600000000200000"],
                "0.05",
                [0, 100, 200],
            ),
        ] {
            let dir = tempfile::tempdir().unwrap();
            for stem in stems {
                touch(
                    dir.path(),
                    &[&format!("1/{stem}.yaml"), &format!("1/{stem}.pcd")],
                );
            }
            let protocol = format!("world: {{fixed_delta_seconds: {tick_s}}}");
            fs::write(dir.path().join("data_protocol.yaml"), protocol).unwrap();
            let mut problems = Vec::new();
            let ticks = scan(dir.path()).0.ticks(100_000_000, &mut problems);
            let first = ticks[0].capture_nanos;
            let times = ticks
                .iter()
                .map(|tick| (tick.capture_nanos - first) / 1_000_000);
            assert_eq!(times.collect::<Vec<u64>>(), expected, "{stems:?}");
            assert_eq!(problems.len(), 0, "{problems:?}");
        }
    }

    #[test]
    fn equal_times_and_times_that_no_lidar_has_are_named() {
        for (stems, expected) in [
            (
                ["1000.5", "1000.50"],
                "frames 1000.5 and 1000.50 have one time",
            ),
            (["26520600060", "26520600062"], "their unit is doubtful"),
        ] {
            let dir = tempfile::tempdir().unwrap();
            for stem in stems {
                touch(
                    dir.path(),
                    &[&format!("1/{stem}.yaml"), &format!("1/{stem}.pcd")],
                );
            }
            let mut problems = Vec::new();
            scan(dir.path()).0.ticks(100_000_000, &mut problems);
            assert_eq!(problems.len(), 1, "{problems:?}");
            assert!(
                problems[0].to_string().ends_with(expected),
                "{}",
                problems[0]
            );
        }
    }

    #[test]
    fn a_stray_frame_does_not_change_the_step_of_the_others() {
        let dir = tempfile::tempdir().unwrap();
        let frame = |stem: u32| {
            let stem = format!("1/{stem:06}");
            touch(
                dir.path(),
                &[&format!("{stem}.yaml"), &format!("{stem}.pcd")],
            );
        };
        let times = || {
            let mut problems = Vec::new();
            let ticks = scan(dir.path()).0.ticks(100_000_000, &mut problems);
            let last = ticks.last().unwrap().capture_nanos / 1_000_000;
            (ticks.len(), last, problems)
        };
        (0..20).for_each(|index| frame(68 + 2 * index));
        let (frames, last, problems) = times();
        assert_eq!((frames, last, problems.len()), (20, 1900, 0));
        frame(65);
        let (frames, last, problems) = times();
        assert_eq!((frames, last, problems.len()), (21, 2050, 1));
        let problem = problems[0].to_string();
        let end = "frame numbers in steps of 2 to 3: 2, their median, is taken for one period";
        assert!(problem.ends_with(end), "{problem}");
        frame(123_456_789);
        let (frames, last, problems) = times();
        assert_eq!((frames, last, problems.len()), (21, 2050, 2));
        let problem = problems[0].to_string();
        let end =
            "frame numbers of another order of magnitude than the others: left out: 123456789";
        assert!(problem.ends_with(end), "{problem}");
        fs::remove_file(dir.path().join("1/123456789.pcd")).unwrap();
        // One between two others would halve the step of all.
        fs::remove_file(dir.path().join("1/000065.pcd")).unwrap();
        frame(69);
        let (frames, last, problems) = times();
        let problem = problems[0].to_string();
        assert_eq!((frames, last), (21, 1900), "{problem}");
        // Frames chosen at random have the unit of the smallest step.
        (0..20).for_each(|index| frame(110 + index * index));
        let (frames, last, _) = times();
        assert_eq!((frames, last), (41, 40_300));
    }

    #[test]
    fn the_period_of_milliseconds_is_the_usual_step() {
        let dir = tempfile::tempdir().unwrap();
        for millis in [1000, 1103, 1198, 1300, 1401, 1440, 1600] {
            let stem = format!("1/{millis:06}");
            touch(
                dir.path(),
                &[&format!("{stem}.yaml"), &format!("{stem}.pcd")],
            );
        }
        let mut problems = Vec::new();
        let ticks = scan(dir.path()).0.ticks(100_000_000, &mut problems);
        let times = ticks.iter().map(|tick| tick.capture_nanos / 1_000_000);
        // In units of the usual step, 101.
        let expected = [0, 101, 196, 297, 397, 435, 594];
        assert_eq!(times.collect::<Vec<u64>>(), expected);
        assert_eq!(problems.len(), 1, "{problems:?}");
    }

    #[test]
    fn capture_times_come_from_ticks_or_the_period() {
        let dir = tempfile::tempdir().unwrap();
        for stem in ["98", "100", "104"] {
            touch(
                dir.path(),
                &[&format!("1/{stem}.yaml"), &format!("1/{stem}.pcd")],
            );
        }
        for (protocol, expected_problems, millis) in [
            (None, 0, [0, 100, 300]),
            (
                Some("world: {fixed_delta_seconds: 0.05}"),
                0,
                [4900, 5000, 5200],
            ),
            (Some("world: {fixed_delta_seconds: -1}"), 1, [0, 100, 300]),
        ] {
            if let Some(text) = protocol {
                fs::write(dir.path().join("data_protocol.yaml"), text).unwrap();
            }
            let mut problems = Vec::new();
            let ticks = scan(dir.path()).0.ticks(100_000_000, &mut problems);
            assert_eq!(problems.len(), expected_problems, "{problems:?}");
            let times: Vec<(&str, u64)> = ticks
                .iter()
                .map(|tick| (tick.stem.as_str(), tick.capture_nanos / 1_000_000))
                .collect();
            let expected: Vec<(&str, u64)> = ["98", "100", "104"].into_iter().zip(millis).collect();
            assert_eq!(times, expected, "{protocol:?}");
        }
    }
}
