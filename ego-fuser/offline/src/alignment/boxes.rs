//! Approaches that exchange boxes.

use nalgebra::Isometry3;
use protocol::message::{Boxes, Message};
use protocol::{Box3d, Detection, NoPoseReason, PoseEstimate};

use super::free_align::{self, FreeAlignConfig};
use super::{AlignError, Approach, NotAligned, Vehicle, box_icp};

/// Nobody knows where it is: that is the point.
const NO_POSE: PoseEstimate = PoseEstimate::NoPose { reason: NoPoseReason::NoSource, inlier_count: 0 };

/// Matches the graphs of both vehicles' boxes.
#[derive(Debug, Clone, Default)]
pub struct FreeAlign {
    /// Settings of the matching.
    pub config: FreeAlignConfig,
}

impl Approach for FreeAlign {
    fn name(&self) -> &str {
        "free-align"
    }

    fn needs_boxes(&self) -> bool {
        true
    }

    fn prepare(&mut self, vehicle: &Vehicle<'_>) -> Result<Message, AlignError> {
        Ok(message(&vehicle.boxes[..vehicle.boxes.len().min(self.config.max_boxes)]))
    }

    fn align(&self, _: &Vehicle<'_>, own: &Message, received: &Message) -> Result<Isometry3<f64>, NotAligned> {
        let (ego, neighbour) = (boxes(own)?, boxes(received)?);
        Ok(free_align::align(&ego, &neighbour, &self.config)?.ego_from_neighbour)
    }
}

/// Moves one vehicle's box centres onto the other's, from where both would stand at one place.
#[derive(Debug, Clone, Copy, Default)]
pub struct BoxIcp;

impl Approach for BoxIcp {
    fn name(&self) -> &str {
        "box-icp"
    }

    fn needs_boxes(&self) -> bool {
        true
    }

    fn prepare(&mut self, vehicle: &Vehicle<'_>) -> Result<Message, AlignError> {
        Ok(message(vehicle.boxes))
    }

    fn align(&self, _: &Vehicle<'_>, own: &Message, received: &Message) -> Result<Isometry3<f64>, NotAligned> {
        Ok(box_icp::align(&boxes(own)?, &boxes(received)?, &Isometry3::identity())?)
    }
}

fn message(boxes: &[Box3d]) -> Message {
    let detections = boxes.iter().map(|box3d| Detection { box3d: *box3d, score: 1.0, source: None }).collect();
    Message::Boxes(Boxes { pose: NO_POSE, detections })
}

fn boxes(message: &Message) -> Result<Vec<Box3d>, NotAligned> {
    match message {
        Message::Boxes(boxes) => Ok(boxes.detections.iter().map(|detection| detection.box3d).collect()),
        _ => Err(NotAligned::Message),
    }
}
