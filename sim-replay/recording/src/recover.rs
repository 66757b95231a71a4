//! Recovery: makes a complete, indexed recording from a damaged one.

use std::path::Path;

use serde::Serialize;

use super::{Damage, OWN_ENCODING, Recording, RecordingOptions, RecordingWriter};
use crate::Result;

/// Result of a recovery.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecoverReport {
    /// Messages of the run, counted once.
    pub messages: u64,
    /// Lost parts; empty if the recording was complete.
    pub damage: Vec<Damage>,
}

/// Writes the readable part of the recording `from` into the new file `to`.
///
/// # Errors
/// [`crate::RecordingError`] if `from` holds no message of this program, or `to` exists already or cannot be written.
pub fn recover(from: &Path, to: &Path, options: RecordingOptions) -> Result<RecoverReport> {
    let recording = Recording::open(from)?;
    RecordingWriter::whole(to, options, |writer| {
        let mut messages = 0;
        for held in recording.file.all() {
            for message in held?.iter() {
                let encoding = message.channel.message_encoding.as_str();
                // The channels for ROS 2 are derived from these.
                if matches!(encoding, OWN_ENCODING | "json")
                    && let Ok(key) = message.channel.topic.parse()
                {
                    messages += 1;
                    writer.write(&key, message.log_time, &message.data)?;
                }
            }
        }
        writer.finish()?;
        Ok(RecoverReport {
            messages,
            damage: recording.damage().to_vec(),
        })
    })
}
