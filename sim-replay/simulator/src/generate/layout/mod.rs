//! Layouts on disk in which scenes are written: one file per layout, one [`Frame`] for all.
//!
//! A [`SceneWriter`] receives the capture times of one scene after another, in the convention of [`dataset::frame`]:
//! the type that the readers produce. Axes, units and file formats of a layout are confined to its writer. A new layout
//! is one file beside this one, a line in [`SceneLayout`] and a line in [`SceneLayout::writer`].

mod agent_folders;
mod boxes;
mod dair;
mod dair_json;
mod disk;
mod kitti_object;
mod kitti_odometry;
mod mars;
mod nclt;
mod nuscenes;
mod nuscenes_tables;
mod opv2v;
mod oxford;
mod sequences;
mod v2v4real;
mod v2xreal;
mod v2xsim;
mod yaml_text;

#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use clap::ValueEnum;
use protocol::{CavId, Pose};

use super::error::SynthError;
use super::positioning::Fix;
use dataset::frame::{Frame, Object};

use agent_folders::AgentFolderWriter;
pub(crate) use disk::{Unfinished, make_folder, remove_folder, written};
use sequences::Sequences;
pub(crate) use support::sync::lock as locked;

/// Name of the file of a scenario's settings, in its folder.
pub(crate) const PROTOCOL_FILE: &str = "data_protocol.yaml";

/// Offset between the clocks of two scenes, microseconds: a day.
const DAY_MICROS: u64 = 86_400_000_000;

/// The layouts that scenes are written in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, ValueEnum, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum SceneLayout {
    /// OPV2V, V2XSet: a folder per agent with PCD and YAML, left-handed. The only layout with radar, GNSS and copies in
    /// other weather.
    #[default]
    Opv2v,
    /// V2V4Real: the same folders, right-handed, pose matrices pickled by NumPy, boxes in the frame of the LiDAR.
    V2v4real,
    /// DAIR-V2X-C: the ego as the vehicle, the second agent as the roadside unit; others are left out.
    Dair,
    /// V2X-Seq SPD: the same two, in sequences with track ids.
    V2xseq,
    /// V2X-Real, V2XPnP: folders as OPV2V, right-handed, `.bin` sweeps, types of objects.
    V2xreal,
    /// V2X-Sim 2.0: tables of nuScenes, one sample for all agents, boxes in the world.
    V2xsim,
    /// Open MARS: tables of nuScenes, a channel per vehicle. The released set has no boxes; scenes written here have.
    Mars,
    /// NCLT as recorded: velodyne_sync and ground truth per agent, steps of 5 mm within 100 m. No boxes.
    Nclt,
    /// Oxford as LightLoc converts it: velodyne_left and HDF5 poses per agent. No boxes.
    Oxford,
    /// KITTI odometry: a sequence per agent, poses from the first scan. No boxes.
    KittiOdometry,
    /// KITTI object detection: each sweep of each agent a frame of its own, without pose.
    KittiObject,
}

impl SceneLayout {
    /// The name on the command line.
    pub fn name(self) -> &'static str {
        self.into()
    }

    /// True if it cannot hold scenes of one agent.
    pub(super) fn needs_two_agents(self) -> bool {
        matches!(self, Self::Dair | Self::V2xseq)
    }

    /// A writer of data sets below `root`, which exists.
    pub(crate) fn writer(self, root: &Path) -> Box<dyn SceneWriter> {
        match self {
            Self::Opv2v => Box::new(AgentFolderWriter::new(root, opv2v::write_files)),
            Self::V2v4real => Box::new(AgentFolderWriter::new(root, v2v4real::write_files)),
            Self::Dair => Box::new(dair::Dair::new(root, dair::Edition::Dair)),
            Self::V2xseq => Box::new(dair::Dair::new(root, dair::Edition::V2xSeq)),
            Self::V2xreal => Box::new(AgentFolderWriter::new(root, v2xreal::write_files)),
            Self::V2xsim => Box::new(nuscenes::NuScenes::new(root, &v2xsim::STYLE)),
            Self::Mars => Box::new(nuscenes::NuScenes::new(root, &mars::STYLE)),
            Self::Nclt => Box::new(Sequences::new(root, &nclt::STYLE)),
            Self::Oxford => Box::new(Sequences::new(root, &oxford::STYLE)),
            Self::KittiOdometry => Box::new(Sequences::new(root, &kitti_odometry::STYLE)),
            Self::KittiObject => Box::new(kitti_object::KittiObject::new(root)),
        }
    }
}

/// Writes scenes in one layout, one after another.
pub(crate) trait SceneWriter: Send + Sync {
    /// Begins a scene. Files of an earlier run under its name are removed.
    fn begin(&mut self, scene: &SceneHeader) -> Result<(), SynthError>;

    /// Writes one capture time of the scene: from any thread, in any order, each once. Returns the number of frames that
    /// were written. Data that the layout cannot hold are counted in `omitted`.
    fn write(&self, moment: &Moment, omitted: &Omissions) -> Result<usize, SynthError>;

    /// Ends the scene: writes data shared by its capture times.
    fn end(&mut self) -> Result<(), SynthError> {
        Ok(())
    }

    /// Ends the data set: writes data shared by its scenes.
    fn finish(&mut self) -> Result<(), SynthError> {
        Ok(())
    }
}

/// A scene before its first moment.
#[derive(Debug, Clone, Default)]
pub(crate) struct SceneHeader {
    /// Its name; parts separated by `/` are folders.
    pub(crate) name: String,
    /// Its agents, ego first.
    pub(crate) agents: Vec<SceneAgent>,
    /// Capture times of its moments, nanoseconds, rising.
    pub(crate) capture_nanos: Vec<u64>,
    /// Length of a tick of the clock that OPV2V's file names count, nanoseconds. Capture times are multiples of it.
    pub(crate) tick_nanos: u64,
    /// Text of `data_protocol.yaml`: the origin of the scene.
    pub(crate) origin: String,
}

/// An agent of a scene.
#[derive(Debug, Clone)]
pub(crate) struct SceneAgent {
    pub(crate) id: CavId,
    /// True for a roadside unit, false for a vehicle.
    pub(crate) is_roadside: bool,
}

/// The frames of the agents that are present at one capture time.
#[derive(Debug)]
pub(crate) struct Moment {
    /// Index of the capture time in the scene.
    pub(crate) index: usize,
    /// In the order of the scene's agents.
    pub(crate) frames: Vec<AgentFrame>,
}

/// One agent's frame.
#[derive(Debug)]
pub(crate) struct AgentFrame {
    /// Index of the agent in the scene.
    pub(crate) agent: usize,
    /// The frame, with points.
    pub(crate) frame: Frame,
    /// Copies of the sweep in other weather.
    pub(crate) variants: Vec<SweepVariant>,
    /// Data that only simulation provides.
    pub(crate) simulated: Option<Simulated>,
}

/// A copy of a sweep, named as in [`dataset::Scenario::lidar_variants`].
#[derive(Debug)]
pub(crate) struct SweepVariant {
    pub(crate) name: String,
    /// x, y, z in metres and intensity, in the frame of the LiDAR.
    pub(crate) points: Vec<[f32; 4]>,
    /// For each point 1 if it is clutter (fog or snow), else 0.
    pub(crate) labels: Vec<u8>,
}

/// Simulated data that [`Frame`] does not hold.
#[derive(Debug)]
pub(crate) struct Simulated {
    /// GNSS and IMU measurements.
    pub(crate) fix: Fix,
    /// For each object the point on the ground under its centre, in the world, and the offset from there to the centre
    /// of the box, metres.
    pub(crate) anchors: Vec<BoxAnchor>,
}

/// OPV2V's reference point of an object, which is not the centre of its box.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BoxAnchor {
    pub(crate) location_m: [f64; 3],
    pub(crate) center_offset_m: [f64; 3],
}

impl AgentFrame {
    /// The pose of the LiDAR in the world. Writers get no frames without a pose.
    pub(crate) fn world_from_lidar(&self) -> nalgebra::Isometry3<f64> {
        let pose = self.frame.world_from_lidar.unwrap_or(Pose::IDENTITY);
        pose.isometry()
    }
}

impl Moment {
    /// The frame of an agent, if it is present.
    fn of(&self, agent: usize) -> Option<&AgentFrame> {
        self.frames.iter().find(|frame| frame.agent == agent)
    }

    /// Every object listed in any of these frames, once: as in the first frame that lists it.
    fn union<'a>(frames: impl IntoIterator<Item = &'a AgentFrame>) -> Vec<&'a Object> {
        let mut seen = std::collections::HashSet::new();
        let objects = frames.into_iter().flat_map(|frame| &frame.frame.objects);
        objects.filter(|object| seen.insert(object.id)).collect()
    }
}

/// Data that a layout cannot hold: counts by kind.
#[derive(Debug, Default)]
pub(crate) struct Omissions(Mutex<BTreeMap<&'static str, u64>>);

impl Omissions {
    /// Counts `count` more of `what`.
    pub(crate) fn add(&self, what: &'static str, count: usize) {
        if count > 0 {
            *locked(&self.0).entry(what).or_default() += count as u64;
        }
    }

    pub(crate) fn into_counts(self) -> BTreeMap<&'static str, u64> {
        self.0.into_inner().unwrap_or_else(PoisonError::into_inner)
    }
}
