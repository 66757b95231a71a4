//! Inputs and outputs of an ego's loop.

use std::time::Duration;

use protocol::message::{Descriptor, Detections};
use protocol::{CavId, DropReason, Pace, Stream, Tracks};
use serde::{Deserialize, Serialize};

use crate::capture_clock::SweepTime;
use crate::ego::EgoError;
use crate::view::View;

/// Something that happens to an ego. Its messages are decoded, or in a recording as on the wire.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub enum Input<M = Box<Message>> {
    /// A vehicle's perception has arrived.
    Message(M),
    /// An agent has named its network.
    Model(CavId, Descriptor),
    /// An agent has reported the arrivals of its sweeps, on the ego's clock.
    Sweeps(CavId, Vec<SweepTime>),
    /// A neighbour has joined: frames wait for its messages.
    Joined(CavId),
    /// A neighbour has left.
    Left(CavId),
    /// A vehicle sends no more. After the own agent's end the loop ends.
    Ended(CavId),
    /// The oldest frame is decided, if it waits for nothing more.
    Wake,
}

impl<M> Input<M> {
    /// The input with its message converted.
    pub(crate) fn try_map<N, E>(
        self,
        convert: impl FnOnce(M) -> Result<N, E>,
    ) -> Result<Input<N>, E> {
        Ok(match self {
            Self::Message(message) => Input::Message(convert(message)?),
            Self::Model(cav, descriptor) => Input::Model(cav, descriptor),
            Self::Sweeps(cav, sweeps) => Input::Sweeps(cav, sweeps),
            Self::Joined(cav) => Input::Joined(cav),
            Self::Left(cav) => Input::Left(cav),
            Self::Ended(cav) => Input::Ended(cav),
            Self::Wake => Input::Wake,
        })
    }
}

/// Sender of a message, and what is measured when it arrives.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Reception {
    /// Sender.
    pub cav: CavId,
    /// Arrival on the loop's clock, nanoseconds.
    pub arrived_nanos: u64,
    /// Time from the publication to the arrival; `None` if the sender has another clock.
    pub transport: Option<Duration>,
    /// System clock of the sender minus the ego's, seconds, minus the shortest transit time; `None`: unknown.
    pub clock_offset_s: Option<f64>,
}

/// A vehicle's perception as received.
#[derive(Debug, Clone)]
pub struct Message {
    /// Sender and arrival.
    pub reception: Reception,
    /// Sender, pose and content, with the capture time that the sender states.
    pub view: View,
    /// Sequence of the message.
    pub sequence: u64,
    /// Bytes of metadata and body.
    pub payload_bytes: u64,
    /// Bytes of all messages for this frame, headers and the pose message included.
    pub wire_bytes: u64,
}

/// A vehicle and the stream of its messages.
pub type Source = (CavId, Stream);

/// Something that an ego does.
#[derive(Debug)]
pub enum Output {
    /// Publishes the result of a frame.
    Publish {
        /// Capture time of the ego's sweep, nanoseconds.
        capture_nanos: u64,
        /// The result.
        result: Box<Detections>,
        /// The tracks after it, if the ego tracks.
        tracks: Option<Tracks>,
    },
    /// A frame has no result.
    Failed {
        /// Capture time of the ego's sweep, nanoseconds.
        capture_nanos: u64,
        /// Cause.
        error: EgoError,
    },
    /// Counts a message of a vehicle's stream as used, or as not used for a reason.
    Counted(Source, Option<DropReason>),
    /// Publishes the share of sweeps that the fleet computes.
    Pace(Pace),
}
