//! Trails: the places of tracks over the last seconds, for the page.

use std::collections::{BTreeMap, VecDeque};

use nalgebra::Point3;
use protocol::{Track, Tracks};

use super::scene_frame::ShownTrack;

/// Time that a trail covers, nanoseconds.
const TRAIL_NANOS: u64 = 2_000_000_000;

/// Places of the tracks of one ego in the world frame, by id, each with its capture time.
#[derive(Default)]
pub(super) struct Trails {
    places: BTreeMap<u64, VecDeque<(u64, [f64; 2])>>,
    newest_nanos: u64,
}

impl Trails {
    /// True if a trail at `now_nanos` reaches back to a capture time.
    pub(super) fn covers(now_nanos: u64, capture_nanos: u64) -> bool {
        capture_nanos <= now_nanos && now_nanos - capture_nanos <= TRAIL_NANOS
    }

    /// Adds the tracks of a frame and returns them with their trails. Without the pose of the ego none has a place.
    pub(super) fn add(&mut self, capture_nanos: u64, tracks: &Tracks) -> Vec<ShownTrack> {
        // Time goes back: the scene has begun again, and so do its trails.
        if capture_nanos <= self.newest_nanos {
            self.places.clear();
        }
        self.newest_nanos = capture_nanos;
        self.places.retain(|_, trail| {
            trail.retain(|(nanos, _)| Self::covers(capture_nanos, *nanos));
            !trail.is_empty()
        });
        let Some(pose) = tracks.pose.world_from_cav() else {
            return Vec::new();
        };
        let world_from_ego = pose.isometry();
        let shown = tracks.tracks.iter().map(|track: &Track| {
            let place = world_from_ego * Point3::from(track.box3d.center_m);
            let trail = self.places.entry(track.id).or_default();
            trail.push_back((capture_nanos, [place.x, place.y]));
            let [x, y] = track.velocity_mps;
            ShownTrack {
                id: track.id,
                trail_m: trail.iter().map(|(_, place)| *place).collect(),
                speed_mps: x.hypot(y),
                is_seen: track.unseen_s == 0.0,
            }
        });
        shown.collect()
    }
}

#[cfg(test)]
mod tests {
    use protocol::{Box3d, CavId, NoPoseReason, Pose, PoseEstimate};

    use super::*;

    fn tracks(x: f64, ids: &[u64]) -> Tracks {
        let tracks = ids.iter().map(|&id| Track {
            id,
            box3d: Box3d {
                center_m: [1.0, 0.0, 0.0],
                size_m: [4.0, 2.0, 1.5],
                heading_rad: 0.0,
            },
            velocity_mps: [3.0, 4.0],
            covariance: [[0.0; 4]; 4],
            score: 0.5,
            hits: 2,
            age_s: 0.1,
            unseen_s: 0.1,
        });
        Tracks {
            ego: CavId::new("7").unwrap(),
            agent_frame: 0,
            pose: PoseEstimate::new(Pose::from_xyz_yaw([x, 5.0, 0.0], 0.0), 0.9),
            tracks: tracks.collect(),
            left_out: 0,
        }
    }

    #[test]
    fn a_trail_is_in_the_world_and_covers_two_seconds() {
        let mut trails = Trails::default();
        let mut shown = Vec::new();
        for tick in 0..40_u32 {
            let ids = if tick == 30 { &[2][..] } else { &[1, 2] };
            shown = trails.add(u64::from(tick) * 100_000_000 + 1, &tracks(tick.into(), ids));
        }
        assert_eq!([shown[0].trail_m.len(), shown[1].trail_m.len()], [20, 21]);
        assert_eq!(
            (shown[1].trail_m[0], shown[1].trail_m[20]),
            ([20.0, 5.0], [40.0, 5.0])
        );
        assert_eq!((shown[0].speed_mps, shown[0].is_seen), (5.0, false));
        // A scene that begins again has no trails yet.
        assert_eq!(trails.add(5, &tracks(3.0, &[1]))[0].trail_m, [[4.0, 5.0]]);
        let unposed = Tracks {
            pose: PoseEstimate::NoPose {
                reason: NoPoseReason::TooFewPoints,
                inlier_count: 0,
            },
            ..tracks(0.0, &[1])
        };
        assert!(trails.add(6, &unposed).is_empty());
    }
}
