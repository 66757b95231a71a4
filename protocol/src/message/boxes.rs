//! Detections of one agent from its own sensors.

use serde::{Deserialize, Serialize};

use super::{PoseEstimate, check_detections, metadata_only};
use crate::{Box3d, Detection, Limits, WireError};

/// Detections of one agent: agent to ego, for late fusion and as an input of other methods.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Boxes {
    /// Pose of the sender.
    pub pose: PoseEstimate,
    /// Detections in the frame of the sender's LiDAR, in single precision, all of the sender.
    #[serde(with = "compact")]
    detections: Vec<Detection>,
}

impl Boxes {
    /// A message of detections; their numbers are rounded to single precision, and a source that they name is left out.
    pub fn new(pose: PoseEstimate, detections: Vec<Detection>) -> Self {
        let round = |detection: &Detection| CompactBox::of(detection).detection();
        Self {
            pose,
            detections: detections.iter().map(round).collect(),
        }
    }

    /// Its detections.
    pub fn detections(&self) -> &[Detection] {
        &self.detections
    }

    /// Its detections, out of the message.
    pub fn into_detections(self) -> Vec<Detection> {
        self.detections
    }

    fn check_values(&self, limits: &Limits) -> Result<(), WireError> {
        self.pose.check_values(limits)?;
        check_detections(&self.detections, limits)
    }
}

metadata_only!(Boxes, Boxes);

/// A detection as it is transmitted: 32 bytes.
#[derive(Serialize, Deserialize)]
struct CompactBox {
    center_m: [f32; 3],
    size_m: [f32; 3],
    heading_rad: f32,
    score: f32,
}

impl CompactBox {
    #[expect(
        clippy::cast_possible_truncation,
        reason = "numbers are transmitted in single precision"
    )]
    fn of(Detection { box3d, score, .. }: &Detection) -> Self {
        Self {
            center_m: box3d.center_m.map(|value| value as f32),
            size_m: box3d.size_m.map(|value| value as f32),
            heading_rad: box3d.heading_rad as f32,
            score: *score,
        }
    }

    fn detection(&self) -> Detection {
        Detection {
            box3d: Box3d {
                center_m: self.center_m.map(f64::from),
                size_m: self.size_m.map(f64::from),
                heading_rad: self.heading_rad.into(),
            },
            score: self.score,
            source: None,
        }
    }
}

/// Serialisation of detections as [`CompactBox`].
mod compact {
    use serde::{Deserialize, Deserializer, Serializer};

    use super::{CompactBox, Detection};

    pub(super) fn serialize<S: Serializer>(
        detections: &[Detection],
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(detections.iter().map(CompactBox::of))
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<Vec<Detection>, D::Error> {
        let boxes = Vec::<CompactBox>::deserialize(deserializer)?;
        Ok(boxes.iter().map(CompactBox::detection).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CavId;

    #[test]
    fn a_box_takes_32_bytes_and_is_of_its_sender() {
        let detection = Detection {
            box3d: Box3d {
                center_m: [12.345_678_901, -7.0, 0.1],
                size_m: [4.1, 1.8, 1.5],
                heading_rad: 0.3,
            },
            score: 0.7,
            source: Some(CavId::new("1000").unwrap()),
        };
        let pose = PoseEstimate::NoPose {
            reason: crate::message::NoPoseReason::TooFewInliers,
            inlier_count: 4,
        };
        let size = |count: usize| {
            let message = Boxes::new(pose, vec![detection.clone(); count]);
            let mut bytes = Vec::new();
            crate::metadata::append(crate::Kind::Boxes, &message, &mut bytes).unwrap();
            bytes.len()
        };
        assert_eq!(size(9) - size(1), 8 * 32);
        let found = Boxes::new(pose, vec![detection.clone()]).into_detections();
        assert_eq!(found[0].source, None);
        let off = found[0].box3d.center_m[0] - detection.box3d.center_m[0];
        assert!(off != 0.0 && off.abs() < 1e-6);
    }
}
