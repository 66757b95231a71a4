//! Latency compensation: carries neighbours' boxes from their capture time to that of the ego's frame.
//!
//! A box moves with the velocity in the message. The ego also tracks the boxes itself: it uses its own velocity if the message
//! has none, or if the positions of the boxes in successive messages contradict it.

use std::borrow::Cow;
use std::collections::BTreeMap;

use nalgebra::{Matrix2, Vector2};
use protocol::{CavId, Detection, ObjectTrack, PerceivedObject};
use tracking::{Tracker, TrackerConfig};

use super::{Content, View};

/// Largest age to which boxes are carried, seconds.
const MAX_AGE_S: f64 = 1.0;
/// Time without a message after which a neighbour's tracks end, nanoseconds.
const FORGOTTEN_NANOS: u64 = 10_000_000_000;

/// Largest number of boxes of a neighbour that are tracked, so that none takes long.
const MAX_TRACKED: usize = 64;
/// Standard deviation of a stated velocity that is true, metres per second: other trackers weigh other noise.
const STATED_SIGMA_MPS: f64 = 1.0;
/// A box whose centre is this near is a vehicle found, metres. Chosen on validation scenes.
const FOUND_M: f64 = 0.7;

/// Trackers of the neighbours that send boxes.
#[derive(Debug, Default)]
pub(super) struct LatencyCompensation {
    of_cav: BTreeMap<CavId, FollowedSender>,
    /// Messages whose velocities were not taken.
    pub(super) refused: usize,
}

#[derive(Debug)]
struct FollowedSender {
    tracker: Tracker,
    capture_nanos: Option<u64>,
    /// The objects of that time.
    objects: Vec<PerceivedObject>,
    /// True if it has stated a velocity that its boxes contradict.
    is_contradicted: bool,
}

impl LatencyCompensation {
    /// The view with its boxes at `now_nanos`; views of other content, and without a pose, as they are.
    pub(super) fn carried<'a>(&mut self, view: &'a View, now_nanos: u64) -> Cow<'a, View> {
        let (Content::Boxes(sent), Some(_)) = (&view.content, view.pose.world_from_cav()) else {
            return Cow::Borrowed(view);
        };
        let followed = self.of_cav.entry(view.cav.clone()).or_default();
        let objects = followed.objects(view, sent, &mut self.refused);
        let age_s = (now_nanos as f64 - view.capture_nanos as f64) * 1e-9;
        let age_s = age_s.clamp(-MAX_AGE_S, MAX_AGE_S);
        let objects = objects.iter().cloned();
        let carried = objects.map(|object| extrapolated(object, age_s));
        Cow::Owned(View {
            content: Content::Boxes(carried.collect()),
            ..view.clone()
        })
    }

    /// Removes the tracks of neighbours that have not sent for long.
    pub(super) fn forget_absent(&mut self, now_nanos: u64) {
        self.of_cav.retain(|_, followed| {
            let sent_nanos = followed.capture_nanos;
            sent_nanos.is_none_or(|sent| now_nanos.abs_diff(sent) <= FORGOTTEN_NANOS)
        });
    }
}

/// The object after a time.
fn extrapolated(mut object: PerceivedObject, elapsed_s: f64) -> PerceivedObject {
    if let Some(track) = &object.track {
        let center_m = &mut object.detection.box3d.center_m;
        for (at, speed) in center_m.iter_mut().zip(track.velocity_mps) {
            *at += f64::from(speed) * elapsed_s;
        }
    }
    object
}

/// Probability that a box that was carried by `age_s` is where its vehicle is, 0..1: within [`FOUND_M`], as the normal
/// distribution of its velocity gives it.
pub(super) fn probability_carried_right(object: &PerceivedObject, age_s: f64) -> f64 {
    let variance = match &object.track {
        Some(track) => f64::midpoint(
            track.velocity_covariance[0].into(),
            track.velocity_covariance[2].into(),
        ),
        // As uncertain as the velocity of a new track.
        None => TrackerConfig::default().initial_sigma_mps.powi(2),
    };
    let error_m2 = variance * age_s.powi(2);
    1.0 - (-0.5 * FOUND_M.powi(2) / error_m2.max(f64::MIN_POSITIVE)).exp()
}

impl Default for FollowedSender {
    fn default() -> Self {
        Self {
            tracker: Tracker::new(TrackerConfig {
                max_detections: MAX_TRACKED,
                max_tracks: MAX_TRACKED,
                ..TrackerConfig::default()
            }),
            capture_nanos: None,
            objects: Vec::new(),
            is_contradicted: false,
        }
    }
}

impl FollowedSender {
    /// The objects of a message with their tracks; it is taken once and may serve several frames.
    fn objects(
        &mut self,
        view: &View,
        sent: &[PerceivedObject],
        refused: &mut usize,
    ) -> &[PerceivedObject] {
        if self.capture_nanos != Some(view.capture_nanos) {
            let found: Vec<Detection> =
                sent.iter().map(|object| object.detection.clone()).collect();
            self.objects = self.tracker.objects(view.capture_nanos, &view.pose, found);
            self.capture_nanos = Some(view.capture_nanos);
            *refused += usize::from(!self.takes_stated(&view.cav, sent));
        }
        &self.objects
    }

    /// Takes the stated tracks. Where the ego's own contradict most of them, its own stay: a single one is rather a box that
    /// the ego has taken for another one after a lost message.
    fn takes_stated(&mut self, cav: &CavId, sent: &[PerceivedObject]) -> bool {
        let pairs = self.objects.iter().zip(sent);
        let compared = pairs.filter_map(|(object, sent)| sent.track.zip(object.track));
        let verdicts: Vec<bool> = compared
            .map(|(stated, own)| is_contradicted(&stated, &own))
            .collect();
        let contradicted = verdicts.iter().filter(|is_so| **is_so).count();
        if 2 * contradicted > verdicts.len() {
            if !std::mem::replace(&mut self.is_contradicted, true) {
                tracing::warn!(%cav, contradicted, of = verdicts.len(), "states velocities that its boxes contradict: the ego takes its own");
            }
            return false;
        }
        for (object, sent) in self.objects.iter_mut().zip(sent) {
            object.track = sent.track.or(object.track);
        }
        true
    }
}

/// True if the velocity that the ego measures contradicts the stated one.
fn is_contradicted(stated: &ObjectTrack, own: &ObjectTrack) -> bool {
    let [stated_mps, own_mps] =
        [stated, own].map(|track| Vector2::from(track.velocity_mps.map(f64::from)));
    let [xx, xy, yy] = own.velocity_covariance.map(f64::from);
    let covariance = Matrix2::new(xx, xy, xy, yy) + Matrix2::identity() * STATED_SIGMA_MPS.powi(2);
    let error = stated_mps - own_mps;
    let solved = covariance.cholesky().map(|factors| factors.solve(&error));
    // The gate of the tracker itself: both have two degrees of freedom.
    let gate = TrackerConfig::default().gate;
    solved.is_none_or(|solved| error.dot(&solved) > gate)
}

#[cfg(test)]
mod tests {
    use protocol::{Box3d, ObjectTrack, Pose, PoseEstimate};

    use super::*;

    fn car(world_m: [f64; 3], world_from_cav: &Pose) -> PerceivedObject {
        let box3d = Box3d {
            center_m: world_m,
            size_m: [4.0, 1.8, 1.5],
            heading_rad: 0.0,
        };
        PerceivedObject::from(Detection {
            box3d: box3d.transformed(&world_from_cav.isometry().inverse()),
            score: 0.9,
            source: None,
        })
    }

    /// A sender that drives at 10 m/s and is turned by 90 degrees, and its view of a standing car and of one at 15 m/s.
    fn view(tick: u32) -> View {
        let t = 0.1 * f64::from(tick);
        let world_from_cav = Pose::from_xyz_yaw([0.0, 10.0 * t, 0.0], 90_f64.to_radians());
        View {
            cav: CavId::new("1").unwrap(),
            pose: PoseEstimate::new(world_from_cav, 1.0),
            capture_nanos: u64::from(tick) * 100_000_000,
            content: Content::Boxes(vec![
                car([20.0, 5.0, 0.0], &world_from_cav),
                car([15.0 * t - 10.0, -4.0, 0.0], &world_from_cav),
            ]),
        }
    }

    fn centers(view: &View) -> Vec<[f64; 2]> {
        let Content::Boxes(objects) = &view.content else {
            panic!("{view:?}");
        };
        objects
            .iter()
            .map(|object| {
                let [x, y, _] = object.detection.box3d.center_m;
                [x, y]
            })
            .collect()
    }

    /// At ages of 0, 0.1 and 0.4 s.
    fn probabilities_carried_right(object: &PerceivedObject) -> [f64; 3] {
        [0.0, 0.1, 0.4].map(|age_s| probability_carried_right(object, age_s))
    }

    #[test]
    fn boxes_move_with_their_tracks_to_the_time_of_the_frame() {
        let mut compensation = LatencyCompensation::default();
        for tick in 0..8 {
            let same_time = u64::from(tick) * 100_000_000;
            compensation.carried(&view(tick), same_time);
        }
        let late = view(8);
        let carried = compensation.carried(&late, late.capture_nanos + 400_000_000);
        // A moment serves twice, to another time.
        let again = compensation.carried(&late, late.capture_nanos);
        assert_eq!(centers(&again), centers(&late));
        // 15 m/s along x of the world is -y of the sender.
        let (before, after) = (centers(&late), centers(&carried));
        for (moved_m, (from, to)) in [0.0, 6.0].into_iter().zip(before.iter().zip(&after)) {
            assert!((to[0] - from[0]).abs() < 0.5, "{before:?} {after:?}");
            assert!(
                (from[1] - moved_m - to[1]).abs() < 0.5,
                "{before:?} {after:?}"
            );
        }
        compensation.forget_absent(late.capture_nanos + FORGOTTEN_NANOS);
        assert_eq!(compensation.of_cav.len(), 1);
        compensation.forget_absent(late.capture_nanos + FORGOTTEN_NANOS + 1);
        assert_eq!(compensation.of_cav.len(), 0);
        let first = compensation.carried(&late, late.capture_nanos + 400_000_000);
        assert_eq!(centers(&first), before, "one view has no velocities");
    }

    #[test]
    fn a_velocity_that_the_boxes_contradict_is_replaced_by_the_own_one() {
        let lie = ObjectTrack {
            id: 1,
            velocity_mps: [-12.0, 9.0],
            position_covariance: [0.0; 3],
            velocity_covariance: [0.0; 3],
        };
        let mut compensation = LatencyCompensation::default();
        let mut carried_by_m = |tick| {
            let mut attacker = view(tick);
            let Content::Boxes(objects) = &mut attacker.content else {
                panic!("{attacker:?}");
            };
            objects[0].track = Some(lie);
            let from = centers(&attacker)[0];
            let to =
                centers(&compensation.carried(&attacker, attacker.capture_nanos + 100_000_000))[0];
            (to[0] - from[0]).hypot(to[1] - from[1])
        };
        assert!(
            (carried_by_m(0) - 1.5).abs() < 1e-6,
            "nothing contradicts it"
        );
        assert!((1..10).all(|tick| carried_by_m(tick) < 0.1));
        assert_eq!(compensation.refused, 9);
    }

    #[test]
    fn a_box_is_less_likely_right_the_further_it_is_carried() {
        let Content::Boxes(mut objects) = view(0).content else {
            panic!("boxes");
        };
        let unknown = probabilities_carried_right(&objects[0]);
        assert!(unknown[0] == 1.0 && unknown[2] < 0.02, "{unknown:?}");
        objects[0].track = Some(ObjectTrack {
            id: 1,
            velocity_mps: [3.0, 0.0],
            position_covariance: [0.1, 0.0, 0.1],
            velocity_covariance: [1.0, 0.0, 1.0],
        });
        let [now, soon, late] = probabilities_carried_right(&objects[0]);
        assert!(now == 1.0 && soon > 0.999 && (0.7..0.9).contains(&late));
    }

    #[test]
    fn a_first_message_is_carried_by_the_velocities_that_it_states() {
        let mut first = view(0);
        let Content::Boxes(objects) = &mut first.content else {
            panic!("{first:?}");
        };
        objects[1].track = Some(ObjectTrack {
            id: 3,
            velocity_mps: [2.0, -15.0],
            position_covariance: [0.1, 0.0, 0.1],
            velocity_covariance: [1.0, 0.0, 1.0],
        });
        let mut compensation = LatencyCompensation::default();
        let before = centers(&first);
        let after = centers(&compensation.carried(&first, 500_000_000));
        assert_eq!(after[0], before[0], "an object without a track stays");
        assert!((after[1][0] - before[1][0] - 1.0).abs() < 1e-9);
        assert!((after[1][1] - before[1][1] + 7.5).abs() < 1e-9);
        // An older box is carried by one second only, and what a sender tracks is not tracked again.
        let far = centers(&compensation.carried(&first, 9_000_000_000));
        assert!((far[1][1] - before[1][1] + 15.0).abs() < 1e-9);
    }
}
