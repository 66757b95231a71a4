//! Bags of ROS 2 (rosbag2) that a robot recorded: sweeps of a LiDAR with odometry, poses or transforms.
//!
//! A bag is a folder with `metadata.yaml` and files of MCAP or SQLite, or a single file; whole files and single messages may
//! be compressed by zstd. Sweeps are `sensor_msgs/PointCloud2`. A pose comes from `nav_msgs/Odometry`,
//! `geometry_msgs/PoseStamped`, `geometry_msgs/PoseWithCovarianceStamped` or `tf2_msgs/TFMessage`, interpolated to the stamp
//! of the sweep, and is carried to the frame of the sweep by the transforms of the bag.

mod clock;
mod contents;
mod files;
mod join;
mod pose_source;
mod scan;
mod sqlite;
mod storage;
mod sweeps;
#[cfg(test)]
mod tests;
mod transforms;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

use protocol::{CavId, Handedness, Limits};
use ros2::read_point_cloud;

pub(super) use self::files::is_bag;

use self::contents::BagContents;
use self::join::{JoinedSweep, join};
use self::storage::Storage;
use super::layout::{LayoutReader, LayoutRow};
use super::points::{IntensityScale, Sweeps, divisor_of_first};
use super::{FrameSource, Layout, OpenOptions, ReadError, Result, Scenario, Tick, single_vehicle};
use crate::frame::Frame;
use crate::pcd::{IntensityOrigin, PcdCloud};

/// A bag of ROS 2.
pub(crate) static ROSBAG: LayoutRow = LayoutRow {
    key: "rosbag",
    name: "bag of ROS 2",
    data_sets: "drives of a robot of one's own",
    files: "a folder with metadata.yaml of rosbag2, or a file <name>.mcap or .db3 (.zstd): sensor_msgs/PointCloud2 with \
            nav_msgs/Odometry, tf2_msgs/TFMessage, geometry_msgs/PoseStamped or PoseWithCovarianceStamped",
    protocol: "opv2v",
    reader: Some(LayoutReader::Sequence(is_bag, open)),
};

/// Limits of a sweep: those of a file.
const LIMITS: Limits = Limits {
    max_points: 1 << 26,
    max_abs_value: f32::MAX,
    ..Limits::DEFAULT
};

/// Sweeps and poses of a bag.
#[derive(Debug)]
struct Bag {
    storage: Storage,
    /// The file that lists those of the storage, in order.
    description: Option<PathBuf>,
    /// By stamp.
    sweeps: BTreeMap<u64, JoinedSweep>,
    scale: IntensityScale,
    divisor: OnceLock<f32>,
}

fn open(path: &Path, options: &OpenOptions, problems: &mut Vec<ReadError>) -> Result<Scenario> {
    let files = files::files_of(path, problems)?;
    let mut contents = BagContents::of(path);
    let storage = Storage::open(&files, &mut contents, problems)?;
    contents.finish(problems);
    let (sweeps, text) = join(path, &contents, problems)?;
    let stamps = sweeps.keys();
    let ticks = stamps.map(|nanos| Tick::new(nanos.to_string(), *nanos));
    let ticks = ticks.collect();
    let source = Bag {
        storage,
        description: files::description(path),
        sweeps,
        scale: options.intensity_scale,
        divisor: OnceLock::new(),
    };
    Ok(Scenario {
        joins: vec![text],
        ..single_vehicle(Layout::ROSBAG, ticks, Arc::new(source))
    })
}

impl Bag {
    fn sweep(&self, tick: &Tick) -> Result<&JoinedSweep> {
        self.sweeps.get(&tick.capture_nanos).ok_or_else(|| {
            ReadError::malformed(Path::new(""), format!("no sweep at {}", tick.stem))
        })
    }

    /// The sweep of a stamp with the intensities as stored.
    fn read_stored(&self, nanos: u64, &(place, _): &JoinedSweep) -> Result<PcdCloud> {
        let bytes = self.storage.read(place)?;
        let read = read_point_cloud(&bytes, &LIMITS).map_err(|error| {
            let reason = format!("sweep {nanos}: {error}");
            ReadError::malformed(self.storage.path(place), reason)
        })?;
        Ok(PcdCloud {
            points: read.points,
            dropped: read.without_return + read.too_far,
            intensity: read
                .intensity
                .map(|(name, kind)| IntensityOrigin::stored(&name, kind)),
            form: "PointCloud2",
            ..PcdCloud::default()
        })
    }
}

impl FrameSource for Bag {
    fn frame(&self, agent: &CavId, tick: &Tick) -> Result<Frame> {
        let mut frame = Frame::empty(agent.clone(), tick.capture_nanos, Handedness::Right);
        (_, frame.world_from_lidar) = *self.sweep(tick)?;
        Ok(frame)
    }

    fn points(&self, agent: &CavId, tick: &Tick, _: Option<&str>) -> Result<PcdCloud> {
        let mut cloud = self.read_stored(tick.capture_nanos, self.sweep(tick)?)?;
        self.scale.apply(&mut cloud, || {
            *self.divisor.get_or_init(|| {
                let sweeps = self.sweeps.iter().take(Sweeps::MOST_TRIED);
                let clouds =
                    sweeps.filter_map(|(nanos, sweep)| self.read_stored(*nanos, sweep).ok());
                divisor_of_first(clouds, &self.points_path(agent, tick, None))
            })
        });
        Ok(cloud)
    }

    fn shared_files(&self, _: &CavId) -> Vec<PathBuf> {
        let mut files = self.storage.paths();
        files.extend(self.description.clone());
        files
    }

    fn points_path(&self, _: &CavId, tick: &Tick, _: Option<&str>) -> PathBuf {
        self.sweep(tick)
            .map(|(place, _)| self.storage.path(*place).to_owned())
            .unwrap_or_default()
    }
}
