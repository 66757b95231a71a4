//! Recordings written, read back, truncated and on a full disk.

mod damaged;
mod export;
mod public_reader;

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use protocol::message::AgentTruth;
use protocol::{
    CavId, DetectionsReport, Gnss, GnssSource, Key, Lidar, PointCloud, Pose, RunId, Stamp, Stream,
    TrueObject, Truth, wire,
};

use super::*;
use dataset::{self, LoadOptions};

const AGENTS: [&str; 2] = ["4279", "4288"];

fn stamp(cav: &str, tick: u64) -> Stamp {
    let cav = CavId::new(cav).unwrap();
    Stamp {
        cav,
        epoch: 1,
        sequence: tick,
        capture_nanos: 100_000_000 * (tick + 1),
        publish_nanos: 7,
    }
}

fn cloud(tick: u64, points: usize) -> PointCloud {
    PointCloud {
        xyzi: (0..points)
            .map(|k| [k as f32, tick as f32, 0.5, 0.25])
            .collect(),
    }
}

fn pose(tick: u64) -> Pose {
    Pose::from_xyz_yaw([tick as f64 + 0.1, -2.0, 1.9], 0.3)
}

fn truth(tick: u64) -> Truth {
    let object = TrueObject {
        id: 7,
        class: "truck".into(),
        world_from_object: Pose::from_xyz_yaw([20.0, 3.0, 0.8], 0.1),
        size_m: [4.0, 1.8, 1.6],
        speed_mps: Some(3.5),
    };
    let agent = |cav: &str| AgentTruth {
        cav: CavId::new(cav).unwrap(),
        world_from_lidar: pose(tick),
        objects: vec![object.clone()],
    };
    Truth {
        tick,
        agents: AGENTS.map(agent).into(),
    }
}

/// The messages of one tick, as they come from the network.
fn tick_messages(tick: u64, points: usize) -> Vec<(Key, Vec<u8>)> {
    let run = RunId::new("test").unwrap();
    let mut messages = Vec::new();
    for cav in AGENTS {
        let key = |stream| Key::stream(&run, &CavId::new(cav).unwrap(), stream);
        let gnss = Gnss {
            world_from_lidar: pose(tick),
            position_std_m: 0.0,
            heading_std_rad: 0.0,
            source: GnssSource::Recorded,
        };
        messages.push((
            key(Stream::Gnss),
            wire::encode(&stamp(cav, tick), gnss).unwrap().to_vec(),
        ));
        let lidar = Lidar {
            points: cloud(tick, points),
        };
        messages.push((
            key(Stream::Lidar),
            wire::encode(&stamp(cav, tick), lidar).unwrap().to_vec(),
        ));
    }
    messages.push((
        protocol::Topic::Truth.in_run(&run),
        wire::encode(&stamp("replay", tick), truth(tick))
            .unwrap()
            .to_vec(),
    ));
    messages
}

/// Memory that is full after a number of bytes.
#[derive(Clone)]
struct Disk {
    bytes: Arc<Mutex<Vec<u8>>>,
    capacity: usize,
}

impl Disk {
    fn new(capacity: usize) -> Self {
        Self {
            bytes: Arc::default(),
            capacity,
        }
    }

    fn bytes(&self) -> Vec<u8> {
        self.bytes.lock().unwrap().clone()
    }
}

impl Write for Disk {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut held = self.bytes.lock().unwrap();
        let take = bytes.len().min(self.capacity - held.len());
        if take == 0 && !bytes.is_empty() {
            return Err(io::ErrorKind::StorageFull.into());
        }
        held.extend(&bytes[..take]);
        Ok(take)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Store for Disk {
    fn cut(&mut self, len: u64) -> io::Result<()> {
        self.bytes.lock().unwrap().truncate(len as usize);
        Ok(())
    }
}

/// A recording of `ticks` ticks, a chunk each.
fn recorded(ticks: u64, points: usize, options: RecordingOptions) -> Vec<u8> {
    let disk = Disk::new(usize::MAX);
    let mut writer = RecordingWriter::over(disk.clone(), Path::new("test.mcap"), options).unwrap();
    for tick in 0..ticks {
        for (key, payload) in tick_messages(tick, points) {
            writer.write(&key, 1_000 + tick, &payload).unwrap();
        }
        writer.flush().unwrap();
    }
    writer.finish().unwrap();
    disk.bytes()
}

/// Every message of every channel: topic, encoding, data.
fn messages_of(recording: &Recording) -> Vec<(String, String, Vec<u8>)> {
    let mut messages = Vec::new();
    for held in recording.file.all() {
        for message in held.unwrap().iter() {
            let channel = &message.channel;
            messages.push((
                channel.topic.clone(),
                channel.message_encoding.clone(),
                message.data.to_vec(),
            ));
        }
    }
    messages
}

fn has_index(path: &Path) -> bool {
    std::fs::read(path).unwrap().ends_with(mcap::MAGIC)
}

fn write(folder: &Path, bytes: &[u8]) -> PathBuf {
    let path = folder.join("recording.mcap");
    std::fs::write(&path, bytes).unwrap();
    path
}

#[test]
fn messages_read_equal_those_written() {
    for zstd_level in [None, Some(1)] {
        let folder = tempfile::tempdir().unwrap();
        let options = RecordingOptions {
            zstd_level,
            contents: Contents::All,
        };
        let path = write(folder.path(), &recorded(3, 100, options));
        let recording = Recording::open(&path).unwrap();
        assert_eq!(recording.damage(), []);
        let expected: Vec<_> = (0..3).flat_map(|tick| tick_messages(tick, 100)).collect();
        assert_eq!(recording.entries().len(), expected.len());
        for (entry, (key, payload)) in recording.entries().iter().zip(&expected) {
            assert_eq!(
                (&entry.key, &recording.read(entry).unwrap()),
                (key, payload)
            );
            assert_eq!(entry.arrived_nanos, 1_000 + entry.header.stamp.sequence);
        }
        let names: Vec<_> = AGENTS.map(|cav| format!("/cav_{cav}/points")).into();
        let topics: Vec<String> = messages_of(&recording)
            .into_iter()
            .map(|(topic, _, _)| topic)
            .collect();
        assert!(names.iter().all(|name| topics.contains(name)), "{topics:?}");
        assert!(has_index(&path));
    }
}

#[test]
fn sweeps_in_map_coordinates_are_converted_for_ros_tools_too() {
    let disk = Disk::new(usize::MAX);
    let mut writer =
        RecordingWriter::over(disk.clone(), Path::new("t"), RecordingOptions::default()).unwrap();
    // UTM: east, north, height.
    let far = PointCloud {
        xyzi: vec![[458_000.0, 5_428_000.0, 115.0, 0.5]],
    };
    let key = Key::stream(
        &RunId::new("test").unwrap(),
        &CavId::new("4279").unwrap(),
        Stream::Lidar,
    );
    for points in [
        far,
        PointCloud {
            xyzi: vec![[f32::NAN; 4]],
        },
    ] {
        let payload = wire::encode(&stamp("4279", 0), Lidar { points })
            .unwrap()
            .to_vec();
        writer.write(&key, 5, &payload).unwrap();
    }
    writer.finish().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let recording = Recording::open(&write(folder.path(), &disk.bytes())).unwrap();
    let messages = messages_of(&recording);
    let converted: Vec<_> = messages
        .iter()
        .filter(|(topic, ..)| topic == "/cav_4279/points")
        .collect();
    assert_eq!(
        (messages.len(), converted.len()),
        (3, 1),
        "a NaN is recorded unchanged"
    );
    let north = 5_428_000.0_f32.to_le_bytes();
    assert!(converted[0].2.windows(4).any(|bytes| bytes == north));
}

#[test]
fn a_recording_is_a_scene() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), &recorded(3, 50, RecordingOptions::default()));
    // The run folder is accepted as well as the file.
    let scenario = dataset::open(folder.path()).unwrap().scenarios.remove(0);
    assert_eq!(scenario.agents, AGENTS.map(|cav| CavId::new(cav).unwrap()));
    let captures: Vec<u64> = scenario
        .ticks
        .iter()
        .map(|tick| tick.capture_nanos)
        .collect();
    assert_eq!(captures, [100_000_000, 200_000_000, 300_000_000]);
    let frame = scenario.load(1, 2, &LoadOptions::default()).unwrap();
    assert_eq!(
        (frame.points, frame.world_from_lidar),
        (cloud(2, 50), Some(pose(2)))
    );
    let object = &frame.objects[0];
    assert_eq!(
        (object.id, object.class, object.speed_mps),
        (7, dataset::frame::ObjectClass::Truck, Some(3.5))
    );
}

#[test]
fn a_truth_that_cannot_be_read_is_a_problem_and_no_end() {
    let folder = tempfile::tempdir().unwrap();
    let disk = Disk::new(usize::MAX);
    let mut writer =
        RecordingWriter::over(disk.clone(), Path::new("t"), RecordingOptions::default()).unwrap();
    for tick in 0..2 {
        for (key, mut payload) in tick_messages(tick, 10) {
            if tick == 1 && key.topic == protocol::Topic::Truth {
                // After the header, which stays valid.
                payload.truncate(payload.len() - 1);
            }
            writer.write(&key, tick, &payload).unwrap();
        }
    }
    writer.finish().unwrap();
    write(folder.path(), &disk.bytes());
    let mut dataset = dataset::open(folder.path()).unwrap();
    assert_eq!(dataset.problems.len(), 1, "{:?}", dataset.problems);
    let scenario = dataset.scenarios.remove(0);
    assert_eq!(scenario.ticks.len(), 2);
    let frame = scenario.load(0, 1, &LoadOptions::default()).unwrap();
    assert_eq!((frame.points, frame.objects.len()), (cloud(1, 10), 0));
}

#[test]
fn a_recovered_recording_has_an_index_and_the_same_messages() {
    let folder = tempfile::tempdir().unwrap();
    let whole = recorded(4, 100, RecordingOptions::default());
    let path = write(folder.path(), &whole[..whole.len() / 2]);
    let to = folder.path().join("whole.mcap");
    let report = recover(&path, &to, RecordingOptions::default()).unwrap();
    assert_eq!(report.damage.len(), 1);
    let (cut, recovered) = (
        Recording::open(&path).unwrap(),
        Recording::open(&to).unwrap(),
    );
    assert_eq!(recovered.damage(), []);
    assert_eq!(report.messages as usize, cut.entries().len());
    assert!(has_index(&to) && !has_index(&path));
    for (left, right) in cut.entries().iter().zip(recovered.entries()) {
        assert_eq!(cut.read(left).unwrap(), recovered.read(right).unwrap());
        assert_eq!(left.arrived_nanos, right.arrived_nanos);
    }
    assert_eq!(cut.entries().len(), recovered.entries().len());
}

#[test]
fn a_file_that_is_not_written_as_a_whole_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let to = folder.path().join("whole.mcap");
    let options = RecordingOptions::default();
    let failed = RecordingWriter::whole(&to, options, |writer| {
        for (key, payload) in tick_messages(0, 10) {
            writer.write(&key, 1, &payload)?;
        }
        writer.flush()?;
        assert!(!to.exists(), "it has no name yet");
        Err::<(), _>(RecordingError::not_ours(&to, "the disk is full"))
    });
    failed.unwrap_err();
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    RecordingWriter::whole(&to, options, RecordingWriter::finish).unwrap();
    let part = folder.path().join("other.mcap.unfinished");
    std::fs::write(&part, "kept").unwrap();
    for (name, existing) in [("whole.mcap", &to), ("other.mcap", &part)] {
        let to = folder.path().join(name);
        let error = RecordingWriter::whole(&to, options, RecordingWriter::finish).unwrap_err();
        let expected = format!("{}: ", existing.display());
        assert!(error.to_string().contains(&expected), "{error}");
    }
    assert_eq!(std::fs::read(&part).unwrap(), b"kept");
}

#[test]
fn json_stands_beside_our_own_messages() {
    let disk = Disk::new(usize::MAX);
    let mut writer =
        RecordingWriter::over(disk.clone(), Path::new("t"), RecordingOptions::default()).unwrap();
    let key: Key = "v2v/test/4279/detections/json".parse().unwrap();
    let text = br#"{"tick": 0}"#;
    assert!(
        serde_json::from_slice::<DetectionsReport>(text).is_err(),
        "any JSON will do"
    );
    writer.write(&key, 5, text).unwrap();
    for (key, payload) in tick_messages(0, 1) {
        writer.write(&key, 6, &payload).unwrap();
    }
    writer.finish().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let recording = Recording::open(&write(folder.path(), &disk.bytes())).unwrap();
    assert_eq!(recording.entries().len(), 5, "JSON is no message of ours");
    assert_eq!(
        messages_of(&recording)[0],
        (key.to_string(), "json".to_owned(), text.to_vec())
    );
}

#[test]
fn a_first_message_that_is_none_spoils_none_after_it() {
    let disk = Disk::new(usize::MAX);
    let mut writer =
        RecordingWriter::over(disk.clone(), Path::new("t"), RecordingOptions::default()).unwrap();
    let messages = tick_messages(0, 1);
    messages
        .iter()
        .for_each(|(key, _)| writer.write(key, 5, b"garbage").unwrap());
    messages
        .iter()
        .for_each(|(key, payload)| writer.write(key, 6, payload).unwrap());
    writer.finish().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let recording = Recording::open(&write(folder.path(), &disk.bytes())).unwrap();
    let keys: Vec<&Key> = recording.entries().iter().map(|entry| &entry.key).collect();
    assert_eq!(
        keys,
        messages.iter().map(|(key, _)| key).collect::<Vec<_>>()
    );
}

#[test]
fn the_first_of_two_replays_of_one_tick_is_used_with_its_own_truth() {
    let disk = Disk::new(usize::MAX);
    let mut writer =
        RecordingWriter::over(disk.clone(), Path::new("t"), RecordingOptions::default()).unwrap();
    for (key, payload) in tick_messages(0, 1) {
        writer.write(&key, 5, &payload).unwrap();
        if key.topic == protocol::Topic::Truth {
            let second = Stamp {
                epoch: 2,
                ..stamp("replay", 0)
            };
            let nothing = Truth {
                tick: 0,
                agents: Vec::new(),
            };
            // The same again is a duplicate.
            for stamp in [stamp("replay", 0), second] {
                writer
                    .write(
                        &key,
                        6,
                        &wire::encode(&stamp, nothing.clone()).unwrap().to_vec(),
                    )
                    .unwrap();
            }
        }
    }
    writer.finish().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let mut dataset = dataset::open(&write(folder.path(), &disk.bytes())).unwrap();
    assert_eq!(dataset.problems.len(), 1, "{:?}", dataset.problems);
    assert!(
        dataset.problems[0]
            .to_string()
            .contains("second replay: the message is"),
        "{}",
        dataset.problems[0]
    );
    let frame = dataset
        .scenarios
        .remove(0)
        .load(0, 0, &LoadOptions::default())
        .unwrap();
    assert_eq!(frame.objects.len(), 1);
}

/// A recording of some messages in a folder, opened as a data set.
fn opened(
    folder: &tempfile::TempDir,
    messages: impl IntoIterator<Item = (Key, Vec<u8>)>,
) -> dataset::Dataset {
    let disk = Disk::new(usize::MAX);
    let mut writer =
        RecordingWriter::over(disk.clone(), Path::new("t"), RecordingOptions::default()).unwrap();
    for (key, payload) in messages {
        writer.write(&key, 5, &payload).unwrap();
    }
    writer.finish().unwrap();
    dataset::open(&write(folder.path(), &disk.bytes())).unwrap()
}

fn lidar_key(cav: &str) -> Key {
    let cav = CavId::new(cav).unwrap();
    Key::stream(&RunId::new("test").unwrap(), &cav, Stream::Lidar)
}

/// A sweep of another vehicle, epoch or time than usual.
fn sweep(stamp: &Stamp) -> Vec<u8> {
    let points = cloud(9, 1);
    wire::encode(stamp, Lidar { points }).unwrap().to_vec()
}

#[test]
fn a_tick_without_its_truth_has_no_true_pose_and_a_recording_without_any_that_of_its_receivers() {
    let folder = tempfile::tempdir().unwrap();
    let messages = || (0..2).flat_map(|tick| tick_messages(tick, 1));
    let pose_of_first = |messages: Vec<(Key, Vec<u8>)>| {
        let scenario = opened(&folder, messages).scenarios.remove(0);
        let frame = scenario.load(0, 0, &LoadOptions::default()).unwrap();
        frame.world_from_lidar
    };
    let is_truth = |key: &Key| key.topic == protocol::Topic::Truth;
    let mut without_first: Vec<_> = messages().collect();
    let first = without_first.iter().position(|(key, _)| is_truth(key));
    without_first.remove(first.unwrap());
    assert_eq!(pose_of_first(without_first), None);
    let without_any = messages().filter(|(key, _)| !is_truth(key));
    assert_eq!(pose_of_first(without_any.collect()), Some(pose(0)));
}

#[test]
fn a_sweep_on_the_topic_of_another_vehicle_is_left_out_and_named() {
    let folder = tempfile::tempdir().unwrap();
    let mut messages = tick_messages(0, 1);
    messages.insert(0, (lidar_key(AGENTS[0]), sweep(&stamp(AGENTS[1], 0))));
    let mut dataset = opened(&folder, messages);
    assert!(
        dataset.problems[0].to_string().ends_with(
            "v2v/test/4279/lidar at 100000000 ns: its header names 4288: the message is left out"
        ),
        "{:?}",
        dataset.problems
    );
    let scenario = dataset.scenarios.remove(0);
    let frame = scenario.load(0, 0, &LoadOptions::default()).unwrap();
    assert_eq!(frame.points, cloud(0, 1));
}

#[test]
fn a_second_sender_of_a_sweep_is_counted_and_a_repeated_message_is_not() {
    let folder = tempfile::tempdir().unwrap();
    let second = Stamp {
        epoch: 2,
        ..stamp(AGENTS[0], 0)
    };
    for (again, problems) in [(stamp(AGENTS[0], 0), 0), (second, 1)] {
        let mut messages = tick_messages(0, 1);
        messages.push((lidar_key(AGENTS[0]), sweep(&again)));
        let found = opened(&folder, messages).problems;
        assert_eq!(found.len(), problems, "{found:?}");
        let expected = "published by a second replay: the message is left out";
        assert!(found.iter().all(|it| it.to_string().ends_with(expected)));
    }
}

#[test]
fn sweeps_between_the_ticks_are_named_and_those_of_a_late_or_lossy_vehicle_are_not() {
    let folder = tempfile::tempdir().unwrap();
    let of_second = |key: &Key| *key == lidar_key(AGENTS[1]);
    let problems = |moved_nanos: u64, kept: &dyn Fn(&Key, u64) -> bool| {
        let messages = (0..6).flat_map(|tick| {
            let messages = tick_messages(tick, 1).into_iter();
            let messages = messages.filter(move |(key, _)| kept(key, tick));
            messages.map(move |(key, payload)| {
                let usual = stamp(AGENTS[1], tick);
                let moved = Stamp {
                    capture_nanos: usual.capture_nanos + moved_nanos,
                    ..usual
                };
                let payload = if of_second(&key) {
                    sweep(&moved)
                } else {
                    payload
                };
                (key, payload)
            })
        });
        let problems = opened(&folder, messages).problems;
        problems.iter().map(ToString::to_string).collect::<Vec<_>>()
    };
    let named = problems(10_000_000, &|_, _| true);
    assert!(
        named[0].ends_with(
            "4288 has sweeps 10 ms and more off every sweep of 4279: it takes part in no tick"
        ),
        "{named:?}"
    );
    let nothing: [&str; 0] = [];
    assert_eq!(problems(0, &|_, _| true), nothing);
    assert_eq!(
        problems(0, &|key, tick| of_second(key) || !(1..5).contains(&tick)),
        nothing,
        "the ego is away in between"
    );
    let either =
        |key: &Key, tick: u64| of_second(key) != (*key == lidar_key(AGENTS[0]) && tick < 4);
    assert_eq!(problems(0, &either), nothing);
}

#[test]
fn topics_that_are_no_keys_are_named_where_nothing_else_is_recorded() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("recording.mcap");
    let mut writer = mcap::Writer::new(std::fs::File::create(&file).unwrap()).unwrap();
    let none = std::collections::BTreeMap::new();
    let topic = "v2v/R1/4279/lidar";
    let channel = writer.add_channel(0, topic, OWN_ENCODING, &none).unwrap();
    let header = mcap::records::MessageHeader {
        channel_id: channel,
        sequence: 0,
        log_time: 5,
        publish_time: 5,
    };
    let payload = sweep(&stamp("4279", 0));
    writer.write_to_known_channel(&header, &payload).unwrap();
    writer.finish().unwrap();
    drop(writer);
    let error = Recording::open(&file).unwrap_err().to_string();
    assert!(
        error.contains("run name \"R1\" is not an identifier"),
        "{error}"
    );
}

#[test]
fn a_full_disk_leaves_whole_chunks() {
    let folder = tempfile::tempdir().unwrap();
    let one = recorded(1, 2_000, RecordingOptions::default()).len();
    let disk = Disk::new(5 * one / 2);
    let mut writer = RecordingWriter::over(
        disk.clone(),
        Path::new("full.mcap"),
        RecordingOptions::default(),
    )
    .unwrap();
    let mut failures = Vec::new();
    for tick in 0..6 {
        for (key, payload) in tick_messages(tick, 2_000) {
            failures.extend(writer.write(&key, tick, &payload).err());
        }
        failures.extend(writer.flush().err());
    }
    let messages: Vec<String> = failures.iter().map(ToString::to_string).collect();
    assert!(
        matches!(failures[0], RecordingError::Io { .. }),
        "{messages:?}"
    );
    assert!(
        messages[0].contains("full.mcap") && messages[0].contains("storage"),
        "{messages:?}"
    );
    assert!(
        failures[1..]
            .iter()
            .all(|error| matches!(error, RecordingError::Ended { .. })),
        "{messages:?}"
    );
    assert!(writer.finish().is_err());
    assert_eq!(writer.whole_messages(), 2 * 5, "two ticks were whole");
    drop(writer);
    let recording = Recording::open(&write(folder.path(), &disk.bytes())).unwrap();
    assert_eq!(recording.entries().len(), 2 * 5);
    let [damage] = recording.damage() else {
        panic!("{:?}", recording.damage())
    };
    assert_eq!(
        (damage.lost_bytes, damage.to_s),
        (0, None),
        "only the index is missing"
    );
}

#[test]
fn a_file_that_is_no_recording_is_refused_with_a_reason() {
    let folder = tempfile::tempdir().unwrap();
    for bytes in [
        b"".as_slice(),
        b"\x89MCAP",
        b"hello, hello, hello",
        &recorded(1, 1, RecordingOptions::default())[..8],
    ] {
        let error = Recording::open(&write(folder.path(), bytes)).unwrap_err();
        assert!(matches!(error, RecordingError::NotOurs { .. }), "{error}");
    }
    // A complete file of another program, without a channel of this one.
    let disk = Disk::new(usize::MAX);
    RecordingWriter::over(disk.clone(), Path::new("t"), RecordingOptions::default())
        .unwrap()
        .finish()
        .unwrap();
    let error = Recording::open(&write(folder.path(), &disk.bytes())).unwrap_err();
    assert!(
        error.to_string().contains("no channel of encoding"),
        "{error}"
    );
}
