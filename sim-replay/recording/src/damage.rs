//! Parts of a recording that cannot be read.

use std::fmt;

use serde::Serialize;

/// A lost part of a recording: cut off, or with a changed bit.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Damage {
    /// Start of the part, bytes.
    pub begin_bytes: u64,
    /// Its length, bytes; none of it is read.
    pub lost_bytes: u64,
    /// Arrival of the last message before it, seconds since the first of the recording; `None` if there is none before
    /// it.
    pub from_s: Option<f64>,
    /// Arrival of the first message after it, likewise; `None` if there is none after it.
    pub to_s: Option<f64>,
    /// The fault found there.
    pub reason: String,
}

impl fmt::Display for Damage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (begin, lost) = (self.begin_bytes, self.lost_bytes);
        write!(f, "{lost} bytes from byte {begin} on are lost, ")?;
        match (self.from_s, self.to_s) {
            (Some(from), Some(to)) => write!(f, "from {from:.1} s to {to:.1} s")?,
            (Some(from), None) => write!(f, "from {from:.1} s on")?,
            (None, Some(to)) => write!(f, "until {to:.1} s after its first message")?,
            (None, None) => write!(f, "with all its messages")?,
        }
        write!(f, ": {}", self.reason)
    }
}
