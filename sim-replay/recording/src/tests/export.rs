//! Bags of ROS 2: the rules of rosbag2 for channels, and the times of messages.

use std::collections::BTreeMap;

use mcap::records::Record;
use ros2::Mount;

use super::*;

/// A recording whose vehicles' messages arrive out of order of their capture times.
fn recording_out_of_order(folder: &Path) -> PathBuf {
    let disk = Disk::new(usize::MAX);
    let mut writer =
        RecordingWriter::over(disk.clone(), Path::new("t"), RecordingOptions::default()).unwrap();
    let run = RunId::new("test").unwrap();
    let pose_of = |cav: &str, tick: u64| {
        let key = Key::stream(&run, &CavId::new(cav).unwrap(), Stream::Pose);
        (
            key,
            wire::encode(
                &stamp(cav, tick),
                protocol::PoseEstimate::new(pose(tick), 0.9),
            )
            .unwrap()
            .to_vec(),
        )
    };
    for (arrival, (cav, tick)) in [("4279", 1), ("4288", 0), ("4288", 2), ("4279", 2)]
        .into_iter()
        .enumerate()
    {
        for (key, payload) in tick_messages(tick, 10) {
            writer
                .write(&key, 1_000 + arrival as u64, &payload)
                .unwrap();
        }
        let (key, payload) = pose_of(cav, tick);
        writer
            .write(&key, 1_000 + arrival as u64, &payload)
            .unwrap();
    }
    // A message without a type in ROS 2.
    let key: Key = "v2v/test/4279/bev".parse().unwrap();
    writer.write(&key, 2_000, b"anything").unwrap();
    writer.finish().unwrap();
    write(folder, &disk.bytes())
}

#[test]
fn a_bag_keeps_the_rules_of_rosbag2() {
    let folder = tempfile::tempdir().unwrap();
    let from = recording_out_of_order(folder.path());
    for (times, first) in [
        (ExportTimes::Capture, 100_000_000),
        (ExportTimes::Arrival, 1_000),
    ] {
        let to = folder.path().join(format!("{first}.mcap"));
        let report = export_ros2(&from, &to, times, &Mount::default(), None).unwrap();
        // Of each of four ticks: two sweeps, a ground truth, a pose; the recorded poses have no type.
        assert_eq!(
            (report.messages, report.left_out, report.damage.len()),
            (16, 8, 0),
            "{times:?}"
        );
        let bytes = std::fs::read(&to).unwrap();
        let header = mcap::read::LinearReader::new(&bytes)
            .unwrap()
            .next()
            .unwrap()
            .unwrap();
        assert!(matches!(header, Record::Header(header) if header.profile == "ros2"));
        let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
        let mut topics = Vec::new();
        for channel in summary.channels.values() {
            let schema = channel
                .schema
                .as_ref()
                .expect("rosbag2 throws for a channel without a schema");
            assert_eq!(
                (channel.message_encoding.as_str(), schema.encoding.as_str()),
                ("cdr", "ros2msg")
            );
            let latched = "durability: 1\n";
            let qos = &channel.metadata["offered_qos_profiles"];
            assert_eq!(
                qos.contains(latched),
                channel.topic == "/tf_static",
                "{qos}"
            );
            assert!(channel.metadata["topic_type_hash"].starts_with("RIHS01_"));
            assert!(
                channel.topic.parse::<ros2::RosName>().is_ok(),
                "{}",
                channel.topic
            );
            topics.push(channel.topic.as_str());
        }
        topics.sort_unstable();
        let of_vehicles = ["4279", "4288"]
            .map(|cav| ["odometry", "points", "pose"].map(|of| format!("/cav_{cav}/{of}")));
        let expected: Vec<&str> = of_vehicles
            .as_flattened()
            .iter()
            .map(String::as_str)
            .chain(["/tf", "/tf_static", "/truth"])
            .collect();
        assert_eq!(topics, expected);
        let mut latest = BTreeMap::new();
        for message in mcap::MessageStream::new(&bytes).unwrap() {
            let message = message.unwrap();
            assert_eq!(message.log_time, message.publish_time);
            let before = latest
                .insert(message.channel.topic.clone(), message.publish_time)
                .unwrap_or(first);
            assert!(message.publish_time >= before, "{}", message.channel.topic);
            if times == ExportTimes::Capture && message.channel.topic.ends_with("/points") {
                // The stamp of the header: seconds and nanoseconds.
                let stamp =
                    [4, 8].map(|at| u32::from_le_bytes(*message.data[at..].first_chunk().unwrap()));
                assert_eq!(
                    u64::from(stamp[0]) * 1_000_000_000 + u64::from(stamp[1]),
                    message.log_time
                );
            }
        }
    }
}

#[test]
fn a_recording_with_messages_of_its_own_does_not_claim_to_be_a_bag() {
    let folder = tempfile::tempdir().unwrap();
    let from = recording_out_of_order(folder.path());
    let bytes = std::fs::read(&from).unwrap();
    let header = mcap::read::LinearReader::new(&bytes)
        .unwrap()
        .next()
        .unwrap()
        .unwrap();
    assert!(matches!(header, Record::Header(header) if header.profile.is_empty()));
    let to = folder.path().join("to.mcap");
    std::fs::write(&to, b"").unwrap();
    let error = export_ros2(&from, &to, ExportTimes::Capture, &Mount::default(), None).unwrap_err();
    assert!(error.to_string().contains("to.mcap"), "{error}");
}
