//! Recordings written, read back, cut and filled up.

mod public_reader;

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use mcap::{Compression, WriteOptions};
use proptest::collection::vec;
use proptest::prelude::*;
use protocol::message::AgentTruth;
use protocol::{
    CavId, DetectionsReport, Gnss, GnssSource, Key, Lidar, PointCloud, Pose, RunId, Stamp, Stream, TrueObject, Truth,
    wire,
};

use super::*;
use crate::dataset::{self, LoadOptions};

const AGENTS: [&str; 2] = ["4279", "4288"];

fn stamp(cav: &str, tick: u64) -> Stamp {
    let cav = CavId::new(cav).unwrap();
    Stamp { cav, epoch: 1, sequence: tick, capture_nanos: 100_000_000 * (tick + 1), publish_nanos: 7 }
}

fn cloud(tick: u64, points: usize) -> PointCloud {
    PointCloud { xyzi: (0..points).map(|k| [k as f32, tick as f32, 0.5, 0.25]).collect() }
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
    Truth { tick, agents: AGENTS.map(agent).into() }
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
        messages.push((key(Stream::Gnss), wire::encode(&stamp(cav, tick), gnss).unwrap().to_vec()));
        let lidar = Lidar { points: cloud(tick, points) };
        messages.push((key(Stream::Lidar), wire::encode(&stamp(cav, tick), lidar).unwrap().to_vec()));
    }
    messages.push((Key::truth(&run), wire::encode(&stamp("replay", tick), truth(tick)).unwrap().to_vec()));
    messages
}

/// Memory that is full at some point.
#[derive(Clone)]
struct Disk {
    bytes: Arc<Mutex<Vec<u8>>>,
    capacity: usize,
}

impl Disk {
    fn new(capacity: usize) -> Self {
        Self { bytes: Arc::default(), capacity }
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
    for held in recording.all() {
        for message in held.unwrap().iter() {
            let channel = &message.channel;
            messages.push((channel.topic.clone(), channel.message_encoding.clone(), message.data.to_vec()));
        }
    }
    messages
}

/// The same messages as another program writes them.
fn rewritten(recording: &Recording, options: WriteOptions) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    let mut writer = options.create(&mut bytes).unwrap();
    for messages in recording.all() {
        messages.unwrap().iter().for_each(|message| writer.write(message).unwrap());
    }
    writer.finish().unwrap();
    drop(writer);
    bytes.into_inner()
}

/// Packed by lz4, some messages a chunk.
fn lz4() -> WriteOptions {
    WriteOptions::new().compression(Some(Compression::Lz4)).chunk_size(Some(2_000))
}

/// Without chunks.
fn unchunked() -> WriteOptions {
    WriteOptions::new().compression(None).use_chunks(false)
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
fn what_is_read_is_what_was_written() {
    for zstd_level in [None, Some(1)] {
        let folder = tempfile::tempdir().unwrap();
        let options = RecordingOptions { zstd_level, with_ros: true };
        let path = write(folder.path(), &recorded(3, 100, options));
        let recording = Recording::open(&path).unwrap();
        assert_eq!(recording.damage(), []);
        let expected: Vec<_> = (0..3).flat_map(|tick| tick_messages(tick, 100)).collect();
        assert_eq!(recording.entries().len(), expected.len());
        for (entry, (key, payload)) in recording.entries().iter().zip(&expected) {
            assert_eq!((&entry.key, &recording.read(entry).unwrap()), (key, payload));
            assert_eq!(entry.arrived_nanos, 1_000 + entry.header.stamp.sequence);
        }
        let names: Vec<_> = AGENTS.map(|cav| format!("/{cav}/points")).into();
        let topics: Vec<String> = messages_of(&recording).into_iter().map(|(topic, _, _)| topic).collect();
        assert!(names.iter().all(|name| topics.contains(name)), "{topics:?}");
        assert!(has_index(&path));
    }
}

#[test]
fn a_recording_that_another_program_has_rewritten_is_read_alike() {
    for options in [lz4(), unchunked()] {
        let folder = tempfile::tempdir().unwrap();
        let own = Recording::open(&write(folder.path(), &recorded(3, 100, RecordingOptions::default()))).unwrap();
        let (own_messages, bytes) = (messages_of(&own), rewritten(&own, options));
        let recording = Recording::open(&write(folder.path(), &bytes)).unwrap();
        assert_eq!(recording.damage(), []);
        assert_eq!(messages_of(&recording), own_messages);
        let expected: Vec<_> = (0..3).flat_map(|tick| tick_messages(tick, 100)).collect();
        assert_eq!(recording.entries().len(), expected.len());
        for (entry, (key, payload)) in recording.entries().iter().zip(&expected) {
            assert_eq!((&entry.key, &recording.read(entry).unwrap()), (key, payload));
        }
        assert_eq!(dataset::open(folder.path()).unwrap().scenarios[0].ticks.len(), 3, "and is a scene");
    }
}

/// Where the chunks of a file begin.
fn chunk_places(bytes: &[u8]) -> Vec<usize> {
    let mut at = mcap::MAGIC.len();
    let mut places = Vec::new();
    while bytes[at] != mcap::records::op::DATA_END {
        if bytes[at] == mcap::records::op::CHUNK {
            places.push(at);
        }
        at += 9 + u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize;
    }
    places
}

#[test]
fn what_stands_behind_a_damaged_chunk_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let sound = recorded(4, 100, RecordingOptions::default());
    let chunks = chunk_places(&sound);
    // In its records, in the length of its record, in its kind; chunk 1 of 4.
    for (place, bit) in [(100, 1), (2, 1), (7, 0x40), (0, 0x80)] {
        let mut bytes = sound.clone();
        bytes[chunks[1] + place] ^= bit;
        let recording = Recording::open(&write(folder.path(), &bytes)).unwrap();
        let [damage] = recording.damage() else { panic!("{place}: {:?}", recording.damage()) };
        assert_eq!(damage.begin_bytes as usize, chunks[1], "{place}: {damage}");
        assert_eq!(damage.lost_bytes as usize, chunks[2] - chunks[1], "{place}: {damage}");
        // They arrived a nanosecond apart.
        assert_eq!((damage.from_s, damage.to_s), (Some(0.0), Some(2e-9)), "{place}: {damage}");
        let expected: Vec<_> = [0, 2, 3].into_iter().flat_map(|tick| tick_messages(tick, 100)).collect();
        let read: Vec<_> =
            recording.entries().iter().map(|entry| (entry.key.clone(), recording.read(entry).unwrap())).collect();
        assert_eq!(read, expected, "{place}");
        let report =
            recover(recording.path(), &folder.path().join(format!("{place}.mcap")), Default::default()).unwrap();
        assert_eq!((report.messages, report.damage.len()), (3 * 5, 1));
    }
}

#[test]
fn channels_that_a_damaged_chunk_describes_are_known_from_the_summary() {
    let folder = tempfile::tempdir().unwrap();
    let mut bytes = recorded(3, 10, RecordingOptions::default());
    let first = chunk_places(&bytes)[0];
    bytes[first + 100] ^= 1;
    let recording = Recording::open(&write(folder.path(), &bytes)).unwrap();
    assert_eq!((recording.entries().len(), recording.damage().len()), (2 * 5, 1));
    // Without a summary nobody knows what they are called, which is said.
    let cut = &bytes[..bytes.len() - 8];
    let error = Recording::open(&write(folder.path(), cut)).unwrap_err().to_string();
    assert!(error.contains("none of its messages can be read") && !error.contains("no channel"), "{error}");
}

#[test]
fn a_message_without_a_chunk_that_is_damaged_is_left_out_alone() {
    let folder = tempfile::tempdir().unwrap();
    let own = Recording::open(&write(folder.path(), &recorded(3, 10, RecordingOptions::default()))).unwrap();
    let sound = rewritten(&own, unchunked());
    let payloads: Vec<usize> = (0..sound.len() - 4).filter(|at| sound[*at..].starts_with(b"V2VL")).collect();
    assert_eq!(payloads.len(), 15);
    // The length of its record, which stands before 22 bytes of times and numbers.
    let mut bytes = sound.clone();
    bytes[payloads[4] - 22 - 7] ^= 2;
    let recording = Recording::open(&write(folder.path(), &bytes)).unwrap();
    assert_eq!((recording.entries().len(), recording.damage().len()), (14, 1), "{:?}", recording.damage());
    // A bit of what nobody else checks: when it arrived.
    let mut bytes = sound;
    bytes[payloads[4] - 10] ^= 2;
    let recording = Recording::open(&write(folder.path(), &bytes)).unwrap();
    let [damage] = recording.damage() else { panic!("{:?}", recording.damage()) };
    assert!(recording.entries().len() == 15 && damage.reason.contains("checksum of the data"), "{damage}");
}

#[test]
fn sweeps_in_coordinates_of_a_map_are_told_to_ros_tools_too() {
    let disk = Disk::new(usize::MAX);
    let mut writer = RecordingWriter::over(disk.clone(), Path::new("t"), RecordingOptions::default()).unwrap();
    // UTM: east, north, height.
    let far = PointCloud { xyzi: vec![[458_000.0, 5_428_000.0, 115.0, 0.5]] };
    let key = Key::stream(&RunId::new("test").unwrap(), &CavId::new("4279").unwrap(), Stream::Lidar);
    for points in [far, PointCloud { xyzi: vec![[f32::NAN; 4]] }] {
        let payload = wire::encode(&stamp("4279", 0), Lidar { points }).unwrap().to_vec();
        writer.write(&key, 5, &payload).unwrap();
    }
    writer.finish().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let recording = Recording::open(&write(folder.path(), &disk.bytes())).unwrap();
    let messages = messages_of(&recording);
    let told: Vec<_> = messages.iter().filter(|(topic, ..)| topic == "/4279/points").collect();
    assert_eq!((messages.len(), told.len()), (3, 1), "what is no number is recorded as it came");
    let north = 5_428_000.0_f32.to_le_bytes();
    assert!(told[0].2.windows(4).any(|bytes| bytes == north));
}

#[test]
fn a_chunk_that_asks_for_a_huge_window_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let options = RecordingOptions { zstd_level: Some(1), with_ros: false };
    let mut bytes = recorded(3, 100, options);
    let frame = bytes.windows(4).position(|bytes| bytes == [0x28, 0xb5, 0x2f, 0xfd]).unwrap();
    // The window descriptor of the frame: 2 GiB. zstd itself allows a stream 128 MiB, and looks before it allocates.
    assert_eq!(bytes[frame + 4] & 0x20, 0, "a frame with a window");
    bytes[frame + 5] = 21 << 3;
    let recording = Recording::open(&write(folder.path(), &bytes)).unwrap();
    let [damage] = recording.damage() else { panic!("{:?}", recording.damage()) };
    assert!(damage.reason.contains("too much memory"), "{damage}");
    assert_eq!(recording.entries().len(), 2 * 5, "the other chunks are read");
}

#[test]
fn a_record_that_reaches_beyond_its_chunk_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut bytes = recorded(1, 100, RecordingOptions { zstd_level: None, with_ros: false });
    let number = |bytes: &[u8], at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
    // Behind two times come the length unpacked, the checksum (0: none), no name of a packing, the length.
    let chunk = chunk_places(&bytes)[0] + 9;
    bytes[chunk + 24..chunk + 28].fill(0);
    assert_eq!(bytes[chunk + 28..chunk + 32], [0; 4]);
    let shorter = number(&bytes, chunk + 32) - 4;
    bytes[chunk + 32..chunk + 40].copy_from_slice(&shorter.to_le_bytes());
    let error = Recording::open(&write(folder.path(), &bytes)).unwrap_err();
    assert!(error.to_string().contains("not as long as what is in it"), "{error}");
}

#[test]
fn a_recording_is_a_scene() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), &recorded(3, 50, RecordingOptions::default()));
    // The run folder names it as well as the file does.
    let scenario = dataset::open(folder.path()).unwrap().scenarios.remove(0);
    assert_eq!(scenario.agents, AGENTS.map(|cav| CavId::new(cav).unwrap()));
    let captures: Vec<u64> = scenario.ticks.iter().map(|tick| tick.capture_nanos).collect();
    assert_eq!(captures, [100_000_000, 200_000_000, 300_000_000]);
    let frame = scenario.load(1, 2, &LoadOptions::default()).unwrap();
    assert_eq!((frame.points, frame.world_from_lidar), (cloud(2, 50), Some(pose(2))));
    let object = &frame.objects[0];
    assert_eq!((object.id, object.class, object.speed_mps), (7, crate::frame::ObjectClass::Truck, Some(3.5)));
}

#[test]
fn a_truth_that_cannot_be_read_is_a_problem_and_no_end() {
    let folder = tempfile::tempdir().unwrap();
    let disk = Disk::new(usize::MAX);
    let mut writer = RecordingWriter::over(disk.clone(), Path::new("t"), RecordingOptions::default()).unwrap();
    for tick in 0..2 {
        for (key, mut payload) in tick_messages(tick, 10) {
            if tick == 1 && key.topic == protocol::Topic::Truth {
                // Behind the header, which stays sound.
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
    let (cut, recovered) = (Recording::open(&path).unwrap(), Recording::open(&to).unwrap());
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
fn json_stands_beside_our_own_messages() {
    let disk = Disk::new(usize::MAX);
    let mut writer = RecordingWriter::over(disk.clone(), Path::new("t"), RecordingOptions::default()).unwrap();
    let key: Key = "v2v/test/4279/detections/json".parse().unwrap();
    let text = br#"{"tick": 0}"#;
    assert!(serde_json::from_slice::<DetectionsReport>(text).is_err(), "any JSON will do");
    writer.write(&key, 5, text).unwrap();
    for (key, payload) in tick_messages(0, 1) {
        writer.write(&key, 6, &payload).unwrap();
    }
    writer.finish().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let recording = Recording::open(&write(folder.path(), &disk.bytes())).unwrap();
    assert_eq!(recording.entries().len(), 5, "JSON is no message of ours");
    assert_eq!(messages_of(&recording)[0], (key.to_string(), "json".to_owned(), text.to_vec()));
}

#[test]
fn a_first_message_that_is_none_spoils_none_after_it() {
    let disk = Disk::new(usize::MAX);
    let mut writer = RecordingWriter::over(disk.clone(), Path::new("t"), RecordingOptions::default()).unwrap();
    let messages = tick_messages(0, 1);
    messages.iter().for_each(|(key, _)| writer.write(key, 5, b"garbage").unwrap());
    messages.iter().for_each(|(key, payload)| writer.write(key, 6, payload).unwrap());
    writer.finish().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let recording = Recording::open(&write(folder.path(), &disk.bytes())).unwrap();
    let keys: Vec<&Key> = recording.entries().iter().map(|entry| &entry.key).collect();
    assert_eq!(keys, messages.iter().map(|(key, _)| key).collect::<Vec<_>>());
}

#[test]
fn the_first_of_two_replays_of_one_moment_is_taken_with_its_own_truth() {
    let disk = Disk::new(usize::MAX);
    let mut writer = RecordingWriter::over(disk.clone(), Path::new("t"), RecordingOptions::default()).unwrap();
    for (key, payload) in tick_messages(0, 1) {
        writer.write(&key, 5, &payload).unwrap();
        if key.topic == protocol::Topic::Truth {
            let second = Stamp { epoch: 2, ..stamp("replay", 0) };
            let nothing = Truth { tick: 0, agents: Vec::new() };
            // The same once more is no news.
            for stamp in [stamp("replay", 0), second] {
                writer.write(&key, 6, &wire::encode(&stamp, nothing.clone()).unwrap().to_vec()).unwrap();
            }
        }
    }
    writer.finish().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let mut dataset = dataset::open(&write(folder.path(), &disk.bytes())).unwrap();
    assert_eq!(dataset.problems.len(), 1, "{:?}", dataset.problems);
    assert!(dataset.problems[0].to_string().contains("1 moments"), "{}", dataset.problems[0]);
    let frame = dataset.scenarios.remove(0).load(0, 0, &LoadOptions::default()).unwrap();
    assert_eq!(frame.objects.len(), 1);
}

#[test]
fn a_full_disk_leaves_what_is_whole() {
    let folder = tempfile::tempdir().unwrap();
    let one = recorded(1, 2_000, RecordingOptions::default()).len();
    let disk = Disk::new(5 * one / 2);
    let mut writer = RecordingWriter::over(disk.clone(), Path::new("full.mcap"), RecordingOptions::default()).unwrap();
    let mut failures = Vec::new();
    for tick in 0..6 {
        for (key, payload) in tick_messages(tick, 2_000) {
            failures.extend(writer.write(&key, tick, &payload).err());
        }
        failures.extend(writer.flush().err());
    }
    let said: Vec<String> = failures.iter().map(ToString::to_string).collect();
    assert!(matches!(failures[0], RecordingError::Io { .. }), "{said:?}");
    assert!(said[0].contains("full.mcap") && said[0].contains("storage"), "{said:?}");
    assert!(failures[1..].iter().all(|error| matches!(error, RecordingError::Ended { .. })), "{said:?}");
    assert!(writer.finish().is_err());
    assert_eq!(writer.whole_messages(), 2 * 5, "two ticks were whole");
    drop(writer);
    let recording = Recording::open(&write(folder.path(), &disk.bytes())).unwrap();
    assert_eq!(recording.entries().len(), 2 * 5);
    let [damage] = recording.damage() else { panic!("{:?}", recording.damage()) };
    assert_eq!((damage.lost_bytes, damage.to_s), (0, None), "only the index is missing");
}

#[test]
fn what_is_no_recording_is_refused_with_a_reason() {
    let folder = tempfile::tempdir().unwrap();
    for bytes in
        [b"".as_slice(), b"\x89MCAP", b"hello, hello, hello", &recorded(1, 1, RecordingOptions::default())[..8]]
    {
        let error = Recording::open(&write(folder.path(), bytes)).unwrap_err();
        assert!(matches!(error, RecordingError::NotOurs { .. }), "{error}");
    }
    // A file of someone else: whole, but without a channel of ours.
    let disk = Disk::new(usize::MAX);
    RecordingWriter::over(disk.clone(), Path::new("t"), RecordingOptions::default()).unwrap().finish().unwrap();
    let error = Recording::open(&write(folder.path(), &disk.bytes())).unwrap_err();
    assert!(error.to_string().contains("no channel of encoding"), "{error}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn a_cut_recording_reads_up_to_its_last_whole_chunk(at in 0.0_f64..1.0, packed: bool) {
        let options = RecordingOptions { zstd_level: packed.then_some(1), with_ros: true };
        let whole = recorded(4, 40, options);
        let folder = tempfile::tempdir().unwrap();
        let cut = (at * whole.len() as f64) as usize;
        let all: Vec<_> = (0..4).flat_map(|tick| tick_messages(tick, 40)).collect();
        match Recording::open(&write(folder.path(), &whole[..cut])) {
            Err(error) => prop_assert!(matches!(error, RecordingError::NotOurs { .. }), "{}", error),
            Ok(recording) => {
                let count = recording.entries().len();
                prop_assert_eq!(count % 5, 0, "whole chunks, which are whole ticks here");
                for (entry, (key, payload)) in recording.entries().iter().zip(&all) {
                    prop_assert_eq!(&entry.key, key);
                    prop_assert_eq!(&recording.read(entry).unwrap(), payload);
                }
                if let Some(damage) = recording.damage().last() {
                    prop_assert_eq!(damage.begin_bytes + damage.lost_bytes, cut as u64);
                } else {
                    prop_assert_eq!(count, 20);
                }
            }
        }
    }

    #[test]
    fn one_bit_costs_one_chunk_at_most_and_is_noticed(at in 0.0_f64..1.0, bit in 0_u8..8, packing in 0..3) {
        let zstd_level = (packing == 1).then_some(1);
        let mut bytes = recorded(4, 40, RecordingOptions { zstd_level, ..RecordingOptions::default() });
        let folder = tempfile::tempdir().unwrap();
        if packing == 2 {
            bytes = rewritten(&Recording::open(&write(folder.path(), &bytes)).unwrap(), lz4());
        }
        let at = (at * bytes.len() as f64) as usize;
        bytes[at] ^= 1 << bit;
        let all: Vec<_> = (0..4).flat_map(|tick| tick_messages(tick, 40)).collect();
        let recording = Recording::open(&write(folder.path(), &bytes)).unwrap();
        let read: Vec<_> =
            recording.entries().iter().map(|entry| (entry.key.clone(), recording.read(entry).unwrap())).collect();
        prop_assert!(read.len() >= all.len() - 5, "{:?}", recording.damage());
        prop_assert!(read.len() == all.len() || !recording.damage().is_empty());
        let mut left = all.iter();
        prop_assert!(read.iter().all(|message| left.any(|written| written == message)), "in the order of the file");
    }

    #[test]
    fn what_is_damaged_anyhow_never_panics(places in vec((0.0_f64..1.0, any::<u8>()), 1..40), without_chunks: bool) {
        let mut bytes = recorded(3, 10, RecordingOptions::default());
        let folder = tempfile::tempdir().unwrap();
        if without_chunks {
            bytes = rewritten(&Recording::open(&write(folder.path(), &bytes)).unwrap(), unchunked());
        }
        for (at, byte) in places {
            let at = (at * bytes.len() as f64) as usize;
            bytes[at] = byte;
        }
        if let Ok(recording) = Recording::open(&write(folder.path(), &bytes)) {
            prop_assert!(recording.entries().iter().all(|entry| recording.read(entry).is_ok()));
        }
    }
}
