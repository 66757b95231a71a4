//! Single point clouds: files by path, read as their data set stores them if they lie in one.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use protocol::PointCloud;

use super::points::{SweepStorage, Sweeps, clouds_in};
use super::{
    Layout, OpenOptions, Plausibility, ReadError, Result, Scenario, rosbag, single_vehicle_id,
};
use crate::findings::SweepFindings;

/// Folders of sweeps whose files are readable only with the rest of their data set: NCLT and Oxford.
const SEQUENCE_FOLDERS: [&str; 2] = ["velodyne_sync", "velodyne_left"];

/// A file of one sweep, and its reader.
#[derive(Debug, Clone)]
pub struct CloudFile {
    /// Path of the file.
    pub path: PathBuf,
    source: CloudSource,
}

#[derive(Debug, Clone)]
enum CloudSource {
    /// A frame of a data set, by its agent and tick.
    Frame(Arc<Scenario>, (usize, usize)),
    /// A file by itself, with the others of its folder.
    File(Arc<Sweeps>),
}

/// Points of one file, right-handed if it lies in a data set, else as in the file.
#[derive(Debug, Clone, PartialEq)]
pub struct Cloud {
    /// The points in the LiDAR frame.
    pub points: PointCloud,
    /// Number of points that were left out: not finite, or exactly at the origin (rays without a return).
    pub left_out: usize,
    /// Findings about the sweep as stored.
    pub findings: SweepFindings,
    /// True if a data set states its handedness, which has been removed.
    pub is_of_data_set: bool,
}

/// Files at paths, each a file or a folder: of a folder its files of points in natural order, or all sweeps of the data
/// set in it.
pub fn clouds_at(paths: &[PathBuf]) -> Vec<Result<CloudFile>> {
    let mut found = Vec::new();
    for path in paths {
        match listed(path) {
            Ok(clouds) => found.extend(clouds.into_iter().map(Ok)),
            Err(error) => found.push(Err(error)),
        }
    }
    let mut folders = Folders::of(found.iter().flatten());
    let found = found.into_iter();
    let opened = found.map(|file| file.map(|file| folders.opened(file)));
    opened.collect()
}

/// The files at a path; one that was not found as part of a data set is read by itself.
fn listed(path: &Path) -> Result<Vec<CloudFile>> {
    let about = std::fs::metadata(path).map_err(|error| ReadError::io(path, error))?;
    let clouds = match about.is_dir() {
        true => clouds_in(path)?,
        // A bag is a file with many sweeps: it is opened as a data set below.
        false if rosbag::is_bag(path) => Vec::new(),
        false => vec![path.to_owned()],
    };
    if !clouds.is_empty() {
        let alone = |path| CloudFile {
            path,
            source: CloudSource::File(Arc::default()),
        };
        return Ok(clouds.into_iter().map(alone).collect());
    }
    let scenarios = crate::open(path)?.scenarios.into_iter();
    let sweeps: Vec<CloudFile> = scenarios.flat_map(frames_of).collect();
    if sweeps.is_empty() {
        let reason = "no cloud in it: expected files .pcd, .ply, .npy or .bin";
        return Err(ReadError::malformed(path, reason));
    }
    Ok(sweeps)
}

/// All sweeps of a scenario.
fn frames_of(scenario: Scenario) -> Vec<CloudFile> {
    let scenario = Arc::new(scenario);
    let all = (0..scenario.agents.len())
        .flat_map(|agent| (0..scenario.ticks.len()).map(move |tick| (agent, tick)));
    all.filter_map(|(agent, tick)| {
        let path = scenario.points_path(agent, tick, None).ok()?;
        // Bags and recordings hold many sweeps in a file: the stem tells them apart.
        let has_many = [Layout::ROSBAG, Layout::RECORDING].contains(&scenario.layout);
        let stem = &scenario.ticks.get(tick)?.stem;
        let path = if has_many { path.join(stem) } else { path };
        Some(CloudFile {
            path,
            source: CloudSource::Frame(Arc::clone(&scenario), (agent, tick)),
        })
    })
    .collect()
}

/// Readers of the folders that hold single files.
struct Folders {
    alone: BTreeMap<PathBuf, Arc<Sweeps>>,
    /// Frames by path, of the data sets opened so far.
    scenes: BTreeMap<PathBuf, BTreeMap<PathBuf, CloudFile>>,
}

impl Folders {
    fn of<'a>(listed: impl Iterator<Item = &'a CloudFile>) -> Self {
        let mut files: BTreeMap<PathBuf, Vec<PathBuf>> = BTreeMap::new();
        for CloudFile { path, source } in listed {
            if matches!(source, CloudSource::File(_)) {
                files.entry(folder_of(path)).or_default().push(path.clone());
            }
        }
        let alone = files.into_iter().map(|(folder, files)| {
            let options = OpenOptions::default();
            let sweeps = Sweeps::of_single_vehicle(SweepStorage::ByName, files, &options);
            (folder, Arc::new(sweeps))
        });
        Self {
            alone: alone.collect(),
            scenes: BTreeMap::new(),
        }
    }

    /// The file with its reader.
    fn opened(&mut self, file: CloudFile) -> CloudFile {
        let CloudFile { path, source } = file;
        if matches!(source, CloudSource::Frame(..)) {
            return CloudFile { path, source };
        }
        let known = scene_of(&path).and_then(|scene| {
            let frames = self.scenes.entry(scene.clone()).or_insert_with(|| {
                // A folder may only look like a scene: then its files are read by themselves.
                let scenarios = crate::open(&scene).map(|dataset| dataset.scenarios);
                let scenarios = scenarios.unwrap_or_default().into_iter();
                let frames = scenarios.flat_map(frames_of);
                frames.map(|file| (canonical(&file.path), file)).collect()
            });
            // A relative path or a link may name the same file as the scene does.
            frames.get(&canonical(&path)).cloned()
        });
        let source = known.map(|known| known.source).unwrap_or_else(|| {
            let alone = self.alone.get(&folder_of(&path)).cloned();
            CloudSource::File(alone.unwrap_or_default())
        });
        CloudFile { path, source }
    }
}

fn folder_of(path: &Path) -> PathBuf {
    path.parent().unwrap_or(path).to_owned()
}

fn canonical(path: &Path) -> PathBuf {
    path.canonicalize().unwrap_or_else(|_| path.to_owned())
}

/// The scenario that a file belongs to, by the files beside it: OPV2V and its relatives have a YAML beside each sweep.
fn scene_of(path: &Path) -> Option<PathBuf> {
    let path = canonical(path);
    let folder = path.parent()?;
    let is_of_sequence = SEQUENCE_FOLDERS.iter().any(|name| folder.ends_with(name));
    let is_frame = path.with_extension("yaml").is_file();
    let scene = folder.parent().filter(|_| is_frame || is_of_sequence);
    scene.map(Path::to_owned)
}

impl CloudFile {
    /// Reads the points.
    ///
    /// # Errors
    /// [`ReadError`] when the file cannot be read, is malformed or holds no points that a LiDAR measures: in this case
    /// with the exceeded limit.
    pub fn read(&self) -> Result<Cloud> {
        let cloud = match &self.source {
            CloudSource::Frame(scenario, (agent, tick)) => {
                scenario.load_points(*agent, *tick, None)?
            }
            CloudSource::File(sweeps) => sweeps.read(&single_vehicle_id(), &self.path)?,
        };
        let findings = SweepFindings::of(&cloud);
        let mut points = cloud.points;
        let before = points.len();
        points.xyzi.retain(|&[x, y, z, _]| [x, y, z] != [0.0; 3]);
        let left_out = cloud.dropped + before - points.len();
        if let Some(fault) = Plausibility::of(&points).fault() {
            let reason = format!("{fault}; a cloud is in the LiDAR frame, in metres");
            return Err(ReadError::malformed(&self.path, reason));
        }
        Ok(Cloud {
            points,
            left_out,
            findings,
            is_of_data_set: matches!(self.source, CloudSource::Frame(..)),
        })
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    const POINTS: [[f32; 3]; 3] = [[1.0, 2.0, 3.0], [0.0, 0.0, 0.0], [4.0, -5.0, 1.5]];

    fn ascii_pcd(points: &[[f32; 3]]) -> String {
        let head = format!(
            "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {}\nHEIGHT 1\nDATA ascii\n",
            points.len()
        );
        points
            .iter()
            .fold(head, |text, [x, y, z]| format!("{text}{x} {y} {z}\n"))
    }

    fn xyz(file: &CloudFile) -> Vec<[f32; 3]> {
        file.read()
            .unwrap()
            .points
            .xyzi
            .iter()
            .map(|&[x, y, z, _]| [x, y, z])
            .collect()
    }

    #[test]
    fn files_and_folders_are_listed_and_a_bad_one_is_an_error_of_its_own() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("clouds");
        fs::create_dir(&folder).unwrap();
        fs::write(folder.join("a.pcd"), ascii_pcd(&POINTS)).unwrap();
        fs::write(folder.join("b.npy"), "no array").unwrap();
        fs::write(folder.join("notes.md"), "").unwrap();
        let none = dir.path().join("none.pcd");
        let files = clouds_at(&[folder.clone(), none.clone(), folder.join("a.pcd")]);
        assert_eq!(files.len(), 4);
        let first = files[0].as_ref().unwrap();
        assert_eq!(
            xyz(first),
            [POINTS[0], POINTS[2]],
            "no return lies at the origin"
        );
        assert_eq!(
            (
                first.read().unwrap().left_out,
                first.read().unwrap().is_of_data_set
            ),
            (1, false)
        );
        assert!(
            files[1]
                .as_ref()
                .unwrap()
                .read()
                .unwrap_err()
                .to_string()
                .contains("b.npy: it does not begin")
        );
        assert!(
            files[2]
                .as_ref()
                .unwrap_err()
                .to_string()
                .contains("none.pcd")
        );
        assert_eq!(files[3].as_ref().unwrap().path, folder.join("a.pcd"));
    }

    #[test]
    fn a_file_of_a_left_handed_data_set_is_mirrored() {
        let dir = tempfile::tempdir().unwrap();
        let agent = dir.path().join("scene/7");
        fs::create_dir_all(&agent).unwrap();
        fs::write(agent.join("000069.pcd"), ascii_pcd(&POINTS)).unwrap();
        fs::write(
            agent.join("000069.yaml"),
            "lidar_pose: [0, 0, 0, 0, 0, 0]\nvehicles: {}\n",
        )
        .unwrap();
        for path in [agent.join("000069.pcd"), dir.path().to_owned()] {
            let file = clouds_at(&[path]).remove(0).unwrap();
            assert_eq!(xyz(&file), [[1.0, -2.0, 3.0], [4.0, 5.0, 1.5]]);
            assert!(file.read().unwrap().is_of_data_set);
        }
    }

    #[test]
    fn a_file_of_another_kind_is_named() {
        let dir = tempfile::tempdir().unwrap();
        for name in ["cloud.las", "cloud.pcd.gz", "cloud.xyz", "cloud"] {
            let path = dir.path().join(name);
            fs::write(&path, [0; 16]).unwrap();
            let message = clouds_at(&[path])[0]
                .as_ref()
                .unwrap()
                .read()
                .unwrap_err()
                .to_string();
            let ending = name.rsplit_once('.').map_or("", |(_, ending)| ending);
            let expected =
                format!("{ending:?} is no kind of cloud that is read: .pcd, .ply, .npy or .bin");
            assert!(message.ends_with(&expected), "{message}");
        }
    }

    #[test]
    fn points_of_a_map_are_refused_with_the_limit() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("map.pcd");
        fs::write(&path, ascii_pcd(&[[450_000.0, 5_400_000.0, 110.0]])).unwrap();
        let message = clouds_at(&[path])
            .remove(0)
            .unwrap()
            .read()
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("0.0 % of the points lie within 300 m")
                && message.ends_with("LiDAR frame, in metres")
        );
    }
}
