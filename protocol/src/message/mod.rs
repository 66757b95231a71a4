//! The messages: one struct of public fields per kind.
//!
//! Small fields are in the metadata, large ones in the body. Metadata are checked when they are decoded and, by the
//! same rules, when they are encoded, so that an error is reported at its origin; bodies are checked by receivers.

mod bev;
mod boxes;
mod camera;
mod control;
mod descriptor;
mod detections;
mod ego_motion;
mod frame_report;
mod gnss;
mod pace;
mod pose_estimate;
mod stats;
mod sweep;
mod table;
mod tracks;
mod truth;

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::checks::{check_limit, check_within};
use crate::text::MAX_MESSAGE_BYTES;
use crate::{Body, BodyShape, Limits, Pose, Result, WireError};

pub use bev::Bev;
pub use boxes::{Boxes, ObjectTrack, PerceivedObject};
pub use camera::{Camera, CameraMetadata, ImageFormat, Pinhole};
pub use control::{Control, TopicCount};
pub use descriptor::{Descriptor, ModelHash, SweepArrival};
pub use detections::{Detections, FusedNeighbour, NeighbourState, SkippedNeighbour};
pub use ego_motion::EgoMotion;
pub use frame_report::{DetectionsReport, FrameReport, TracksReport};
pub use gnss::{Gnss, GnssSource};
pub use pace::Pace;
pub use pose_estimate::{NoPoseReason, PlanarCovariance, PoseEstimate};
pub use stats::{ProcessUsage, StageSummary, StageTiming, Stats, ThreadUsage, TopicTraffic};
pub use sweep::{Lidar, Points, PointsMetadata, Radar, SweepMetadata};
pub use table::{Kind, Message};
pub(crate) use table::{MessageSource, MessageVisitor};
pub use tracks::{Track, Tracks};
pub use truth::{AgentTruth, TrueObject, Truth};

/// One kind of message. Implemented by messages of this crate only.
pub trait Payload: Sized + private::Sealed {
    /// The kind on the wire.
    const KIND: Kind;
    /// Fields in the metadata.
    type Metadata: Serialize + DeserializeOwned;

    /// Splits the message into metadata and body, copying nothing large.
    fn into_parts(self) -> (Self::Metadata, Body);

    /// Checks all values of the metadata and returns the required shape of the body.
    ///
    /// # Errors
    /// [`WireError`] states the field and its bounds.
    fn check(metadata: &Self::Metadata, limits: &Limits) -> Result<BodyShape>;

    /// Assembles a message from checked metadata and a body of the required shape.
    ///
    /// # Errors
    /// [`WireError::Shape`] when the body is of another type.
    fn from_parts(metadata: Self::Metadata, body: Body) -> Result<Self>;
}

mod private {
    pub trait Sealed {}
}

/// Implements [`Payload`] for messages that are metadata only; `check` is their own method.
macro_rules! metadata_only {
    ($name:ident, $kind:ident) => {
        impl crate::message::private::Sealed for $name {}

        impl crate::message::Payload for $name {
            const KIND: crate::Kind = crate::Kind::$kind;
            type Metadata = Self;

            fn into_parts(self) -> (Self, crate::Body) {
                (self, crate::Body::Empty)
            }

            fn check(metadata: &Self, limits: &crate::Limits) -> crate::Result<crate::BodyShape> {
                metadata.check_values(limits)?;
                Ok(crate::BodyShape::Empty)
            }

            fn from_parts(metadata: Self, _: crate::Body) -> crate::Result<Self> {
                Ok(metadata)
            }
        }
    };
}
use metadata_only;

fn check_count(what: &'static str, found: usize, max: usize) -> Result<()> {
    check_limit(what, found as u64, max as u64)
}

fn check_pose(what: &'static str, pose: &Pose) -> Result<()> {
    pose.validate()
        .map_err(|source| WireError::Pose { what, source })
}

/// Checks texts in metadata: names of stages and classes, problems. They reach the terminals of others.
fn check_text(what: &'static str, text: &str) -> Result<()> {
    check_count(what, text.len(), MAX_MESSAGE_BYTES)?;
    match text.chars().find(|letter| letter.is_control()) {
        Some(found) => Err(WireError::ControlCharacter { what, found }),
        None => Ok(()),
    }
}

fn wrong_body(expected: u64, body: &Body) -> WireError {
    WireError::shape("body bytes", expected, body.len() as u64)
}

/// Maximum duration that a receiver accepts, nanoseconds: one day.
const MAX_NANOS: u64 = 86_400_000_000_000;

fn check_nanos(what: &'static str, nanos: u64) -> Result<()> {
    check_limit(what, nanos, MAX_NANOS)
}

fn check_detection(detection: &crate::Detection) -> Result<()> {
    detection.box3d.check()?;
    check_within("detection score", detection.score.into(), 0.0, 1.0)
}
