//! A whole, indexed recording from what is left of one.

use std::path::Path;

use serde::Serialize;

use super::{Damage, OWN_ENCODING, Recording, RecordingError, RecordingOptions, RecordingWriter};

/// What was recovered.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct RecoverReport {
    /// Messages of the run, counted once.
    pub messages: u64,
    /// What is lost; nothing where the recording was whole.
    pub damage: Option<Damage>,
}

/// Writes what can be read of the recording `from` into the new file `to`.
///
/// # Errors
/// [`RecordingError`] when `from` holds nothing of ours, or `to` is there already or cannot be written.
pub fn recover(from: &Path, to: &Path, options: RecordingOptions) -> Result<RecoverReport, RecordingError> {
    let recording = Recording::open(from)?;
    let mut writer = RecordingWriter::create(to, options)?;
    let mut messages = 0;
    recording.for_each(|topic, encoding, arrived_nanos, data| {
        // The channels for ROS 2 follow from ours.
        let is_ours = encoding == OWN_ENCODING || encoding == "json";
        let Some(key) = topic.parse().ok().filter(|_| is_ours) else { return Ok(()) };
        messages += 1;
        writer.write(&key, arrived_nanos, data)
    })?;
    writer.finish()?;
    Ok(RecoverReport { messages, damage: recording.damage().cloned() })
}
