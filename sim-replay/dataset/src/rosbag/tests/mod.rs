//! Bags of every form, and of every kind of clock, frame and topic.

mod bag;

use std::fs;
use std::path::Path;

use support::file_digests::FileDigests;

use self::bag::{Bag, S, T0, describe, drive, drive_at, x_at};
use super::contents::BagContents;
use super::scan::{BagMessage, BagTopic, Scan};
use super::storage::Storage;
use crate::{Dataset, LoadOptions};

/// A bag in a file.
fn opened(bag: &Bag) -> Dataset {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("drive.mcap");
    bag.mcap(&path);
    crate::open(&path).unwrap()
}

fn problems(dataset: &Dataset) -> Vec<String> {
    let problems = dataset.problems.iter().map(ToString::to_string);
    problems
        .map(|text| text.split_once(": ").unwrap().1.to_owned())
        .collect()
}

/// Stamp after `T0` (seconds) and position of each sweep.
fn positions(dataset: &Dataset) -> Vec<(f64, [f64; 3])> {
    let scenario = &dataset.scenarios[0];
    let frame = |tick| scenario.load(0, tick, &LoadOptions::default()).unwrap();
    let position = |tick| {
        let frame: crate::frame::Frame = frame(tick);
        let seconds = (frame.capture_nanos - T0) as f64 * 1e-9;
        (seconds, frame.world_from_lidar.unwrap().translation_m)
    };
    (0..scenario.ticks.len()).map(position).collect()
}

/// Largest distance of the sweeps from where the robot's LiDAR was, with its body `offset_m` from the odometry, metres.
fn largest_error(dataset: &Dataset, offset_m: f64) -> f64 {
    let errors = positions(dataset).into_iter().map(|(seconds, [x, y, z])| {
        (x - 2.0 * seconds - 1.0 - offset_m)
            .abs()
            .max(y.abs())
            .max((z - 2.0).abs())
    });
    errors.fold(0.0, f64::max)
}

fn check_drive(path: &Path) {
    let dataset = crate::open(path).unwrap();
    assert_eq!(dataset.layout, crate::Layout::ROSBAG, "{path:?}");
    let left_out = "/points: 1 of 31 sweeps are not within the poses of /odom (base_link in odom), 1700000000.003 s to \
                    1700000003.003 s: left out";
    assert_eq!(problems(&dataset), [left_out], "{path:?}");
    assert!(largest_error(&dataset, 0.0) < 1e-6);
    let scenario = &dataset.scenarios[0];
    assert_eq!(scenario.ticks.len(), 30);
    assert_eq!(
        scenario.joins,
        [
            "sweeps of /points (os_sensor) and poses of /odom (base_link in odom) by the stamps of their headers, interpolated \
          over at most 1.25 s"
        ]
    );
    let frame = scenario.load(0, 9, &LoadOptions::default()).unwrap();
    assert_eq!(frame.points.xyzi, [[1.0, 2.0, 3.0, 0.2]], "51 of 255");
    let pose = frame.world_from_lidar.unwrap();
    assert!((pose.yaw_rad() - std::f64::consts::FRAC_PI_2).abs() < 1e-9);
}

#[test]
fn a_bag_is_a_folder_or_a_file_of_mcap_or_sqlite_compressed_or_not() {
    let folder = tempfile::tempdir().unwrap();
    let whole = drive();
    let (mut first, mut second) = (whole.clone(), whole.clone());
    second.messages = first.messages.split_off(50);
    for (name, ending) in [("a", "mcap"), ("b", "db3")] {
        let bag = folder.path().join(name);
        fs::create_dir(&bag).unwrap();
        let files = [0, 1].map(|number| format!("{name}_{number}.{ending}"));
        for (file, part) in files.iter().zip([&first, &second]) {
            match ending {
                "mcap" => part.mcap(&bag.join(file)),
                _ => part.sqlite(&bag.join(file)),
            }
        }
        check_drive(&describe(&bag, &[&files[0], &files[1]]));
    }
    let single = folder.path().join("single.db3");
    whole.sqlite(&single);
    check_drive(&single);
    let packed = folder.path().join("packed");
    fs::create_dir(&packed).unwrap();
    let bytes = zstd::encode_all(&fs::read(&single).unwrap()[..], 1).unwrap();
    fs::write(packed.join("packed.db3.zstd"), bytes).unwrap();
    check_drive(&describe(&packed, &["packed/packed.db3.zstd"]));
    let mut by_message = whole;
    for message in &mut by_message.messages {
        message.data = zstd::encode_all(&message.data[..], 1).unwrap();
    }
    let undescribed = folder.path().join("by-message");
    fs::create_dir(&undescribed).unwrap();
    by_message.mcap(&undescribed.join("x.mcap"));
    check_drive(&undescribed);
    let beside = crate::open(folder.path()).unwrap();
    let text = "4 folders beside the file of a bag: left out";
    assert_eq!(
        (beside.scenarios.len(), problems(&beside)[0].as_str()),
        (1, text)
    );
    fs::remove_file(single).unwrap();
    let all = crate::open(folder.path()).unwrap();
    assert_eq!(all.scenarios.len(), 4, "a folder of bags");
}

/// Digest of the data of a bag; `None` if it cannot be opened.
fn sha256(bag: &Path) -> Option<String> {
    let scenarios = crate::open(bag).ok()?.scenarios;
    let digests = FileDigests::default();
    Some(crate::content_sha256(&scenarios, None, &digests))
}

#[test]
fn a_flipped_byte_of_any_file_of_a_bag_changes_the_digest() {
    for ending in ["mcap", "db3"] {
        let folder = tempfile::tempdir().unwrap();
        let data = format!("a_0.{ending}");
        match ending {
            "mcap" => drive().mcap(&folder.path().join(&data)),
            _ => drive().sqlite(&folder.path().join(&data)),
        }
        let bag = describe(folder.path(), &[&data]);
        let original = sha256(&bag);
        assert!(original.is_some(), "{ending}");
        for name in [data.as_str(), "metadata.yaml"] {
            let file = bag.join(name);
            let bytes = fs::read(&file).unwrap();
            let mut flipped = bytes.clone();
            flipped[bytes.len() / 2] ^= 1;
            fs::write(&file, flipped).unwrap();
            assert_ne!(sha256(&bag), original, "{name}");
            fs::write(&file, bytes).unwrap();
        }
        assert_eq!(sha256(&bag), original, "{ending}");
    }
}

#[test]
fn a_line_of_the_description_that_is_not_read_changes_the_digest_too() {
    let folder = tempfile::tempdir().unwrap();
    drive().mcap(&folder.path().join("a_0.mcap"));
    let original = sha256(&describe(folder.path(), &["a_0.mcap"]));
    let description = folder.path().join("metadata.yaml");
    let text = fs::read_to_string(&description).unwrap();
    fs::write(&description, format!("{text}  message_count: 93\n")).unwrap();
    check_drive(folder.path());
    assert_ne!(sha256(folder.path()), original);
}

#[test]
fn files_that_a_description_lacks_or_lists_in_vain_are_named() {
    let folder = tempfile::tempdir().unwrap();
    drive().mcap(&folder.path().join("a_0.mcap"));
    drive().mcap(&folder.path().join("b.mcap"));
    let error = crate::open(folder.path()).unwrap_err().to_string();
    assert!(
        error.contains("2 files of bags and no metadata.yaml"),
        "{error}"
    );
    describe(folder.path(), &["a_0.mcap", "a_1.mcap"]);
    let dataset = crate::open(folder.path()).unwrap();
    assert_eq!(
        problems(&dataset)[..2],
        [
            "not listed in metadata.yaml: left out",
            "does not exist, but metadata.yaml lists it: left out"
        ]
    );
    fs::write(folder.path().join("old.bag"), "#ROSBAG V2.0").unwrap();
    let error = crate::open(&folder.path().join("old.bag"))
        .unwrap_err()
        .to_string();
    assert!(error.contains("a bag of ROS 1"), "{error}");
    fs::write(folder.path().join("cut.db3"), "SQLite format 3\0").unwrap();
    let error = crate::open(&folder.path().join("cut.db3"))
        .unwrap_err()
        .to_string();
    assert!(error.contains("cut.db3: SQLite: "), "{error}");
}

/// A scan during which a file is cut off.
struct Cutting<'a>(BagContents, &'a Path);

impl Scan for Cutting<'_> {
    fn declare(&mut self, topic: &BagTopic) -> bool {
        self.0.declare(topic)
    }

    fn take(&mut self, message: BagMessage<'_>) {
        let file = fs::File::options().write(true).open(self.1).unwrap();
        file.set_len(8).unwrap();
        self.0.take(message);
    }

    fn forget(&mut self, file: usize) {
        self.0.forget(file);
    }
}

#[test]
fn sweeps_of_a_file_that_fails_midway_are_not_looked_for_in_the_next() {
    let folder = tempfile::tempdir().unwrap();
    let paths = ["a_0.mcap", "a_1.mcap"].map(|name| folder.path().join(name));
    paths.iter().for_each(|path| drive().mcap(path));
    let mut scan = Cutting(BagContents::of(folder.path()), &paths[0]);
    let mut problems = Vec::new();
    let storage = Storage::open(&paths, &mut scan, &mut problems).unwrap();
    assert_eq!((storage.paths().len(), problems.len()), (1, 1));
    assert_eq!(scan.0.clouds["/points"].len(), 31, "those of the second");
}

#[test]
fn a_bag_without_sweeps_is_refused_with_its_topics_and_one_without_poses_is_read_without() {
    let mut bag = Bag::default();
    bag.text();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("drive.mcap");
    bag.mcap(&path);
    let error = crate::open(&path).unwrap_err().to_string();
    assert!(
        error.contains("no sweep in the bag: expected sensor_msgs/PointCloud2")
            && error.ends_with("its topics: /rosout (rcl_interfaces/msg/Log)"),
        "{error}"
    );
    bag.cloud("/points", "lidar", T0, T0);
    let dataset = opened(&bag);
    assert_eq!(
        problems(&dataset),
        [
            "no poses in the bag: expected nav_msgs/Odometry, geometry_msgs/PoseStamped or PoseWithCovarianceStamped, or \
          tf2_msgs/TFMessage; its topics: /rosout (rcl_interfaces/msg/Log), /points (sensor_msgs/msg/PointCloud2): the \
          sequence is read without poses"
        ]
    );
    assert!(!dataset.scenarios[0].has_poses(0, 0));
}

#[test]
fn poses_of_a_frame_that_is_not_connected_to_the_sweeps_are_not_used() {
    let mut bag = drive();
    bag.messages.remove(1);
    let dataset = opened(&bag);
    assert_eq!(
        problems(&dataset),
        [
            "no pose for any of 31 sweeps of /points (os_sensor) from 1700000000.000 s to 1700000003.000 s: /odom: no transform \
          between base_link and os_sensor, the frame of the sweeps: the sequence is read without poses"
        ]
    );
}

#[test]
fn stamps_of_two_clocks_do_not_meet() {
    let mut bag = Bag::default();
    for step in 0..9 {
        bag.cloud("/points", "lidar", (5 + step) * S, T0 + step * S);
        bag.pose("/pose", "map", T0 + step * S, [0.0; 3]);
    }
    let dataset = opened(&bag);
    let text = "no pose for any of 9 sweeps of /points (lidar) from 5.000 s to 13.000 s: /pose (lidar in map, which the \
                messages do not name), 9 poses from 1700000000.000 s to 1700000008.000 s: the sequence is read without poses";
    assert_eq!(problems(&dataset), [text]);
}

#[test]
fn poses_of_a_map_are_preferred_and_gaps_are_left_out() {
    let mut bag = drive();
    // Half of the drive only, and in another place.
    for step in 0..=30_u64 {
        let nanos = T0 + step * S / 10;
        if !(11..=23).contains(&step) {
            bag.pose("/truth", "map", nanos, [x_at(nanos) + 500.0, 0.0, 0.0]);
        }
        bag.pose("/goal", "map", T0 + 40 * S, [0.0; 3]);
        bag.cloud("/registered", "odom", nanos, nanos);
        bag.transform(
            "/tf",
            ("odom", "base_link"),
            nanos,
            ([x_at(nanos), 0.0, 0.0], 0.0),
        );
    }
    bag.cloud("/rear", "os_sensor", T0 + S, T0 + S);
    let dataset = opened(&bag);
    assert!(largest_error(&dataset, 500.0) < 1e-6);
    assert_eq!(positions(&dataset).len(), 18);
    let text = problems(&dataset);
    assert!(
        text.contains(
            &"/points: 13 of 31 sweeps are in gaps of more than 1.25 s between the poses of /truth (base_link in map, which \
              the messages do not name): left out"
                .to_owned()
        ),
        "{text:?}"
    );
    let join = &dataset.scenarios[0].joins[0];
    for unused in [
        "/odom (base_link in odom), 61 poses",
        "transforms (os_sensor in odom), 31 poses",
        "/rear, 1 clouds",
        "/registered, 31 clouds",
    ] {
        assert!(join.contains(unused), "{join}");
    }
}

#[test]
fn transforms_alone_give_poses_over_several_moving_frames() {
    let mut bag = Bag::default();
    bag.transform(
        "/tf_static",
        ("base_link", "lidar"),
        0,
        ([1.0, 0.0, 2.0], 0.0),
    );
    for step in 0..=30_u64 {
        let nanos = T0 + step * S / 10;
        bag.cloud("/points", "lidar", nanos, nanos);
        bag.transform(
            "/tf",
            ("map", "odom"),
            nanos,
            ([100.0 - x_at(nanos) / 2.0, 0.0, 0.0], 0.0),
        );
        bag.transform(
            "/tf",
            ("odom", "base_link"),
            nanos,
            ([1.5 * x_at(nanos), 0.0, 0.0], 0.0),
        );
    }
    let dataset = opened(&bag);
    assert_eq!(
        (problems(&dataset), positions(&dataset).len()),
        (vec![], 31)
    );
    assert!(largest_error(&dataset, 100.0) < 1e-6);
}

#[test]
fn stamps_of_0_and_sweeps_out_of_order_or_in_another_frame_are_left_out_and_counted() {
    let mut bag = drive();
    bag.cloud("/points", "os_sensor", 0, T0);
    bag.cloud("/points", "os_imu", T0 + S, T0 + S);
    bag.cloud("/points", "os_sensor", T0 + S / 2, T0 + 2 * S);
    bag.odometry("/odom", ("odom", "base_link"), 0, [9.0; 3]);
    let dataset = opened(&bag);
    assert!(largest_error(&dataset, 0.0) < 1e-6);
    let text = problems(&dataset).join("\n");
    for expected in [
        "/points: 1 of 34 sweeps have the stamp 0: left out",
        "/points: 1 of 34 sweeps are not in frame os_sensor, as most are: left out",
        "/points: 1 of 34 sweeps have a stamp that is not between those around it: left out",
        "/odom: 1 of 62 poses have the stamp 0: left out",
    ] {
        assert!(text.contains(expected), "{text}");
    }
}

#[test]
fn sweeps_before_a_clock_was_set_back_never_meet_poses_after_it() {
    let (mut bag, again) = (drive(), drive_at(1000.0));
    // The same stamps once more, a minute later and elsewhere; the recording of the second run is longer.
    for mut message in again.messages {
        message.recorded_nanos += 60 * S;
        bag.messages.push(message);
    }
    for step in 61..=80_u64 {
        let nanos = T0 + step * S / 20;
        bag.odometry(
            "/odom",
            ("odom", "base_link"),
            nanos,
            [1000.0 + x_at(nanos), 0.0, 0.0],
        );
        bag.messages.last_mut().unwrap().recorded_nanos += 60 * S;
        bag.cloud("/points", "os_sensor", nanos, nanos + 60 * S);
    }
    let dataset = opened(&bag);
    let text = problems(&dataset).join("\n");
    assert!(
        text.contains("31 of 82 sweeps are before or after the clock of their stamps was set back"),
        "{text}"
    );
    assert!(
        largest_error(&dataset, 1000.0) < 1e-6 && positions(&dataset).len() == 50,
        "{text}"
    );
}

#[test]
fn messages_that_cannot_be_read_are_counted() {
    let mut bag = drive();
    let last = bag.messages.len() - 1;
    bag.messages[last].data.truncate(6);
    bag.messages[last - 2].data.truncate(20);
    let dataset = opened(&bag);
    let text = problems(&dataset).join("\n");
    assert!(
        text.contains("/points: header.stamp.sec at byte 0 of 2"),
        "{text}"
    );
    assert!(text.contains("the message is left out"), "{text}");
}
