//! Tests of the frames of robots.

use std::f64::consts::FRAC_PI_2;

use protocol::Pose;

use super::*;

const S: u64 = 1_000_000_000;

fn cav() -> CavId {
    CavId::new("1").unwrap()
}

fn add(frames: &RobotFrames, nanos: u64, [parent, child]: [&str; 2], pose: Pose, by: Origin) {
    let transform = Transform {
        nanos,
        parent: parent.into(),
        child: Some(child.into()),
        parent_from_child: pose,
    };
    match by {
        Origin::Odometry => lock(&frames.state).note_odometry(&cav(), &transform),
        by => assert!(lock(&frames.state).tree.add(&transform, by)),
    }
}

/// A robot that has driven 3 m in its odometry frame, with a LiDAR 1 m ahead of its body's origin.
fn robot(mount: Option<&str>) -> RobotFrames {
    let mount = mount.map(|text| text.parse().unwrap());
    let frames = RobotFrames::of([cav()].into_iter(), mount);
    frames.note_lidar(&cav(), "velodyne");
    for (nanos, x) in [(S, 2.0), (2 * S, 4.0)] {
        let pose = Pose::from_xyz_yaw([x, 0.0, 0.0], 0.0);
        add(
            &frames,
            nanos,
            ["odom", "base_link"],
            pose,
            Origin::Odometry,
        );
    }
    frames
}

fn map_from_odom(frames: &RobotFrames) -> Vec<(u64, [f64; 3])> {
    let found = frames.odometry_in_map().into_iter();
    found
        .map(|(nanos, (map, odom, pose))| {
            assert_eq!((map.as_str(), odom.as_str()), ("map", "odom"));
            let [x, y, _] = pose.translation_m;
            (
                nanos,
                [x, y, pose.yaw_rad()].map(|value| (value * 1e9).round() / 1e9),
            )
        })
        .collect()
}

/// The LiDAR is at x 10, y 20 of the map and faces its y axis: the odometry frame is 4 m behind it.
fn facing_y() -> Option<Isometry3<f64>> {
    Some(Pose::from_xyz_yaw([10.0, 20.0, 1.0], FRAC_PI_2).isometry())
}

#[test]
fn map_to_odom_joins_the_pose_with_the_odometry_of_the_time_of_the_sweep() {
    let half = S + S / 2;
    let expected = (
        half + VALID_NANOS,
        [10.0, 16.0, (FRAC_PI_2 * 1e9).round() / 1e9],
    );
    for mount in [Some("1,0,0"), None] {
        let frames = robot(mount);
        if mount.is_none() {
            let pose = Pose::from_xyz_yaw([1.0, 0.0, 0.0], 0.0);
            add(&frames, 0, ["base_link", "velodyne"], pose, Origin::Fixed);
        }
        frames.note_pose(&cav(), half, facing_y());
        assert_eq!(map_from_odom(&frames), [expected]);
        // The robot goes on by its odometry while it has no pose.
        frames.note_pose(&cav(), 2 * S, None);
        assert_eq!(map_from_odom(&frames), [(2 * S + VALID_NANOS, expected.1)]);
        assert_eq!(frames.unplaced(), 0);
    }
}

#[test]
fn a_pose_waits_for_the_odometry_of_its_time_but_not_for_ever() {
    let frames = robot(Some("1,0,0"));
    frames.note_pose(&cav(), 3 * S, facing_y());
    assert_eq!(map_from_odom(&frames), []);
    let pose = Pose::from_xyz_yaw([3.0, 0.0, 0.0], 0.0);
    add(
        &frames,
        3 * S,
        ["odom", "base_link"],
        pose,
        Origin::Odometry,
    );
    assert_eq!(map_from_odom(&frames).len(), 1);
    for k in 0..MOST_WAITING as u64 + 2 {
        frames.note_pose(&cav(), 9 * S + k, facing_y());
    }
    assert_eq!((map_from_odom(&frames), frames.unplaced()), (vec![], 2));
}

#[test]
fn a_lidar_without_a_place_on_the_robot_gives_no_transform() {
    let frames = robot(None);
    frames.note_pose(&cav(), S, facing_y());
    assert_eq!((map_from_odom(&frames), frames.unplaced()), (vec![], 1));
    let logged = lock(&frames.state).robots[&cav()].logged.clone();
    assert!(logged.contains("\"velodyne\" has no parent"), "{logged}");
}

/// Frame of the robot, frame of the LiDAR, and the place of the LiDAR in the former.
fn lidar_in_robot(frames: &RobotFrames) -> FrameInParent {
    frames.lidars_in_robots(&FrameNames::default())[&cav()].clone()
}

#[test]
fn the_lidar_of_the_vehicle_hangs_in_the_tree_of_the_robot() {
    let (parent, child, place) = lidar_in_robot(&robot(None));
    assert_eq!(
        (parent.as_str(), child.as_str()),
        ("velodyne", "cav_1/lidar")
    );
    assert_eq!(place, Pose::IDENTITY);
    let (parent, _, place) = lidar_in_robot(&robot(Some("1,0,0")));
    assert_eq!(
        (parent.as_str(), place.translation_m),
        ("base_link", [1.0, 0.0, 0.0])
    );
}

#[test]
fn two_robots_cannot_have_one_odometry_frame() {
    let other = CavId::new("2").unwrap();
    let frames = RobotFrames::of([cav(), other.clone()].into_iter(), None);
    let transform = Transform {
        nanos: S,
        parent: "odom".into(),
        child: Some("base_link".into()),
        parent_from_child: Pose::IDENTITY,
    };
    for cav in [cav(), other.clone()] {
        lock(&frames.state).note_odometry(&cav, &transform);
    }
    let state = lock(&frames.state);
    assert!(state.robots[&cav()].odom_and_base.is_some());
    assert!(state.robots[&other].logged.contains("another robot"));
}
