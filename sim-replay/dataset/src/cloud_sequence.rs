//! Folders of point clouds with one file of poses, as LiDAR odometry and mapping programs write them.
//!
//! The clouds (`.pcd`, `.ply`, `.npy` or `.bin`) lie in the folder, or in `clouds`, `scans`, `lidar` or `points` below it,
//! in the LiDAR frame, right-handed. The file of poses has a line per cloud: `world_from_lidar` as 3x4 or 4x4 matrix row
//! by row, or as x y z and the quaternion x y z w (TUM); before these possibly the cloud's time or name. Lines belong to
//! clouds by that first number or name if it is in the clouds' names, else by their order.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use nalgebra::{Isometry3, Matrix4, Quaternion, Translation3, UnitQuaternion};
use protocol::{CavId, Handedness, Pose};
use support::rounding;

use super::cloud_files::clouds_in;
use super::faults::Faults;
use super::kitti_text::{lines, malformed};
use super::layouts::{LayoutRow, Reader};
use super::points::{SweepStorage, Sweeps};
use super::{FrameSource, Layout, OpenOptions, ReadError, Scenario, Tick, files, single_vehicle};
use crate::frame::Frame;
use crate::pcd::PcdCloud;

/// A folder of clouds and a file of poses.
pub(crate) static CLOUDS: LayoutRow = LayoutRow {
    key: "clouds",
    name: "clouds with poses",
    data_sets: "results of LiDAR odometry and mapping",
    files: "<cloud>.pcd, .ply, .npy or .bin (or in clouds/, scans/, lidar/, points/), and poses.txt or poses.csv (x y z qx \
            qy qz qw, 3x4 or 4x4 matrices; before these possibly time or name)",
    protocol: "opv2v",
    reader: Some(Reader::Sequence {
        is_one: |dir| place_of(dir).is_some(),
        open,
    }),
};

/// Names of the file of poses.
const POSES: [&str; 5] = [
    "poses.txt",
    "poses.csv",
    "poses.tum",
    "trajectory.txt",
    "trajectory.csv",
];
/// Folders of the clouds below that of the poses.
const FOLDERS: [&str; 4] = ["clouds", "scans", "lidar", "points"];
/// Largest difference between a time of a pose and that in a cloud's name, seconds.
const SAME_TIME_S: f64 = 1e-3;

#[derive(Debug)]
struct Sequence {
    /// File of the poses.
    poses: PathBuf,
    /// File and pose by stem.
    clouds: BTreeMap<String, (PathBuf, Pose)>,
    sweeps: Sweeps,
}

/// A line of the file of poses.
#[derive(Debug)]
struct Row {
    /// Time or name.
    name: Option<String>,
    world_from_lidar: Pose,
}

/// File of poses and clouds, if a folder has both.
fn place_of(dir: &Path) -> Option<(PathBuf, Vec<PathBuf>)> {
    let poses = POSES
        .iter()
        .map(|name| dir.join(name))
        .find(|path| path.is_file())?;
    let folders = std::iter::once(dir.to_owned()).chain(FOLDERS.iter().map(|name| dir.join(name)));
    let clouds = folders
        .filter_map(|folder| clouds_in(&folder).ok())
        .find(|clouds| !clouds.is_empty())?;
    Some((poses, clouds))
}

fn open(
    root: &Path,
    dir: &Path,
    options: &OpenOptions,
    problems: &mut Vec<ReadError>,
) -> Result<Scenario, ReadError> {
    let (path, clouds) =
        place_of(dir).ok_or_else(|| ReadError::malformed(dir, "no clouds with poses"))?;
    let mut faults = Faults::default();
    let rows = rows(&path, &mut faults)?;
    let mut timed = BTreeMap::new();
    let mut without = Faults::default();
    for (index, (cloud, row)) in joined(&path, &clouds, &rows)?.into_iter().enumerate() {
        let Some(stem) = cloud
            .file_stem()
            .and_then(|stem| stem.to_str())
            .map(str::to_owned)
        else {
            continue;
        };
        match row {
            Some(Row {
                name,
                world_from_lidar,
            }) => {
                let name = name.as_deref().unwrap_or_default();
                let nanos = nanos_of(name)
                    .unwrap_or_else(|| options.period_nanos.saturating_mul(index as u64));
                timed.insert((nanos, stem), (cloud, *world_from_lidar));
            }
            None => without.push(ReadError::malformed(
                &cloud,
                format!("no pose in {}", path.display()),
            )),
        }
    }
    faults.report("pose", problems);
    without.report("cloud", problems);
    let ticks = timed
        .keys()
        .map(|(nanos, stem)| Tick {
            stem: stem.clone(),
            capture_nanos: *nanos,
        })
        .collect();
    let files: Vec<PathBuf> = timed.values().map(|(cloud, _)| cloud.clone()).collect();
    let sweeps = Sweeps::of_single_vehicle(SweepStorage::ByName, files, options);
    let clouds = timed
        .into_iter()
        .map(|((_, stem), cloud)| (stem, cloud))
        .collect();
    let source = Arc::new(Sequence {
        poses: path,
        clouds,
        sweeps,
    });
    Ok(single_vehicle(
        files::name_below(root, dir),
        Layout(&CLOUDS),
        ticks,
        source,
    ))
}

/// The lines of the file. The first may be a line of names; one that cannot be read is none, and a fault.
fn rows(path: &Path, faults: &mut Faults) -> Result<Vec<Option<Row>>, ReadError> {
    let lines = lines(path)?
        .into_iter()
        .filter(|(_, text)| !text.trim_start().starts_with('#'));
    let is_names = |(_, text): &(u64, String)| {
        words(text)
            .iter()
            .skip(1)
            .all(|word| word.parse::<f64>().is_err())
    };
    Ok(lines
        .skip_while(is_names)
        .map(|(line, text)| faults.take(row(path, line, &text)))
        .collect())
}

fn words(text: &str) -> Vec<&str> {
    text.split([' ', '\t', ',', ';'])
        .filter(|word| !word.is_empty())
        .map(str::trim)
        .collect()
}

fn row(path: &Path, line: u64, text: &str) -> Result<Row, ReadError> {
    let fault = |reason: String| malformed(path, line, None, reason);
    let words = words(text);
    let (name, words) = match words.split_first() {
        Some((name, rest)) if [8, 13, 17].contains(&words.len()) => {
            (Some((*name).to_owned()), rest)
        }
        _ => (None, &words[..]),
    };
    let number = |word: &&str| word.parse::<f64>().ok().filter(|number| number.is_finite());
    let numbers: Option<Vec<f64>> = words.iter().map(number).collect();
    let numbers = numbers.ok_or_else(|| fault("not all values are finite numbers".to_owned()))?;
    let matrix = |rows: &[f64]| {
        let last = if rows.len() == 12 {
            &[0.0, 0.0, 0.0, 1.0][..]
        } else {
            &[]
        };
        Pose::from_matrix(&Matrix4::from_row_slice(&[rows, last].concat()))
            .map_err(|error| fault(error.to_string()))
    };
    let world_from_lidar = match numbers[..] {
        [x, y, z, qx, qy, qz, qw] => {
            let stored = Quaternion::new(qw, qx, qy, qz);
            if (stored.norm() - 1.0).abs() > 0.01 {
                return Err(fault(format!(
                    "quaternion of length {:.3}, expected 1",
                    stored.norm()
                )));
            }
            let pose: Pose = Isometry3::from_parts(
                Translation3::new(x, y, z),
                UnitQuaternion::new_normalize(stored),
            )
            .into();
            pose.validate().map_err(|error| fault(error.to_string()))?;
            pose
        }
        _ if [12, 16].contains(&numbers.len()) => matrix(&numbers)?,
        _ => {
            return Err(fault(format!(
                "{} values, expected 7, 12 or 16, or one more",
                words.len()
            )));
        }
    };
    Ok(Row {
        name,
        world_from_lidar,
    })
}

/// A cloud and its line.
type Joined<'a> = Vec<(PathBuf, Option<&'a Row>)>;

/// The line of each cloud: by name or time, or by order if there are as many lines as clouds.
fn joined<'a>(
    path: &Path,
    clouds: &[PathBuf],
    rows: &'a [Option<Row>],
) -> Result<Joined<'a>, ReadError> {
    let by_name: Joined<'_> = clouds
        .iter()
        .map(|cloud| (cloud.clone(), named_row(cloud, rows)))
        .collect();
    if by_name.iter().any(|(_, row)| row.is_some()) {
        return Ok(by_name);
    }
    if rows.len() != clouds.len() {
        let (poses, clouds) = (rows.len(), clouds.len());
        let reason = format!(
            "{poses} poses for {clouds} clouds, and no cloud has the name or time of a pose: lines cannot be assigned"
        );
        return Err(ReadError::malformed(path, reason));
    }
    Ok(clouds
        .iter()
        .cloned()
        .zip(rows.iter().map(Option::as_ref))
        .collect())
}

fn named_row<'a>(cloud: &Path, rows: &'a [Option<Row>]) -> Option<&'a Row> {
    let (file, stem) = (cloud.file_name()?.to_str()?, cloud.file_stem()?.to_str()?);
    let number = stem.parse::<f64>().ok();
    let is_of = |row: &&Row| {
        let Some(name) = row.name.as_deref() else {
            return false;
        };
        let same_time = || Some((name.parse::<f64>().ok()? - number?).abs() < SAME_TIME_S);
        name == stem || name == file || same_time().unwrap_or(false)
    };
    rows.iter().flatten().find(is_of)
}

/// A time in nanoseconds: numbers of 18 digits and more are nanoseconds, of 15 and more microseconds, else seconds.
fn nanos_of(text: &str) -> Option<u64> {
    let time = text
        .parse::<f64>()
        .ok()
        .filter(|time| *time >= 0.0 && *time < 1e19)?;
    let seconds = if time >= 1e17 {
        time * 1e-9
    } else if time >= 1e14 {
        time * 1e-6
    } else {
        time
    };
    (seconds < 1e10).then(|| rounding::to_u64(seconds * 1e9))
}

impl FrameSource for Sequence {
    fn frame(&self, agent: &CavId, tick: &Tick) -> Result<Frame, ReadError> {
        let mut frame = Frame::empty(agent.clone(), tick.capture_nanos, Handedness::Right);
        frame.world_from_lidar = self.clouds.get(&tick.stem).map(|(_, pose)| *pose);
        Ok(frame)
    }

    fn points(
        &self,
        agent: &CavId,
        tick: &Tick,
        variant: Option<&str>,
    ) -> Result<PcdCloud, ReadError> {
        self.sweeps
            .read(agent, &self.points_path(agent, tick, variant))
    }

    fn shared_files(&self, agent: &CavId) -> Vec<PathBuf> {
        let mut files = self.sweeps.samples(agent);
        files.push(self.poses.clone());
        files
    }

    fn points_path(&self, _agent: &CavId, tick: &Tick, _variant: Option<&str>) -> PathBuf {
        self.clouds
            .get(&tick.stem)
            .map(|(path, _)| path.clone())
            .unwrap_or_default()
    }
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
        let frame = |tick: usize| scenario.load(0, tick, &LoadOptions::default()).unwrap();
        let pose = |tick: usize| {
            let frame = frame(tick);
            (
                scenario.ticks[tick].stem.clone(),
                frame.world_from_lidar.unwrap().translation_m,
                frame.points.xyzi[0][0],
            )
        };
        (0..scenario.ticks.len()).map(pose).collect()
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
        let of = |text: &str| {
            fs::write(dir.path().join("poses.txt"), text).unwrap();
            crate::open(dir.path()).unwrap()
        };
        let by_time = of("# time x y z q\n11.0002 4 5 6 0 0 0 1\n10.5 1 2 3 0 0 1 0\n");
        assert_eq!(
            (by_time.layout.name(), poses(&by_time)),
            ("clouds with poses", expected.clone())
        );
        let by_name = of("file,x,y,z,qx,qy,qz,qw\n11.bin,4,5,6,0,0,0,1\n10.5.bin,1,2,3,0,0,0,1\n");
        assert_eq!(poses(&by_name), expected);
        let by_order = of("1 0 0 1 0 1 0 2 0 0 1 3\n1 0 0 4 0 1 0 5 0 0 1 6\n");
        assert_eq!(poses(&by_order), expected);
        let lacking = of("10.5 1 2 3 0 0 1 0\n11 4 5 6 0 0 0 2\n");
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

    #[test]
    fn times_are_read_in_their_unit() {
        let cases = [
            ("1.5", 1_500_000_000),
            ("1600000000000000", 1_600_000_000_000_000_000),
        ];
        for (text, nanos) in cases {
            assert_eq!(nanos_of(text), Some(nanos), "{text}");
        }
        assert_eq!((nanos_of("scan"), nanos_of("-1")), (None, None));
    }
}
