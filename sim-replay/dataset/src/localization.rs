//! Localization sequences: NCLT as recorded and as LightLoc converts it, Oxford and QEOxford.
//!
//! `<root>/<sequence>/velodyne_left/<microseconds>.bin` (or NCLT's original `velodyne_sync`), with poses in
//! `velodyne_left_False.h5` or, better aligned, QEOxford's `velodyne_left_calibrateFalse.h5`; if NCLT has neither, in
//! the dataset's own `groundtruth_<day>.csv`, taken at the time of the sweep. A file `<scene>_pose_stats.txt` above the
//! sequences holds the mean position of the training sequences, which LightLoc subtracts from all positions; so does
//! this reader if the file exists.
//!
//! NCLT's sweeps are in the frame of the robot's body, on the ground below the LiDAR, and so is its ground truth: seen
//! from (0.002, -0.004, -0.957) m, the position of the LiDAR in the dataset's documentation, each laser of a sweep
//! keeps its elevation to within 0.1 degrees; seen from the origin it does not.
//!
//! Sensor and world of these recordings have x forward, y right, z **down**: right-handed. LightLoc negates z of the
//! points alone, which is a mirror, and leaves the poses as they are. Here points and poses take the same half turn
//! about x, `C = diag(1, -1, -1)`: a point becomes `C p`, a pose `C M C`. It is a rotation, so distances, chirality and
//! the motion between scans are unchanged.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use protocol::Pose;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::faults::Faults;
use super::hdf5_poses::{self, RowOrder};
use super::keys::Keys;
use super::kitti_text::{lines, numbers};
use super::layout::{LayoutReader, LayoutRow};
use super::points::SweepStorage;
use super::{
    Layout, OpenOptions, ReadError, Result, Scenario, Tick, files, nclt_ground_truth, sequence,
};

/// Localization sequences of NCLT, as recorded or as converted by LightLoc.
pub(crate) static NCLT: LayoutRow = LayoutRow {
    key: "nclt",
    name: "NCLT localization sequences",
    data_sets: "NCLT, as published or as LightLoc converts it",
    files: "<day>/velodyne_sync/<microseconds>.bin, or <day>/velodyne_left/<microseconds>.bin in a folder named by a date \
            of 2012 or 2013",
    protocol: "opv2v",
    reader: Some(LayoutReader::Sequence(is_sequence, open)),
};

/// Localization sequences of Oxford and QEOxford, as converted by LightLoc.
pub(crate) static OXFORD: LayoutRow = LayoutRow {
    key: "oxford",
    name: "Oxford localization sequences",
    data_sets: "Oxford Radar RobotCar and QEOxford as LightLoc converts them",
    files: "<sequence>/velodyne_left/<microseconds>.bin",
    protocol: "opv2v",
    reader: None,
};

/// Converted points, one file per sweep.
const CONVERTED: &str = "velodyne_left";
/// NCLT's original points.
const RAW: &str = "velodyne_sync";

/// Poses in the axes of QEOxford, better aligned.
const ALIGNED_POSES: &str = "velodyne_left_calibrateFalse.h5";
/// Poses as LightLoc converts them.
const PLAIN_POSES: &str = "velodyne_left_False.h5";
/// The years of NCLT's days, with which the names of its sequences begin (`2012-01-22`).
const NCLT_YEARS: [&str; 2] = ["2012-", "2013-"];
/// LightLoc's names of the scenes.
const SCENES: [&str; 3] = ["NCLT", "Oxford", "QEOxford"];

/// True if a folder is a sequence.
fn is_sequence(dir: &Path) -> bool {
    let mut folders = [CONVERTED, RAW].iter();
    folders.any(|name| files::holds(&dir.join(name), ".bin"))
}

/// Opens a sequence. Sweeps without pose and poses without sweep are left out, the latter with a problem.
fn open(dir: &Path, options: &OpenOptions, problems: &mut Vec<ReadError>) -> Result<Scenario> {
    // Layout, storage and folder of the points.
    let name = files::own_name(dir);
    let is_nclt = dir.join(RAW).is_dir() || NCLT_YEARS.iter().any(|year| name.starts_with(year));
    let (layout, storage, points) = match (is_nclt, files::holds(&dir.join(CONVERTED), ".bin")) {
        (true, true) => (Layout::NCLT, SweepStorage::ByName, CONVERTED),
        (true, false) => (Layout::NCLT, SweepStorage::NcltRaw, RAW),
        (false, _) => (Layout::OXFORD, SweepStorage::Planar, CONVERTED),
    };
    let points_dir = dir.join(points);
    let stamps = sequence::numbered::<u64>(&points_dir, "time in microseconds", problems)?;
    let mut stamps: BTreeMap<u64, String> = stamps.into_iter().collect();
    let poses = poses(dir, storage, &stamps, problems);
    let poses = sequence::or_without("poses", poses, problems);
    let join = (poses.as_ref()).map(|poses| join(&points_dir, &mut stamps, poses, problems));
    let poses = poses.unwrap_or_default();
    let stems: Vec<&str> = stamps.values().map(String::as_str).collect();
    let times = match Keys::of_stems(&stems) {
        Keys::Times(nanos) => nanos,
        // Few digits: they count microseconds, as the layout states.
        _ => stamps.keys().map(|us| us.saturating_mul(1000)).collect(),
    };
    let clouds = stamps.into_iter().zip(times);
    let clouds = clouds.map(|((stamp, stem), nanos)| {
        let file = points_dir.join(format!("{stem}.bin"));
        // To the microsecond: doubles keep times to a quarter of one.
        let tick = Tick::new(stem, nanos.saturating_add(500) / 1000 * 1000);
        (tick, file, poses.get(&stamp).copied())
    });
    let (clouds, files) = (clouds.collect(), pose_files(dir));
    Ok(Scenario {
        joins: join.into_iter().collect(),
        ..sequence::scenario(layout, clouds, storage, files, options)
    })
}

/// Leaves out the sweeps without a pose, and says how many have one. Recordings begin before their poses and end after
/// them: only sweeps between two poses are a problem, and all if there is no pose.
fn join(
    points_dir: &Path,
    stamps: &mut BTreeMap<u64, String>,
    poses: &BTreeMap<u64, Pose>,
    problems: &mut Vec<ReadError>,
) -> String {
    for micros in poses.keys().filter(|micros| !stamps.contains_key(micros)) {
        let path = points_dir.join(format!("{micros}.bin"));
        let reason = "does not exist, but there is a pose for it: left out";
        problems.push(ReadError::malformed(&path, reason));
    }
    let (all, mut faults) = (stamps.len(), Faults::default());
    let span = poses.keys().next().zip(poses.keys().next_back());
    stamps.retain(|micros, stem| {
        let has_pose = poses.contains_key(micros);
        if !has_pose && span.is_none_or(|(first, last)| (first..=last).contains(&micros)) {
            let path = points_dir.join(format!("{stem}.bin"));
            faults.push(ReadError::malformed(&path, "no pose of its time"));
        }
        has_pose
    });
    faults.report("sweep", problems);
    let (count, without) = (stamps.len(), all - stamps.len());
    format!("{count} poses by time, {without} sweeps without pose")
}

/// The poses of the best available file, relative to the mean of the training sequences if that is known, turned to z
/// up.
fn poses(
    dir: &Path,
    storage: SweepStorage,
    stamps: &BTreeMap<u64, String>,
    problems: &mut Vec<ReadError>,
) -> Result<Option<BTreeMap<u64, Pose>>> {
    let is_nclt = storage != SweepStorage::Planar;
    let (aligned, plain) = (dir.join(ALIGNED_POSES), dir.join(PLAIN_POSES));
    let (scene, mut poses) = if aligned.is_file() {
        let poses = hdf5_poses::read(&aligned, RowOrder::RotationFirst, problems)?;
        ("QEOxford", poses)
    } else if plain.is_file() {
        let scene = if is_nclt { "NCLT" } else { "Oxford" };
        (scene, hdf5_poses::read(&plain, RowOrder::Matrix, problems)?)
    } else if is_nclt && let Some(path) = nclt_ground_truth::find(dir, &files::own_name(dir)) {
        let truth = nclt_ground_truth::read(&path, problems)?;
        let poses = (stamps.keys())
            .filter_map(|&micros| Some((micros, Pose::from(truth.at(micros).ok()?))));
        ("NCLT", poses.collect())
    } else {
        return Ok(None);
    };
    // The mean that LightLoc subtracts from all positions of a scene, in the axes of their file.
    let middle = middle_file(dir, scene).map(|path| first_row(&path));
    let middle = Translation3::from(middle.transpose()?.unwrap_or_default());
    // z down to z up: half a turn about x.
    let turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    let turn = Isometry3::from_parts(Vector3::zeros().into(), turn);
    for pose in poses.values_mut() {
        // The mean is in the axes of the file: it is subtracted before the turn.
        *pose = (turn * middle.inverse() * pose.isometry() * turn.inverse()).into();
    }
    Ok(Some(poses))
}

/// File of the mean position of a scene's training sequences.
fn middle_file(dir: &Path, scene: &str) -> Option<PathBuf> {
    let name = format!("{scene}_pose_stats.txt");
    let mut places = files::above(dir).map(|above| above.join(&name));
    places.find(|path| path.is_file())
}

/// Files that poses of a sequence may come from.
fn pose_files(dir: &Path) -> Vec<PathBuf> {
    let mut files = vec![dir.join(ALIGNED_POSES), dir.join(PLAIN_POSES)];
    files.extend(nclt_ground_truth::find(dir, &files::own_name(dir)));
    files.extend(SCENES.iter().filter_map(|scene| middle_file(dir, scene)));
    files
}

/// The mean of positions: LightLoc writes three numbers, one a line; SGLoc, LiSA, DiffLoc and others a row of three,
/// and their standard deviation as a second row.
fn first_row(path: &Path) -> Result<[f64; 3]> {
    let mut lines = lines(path)?;
    lines.retain(|(_, text)| !text.trim_start().starts_with('#'));
    let line = lines.first().map_or(1, |(line, _)| *line);
    let mut rows: Vec<String> = lines.into_iter().map(|(_, text)| text).collect();
    let mut counts = rows.iter().map(|row| row.split_ascii_whitespace().count());
    if rows.len() == 2 && counts.all(|count| count == 3) {
        rows.truncate(1);
    }
    numbers(path, line, None, &rows.join(" "))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::frame::Frame;
    use crate::{Dataset, LoadOptions};

    /// First time stamp.
    const T0: u64 = 1_547_120_000_000_000;

    fn write(root: &Path, name: &str, bytes: &[u8]) {
        let path = root.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
    }

    fn floats(values: &[f32]) -> Vec<u8> {
        values
            .iter()
            .flat_map(|value| value.to_le_bytes())
            .collect()
    }

    fn stamps() -> Vec<i64> {
        (0..12).map(|index| (T0 + 50_000 * index) as i64).collect()
    }

    /// Sensor and world with z down: at entry `i`, `i` metres ahead, 2 m to the right, 1 m below, turned 0.1 rad to
    /// the right.
    fn poses() -> Vec<[f64; 12]> {
        let (sin, cos) = 0.1f64.sin_cos();
        (0..12)
            .map(|i| {
                [
                    cos,
                    -sin,
                    0.0,
                    f64::from(i),
                    sin,
                    cos,
                    0.0,
                    2.0,
                    0.0,
                    0.0,
                    1.0,
                    1.0,
                ]
            })
            .collect()
    }

    fn open(root: &Path) -> Dataset {
        crate::open(root).unwrap()
    }

    #[test]
    fn oxford_points_and_poses_turn_together() {
        let dir = tempfile::tempdir().unwrap();
        let sequence = "Oxford/2019-01-11-14-02-26-radar-oxford-10k";
        write(
            dir.path(),
            &format!("{sequence}/velodyne_left_False.h5"),
            &hdf5_poses::tests::file(&stamps(), &poses()),
        );
        for index in [5, 6] {
            // All x, all y, all z, all intensities; z points down.
            let points = floats(&[10.0, 20.0, 1.0, 2.0, 1.5, -3.0, 51.0, 255.0]);
            write(
                dir.path(),
                &format!("{sequence}/velodyne_left/{}.bin", T0 + 50_000 * index),
                &points,
            );
        }
        let dataset = open(dir.path());
        assert_eq!(
            (dataset.layout, dataset.problems.len()),
            (Layout::OXFORD, 0)
        );
        let scenario = &dataset.scenarios[0];
        assert_eq!(
            (scenario.name.as_str(), scenario.ticks.len()),
            (sequence, 2)
        );
        let frame = scenario.load(0, 0, &LoadOptions::default()).unwrap();
        assert_eq!(
            frame.points.xyzi,
            [[10.0, -1.0, -1.5, 0.2], [20.0, -2.0, 3.0, 1.0]]
        );
        assert_eq!(frame.capture_nanos, (T0 + 250_000) * 1000);
        let pose = frame.world_from_lidar.unwrap();
        let [x, y, z] = pose.translation_m;
        assert!(
            (x - 5.0).abs() < 1e-9 && (y + 2.0).abs() < 1e-9 && (z + 1.0).abs() < 1e-9,
            "{pose:?}"
        );
        assert!(
            (pose.yaw_rad() + 0.1).abs() < 1e-9,
            "to the right is negative"
        );
    }

    #[test]
    fn names_in_nanoseconds_are_times_too() {
        let dir = tempfile::tempdir().unwrap();
        for step in [0, 50_000_000] {
            let name = format!("sequence-01/velodyne_left/{}.bin", T0 * 1000 + step);
            write(dir.path(), &name, &floats(&[1.0; 4]));
        }
        let dataset = open(dir.path());
        let ticks = dataset.scenarios[0].ticks.iter();
        let times: Vec<u64> = ticks.map(|tick| tick.capture_nanos).collect();
        assert_eq!(times, [T0 * 1000, T0 * 1000 + 50_000_000]);
    }

    #[test]
    fn a_point_lands_where_the_recording_puts_it() {
        let dir = tempfile::tempdir().unwrap();
        let sequence = dir.path().join("2012-01-22");
        let (down, rows) = ([3.0f32, -4.0, 1.0], poses());
        write(
            &sequence,
            "velodyne_left_False.h5",
            &hdf5_poses::tests::file(&stamps(), &rows),
        );
        write(
            &sequence,
            &format!("velodyne_left/{}.bin", T0 + 250_000),
            &floats(&[down[0], down[1], down[2], 0.0]),
        );
        write(
            &sequence,
            &format!("velodyne_left/{}.bin", T0 + 300_000),
            &[],
        );
        let dataset = open(&sequence);
        assert_eq!(dataset.layout, Layout::NCLT);
        let frame = dataset.scenarios[0]
            .load(0, 0, &LoadOptions::default())
            .unwrap();
        let [x, y, z, _] = frame.points.xyzi[0].map(f64::from);
        let ours = frame.world_from_lidar.unwrap().isometry() * nalgebra::Point3::new(x, y, z);
        let theirs: [f64; 3] = std::array::from_fn(|line| {
            let row = &rows[5][4 * line..4 * line + 4];
            row[0] * f64::from(down[0])
                + row[1] * f64::from(down[1])
                + row[2] * f64::from(down[2])
                + row[3]
        });
        // The reference's world with its z turned up, and nothing mirrored.
        assert!((ours - nalgebra::Point3::new(theirs[0], -theirs[1], -theirs[2])).norm() < 1e-6);
    }

    #[test]
    fn a_better_file_wins() {
        let dir = tempfile::tempdir().unwrap();
        let sequence = dir.path().join("2019-01-14-12-05-52-radar-oxford-10k");
        write(&sequence, "velodyne_left_False.h5", b"not looked at");
        let rotation_first = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 7.0, 8.0, 9.0];
        let poses = hdf5_poses::tests::file(&stamps(), &[rotation_first; 12]);
        write(&sequence, "velodyne_left_calibrateFalse.h5", &poses);
        write(
            &sequence,
            &format!("velodyne_left/{}.bin", T0 + 250_000),
            &floats(&[1.0; 4]),
        );
        let frame = open(&sequence).scenarios[0]
            .load(0, 0, &LoadOptions::default())
            .unwrap();
        assert_eq!(
            frame.world_from_lidar.unwrap().translation_m,
            [7.0, -8.0, -9.0]
        );
    }

    fn load_only_tick(root: &Path) -> Frame {
        let dataset = open(root);
        assert_eq!(
            (dataset.problems.len(), dataset.scenarios[0].ticks.len()),
            (0, 1),
            "one sweep has no pose"
        );
        dataset.scenarios[0]
            .load(0, 0, &LoadOptions::default())
            .unwrap()
    }

    #[test]
    fn raw_nclt_takes_its_poses_from_the_ground_truth() {
        let dir = tempfile::tempdir().unwrap();
        let stamp = 1_326_652_795_280_148u64;
        for micros in [stamp - 60_000_000, stamp] {
            let name = format!("2012-01-15/velodyne_sync/{micros}.bin");
            write(dir.path(), &name, &[0x20, 0x4e, 0x20, 0x4e, 0, 0, 51, 3]);
        }
        // 2 m north and 1 m east of where it was, facing east; half the way at the time of the sweep.
        let turn = std::f64::consts::FRAC_PI_2;
        let rows = format!(
            "{},0,0,-3,0,0,{turn}\n{},2,1,-3,0,0,{turn}\n",
            stamp - 5_000,
            stamp + 5_000
        );
        write(
            dir.path(),
            "ground_truth/groundtruth_2012-01-15.csv",
            rows.as_bytes(),
        );
        let pose = load_only_tick(dir.path()).world_from_lidar.unwrap();
        let [x, y, z] = pose.translation_m;
        assert!(
            (x - 1.0).abs() < 1e-9 && (y + 0.5).abs() < 1e-9 && (z - 3.0).abs() < 1e-9,
            "{pose:?}"
        );
        assert!(
            (pose.yaw_rad() + turn).abs() < 1e-9,
            "east is to the right of north"
        );
        // LightLoc's positions are relative to the mean of the training sequences.
        write(
            dir.path(),
            "NCLT_pose_stats.txt",
            b"100.0\n-50.0000000\n-4.0\n",
        );
        let moved = load_only_tick(dir.path()).world_from_lidar.unwrap();
        let [x, y, z] = moved.translation_m;
        assert!(
            (x + 99.0).abs() < 1e-9 && (y + 50.5).abs() < 1e-9 && (z + 1.0).abs() < 1e-9,
            "{x} {y} {z}"
        );
        // The files above the folder do not depend on the path by which it is opened.
        let same = open(&dir.path().join("2012-01-15/velodyne_sync/.."));
        assert_eq!(
            same.scenarios[0]
                .load(0, 0, &LoadOptions::default())
                .unwrap()
                .world_from_lidar,
            Some(moved)
        );
        // Other tools write a row of three, and their deviation below it.
        for rows in [
            "100.0 -50.0 -4.0\n",
            "100.0 -50.0 -4.0\n3 4 5\n",
            "# mean, deviation\n100 -50 -4\n3 4 nan\n",
        ] {
            write(dir.path(), "NCLT_pose_stats.txt", rows.as_bytes());
            let frame = load_only_tick(dir.path());
            assert_eq!(frame.world_from_lidar, Some(moved), "{rows}");
        }
        for (rows, expected) in [
            (
                "100.0\n-50.0000000\n",
                "NCLT_pose_stats.txt:1: 2 numbers, expected 3",
            ),
            (
                "1 2 3\n4 5 6\n7 8 9\n",
                "NCLT_pose_stats.txt:1: 9 numbers, expected 3",
            ),
            (
                "1 2 nan\n4 5 6\n",
                "NCLT_pose_stats.txt:1: \"nan\" is no finite number",
            ),
        ] {
            write(dir.path(), "NCLT_pose_stats.txt", rows.as_bytes());
            let dataset = open(dir.path());
            let message = dataset.problems[0].to_string();
            assert!(
                message.contains(expected)
                    && message.ends_with("the sequence is read without poses"),
                "{message}"
            );
            let frame = dataset.scenarios[0]
                .load(0, 0, &LoadOptions::default())
                .unwrap();
            assert_eq!(frame.world_from_lidar, None, "not counted from elsewhere");
        }
    }

    #[test]
    fn a_sweep_without_pose_between_two_poses_is_a_problem() {
        let dir = tempfile::tempdir().unwrap();
        let (stamp, mut rows) = (1_326_652_795_280_148_u64, String::new());
        // The last sweep is after the last pose, as in all recordings.
        for (seconds, has_pose) in [(0, true), (2, false), (4, true), (9, false)] {
            let micros = stamp + 1_000_000 * seconds;
            let name = format!("2012-01-15/velodyne_sync/{micros}.bin");
            write(dir.path(), &name, &[0x20, 0x4e, 0x20, 0x4e, 0, 0, 51, 3]);
            if has_pose {
                rows += &format!("{micros},0,0,-3,0,0,0\n");
            }
        }
        let truth = "ground_truth/groundtruth_2012-01-15.csv";
        write(dir.path(), truth, rows.as_bytes());
        let dataset = open(dir.path());
        let join = "2 poses by time, 2 sweeps without pose";
        assert_eq!(dataset.scenarios[0].joins, [join]);
        let problem = dataset.problems[0].to_string();
        let expected = "/1326652797280148.bin: no pose of its time: the sweep is left out";
        assert!(problem.ends_with(expected), "{problem}");
        assert_eq!(dataset.problems.len(), 1);
    }

    #[test]
    fn nclt_is_known_by_the_year_in_the_name() {
        for (name, layout) in [
            ("2012-01-15_a", Layout::NCLT),
            ("2013-04-05", Layout::NCLT),
            ("2019-01-11", Layout::OXFORD),
            ("sequence_1", Layout::OXFORD),
        ] {
            let dir = tempfile::tempdir().unwrap();
            let sweep = format!("{name}/velodyne_left/{T0}.bin");
            write(dir.path(), &sweep, &floats(&[1.0; 4]));
            assert_eq!(open(dir.path()).layout, layout, "{name}");
        }
    }

    #[test]
    fn raw_nclt_has_no_poses_and_missing_sweeps_are_reported() {
        let dir = tempfile::tempdir().unwrap();
        write(
            dir.path(),
            "2012-01-15/velodyne_sync/1326652795280148.bin",
            &[0x20, 0x4e, 0x20, 0x4e, 0, 0, 51, 3],
        );
        let dataset = open(dir.path());
        let frame = dataset.scenarios[0]
            .load(0, 0, &LoadOptions::default())
            .unwrap();
        assert_eq!(
            (frame.world_from_lidar, frame.points.xyzi.as_slice()),
            (None, [[0.0, 0.0, 100.0, 0.2]].as_slice())
        );

        let sequence = dir.path().join("2012-01-22");
        write(
            &sequence,
            "velodyne_left_False.h5",
            &hdf5_poses::tests::file(&stamps(), &poses()),
        );
        write(
            &sequence,
            &format!("velodyne_left/{}.bin", T0 + 250_000),
            &[],
        );
        write(&sequence, "velodyne_left/readme.bin", &[]);
        let dataset = open(&sequence);
        assert_eq!(dataset.scenarios[0].ticks.len(), 1);
        let problems: Vec<String> = dataset.problems.iter().map(ToString::to_string).collect();
        assert!(
            problems[0].contains("is no time in microseconds")
                && problems[1].contains("but there is a pose for it")
        );
    }
}
