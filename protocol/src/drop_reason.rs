//! Why messages are lost.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Why a message was not used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DropReason {
    /// Lost on the emulated air.
    LinkLoss,
    /// The emulated air's queue was full.
    LinkQueue,
    /// A newer one took its place before it was used.
    Superseded,
    /// Too old when it came.
    Stale,
    /// The same one had come before.
    Duplicate,
    /// Not a message, or not of this kind.
    Decode,
    /// Changed on the way.
    Checksum,
    /// Sizes that do not agree with each other, with what was announced, or with the limits; maps of another network.
    Shape,
    /// A value that is NaN, infinite or out of bounds.
    NotFinite,
    /// Sent under another's name.
    Identity,
    /// Of another wire version.
    Version,
    /// Sender or receiver does not know where it is.
    NoPose,
    /// From a vehicle farther away than vehicles talk to each other.
    OutOfRange,
}

impl DropReason {
    /// Every reason.
    pub const ALL: [Self; 13] = [
        Self::LinkLoss,
        Self::LinkQueue,
        Self::Superseded,
        Self::Stale,
        Self::Duplicate,
        Self::Decode,
        Self::Checksum,
        Self::Shape,
        Self::NotFinite,
        Self::Identity,
        Self::Version,
        Self::NoPose,
        Self::OutOfRange,
    ];

    /// Whether data were lost that should have been used: not by what the air does to them, and not for being rightly
    /// left out.
    #[must_use]
    pub fn is_loss(self) -> bool {
        !matches!(self, Self::LinkLoss | Self::LinkQueue | Self::OutOfRange)
    }

    /// Its name, as in reports: `link_loss`.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::LinkLoss => "link_loss",
            Self::LinkQueue => "link_queue",
            Self::Superseded => "superseded",
            Self::Stale => "stale",
            Self::Duplicate => "duplicate",
            Self::Decode => "decode",
            Self::Checksum => "checksum",
            Self::Shape => "shape",
            Self::NotFinite => "not_finite",
            Self::Identity => "identity",
            Self::Version => "version",
            Self::NoPose => "no_pose",
            Self::OutOfRange => "out_of_range",
        }
    }
}

impl fmt::Display for DropReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reasons_have_the_names_of_the_design() {
        for reason in DropReason::ALL {
            assert_eq!(serde_json::to_string(&reason).unwrap(), format!("\"{reason}\""));
        }
    }
}
