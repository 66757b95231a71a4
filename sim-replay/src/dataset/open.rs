//! Finding out what layout a folder has.

use std::path::Path;
use std::sync::Arc;

use protocol::{CavId, Handedness};

use super::agent_folders::{self, ScenarioFolder};
use super::opv2v::{self, Opv2v};
use super::presence::Absences;
use super::v2v4real::V2v4Real;
use super::{
    Dataset, FrameSource, Layout, ReadError, Scenario, files, kitti_object, kitti_odometry, localization, recorded,
    unfinished,
};

/// How far below the opened folder sequences of a single vehicle are looked for.
const SEQUENCE_DEPTH: usize = 2;
/// How many frames of a scenario are tried to tell its layout.
const FRAMES_TO_TRY: usize = 5;

/// What a dataset does not say of itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OpenOptions {
    /// Time from one stored frame to the next where neither time stamps nor the length of a simulator's tick are
    /// recorded, nanoseconds. The datasets of the OPV2V family store ten frames a second.
    pub period_nanos: u64,
}

impl Default for OpenOptions {
    fn default() -> Self {
        Self { period_nanos: 100_000_000 }
    }
}

/// Opens the dataset, split, scenario or sequence in `dir`, or a recording; the layout is found out.
///
/// # Errors
/// [`ReadError`] when `dir` cannot be read or is no layout that is known here. What is wrong with single frames is
/// found when they are loaded; what had to be left out stands in [`Dataset::problems`].
pub fn open(dir: &Path) -> Result<Dataset, ReadError> {
    open_with(dir, &OpenOptions::default())
}

/// [`open`] with what the dataset does not say of itself.
///
/// # Errors
/// As [`open`].
pub fn open_with(dir: &Path, options: &OpenOptions) -> Result<Dataset, ReadError> {
    let mut dataset = open_any(dir, options)?;
    unfinished::report(dir, &mut dataset);
    Ok(dataset)
}

fn open_any(dir: &Path, options: &OpenOptions) -> Result<Dataset, ReadError> {
    if let Some(file) = recorded::file_of(dir) {
        return recorded::open(&file);
    }
    let folders = agent_folders::find(dir)?;
    if !folders.is_empty() {
        return open_agent_folders(dir, &folders, options);
    }
    let mut problems = Vec::new();
    let mut scenarios = Vec::new();
    open_single_vehicles(dir, (dir, SEQUENCE_DEPTH), options, &mut scenarios, &mut problems)?;
    let layout = scenarios.first().map(|scenario: &Scenario| scenario.layout).ok_or_else(|| unknown(dir))?;
    Ok(Dataset { layout, scenarios, problems })
}

/// Opens what is a sequence or split of one of the layouts with a single vehicle, at `dir` or below.
fn open_single_vehicles(
    root: &Path,
    (dir, depth): (&Path, usize),
    options: &OpenOptions,
    scenarios: &mut Vec<Scenario>,
    problems: &mut Vec<ReadError>,
) -> Result<(), ReadError> {
    if kitti_object::is_split(dir) {
        scenarios.push(kitti_object::open(root, dir, options)?);
    } else if kitti_odometry::is_sequence(dir) {
        scenarios.push(kitti_odometry::open(root, dir, options)?);
    } else if localization::is_sequence(dir) {
        scenarios.push(localization::open(root, dir, problems)?);
    } else if depth > 0 {
        for folder in files::list(dir)?.folders {
            open_single_vehicles(root, (&dir.join(folder), depth - 1), options, scenarios, problems)?;
        }
    }
    Ok(())
}

fn open_agent_folders(
    root: &Path,
    folders: &[std::path::PathBuf],
    options: &OpenOptions,
) -> Result<Dataset, ReadError> {
    let mut problems = Vec::new();
    let mut scenarios = Vec::with_capacity(folders.len());
    for dir in folders {
        let folder = ScenarioFolder::scan(dir, &mut problems)?;
        scenarios.push(agent_folder_scenario(root, folder, options, &mut problems));
    }
    let layout = scenarios.first().map_or(Layout::Opv2v, |scenario| scenario.layout);
    Ok(Dataset { layout, scenarios, problems })
}

fn agent_folder_scenario(
    root: &Path,
    folder: ScenarioFolder,
    options: &OpenOptions,
    problems: &mut Vec<ReadError>,
) -> Scenario {
    if folder.stems.is_empty() {
        problems.push(ReadError::malformed(&folder.dir, "no frame of any agent"));
    }
    let layout = if is_v2v4real(&folder) { Layout::V2v4Real } else { Layout::Opv2v };
    let source_handedness = if layout == Layout::Opv2v { Handedness::Left } else { Handedness::Right };
    let ticks = folder.ticks(options.period_nanos, problems);
    let is_unit = |id: &&CavId| id.as_str().starts_with('-');
    Scenario {
        name: files::name_below(root, &folder.dir),
        agents: folder.agents.clone(),
        absences: Absences::new(&folder.agents, &ticks, &folder.missing),
        ticks,
        missing: folder.missing.clone(),
        roadside_units: folder.agents.iter().filter(is_unit).cloned().collect(),
        lidar_variants: folder.variants.clone(),
        has_radar: folder.has_radar,
        layout,
        source_handedness,
        source: match layout {
            Layout::V2v4Real => Arc::new(V2v4Real(folder)) as Arc<dyn FrameSource>,
            _ => Arc::new(Opv2v(folder)),
        },
    }
}

/// The first frames that can be read decide. What is wrong with the others shows when they are loaded.
fn is_v2v4real(folder: &ScenarioFolder) -> bool {
    let frames = folder.stems.iter().flat_map(|stem| folder.agents.iter().map(move |agent| folder.yaml(agent, stem)));
    frames.take(FRAMES_TO_TRY).find_map(|path| opv2v::is_v2v4real(&path).ok()).unwrap_or(false)
}

fn unknown(dir: &Path) -> ReadError {
    let reason = if agent_folders::is_agent(dir) {
        "this is the folder of one agent: open the scenario above it".to_owned()
    } else {
        "no known layout: expected <scenario>/<agent>/<frame>.yaml and .pcd (OPV2V and its relatives, V2V4Real), \
         <sequence>/velodyne_left or velodyne_sync/<microseconds>.bin (Oxford, NCLT), velodyne and calib.txt (KITTI \
         odometry) or velodyne and calib (KITTI object), at most three folders down"
            .to_owned()
    };
    ReadError::Layout { path: dir.to_owned(), reason }
}
