//! Recorded inputs of an ego's loop: everything that a run decides from, and the times that only a clock knows.

use agent::input_log;
use protocol::message::StageTiming;
use protocol::{Limits, Stamp, Stream, wire};
use serde::{Deserialize, Serialize};

use super::{EgoLoop, Input, Message, Reception, Refusal};

/// Kind of a log of an ego's inputs.
pub const KIND: &str = "ego inputs, 3";

/// A record of an ego's inputs.
pub type EgoRecord = input_log::Record<Input<WireMessage>, PublishedResult>;

/// Published detections or tracks: their stamp, and the measured durations of stages.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct PublishedResult {
    /// Their stream.
    pub stream: Stream,
    /// Stamp of the message.
    pub stamp: Stamp,
    /// Durations of the stages; empty for tracks.
    pub stages: Vec<StageTiming>,
}

/// A message as on the wire, header included.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct WireMessage {
    /// Sender, and measurements at the arrival.
    pub reception: Reception,
    /// Header, metadata and body.
    pub bytes: Vec<u8>,
}

impl WireMessage {
    /// Decodes the message as the loop did when it was recorded.
    ///
    /// # Errors
    /// As [`EgoLoop::decode`].
    pub(crate) fn decode(&self, of: &EgoLoop, limits: &Limits) -> Result<Message, Refusal> {
        let header = wire::decode_header([self.bytes.as_slice()])?;
        of.decode(&self.reception, &header, [self.bytes.as_slice()], limits)
    }
}
