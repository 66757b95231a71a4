//! Opening of data sets: detects the layout of a folder.

use std::path::Path;
use std::sync::Arc;

use protocol::{CavId, Handedness};

use super::agent_folders::{self, ScenarioFolder};
use super::opv2v::Opv2v;
use super::points::IntensityScale;
use super::presence::Absences;
use super::v2v4real::V2v4Real;
use super::written_pose::WrittenPose;
use super::yaml::{self, Field};
use super::{
    Dataset, FrameSource, Layout, ReadError, Scenario, Tick, dair, files, kitti_object, kitti_odometry, layouts_text,
    localization, nuscenes, recorded, unfinished,
};

/// Depth below the opened folder to which sequences of a single vehicle are searched.
const SEQUENCE_DEPTH: usize = 2;
/// Number of frames of a scenario that are tried to detect its layout.
const FRAMES_TO_TRY: usize = 5;
/// Largest number of faults listed when nothing can be opened.
const SHOWN_PROBLEMS: usize = 5;

/// Properties that a data set does not record itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OpenOptions {
    /// Time from one stored frame to the next if neither time stamps nor the length of a simulator's tick are recorded,
    /// nanoseconds. The data sets of the OPV2V family store ten frames a second.
    pub period_nanos: u64,
    /// Divisor of the intensities of LiDAR sweeps.
    pub intensity_scale: IntensityScale,
}

impl Default for OpenOptions {
    fn default() -> Self {
        Self { period_nanos: 100_000_000, intensity_scale: IntensityScale::AUTO }
    }
}

/// Opens the data set, split, scenario or sequence in `dir`, or a recording; the layout is detected.
///
/// # Errors
/// [`ReadError`] if `dir` cannot be read or has no supported layout. Faults of single frames are found when they are
/// loaded; parts that had to be left out are listed in [`Dataset::problems`].
pub fn open(dir: &Path) -> Result<Dataset, ReadError> {
    open_with(dir, &OpenOptions::default())
}

/// [`open`] with the properties that the data set does not record itself.
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
    for reader in [dair::open, nuscenes::open] {
        if let Some(dataset) = reader(dir, options)? {
            return Ok(dataset);
        }
    }
    let mut problems = Vec::new();
    let folders = agent_folders::find(dir, &mut problems)?;
    if !folders.is_empty() {
        return open_agent_folders(dir, &folders, options, problems);
    }
    // The same folders are listed again.
    problems.clear();
    let mut scenarios = Vec::new();
    open_single_vehicles(dir, (dir, SEQUENCE_DEPTH), options, &mut scenarios, &mut problems)?;
    match scenarios.first().map(|scenario: &Scenario| scenario.layout) {
        Some(layout) => Ok(Dataset { layout, scenarios, problems }),
        None => Err(nothing_opened(dir, problems)),
    }
}

/// Opens the sequences and splits of one of the layouts with a single vehicle, at `dir` or below.
fn open_single_vehicles(
    root: &Path,
    (dir, depth): (&Path, usize),
    options: &OpenOptions,
    scenarios: &mut Vec<Scenario>,
    problems: &mut Vec<ReadError>,
) -> Result<(), ReadError> {
    let opened = if kitti_object::is_split(dir) {
        kitti_object::open(root, dir, options, problems)
    } else if kitti_odometry::is_sequence(dir) {
        kitti_odometry::open(root, dir, options, problems)
    } else if localization::is_sequence(dir) {
        localization::open(root, dir, options, problems)
    } else if depth > 0 {
        for (folder, _) in files::list_below(dir, &files::list(dir)?, problems) {
            open_single_vehicles(root, (&folder, depth - 1), options, scenarios, problems)?;
        }
        return Ok(());
    } else {
        return Ok(());
    };
    // One sequence that cannot be opened does not prevent opening the others.
    match opened {
        Ok(scenario) => scenarios.push(scenario),
        Err(error) => problems.push(error),
    }
    Ok(())
}

fn open_agent_folders(
    root: &Path,
    folders: &[std::path::PathBuf],
    options: &OpenOptions,
    mut problems: Vec<ReadError>,
) -> Result<Dataset, ReadError> {
    let mut scenarios = Vec::with_capacity(folders.len());
    for dir in folders {
        match ScenarioFolder::scan(dir, &mut problems) {
            Ok(folder) if folder.agents.is_empty() => {
                problems.push(ReadError::malformed(dir, "no agent with a frame: the scenario is left out"));
            }
            Ok(folder) => scenarios.push(agent_folder_scenario(root, folder, options, &mut problems)),
            Err(error) => problems.push(error),
        }
    }
    match scenarios.first().map(|scenario| scenario.layout) {
        Some(layout) => Ok(Dataset { layout, scenarios, problems }),
        None => Err(nothing_opened(root, problems)),
    }
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
    let layout = family_layout(&folder);
    let sweeps = folder.sweeps(options);
    let source_handedness = if layout == Layout::Opv2v { Handedness::Left } else { Handedness::Right };
    let moments = folder.ticks(options.period_nanos, problems);
    let ego_lacks = |tick: &Tick| {
        folder.missing.iter().any(|frame| Some(&frame.agent) == folder.agents.first() && frame.stem == tick.stem)
    };
    let ticks: Vec<Tick> = moments.iter().filter(|tick| !ego_lacks(tick)).cloned().collect();
    let is_unit = |id: &&CavId| id.as_str().starts_with('-');
    Scenario {
        name: files::name_below(root, &folder.dir),
        agents: folder.agents.clone(),
        absences: Absences::new(&folder.agents, &ticks, &folder.missing).among(moments),
        ticks,
        missing: folder.missing.clone(),
        roadside_units: folder.agents.iter().filter(is_unit).cloned().collect(),
        lidar_variants: folder.variants.clone(),
        has_radar: folder.has_radar,
        layout,
        source_handedness,
        source: match layout {
            Layout::V2v4Real => Arc::new(V2v4Real { folder, sweeps }) as Arc<dyn FrameSource>,
            _ => Arc::new(Opv2v { folder, sweeps, handedness: source_handedness }),
        },
    }
}

/// The layout by the shape of the first pose that can be read, and then by the kind of sweeps. Frames with another
/// shape are reported when they are loaded.
fn family_layout(folder: &ScenarioFolder) -> Layout {
    let frames = folder.stems.iter().flat_map(|stem| folder.agents.iter().map(move |agent| folder.yaml(agent, stem)));
    match frames.take(FRAMES_TO_TRY).find_map(|path| lidar_pose(&path).ok()) {
        Some(WrittenPose::Matrix(_)) => Layout::V2v4Real,
        _ if folder.has_bare_floats() => Layout::V2xReal,
        _ => Layout::Opv2v,
    }
}

fn lidar_pose(path: &Path) -> Result<WrittenPose, ReadError> {
    let node = yaml::read(path)?;
    WrittenPose::read(&Field::root(path, &node).required("lidar_pose")?)
}

/// The only fault, or all of them, or an unknown layout.
fn nothing_opened(dir: &Path, mut problems: Vec<ReadError>) -> ReadError {
    match problems.len() {
        0 => unknown(dir),
        1 => problems.swap_remove(0),
        count => {
            let shown: Vec<String> = problems.iter().take(SHOWN_PROBLEMS).map(ToString::to_string).collect();
            let more =
                if count > SHOWN_PROBLEMS { format!("; and {} more", count - SHOWN_PROBLEMS) } else { String::new() };
            ReadError::Layout {
                path: dir.to_owned(),
                reason: format!("nothing can be opened: {}{more}", shown.join("; ")),
            }
        }
    }
}

fn unknown(dir: &Path) -> ReadError {
    let reason = if agent_folders::is_agent(dir) {
        "this is the folder of one agent: open the scenario above it".to_owned()
    } else {
        let layouts = layouts_text();
        format!("no supported layout; at most three folders down, expected one of\n{}", layouts.trim_end())
    };
    ReadError::Layout { path: dir.to_owned(), reason }
}
