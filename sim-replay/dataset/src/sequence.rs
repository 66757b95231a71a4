//! Sequences of a single vehicle: a file per sweep, and the pose of its LiDAR where that is known.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;

use protocol::{CavId, Handedness, Pose};

use super::faults::Faults;
use super::points::{SweepStorage, Sweeps};
use super::{
    FrameSource, Layout, OpenOptions, ReadError, Result, Scenario, Tick, files, single_vehicle,
};
use crate::frame::Frame;
use crate::pcd::PcdCloud;

/// Sweeps and poses of a sequence.
#[derive(Debug)]
struct SequenceSource {
    /// File and `world_from_lidar` by the stem of the tick.
    clouds: HashMap<String, (PathBuf, Option<Pose>)>,
    sweeps: Sweeps,
    /// Files of poses, times and calibration, whether or not they exist.
    shared_files: Vec<PathBuf>,
    /// True for the recordings of [`super::localization`]: their points are turned by half a turn about x.
    is_z_down: bool,
}

/// The scenario of `clouds` in order of time, each with its file and `world_from_lidar`. What neither names nor sweeps
/// hold comes from `shared_files`.
pub(super) fn scenario(
    layout: Layout,
    clouds: Vec<(Tick, PathBuf, Option<Pose>)>,
    storage: SweepStorage,
    shared_files: Vec<PathBuf>,
    options: &OpenOptions,
) -> Scenario {
    let files = clouds.iter().map(|(_, file, _)| file.clone());
    let sweeps = Sweeps::of_single_vehicle(storage, files, options);
    let ticks = clouds.iter().map(|(tick, ..)| tick.clone()).collect();
    let clouds = clouds
        .into_iter()
        .map(|(tick, file, pose)| (tick.stem, (file, pose)));
    let source = SequenceSource {
        clouds: clouds.collect(),
        sweeps,
        shared_files,
        is_z_down: [Layout::NCLT, Layout::OXFORD].contains(&layout),
    };
    single_vehicle(layout, ticks, Arc::new(source))
}

/// Number and stem of the `.bin` files of a folder, in order; `what` is the meaning of their numbers. Files of other names
/// are left out, and further ones of one number.
pub(super) fn numbered<T: FromStr + Ord>(
    dir: &Path,
    what: &str,
    problems: &mut Vec<ReadError>,
) -> Result<Vec<(T, String)>> {
    let mut strays = Faults::default();
    let listing = files::list(dir)?;
    let wrong = |stem: &str, reason| ReadError::malformed(&dir.join(format!("{stem}.bin")), reason);
    let sweeps = files::stems(&listing.files, ".bin").filter_map(|stem| {
        let number = stem.parse::<T>();
        let number = number.map_err(|_| wrong(stem, format!("{stem:?} is no {what}")));
        Some((strays.take(number)?, stem.to_owned()))
    });
    let mut sweeps: Vec<(T, String)> = sweeps.collect();
    // Of one number, the name with zeros in front comes first.
    sweeps.sort_unstable();
    sweeps.dedup_by(|(number, stem), (before, kept)| {
        if number == before {
            strays.push(wrong(stem, format!("it has the {what} of {kept}.bin")));
        }
        number == before
    });
    strays.report("file", problems);
    Ok(sweeps)
}

/// Values that a file gives for all scans; if it cannot be read, a problem and nothing.
pub(super) fn or_without<T>(
    what: &str,
    read: Result<Option<T>>,
    problems: &mut Vec<ReadError>,
) -> Option<T> {
    read.unwrap_or_else(|error| {
        problems.push(error.with_consequence(&format!("the sequence is read without {what}")));
        None
    })
}

impl FrameSource for SequenceSource {
    fn frame(&self, agent: &CavId, tick: &Tick) -> Result<Frame> {
        let mut frame = Frame::empty(agent.clone(), tick.capture_nanos, Handedness::Right);
        frame.world_from_lidar = self.clouds.get(&tick.stem).and_then(|(_, pose)| *pose);
        Ok(frame)
    }

    fn points(&self, agent: &CavId, tick: &Tick, variant: Option<&str>) -> Result<PcdCloud> {
        let path = self.points_path(agent, tick, variant);
        let mut cloud = self.sweeps.read(agent, &path)?;
        if self.is_z_down {
            for [_, y, z, _] in &mut cloud.points.xyzi {
                // The half turn, `diag(1, -1, -1)`.
                (*y, *z) = (-*y, -*z);
            }
        }
        Ok(cloud)
    }

    fn shared_files(&self, agent: &CavId) -> Vec<PathBuf> {
        self.sweeps.samples(agent, self.shared_files.clone())
    }

    fn points_path(&self, _agent: &CavId, tick: &Tick, _variant: Option<&str>) -> PathBuf {
        let cloud = self.clouds.get(&tick.stem);
        cloud.map(|(file, _)| file.clone()).unwrap_or_default()
    }
}
