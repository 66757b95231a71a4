//! Data sets on disk, in any supported layout, as scenarios of agents and ticks.
//!
//! ```no_run
//! # fn main() -> Result<(), dataset::ReadError> {
//! use dataset::{self, LoadOptions};
//!
//! let dataset = dataset::open("v2xset/validate".as_ref())?;
//! let scenario = &dataset.scenarios[0];
//! let ego_frame = scenario.load(0, 0, &LoadOptions::default())?;
//! println!("{} points", ego_frame.points.len());
//! # Ok(())
//! # }
//! ```

// This crate reads what other processes and people wrote: an index or a cast that does not fit is an error there, not
// a panic or another number.
#![cfg_attr(not(test), deny(clippy::cast_possible_truncation))]
#![cfg_attr(not(test), deny(clippy::cast_sign_loss))]
#![cfg_attr(not(test), deny(clippy::indexing_slicing))]

mod agent_folders;
mod annotations;
pub mod average_precision;
pub mod camera_files;
pub mod carla_pose;
pub mod class_set;
mod classes;
pub mod cloud_files;
mod cloud_sequence;
mod dair;
mod error;
pub mod evaluation_protocol;
mod faults;
mod field;
mod files;
pub mod findings;
pub mod frame;
mod frame_files;
mod generated_map;
pub mod ground_truth;
pub mod hdf5_file;
mod hdf5_poses;
mod json;
mod json_table;
mod keys;
mod kitti_object;
mod kitti_odometry;
mod kitti_text;
mod layout;
mod layouts;
mod left_out;
mod listing;
mod localization;
mod nclt_ground_truth;
mod npy;
mod nuscenes;
mod open;
mod options;
mod opv2v;
mod opv2v_family;
pub mod overlap;
pub mod pcd;
mod period;
mod ply;
mod points;
mod poses;
mod presence;
mod problem;
mod recorded;
mod recorded_motion;
mod repeats;
mod roots;
mod rosbag;
mod scalar;
mod sequence;
mod time_stamps;
mod trajectory;
mod unfinished;
mod v2v4real;
mod written_pose;
mod yaml;

use std::collections::{BTreeSet, HashSet};
use std::fmt::Display;
use std::path::PathBuf;
use std::sync::Arc;

use protocol::{CavId, Handedness};
use serde::Serialize;

pub use error::ReadError;
pub use generated_map::GeneratedMap;
pub use layout::{Layout, LayoutRow};
pub use layouts::{LAYOUTS, layouts_text};
pub use left_out::LeftOut;
pub use listing::{content_sha256, provenance, scenario_sha256};
pub use open::{open, open_with};
pub use options::OpenOptions;
pub use period::period_nanos;
pub use points::{IntensityOption, IntensityScale, LiveIntensities, Plausibility};
pub use presence::LoadedTick;
pub use problem::{Problem, reasons};
pub use recorded::recording_of;
pub use unfinished::UNFINISHED;

use crate::error::Result;
use crate::frame::Frame;
use crate::pcd::PcdCloud;

/// A dataset, or the part of one that was opened.
#[derive(Debug)]
pub struct Dataset {
    /// Its layout.
    pub layout: Layout,
    /// Its scenarios, in text order of their names.
    pub scenarios: Vec<Scenario>,
    /// Faults that did not prevent opening: missing files, folders that cannot be interpreted.
    pub problems: Vec<ReadError>,
}

/// One capture time of a scenario.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Tick {
    /// The name of the tick's files, without suffix: a tick counter or a time stamp, by layout.
    pub stem: String,
    /// Capture time on the scene's clock, nanoseconds.
    pub capture_nanos: u64,
}

impl Tick {
    fn new(stem: impl Into<String>, capture_nanos: u64) -> Self {
        Self {
            stem: stem.into(),
            capture_nanos,
        }
    }
}

/// A frame that one agent lacks.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct MissingFrame {
    /// The agent without the frame.
    pub agent: CavId,
    /// Its stem.
    pub stem: String,
}

impl MissingFrame {
    fn new(agent: &CavId, stem: &str) -> Self {
        Self {
            agent: agent.clone(),
            stem: stem.to_owned(),
        }
    }
}

/// Vehicles (and roadside units) driving at the same time.
#[derive(Debug, Clone)]
pub struct Scenario {
    /// Name: its path below the folder that was opened, or that folder's own name.
    pub name: String,
    /// The agents, ego first: in text order, except that a roadside unit that would come first comes last.
    pub agents: Vec<CavId>,
    /// The ego's ticks, in order. Other agents take part where they have a frame, see [`Self::is_present`].
    pub ticks: Vec<Tick>,
    /// Frames that some agents have and others lack. If the ego lacks one there is no tick.
    pub missing: Vec<MissingFrame>,
    /// Those of `agents` that are roadside units.
    pub roadside_units: Vec<CavId>,
    /// Variants of the LiDAR sweep other than the plain one, for example `fog_0.060`.
    pub lidar_variants: Vec<String>,
    /// True if there are 4D radar points.
    pub has_radar: bool,
    /// Numbers of the cameras that have images.
    pub cameras: Vec<u8>,
    /// Layout of this scenario's files.
    pub layout: Layout,
    /// Handedness of the axes of the recording.
    pub source_handedness: Handedness,
    /// Lists of files that were joined, and by which property: clouds with poses, scans with times.
    pub joins: Vec<String>,
    /// Agents whose recorded speed, and whose yaw rate, contradicts their recorded poses: it is not used.
    contradicted: [BTreeSet<CavId>; 2],
    /// Pairs of agent and tick, by their indices, that have no frame.
    absent_at: Arc<HashSet<(usize, usize)>>,
    /// Capture times at which any agent has a frame, in order; none if they are the ticks.
    moments: Option<Arc<Vec<Tick>>>,
    source: Arc<dyn FrameSource>,
}

/// Options of reading a frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LoadOptions {
    /// A variant of [`Scenario::lidar_variants`] in place of the plain sweep.
    pub lidar_variant: Option<String>,
    /// True to read the LiDAR's points. If false, only poses and objects are read.
    pub points: bool,
    /// True to read the radar's points.
    pub radar: bool,
    /// True to read the images of the cameras.
    pub cameras: bool,
}

impl Default for LoadOptions {
    fn default() -> Self {
        Self {
            points: true,
            ..Self::without_points()
        }
    }
}

impl LoadOptions {
    /// Poses, motion and objects only.
    pub const fn without_points() -> Self {
        Self {
            lidar_variant: None,
            points: false,
            radar: false,
            cameras: false,
        }
    }
}

/// Reader of a layout's frames, in the conventions of [`protocol`].
trait FrameSource: std::fmt::Debug + Send + Sync {
    /// Reads a frame without its points.
    fn frame(&self, agent: &CavId, tick: &Tick) -> Result<Frame>;

    /// Reads the LiDAR's points, the plain sweep or a variant.
    fn points(&self, agent: &CavId, tick: &Tick, variant: Option<&str>) -> Result<PcdCloud>;

    /// Reads the radar's points. Called only for scenarios that have them.
    fn radar(&self, agent: &CavId, tick: &Tick) -> Result<PcdCloud> {
        let path = self.points_path(agent, tick, None);
        let reason = "there are no radar points beside it";
        Err(ReadError::malformed(&path, reason))
    }

    /// Adds the images of some cameras, by number, to a frame; those that are missing or unreadable are named.
    fn cameras(&self, _agent: &CavId, _tick: &Tick, _numbers: &[u8], _frame: &mut Frame) {}

    /// The files that all frames of an agent are read from: tables, poses, times, and the sweeps that determine how the
    /// others are read. A change of any file of a frame is a change of the data ([`content_sha256`]).
    fn shared_files(&self, agent: &CavId) -> Vec<PathBuf>;

    /// The files with pose, objects and calibration of one frame, in layouts that have such.
    fn frame_files(&self, _agent: &CavId, _tick: &Tick) -> Vec<PathBuf> {
        Vec::new()
    }

    /// The file with the LiDAR's points.
    fn points_path(&self, agent: &CavId, tick: &Tick, variant: Option<&str>) -> PathBuf;
}

impl Scenario {
    /// Vehicles and roadside units with a LiDAR each, present at every tick.
    fn new(
        name: String,
        layout: Layout,
        agents: Vec<CavId>,
        ticks: Vec<Tick>,
        source: Arc<dyn FrameSource>,
    ) -> Self {
        let units = agents.iter().filter(|id| id.as_str().starts_with('-'));
        Self {
            name,
            roadside_units: units.cloned().collect(),
            agents,
            ticks,
            missing: Vec::new(),
            lidar_variants: Vec::new(),
            has_radar: false,
            cameras: Vec::new(),
            layout,
            source_handedness: Handedness::Right,
            joins: Vec::new(),
            contradicted: [BTreeSet::new(), BTreeSet::new()],
            absent_at: Arc::default(),
            moments: None,
            source,
        }
    }

    /// Reads the frame of an agent at a tick, by their indices in [`Self::agents`] and [`Self::ticks`].
    ///
    /// # Errors
    /// [`ReadError`] if there is no such agent, tick or variant, if a file is missing or malformed, and if no point of the
    /// sweep is in range.
    pub fn load(
        &self,
        agent_index: usize,
        tick_index: usize,
        options: &LoadOptions,
    ) -> Result<Frame> {
        let (agent, tick) = self.frame_of(agent_index, tick_index)?;
        let mut frame = self.source.frame(agent, tick)?;
        let [speed, yaw_rate] = self.contradicted.each_ref().map(|of| of.contains(agent));
        frame.speed_mps = frame.speed_mps.filter(|_| !speed);
        frame.yaw_rate_rad_s = frame.yaw_rate_rad_s.filter(|_| !yaw_rate);
        if options.points {
            let variant = options.lidar_variant.as_deref();
            let cloud = self.load_points(agent_index, tick_index, variant)?;
            if let Some(reason) = cloud.without_returns() {
                let path = self.source.points_path(agent, tick, variant);
                return Err(ReadError::malformed(&path, reason));
            }
            (frame.points, frame.dropped_points) = (cloud.points, cloud.dropped);
        }
        if options.radar && self.has_radar {
            frame.radar = Some(self.load_radar(agent_index, tick_index)?.points);
        }
        if options.cameras && !self.cameras.is_empty() {
            self.source.cameras(agent, tick, &self.cameras, &mut frame);
        }
        Ok(frame)
    }

    /// Reads the radar's points alone.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn load_radar(&self, agent_index: usize, tick_index: usize) -> Result<PcdCloud> {
        let (agent, tick) = self.frame_of(agent_index, tick_index)?;
        self.source.radar(agent, tick)
    }

    /// Reads the LiDAR's points alone: the plain sweep, or a variant of [`Self::lidar_variants`].
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn load_points(
        &self,
        agent_index: usize,
        tick_index: usize,
        variant: Option<&str>,
    ) -> Result<PcdCloud> {
        let (agent, tick) = self.frame_of(agent_index, tick_index)?;
        if let Some(asked) = variant
            && !self.lidar_variants.iter().any(|known| known == asked)
        {
            let available = format_args!("{:?}", self.lidar_variants);
            return Err(self.no_such("LiDAR variant", asked, available));
        }
        self.source.points(agent, tick, variant)
    }

    /// The file with a frame's LiDAR points.
    ///
    /// # Errors
    /// [`ReadError::NoSuch`] if there is no such agent or tick.
    pub fn points_path(
        &self,
        agent_index: usize,
        tick_index: usize,
        variant: Option<&str>,
    ) -> Result<PathBuf> {
        let (agent, tick) = self.frame_of(agent_index, tick_index)?;
        Ok(self.source.points_path(agent, tick, variant))
    }

    /// Stem of a tick; empty if there is none.
    fn stem(&self, tick_index: usize) -> &str {
        let tick = self.ticks.get(tick_index);
        tick.map_or("", |tick| tick.stem.as_str())
    }

    fn frame_of(&self, agent_index: usize, tick_index: usize) -> Result<(&CavId, &Tick)> {
        let agent = self.agents.get(agent_index);
        let agent = agent.ok_or_else(|| self.out_of("agent", agent_index, self.agents.len()))?;
        let tick = self.ticks.get(tick_index);
        let tick = tick.ok_or_else(|| self.out_of("tick", tick_index, self.ticks.len()))?;
        if !self.is_present(agent_index, tick_index) {
            let (scenario, tick) = (&self.name, &tick.stem);
            let missing = format!("scenario {scenario}: agent {agent} has no frame at tick {tick}");
            return Err(ReadError::Absent(missing));
        }
        Ok((agent, tick))
    }

    fn out_of(&self, what: &str, index: usize, count: usize) -> ReadError {
        self.no_such(what, index, format_args!("{count}, counted from 0"))
    }

    fn no_such(&self, what: &str, asked: impl Display, available: impl Display) -> ReadError {
        let scenario = &self.name;
        let asked = format!("{what} {asked} does not exist (there are {available})");
        ReadError::NoSuch(format!("scenario {scenario}: {asked}"))
    }
}

/// Id of the vehicle in a layout that does not name it.
fn single_vehicle_id() -> CavId {
    CavId::new("0").expect("a digit is an identifier")
}

/// A scenario of a layout with one unnamed vehicle. Its folder gives it its name when it is opened ([`open()`]).
fn single_vehicle(layout: Layout, ticks: Vec<Tick>, source: Arc<dyn FrameSource>) -> Scenario {
    let agents = vec![single_vehicle_id()];
    Scenario::new(String::new(), layout, agents, ticks, source)
}
