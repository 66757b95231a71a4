//! Sweeps with true poses, kept in memory: centimetres as 16-bit integers, a third of a megabyte each.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::{Arc, Mutex};

use dataset::frame::Frame;
use dataset::{self, IntensityScale, LoadOptions, Scenario, findings, reasons};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rand::Rng;

use crate::Error;
use crate::sweep_database::present_sweeps;
use localization::pgc::{SceneEncoderConfig, SweepVoxels};
use perception::train::{DataListing, Prefetch};
use support::file_digests::FileDigests;
use support::sync::lock;

/// Unit of stored coordinates, metres.
const UNIT_M: f32 = 0.01;

/// One sweep.
#[derive(Debug, Clone)]
pub(crate) struct StoredSweep {
    /// World that it was recorded in: index of its folder on the command line.
    pub world: usize,
    /// Index of its drive.
    pub drive: usize,
    /// True pose.
    pub world_from_sensor: Isometry3<f64>,
    /// x, y, z in [`UNIT_M`].
    points: Vec<[i16; 3]>,
}

impl StoredSweep {
    /// The voxels of the same sweep for a sensor in another orientation, `turned_from_sensor`; each point is kept with
    /// a probability.
    pub(crate) fn turned_voxels(
        &self,
        turned_from_sensor: &Isometry3<f64>,
        keep: f64,
        rng: &mut impl Rng,
        config: &SceneEncoderConfig,
    ) -> SweepVoxels {
        let turn: Isometry3<f32> = turned_from_sensor.cast();
        // 32 decisions from one draw of the generator would be faster still; this does not dominate the time.
        let points = self.points.iter();
        let kept = points.filter(|_| keep >= 1.0 || rng.random_bool(keep));
        let turned = kept.map(|point| {
            let metres = point.map(|axis| f32::from(axis) * UNIT_M);
            (turn * nalgebra::Point3::from(metres)).into()
        });
        SweepVoxels::new(turned, config)
    }
}

/// Points of a sweep, `[N]` of x, y, z (metres, sensor frame) and intensity, and its true pose.
pub(super) type PosedSweep = (Vec<[f32; 4]>, Isometry3<f64>);

/// A rotation about the vertical.
pub(crate) fn yaw(angle_rad: f64) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle_rad);
    Isometry3::from_parts(Translation3::identity(), rotation)
}

/// Heading of a pose, radians.
pub(super) fn heading_rad(world_from_sensor: &Isometry3<f64>) -> f64 {
    let ahead = world_from_sensor.rotation * Vector3::x();
    ahead.y.atan2(ahead.x)
}

/// Mean position of sensors, metres, world frame.
pub(super) fn mean_position_m(world_from_sensor: &[Isometry3<f64>]) -> [f64; 3] {
    let positions = world_from_sensor.iter().map(|pose| pose.translation.vector);
    (positions.sum::<Vector3<f64>>() / world_from_sensor.len() as f64).into()
}

/// Paths of sweeps with true poses on disk. Each folder is one world: poses in different folders are unrelated.
#[derive(Debug, Default)]
pub(crate) struct SweepList {
    places: Vec<SweepPlace>,
    sha256: String,
    problems: Vec<String>,
    /// Indices of the sweeps without a pose among those read so far.
    without_pose: Mutex<BTreeSet<usize>>,
    /// Faults of the sweeps that could not be read so far, by index.
    unreadable: Mutex<BTreeMap<usize, String>>,
}

#[derive(Debug, Clone)]
struct SweepPlace {
    scenario: Arc<Scenario>,
    agent: usize,
    tick: usize,
    world: usize,
    drive: usize,
}

impl SweepList {
    /// Lists every sweep of every agent.
    ///
    /// # Errors
    /// [`Error`] when a folder cannot be read or holds no sweep.
    pub(crate) fn open(folders: &[PathBuf]) -> Result<Self, Error> {
        let (mut places, mut scenarios, mut problems) = (Vec::new(), Vec::new(), Vec::new());
        let mut drive = 0;
        for (world, folder) in folders.iter().enumerate() {
            let dataset = dataset::open(folder)?;
            let found = findings::sampled(&dataset.scenarios, IntensityScale::AUTO, None);
            findings::note(&found);
            problems.extend(dataset.problems.iter().map(ToString::to_string));
            for scenario in dataset.scenarios.into_iter().map(Arc::new) {
                places.extend(present_sweeps(&scenario).map(|(agent, tick)| SweepPlace {
                    scenario: Arc::clone(&scenario),
                    agent,
                    tick,
                    world,
                    drive: drive + agent,
                }));
                drive += scenario.agents.len();
                scenarios.push(scenario);
            }
        }
        if places.is_empty() {
            let reasons = reasons(&problems);
            return Err(Error::NoSweeps(folders.to_vec(), reasons));
        }
        let scenarios = scenarios.iter().map(AsRef::as_ref);
        let sha256 = dataset::content_sha256(scenarios, None, &FileDigests::default());
        Ok(Self {
            places,
            sha256,
            problems,
            ..Self::default()
        })
    }

    /// Identity of the data, and the part of it that proved unusable so far.
    pub(crate) fn data(&self) -> DataListing {
        let (without_pose, unreadable) = (lock(&self.without_pose), lock(&self.unreadable));
        let problems = self.problems.iter().chain(unreadable.values());
        DataListing {
            sha256: self.sha256.clone(),
            without_pose: without_pose.len(),
            problems: problems.cloned().collect(),
        }
    }

    /// The sweeps at some indices, as a list of their own, in the order given.
    pub(crate) fn subset(&self, indices: &[usize]) -> Self {
        let places = indices.iter().filter_map(|&index| self.places.get(index));
        Self {
            places: places.cloned().collect(),
            sha256: self.sha256.clone(),
            problems: self.problems.clone(),
            ..Self::default()
        }
    }

    /// Drive of each sweep, and its position without reading points, metres; `None` for a sweep without a pose.
    pub(crate) fn positions(&self) -> Vec<(usize, Option<Vector3<f64>>)> {
        let options = LoadOptions::without_points();
        let positions = self.places.iter().enumerate().map(|(index, place)| {
            let frame = self.load(index, place, &options);
            let pose = frame.and_then(|frame| frame.world_from_lidar);
            (place.drive, pose.map(|pose| pose.translation_m.into()))
        });
        positions.collect()
    }

    /// Reads the whole frame of a sweep, with the names of its scenario and its files; `None` if it cannot be read.
    pub(crate) fn frame(&self, index: usize) -> Option<(Frame, String, String)> {
        let place = self.places.get(index)?;
        let stem = place.scenario.ticks.get(place.tick)?.stem.clone();
        let frame = self.load(index, place, &LoadOptions::default())?;
        Some((frame, place.scenario.name.clone(), stem))
    }

    /// The frame of a sweep; one that cannot be read is noted.
    fn load(&self, index: usize, place: &SweepPlace, options: &LoadOptions) -> Option<Frame> {
        let loaded = place.scenario.load(place.agent, place.tick, options);
        let noted = loaded.inspect_err(|error| {
            lock(&self.unreadable).insert(index, error.to_string());
        });
        noted.ok()
    }

    /// Keeps at most `count` sweeps, evenly spread.
    pub(crate) fn thin_out(&mut self, count: usize) {
        let total = self.places.len();
        if total > count {
            let mut index = 0;
            // Sweep k of n stays if the running share passes an integer there.
            self.places.retain(|_| {
                index += 1;
                index * count / total > (index - 1) * count / total
            });
        }
    }

    /// Number of sweeps.
    pub(crate) fn len(&self) -> usize {
        self.places.len()
    }

    /// Reads one sweep, points within `range_m` of the sensor; `None` if its pose is unknown or it cannot be read, which
    /// is counted.
    pub(crate) fn read(&self, index: usize, range_m: f64) -> Option<StoredSweep> {
        let (points, world_from_sensor) = self.posed_sweep(index, range_m)?;
        let points = points.iter().map(|point| {
            // The cast saturates: coordinates beyond 327 m stay at the end of the range of i16.
            std::array::from_fn(|axis| (point[axis] / UNIT_M).round() as i16)
        });
        Some(StoredSweep {
            world: self.places[index].world,
            drive: self.places[index].drive,
            world_from_sensor,
            points: points.collect(),
        })
    }

    /// The same with the values of the file.
    pub(super) fn posed_sweep(&self, index: usize, range_m: f64) -> Option<PosedSweep> {
        let (frame, world_from_sensor) = self.posed_frame(index)?;
        let (mut points, range) = (frame.points.xyzi, range_m as f32);
        // A NaN in x or y fails the comparison and is left out too.
        points.retain(|[x, y, z, _]| x * x + y * y <= range * range && z.is_finite());
        Some((points, world_from_sensor))
    }

    /// Reads the whole frame of a sweep with the pose of its sensor; `None` if that is unknown or the frame cannot be
    /// read, which is counted.
    pub(crate) fn posed_frame(&self, index: usize) -> Option<(Frame, Isometry3<f64>)> {
        let (frame, ..) = self.frame(index)?;
        let Some(pose) = frame.world_from_lidar else {
            lock(&self.without_pose).insert(index);
            return None;
        };
        Some((frame, pose.isometry()))
    }

    /// Drive of a sweep.
    pub(crate) fn drive(&self, index: usize) -> Option<usize> {
        Some(self.places.get(index)?.drive)
    }
}

/// Sweeps of a list in memory, without those that cannot be read or have no pose.
#[derive(Debug)]
pub(crate) struct SweepStore {
    /// The sweeps, drive after drive.
    pub sweeps: Vec<StoredSweep>,
    /// Identity of the data.
    pub data: DataListing,
}

impl SweepStore {
    /// Reads every sweep that has a pose.
    ///
    /// # Errors
    /// [`Error`] when a folder cannot be read or holds no sweep with a pose.
    pub(crate) fn read(folders: &[PathBuf], range_m: f64) -> Result<Self, Error> {
        let list = Arc::new(SweepList::open(folders)?);
        let source = Arc::clone(&list);
        let threads = std::thread::available_parallelism().map_or(1, usize::from);
        let mut reader = Prefetch::start(threads, 0, move |number| {
            // The threads also ask for sweeps beyond the end: there are none.
            source.read(number as usize, range_m)
        });
        let mut sweeps = Vec::with_capacity(list.len());
        for _ in 0..list.len() {
            sweeps.extend(reader.next_batch()?);
        }
        let data = list.data();
        match sweeps.is_empty() {
            true => Err(Error::NoSweeps(folders.to_vec(), reasons(&data.problems))),
            false => Ok(Self { sweeps, data }),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::Path;

    use super::*;

    /// A KITTI sequence of two sweeps of one point each, with or without poses.
    fn sequence(folder: &Path, poses: &str) {
        fs::create_dir_all(folder.join("velodyne")).unwrap();
        for scan in ["000000", "000001"] {
            let point: Vec<u8> = [7.0f32, 1.0, 0.5, 0.1]
                .iter()
                .flat_map(|axis| axis.to_le_bytes())
                .collect();
            fs::write(folder.join("velodyne").join(format!("{scan}.bin")), point).unwrap();
        }
        fs::write(folder.join("calib.txt"), "Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n").unwrap();
        if !poses.is_empty() {
            fs::write(folder.join("poses.txt"), poses).unwrap();
        }
    }

    #[test]
    fn sweeps_without_a_pose_are_counted() {
        let folder = tempfile::tempdir().unwrap();
        let (known, unknown) = (folder.path().join("00"), folder.path().join("11"));
        sequence(&known, "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 2 0 1 0 0 0 0 1 0\n");
        sequence(&unknown, "");
        let store = SweepStore::read(&[known.clone(), unknown.clone()], 50.0).unwrap();
        assert_eq!((store.sweeps.len(), store.data.without_pose), (2, 2));
        assert_eq!(
            store.data.left_out().unwrap(),
            "2 sweeps without a pose left out"
        );
        let alone = SweepStore::read(&[known], 50.0).unwrap();
        assert_eq!((alone.sweeps.len(), alone.data.left_out()), (2, None));
        assert_ne!(alone.data.sha256, store.data.sha256);
        let error = SweepStore::read(&[unknown], 50.0).unwrap_err();
        assert!(matches!(error, Error::NoSweeps(..)), "{error}");
    }
}
