//! Tracks of simulated traffic: four lanes seen by a driving ego, with noise, missed vehicles and false alarms.

use std::collections::BTreeMap;

use nalgebra::{Matrix2, Point3, Vector2};
use protocol::{Box3d, Detection, Pose, PoseEstimate};
use tracking::metrics::{Sequence, TrackPoint, TrackQuality, TrackedFrame, TruePoint};
use tracking::{Tracker, TrackerConfig};

const AREA_M: [f64; 4] = [-50.0, -40.0, 50.0, 40.0];
const FRAMES: u32 = 150;

/// Uniform numbers of 0..1 from a linear congruential generator.
struct Draws(u64);

impl Draws {
    fn next(&mut self) -> f64 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.next()
    }
}

fn detection([x, y]: [f64; 2], score: f64) -> Detection {
    let box3d = Box3d {
        center_m: [x, y, 0.0],
        size_m: [4.5, 1.9, 1.6],
        heading_rad: 0.0,
    };
    Detection {
        box3d,
        score: score as f32,
        source: None,
    }
}

/// Position of a vehicle in the world at a time: lanes at 0, 3.5, 7 and 10.5 m, two in each direction.
fn vehicle(id: i64, time_s: f64) -> [f64; 2] {
    let (lane, place) = (id % 4, (id / 4) as f64);
    [
        place * 14.0 - 40.0 + velocity_mps(id)[0] * time_s,
        lane as f64 * 3.5,
    ]
}

fn velocity_mps(id: i64) -> [f64; 2] {
    [[9.0, 12.0, -8.0, -13.0][(id % 4) as usize], 0.0]
}

/// Pose of the ego and its LiDAR frame, the vehicles in its area, and their detections with the vehicle of each.
fn frame(tick: u32, miss: f64, draws: &mut Draws) -> (Pose, Vec<TruePoint>, Vec<(i64, Detection)>) {
    let time_s = f64::from(tick) / 10.0;
    let world_from_ego = Pose::from_xyz_yaw([10.0 * time_s, 2.0, 0.0], 0.02 * time_s);
    let ego_from_world = world_from_ego.isometry().inverse();
    let (mut objects, mut detections) = (Vec::new(), Vec::new());
    for id in 0..48 {
        let [x, y] = vehicle(id, time_s);
        let seen = ego_from_world * Point3::new(x, y, 0.0);
        if seen.x.abs() > 48.0 || seen.y.abs() > 38.0 {
            continue;
        }
        objects.push(TruePoint {
            id,
            center_m: [seen.x, seen.y],
        });
        let noise = [draws.between(-0.4, 0.4), draws.between(-0.4, 0.4)];
        if draws.next() >= miss {
            let center = [seen.x + noise[0], seen.y + noise[1]];
            detections.push((id, detection(center, draws.between(0.5, 0.95))));
        }
    }
    (world_from_ego, objects, detections)
}

fn quality(miss: f64, false_alarms: f64) -> TrackQuality {
    let mut draws = Draws(11);
    let mut sequence = Sequence::default();
    let mut tracker = Tracker::new(TrackerConfig {
        area_m: AREA_M,
        ..TrackerConfig::default()
    });
    for tick in 0..FRAMES {
        let (world_from_ego, objects, detections) = frame(tick, miss, &mut draws);
        let mut detections: Vec<Detection> = detections.into_iter().map(|(_, one)| one).collect();
        while draws.next() < false_alarms {
            let center = [draws.between(-48.0, 48.0), draws.between(-38.0, 38.0)];
            detections.push(detection(center, draws.between(0.2, 0.6)));
        }
        let tracks = tracker
            .update(
                u64::from(tick + 1) * 100_000_000,
                &world_from_ego,
                None,
                &detections,
            )
            .unwrap();
        let in_ego = tracks.iter().map(|track| TrackPoint {
            id: track.id,
            center_m: [track.box3d.center_m[0], track.box3d.center_m[1]],
            score: track.score,
        });
        let tracks = in_ego
            .filter(|track| track.center_m[0].abs() <= 48.0 && track.center_m[1].abs() <= 38.0)
            .collect();
        sequence.add(TrackedFrame { objects, tracks }).unwrap();
    }
    TrackQuality::of(&[sequence])
}

#[test]
fn good_detections_give_whole_tracks() {
    let quality = quality(0.0, 0.0);
    assert!(
        quality.amota > Some(0.97) && quality.hota > Some(0.8),
        "{quality:?}"
    );
    assert_eq!((quality.ids, quality.frag), (Some(0), Some(0)));
    assert!(
        quality.motp_m < Some(0.3),
        "the filter is no worse than its input: {quality:?}"
    );
}

#[test]
fn misses_and_false_alarms_cost_few_identities() {
    let quality = quality(0.2, 0.6);
    assert!(
        quality.amota > Some(0.85) && quality.idf1 > Some(0.85),
        "{quality:?}"
    );
    // 6 among 2,746 points when this was written.
    assert!(quality.ids <= Some(10), "{quality:?}");
}

#[test]
fn a_stated_track_is_that_of_its_detection_and_its_velocity_is_within_its_covariance() {
    let (mut draws, mut tracker) = (Draws(5), Tracker::default());
    let mut vehicle_of = BTreeMap::new();
    let (mut changes, mut normalised) = (0, Vec::new());
    for tick in 0..FRAMES {
        let (world_from_ego, _, detections) = frame(tick, 0.1, &mut draws);
        let (ids, found): (Vec<i64>, Vec<Detection>) = detections.into_iter().unzip();
        let turn = world_from_ego.yaw_rad();
        let pose = PoseEstimate::new(world_from_ego, 1.0);
        let objects = tracker.objects(u64::from(tick + 1) * 100_000_000, &pose, found.clone());
        assert_eq!(objects.len(), found.len());
        for ((id, found), object) in ids.iter().zip(&found).zip(&objects) {
            assert_eq!(&object.detection, found);
            let Some(track) = &object.track else {
                continue;
            };
            assert!(tick > 0, "nothing was detected before");
            changes += usize::from(
                vehicle_of
                    .insert(track.id, *id)
                    .is_some_and(|was| was != *id),
            );
            let [true_x, _] = velocity_mps(*id);
            let [u, v] = track.velocity_mps.map(f64::from);
            let error = Vector2::new(u - true_x * turn.cos(), v + true_x * turn.sin());
            let [xx, xy, yy] = track.velocity_covariance.map(f64::from);
            let information = Matrix2::new(xx, xy, xy, yy).try_inverse().unwrap();
            normalised.push(error.dot(&(information * error)));
        }
    }
    assert!(normalised.len() > 1000);
    // Chi-square of two degrees of freedom has the mean 2; 99.9 % are below 13.8.
    let mean = normalised.iter().sum::<f64>() / normalised.len() as f64;
    let beyond = normalised.iter().filter(|value| **value > 13.8).count();
    assert!((0.3..2.0).contains(&mean), "{mean}");
    assert!(
        beyond * 200 < normalised.len(),
        "{beyond} of {}",
        normalised.len()
    );
    assert!(changes < 10, "{changes}");
}
