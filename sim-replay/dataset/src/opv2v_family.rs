//! Reader of OPV2V and the layouts of its family: a folder per scenario, in it a folder per agent.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;

use protocol::{CavId, Handedness};

use super::agent_folders::{self, ScenarioFolder};
use super::layouts::{LayoutRow, Reader};
use super::open::{OpenOptions, opened};
use super::opv2v::Opv2v;
use super::presence::Absences;
use super::v2v4real::V2v4Real;
use super::written_pose::WrittenPose;
use super::yaml::{self, Field};
use super::{Dataset, FrameSource, Layout, ReadError, Scenario, Tick, files};

/// OPV2V, V2XSet, V2X-R, V2VDet and generated scenes: a folder per agent, YAML and PCD per frame, left-handed.
pub(crate) static OPV2V: LayoutRow = LayoutRow {
    key: "opv2v",
    name: "OPV2V layout",
    data_sets: "OPV2V, V2XSet, V2X-R, V2VDet, V2X-Radar, RCooper as its converter writes it, generated scenes",
    files: "<scenario>/<agent>/<frame>.yaml and .pcd; lidar_pose of 6 numbers",
    protocol: "opv2v",
    reader: Some(Reader::DataSet(open)),
};

/// V2V4Real: the same folders, with pose matrices and objects in the LiDAR frame, right-handed.
pub(crate) static V2V4REAL: LayoutRow = LayoutRow {
    key: "v2v4_real",
    name: "V2V4Real layout",
    data_sets: "V2V4Real",
    files: "<scenario>/<agent>/<frame>.yaml and .pcd; lidar_pose a 4x4 matrix or 16 numbers",
    protocol: "v2v4real",
    reader: None,
};

/// V2X-Real and V2XPnP: the folders of OPV2V with `.bin` sweeps, right-handed.
pub(crate) static V2XREAL: LayoutRow = LayoutRow {
    key: "v2x_real",
    name: "V2X-Real layout",
    data_sets: "V2X-Real, V2XPnP",
    files: "<scenario>/<agent>/<frame>.yaml and .bin (float32 x y z intensity); lidar_pose of 6 numbers",
    protocol: "v2xreal",
    reader: None,
};

/// Number of frames of a scenario that are tried to detect its layout.
const FRAMES_TO_TRY: usize = 5;

/// Opens the scenarios at or below `root`; `None` where there are none.
fn open(root: &Path, options: &OpenOptions) -> Result<Option<Dataset>, ReadError> {
    let mut problems = Vec::new();
    let folders = agent_folders::find(root, &mut problems)?;
    if folders.is_empty() {
        // The readers of sequences list the same folders again.
        return Ok(None);
    }
    let mut scenarios = Vec::with_capacity(folders.len());
    for dir in &folders {
        match ScenarioFolder::scan(dir, &mut problems) {
            Ok(folder) if folder.agents.is_empty() => {
                problems.push(ReadError::malformed(
                    dir,
                    "no agent with a frame: the scenario is left out",
                ));
            }
            Ok(folder) => {
                scenarios.push(agent_folder_scenario(root, folder, options, &mut problems))
            }
            Err(error) => problems.push(error),
        }
    }
    opened(root, scenarios, problems)
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
    let source_handedness = if layout == Layout::OPV2V {
        Handedness::Left
    } else {
        Handedness::Right
    };
    let moments = folder.ticks(options.period_nanos, problems);
    let ego_lacks = |tick: &Tick| {
        folder
            .missing
            .iter()
            .any(|frame| Some(&frame.agent) == folder.agents.first() && frame.stem == tick.stem)
    };
    let ticks: Vec<Tick> = moments
        .iter()
        .filter(|tick| !ego_lacks(tick))
        .cloned()
        .collect();
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
        cameras: if layout == Layout::V2V4REAL {
            Vec::new()
        } else {
            all_cameras(&folder)
        },
        layout,
        source_handedness,
        joins: Vec::new(),
        contradicted: BTreeSet::new(),
        source: if layout == Layout::V2V4REAL {
            Arc::new(V2v4Real { folder, sweeps }) as Arc<dyn FrameSource>
        } else {
            Arc::new(Opv2v {
                folder,
                sweeps,
                handedness: source_handedness,
            })
        },
    }
}

/// Numbers of the cameras of any agent.
fn all_cameras(folder: &ScenarioFolder) -> Vec<u8> {
    let all: BTreeSet<u8> = folder.cameras.values().flatten().copied().collect();
    all.into_iter().collect()
}

/// The layout by the shape of the first pose that can be read, and then by the kind of sweeps. Frames with another
/// shape are reported when they are loaded.
fn family_layout(folder: &ScenarioFolder) -> Layout {
    let frames = folder.stems.iter().flat_map(|stem| {
        folder
            .agents
            .iter()
            .map(move |agent| folder.yaml(agent, stem))
    });
    match frames
        .take(FRAMES_TO_TRY)
        .find_map(|path| lidar_pose(&path).ok())
    {
        Some(WrittenPose::Matrix(_)) => Layout::V2V4REAL,
        _ if folder.has_bare_floats() => Layout::V2XREAL,
        _ => Layout::OPV2V,
    }
}

fn lidar_pose(path: &Path) -> Result<WrittenPose, ReadError> {
    let node = yaml::read(path)?;
    WrittenPose::read(&Field::root(path, &node).required("lidar_pose")?)
}
