//! Objects that one agent detects from its own sensors, with the motion of those that it tracks.

use half::f16;
use serde::{Deserialize, Serialize};

use super::{PoseEstimate, check_count, check_detection, check_within, metadata_only};
use crate::{Box3d, Detection, EgoMotion, Limits, WireError};

/// Objects of one agent: agent to ego, for late fusion and as an input of other methods.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Boxes {
    /// Pose of the sender.
    pub pose: PoseEstimate,
    /// Objects in the frame of the sender's LiDAR, all of the sender.
    objects: Vec<PerceivedObject>,
}

/// A detection, and the track of the same object where its vehicle has one. Serialised as on the wire: rounded, and without
/// the source of the detection.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(from = "CompactBox", into = "CompactBox")]
pub struct PerceivedObject {
    /// The detection in the frame of the sender's LiDAR.
    pub detection: Detection,
    /// Its track; `None` for an object that has not been detected before, or of a sender that tracks nothing.
    pub track: Option<ObjectTrack>,
}

/// Identity and motion of an object at the capture time of its detection.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ObjectTrack {
    /// Identity, from 1 on; unique within a process instance (epoch) of its agent.
    pub id: u64,
    /// Velocity over ground along x, y of the sender's LiDAR frame, metres per second.
    pub velocity_mps: [f32; 2],
    /// Covariance of the track's x and y along the same axes, that of the sender's pose included: xx, xy, yy, square
    /// metres.
    pub position_covariance: [f32; 3],
    /// Covariance of the velocity: xx, xy, yy, square metres per square second.
    pub velocity_covariance: [f32; 3],
}

/// Largest variance: standard deviations of 200 m and of 200 m/s.
const MAX_VARIANCE: f64 = 4e4;

impl From<Detection> for PerceivedObject {
    fn from(detection: Detection) -> Self {
        Self {
            detection,
            track: None,
        }
    }
}

impl Boxes {
    /// A message of objects. Their numbers are rounded to those that are transmitted: single precision, covariances half
    /// precision. The source that a detection names is left out, and a track that no receiver would take.
    pub fn new(pose: PoseEstimate, objects: &[PerceivedObject]) -> Self {
        let objects = objects.iter().map(|object| {
            let PerceivedObject { detection, track } = CompactBox::from(object.clone()).into();
            // Checked as rounded: a variance beyond half precision is infinite there.
            let track = track.filter(|track| track.check_values().is_ok());
            PerceivedObject { detection, track }
        });
        Self {
            pose,
            objects: objects.collect(),
        }
    }

    /// Its objects.
    pub fn objects(&self) -> &[PerceivedObject] {
        &self.objects
    }

    /// Their detections.
    pub fn detections(&self) -> impl Iterator<Item = &Detection> {
        self.objects.iter().map(|object| &object.detection)
    }

    /// Its objects, out of the message.
    pub fn into_objects(self) -> Vec<PerceivedObject> {
        self.objects
    }

    fn check_values(&self, limits: &Limits) -> Result<(), WireError> {
        self.pose.check_values(limits)?;
        check_count("detections", self.objects.len(), limits.max_boxes)?;
        for PerceivedObject { detection, track } in &self.objects {
            check_detection(detection)?;
            track.iter().try_for_each(ObjectTrack::check_values)?;
        }
        Ok(())
    }
}

impl ObjectTrack {
    fn check_values(&self) -> Result<(), WireError> {
        let most = EgoMotion::MAX_SPEED_MPS;
        for speed in self.velocity_mps {
            check_within("object velocity_mps", speed.into(), -most, most)?;
        }
        for [xx, xy, yy] in [self.position_covariance, self.velocity_covariance] {
            let [xx, xy, yy] = [xx, xy, yy].map(f64::from);
            check_within("object covariance", xx, 0.0, MAX_VARIANCE)?;
            check_within("object covariance", yy, 0.0, MAX_VARIANCE)?;
            // Rounding to half precision may exceed the bound by a little.
            let bound = (xx * yy).sqrt() * 1.002 + 1e-6;
            check_within("object covariance", xy, -bound, bound)?;
        }
        Ok(())
    }
}

metadata_only!(Boxes, Boxes);

/// An object as it is transmitted: 33 bytes, and with a track 21 to 29 more, as its id is large.
#[derive(Serialize, Deserialize)]
struct CompactBox {
    center_m: [f32; 3],
    size_m: [f32; 3],
    heading_rad: f32,
    score: f32,
    track: Option<CompactTrack>,
}

#[derive(Serialize, Deserialize)]
struct CompactTrack {
    id: u64,
    velocity_mps: [f32; 2],
    position_covariance: [HalfBytes; 3],
    velocity_covariance: [HalfBytes; 3],
}

/// Half precision, little-endian: the encoding of integers would take three bytes.
type HalfBytes = [u8; 2];

impl From<PerceivedObject> for CompactBox {
    #[expect(
        clippy::cast_possible_truncation,
        reason = "numbers are transmitted in single precision"
    )]
    fn from(object: PerceivedObject) -> Self {
        let Detection { box3d, score, .. } = object.detection;
        Self {
            center_m: box3d.center_m.map(|value| value as f32),
            size_m: box3d.size_m.map(|value| value as f32),
            heading_rad: box3d.heading_rad as f32,
            score,
            track: object.track.map(|track| CompactTrack {
                id: track.id,
                velocity_mps: track.velocity_mps,
                position_covariance: track.position_covariance.map(half_precision),
                velocity_covariance: track.velocity_covariance.map(half_precision),
            }),
        }
    }
}

impl From<CompactBox> for PerceivedObject {
    fn from(compact: CompactBox) -> Self {
        let detection = Detection {
            box3d: Box3d {
                center_m: compact.center_m.map(f64::from),
                size_m: compact.size_m.map(f64::from),
                heading_rad: compact.heading_rad.into(),
            },
            score: compact.score,
            source: None,
        };
        let track = compact.track.map(|track| ObjectTrack {
            id: track.id,
            velocity_mps: track.velocity_mps,
            position_covariance: track.position_covariance.map(single_precision),
            velocity_covariance: track.velocity_covariance.map(single_precision),
        });
        Self { detection, track }
    }
}

fn half_precision(value: f32) -> HalfBytes {
    f16::from_f32(value).to_le_bytes()
}

fn single_precision(bytes: HalfBytes) -> f32 {
    f16::from_le_bytes(bytes).to_f32()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CavId;

    fn object() -> PerceivedObject {
        let detection = Detection {
            box3d: Box3d {
                center_m: [12.345_678_901, -7.0, 0.1],
                size_m: [4.1, 1.8, 1.5],
                heading_rad: 0.3,
            },
            score: 0.7,
            source: Some(CavId::new("1000").unwrap()),
        };
        let track = ObjectTrack {
            id: 7,
            velocity_mps: [8.25, -0.5],
            position_covariance: [0.04, 0.01, 0.09],
            velocity_covariance: [1.0, -0.5, 2.0],
        };
        PerceivedObject {
            detection,
            track: Some(track),
        }
    }

    const NO_POSE: PoseEstimate = PoseEstimate::NoPose {
        reason: crate::message::NoPoseReason::TooFewInliers,
        inlier_count: 4,
    };

    /// Bytes of a message with this object so many times.
    fn message_size(object: &PerceivedObject, count: usize) -> usize {
        let message = Boxes::new(NO_POSE, &vec![object.clone(); count]);
        let mut bytes = Vec::new();
        crate::metadata::append(crate::Kind::Boxes, &message, &mut bytes).unwrap();
        bytes.len()
    }

    #[test]
    fn an_object_takes_33_bytes_a_tracked_one_54_and_is_of_its_sender() {
        let tracked = object();
        let bare = PerceivedObject::from(tracked.detection.clone());
        for (object, bytes) in [(&bare, 33), (&tracked, 54)] {
            assert_eq!(message_size(object, 9) - message_size(object, 1), 8 * bytes);
        }
        let found = Boxes::new(NO_POSE, &[object()]).into_objects().remove(0);
        assert_eq!(found.detection.source, None);
        let off = found.detection.box3d.center_m[0] - tracked.detection.box3d.center_m[0];
        assert!(off != 0.0 && off.abs() < 1e-6);
        let variance = found.track.unwrap().position_covariance[0];
        assert!(variance != 0.04 && (variance - 0.04).abs() < 4e-5);
    }

    /// Checks a message with a changed track, which a sender leaves out where it is refused.
    fn check_changed(change: impl FnOnce(&mut ObjectTrack)) -> Result<(), WireError> {
        let mut object = object();
        change(object.track.as_mut().unwrap());
        let sent = Boxes::new(NO_POSE, std::slice::from_ref(&object));
        let received = Boxes {
            pose: NO_POSE,
            objects: vec![object],
        };
        let checked = received.check_values(&Limits::DEFAULT);
        assert_eq!(sent.objects[0].track.is_some(), checked.is_ok());
        checked
    }

    #[test]
    fn numbers_that_are_no_track_are_refused_by_name() {
        assert_eq!(check_changed(|_| {}), Ok(()));
        for (found, name) in [
            (
                check_changed(|track| track.velocity_mps[1] = f32::NAN),
                "velocity_mps",
            ),
            (
                check_changed(|track| track.velocity_mps[0] = 201.0),
                "velocity_mps",
            ),
            (
                check_changed(|track| track.position_covariance[1] = 0.07),
                "covariance",
            ),
            (
                check_changed(|track| track.velocity_covariance[0] = -1.0),
                "covariance",
            ),
            (
                check_changed(|track| track.velocity_covariance[2] = f32::NAN),
                "covariance",
            ),
            (
                check_changed(|track| track.velocity_covariance[2] = 1e9),
                "covariance",
            ),
        ] {
            let error = found.unwrap_err().to_string();
            assert!(error.contains(name), "{error}");
        }
    }
}
