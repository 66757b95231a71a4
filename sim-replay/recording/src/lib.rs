//! Recordings of a run: every published message in [MCAP](https://mcap.dev), written and read.
//!
//! A recording holds two kinds of channels:
//!
//! | topic | encoding | content |
//! | --- | --- | --- |
//! | `v2v/<run>/...`, the key | `v2vloc`, or `json` | the message as transmitted, byte for byte |
//! | those of the crate [`ros2`], for example `/cav_1000/points` | `cdr`, schemas `ros2msg` | the same for ROS 2 tools |
//!
//! The first are for this program: a replay publishes exactly the recorded messages. The second are for Foxglove, Rerun
//! and other readers of MCAP. Log times are the arrival at the recorder on the Unix clock; header stamps are capture times
//! on the scene's clock.
//!
//! rosbag2 refuses a file with a channel that has no schema, as the first kind has none: [`export_ros2`] writes a bag of
//! the second kind only.
//!
//! The file grows by whole chunks of at most some MiB or a second, each with its own checksum. A file that ends within
//! a chunk (power, disk, `kill -9`) is read up to its last whole chunk, a file with a changed bit is read without that
//! chunk ([`Recording::damage`] lists the losses), and [`recover`] makes an indexed file of it again. Files rewritten
//! by other programs are read too: compressed by zstd or lz4, or with messages outside of chunks.
//!
//! ```
//! use protocol::{CavId, Key, Pose, PoseEstimate, RunId, Stamp, Stream, wire};
//! use recording::{Recording, RecordingOptions, RecordingWriter};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let path = std::env::temp_dir().join(format!("v2vloc-{}.mcap", std::process::id()));
//! let cav = CavId::new("4279")?;
//! let key = Key::stream(&RunId::new("demo")?, &cav, Stream::Pose);
//! let stamp = Stamp { cav, epoch: 7, sequence: 1, capture_nanos: 100_000_000, publish_nanos: 0 };
//! let message = wire::encode(&stamp, PoseEstimate::new(Pose::from_xyz_yaw([12.0, -3.5, 1.9], 0.3), 0.8))?.to_vec();
//!
//! let mut writer = RecordingWriter::create(&path, RecordingOptions::default())?;
//! writer.write(&key, 1_700_000_000_000_000_000, &message)?;
//! writer.finish()?;
//!
//! let recording = Recording::open(&path)?;
//! assert!(recording.damage().is_empty());
//! assert_eq!(recording.read(&recording.entries()[0])?, message);
//! # std::fs::remove_file(&path)?;
//! # Ok(())
//! # }
//! ```

// This crate reads what other processes and people wrote: an index or a cast that does not fit is an error there, not
// a panic or another number.
#![cfg_attr(not(test), deny(clippy::cast_possible_truncation))]
#![cfg_attr(not(test), deny(clippy::cast_sign_loss))]
#![cfg_attr(not(test), deny(clippy::indexing_slicing))]

mod chunk;
mod damage;
mod error;
mod export;
mod lengths;
mod mcap_file;
mod reader;
mod records;
mod recover;
mod sink;
mod writer;

pub use damage::Damage;
pub use error::{RecordingError, Result};
pub use export::{ExportReport, ExportTimes, export_ros2};
pub use mcap_file::{McapFile, McapPlace};
pub use reader::{Entry, Recording};
pub use recover::{RecoverReport, recover};
pub use sink::Store;
pub use writer::{Contents, RecordingOptions, RecordingWriter};

/// Encoding of the channels that hold messages as transmitted.
pub(crate) const OWN_ENCODING: &str = "v2vloc";

#[cfg(test)]
mod tests;
