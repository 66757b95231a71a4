//! A whole, indexed recording from what is left of one.

use std::path::Path;

use serde::Serialize;

use super::{Damage, OWN_ENCODING, Recording, RecordingError, RecordingOptions, RecordingWriter};

/// What was recovered.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecoverReport {
    /// Messages of the run, counted once.
    pub messages: u64,
    /// What is lost; nothing where the recording was whole.
    pub damage: Vec<Damage>,
}

/// Writes what can be read of the recording `from` into the new file `to`.
///
/// # Errors
/// [`RecordingError`] when `from` holds nothing of ours, or `to` is there already or cannot be written.
pub fn recover(from: &Path, to: &Path, options: RecordingOptions) -> Result<RecoverReport, RecordingError> {
    let recording = Recording::open(from)?;
    let mut writer = RecordingWriter::create(to, options)?;
    let mut messages = 0;
    for held in recording.all() {
        for message in held?.iter() {
            let (topic, encoding) = (&message.channel.topic, message.channel.message_encoding.as_str());
            // The channels for ROS 2 follow from ours.
            if matches!(encoding, OWN_ENCODING | "json")
                && let Ok(key) = topic.parse()
            {
                messages += 1;
                writer.write(&key, message.log_time, &message.data)?;
            }
        }
    }
    writer.finish()?;
    Ok(RecoverReport { messages, damage: recording.damage().to_vec() })
}
