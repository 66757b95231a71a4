//! Alignment methods that exchange boxes.

use localization::pose_source::NO_SOURCE;
use nalgebra::Isometry3;
use protocol::message::{Boxes, Message};
use protocol::{Box3d, Detection};

use super::box_icp;
use super::free_align::{self, MAX_BOXES, MIN_MATCHES};
use super::method::{
    AlignError, AlignInput, Alignment, AlignmentMethod, AlignmentSpec, NotAligned,
};

/// Matches the graphs of both vehicles' boxes.
#[derive(Debug, Clone, Copy, Default)]
pub struct FreeAlign;

impl FreeAlign {
    /// The method.
    pub fn spec() -> AlignmentSpec {
        AlignmentSpec::new("free-align", true, || Self)
    }
}

impl AlignmentMethod for FreeAlign {
    fn prepare(&mut self, vehicle: &AlignInput<'_>) -> Result<Message, AlignError> {
        let sent = vehicle.boxes.len().min(MAX_BOXES);
        Ok(message(&vehicle.boxes[..sent]))
    }

    fn align(&self, _: &AlignInput<'_>, own: &Message, received: &Message) -> Alignment {
        let (ego, neighbour) = (boxes(own)?, boxes(received)?);
        Ok(free_align::align(&ego, &neighbour, MIN_MATCHES)?.ego_from_neighbour)
    }
}

/// Registers one vehicle's box centres to the other's, starting at the identity.
#[derive(Debug, Clone, Copy, Default)]
pub struct BoxIcp;

impl BoxIcp {
    /// The method, which has no settings.
    pub fn spec() -> AlignmentSpec {
        AlignmentSpec::new("box-icp", true, || Self)
    }
}

impl AlignmentMethod for BoxIcp {
    fn prepare(&mut self, vehicle: &AlignInput<'_>) -> Result<Message, AlignError> {
        Ok(message(vehicle.boxes))
    }

    fn align(&self, _: &AlignInput<'_>, own: &Message, received: &Message) -> Alignment {
        let (ego, neighbour) = (boxes(own)?, boxes(received)?);
        Ok(box_icp::align(&ego, &neighbour, &Isometry3::identity())?)
    }
}

fn message(boxes: &[Box3d]) -> Message {
    let detections = boxes.iter().map(|box3d| Detection {
        box3d: *box3d,
        // The order of the boxes is their confidence: scores are not read.
        score: 1.0,
        source: None,
    });
    let objects: Vec<_> = detections.map(Into::into).collect();
    // No pose is known: these methods do not need one.
    Message::Boxes(Boxes::new(NO_SOURCE, &objects))
}

fn boxes(message: &Message) -> Result<Vec<Box3d>, NotAligned> {
    match message {
        Message::Boxes(boxes) => Ok(boxes.detections().map(|found| found.box3d).collect()),
        _ => Err(NotAligned::Message),
    }
}
