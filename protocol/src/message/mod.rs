//! The messages: one struct of public fields per kind.
//!
//! What is small stands in the metadata, what is large in the body. Metadata are checked when they are decoded and, by the
//! same rules, when they are encoded, so that a mistake shows where it was made; bodies are checked by those who receive
//! them.

mod bev;
mod boxes;
mod control;
mod descriptor;
mod detections;
mod gnss;
mod pose_estimate;
mod stats;
mod sweep;
mod truth;

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::Body;
use crate::BodyShape;
use crate::Kind;
use crate::Limits;
use crate::Pose;
use crate::WireError;

pub use bev::{Bev, BevMetadata};
pub use boxes::Boxes;
pub use control::{Control, TopicCount};
pub use descriptor::{Descriptor, ModelHash};
pub use detections::{Detections, DetectionsReport, FusedNeighbour, HeardNeighbour, SkippedNeighbour};
pub use gnss::{Gnss, GnssSource};
pub use pose_estimate::{NoPoseReason, PoseEstimate};
pub use stats::{StageSummary, StageTiming, Stats};
pub use sweep::{Lidar, Points, PointsMetadata, Radar, SweepMetadata};
pub use truth::{AgentTruth, TrueObject, Truth};

/// A struct that is one kind of message. Only this crate's messages are.
pub trait Payload: Sized + private::Sealed {
    /// The kind that names it on the wire.
    const KIND: Kind;
    /// What of it stands in the metadata.
    type Metadata: Serialize + DeserializeOwned;

    /// Takes the message apart, copying nothing large.
    fn into_parts(self) -> (Self::Metadata, Body);

    /// Checks all values of the metadata and says what the body has to be.
    ///
    /// # Errors
    /// [`WireError`] names the field and its bounds.
    fn check(metadata: &Self::Metadata, limits: &Limits) -> Result<BodyShape, WireError>;

    /// Puts checked metadata and a body of the shape they ask for together.
    ///
    /// # Errors
    /// [`WireError::Shape`] when the body is of another type.
    fn from_parts(metadata: Self::Metadata, body: Body) -> Result<Self, WireError>;
}

mod private {
    pub trait Sealed {}
}

/// A message of any kind, for those who handle all: recorder, link, tests.
#[derive(Debug, Clone, PartialEq)]
pub enum Message {
    /// A LiDAR sweep.
    Lidar(Lidar),
    /// A radar sweep.
    Radar(Radar),
    /// A recorded or GNSS pose.
    Gnss(Gnss),
    /// A pose estimate.
    Pose(PoseEstimate),
    /// A BEV feature map.
    Bev(Bev),
    /// Detections of one agent.
    Boxes(Boxes),
    /// Points of one agent.
    Points(Points),
    /// What an agent is going to send.
    Descriptor(Descriptor),
    /// What the ego detected.
    Detections(Detections),
    /// True poses and objects.
    Truth(Truth),
    /// Start, stop, readiness.
    Control(Control),
    /// Ledger and timings of a process.
    Stats(Stats),
}

/// RunScope `$body` with `$message` bound to the message inside, whatever its kind.
macro_rules! for_message {
    ($any:expr, $message:ident => $body:expr) => {
        match $any {
            Message::Lidar($message) => $body,
            Message::Radar($message) => $body,
            Message::Gnss($message) => $body,
            Message::Pose($message) => $body,
            Message::Bev($message) => $body,
            Message::Boxes($message) => $body,
            Message::Points($message) => $body,
            Message::Descriptor($message) => $body,
            Message::Detections($message) => $body,
            Message::Truth($message) => $body,
            Message::Control($message) => $body,
            Message::Stats($message) => $body,
        }
    };
}
pub(crate) use for_message;

impl Message {
    /// What kind it is.
    #[must_use]
    pub fn kind(&self) -> Kind {
        fn kind_of<M: Payload>(_: &M) -> Kind {
            M::KIND
        }
        for_message!(self, message => kind_of(message))
    }
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

            fn check(metadata: &Self, limits: &crate::Limits) -> Result<crate::BodyShape, crate::WireError> {
                metadata.check_values(limits)?;
                Ok(crate::BodyShape::Empty)
            }

            fn from_parts(metadata: Self, _: crate::Body) -> Result<Self, crate::WireError> {
                Ok(metadata)
            }
        }
    };
}
use metadata_only;

fn check_within(what: &'static str, value: f64, min: f64, max: f64) -> Result<(), WireError> {
    // NaN is within nothing.
    if (min..=max).contains(&value) { Ok(()) } else { Err(WireError::Value { what, index: 0, value, min, max }) }
}

fn check_count(what: &'static str, found: usize, max: usize) -> Result<(), WireError> {
    if found <= max { Ok(()) } else { Err(WireError::Limit { what, max: max as u64, found: found as u64 }) }
}

fn check_pose(what: &'static str, pose: &Pose) -> Result<(), WireError> {
    pose.validate().map_err(|source| WireError::Pose { what, source })
}

/// Names inside metadata: stages, classes.
fn check_name(what: &'static str, name: &str) -> Result<(), WireError> {
    check_count(what, name.len(), 64)
}

fn wrong_body(shape: BodyShape, body: &Body) -> WireError {
    let expected = match shape {
        BodyShape::Empty => 0,
        BodyShape::Bytes { min, .. } => min,
        BodyShape::Floats(count) => count.saturating_mul(4),
        BodyShape::Points(count) => count.saturating_mul(16),
    };
    WireError::Shape { what: "body bytes", expected, found: body.len() as u64 }
}

/// The longest time a process takes for anything, in the eyes of a receiver: one day.
const MAX_NANOS: u64 = 86_400_000_000_000;

fn check_nanos(what: &'static str, nanos: u64) -> Result<(), WireError> {
    if nanos <= MAX_NANOS { Ok(()) } else { Err(WireError::Limit { what, max: MAX_NANOS, found: nanos }) }
}

/// A box from outside: finite, of positive and plausible size.
fn check_box(box3d: &crate::Box3d) -> Result<(), WireError> {
    check_box_from(box3d, 1e-3)
}

/// [`check_box`] with another smallest size, metres.
fn check_box_from(box3d: &crate::Box3d, min_size_m: f64) -> Result<(), WireError> {
    for coordinate in box3d.center_m {
        check_within("box center_m", coordinate, -1e7, 1e7)?;
    }
    for size in box3d.size_m {
        check_within("box size_m", size, min_size_m, 1e3)?;
    }
    check_within("box heading_rad", box3d.heading_rad, -1e3, 1e3)
}

fn check_detections(detections: &[crate::Detection], limits: &Limits) -> Result<(), WireError> {
    check_count("detections", detections.len(), limits.max_boxes)?;
    for detection in detections {
        check_box(&detection.box3d)?;
        check_within("detection score", detection.score.into(), 0.0, 1.0)?;
    }
    Ok(())
}
