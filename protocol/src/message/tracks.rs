//! Tracks of an ego: detected objects with identity, velocity and covariance.

use serde::{Deserialize, Serialize};

use super::{PoseEstimate, check_count, check_within, metadata_only};
use crate::{Box3d, CavId, Limits, WireError};

/// The tracks after one ego frame: ego-fuser to anyone, also as JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Tracks {
    /// The vehicle that fused; the tracks are in its LiDAR frame.
    pub ego: CavId,
    /// Frame of the ego's own agent, that of the detections.
    pub agent_frame: u64,
    /// Pose estimate of the ego. Without a pose a frame has no tracks.
    pub pose: PoseEstimate,
    /// Tracks, by id.
    pub tracks: Vec<Track>,
    /// Number of detections that are left out: a number is none, or there are more than a tracker takes.
    pub left_out: u32,
}

/// A tracked object at the capture time of a frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Track {
    /// Identity, from 1 on; never used again by the same ego-fuser.
    pub id: u64,
    /// The object in the ego's LiDAR frame.
    #[serde(rename = "box")]
    pub box3d: Box3d,
    /// Velocity over ground along x, y of the ego's LiDAR frame, metres per second: 0 for a standing object, however the
    /// ego moves.
    pub velocity_mps: [f64; 2],
    /// Covariance of x, y, velocity x, velocity y along the same axes, by rows: metres and metres per second.
    pub covariance: [[f32; 4]; 4],
    /// Mean score of its detections times the probability that the object exists, 0..=1.
    pub score: f64,
    /// Number of its detections.
    pub hits: u32,
    /// Time since its first detection, seconds.
    pub age_s: f64,
    /// Time since its last detection, seconds; 0 if it is detected in this frame, else its place is predicted.
    pub unseen_s: f64,
}

/// Largest variance: standard deviations of a kilometre, and of a kilometre per second.
const MAX_VARIANCE: f64 = 1e6;
/// Largest speed in one direction, metres per second.
const MAX_SPEED_MPS: f64 = 1e4;
/// Largest age, seconds: some centuries.
const MAX_AGE_S: f64 = 1e11;

impl Tracks {
    fn check_values(&self, limits: &Limits) -> Result<(), WireError> {
        self.pose.check_values(limits)?;
        check_count("tracks", self.tracks.len(), limits.max_boxes)?;
        self.tracks.iter().try_for_each(Track::check_values)
    }
}

impl Track {
    fn check_values(&self) -> Result<(), WireError> {
        self.box3d.check()?;
        for speed in self.velocity_mps {
            check_within("track velocity_mps", speed, -MAX_SPEED_MPS, MAX_SPEED_MPS)?;
        }
        let [x, y, u, v] = self.covariance;
        let variances = [x[0], y[1], u[2], v[3]].map(f64::from);
        for (row, variance) in self.covariance.iter().zip(variances) {
            check_within("track covariance", variance, 0.0, MAX_VARIANCE)?;
            for (value, other) in row.iter().zip(variances) {
                // Rounding to single precision may exceed the bound by a little.
                let bound = (variance * other).sqrt() * (1.0 + 1e-5);
                check_within("track covariance", (*value).into(), -bound, bound)?;
            }
        }
        check_within("track score", self.score, 0.0, 1.0)?;
        check_within("track age_s", self.age_s, 0.0, MAX_AGE_S)?;
        check_within("track unseen_s", self.unseen_s, 0.0, self.age_s)
    }
}

metadata_only!(Tracks, Tracks);

#[cfg(test)]
mod tests {
    use super::*;

    fn track() -> Track {
        Track {
            id: 1,
            box3d: Box3d {
                center_m: [1.0, 2.0, 0.5],
                size_m: [4.0, 2.0, 1.5],
                heading_rad: 0.0,
            },
            velocity_mps: [3.0, 0.0],
            covariance: [[1.0; 4]; 4],
            score: 0.5,
            hits: 1,
            age_s: 1.0,
            unseen_s: 1.0,
        }
    }

    fn check_changed(change: impl FnOnce(&mut Track)) -> Result<(), String> {
        let mut track = track();
        change(&mut track);
        track.check_values().map_err(|error| error.to_string())
    }

    #[test]
    fn numbers_that_are_no_track_are_refused_by_name() {
        assert_eq!(check_changed(|_| {}), Ok(()));
        for (found, name) in [
            (
                check_changed(|track| track.velocity_mps[1] = f64::NAN),
                "velocity_mps",
            ),
            (
                check_changed(|track| track.velocity_mps[0] = 1e5),
                "velocity_mps",
            ),
            (check_changed(|track| track.score = 1.5), "score"),
            (check_changed(|track| track.unseen_s = 1.5), "unseen_s"),
            (check_changed(|track| track.age_s = -1.0), "age_s"),
            (check_changed(|track| track.box3d.size_m[2] = 0.0), "size_m"),
            (
                check_changed(|track| track.covariance[2][2] = -1.0),
                "covariance",
            ),
            (
                check_changed(|track| track.covariance[0][3] = 1.1),
                "covariance",
            ),
            (
                check_changed(|track| track.covariance[1][0] = f32::NAN),
                "covariance",
            ),
            (
                check_changed(|track| track.covariance[3][3] = 1e7),
                "covariance",
            ),
        ] {
            assert!(found.clone().unwrap_err().contains(name), "{found:?}");
        }
    }
}
