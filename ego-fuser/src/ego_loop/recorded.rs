//! Recorded inputs of an ego's loop: everything that a run decides from, and the times that only a clock knows.

use protocol::message::{ModelHash, StageTiming};
use protocol::{Limits, Stamp, wire};
use serde::{Deserialize, Serialize};

use crate::ego::Ego;

use super::{EgoLoop, Input, Message, Reception, Refusal};

/// Kind of a log of an ego's inputs.
pub const KIND: &str = "ego inputs";

/// A record of an ego's inputs.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub enum Record {
    /// Beginning of the run.
    Start {
        /// Configuration of the process, as JSON.
        config: String,
        /// Hash of the ego's network.
        model_hash: ModelHash,
        /// Version of the program.
        version: String,
    },
    /// Something that happened to the ego.
    Input {
        /// Time on the loop's clock, nanoseconds.
        now_nanos: u64,
        /// Input, with messages as on the wire.
        input: Input<WireMessage>,
    },
    /// A result was published: its stamp, and the measured durations of its stages.
    Published {
        /// Stamp of the message.
        stamp: Stamp,
        /// Durations of the stages.
        stages: Vec<StageTiming>,
    },
}

impl Record {
    /// First record of a process with that configuration, as JSON.
    #[must_use]
    pub fn start(config: String, ego: &Ego) -> Self {
        Self::Start {
            config,
            model_hash: ego.detector().model_hash(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
        }
    }
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
