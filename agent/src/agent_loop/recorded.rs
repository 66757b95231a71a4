//! Recorded inputs of an agent's loop, and the messages that were published from them.

use protocol::text::hex;
use protocol::{Encoded, Stamp, Stream};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::LoopInput;
use crate::input_log;
use crate::rate::Turn;

/// Kind of a log of an agent's inputs.
pub const KIND: &str = "agent inputs";

/// A record of an agent's inputs.
pub type AgentRecord = input_log::Record<LoopInput, Published>;

/// A published message: everything that its bytes depend on beside the inputs, and their digest.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Published {
    /// Its stream.
    pub stream: Stream,
    /// Its turn in the queue of the stream, on the loop's clock.
    pub turn: Turn,
    /// Stamp of the message.
    pub stamp: Stamp,
    /// Bytes on the wire, header included; 0 if it could not be encoded.
    pub bytes: u64,
    /// SHA-256 of these bytes, in hexadecimal digits.
    pub sha256: String,
}

impl Published {
    /// The record of a message; `None` for the bytes of one that could not be encoded.
    pub fn new(stream: Stream, turn: Turn, stamp: &Stamp, encoded: Option<&Encoded>) -> Self {
        let pieces = encoded.map_or([&[][..]; 2], Encoded::pieces);
        let hash = pieces.iter().fold(Sha256::new(), Sha256::chain_update);
        Self {
            stream,
            turn,
            stamp: stamp.clone(),
            bytes: encoded.map_or(0, Encoded::wire_bytes) as u64,
            sha256: hex(&hash.finalize()),
        }
    }
}
