//! Digest of the data: a flipped byte of any file that is opened gives another one, in every layout.

use std::collections::BTreeMap;
use std::fs;
use std::mem::MaybeUninit;
use std::path::{Path, PathBuf};

use dataset::LoadOptions;
use protocol::{CavId, Gnss, GnssSource, Key, Lidar, PointCloud, Pose, RunId, Stamp, Stream, wire};
use recording::{ExportTimes, RecordingOptions, RecordingWriter, export_ros2};
use ros2::Mount;
use rustix::fs::inotify::{self, CreateFlags, WatchFlags};
use rustix::io::Errno;
use simulator::generate::{SceneLayout, Subset, SynthOptions, generate};
use support::file_digests::FileDigests;

/// All layouts that scenes are written in.
const LAYOUTS: [SceneLayout; 11] = [
    SceneLayout::Opv2v,
    SceneLayout::V2v4real,
    SceneLayout::V2xreal,
    SceneLayout::Dair,
    SceneLayout::V2xseq,
    SceneLayout::V2xsim,
    SceneLayout::Mars,
    SceneLayout::Nclt,
    SceneLayout::Oxford,
    SceneLayout::KittiOdometry,
    SceneLayout::KittiObject,
];

fn folders_below(root: &Path) -> Vec<PathBuf> {
    let mut folders = vec![root.to_owned()];
    for entry in fs::read_dir(root).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            folders.extend(folders_below(&path));
        }
    }
    folders
}

/// Files below a folder that `read` opens, as the system reports them.
fn opened_by(root: &Path, read: impl FnOnce()) -> Vec<PathBuf> {
    let watch = inotify::init(CreateFlags::NONBLOCK | CreateFlags::CLOEXEC).unwrap();
    let folders: BTreeMap<i32, PathBuf> = folders_below(root)
        .into_iter()
        .map(|folder| {
            let number = inotify::add_watch(&watch, &folder, WatchFlags::OPEN).unwrap();
            (number, folder)
        })
        .collect();
    read();
    let mut buffer = [MaybeUninit::uninit(); 4096];
    let mut events = inotify::Reader::new(&watch, &mut buffer);
    let mut files = Vec::new();
    loop {
        match events.next() {
            Ok(event) => {
                let name = event.file_name().map(|name| name.to_str().unwrap());
                files.extend(name.map(|name| folders[&event.wd()].join(name)));
            }
            Err(Errno::WOULDBLOCK) => break,
            Err(error) => panic!("{error}"),
        }
    }
    files.retain(|path| path.is_file());
    files.sort();
    files.dedup();
    files
}

/// Reads every frame of a data set.
fn load_all(root: &Path) {
    for scenario in dataset::open(root).unwrap().scenarios {
        for tick in 0..scenario.ticks.len() {
            for agent in scenario.present_agents(tick) {
                let frame = scenario.load(agent, tick, &LoadOptions::default());
                assert!(!frame.unwrap().points.is_empty());
            }
        }
    }
}

/// Digest of a data set; `None` if it cannot be opened any more.
fn sha256(root: &Path) -> Option<String> {
    let dataset = dataset::open(root).ok()?;
    let digests = FileDigests::default();
    Some(dataset::content_sha256(&dataset.scenarios, None, &digests))
}

/// Fails where a file is opened whose bytes are not in the digest, and where fewer than `least` files are opened.
fn assert_covers_all_that_is_opened(name: &str, root: &Path, least: usize) {
    let original = sha256(root);
    assert!(original.is_some(), "{name}");
    let opened = opened_by(root, || load_all(root));
    assert!(opened.len() >= least, "{name}: {opened:?}");
    for file in opened {
        let bytes = fs::read(&file).unwrap();
        let mut flipped = bytes.clone();
        let middle = flipped.len() / 2;
        flipped[middle] ^= 1;
        fs::write(&file, flipped).unwrap();
        assert_ne!(sha256(root), original, "{name}: {}", file.display());
        fs::write(&file, bytes).unwrap();
    }
    assert_eq!(sha256(root), original, "{name}");
}

#[test]
fn a_flipped_byte_of_any_opened_file_changes_the_digest_in_every_layout() {
    for layout in LAYOUTS {
        let folder = tempfile::tempdir().unwrap();
        let options = SynthOptions {
            layout,
            frames: 2,
            agents: 2..=2,
            ..SynthOptions::new(Subset::V2vdet, 1007, folder.path().to_owned())
        };
        generate(&options, &|_| {}).unwrap();
        assert_covers_all_that_is_opened(layout.name(), folder.path(), 2);
    }
}

#[test]
fn a_flipped_byte_of_clouds_or_poses_changes_the_digest() {
    let folder = tempfile::tempdir().unwrap();
    let cloud = |x: f32| [x, 2.0, 3.0, 0.5].map(f32::to_le_bytes).concat();
    fs::write(folder.path().join("1.bin"), cloud(1.0)).unwrap();
    fs::write(folder.path().join("2.bin"), cloud(2.0)).unwrap();
    fs::write(
        folder.path().join("poses.txt"),
        "1 0 0 0 0 0 0 1\n2 1.5 0 0 0 0 0 1\n",
    )
    .unwrap();
    assert_covers_all_that_is_opened("clouds", folder.path(), 2);
}

/// Writes a recording of one vehicle: three sweeps with their poses, 100 ms apart.
fn write_recording(path: &Path) {
    let (run, cav) = (RunId::new("test").unwrap(), CavId::new("4279").unwrap());
    let mut writer = RecordingWriter::create(path, RecordingOptions::default()).unwrap();
    for tick in 0..3_u32 {
        let stamp = Stamp {
            cav: cav.clone(),
            epoch: 1,
            sequence: u64::from(tick),
            capture_nanos: 100_000_000 * u64::from(tick + 1),
            publish_nanos: 7,
        };
        let gnss = Gnss {
            world_from_lidar: Pose::from_xyz_yaw([f64::from(tick), -2.0, 1.9], 0.3),
            position_std_m: 0.0,
            heading_std_rad: 0.0,
            source: GnssSource::Recorded,
        };
        let xyzi = (0..50_u16).map(|k| [f32::from(k), 5.0, 0.5, 0.25]);
        let points = PointCloud {
            xyzi: xyzi.collect(),
        };
        for (stream, message) in [
            (Stream::Gnss, wire::encode(&stamp, gnss)),
            (Stream::Lidar, wire::encode(&stamp, Lidar { points })),
        ] {
            let key = Key::stream(&run, &cav, stream);
            let bytes = message.unwrap().to_vec();
            writer.write(&key, stamp.capture_nanos, &bytes).unwrap();
        }
    }
    writer.finish().unwrap();
}

#[test]
fn a_flipped_byte_of_a_recorded_run_changes_the_digest() {
    let folder = tempfile::tempdir().unwrap();
    write_recording(&folder.path().join("recording.mcap"));
    assert_covers_all_that_is_opened("recording", folder.path(), 1);
}

#[test]
fn a_flipped_byte_of_a_bag_of_ros_2_or_of_its_description_changes_the_digest() {
    let [scratch, bag] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let recording = scratch.path().join("recording.mcap");
    write_recording(&recording);
    let file = bag.path().join("bag_0.mcap");
    let mount = Mount::default();
    export_ros2(&recording, &file, ExportTimes::Capture, &mount, None).unwrap();
    // The byte in the middle is within the name of the storage, which is not read.
    let description = "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n  \
                       relative_file_paths:\n    - bag_0.mcap\n";
    fs::write(bag.path().join("metadata.yaml"), description).unwrap();
    assert_covers_all_that_is_opened("bag", bag.path(), 2);
}
