//! Readers of every format on disk: the path of the damaged file, and the function that reads it.

use std::fs;
use std::path::{Path, PathBuf};

use dataset::cloud_files::clouds_at;
use dataset::pcd;
use dataset::{self, LoadOptions, Tick};
use ego_fuser::ego_loop::Input;
use ego_fuser::ego_loop::recorded::{EgoRecord, KIND};
use link::{LinkConfig, Trace};
use localization::pose_source::{ErrorTable, PoseTable};
use localization::registration::icp::surfel_map::SurfelMap;
use perception::weights::Weights;
use protocol::{Limits, wire};
use recording::Recording;
use ros2::{MotionType, read_point_cloud};
use runner::experiment::spec::Experiment;
use runner::scenario::Scenario;
use safetensors::tensor::{Dtype, TensorView, serialize};
use sim_replay::stream::{Place, Schedule};
use simulator::map;
use support::record_log::RecordReader;

use super::seeds;
use crate::sequences;

/// A format and its reader, with a folder of its own.
pub struct Reader {
    /// Name in tables.
    pub name: &'static str,
    /// Valid files.
    pub seeds: Vec<Vec<u8>>,
    path: PathBuf,
    read: fn(&Path, &[u8]) -> bool,
}

impl Reader {
    /// Writes `bytes` to the file and reads it; returns true if it was accepted.
    ///
    /// # Panics
    /// When a file cannot be written.
    #[must_use]
    pub fn try_read(&self, bytes: &[u8]) -> bool {
        if !self.path.as_os_str().is_empty() {
            fs::write(&self.path, bytes).expect("a writable folder");
        }
        (self.read)(&self.path, bytes)
    }
}

/// Every format, each in a folder below `root`.
///
/// # Panics
/// When a file cannot be written.
#[must_use]
pub fn all(root: &Path) -> Vec<Reader> {
    let text = |text: &str| vec![text.as_bytes().to_vec()];
    let file = |name: &str, file: &str| {
        let path = root.join(name).join(file);
        fs::create_dir_all(path.parent().expect("a folder below the root"))
            .expect("a writable folder");
        path
    };
    let in_memory = |name, seeds, read| Reader {
        name,
        seeds,
        path: PathBuf::new(),
        read,
    };
    let on_disk = |name, seeds, path: PathBuf, read| Reader {
        name,
        seeds,
        path,
        read,
    };
    fs::write(file("experiment", "links/newest-first.yaml"), seeds::LINK)
        .expect("a writable folder");
    let mut all = vec![
        in_memory("pcd", seeds::clouds(), |_, bytes| {
            pcd::decode(bytes).is_ok()
        }),
        in_memory("ros2 cloud", vec![seeds::ros2_cloud()], |_, bytes| {
            read_point_cloud(bytes, &Limits::DEFAULT).is_ok()
        }),
        in_memory("ros2 motion", seeds::ros2_motions(), |_, bytes| {
            // One byte in front selects the type.
            let Some((first, message)) = bytes.split_first() else {
                return false;
            };
            let types = [
                MotionType::Odometry,
                MotionType::TwistStamped,
                MotionType::Imu,
            ];
            types[usize::from(*first) % types.len()]
                .read(message)
                .is_ok()
        }),
        on_disk(
            "ply",
            vec![seeds::PLY.as_bytes().to_vec()],
            file("ply", "a.ply"),
            read_cloud,
        ),
        on_disk("npy", vec![seeds::npy()], file("npy", "a.npy"), read_cloud),
        in_memory("opendrive", text(seeds::OPENDRIVE), |_, bytes| {
            map::opendrive::read(bytes).is_ok()
        }),
        on_disk(
            "mcap recording",
            vec![seeds::recording(root)],
            file("mcap", "a.mcap"),
            read_recording,
        ),
        on_disk(
            "ego inputs",
            vec![seeds::ego_inputs(root)],
            file("inputs", "a.log"),
            read_inputs,
        ),
        on_disk(
            "scenario",
            text(seeds::SCENARIO),
            file("scenario", "a.yaml"),
            |path, _| {
                // Files that it names do not exist, which is no fault of the file.
                Scenario::read(path)
                    .inspect(|scenario| drop(scenario.check(path)))
                    .is_ok()
            },
        ),
        on_disk(
            "experiment",
            text(seeds::EXPERIMENT),
            file("experiment", "a.yaml"),
            |path, _| Experiment::read(path).is_ok(),
        ),
        on_disk(
            "tables",
            text(seeds::TABLES),
            file("tables", "a.yaml"),
            |path, _| Experiment::read(path).is_ok(),
        ),
        on_disk(
            "link",
            text(seeds::LINK),
            file("link", "a.yaml"),
            |path, _| LinkConfig::open(&path.to_string_lossy()).is_ok(),
        ),
        on_disk(
            "link trace",
            text(seeds::TRACE),
            file("trace", "a.csv"),
            |path, _| Trace::read_csv(path, 0).is_ok(),
        ),
        on_disk(
            "mahimahi trace",
            text(seeds::MAHIMAHI),
            file("mahimahi", "a.txt"),
            |path, _| Trace::read_mahimahi(path).is_ok(),
        ),
        on_disk(
            "pose table",
            text(seeds::POSES),
            file("poses", "a.csv"),
            |path, _| PoseTable::read(path).is_ok(),
        ),
        on_disk(
            "replay place",
            text(seeds::PLACE),
            file("place", "a.json"),
            read_place,
        ),
        on_disk(
            "error table",
            text(seeds::ERRORS),
            file("errors", "a.csv"),
            |path, _| ErrorTable::read(path).is_ok(),
        ),
        on_disk(
            "surfel map",
            vec![seeds::surfel_map(root)],
            file("surfels", "a.safetensors"),
            |path, _| SurfelMap::load(path).is_ok_and(|map| map.target().planes() < 1 << 20),
        ),
        on_disk(
            "weights",
            vec![weights()],
            file("weights", "a.safetensors"),
            |path, _| {
                Weights::load(path).is_ok_and(|weights| {
                    weights.config::<serde_json::Value>().is_ok()
                        && weights.names().count() < 1 << 20
                })
            },
        ),
    ];
    all.extend(frames(root));
    all.extend(drives(root));
    all
}

/// A single cloud.
fn read_cloud(path: &Path, _: &[u8]) -> bool {
    clouds_at(&[path.to_owned()])
        .into_iter()
        .flatten()
        .all(|file| file.read().is_ok())
}

/// Checkpoint of a replay, and the ticks that follow from it.
fn read_place(path: &Path, _: &[u8]) -> bool {
    let tick = |number: u64| Tick {
        stem: number.to_string(),
        capture_nanos: number * 100_000_000,
    };
    let ticks: Vec<Tick> = (0..10).map(tick).collect();
    let Ok(Some(place)) = Place::read(path, ("town", ticks.len()), seeds::PLAN) else {
        return false;
    };
    Schedule::new(&ticks, 0, None, true)
        .resumed(place.position)
        .take(20)
        .count()
        <= 20
}

/// The annotations of OPV2V and V2V4Real, with Python's matrices.
fn frames(root: &Path) -> Vec<Reader> {
    let frame = |name: &str, text: &str| {
        let folder = root.join(name).join("scene/100");
        fs::create_dir_all(&folder).expect("a writable folder");
        fs::write(folder.join("000060.pcd"), &seeds::clouds()[2]).expect("a writable folder");
        fs::write(folder.join("000060.yaml"), text).expect("a writable folder");
        folder.join("000060.yaml")
    };
    let read = |path: &Path, _: &[u8]| read_first(path.ancestors().nth(2).unwrap_or(path));
    let reader = |name, text: &str| Reader {
        name,
        seeds: vec![text.as_bytes().to_vec()],
        path: frame(name, text),
        read,
    };
    vec![
        reader("opv2v yaml", seeds::OPV2V),
        reader("v2v4real yaml", seeds::V2V4REAL),
    ]
}

/// Single-vehicle data sets: points, calibrations, poses, labels.
fn drives(root: &Path) -> Vec<Reader> {
    let points: Vec<u8> = (0..64)
        .flat_map(|number| (number as f32 * 0.5).to_le_bytes())
        .collect();
    let row = "1 0 0 0.5 0 1 0 -0.25 0 0 1 2";
    let odometry: [(&str, &[u8]); 4] = [
        ("velodyne/000000.bin", &points),
        (
            "calib.txt",
            b"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n",
        ),
        ("times.txt", b"0.0\n"),
        ("poses.txt", row.as_bytes()),
    ];
    let object: [(&str, &[u8]); 3] = [
        ("velodyne/000000.bin", &points),
        (
            "calib/000000.txt",
            b"R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n",
        ),
        (
            "label_2/000000.txt",
            b"Car 0.00 0 -1.57 599.41 156.40 629.75 189.25 1.65 1.67 3.64 0.65 1.71 46.70 -1.59\n",
        ),
    ];
    let nclt: [(&str, &[u8]); 2] = [
        ("velodyne_sync/1326030975726043.bin", &points),
        (
            "groundtruth_2012-01-22.csv",
            b"1326030975000000,1,2,3,0.1,0.2,0.3\n1326030975726043,1,2,3,0.1,0.2,0.3\n1326030976000000,1.5,2,3,0.1,0.2,0.3\n",
        ),
    ];
    let clouds: [(&str, &[u8]); 2] = [
        ("clouds/1.5.bin", &points),
        ("poses.txt", b"# time x y z q\n1.5 1 2 3 0 0 0.6 0.8\n"),
    ];
    let h5 = sequences::hdf5(
        &(0..12)
            .map(|sweep| 1_000_000 + 100_000 * sweep)
            .collect::<Vec<_>>(),
        &[[1.0, 0.0, 0.0, 5.0, 0.0, 1.0, 0.0, 6.0, 0.0, 0.0, 1.0, 0.0]; 12],
    );
    let sweeps: Vec<(String, Vec<u8>)> = (0..12)
        .map(|sweep| {
            (
                format!("velodyne_left/{}.bin", 1_000_000 + 100_000 * sweep),
                points.clone(),
            )
        })
        .collect();
    let converted: Vec<(&str, &[u8])> = sweeps
        .iter()
        .map(|(name, bytes)| (name.as_str(), &bytes[..]))
        .collect();
    let with_poses = [&converted[..], &[("velodyne_left_False.h5", &h5[..])]].concat();
    let robot = seeds::rosbag(root);
    let bag: [(&str, &[u8]); 2] = [
        ("drive_0.mcap", &robot),
        ("metadata.yaml", seeds::ROSBAG_METADATA.as_bytes()),
    ];
    let oxford = "2019-01-10-14-02-26-radar-oxford-10k";
    [
        (
            root.join("odometry/00"),
            &odometry[..],
            &[
                "kitti odometry points",
                "kitti calib",
                "kitti times",
                "kitti poses",
            ][..],
        ),
        (
            root.join("object/training"),
            &object[..],
            &["kitti object points", "kitti object calib", "kitti labels"][..],
        ),
        (
            root.join("raw/2012-01-22"),
            &nclt[..],
            &["nclt raw points", "nclt ground truth"][..],
        ),
        (
            root.join("clouds/drive"),
            &clouds[..],
            &["", "cloud poses"][..],
        ),
        (
            root.join("rosbag/drive"),
            &bag[..],
            &["rosbag mcap", "rosbag metadata"][..],
        ),
        (
            root.join("nclt/2012-01-22"),
            &with_poses[5..],
            &["", "", "", "", "", "", "", "nclt poses hdf5"][..],
        ),
        (
            root.join("oxford").join(oxford),
            &with_poses[5..],
            &["oxford points", "", "", "", "", "", "", ""][..],
        ),
    ]
    .into_iter()
    .flat_map(|(folder, files, names)| drive(&folder, files, names))
    .collect()
}

/// A folder of valid files; a reader for each that has a name.
fn drive(folder: &Path, files: &[(&str, &[u8])], names: &[&'static str]) -> Vec<Reader> {
    // A folder of its own for each, so that the other files stay valid.
    let reader = |(place, name): (usize, &&'static str)| {
        let own = folder
            .with_file_name(format!("{place}"))
            .join(folder.file_name().unwrap_or_default());
        for (path, bytes) in files {
            let path = own.join(path);
            fs::create_dir_all(path.parent().unwrap_or(&own)).expect("a writable folder");
            fs::write(path, bytes).expect("a writable folder");
        }
        let (path, bytes) = files[place];
        let read = |path: &Path, _: &[u8]| {
            let above = |path: &Path| path.parent().map(Path::to_owned).unwrap_or_default();
            read_first(&above(path)) || read_first(&above(&above(path)))
        };
        Reader {
            name,
            seeds: vec![bytes.to_vec()],
            path: own.join(path),
            read,
        }
    };
    names
        .iter()
        .enumerate()
        .filter(|(place, name)| !name.is_empty() && *place < files.len())
        .map(reader)
        .collect()
}

/// True if the first sweep of the first scenario can be read, and nothing is left out.
fn read_first(folder: &Path) -> bool {
    let Some(dataset) = dataset::open(folder)
        .ok()
        .filter(|dataset| dataset.problems.is_empty())
    else {
        return false;
    };
    let Some(scenario) = dataset
        .scenarios
        .first()
        .filter(|scenario| !scenario.ticks.is_empty())
    else {
        return false;
    };
    scenario
        .load(0, 0, &LoadOptions::default())
        .is_ok_and(|frame| frame.problems.is_empty())
}

fn read_recording(path: &Path, _: &[u8]) -> bool {
    let Ok(recording) = Recording::open(path) else {
        return false;
    };
    for entry in recording.entries() {
        if let Ok(bytes) = recording.read(entry) {
            let _ = wire::decode_any([&bytes[..]], &Limits::DEFAULT);
        }
    }
    recording.damage().is_empty()
}

/// Log of the inputs of an ego as it is, then with the checksums of its records corrected, so that damage gets past
/// them.
fn read_inputs(path: &Path, bytes: &[u8]) -> bool {
    let read = || {
        RecordReader::<EgoRecord>::open(path, KIND).is_ok_and(|mut records| {
            records.all(|record| match record {
                Ok(EgoRecord::Input {
                    input: Input::Message(message),
                    ..
                }) => wire::decode_any([&message.bytes[..]], &Limits::DEFAULT).is_ok(),
                record => record.is_ok(),
            })
        })
    };
    let is_sound = read();
    fs::write(path, with_checksums(bytes)).expect("a writable folder");
    read();
    is_sound
}

/// A record log with the right checksum of each record.
fn with_checksums(bytes: &[u8]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    let first_line = bytes.iter().position(|byte| *byte == b'\n');
    let mut rest = &mut bytes[first_line.map_or(0, |end| end + 1)..];
    while let Some((head, records)) = rest.split_first_chunk_mut::<8>() {
        let [length @ .., _, _, _, _] = *head;
        let length = usize::try_from(u32::from_le_bytes(length)).unwrap_or(usize::MAX);
        let (record, others) = records.split_at_mut(length.min(records.len()));
        head[4..].copy_from_slice(&crc32fast::hash(record).to_le_bytes());
        rest = others;
    }
    bytes
}

fn weights() -> Vec<u8> {
    let values: Vec<u8> = (0..24)
        .flat_map(|number| (number as f32).to_le_bytes())
        .collect();
    let view = |shape: Vec<usize>, bytes| {
        TensorView::new(Dtype::F32, shape, bytes).expect("a sound tensor")
    };
    let tensors = [
        ("a.weight", view(vec![2, 3, 4], &values)),
        ("a.bias", view(vec![6], &values[..24])),
    ];
    let metadata = [("config".to_owned(), "{\"name\": \"a\"}".to_owned())].into();
    serialize(tensors, Some(metadata)).expect("sound tensors")
}
