//! Descriptor of an agent: model, grid and streams.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::{check_count, check_limit, metadata_only};
use crate::string_enum::written_as_text;
use crate::{BevGrid, Dtype, Limits, Stream, WireError};

/// Model and streams of an agent: agent to ego, once it is ready and to every late joiner.
///
/// An ego compares it with its own network before any feature map arrives.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Descriptor {
    /// Hash of the weights its features come from.
    pub model_hash: ModelHash,
    /// BEV grid of its feature maps.
    pub grid: BevGrid,
    /// Channels of its feature maps.
    pub channels: u32,
    /// Number format of its feature maps.
    pub dtype: Dtype,
    /// Streams that it publishes.
    pub streams: Vec<Stream>,
    /// Sweeps since the descriptor before, oldest first. The capture time of the newest is that of the message.
    pub sweeps: Vec<SweepArrival>,
}

/// Arrival of a sweep at its agent. An ego compares the capture clocks of vehicles with it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct SweepArrival {
    /// Capture time of the newest sweep minus that of this one, nanoseconds.
    pub before_nanos: u64,
    /// Arrival, nanoseconds on the Unix clock of the agent.
    pub arrived_nanos: u64,
}

impl Descriptor {
    fn check_values(&self, limits: &Limits) -> Result<(), WireError> {
        self.grid.check(limits)?;
        check_limit("channels", self.channels.into(), limits.max_channels.into())?;
        check_count("sweeps", self.sweeps.len(), limits.max_entries)?;
        check_count("streams", self.streams.len(), limits.max_entries)
    }
}

metadata_only!(Descriptor, Descriptor);

/// SHA-256 (or any other 256-bit hash) of a weights file; as text, and in metadata, 64 lower-case hexadecimal digits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct ModelHash(pub [u8; 32]);

/// A text that is not 64 lower-case hexadecimal digits.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is no model hash: 64 lower-case hexadecimal digits")]
pub struct ModelHashError(String);

impl fmt::Display for ModelHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl FromStr for ModelHash {
    type Err = ModelHashError;

    fn from_str(text: &str) -> Result<Self, ModelHashError> {
        hash_of(text).ok_or_else(|| ModelHashError(text.chars().take(80).collect()))
    }
}

fn hash_of(text: &str) -> Option<ModelHash> {
    let mut hash = ModelHash([0; 32]);
    for (byte, digits) in hash.0.iter_mut().zip(text.as_bytes().chunks(2)) {
        *byte = u8::from_str_radix(str::from_utf8(digits).ok()?, 16).ok()?;
    }
    // Signs, capitals and other lengths are no part of its spelling.
    (hash.to_string() == text).then_some(hash)
}

written_as_text!(ModelHash);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hash_is_its_own_spelling() {
        let text = "00ff".repeat(16);
        assert_eq!(text.parse::<ModelHash>().unwrap().to_string(), text);
        for bad in [
            "",
            "00",
            &"0".repeat(63),
            &"0".repeat(65),
            &"G".repeat(64),
            &"F".repeat(64),
            &"é".repeat(32),
        ] {
            assert!(bad.parse::<ModelHash>().is_err(), "{bad}");
        }
    }
}
