//! Bags for tests: messages in CDR, written to MCAP and SQLite as rosbag2 does.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use mcap::records::MessageHeader;
use re_cdr::{CdrWriter, LittleEndian};

type Cdr<'a> = CdrWriter<'a, LittleEndian>;

/// A second.
pub(super) const S: u64 = 1_000_000_000;
/// Stamp of time 0 of the drives.
pub(super) const T0: u64 = 1_700_000_000 * S;

/// Messages in the order in which they are recorded.
#[derive(Debug, Clone, Default)]
pub(super) struct Bag {
    pub(super) messages: Vec<Message>,
}

#[derive(Debug, Clone)]
pub(super) struct Message {
    topic: &'static str,
    type_name: &'static str,
    pub(super) recorded_nanos: u64,
    pub(super) data: Vec<u8>,
}

fn message(write: impl FnOnce(&mut Cdr<'_>)) -> Vec<u8> {
    let mut bytes = vec![0, 1, 0, 0];
    write(&mut CdrWriter::new(&mut bytes));
    bytes
}

fn header(cdr: &mut Cdr<'_>, nanos: u64, frame: &str) {
    cdr.write_i32(i32::try_from(nanos / S).unwrap());
    cdr.write_u32(u32::try_from(nanos % S).unwrap());
    cdr.write_string(frame);
}

/// Position and yaw of a pose.
fn pose(cdr: &mut Cdr<'_>, [x, y, z]: [f64; 3], yaw_rad: f64) {
    let (sin, cos) = (yaw_rad / 2.0).sin_cos();
    [x, y, z, 0.0, 0.0, sin, cos]
        .into_iter()
        .for_each(|value| cdr.write_f64(value));
}

impl Bag {
    fn add(
        &mut self,
        topic: &'static str,
        type_name: &'static str,
        recorded_nanos: u64,
        data: Vec<u8>,
    ) {
        self.messages.push(Message {
            topic,
            type_name,
            recorded_nanos,
            data,
        });
    }

    /// Adds a cloud of one point, at x = its stamp in seconds since `T0`: fields x, y, z, intensity with padding.
    pub(super) fn cloud(
        &mut self,
        topic: &'static str,
        frame: &str,
        nanos: u64,
        recorded_nanos: u64,
    ) {
        let data = message(|cdr| {
            header(cdr, nanos, frame);
            cdr.write_u32(1);
            cdr.write_u32(1);
            cdr.write_sequence_length(4);
            for (name, offset) in [("x", 0), ("y", 4), ("z", 8), ("intensity", 16)] {
                cdr.write_string(name);
                cdr.write_u32(offset);
                cdr.write_u8(7);
                cdr.write_u32(1);
            }
            cdr.write_bool(false);
            cdr.write_u32(32);
            cdr.write_u32(32);
            let mut point = [0; 32];
            let x = (nanos.wrapping_sub(T0) as f64 * 1e-9) as f32;
            for (offset, value) in [(0, x), (4, 2.0), (8, 3.0), (16, 51.0)] {
                point[offset..offset + 4].copy_from_slice(&value.to_le_bytes());
            }
            cdr.write_bytes(&point);
            cdr.write_bool(true);
        });
        self.add(topic, "sensor_msgs/msg/PointCloud2", recorded_nanos, data);
    }

    /// Adds `nav_msgs/Odometry`.
    pub(super) fn odometry(
        &mut self,
        topic: &'static str,
        (parent, child): (&str, &str),
        nanos: u64,
        xyz: [f64; 3],
    ) {
        let data = message(|cdr| {
            header(cdr, nanos, parent);
            cdr.write_string(child);
            pose(cdr, xyz, 0.0);
            (0..36 + 6 + 36).for_each(|_| cdr.write_f64(0.0));
        });
        self.add(topic, "nav_msgs/msg/Odometry", nanos, data);
    }

    /// Adds `geometry_msgs/PoseStamped`.
    pub(super) fn pose(&mut self, topic: &'static str, parent: &str, nanos: u64, xyz: [f64; 3]) {
        let data = message(|cdr| {
            header(cdr, nanos, parent);
            pose(cdr, xyz, 0.0);
        });
        self.add(topic, "geometry_msgs/msg/PoseStamped", nanos, data);
    }

    /// Adds `tf2_msgs/TFMessage` of one transform.
    pub(super) fn transform(
        &mut self,
        topic: &'static str,
        (parent, child): (&str, &str),
        nanos: u64,
        (xyz, yaw_rad): ([f64; 3], f64),
    ) {
        let data = message(|cdr| {
            cdr.write_sequence_length(1);
            header(cdr, nanos, parent);
            cdr.write_string(child);
            pose(cdr, xyz, yaw_rad);
        });
        self.add(topic, "tf2_msgs/msg/TFMessage", nanos, data);
    }

    /// Adds a message that is no use.
    pub(super) fn text(&mut self) {
        self.add("/rosout", "rcl_interfaces/msg/Log", T0, vec![0, 1, 0, 0]);
    }

    /// Writes an MCAP file.
    pub(super) fn mcap(&self, path: &Path) {
        let options = mcap::WriteOptions::new()
            .profile("ros2")
            .compression(Some(mcap::Compression::Zstd));
        let mut writer = options.create(File::create(path).unwrap()).unwrap();
        for (sequence, message) in (0..).zip(&self.messages) {
            let schema = writer
                .add_schema(message.type_name, "ros2msg", b"")
                .unwrap();
            let channel = writer
                .add_channel(
                    schema,
                    message.topic,
                    "cdr",
                    &std::collections::BTreeMap::new(),
                )
                .unwrap();
            let head = MessageHeader {
                channel_id: channel,
                sequence,
                log_time: message.recorded_nanos,
                publish_time: message.recorded_nanos,
            };
            writer.write_to_known_channel(&head, &message.data).unwrap();
        }
        writer.finish().unwrap();
    }

    /// Writes an SQLite file.
    pub(super) fn sqlite(&self, path: &Path) {
        let database = rusqlite::Connection::open(path).unwrap();
        database
            .execute_batch(
                "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, \
                 offered_qos_profiles TEXT); CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp \
                 INTEGER, data BLOB); BEGIN",
            )
            .unwrap();
        let mut topics: Vec<&str> = Vec::new();
        for message in &self.messages {
            let known = topics.iter().position(|topic| *topic == message.topic);
            let id = known.unwrap_or_else(|| {
                topics.push(message.topic);
                let row = (topics.len() - 1, message.topic, message.type_name);
                database
                    .execute("INSERT INTO topics VALUES (?1, ?2, ?3, 'cdr', '')", row)
                    .unwrap();
                topics.len() - 1
            });
            let row = (
                id,
                i64::try_from(message.recorded_nanos).unwrap(),
                &message.data,
            );
            database
                .execute(
                    "INSERT INTO messages(topic_id, timestamp, data) VALUES (?1, ?2, ?3)",
                    row,
                )
                .unwrap();
        }
        database.execute_batch("COMMIT").unwrap();
    }
}

/// Writes the description of a bag with these files.
pub(super) fn describe(folder: &Path, files: &[&str]) -> PathBuf {
    let files: String = files.iter().map(|file| format!("    - {file}\n")).collect();
    let text = format!(
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n  relative_file_paths:\n{files}"
    );
    fs::write(folder.join("metadata.yaml"), text).unwrap();
    folder.to_owned()
}

/// A robot that drives along x at 2 m/s for three seconds, with a LiDAR 1 m before and 2 m above its body, turned by a
/// quarter: ten sweeps a second, odometry at 20 Hz, a few milliseconds apart.
pub(super) fn drive() -> Bag {
    drive_at(0.0)
}

/// [`drive`], from `begin_m` on.
pub(super) fn drive_at(begin_m: f64) -> Bag {
    let mut bag = Bag::default();
    bag.text();
    bag.transform(
        "/tf_static",
        ("base_link", "os_sensor"),
        0,
        ([1.0, 0.0, 2.0], std::f64::consts::FRAC_PI_2),
    );
    for step in 0..=60_u64 {
        let nanos = T0 + step * S / 20 + 3_000_000;
        bag.odometry(
            "/odom",
            ("odom", "base_link"),
            nanos,
            [begin_m + x_at(nanos), 0.0, 0.0],
        );
        if step % 2 == 0 {
            let nanos = T0 + step * S / 20;
            bag.cloud("/points", "os_sensor", nanos, nanos + 50_000_000);
        }
    }
    bag
}

/// Position of the robot, metres.
pub(super) fn x_at(nanos: u64) -> f64 {
    2.0 * (nanos as f64 - T0 as f64) * 1e-9
}
