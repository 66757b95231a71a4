//! KITTI odometry: sequences of scans with poses of the left camera.
//!
//! A sequence is a folder with `velodyne/<scan>.bin` and `calib.txt`; its poses are in `poses.txt` or
//! `poses_cam0.txt` beside these, or in the release's `poses/<sequence>.txt`. The line of the poses is the scan's
//! number. The pose of the LiDAR is `inverse(Tr) * P * Tr`, in the frame of the first scan's LiDAR.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use protocol::{CavId, Handedness, Pose};

use super::kitti_text::{self, Calibration};
use super::points::{SweepStorage, Sweeps};
use super::{FrameSource, Layout, OpenOptions, ReadError, Scenario, Tick, files, single_vehicle};
use crate::frame::Frame;
use crate::pcd::PcdCloud;

/// A sequence.
#[derive(Debug)]
struct Sequence {
    dir: PathBuf,
    /// Poses of the LiDAR by scan number; `None` where the sequence has no poses.
    world_from_lidar: Option<Vec<Pose>>,
    sweeps: Sweeps,
}

/// Whether a folder is a sequence.
pub(super) fn is_sequence(dir: &Path) -> bool {
    dir.join("velodyne").is_dir() && dir.join("calib.txt").is_file()
}

/// Opens a sequence.
pub(super) fn open(root: &Path, dir: &Path, options: &OpenOptions) -> Result<Scenario, ReadError> {
    let velodyne = dir.join("velodyne");
    let listing = files::list(&velodyne)?;
    let times = times(dir)?;
    let mut ticks = Vec::new();
    for stem in files::stems(&listing.files, ".bin") {
        let scan = scan_number(&velodyne, stem)?;
        let capture_nanos = match &times {
            Some(times) => *times.get(scan).ok_or_else(|| no_line(&dir.join("times.txt"), scan, times.len()))?,
            None => options.period_nanos.saturating_mul(scan as u64),
        };
        ticks.push(Tick { stem: stem.to_owned(), capture_nanos });
    }
    ticks.sort_by_key(|tick| tick.capture_nanos);
    let files = ticks.iter().map(|tick| velodyne.join(format!("{}.bin", tick.stem)));
    let sweeps = Sweeps::of_single_vehicle(SweepStorage::ByName, files, options);
    let source = Sequence { dir: dir.to_owned(), world_from_lidar: poses(dir)?, sweeps };
    Ok(single_vehicle(files::name_below(root, dir), Layout::KittiOdometry, ticks, Arc::new(source)))
}

impl FrameSource for Sequence {
    fn frame(&self, agent: &CavId, tick: &Tick) -> Result<Frame, ReadError> {
        let mut frame = Frame::empty(agent.clone(), tick.capture_nanos, Handedness::Right);
        if let Some(poses) = &self.world_from_lidar {
            let scan = scan_number(&self.dir.join("velodyne"), &tick.stem)?;
            let pose = poses
                .get(scan)
                .ok_or_else(|| no_line(&poses_path(&self.dir).unwrap_or_default(), scan, poses.len()))?;
            frame.world_from_lidar = Some(*pose);
        }
        Ok(frame)
    }

    fn points(&self, agent: &CavId, tick: &Tick, variant: Option<&str>) -> Result<PcdCloud, ReadError> {
        self.sweeps.read(agent, &self.points_path(agent, tick, variant))
    }

    fn points_path(&self, _agent: &CavId, tick: &Tick, _variant: Option<&str>) -> PathBuf {
        self.dir.join("velodyne").join(format!("{}.bin", tick.stem))
    }
}

fn scan_number(velodyne: &Path, stem: &str) -> Result<usize, ReadError> {
    let path = velodyne.join(format!("{stem}.bin"));
    stem.parse().map_err(|_| ReadError::malformed(&path, format!("{stem:?} is no scan number")))
}

fn no_line(path: &Path, scan: usize, lines: usize) -> ReadError {
    ReadError::malformed(path, format!("no line for scan {scan}: there are {lines}"))
}

/// Where the sequence's poses are: beside the scans, or in the release's common folder.
fn poses_path(dir: &Path) -> Option<PathBuf> {
    let beside = ["poses.txt", "poses_cam0.txt"].map(|name| dir.join(name)).into_iter().find(|path| path.is_file());
    let common = |dir: PathBuf| {
        let name = dir.file_name()?.to_str()?;
        Some(dir.parent()?.parent()?.join("poses").join(format!("{name}.txt"))).filter(|path| path.is_file())
    };
    beside.or_else(|| files::names_of(dir).find_map(common))
}

fn poses(dir: &Path) -> Result<Option<Vec<Pose>>, ReadError> {
    let Some(path) = poses_path(dir) else { return Ok(None) };
    let camera_from_lidar = Calibration::read(&dir.join("calib.txt"))?.transform("Tr")?.isometry();
    let lidar_from_camera = camera_from_lidar.inverse();
    let poses = kitti_text::lines(&path)?.into_iter().map(|(line, text)| {
        let rows = kitti_text::numbers::<12>(&path, line, None, &text)?;
        let world_from_camera = kitti_text::rigid(&path, line, None, &rows)?.isometry();
        Ok((lidar_from_camera * world_from_camera * camera_from_lidar).into())
    });
    poses.collect::<Result<_, _>>().map(Some)
}

/// `times.txt`, seconds from the first scan, one per line.
fn times(dir: &Path) -> Result<Option<Vec<u64>>, ReadError> {
    let path = dir.join("times.txt");
    if !path.is_file() {
        return Ok(None);
    }
    let times = kitti_text::lines(&path)?.into_iter().map(|(line, text)| {
        let [seconds] = kitti_text::numbers(&path, line, None, &text)?;
        if !(0.0..=1e9).contains(&seconds) {
            return Err(kitti_text::malformed(&path, line, None, format!("{seconds} s, expected 0 to 1e9")));
        }
        Ok((seconds * 1e9).round() as u64)
    });
    times.collect::<Result<_, _>>().map(Some)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::dataset::{self, LoadOptions};

    /// The camera looks along x of the LiDAR: x right, y down, z forward.
    const TR: &str = "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n";

    fn build(root: &Path, name: &str, poses_at: &str, poses: &str) {
        let dir = root.join(name);
        fs::create_dir_all(dir.join("velodyne")).unwrap();
        fs::write(dir.join("calib.txt"), TR).unwrap();
        for scan in 0..2u8 {
            let point: Vec<u8> =
                [f32::from(scan), 2.0, 3.0, 0.5].iter().flat_map(|value| value.to_le_bytes()).collect();
            fs::write(dir.join(format!("velodyne/{scan:06}.bin")), point).unwrap();
        }
        let poses_at = root.join(poses_at);
        fs::create_dir_all(poses_at.parent().unwrap()).unwrap();
        fs::write(poses_at, poses).unwrap();
    }

    #[test]
    fn camera_poses_become_lidar_poses() {
        let dir = tempfile::tempdir().unwrap();
        // The second pose: 2 m ahead (camera z) and 1 m to the right (camera x).
        let poses = "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 1 0 1 0 0 0 0 1 2\n";
        build(dir.path(), "sequences/07", "poses/07.txt", poses);
        let dataset = dataset::open(dir.path()).unwrap();
        let scenario = &dataset.scenarios[0];
        assert_eq!((dataset.layout, scenario.name.as_str()), (Layout::KittiOdometry, "sequences/07"));
        let frame = scenario.load(0, 1, &LoadOptions::default()).unwrap();
        let moved = frame.world_from_lidar.unwrap().translation_m;
        assert!((moved[0] - 2.0).abs() < 1e-9 && (moved[1] + 1.0).abs() < 1e-9 && moved[2].abs() < 1e-9, "{moved:?}");
        assert_eq!((frame.points.xyzi, frame.capture_nanos), (vec![[1.0, 2.0, 3.0, 0.5]], 100_000_000));
    }

    #[test]
    fn poses_above_are_found_by_whatever_name_the_folder_has() {
        let dir = tempfile::tempdir().unwrap();
        build(dir.path(), "sequences/07", "poses/07.txt", &"1 0 0 0 0 1 0 0 0 0 1 0\n".repeat(2));
        let sequence = dir.path().join("sequences/07");
        for name in [sequence.clone(), sequence.join("velodyne/..")] {
            let dataset = dataset::open(&name).unwrap();
            assert_eq!(dataset.scenarios[0].name, "07");
            let frame = dataset.scenarios[0].load(0, 0, &LoadOptions::default()).unwrap();
            assert!(frame.world_from_lidar.is_some(), "{}", name.display());
        }
    }

    #[test]
    fn times_and_missing_lines() {
        let dir = tempfile::tempdir().unwrap();
        build(dir.path(), ".", "poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n");
        fs::write(dir.path().join("times.txt"), "0.0\n1.036e-01\n").unwrap();
        let dataset = dataset::open(dir.path()).unwrap();
        assert_eq!(dataset.scenarios[0].ticks[1].capture_nanos, 103_600_000);
        let error = dataset.scenarios[0].load(0, 1, &LoadOptions::default()).unwrap_err();
        assert!(error.to_string().ends_with("poses.txt: no line for scan 1: there are 1"), "{error}");
    }

    #[test]
    fn a_bad_pose_names_its_line() {
        let dir = tempfile::tempdir().unwrap();
        build(dir.path(), ".", "poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 -1 0\n");
        let error = dataset::open(dir.path()).unwrap_err();
        assert_eq!(error.line(), Some(2), "{error}");
    }
}
