//! What can be wrong with a message, and under which reason its loss is counted.

use crate::CavId;
use crate::DropReason;
use crate::IdError;
use crate::PoseError;
use crate::header::{HEADER_LEN, Kind, MAGIC, WIRE_VERSION};

/// Why bytes are not a message, or values cannot become one.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum WireError {
    /// Fewer bytes than a header, or than the header announces.
    #[error("message has {found} bytes, its header and lengths need {expected}")]
    Truncated {
        /// Bytes needed.
        expected: u64,
        /// Bytes there.
        found: u64,
    },
    /// More bytes than the header announces.
    #[error("message has {found} bytes, its header announces {expected}")]
    TrailingBytes {
        /// Bytes announced.
        expected: u64,
        /// Bytes there.
        found: u64,
    },
    /// Not a message of this program.
    #[error("message starts with {found:02x?}, not with {MAGIC:02x?}")]
    Magic {
        /// The first four bytes.
        found: [u8; 4],
    },
    /// A message of another version.
    #[error("message is of wire version {found}, this program speaks {WIRE_VERSION}")]
    Version {
        /// Its version.
        found: u16,
    },
    /// A number that names no kind.
    #[error("message is of the unknown kind {found}")]
    UnknownKind {
        /// The number.
        found: u8,
    },
    /// A message of another kind than this key carries.
    #[error("message is of kind {found}, expected {expected}")]
    Kind {
        /// Kind that belongs here.
        expected: Kind,
        /// Kind in the header.
        found: Kind,
    },
    /// The name in the header is no identifier, or not padded with zeros.
    #[error("header names no CAV: {0}")]
    Cav(#[source] IdError),
    /// Header and key (or certificate) name different vehicles.
    #[error("message of CAV {found} came under the name of CAV {expected}")]
    Identity {
        /// Who the key says is speaking.
        expected: CavId,
        /// Who the header says is speaking.
        found: CavId,
    },
    /// The first {HEADER_LEN} bytes were changed on the way.
    #[error("header checksum is {found:08x}, its {HEADER_LEN} bytes give {expected:08x}")]
    HeaderChecksum {
        /// Computed here.
        expected: u32,
        /// Carried by the message.
        found: u32,
    },
    /// Metadata or body were changed on the way.
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
        /// What the decoder says.
        detail: String,
    },
    /// More than the receiver takes.
    #[error("{what}: {found}, at most {max} are taken")]
    Limit {
        /// What is counted.
        what: &'static str,
        /// The limit.
        max: u64,
        /// How much the message has, or claims.
        found: u64,
    },
    /// Two sizes that have to agree do not.
    #[error("{what}: {found}, expected {expected}")]
    Shape {
        /// Which size.
        what: &'static str,
        /// What it has to be.
        expected: u64,
        /// What it is.
        found: u64,
    },
    /// The lattice is not the one that was agreed on.
    #[error("feature map lies on {found}, expected {expected}")]
    Grid {
        /// The agreed lattice.
        expected: String,
        /// The message's lattice.
        found: String,
    },
    /// A number that is NaN, infinite or beyond its bounds.
    #[error("{what}[{index}] is {value}, not a number within {min}..={max}")]
    Value {
        /// Which field.
        what: &'static str,
        /// Where in it; 0 for a scalar.
        index: usize,
        /// The number.
        value: f64,
        /// Lower bound.
        min: f64,
        /// Upper bound.
        max: f64,
    },
    /// Numbers that are no pose.
    #[error("{what}: {source}")]
    Pose {
        /// Which pose.
        what: &'static str,
        /// What is wrong with it.
        source: PoseError,
    },
    /// A compressed body that does not unpack to what it announces.
    #[error("compressed body of {bytes} bytes, {expected} unpacked: {detail}")]
    Compression {
        /// Compressed size.
        bytes: u64,
        /// Size that shape and codec demand of the unpacked body.
        expected: u64,
        /// What the decoder says.
        detail: String,
    },
    /// A byte budget that cannot hold the parts every selection has.
    #[error("budget of {budget} bytes cannot hold scales and cell mask, which take {needed}")]
    Budget {
        /// The configured budget.
        budget: u64,
        /// The least that any selection takes.
        needed: u64,
    },
    /// Cells cannot be selected without a confidence for each.
    #[error("a byte budget needs a confidence map, one value for each of {cells} cells")]
    NoConfidence {
        /// Cells of the map.
        cells: u64,
    },
}

impl WireError {
    /// The reason under which the ledger counts a message lost to this error.
    #[must_use]
    pub fn drop_reason(&self) -> DropReason {
        match self {
            Self::Truncated { .. }
            | Self::TrailingBytes { .. }
            | Self::Magic { .. }
            | Self::UnknownKind { .. }
            | Self::Kind { .. }
            | Self::Metadata { .. }
            | Self::Compression { .. } => DropReason::Decode,
            Self::Version { .. } => DropReason::Version,
            Self::Cav(_) | Self::Identity { .. } => DropReason::Identity,
            Self::HeaderChecksum { .. } | Self::Checksum { .. } => DropReason::Checksum,
            Self::Limit { .. }
            | Self::Shape { .. }
            | Self::Grid { .. }
            | Self::Budget { .. }
            | Self::NoConfidence { .. } => DropReason::Shape,
            Self::Value { .. } | Self::Pose { .. } => DropReason::NotFinite,
        }
    }
}
