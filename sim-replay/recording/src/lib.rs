//! A run in a file: everything that was said, in [MCAP](https://mcap.dev), and back out of it.
//!
//! A recording holds two kinds of channels:
//!
//! | topic | encoding | content |
//! | --- | --- | --- |
//! | `v2v/<run>/...`, the key | `v2vloc`, or `json` | the message as it was on the wire, byte for byte |
//! | `/<cav>/points`, `/<cav>/pose`, `/<cav>/detections`, `/truth`, `/tf` | `cdr`, schemas `ros2msg` | the same for ROS 2 tools |
//!
//! The first are for this program: what is replayed from them is exactly what was recorded. The second are for Foxglove,
//! Rerun and whatever else reads ROS 2 bags. Log times are the arrival at the recorder on the Unix clock; header stamps
//! are capture times on the scene's clock.
//!
//! The file grows by whole chunks of at most some MiB or a second, each with its own checksum. One that ends in the middle
//! of a chunk (power, disk, `kill -9`) reads up to its last whole chunk, one with a bit that is not as it was written reads
//! but for that chunk ([`Recording::damage`] says what is lost), and [`recover`] makes an indexed file of it again. Files that
//! other programs have rewritten are read too: packed by zstd or lz4, or with messages that stand in no chunk.

mod chunk;
mod damage;
mod error;
mod lengths;
mod reader;
mod records;
mod recover;
mod ros;
mod ros_schema;
mod sink;
mod writer;

pub use damage::Damage;
pub use error::RecordingError;
pub use reader::{Entry, Recording};
pub use recover::{RecoverReport, recover};
pub use sink::Store;
pub use writer::{RecordingOptions, RecordingWriter};

/// Encoding of the channels that hold messages as they were on the wire.
pub(crate) const OWN_ENCODING: &str = "v2vloc";

#[cfg(test)]
mod tests;
