use std::f64::consts::PI;

use protocol::Box3d;

use super::*;

const TICK_NANOS: u64 = 100_000_000;

fn detection(x: f64, y: f64, score: f32) -> Detection {
    let box3d = Box3d {
        center_m: [x, y, 0.5],
        size_m: [4.5, 1.9, 1.6],
        heading_rad: 0.0,
    };
    Detection {
        box3d,
        score,
        source: None,
    }
}

/// Tracks after each of some frames at 10 Hz, given by pose and detections.
fn run(
    config: TrackerConfig,
    frames: impl IntoIterator<Item = (Pose, Vec<Detection>)>,
) -> Vec<Vec<Track>> {
    let mut tracker = Tracker::new(config);
    let frames = frames.into_iter().zip(1..);
    frames
        .map(|((pose, detections), tick)| {
            tracker
                .update(tick * TICK_NANOS, &pose, None, &detections)
                .unwrap()
        })
        .collect()
}

fn ids(tracks: &[Track]) -> Vec<u64> {
    tracks.iter().map(|track| track.id).collect()
}

#[test]
fn objects_that_meet_keep_their_identities() {
    // Two vehicles at 15 m/s in opposite lanes, detections in a changing order.
    let frames = (0..60).map(|tick| {
        let along = f64::from(tick) * 1.5 - 45.0;
        let mut detections = vec![detection(along, 0.0, 0.9), detection(-along, 3.5, 0.8)];
        if tick % 2 == 0 {
            detections.reverse();
        }
        (Pose::IDENTITY, detections)
    });
    let tracks = run(TrackerConfig::default(), frames);
    let last = tracks.last().unwrap();
    assert_eq!(ids(last), [1, 2]);
    let [first, second] = [&last[0], &last[1]].map(|track| track.velocity_mps[0]);
    assert!(
        (first.abs() - 15.0).abs() < 0.2 && (first + second).abs() < 0.2,
        "{last:?}"
    );
}

#[test]
fn standing_objects_stand_while_the_ego_drives_and_turns() {
    let objects = [[30.0, 5.0], [60.0, -8.0]];
    let frames = (0..40).map(|tick| {
        let time = f64::from(tick) / 10.0;
        let pose = Pose::from_xyz_yaw([12.0 * time, time * time, 0.0], 0.3 * time);
        let ego_from_world = pose.isometry().inverse();
        let in_ego = objects.map(|[x, y]| {
            let seen = detection(x, y, 0.9);
            let box3d = seen.box3d.transformed(&ego_from_world);
            Detection { box3d, ..seen }
        });
        (pose, in_ego.to_vec())
    });
    let tracks = run(TrackerConfig::default(), frames);
    let last = Pose::from_xyz_yaw([12.0 * 3.9, 3.9 * 3.9, 0.0], 0.3 * 3.9);
    for (track, [x, y]) in tracks.last().unwrap().iter().zip(objects) {
        let in_world = track.box3d.transformed(&last.isometry());
        assert!((in_world.center_m[0] - x).hypot(in_world.center_m[1] - y) < 1e-6);
        assert!(track.velocity_mps[0].hypot(track.velocity_mps[1]) < 1e-6);
        assert!(in_world.heading_rad.abs() < 1e-6);
    }
    assert_eq!(ids(&tracks[39]), [1, 2]);
}

#[test]
fn a_missing_detection_counts_against_an_object_in_view_only() {
    let config = TrackerConfig {
        area_m: [-50.0, -20.0, 50.0, 20.0],
        ..TrackerConfig::default()
    };
    let frames = (0..20).map(|tick| {
        let seen = vec![detection(10.0, 0.0, 0.9), detection(60.0, 0.0, 0.9)];
        (Pose::IDENTITY, if tick < 5 { seen } else { vec![] })
    });
    let tracks = run(config, frames);
    assert_eq!(ids(&tracks[4]), [1, 2]);
    assert_eq!(
        ids(&tracks[6]),
        [1, 2],
        "two misses do not end a sure track"
    );
    assert_eq!(ids(&tracks[12]), [2]);
    assert!((tracks[12][0].unseen_s - 0.8).abs() < 1e-9);
    assert!(tracks[16].is_empty(), "followed for longer than a second");
}

#[test]
fn an_identity_is_not_used_again_and_a_weak_detection_begins_no_track() {
    let frames = (0..40).map(|tick| {
        let seen = match tick {
            0..5 | 30.. => vec![detection(10.0, 0.0, 0.9)],
            _ => vec![detection(10.0, 0.0, 0.05)],
        };
        (
            Pose::IDENTITY,
            if (10..30).contains(&tick) {
                vec![]
            } else {
                seen
            },
        )
    });
    let tracks = run(TrackerConfig::default(), frames);
    assert_eq!((ids(&tracks[4]), ids(&tracks[39])), (vec![1], vec![2]));
    let weak = (0..5).map(|_| (Pose::IDENTITY, vec![detection(0.0, 0.0, 0.09)]));
    assert!(
        run(TrackerConfig::default(), weak)
            .iter()
            .all(Vec::is_empty)
    );
}

#[test]
fn front_and_rear_are_distinguished_by_a_clear_motion() {
    let frames = (0..30).map(|tick| {
        let mut seen = detection(f64::from(tick), 0.0, 0.9);
        // Every detection but each fourth has the front at the rear.
        seen.box3d.heading_rad = if tick % 4 == 0 { 0.05 } else { PI - 0.05 };
        (Pose::IDENTITY, vec![seen])
    });
    let tracks = run(TrackerConfig::default(), frames);
    assert!(tracks[29][0].box3d.heading_rad.abs() < 0.06, "{tracks:?}");
}

/// Identities after a pose that jumps by 4 m to the side.
fn ids_after_jump(covariance: Option<&PlanarCovariance>) -> Vec<u64> {
    let mut tracker = Tracker::new(TrackerConfig::default());
    let mut tracks = Vec::new();
    for tick in 1..=20 {
        let pose = Pose::from_xyz_yaw([0.0, if tick < 20 { 0.0 } else { 4.0 }, 0.0], 0.0);
        let detections = [detection(20.0, 0.0, 0.9)];
        tracks = tracker
            .update(tick * TICK_NANOS, &pose, covariance, &detections)
            .unwrap();
    }
    ids(&tracks)
}

#[test]
fn an_uncertain_pose_widens_the_gate() {
    let covariance = PlanarCovariance {
        xx_m2: 4.0,
        xy_m2: 0.0,
        yy_m2: 4.0,
        yaw_rad2: 0.0,
    };
    assert_eq!(ids_after_jump(Some(&covariance)), [1]);
    assert_eq!(ids_after_jump(None), [1, 2]);
}

#[test]
fn time_that_does_not_advance_and_a_broken_pose_change_nothing() {
    let mut tracker = Tracker::new(TrackerConfig::default());
    let seen = [detection(5.0, 0.0, 0.9)];
    let nan = Pose {
        translation_m: [f64::NAN, 0.0, 0.0],
        ..Pose::IDENTITY
    };
    let here = Pose::IDENTITY;
    tracker.update(TICK_NANOS, &here, None, &seen).unwrap();
    for given_nanos in [0, TICK_NANOS] {
        assert_eq!(tracker.update(given_nanos, &here, None, &seen), None);
    }
    assert_eq!(tracker.update(2 * TICK_NANOS, &nan, None, &seen), None);
    let tracks = tracker.update(2 * TICK_NANOS, &here, None, &seen).unwrap();
    assert_eq!((ids(&tracks), tracks[0].hits), (vec![1], 2));
    // A pause of a century ends tracks, and numbers stay finite.
    let tracks = tracker.update(u64::MAX, &here, None, &seen).unwrap();
    assert_eq!(ids(&tracks), [2]);
}

#[test]
fn detections_that_are_none_are_counted_and_the_others_are_taken() {
    let mut tracker = Tracker::new(TrackerConfig::default());
    let detections = [
        detection(f64::NAN, 0.0, 0.9),
        detection(5.0, 0.0, 0.9),
        detection(9.0, 0.0, f32::INFINITY),
    ];
    let tracks = tracker
        .update(1, &Pose::IDENTITY, None, &detections)
        .unwrap();
    assert_eq!((tracks.len(), tracker.left_out), (1, 2));
}

#[test]
fn velocity_and_covariance_are_along_the_axes_of_the_ego() {
    // The ego looks along y of the world, and so does the object move, at 6 m/s.
    let pose = Pose::from_xyz_yaw([50.0, 20.0, 0.0], PI / 2.0);
    let covariance = PlanarCovariance {
        xx_m2: 0.0,
        xy_m2: 0.0,
        yy_m2: 1.0,
        yaw_rad2: 0.0,
    };
    let mut tracker = Tracker::new(TrackerConfig::default());
    let mut tracks = Vec::new();
    for tick in 1..=40_u32 {
        let seen = [detection(0.6 * f64::from(tick), 3.0, 0.9)];
        let nanos = u64::from(tick) * TICK_NANOS;
        tracks = tracker
            .update(nanos, &pose, Some(&covariance), &seen)
            .unwrap();
    }
    let track = &tracks[0];
    assert!((track.velocity_mps[0] - 6.0).abs() < 0.1 && track.velocity_mps[1].abs() < 0.1);
    assert!((track.box3d.center_m[0] - 24.0).hypot(track.box3d.center_m[1] - 3.0) < 0.1);
    let [x, y, u, v] = track.covariance;
    assert!(
        x[0] > 2.0 * y[1] && u[2] > 1.5 * v[3] && x[2] > 0.0,
        "{track:?}"
    );
    assert!((track.age_s - 3.9).abs() < 1e-9 && track.unseen_s == 0.0);
}

/// A hundred detections beside each other, the farther the higher the score.
fn row_of_detections(offset: f64) -> Vec<Detection> {
    let seen = (0..100_u16).map(|k| {
        let (x, score) = (f64::from(k) * 10.0, 0.3 + f32::from(k) / 200.0);
        detection(x, offset, score)
    });
    seen.collect()
}

#[test]
fn detections_beyond_the_largest_number_are_counted_and_those_of_the_highest_scores_are_taken() {
    let config = TrackerConfig {
        max_detections: 30,
        max_tracks: 40,
        ..TrackerConfig::default()
    };
    let mut tracker = Tracker::new(config);
    let seen = row_of_detections(0.0);
    let tracks = tracker.update(TICK_NANOS, &Pose::IDENTITY, None, &seen);
    let tracks = tracks.unwrap();
    assert_eq!((tracks.len(), tracker.left_out), (30, 70));
    let least = tracks.iter().map(|track| track.box3d.center_m[0]);
    assert_eq!(least.fold(f64::INFINITY, f64::min), 700.0);
    // All 30 are new objects; there is room for 10.
    let seen = row_of_detections(500.0);
    let tracks = tracker.update(2 * TICK_NANOS, &Pose::IDENTITY, None, &seen);
    let tracks = tracks.unwrap();
    assert_eq!((tracks.len(), tracker.left_out), (40, 160));
    let new = tracks
        .iter()
        .filter(|track| track.hits == 1 && track.unseen_s == 0.0);
    let least = new.map(|track| track.box3d.center_m[0]);
    assert_eq!(least.fold(f64::INFINITY, f64::min), 900.0);
}

fn result(pose: PoseEstimate) -> Detections {
    Detections {
        ego: protocol::CavId::new("7").unwrap(),
        agent_frame: 4,
        method: "max".into(),
        pose,
        detections: vec![detection(5.0, 0.0, 0.9), detection(f64::NAN, 0.0, 0.9)],
        fused: vec![],
        skipped: vec![],
        neighbours: vec![],
        stages: vec![],
    }
}

#[test]
fn results_are_followed_through_frames_without_pose_and_scenes_that_begin_again() {
    let posed = result(PoseEstimate::new(Pose::IDENTITY, 0.9));
    let unposed = result(PoseEstimate::NoPose {
        reason: protocol::NoPoseReason::TooFewPoints,
        inlier_count: 0,
    });
    let mut tracker = Tracker::new(TrackerConfig::default());
    let found = [
        (1, &posed),
        (2, &unposed),
        (3, &posed),
        (3, &posed),
        (3, &unposed),
        (2, &posed),
    ];
    let found = found.map(|(tick, result)| tracker.follow(tick * TICK_NANOS, result));
    assert_eq!(
        found.clone().map(|frame| ids(&frame.tracks)),
        [vec![1], vec![], vec![1], vec![1], vec![], vec![2]],
        "a repeated frame changes nothing, an earlier one ends all tracks"
    );
    assert_eq!(
        found.clone().map(|frame| frame.left_out),
        [1, 0, 1, 0, 0, 1]
    );
    assert_eq!((found[2].agent_frame, found[1].pose), (4, unposed.pose));
}

#[test]
fn equal_inputs_give_equal_tracks() {
    let frames = (0..50).map(|tick| {
        let time = f64::from(tick);
        let seen = (0..20).map(|k| {
            let k = f64::from(k);
            detection(
                (k * 37.0 + time * k / 9.0) % 80.0 - 40.0,
                (k * 3.3) % 40.0 - 20.0,
                0.6,
            )
        });
        (
            Pose::from_xyz_yaw([time, 0.0, 0.0], 0.01 * time),
            seen.collect::<Vec<_>>(),
        )
    });
    let tracks = run(TrackerConfig::default(), frames.clone());
    assert_eq!(tracks, run(TrackerConfig::default(), frames));
    assert!(
        tracks
            .iter()
            .flatten()
            .all(|track| (0.0..=1.0).contains(&track.score))
    );
}
