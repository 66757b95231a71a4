//! Latency compensation: carries neighbours' boxes from their capture time to that of the ego's frame.
//!
//! A box moves with the velocity that its sender states. Boxes of a sender that states none are tracked here.

use std::borrow::Cow;
use std::collections::BTreeMap;

use protocol::{CavId, Detection, PerceivedObject};
use tracking::Tracker;

use super::{Content, View};

/// Largest age to which boxes are carried, seconds.
const MAX_AGE_S: f64 = 1.0;
/// Time without a message after which a neighbour's tracks end, nanoseconds.
const FORGOTTEN_NANOS: u64 = 10_000_000_000;

/// Trackers of the neighbours that send boxes without velocities.
#[derive(Debug, Default)]
pub(super) struct LatencyCompensation {
    of_cav: BTreeMap<CavId, Followed>,
}

#[derive(Debug, Default)]
struct Followed {
    tracker: Tracker,
    capture_nanos: Option<u64>,
    /// The objects of that time.
    objects: Vec<PerceivedObject>,
}

impl LatencyCompensation {
    /// The view with its boxes at `now_nanos`; views of other content, and without a pose, as they are.
    pub(super) fn carried<'a>(&mut self, view: &'a View, now_nanos: u64) -> Cow<'a, View> {
        let (Content::Boxes(sent), Some(_)) = (&view.content, view.pose.world_from_cav()) else {
            return Cow::Borrowed(view);
        };
        let objects = if sent.iter().any(|object| object.track.is_some()) {
            sent
        } else {
            let followed = self.of_cav.entry(view.cav.clone()).or_default();
            followed.objects(view, sent)
        };
        let age_s = (now_nanos as f64 - view.capture_nanos as f64) * 1e-9;
        let age_s = age_s.clamp(-MAX_AGE_S, MAX_AGE_S);
        let carried = objects
            .iter()
            .map(|object| extrapolated(object.clone(), age_s));
        Cow::Owned(View {
            content: Content::Boxes(carried.collect()),
            ..view.clone()
        })
    }

    /// Removes the tracks of neighbours that have not sent for long.
    pub(super) fn forget_absent(&mut self, now_nanos: u64) {
        let is_absent = |sent_nanos| now_nanos.abs_diff(sent_nanos) > FORGOTTEN_NANOS;
        self.of_cav
            .retain(|_, followed| !followed.capture_nanos.is_some_and(is_absent));
    }

    /// Removes all tracks: another scene begins.
    pub(super) fn clear(&mut self) {
        self.of_cav.clear();
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

impl Followed {
    /// The objects of a message with their tracks; it is taken once and may serve several frames.
    fn objects(&mut self, view: &View, sent: &[PerceivedObject]) -> &[PerceivedObject] {
        if self.capture_nanos != Some(view.capture_nanos) {
            let found: Vec<Detection> = { sent.iter() }
                .map(|object| object.detection.clone())
                .collect();
            self.objects = self.tracker.objects(view.capture_nanos, &view.pose, found);
            self.capture_nanos = Some(view.capture_nanos);
        }
        &self.objects
    }
}

#[cfg(test)]
mod tests {
    use protocol::{Box3d, ObjectTrack, Pose, PoseEstimate};

    use super::*;

    /// A sender that drives at 10 m/s and is turned by 90 degrees, and its view of a standing car and of one at 15 m/s.
    fn view(tick: u32) -> View {
        let t = 0.1 * f64::from(tick);
        let world_from_cav = Pose::from_xyz_yaw([0.0, 10.0 * t, 0.0], 90_f64.to_radians());
        let car = |world_m: [f64; 3]| {
            PerceivedObject::from(Detection {
                box3d: Box3d {
                    center_m: world_m,
                    size_m: [4.0, 1.8, 1.5],
                    heading_rad: 0.0,
                }
                .transformed(&world_from_cav.isometry().inverse()),
                score: 0.9,
                source: None,
            })
        };
        View {
            cav: CavId::new("1").unwrap(),
            pose: PoseEstimate::new(world_from_cav, 1.0),
            capture_nanos: u64::from(tick) * 100_000_000,
            content: Content::Boxes(vec![
                car([20.0, 5.0, 0.0]),
                car([15.0 * t - 10.0, -4.0, 0.0]),
            ]),
        }
    }

    fn centers(view: &View) -> Vec<[f64; 2]> {
        let Content::Boxes(objects) = &view.content else {
            panic!("{view:?}");
        };
        let center = |object: &PerceivedObject| object.detection.box3d.center_m;
        { objects.iter() }
            .map(|object| [center(object)[0], center(object)[1]])
            .collect()
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
        assert!(compensation.of_cav.is_empty());
    }
}
