//! Folders of point clouds with one file of poses, as LiDAR odometry and mapping programs write them.
//!
//! The clouds (`.pcd`, `.ply`, `.npy` or `.bin`) lie in the folder, or in `clouds`, `scans`, `lidar` or `points` below it,
//! in the LiDAR frame, right-handed. The file of poses has a line per cloud: `world_from_lidar` as 3x4 or 4x4 matrix row
//! by row, or as position and quaternion, in the order x y z qx qy qz qw (TUM) or by the names of a header; possibly with
//! the cloud's name, number or time. Lines belong to clouds by that key ([`join`]), else by their order.

mod columns;
mod join;
mod pose_file;

use std::collections::{BTreeMap, HashSet};
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use self::join::join;
use self::pose_file::PoseFile;
use super::faults::Faults;
use super::frame_files::{named_once, usual_stems};
use super::keys::{Keys, LEAST_PER_STRAY};
use super::layout::{LayoutReader, LayoutRow};
use super::points::{SweepStorage, clouds_in};
use super::{Layout, OpenOptions, ReadError, Result, Scenario, Tick, files, sequence, time_stamps};

/// A folder of clouds and a file of poses.
pub(crate) static CLOUDS: LayoutRow = LayoutRow {
    key: "clouds",
    name: "clouds with poses",
    data_sets: "results of LiDAR odometry and mapping",
    files: "<cloud>.pcd, .ply, .npy or .bin (or in clouds/, scans/, lidar/, points/), and poses.txt, poses.csv, \
            <sequence>_poses_tum.txt or optimized_poses.txt (x y z qx qy qz qw or the columns of a header, 3x4 or 4x4 \
            matrices; possibly with time, number or name of the cloud)",
    protocol: "opv2v",
    reader: Some(LayoutReader::Sequence(|dir| place_of(dir).is_some(), open)),
};

/// Names of the file of poses, or their ends (KISS-ICP, SC-LIO-SAM), the first that exists.
const POSES: [&str; 8] = [
    "poses.txt",
    "poses.csv",
    "poses.tum",
    "trajectory.txt",
    "trajectory.csv",
    "optimized_poses.txt",
    "_poses_tum.txt",
    "_poses_kitti.txt",
];
/// Folders of the clouds below that of the poses, whatever the case of their letters.
const FOLDERS: [&str; 4] = ["clouds", "scans", "lidar", "points"];

/// True for a name, or one that ends in it where that begins with `_`.
fn is_poses(name: &str, known: &str) -> bool {
    name == known || (known.starts_with('_') && name.ends_with(known))
}

/// File of poses and clouds in natural order, if a folder has both.
fn place_of(dir: &Path) -> Option<(PathBuf, Vec<PathBuf>)> {
    let listing = files::list(dir).ok()?;
    let mut usual = POSES.iter();
    let poses = usual.find_map(|known| listing.files.iter().find(|name| is_poses(name, known)))?;
    let below = FOLDERS.iter().filter_map(|known| {
        let mut folders = listing.folders.iter();
        folders.find(|name| name.eq_ignore_ascii_case(known))
    });
    // A map that was saved beside the sweeps is none of them.
    let folders = below.map(|name| dir.join(name)).chain([dir.to_owned()]);
    let mut clouds = folders.filter_map(|folder| clouds_in(&folder).ok());
    let clouds = clouds.find(|clouds| !clouds.is_empty())?;
    Some((dir.join(poses), clouds))
}

fn open(dir: &Path, options: &OpenOptions, problems: &mut Vec<ReadError>) -> Result<Scenario> {
    let (path, files) =
        place_of(dir).ok_or_else(|| ReadError::malformed(dir, "no clouds with poses"))?;
    let mut faults = Faults::default();
    let poses = PoseFile::read(&path, &mut faults)?;
    let files = in_order(files, &poses, problems)?;
    let stems = stems_of(&files);
    let keys = Keys::of_stems(&stems);
    let joined =
        join(&stems, &keys, &poses).map_err(|reason| ReadError::malformed(&path, reason))?;
    faults.report("pose", problems);
    let (rows, used) = (poses.poses.len(), joined.rows.iter().flatten().count());
    if joined.is_beginning {
        let numbers = keys.shown();
        let reason = format!(
            "{rows} poses for clouds with {numbers}: those beyond the last cloud are not used; if the clouds were \
             numbered anew, they have the poses of others"
        );
        problems.push(ReadError::malformed(&path, reason));
    }
    let mut timed = BTreeMap::new();
    let mut without = Faults::default();
    for (index, ((file, stem), row)) in files.iter().zip(&stems).zip(&joined.rows).enumerate() {
        let Some(world_from_lidar) = row.and_then(|row| poses.poses.get(row).copied().flatten())
        else {
            let reason = format!("no pose in {}", path.display());
            without.push(ReadError::malformed(file, reason));
            continue;
        };
        let nanos = match &keys {
            Keys::Times(times) => times.get(index),
            // Without a time in its name a cloud has that of its pose.
            Keys::Numbers(_) | Keys::Names(_) => row.and_then(|row| poses.times()?.get(row)),
        };
        let counted = || options.period_nanos.saturating_mul(keys.count(index));
        let nanos = nanos.copied().unwrap_or_else(counted);
        let tick = Tick::new(*stem, nanos);
        let cloud = (tick, file.clone(), Some(world_from_lidar));
        // The index keeps clouds of equal times apart.
        timed.insert((nanos, index), cloud);
    }
    without.report("cloud", problems);
    let unclear = if matches!(keys, Keys::Times(_)) || poses.times().is_some() {
        let nanos: Vec<u64> = timed.keys().map(|(nanos, _)| *nanos).collect();
        time_stamps::step_problem(&path, &nanos)
    } else {
        time_stamps::date_problem(dir, &stems)
    };
    problems.extend(unclear);
    let of_poses = path.file_name().unwrap_or_default().display();
    let mut join = format!("{} poses of {of_poses} by {}", timed.len(), joined.by);
    if used < rows {
        join += &format!(", {} without cloud", rows - used);
    }
    let clouds = timed.into_values().collect();
    let (layout, storage) = (Layout(&CLOUDS), SweepStorage::ByName);
    Ok(Scenario {
        joins: vec![join],
        ..sequence::scenario(layout, clouds, storage, vec![path], options)
    })
}

/// Clouds in the order of their times, or in natural order. At most one of ten is left out: names that are no numbers
/// beside those that are, and further files of a number, time or stem.
///
/// # Errors
/// [`ReadError`] for more further files: then it is not known which are wrong.
fn in_order(
    mut files: Vec<PathBuf>,
    poses: &PoseFile,
    problems: &mut Vec<ReadError>,
) -> Result<Vec<PathBuf>> {
    let folder = files.first().and_then(|file| file.parent());
    let folder = folder.unwrap_or(Path::new(".")).to_owned();
    report_unread(&folder, &files, problems);
    let stems = stems_of(&files);
    if !Keys::of_stems(&stems).have_one_form() && !poses.has_names() {
        let (_, strays) = usual_stems(stems.into_iter().collect(), "");
        if strays.len() * LEAST_PER_STRAY <= files.len() {
            problems.extend(named_once(&folder, &strays));
            let strays: HashSet<&OsStr> = strays.iter().map(OsStr::new).collect();
            files.retain(|file| file.file_stem().is_none_or(|stem| !strays.contains(stem)));
        }
    }
    // Natural order compares fractions as whole numbers: 1.5 would come before 1.25.
    if let Keys::Times(times) = Keys::of_stems(&stems_of(&files)) {
        let mut timed: Vec<(u64, PathBuf)> = times.into_iter().zip(files).collect();
        timed.sort();
        files = timed.into_iter().map(|(_, file)| file).collect();
    }
    let keys = Keys::of_stems(&stems_of(&files));
    // The files are in order, so equal keys are neighbours.
    let pairs = files.array_windows::<2>().zip(0..);
    let doubles = pairs.filter(|(_, index)| keys.are_equal(*index, index + 1));
    let doubles: Vec<[PathBuf; 2]> = doubles.map(|(pair, _)| pair.clone()).collect();
    if let Some([first, second]) = doubles.first() {
        let (count, first) = (doubles.len(), first.display());
        let reason = format!("has the number, time or name of {first}: a pose is of one cloud");
        let fault = ReadError::malformed(second, reason);
        if count * LEAST_PER_STRAY > files.len() {
            return Err(fault);
        }
        problems.push(fault.with_consequence(&format!("{count} such files are left out")));
        files.retain(|file| !doubles.iter().any(|[_, second]| second == file));
    }
    Ok(files)
}

/// Reports clouds with another ending after their own, as compression adds it, where the cloud itself does not exist.
fn report_unread(folder: &Path, clouds: &[PathBuf], problems: &mut Vec<ReadError>) {
    let ending = clouds.first().and_then(|cloud| cloud.extension());
    let mut unread = Faults::default();
    for name in files::list(folder).unwrap_or_default().files {
        let file = folder.join(name);
        let cloud = file.with_extension("");
        if cloud.extension() == ending && !cloud.is_file() {
            unread.push(ReadError::malformed(&file, "no kind of cloud that is read"));
        }
    }
    unread.report("file", problems);
}

fn stems_of(files: &[PathBuf]) -> Vec<&str> {
    let stems = files.iter().map(|file| file.file_stem()?.to_str());
    stems.map(Option::unwrap_or_default).collect()
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::{Dataset, LoadOptions};

    fn clouds(dir: &Path, names: &[&str]) {
        for (index, name) in (1_u8..).zip(names) {
            let point: Vec<u8> = [f32::from(index), 2.0, 3.0, 0.5]
                .iter()
                .flat_map(|value| value.to_le_bytes())
                .collect();
            fs::write(dir.join(name), point).unwrap();
        }
    }

    fn poses(dataset: &Dataset) -> Vec<(String, [f64; 3], f32)> {
        let scenario = &dataset.scenarios[0];
        (0..scenario.ticks.len())
            .map(|tick| {
                let frame = scenario.load(0, tick, &LoadOptions::default()).unwrap();
                (
                    scenario.ticks[tick].stem.clone(),
                    frame.world_from_lidar.unwrap().translation_m,
                    frame.points.xyzi[0][0],
                )
            })
            .collect()
    }

    fn twelve_rows(row: impl Fn(usize) -> String) -> String {
        (0..12).map(row).collect()
    }

    fn open_with_poses(dir: &Path, text: &str) -> Dataset {
        fs::write(dir.join("poses.txt"), text).unwrap();
        crate::open(dir).unwrap()
    }

    #[test]
    fn poses_are_joined_by_the_number_of_the_cloud() {
        let dir = tempfile::tempdir().unwrap();
        let names: Vec<String> = (0..12).map(|number| format!("{number}.bin")).collect();
        clouds(
            dir.path(),
            &names.iter().map(String::as_str).collect::<Vec<_>>(),
        );
        let matrices = twelve_rows(|number| format!("1 0 0 {number} 0 1 0 0 0 0 1 0\n"));
        let timed =
            twelve_rows(|number| format!("{:.6} {number} 0 0 0 0 0 1\n", 0.1 * number as f64));
        let counted = twelve_rows(|number| format!("{number}.0 {number} 0 0 0 0 0 1\n"));
        let keyed = twelve_rows(|row| {
            let number = 11 - row;
            format!("{number} 1 0 0 {number} 0 1 0 0 0 0 1 0\n")
        });
        for (text, by) in [
            (matrices, "order"),
            (timed, "order"),
            (counted, "order"),
            (keyed, "number"),
        ] {
            let dataset = open_with_poses(dir.path(), &text);
            let scenario = &dataset.scenarios[0];
            assert_eq!(scenario.joins, [format!("12 poses of poses.txt by {by}")]);
            let found = poses(&dataset);
            for (number, (stem, position, first_x)) in found.iter().enumerate() {
                let expected = (number.to_string(), [number as f64, 0.0, 0.0]);
                assert_eq!((stem.clone(), *position), expected, "{by}");
                // The first cloud has a point at 1 m.
                assert_eq!(*first_x as usize, number + 1);
            }
            let times: Vec<u64> = scenario
                .ticks
                .iter()
                .map(|tick| tick.capture_nanos)
                .collect();
            assert_eq!(
                times,
                (0..12).map(|tick| tick * 100_000_000).collect::<Vec<u64>>()
            );
        }
    }

    #[test]
    fn files_of_odometry_programs_are_found() {
        let dir = tempfile::tempdir().unwrap();
        let scans = dir.path().join("Scans");
        fs::create_dir(&scans).unwrap();
        clouds(&scans, &["000000.bin", "000001.bin"]);
        fs::write(dir.path().join("GlobalMap.bin"), [0; 16]).unwrap();
        for name in [
            "optimized_poses.txt",
            "07_poses_kitti.txt",
            "07_poses_tum.txt",
        ] {
            let text = match name.ends_with("tum.txt") {
                true => "0.0 1 2 3 0 0 0 1\n1.0 4 5 6 0 0 0 1\n",
                false => "1 0 0 1 0 1 0 2 0 0 1 3\n1 0 0 4 0 1 0 5 0 0 1 6\n",
            };
            fs::write(dir.path().join(name), text).unwrap();
            let dataset = crate::open(dir.path()).unwrap();
            assert_eq!(
                dataset.scenarios[0].joins,
                [format!("2 poses of {name} by order")]
            );
            assert_eq!(poses(&dataset)[1].1, [4.0, 5.0, 6.0]);
            fs::remove_file(dir.path().join(name)).unwrap();
        }
    }

    #[test]
    fn seconds_and_nanoseconds_are_a_time() {
        let dir = tempfile::tempdir().unwrap();
        clouds(
            dir.path(),
            &[
                "cloud_1583836591_182590976.bin",
                "cloud_1583836591_382590976.bin",
            ],
        );
        let rows = "#sec,nsec,x,y,z,qx,qy,qz,qw\n1583836591,182590976,1,2,3,0,0,0,1\n\
                    1583836591,282590976,9,9,9,0,0,0,1\n1583836591,382590976,4,5,6,0,0,0,1\n";
        fs::write(dir.path().join("poses.csv"), rows).unwrap();
        let dataset = crate::open(dir.path()).unwrap();
        let found: Vec<[f64; 3]> = poses(&dataset).into_iter().map(|pose| pose.1).collect();
        assert_eq!(found, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
        assert_eq!(
            dataset.scenarios[0].ticks[1].capture_nanos,
            1_583_836_591_382_590_976
        );
    }

    #[test]
    fn one_pose_for_two_clouds_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        clouds(dir.path(), &["1.bin", "01.bin"]);
        fs::write(
            dir.path().join("poses.txt"),
            "1 2 3 0 0 0 1\n4 5 6 0 0 0 1\n",
        )
        .unwrap();
        let message = crate::open(dir.path()).unwrap_err().to_string();
        assert!(
            message.contains("1.bin: has the number, time or name of"),
            "{message}"
        );
    }

    /// Joins and problems of twelve clouds with fewer or other files, and of `rows` poses.
    fn joined(without: &[u8], others: &[&str], rows: usize) -> (Vec<String>, Vec<String>) {
        let dir = tempfile::tempdir().unwrap();
        let numbers = (0..12).filter(|number| !without.contains(number));
        let names: Vec<String> = numbers.map(|number| format!("{number:06}.bin")).collect();
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        clouds(dir.path(), &[&names[..], others].concat());
        let dataset = open_with_poses(dir.path(), &"1 2 3 0 0 0 1\n".repeat(rows));
        let root = format!("{}/", dir.path().display());
        let problems = dataset.problems.iter();
        let problems = problems.map(|problem| problem.to_string().replace(&root, ""));
        (dataset.scenarios[0].joins.clone(), problems.collect())
    }

    #[test]
    fn a_stray_file_is_left_out_and_named() {
        for (other, expected) in [
            (
                "GlobalMap.bin",
                "1 files whose names are no frame numbers are left out, first: GlobalMap",
            ),
            (
                "000005 (1).bin",
                "1 files whose names are no frame numbers are left out, first: 000005 (1)",
            ),
            (
                "000003.npy",
                "000003.npy: has the number, time or name of 000003.bin: a pose is of one cloud: 1 such files are left out",
            ),
            (
                "000012.bin.gz",
                "000012.bin.gz: no kind of cloud that is read: the file is left out",
            ),
        ] {
            let (joins, problems) = joined(&[], &[other], 12);
            assert_eq!(joins, ["12 poses of poses.txt by order"], "{other}");
            assert!(
                problems.len() == 1 && problems[0].ends_with(expected),
                "{problems:?}"
            );
        }
    }

    #[test]
    fn the_beginning_of_a_longer_list_is_named() {
        let (joins, problems) = joined(&[10, 11], &[], 12);
        let join = "10 poses of poses.txt by number of the row, 2 without cloud";
        assert_eq!(joins, [join]);
        let expected = "poses.txt: 12 poses for clouds with numbers 0 to 9: those beyond the last cloud are not used; if \
                        the clouds were numbered anew, they have the poses of others";
        assert_eq!(problems, [expected]);
        let (joins, problems) = joined(&[4, 5], &[], 12);
        assert_eq!((joins, problems.len()), (vec![join.to_owned()], 0));
    }

    #[test]
    fn poses_belong_to_clouds_by_name_time_or_order() {
        let dir = tempfile::tempdir().unwrap();
        let below = dir.path().join("scans");
        fs::create_dir(&below).unwrap();
        clouds(&below, &["10.5.bin", "11.bin"]);
        let expected = vec![
            ("10.5".into(), [1.0, 2.0, 3.0], 1.0),
            ("11".into(), [4.0, 5.0, 6.0], 2.0),
        ];
        let by_time = open_with_poses(
            dir.path(),
            "# time x y z q\n11.0002 4 5 6 0 0 0 1\n10.5 1 2 3 0 0 1 0\n",
        );
        assert_eq!(
            (by_time.layout.name(), poses(&by_time)),
            ("clouds with poses", expected.clone())
        );
        let by_name = open_with_poses(
            dir.path(),
            "file,x,y,z,qx,qy,qz,qw\n11.bin,4,5,6,0,0,0,1\n10.5.bin,1,2,3,0,0,0,1\n",
        );
        assert_eq!(poses(&by_name), expected);
        let by_order = open_with_poses(
            dir.path(),
            "1 0 0 1 0 1 0 2 0 0 1 3\n1 0 0 4 0 1 0 5 0 0 1 6\n",
        );
        assert_eq!(poses(&by_order), expected);
        let lacking = open_with_poses(dir.path(), "10.5 1 2 3 0 0 1 0\n11 4 5 6 0 0 0 2\n");
        assert_eq!((poses(&lacking).len(), lacking.problems.len()), (1, 2));
        assert!(
            lacking.problems[0]
                .to_string()
                .contains("quaternion of length 2.000, expected 1")
        );
        fs::write(dir.path().join("poses.txt"), "1 2 3 0 0 1 0\n").unwrap();
        let message = crate::open(dir.path()).unwrap_err().to_string();
        assert!(message.contains("1 poses for 2 clouds"), "{message}");
    }
}
