//! Reader of OPV2V and the layouts of its family: a folder per scenario, in it a folder per agent.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;

use protocol::Handedness;

use super::agent_folders::{self, ScenarioFolder};
use super::frame_files::BIN;
use super::layout::{LayoutReader, LayoutRow, opened};
use super::options::OpenOptions;
use super::opv2v::Opv2v;
use super::v2v4real::V2v4Real;
use super::written_pose::WrittenPose;
use super::yaml::{self, YamlField};
use super::{Dataset, FrameSource, Layout, ReadError, Result, Scenario, files};

/// OPV2V, V2XSet, V2X-R, V2VDet and generated scenes: a folder per agent, YAML and PCD per frame, left-handed.
pub(crate) static OPV2V: LayoutRow = LayoutRow {
    key: "opv2v",
    name: "OPV2V layout",
    data_sets: "OPV2V, V2XSet, V2X-R, V2VDet, V2X-Radar, RCooper as its converter writes it, generated scenes",
    files: "<scenario>/<agent>/<frame>.yaml and .pcd; lidar_pose of 6 numbers",
    protocol: "opv2v",
    reader: Some(LayoutReader::DataSet(open)),
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
fn open(root: &Path, options: &OpenOptions) -> Result<Option<Dataset>> {
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
                let reason = "no agent with a frame: the scenario is left out";
                problems.push(ReadError::malformed(dir, reason));
            }
            Ok(folder) => {
                scenarios.push(agent_folder_scenario(root, folder, options, &mut problems));
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
    let handedness = match layout == Layout::OPV2V {
        true => Handedness::Left,
        false => Handedness::Right,
    };
    let moments = folder.ticks(options.period_nanos, problems);
    let (agents, missing) = (folder.agents.clone(), folder.missing.clone());
    let roadside_units = folder.roadside_units.clone();
    let name = files::name_below(root, &folder.dir);
    let variants = folder.by_agent.values().flat_map(|agent| &agent.variants);
    let variants: BTreeSet<String> = variants.cloned().collect();
    let has_radar = folder.by_agent.values().any(|agent| agent.has_radar);
    let cameras = folder.by_agent.values().flat_map(|agent| &agent.cameras);
    // Images of V2V4Real are not read.
    let cameras = cameras.filter(|_| layout != Layout::V2V4REAL);
    let cameras: BTreeSet<u8> = cameras.copied().collect();
    let source: Arc<dyn FrameSource> = match layout == Layout::V2V4REAL {
        true => Arc::new(V2v4Real { folder, sweeps }),
        false => Arc::new(Opv2v {
            folder,
            sweeps,
            handedness,
        }),
    };
    Scenario {
        roadside_units,
        lidar_variants: variants.into_iter().collect(),
        has_radar,
        cameras: cameras.into_iter().collect(),
        source_handedness: handedness,
        ..Scenario::new(name, layout, agents, Vec::new(), source)
    }
    .among(moments, missing)
}

/// The layout by the shape of the first pose that can be read, and then by the kind of sweeps. Frames with another
/// shape are reported when they are loaded.
fn family_layout(folder: &ScenarioFolder) -> Layout {
    let frames = folder.stems.iter().flat_map(|stem| {
        let agents = folder.agents.iter();
        agents.map(move |agent| folder.yaml(agent, stem))
    });
    let mut tried = frames.take(FRAMES_TO_TRY);
    match tried.find_map(|path| lidar_pose(&path).ok()) {
        Some(WrittenPose::Matrix(_)) => Layout::V2V4REAL,
        _ if folder.suffix == BIN => Layout::V2XREAL,
        _ => Layout::OPV2V,
    }
}

fn lidar_pose(path: &Path) -> Result<WrittenPose> {
    let node = yaml::read(path)?;
    WrittenPose::read(&YamlField::root(path, &node).required("lidar_pose")?)
}
