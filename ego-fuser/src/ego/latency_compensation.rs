//! Latency compensation: carries neighbours' boxes from their capture time to that of the ego's frame.
//!
//! Every neighbour has a tracker of its own, in the frame of the world; a box moves with the velocity of its track.

use std::borrow::Cow;
use std::collections::BTreeMap;

use protocol::{CavId, Detection};
use tracking::Tracker;

use super::{Content, View};

/// Largest distance of a box from its track, metres in the plane.
const REACH_M: f64 = 1.5;
/// Detections from which on the velocity of a track is one.
const MIN_HITS: u32 = 2;
/// Largest age to which boxes are carried, seconds.
const MAX_AGE_S: f64 = 1.0;
/// Time without a message after which a neighbour's tracks end, nanoseconds.
const FORGOTTEN_NANOS: u64 = 10_000_000_000;

/// Trackers of the neighbours that send boxes.
#[derive(Debug, Default)]
pub(super) struct LatencyCompensation {
    of_cav: BTreeMap<CavId, Followed>,
}

#[derive(Debug, Default)]
struct Followed {
    tracker: Tracker,
    capture_nanos: Option<u64>,
    /// Velocities over ground of the boxes of that time, in the sender's LiDAR frame, metres per second.
    velocities_mps: Vec<[f64; 2]>,
}

impl LatencyCompensation {
    /// The view with its boxes at `now_nanos`; views of other content, and without a pose, as they are.
    pub(super) fn carried<'a>(&mut self, view: &'a View, now_nanos: u64) -> Cow<'a, View> {
        let (Content::Boxes(found), Some(_)) = (&view.content, view.pose.world_from_cav()) else {
            return Cow::Borrowed(view);
        };
        let followed = self.of_cav.entry(view.cav.clone()).or_default();
        followed.follow(view, found);
        let age_s = (now_nanos as f64 - view.capture_nanos as f64) * 1e-9;
        let mut carried = found.clone();
        for (detection, velocity_mps) in carried.iter_mut().zip(&followed.velocities_mps) {
            for (at, speed) in detection.box3d.center_m.iter_mut().zip(velocity_mps) {
                *at += speed * age_s.clamp(-MAX_AGE_S, MAX_AGE_S);
            }
        }
        Cow::Owned(View {
            content: Content::Boxes(carried),
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

impl Followed {
    /// Takes a message once: it may serve several frames.
    fn follow(&mut self, view: &View, found: &[Detection]) {
        if self.capture_nanos == Some(view.capture_nanos) {
            return;
        }
        let tracks = self
            .tracker
            .tracks_of(view.capture_nanos, &view.pose, found);
        let velocity_mps = |detection: &Detection| {
            let [x, y, _] = detection.box3d.center_m;
            let near = { tracks.iter() }
                .filter(|track| track.hits >= MIN_HITS && track.unseen_s == 0.0)
                .map(|track| {
                    let [at_x, at_y, _] = track.box3d.center_m;
                    ((at_x - x).hypot(at_y - y), track.velocity_mps)
                })
                .filter(|(distance_m, _)| *distance_m <= REACH_M)
                .min_by(|(a, _), (b, _)| a.total_cmp(b));
            near.map_or([0.0; 2], |(_, velocity_mps)| velocity_mps)
        };
        self.velocities_mps = found.iter().map(velocity_mps).collect();
        self.capture_nanos = Some(view.capture_nanos);
    }
}

#[cfg(test)]
mod tests {
    use protocol::{Box3d, Pose, PoseEstimate};

    use super::*;

    /// A sender that drives at 10 m/s and is turned by 90 degrees, and its view of a standing car and of one at 15 m/s.
    fn view(tick: u32) -> View {
        let t = 0.1 * f64::from(tick);
        let world_from_cav = Pose::from_xyz_yaw([0.0, 10.0 * t, 0.0], 90_f64.to_radians());
        let car = |world_m: [f64; 3]| Detection {
            box3d: Box3d {
                center_m: world_m,
                size_m: [4.0, 1.8, 1.5],
                heading_rad: 0.0,
            }
            .transformed(&world_from_cav.isometry().inverse()),
            score: 0.9,
            source: None,
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
        let Content::Boxes(found) = &view.content else {
            panic!("{view:?}");
        };
        { found.iter() }
            .map(|found| [found.box3d.center_m[0], found.box3d.center_m[1]])
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
}
