//! Errors of messages, and the drop reason under which each is counted.

use crate::CavId;
use crate::header::{HEADER_LEN, MAGIC, WIRE_VERSION};
use crate::{DropReason, IdError, InvalidPose, Kind};

/// Result of reading or writing a message: a [`WireError`] if nothing else is named.
pub(crate) type Result<T, E = WireError> = std::result::Result<T, E>;

/// Error of decoding or encoding a message.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum WireError {
    /// Fewer bytes than a header, or than the header announces.
    #[error("message has {found} bytes, its header and lengths need {expected}")]
    Truncated {
        /// Bytes needed.
        expected: u64,
        /// Bytes found.
        found: u64,
    },
    /// More bytes than the header announces.
    #[error("message has {found} bytes, its header announces {expected}")]
    TrailingBytes {
        /// Bytes announced.
        expected: u64,
        /// Bytes found.
        found: u64,
    },
    /// Not a message of this program, by its first four bytes.
    #[error("message starts with {0:02x?}, not with {MAGIC:02x?}")]
    Magic([u8; 4]),
    /// A message of another wire version.
    #[error("message is of wire version {0}, this program supports {WIRE_VERSION}")]
    Version(u16),
    /// A number that is no message kind.
    #[error("message is of the unknown kind {0}")]
    UnknownKind(u8),
    /// A message of another kind than this key carries.
    #[error("message is of kind {found}, expected {expected}")]
    Kind {
        /// Kind that belongs to the key.
        expected: Kind,
        /// Kind in the header.
        found: Kind,
    },
    /// The name in the header is no identifier, or not padded with zeros.
    #[error("header names no CAV: {0}")]
    Cav(#[source] IdError),
    /// Header and key (or certificate) name different vehicles.
    #[error("message names CAV {found} as its sender, its key names CAV {expected}")]
    Identity {
        /// Sender named in the key.
        expected: CavId,
        /// Sender named in the header.
        found: CavId,
    },
    /// The first {HEADER_LEN} bytes were corrupted in transit.
    #[error("header checksum is {found:08x}, its {HEADER_LEN} bytes give {expected:08x}")]
    HeaderChecksum {
        /// Computed here.
        expected: u32,
        /// Carried by the message.
        found: u32,
    },
    /// Metadata or body were corrupted in transit.
    #[error("payload checksum is {found:08x}, the bytes give {expected:08x}")]
    Checksum {
        /// Computed here.
        expected: u32,
        /// Carried by the message.
        found: u32,
    },
    /// Metadata that do not decode.
    #[error("metadata of a {kind} message: {detail}")]
    Metadata {
        /// Kind of the message.
        kind: Kind,
        /// Error text of the decoder.
        detail: String,
    },
    /// More than the receiver permits.
    #[error("{what}: {found}, at most {max} are permitted")]
    Limit {
        /// Quantity that is limited.
        what: &'static str,
        /// The limit.
        max: u64,
        /// Value found in the message, or claimed by it.
        found: u64,
    },
    /// Two sizes that have to agree do not.
    #[error("{what}: {found}, expected {expected}")]
    Shape {
        /// Name of the size.
        what: &'static str,
        /// Required size.
        expected: u64,
        /// Size found.
        found: u64,
    },
    /// A text with a control character, which could forge lines of a terminal.
    #[error("{what}: control character {found:?}, none is permitted")]
    ControlCharacter {
        /// Name of the field.
        what: &'static str,
        /// The first one.
        found: char,
    },
    /// The grid is not the agreed one: that of the message and the agreed one.
    #[error("feature map has the grid {0}")]
    Grid(String),
    /// A number that is NaN, infinite or beyond its bounds.
    #[error("{what}[{index}] is {value}, not a number within {min}..={max}")]
    Value {
        /// Name of the field.
        what: &'static str,
        /// Index in the field; 0 for a scalar.
        index: usize,
        /// The number.
        value: f64,
        /// Lower bound.
        min: f64,
        /// Upper bound.
        max: f64,
    },
    /// Numbers that are not a valid pose.
    #[error("{what}: {source}")]
    Pose {
        /// Name of the pose.
        what: &'static str,
        /// Error of the pose.
        source: InvalidPose,
    },
    /// A compressed body that does not decompress to the announced size: its size, the size that shape and codec require of
    /// the decompressed body, and the error text of the decoder.
    #[error("compressed body of {0}")]
    Compression(String),
    /// A byte budget that cannot hold the parts of an empty selection.
    #[error("budget of {budget} bytes cannot hold scales and cell mask, which take {needed}")]
    Budget {
        /// The configured budget.
        budget: u64,
        /// Size of an empty selection.
        needed: u64,
    },
    /// Cells of a map, of this number, cannot be selected without a confidence for each.
    #[error("a byte budget needs a confidence map, one value for each of {0} cells")]
    NoConfidence(u64),
}

impl WireError {
    /// Two sizes that have to agree and do not.
    pub(crate) fn shape(what: &'static str, expected: u64, found: u64) -> Self {
        Self::Shape {
            what,
            expected,
            found,
        }
    }

    /// Drop reason under which the ledger counts a message lost to this error.
    pub fn drop_reason(&self) -> DropReason {
        match self {
            Self::Truncated { .. }
            | Self::TrailingBytes { .. }
            | Self::Magic(_)
            | Self::UnknownKind(_)
            | Self::Kind { .. }
            | Self::Metadata { .. }
            | Self::Compression { .. } => DropReason::Decode,
            Self::Version(_) => DropReason::Version,
            Self::Cav(_) | Self::Identity { .. } => DropReason::Identity,
            Self::HeaderChecksum { .. } | Self::Checksum { .. } => DropReason::Checksum,
            Self::Limit { .. }
            | Self::Shape { .. }
            | Self::ControlCharacter { .. }
            | Self::Grid { .. }
            | Self::Budget { .. }
            | Self::NoConfidence(_) => DropReason::Shape,
            Self::Value { .. } | Self::Pose { .. } => DropReason::NotFinite,
        }
    }
}
