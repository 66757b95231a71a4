//! Tests of the pose tracker on simulated drives.

use nalgebra::{Translation3, UnitQuaternion};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

use super::*;

const TENTH_NANOS: u64 = 100_000_000;
const MAX_COAST_S: f64 = 3.0;

/// Pose of the rear axle on a drive at 10 m/s through bends, 500 km from the origin.
fn truth(sweep: u64) -> Isometry3<f64> {
    let (mut x, mut y, mut yaw) = (500_000.0, 5_700_000.0, 0.0_f64);
    for step in 0..sweep * 10 {
        yaw += 0.01 * 0.3 * (step as f64 * 0.005).sin();
        x += 0.01 * 10.0 * yaw.cos();
        y += 0.01 * 10.0 * yaw.sin();
    }
    let height = 2.0 + 0.02 * sweep as f64;
    Isometry3::from_parts(
        Translation3::new(x, y, height),
        UnitQuaternion::from_euler_angles(0.0, 0.0, yaw),
    )
}

fn measured(sweep: u64, off_m: [f64; 2], position_std_m: f64) -> PoseMeasurement {
    let mut world_from_lidar = truth(sweep);
    world_from_lidar.translation.x += off_m[0];
    world_from_lidar.translation.y += off_m[1];
    PoseMeasurement {
        capture_nanos: sweep * TENTH_NANOS,
        world_from_lidar,
        position_std_m,
        yaw_std_rad: 0.002,
    }
}

/// Motion as a vehicle on the drive measures it, with a biased gyroscope.
fn motion(sweep: u64, bias_rad_s: f64) -> EgoMotion {
    let [before_rad, yaw_rad] =
        [sweep.saturating_sub(1), sweep].map(|sweep| truth(sweep).rotation.euler_angles().2);
    EgoMotion {
        speed_mps: Some(10.0),
        yaw_rate_rad_s: Some((yaw_rad - before_rad) / 0.1 + bias_rad_s),
    }
}

/// Largest position error (metres) and yaw error (radians) of the predictions of sweeps 60 to 200, a fourth of which are
/// measured, of a LiDAR ahead of the rear axle.
fn worst(motion: impl Fn(u64) -> EgoMotion, lever_m: f64) -> [f64; 2] {
    let lever = Translation3::new(lever_m, 0.0, 0.0);
    worst_at(motion, |sweep| truth(sweep) * lever)
}

/// The same of a LiDAR at these poses.
fn worst_at(
    motion: impl Fn(u64) -> EgoMotion,
    world_from_lidar: impl Fn(u64) -> Isometry3<f64>,
) -> [f64; 2] {
    let mut tracker = PoseTracker::new(MAX_COAST_S);
    let mut worst: [f64; 2] = [0.0; 2];
    for sweep in 0..200 {
        let state = tracker.predict(sweep * TENTH_NANOS, &motion(sweep));
        let world_from_lidar = world_from_lidar(sweep);
        if let Some(state) = state.filter(|_| sweep >= 60) {
            let off = world_from_lidar.inv_mul(&state.world_from_lidar);
            worst = [
                worst[0].max(off.translation.vector.xy().norm()),
                worst[1].max(off.rotation.angle()),
            ];
        }
        if sweep % 4 == 0 || tracker.needs_measurement() {
            tracker.correct(&PoseMeasurement {
                world_from_lidar,
                ..measured(sweep, [0.0; 2], 0.02)
            });
        }
    }
    worst
}

/// Planar error of the state, metres.
fn error_m(state: &TrackedState, sweep: u64) -> f64 {
    (state.world_from_lidar.translation.vector - truth(sweep).translation.vector)
        .xy()
        .norm()
}

/// Follows the drive with a measurement in every second sweep; error and bound of every prediction.
fn followed(tracker: &mut PoseTracker, sweeps: std::ops::Range<u64>, seed: u64) -> Vec<(f64, f64)> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let noise = Normal::new(0.0, 0.1).unwrap();
    let mut results = Vec::new();
    for sweep in sweeps {
        if let Some(state) = tracker.predict(sweep * TENTH_NANOS, &EgoMotion::default()) {
            results.push((error_m(&state, sweep), state.covariance.bound_95_m()));
        }
        if sweep % 2 == 0 {
            let off_m = [noise.sample(&mut random), noise.sample(&mut random)];
            tracker.correct(&measured(sweep, off_m, 0.1));
        }
    }
    results
}

fn mean(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len() as f64;
    values.sum::<f64>() / count
}

#[test]
fn predictions_are_about_as_good_as_measurements_and_stay_within_their_bounds() {
    let (mut errors, mut exceeded) = (Vec::new(), 0);
    for seed in 0..20 {
        let results = followed(&mut PoseTracker::new(MAX_COAST_S), 0..100, seed);
        // One pose says nothing of the speed: the second measurement starts again, with it.
        assert_eq!(results.len(), 98);
        let settled = &results[20..];
        errors.extend(settled.iter().map(|(error_m, _)| *error_m));
        exceeded += settled
            .iter()
            .filter(|(error_m, bound_m)| error_m > bound_m)
            .count();
    }
    // A measurement is off by 0.1 m in each of two axes: 0.125 m in the mean.
    assert!(
        mean(errors.iter().copied()) < 0.15,
        "{}",
        mean(errors.iter().copied())
    );
    assert!(
        (exceeded as f64) < 0.05 * errors.len() as f64,
        "{exceeded} of {}",
        errors.len()
    );
}

/// Error of the prediction after one measurement, metres.
fn second_error_m(motion: &EgoMotion) -> Option<f64> {
    let mut tracker = PoseTracker::new(MAX_COAST_S);
    tracker.predict(0, motion);
    tracker.correct(&measured(0, [0.0; 2], 0.05));
    tracker
        .predict(TENTH_NANOS, motion)
        .map(|state| error_m(&state, 1))
}

#[test]
fn the_speed_that_the_vehicle_measures_is_used() {
    let speed = EgoMotion {
        speed_mps: Some(10.0),
        yaw_rate_rad_s: None,
    };
    // The first pose says nothing of the speed.
    assert!(second_error_m(&speed).unwrap() < 0.1);
    assert!(second_error_m(&EgoMotion::default()).unwrap() > 0.9);
}

#[test]
fn a_yaw_rate_keeps_the_prediction_from_lagging_in_bends() {
    let without = worst(
        |sweep| EgoMotion {
            yaw_rate_rad_s: None,
            ..motion(sweep, 0.0)
        },
        0.0,
    );
    // A bias of 0.6 degrees/s is estimated.
    let with = worst(|sweep| motion(sweep, 0.01), 0.0);
    assert!(
        without[1] > 0.01 && with[1] < 0.002 && with[0] < 0.02,
        "{without:?} {with:?}"
    );
    let broken = worst(
        |sweep| EgoMotion {
            yaw_rate_rad_s: Some(f64::NAN),
            ..motion(sweep, 0.0)
        },
        0.0,
    );
    assert_eq!(broken, without, "no yaw rate");
}

#[test]
fn a_lidar_ahead_of_the_rear_axle_is_swung_aside_in_bends() {
    let [off_m, off_rad] = worst(|sweep| motion(sweep, 0.0), 2.0);
    // Without the lever: 0.3 rad/s at 2 m for 0.4 s are 0.24 m.
    assert!(off_m < 0.04 && off_rad < 0.002, "{off_m} m, {off_rad} rad");
}

#[test]
fn a_turned_lidar_is_followed_ahead_and_in_reverse() {
    let reversing = |sweep: u64| EgoMotion {
        speed_mps: Some(-10.0),
        yaw_rate_rad_s: motion(201 - sweep, 0.0).yaw_rate_rad_s.map(|rate| -rate),
    };
    for degrees in [4.0_f64, 20.0, 90.0] {
        let turn = UnitQuaternion::from_euler_angles(0.0, 0.0, degrees.to_radians());
        let [ahead_m, _] = worst_at(|sweep| motion(sweep, 0.0), |sweep| truth(sweep) * turn);
        let [reverse_m, _] = worst_at(reversing, |sweep| truth(200 - sweep) * turn);
        assert!(
            ahead_m < 0.03 && reverse_m < 0.03,
            "{degrees} degrees: {ahead_m} m, in reverse {reverse_m} m"
        );
    }
}

/// Tracker after thirty seconds at changing speed through turns, with a speed and a yaw rate of some sweeps before.
fn driven_late([speed_late, yaw_rate_late]: [u64; 2]) -> PoseTracker {
    let speed_mps = |sweep: u64| 8.0 + 4.0 * (0.06 * sweep as f64).sin();
    let yaw_rate_rad_s = |sweep: u64| if sweep % 50 < 15 { 0.4 } else { 0.0 };
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let noise = Normal::new(0.0, 0.03).unwrap();
    let mut tracker = PoseTracker::new(MAX_COAST_S);
    let mut pose = Isometry3::identity();
    for sweep in 0..300_u64 {
        pose.rotation *= UnitQuaternion::from_euler_angles(0.0, 0.0, 0.1 * yaw_rate_rad_s(sweep));
        pose *= Translation3::new(0.1 * speed_mps(sweep), 0.0, 0.0);
        let motion = EgoMotion {
            speed_mps: Some(speed_mps(sweep.saturating_sub(speed_late))),
            yaw_rate_rad_s: Some(yaw_rate_rad_s(sweep.saturating_sub(yaw_rate_late))),
        };
        tracker.predict(sweep * TENTH_NANOS, &motion);
        if sweep % 4 == 0 || tracker.needs_measurement() {
            let mut world_from_lidar = pose;
            world_from_lidar.translation.x += noise.sample(&mut random);
            world_from_lidar.translation.y += noise.sample(&mut random);
            tracker.correct(&PoseMeasurement {
                world_from_lidar,
                ..measured(sweep, [0.0; 2], 0.03)
            });
        }
    }
    tracker
}

#[test]
fn a_late_speed_and_a_late_yaw_rate_are_named_and_not_used() {
    for (late, is_refuted) in [
        ([0, 0], [false, false]),
        ([1, 0], [false, false]),
        ([10, 0], [true, false]),
        ([0, 3], [false, true]),
    ] {
        let refuted = driven_late(late).refuted();
        assert_eq!(
            refuted.map(|of| of.is_some()),
            is_refuted,
            "{late:?} sweeps late: {refuted:?}"
        );
    }
}

#[test]
fn a_gyroscope_that_fails_does_not_lose_the_vehicle() {
    for rate in [0.0, -0.3] {
        let [off_m, _] = worst(
            |sweep| EgoMotion {
                yaw_rate_rad_s: Some(rate),
                ..motion(sweep, 0.0)
            },
            0.0,
        );
        assert!(off_m < 1.0, "{rate} rad/s: {off_m} m");
    }
}

#[test]
fn a_wrong_pose_does_not_pull_the_state_off() {
    let mut tracker = PoseTracker::new(MAX_COAST_S);
    followed(&mut tracker, 0..40, 1);
    let predicted = tracker
        .predict(40 * TENTH_NANOS, &EgoMotion::default())
        .unwrap();
    assert_eq!(
        tracker.correct(&measured(40, [30.0, 0.0], 0.1)),
        Correction::Rejected
    );
    let doubted = tracker.state().unwrap();
    assert_eq!(doubted.world_from_lidar, predicted.world_from_lidar);
    assert!(
        tracker.is_contradicted() && doubted.covariance.bound_95_m() > 30.0,
        "one of both is right"
    );
    tracker
        .predict(41 * TENTH_NANOS, &EgoMotion::default())
        .unwrap();
    assert_eq!(
        tracker.correct(&measured(41, [0.1, 0.0], 0.1)),
        Correction::Accepted
    );
    assert!(tracker.state().unwrap().covariance.bound_95_m() < 1.0);
    tracker
        .predict(42 * TENTH_NANOS, &EgoMotion::default())
        .unwrap();
    let mut turned = measured(42, [0.0; 2], 0.1);
    turned.world_from_lidar.rotation *= UnitQuaternion::from_euler_angles(0.0, 0.0, 1.0);
    assert_eq!(tracker.correct(&turned), Correction::Rejected);
    let yaw_std_rad = tracker.state().unwrap().covariance.yaw_rad2.sqrt();
    assert!((0.4..0.6).contains(&yaw_std_rad), "{yaw_std_rad} rad");
}

#[test]
fn a_vehicle_that_was_carried_away_is_found_again() {
    let mut tracker = PoseTracker::new(MAX_COAST_S);
    followed(&mut tracker, 0..40, 1);
    let corrections: Vec<Correction> = (40..43)
        .map(|sweep| {
            tracker.predict(sweep * TENTH_NANOS, &EgoMotion::default());
            tracker.correct(&measured(sweep, [200.0, 0.0], 0.1))
        })
        .collect();
    assert_eq!(
        corrections,
        [
            Correction::Rejected,
            Correction::Rejected,
            Correction::Relocated
        ]
    );
    let state = tracker
        .predict(43 * TENTH_NANOS, &EgoMotion::default())
        .unwrap();
    assert!((error_m(&state, 43) - 200.0).abs() < 2.0);
    // Poses of random places agree on none of them.
    for sweep in 43..47 {
        tracker.predict(sweep * TENTH_NANOS, &EgoMotion::default());
        let off_m = [
            1000.0 * (sweep as f64).sin(),
            900.0 * (3.0 * sweep as f64).cos(),
        ];
        assert_eq!(
            tracker.correct(&measured(sweep, off_m, 0.1)),
            Correction::Rejected
        );
    }
}

#[test]
fn without_measurements_the_bound_grows_until_the_vehicle_is_lost() {
    let mut tracker = PoseTracker::new(MAX_COAST_S);
    followed(&mut tracker, 0..40, 1);
    let mut bounds = Vec::new();
    for sweep in 40..80 {
        match tracker.predict(sweep * TENTH_NANOS, &EgoMotion::default()) {
            Some(state) => {
                assert!(error_m(&state, sweep) < state.covariance.bound_95_m().max(0.5));
                bounds.push(state.covariance.bound_95_m());
            }
            None => break,
        }
    }
    assert!(bounds.windows(2).all(|pair| pair[1] > pair[0]));
    assert!((5..32).contains(&bounds.len()), "{}", bounds.len());
    assert_eq!(
        tracker.correct(&measured(80, [0.0; 2], 0.1)),
        Correction::Started
    );
}

#[test]
fn a_tunnel_and_a_restarted_scene_end_the_track() {
    let mut tracker = PoseTracker::new(MAX_COAST_S);
    followed(&mut tracker, 0..40, 1);
    assert_eq!(
        tracker.predict(140 * TENTH_NANOS, &EgoMotion::default()),
        None,
        "ten seconds without a sweep"
    );
    assert_eq!(
        tracker.correct(&measured(140, [0.0; 2], 0.1)),
        Correction::Started
    );
    assert!(
        tracker
            .predict(141 * TENTH_NANOS, &EgoMotion::default())
            .is_some()
    );
    assert_eq!(
        tracker.predict(0, &EgoMotion::default()),
        None,
        "the clock went back"
    );
}

/// Follows the drive with a measurement in every fourth sweep, at the speed that `measures_mps` makes of the true one.
/// Position errors and bounds of all predictions, and the tracker at the end.
fn driven_at_speeds(
    measures_mps: impl Fn(f64) -> f64,
    seed: u64,
) -> (Vec<(f64, f64)>, PoseTracker) {
    let mut tracker = PoseTracker::new(MAX_COAST_S);
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let noise = Normal::new(0.0, 0.03).unwrap();
    let mut results = Vec::new();
    for sweep in 0..120 {
        let motion = EgoMotion {
            speed_mps: Some(measures_mps(10.0)),
            ..motion(sweep, 0.0)
        };
        if let Some(state) = tracker.predict(sweep * TENTH_NANOS, &motion) {
            results.push((error_m(&state, sweep), state.covariance.bound_95_m()));
        }
        if sweep % 4 == 0 || tracker.needs_measurement() {
            let off_m = [noise.sample(&mut random), noise.sample(&mut random)];
            tracker.correct(&measured(sweep, off_m, 0.03));
        }
    }
    (results, tracker)
}

/// Mean error (metres) and share of the errors beyond their bounds over some drives at these speeds.
fn errors_at_speeds(measures_mps: impl Fn(f64) -> f64) -> (f64, f64) {
    let results: Vec<(f64, f64)> = (0..10)
        .flat_map(|seed| driven_at_speeds(&measures_mps, seed).0)
        .collect();
    let exceeded = results
        .iter()
        .map(|(error_m, bound_m)| f64::from(error_m > bound_m));
    (
        mean(results.iter().map(|(error_m, _)| *error_m)),
        mean(exceeded),
    )
}

#[test]
fn the_bound_holds_at_any_scale_of_the_speed_and_without_it() {
    let (right_m, _) = errors_at_speeds(|speed| speed);
    for scale in [0.95, 1.0, 1.05, 1.3, 0.0, 2.0, 3.6, -1.0] {
        let (error_m, exceeded) = errors_at_speeds(|speed| scale * speed);
        assert!(exceeded <= 0.05, "{scale}: {exceeded} beyond the bound");
        assert!(
            error_m < 0.3,
            "{scale}: {error_m} m, {right_m} m with the right speed"
        );
    }
    assert!(right_m < 0.06, "{right_m}");
}

#[test]
fn a_speed_that_poses_contradict_is_named_and_one_of_a_slightly_wrong_scale_is_not() {
    for (scale, is_refuted) in [
        (1.0, false),
        (1.05, false),
        (1.3, false),
        (0.0, true),
        (3.6, true),
        (-1.0, true),
    ] {
        let (_, tracker) = driven_at_speeds(|speed| scale * speed, 1);
        let [refuted, _] = tracker.refuted();
        assert_eq!(refuted.is_some(), is_refuted, "{scale}: {refuted:?}");
        if let Some(refuted) = refuted {
            assert!((refuted.of_poses - 10.0).abs() < 1.0, "{refuted:?}");
        }
    }
}

/// Follows the drive with a measurement in every fourth sweep, at the yaw rate that `measures` makes of the true one
/// (radians per second). Yaw errors of all predictions, radians, and the tracker at the end.
fn driven_at_yaw_rates(measures: impl Fn(f64) -> f64) -> (Vec<f64>, PoseTracker) {
    let mut tracker = PoseTracker::new(MAX_COAST_S);
    let mut errors = Vec::new();
    for sweep in 0..120 {
        let right = motion(sweep, 0.0);
        let motion = EgoMotion {
            yaw_rate_rad_s: right.yaw_rate_rad_s.map(&measures),
            ..right
        };
        if let Some(state) = tracker.predict(sweep * TENTH_NANOS, &motion) {
            let off = truth(sweep).inv_mul(&state.world_from_lidar);
            errors.push(off.rotation.angle());
        }
        if sweep % 4 == 0 || tracker.needs_measurement() {
            tracker.correct(&measured(sweep, [0.0; 2], 0.03));
        }
    }
    (errors, tracker)
}

#[test]
fn a_yaw_rate_that_poses_contradict_is_named_and_not_used() {
    type Measured = fn(f64) -> f64;
    let rates: [(Measured, bool); 6] = [
        (|rate| rate, false),
        (|rate| rate + 0.01, false),
        (|rate| 1.05 * rate, false),
        (|rate| -rate, true),
        (f64::to_degrees, true),
        (f64::to_radians, true),
    ];
    for (measures, is_refuted) in rates {
        let (errors, mut tracker) = driven_at_yaw_rates(measures);
        let [speed, yaw_rate] = tracker.refuted();
        assert_eq!(
            (speed, yaw_rate.is_some()),
            (None, is_refuted),
            "{yaw_rate:?}"
        );
        let worst = errors[60..].iter().copied().fold(0.0, f64::max);
        assert!(worst < 0.03, "{worst} rad, {yaw_rate:?}");
        tracker.begin();
        assert_eq!(tracker.refuted(), [None; 2], "another vehicle");
    }
}
