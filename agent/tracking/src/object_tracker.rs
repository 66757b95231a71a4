//! Object tracker: a vehicle's own detections with their tracks, as its neighbours need them.

use protocol::{Detection, ObjectTrack, PerceivedObject, PoseEstimate, Track};

use crate::Tracker;

/// Tracker of the detections of one vehicle.
#[derive(Debug, Default)]
pub struct ObjectTracker {
    tracker: Tracker,
}

impl ObjectTracker {
    /// The detections of a sweep, in the LiDAR frame of the vehicle, with the track of each object that was detected
    /// before. Where time does not advance the scene begins again; without a pose nothing has a track.
    pub fn objects(
        &mut self,
        capture_nanos: u64,
        pose: &PoseEstimate,
        detections: Vec<Detection>,
    ) -> Vec<PerceivedObject> {
        let tracks = self.tracker.track_of_each(capture_nanos, pose, &detections);
        let object = |(detection, track): (Detection, Option<Track>)| PerceivedObject {
            detection,
            track: track.map(|track| in_message(&track)),
        };
        detections.into_iter().zip(tracks).map(object).collect()
    }
}

fn in_message(track: &Track) -> ObjectTrack {
    let [x, y, u, v] = track.covariance;
    ObjectTrack {
        id: track.id,
        velocity_mps: track.velocity_mps.map(|speed| speed as f32),
        position_covariance: [x[0], x[1], y[1]],
        velocity_covariance: [u[2], u[3], v[3]],
    }
}
