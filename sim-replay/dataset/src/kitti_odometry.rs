//! KITTI odometry: sequences of scans with poses of the left camera.
//!
//! A sequence is a folder with `velodyne/<scan>.bin` and `calib.txt`; its poses are in `poses.txt` or
//! `poses_cam0.txt` beside these, or in the release's `poses/<sequence>.txt`. The line of the poses is the scan's
//! number. The pose of the LiDAR is `inverse(Tr) * P * Tr`, in the frame of the first scan's LiDAR.

use protocol::Pose;
use std::path::{Path, PathBuf};

use super::faults::Faults;
use super::kitti_text::{self, Calibration};
use super::layout::{LayoutReader, LayoutRow};
use super::points::SweepStorage;
use super::time_stamps::Unit;
use super::{Layout, OpenOptions, ReadError, Result, Scenario, Tick, files, sequence};

/// KITTI odometry.
pub(crate) static KITTI_ODOMETRY: LayoutRow = LayoutRow {
    key: "kitti_odometry",
    name: "KITTI odometry",
    data_sets: "KITTI odometry, SemanticKITTI",
    files: "velodyne/<scan>.bin and calib.txt (a file)",
    protocol: "opv2v",
    reader: Some(LayoutReader::Sequence(is_sequence, open)),
};

/// Least number of whole times from 0 on, one apart, that are numbers of scans.
const LEAST_COUNTED: usize = 3;

/// True for a folder with scans and a calibration file.
fn is_sequence(dir: &Path) -> bool {
    dir.join("calib.txt").is_file() && files::holds(&dir.join("velodyne"), ".bin")
}

/// Opens a sequence. Scans without time or pose are left out if others have them, and reported with their number.
fn open(dir: &Path, options: &OpenOptions, problems: &mut Vec<ReadError>) -> Result<Scenario> {
    let velodyne = dir.join("velodyne");
    let mut scans = sequence::numbered::<usize>(&velodyne, "scan number", problems)?;
    let times = sequence::or_without("times", times(dir, &scans, problems), problems);
    let poses = sequence::or_without("poses", poses(dir, &scans, problems), problems);
    keep_those_with(&mut scans, times.as_deref());
    keep_those_with(&mut scans, poses.as_deref());
    let (mut joins, count) = (Vec::new(), scans.len());
    for (is_joined, what) in [(poses.is_some(), "poses"), (times.is_some(), "times")] {
        let line = format!("{count} {what} by number: the line is that of the scan");
        joins.extend(is_joined.then_some(line));
    }
    let clouds = scans.into_iter().map(|(scan, stem)| {
        let capture_nanos = match &times {
            Some(times) => times.get(scan).copied().flatten().unwrap_or_default(),
            None => options.period_nanos.saturating_mul(scan as u64),
        };
        let file = velodyne.join(format!("{stem}.bin"));
        let pose = poses.as_ref().and_then(|poses| *poses.get(scan)?);
        (Tick::new(stem, capture_nanos), file, pose)
    });
    let (layout, storage) = (Layout::KITTI_ODOMETRY, SweepStorage::ByName);
    let files = ["calib.txt", "times.txt"].map(|name| dir.join(name));
    let files = files.into_iter().chain(poses_path(dir)).collect();
    Ok(Scenario {
        joins,
        ..sequence::scenario(layout, clouds.collect(), storage, files, options)
    })
}

/// One value for each line of a file, whose number from 0 is that of the scan. Lines that cannot be read or are missing
/// are reported, and lines beyond scans without a gap: scans of a part of a drive that were numbered anew look alike.
///
/// # Errors
/// [`ReadError`] if the file cannot be read, or has as many lines as there are scans, with other numbers.
fn of_lines<T>(
    path: &Path,
    scans: &[(usize, String)],
    problems: &mut Vec<ReadError>,
    read: impl Fn(u64, &str) -> Result<T>,
) -> Result<Vec<Option<T>>> {
    let mut faults = Faults::default();
    let rows = kitti_text::rows(path, &mut faults, read)?;
    let (lines, count) = (rows.len(), scans.len());
    let last = scans.last().map_or(0, |(scan, _)| *scan);
    // As many lines as scans, but other numbers: by number, scans would get the lines of others.
    if let Some((first, _)) = scans.first().filter(|_| lines == count && last >= lines) {
        let reason = format!(
            "as many lines as scans, but scans are numbered {first} to {last} and lines from 0: number the scans as the \
             lines"
        );
        return Err(ReadError::malformed(path, reason));
    }
    if lines > count && last < count {
        let reason = format!(
            "{lines} lines for {count} scans: those beyond the last scan are not used; if the scans were numbered anew, \
             they have the lines of others"
        );
        problems.push(ReadError::malformed(path, reason));
    }
    for (scan, _) in scans.iter().filter(|(scan, _)| *scan >= lines) {
        let reason = format!("no line for scan {scan}: there are {lines}");
        faults.push(ReadError::malformed(path, reason));
    }
    faults.report("scan", problems);
    Ok(rows)
}

/// Leaves out the scans without a value, which are already reported.
fn keep_those_with<T>(scans: &mut Vec<(usize, String)>, rows: Option<&[Option<T>]>) {
    let Some(rows) = rows else { return };
    scans.retain(|(scan, _)| rows.get(*scan).is_some_and(Option::is_some));
}

/// Path of the sequence's poses: beside the scans, or in the release's common folder.
fn poses_path(dir: &Path) -> Option<PathBuf> {
    let beside = ["poses.txt", "poses_cam0.txt"].map(|name| dir.join(name));
    let common = files::names_of(dir).filter_map(|dir| {
        let name = dir.file_name()?.to_str()?;
        Some(dir.parent()?.parent()?.join(format!("poses/{name}.txt")))
    });
    let mut places = beside.into_iter().chain(common);
    places.find(|path| path.is_file())
}

fn poses(
    dir: &Path,
    scans: &[(usize, String)],
    problems: &mut Vec<ReadError>,
) -> Result<Option<Vec<Option<Pose>>>> {
    let Some(path) = poses_path(dir) else {
        return Ok(None);
    };
    let camera_from_lidar = Calibration::read(&dir.join("calib.txt"))?
        .transform("Tr")?
        .isometry();
    let lidar_from_camera = camera_from_lidar.inverse();
    let poses = of_lines(&path, scans, problems, |line, text| {
        let rows = kitti_text::numbers::<12>(&path, line, None, text)?;
        let world_from_camera = kitti_text::rigid(&path, line, None, &rows)?.isometry();
        Ok((lidar_from_camera * world_from_camera * camera_from_lidar).into())
    });
    poses.map(Some)
}

/// `times.txt`, one per line, in nanoseconds. Those that are not above all before are reported: a clock was set back.
///
/// # Errors
/// [`ReadError`] for numbers of scans instead of times too.
fn times(
    dir: &Path,
    scans: &[(usize, String)],
    problems: &mut Vec<ReadError>,
) -> Result<Option<Vec<Option<u64>>>> {
    let path = dir.join("times.txt");
    if !path.is_file() {
        return Ok(None);
    }
    let mut found = Vec::new();
    let times = of_lines(&path, scans, &mut found, |line, text| {
        let [time] = kitti_text::numbers(&path, line, None, text)?;
        if time < 0.0 {
            let reason = format!("{time}, expected a time from 0");
            return Err(kitti_text::malformed(&path, line, None, reason));
        }
        // KITTI's times have a fraction or an exponent.
        Ok((time, text.trim() == (line - 1).to_string()))
    })?;
    let mut all = times.iter().copied();
    if times.len() >= LEAST_COUNTED && all.all(|time| time.is_some_and(|(_, is_count)| is_count)) {
        let reason = "numbers of scans, expected their times";
        return Err(ReadError::malformed(&path, reason));
    }
    // Only now: without times no scan is left out.
    problems.append(&mut found);
    let known: Vec<f64> = times.iter().flatten().map(|(time, _)| *time).collect();
    let unit = Unit::of_file(&path, &known, problems);
    let (mut faults, mut latest) = (Faults::default(), -1.0);
    let later = (1..).zip(times).map(|(line, time)| {
        let (time, _) = time?;
        if time <= latest {
            let reason = format!("{time}, expected a time above {latest}, that of the scan before");
            faults.push(kitti_text::malformed(&path, line, None, reason));
            return None;
        }
        latest = time;
        Some(unit.nanos(time))
    });
    let later = later.collect();
    faults.report("scan", problems);
    Ok(Some(later))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::{Dataset, LoadOptions};

    /// The camera faces x of the LiDAR: x right, y down, z forward.
    const TR: &str = "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n";

    fn build(root: &Path, name: &str, poses_at: &str, poses: &str) {
        let dir = root.join(name);
        fs::create_dir_all(dir.join("velodyne")).unwrap();
        fs::write(dir.join("calib.txt"), TR).unwrap();
        for scan in 0..2u8 {
            let point: Vec<u8> = [f32::from(scan), 2.0, 3.0, 0.5]
                .iter()
                .flat_map(|value| value.to_le_bytes())
                .collect();
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
        let dataset = crate::open(dir.path()).unwrap();
        let scenario = &dataset.scenarios[0];
        assert_eq!(
            (dataset.layout, scenario.name.as_str()),
            (Layout::KITTI_ODOMETRY, "sequences/07")
        );
        let frame = scenario.load(0, 1, &LoadOptions::default()).unwrap();
        let moved = frame.world_from_lidar.unwrap().translation_m;
        assert!(
            (moved[0] - 2.0).abs() < 1e-9 && (moved[1] + 1.0).abs() < 1e-9 && moved[2].abs() < 1e-9,
            "{moved:?}"
        );
        assert_eq!(
            (frame.points.xyzi, frame.capture_nanos),
            (vec![[1.0, 2.0, 3.0, 0.5]], 100_000_000)
        );
    }

    #[test]
    fn poses_above_are_found_by_whatever_name_the_folder_has() {
        let dir = tempfile::tempdir().unwrap();
        build(
            dir.path(),
            "sequences/07",
            "poses/07.txt",
            &"1 0 0 0 0 1 0 0 0 0 1 0\n".repeat(2),
        );
        let sequence = dir.path().join("sequences/07");
        for name in [sequence.clone(), sequence.join("velodyne/..")] {
            let dataset = crate::open(&name).unwrap();
            assert_eq!(dataset.scenarios[0].name, "07");
            let frame = dataset.scenarios[0]
                .load(0, 0, &LoadOptions::default())
                .unwrap();
            assert!(frame.world_from_lidar.is_some(), "{}", name.display());
        }
    }

    /// Problems with paths below `root`.
    fn problems_below(root: &Path, dataset: &Dataset) -> Vec<String> {
        let root = root.to_string_lossy();
        dataset
            .problems
            .iter()
            .map(|problem| problem.to_string().replace(&*root, ""))
            .collect()
    }

    #[test]
    fn times_and_missing_lines() {
        let dir = tempfile::tempdir().unwrap();
        build(dir.path(), ".", "poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n");
        fs::write(dir.path().join("times.txt"), "0.0\n1.036e-01\n").unwrap();
        let dataset = crate::open(dir.path()).unwrap();
        assert_eq!(stems(&dataset), ["000000"]);
        assert_eq!(
            problems_below(dir.path(), &dataset),
            ["/poses.txt: no line for scan 1: there are 1: the scan is left out"]
        );
        fs::write(
            dir.path().join("poses.txt"),
            "1 0 0 0 0 1 0 0 0 0 1 0\n".repeat(2),
        )
        .unwrap();
        let dataset = crate::open(dir.path()).unwrap();
        assert_eq!(
            (
                dataset.scenarios[0].ticks[1].capture_nanos,
                dataset.problems.len()
            ),
            (103_600_000, 0)
        );
        for (times, kept, expected) in [
            (
                "0.0\n",
                1,
                "/times.txt: no line for scan 1: there are 1: the scan is left out",
            ),
            (
                "0\nsoon\n",
                1,
                "/times.txt:2: \"soon\" is no finite number: the scan is left out",
            ),
            (
                "0\n0.1\n0.2\n",
                2,
                "/times.txt: 3 lines for 2 scans: those beyond the last scan are not used; if the scans were numbered \
                 anew, they have the lines of others",
            ),
        ] {
            fs::write(dir.path().join("times.txt"), times).unwrap();
            let dataset = crate::open(dir.path()).unwrap();
            assert_eq!(
                (stems(&dataset).len(), problems_below(dir.path(), &dataset)),
                (kept, vec![expected.to_owned()])
            );
        }
    }

    /// Capture times of the scans, milliseconds, and the problems, of `times` of three scans.
    fn millis(times: &str) -> (Vec<u64>, Vec<String>) {
        let dir = tempfile::tempdir().unwrap();
        build(
            dir.path(),
            ".",
            "poses.txt",
            &"1 0 0 0 0 1 0 0 0 0 1 0\n".repeat(3),
        );
        fs::write(dir.path().join("velodyne/000002.bin"), [0; 16]).unwrap();
        fs::write(dir.path().join("times.txt"), times).unwrap();
        let dataset = crate::open(dir.path()).unwrap();
        let ticks = dataset.scenarios[0].ticks.iter();
        let millis = ticks.map(|tick| (tick.capture_nanos + 500_000) / 1_000_000);
        (millis.collect(), problems_below(dir.path(), &dataset))
    }

    #[test]
    fn times_have_the_unit_that_the_list_shows() {
        for (times, expected) in [
            ("0\n0.1\n0.2\n", [0, 100, 200]),
            ("\u{feff}0\n0.1\n0.2\n", [0, 100, 200]),
            ("0.000\n100.000\n200.000\n", [0, 100, 200]),
            (
                "1600000000\n1600000000.1\n1600000000.2\n",
                [1_600_000_000_000, 1_600_000_000_100, 1_600_000_000_200],
            ),
        ] {
            assert_eq!(millis(times), (expected.to_vec(), vec![]), "{times}");
        }
        let (kept, problems) = millis("0\n1\n2\n");
        let expected = "/times.txt: numbers of scans, expected their times: the sequence is read without times";
        assert_eq!(kept, [0, 100, 200]);
        assert_eq!(problems, [expected]);
        assert_eq!(millis("0.0\n1.0\n2.0\n"), (vec![0, 1000, 2000], vec![]));
        let (kept, problems) = millis("0\n0.0001\n0.0002\n");
        assert_eq!((kept.len(), problems.len()), (3, 1));
        assert!(
            problems[0].starts_with("/times.txt: taken as times from 0.000 s to 0.000 s"),
            "{problems:?}"
        );
    }

    #[test]
    fn scans_whose_time_is_not_later_are_left_out() {
        for (times, kept, expected) in [
            (
                "5\n4.1\n5.1\n",
                [5000, 5100],
                "/times.txt:2: 4.1, expected a time above 5, that of the scan before: the scan is left out",
            ),
            (
                "5\n5.1\n5.1\n",
                [5000, 5100],
                "/times.txt:3: 5.1, expected a time above 5.1, that of the scan before: the scan is left out",
            ),
        ] {
            assert_eq!(millis(times), (kept.to_vec(), vec![expected.to_owned()]));
        }
    }

    #[test]
    fn two_files_of_one_scan_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let poses = "1 0 0 0 0 1 0 0 0 0 1 0\n".repeat(2);
        build(dir.path(), ".", "poses.txt", &poses);
        fs::write(dir.path().join("velodyne/1.bin"), [0; 16]).unwrap();
        let dataset = crate::open(dir.path()).unwrap();
        assert_eq!(stems(&dataset), ["000000", "000001"]);
        assert_eq!(
            problems_below(dir.path(), &dataset),
            ["/velodyne/1.bin: it has the scan number of 000001.bin: the file is left out"]
        );
    }

    #[test]
    fn a_blank_line_is_a_scan_without_value() {
        let dir = tempfile::tempdir().unwrap();
        let poses = "1 0 0 0 0 1 0 0 0 0 1 0\n\n1 0 0 0 0 1 0 0 0 0 1 2\n";
        build(dir.path(), ".", "poses.txt", poses);
        fs::write(dir.path().join("velodyne/000002.bin"), b"AAAAAAAAAAAAAAAA").unwrap();
        let dataset = crate::open(dir.path()).unwrap();
        let scenario = &dataset.scenarios[0];
        assert_eq!(stems(&dataset), ["000000", "000002"]);
        let frame = scenario.load(0, 1, &LoadOptions::default()).unwrap();
        assert_eq!(
            frame.world_from_lidar.unwrap().translation_m,
            [2.0, 0.0, 0.0]
        );
        let problem = dataset.problems[0].to_string();
        assert!(
            problem.ends_with("poses.txt:2: the line is blank: the scan is left out"),
            "{problem}"
        );
        assert_eq!(
            scenario.joins,
            ["2 poses by number: the line is that of the scan"]
        );
    }

    #[test]
    fn lines_beyond_scans_without_a_gap_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let poses = "1 0 0 0 0 1 0 0 0 0 1 0\n".repeat(5);
        build(dir.path(), ".", "poses.txt", &poses);
        let dataset = crate::open(dir.path()).unwrap();
        let expected = "/poses.txt: 5 lines for 2 scans: those beyond the last scan are not used; if the scans were \
                        numbered anew, they have the lines of others";
        assert_eq!(problems_below(dir.path(), &dataset), [expected]);
        // A gap shows that scans have their own numbers.
        let scans = dir.path().join("velodyne");
        fs::rename(scans.join("000001.bin"), scans.join("000003.bin")).unwrap();
        let dataset = crate::open(dir.path()).unwrap();
        assert_eq!(stems(&dataset), ["000000", "000003"]);
        assert_eq!(dataset.problems.len(), 0);
    }

    #[test]
    fn lines_that_may_be_of_other_scans_are_not_used() {
        let dir = tempfile::tempdir().unwrap();
        let pose = "1 0 0 0 0 1 0 0 0 0 1 0\n";
        build(dir.path(), ".", "poses.txt", &pose.repeat(2));
        let scans = dir.path().join("velodyne");
        fs::rename(scans.join("000000.bin"), scans.join("000002.bin")).unwrap();
        for (poses, expected) in [
            (
                pose.repeat(2),
                "scans are numbered 1 to 2 and lines from 0: number the scans as the lines",
            ),
            (
                format!("# poses\n{}", pose.repeat(3)),
                "a comment, where the number of a line is that of a scan",
            ),
        ] {
            fs::write(dir.path().join("poses.txt"), poses).unwrap();
            let problem = crate::open(dir.path()).unwrap().problems[0].to_string();
            assert!(
                problem.contains(expected) && problem.ends_with("read without poses"),
                "{problem}"
            );
        }
    }

    #[test]
    fn a_bad_pose_loses_only_its_scan() {
        let dir = tempfile::tempdir().unwrap();
        build(
            dir.path(),
            ".",
            "poses.txt",
            "1 0 0 0 0 1 0 0 0 0 -1 0\n1 0 0 0 0 1 0 0 0 0 1 0\n",
        );
        fs::write(dir.path().join("velodyne/000001 (1).bin"), [0; 16]).unwrap();
        let dataset = crate::open(dir.path()).unwrap();
        assert_eq!(stems(&dataset), ["000001"]);
        assert!(
            dataset.scenarios[0]
                .load(0, 0, &LoadOptions::default())
                .unwrap()
                .world_from_lidar
                .is_some()
        );
        let problems: Vec<String> = dataset.problems.iter().map(ToString::to_string).collect();
        let line = crate::Problem::from(&dataset.problems[1]).line;
        assert_eq!((problems.len(), line), (2, Some(1)));
        assert!(
            problems[0].ends_with("\"000001 (1)\" is no scan number: the file is left out"),
            "{problems:?}"
        );
        assert!(
            problems[1].ends_with("the scan is left out"),
            "{problems:?}"
        );
    }

    #[test]
    fn without_calibration_there_are_no_poses() {
        let dir = tempfile::tempdir().unwrap();
        build(dir.path(), ".", "poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n");
        fs::write(dir.path().join("calib.txt"), "Tr: 1 2 3\n").unwrap();
        let dataset = crate::open(dir.path()).unwrap();
        assert_eq!((stems(&dataset).len(), dataset.problems.len()), (2, 1));
        assert!(
            dataset.problems[0]
                .to_string()
                .ends_with("expected 12: the sequence is read without poses")
        );
    }

    #[test]
    fn a_folder_without_scans_is_no_sequence() {
        let dir = tempfile::tempdir().unwrap();
        fs::create_dir(dir.path().join("velodyne")).unwrap();
        fs::write(dir.path().join("velodyne/000000.pcd"), "").unwrap();
        fs::write(dir.path().join("calib.txt"), TR).unwrap();
        assert!(
            crate::open(dir.path())
                .unwrap_err()
                .to_string()
                .contains("no supported layout")
        );
    }

    fn stems(dataset: &Dataset) -> Vec<&str> {
        dataset.scenarios[0]
            .ticks
            .iter()
            .map(|tick| tick.stem.as_str())
            .collect()
    }
}
