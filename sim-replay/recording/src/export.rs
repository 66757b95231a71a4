//! Export: a bag of ROS 2 from a recording.

use std::collections::BTreeSet;
use std::path::Path;

use protocol::{CavId, Topic};
use ros2::{Mount, Translator};
use serde::Serialize;

use super::{
    Contents, Damage, Entry, Recording, RecordingError, RecordingOptions, RecordingWriter,
};

/// Times of the messages in a bag.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum ExportTimes {
    /// Capture times, as in the headers: `ros2 bag play --clock` gives `/clock` and stamps on one time base. Latencies are
    /// lost.
    #[default]
    #[value(help = "Capture times, as in the headers")]
    Capture,
    /// Times of arrival at the recorder, on the Unix clock.
    #[value(help = "Arrival at the recorder")]
    Arrival,
}

/// Result of an export.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ExportReport {
    /// Messages of the run that are in the bag, counted once.
    pub messages: u64,
    /// Messages that ROS 2 has no type for, feature maps for example.
    pub left_out: u64,
    /// Parts of the recording that could not be read.
    pub damage: Vec<Damage>,
}

/// Writes what ROS 2 has types for in the recording `from` into the new bag `to`: every channel has a schema, encoding
/// `cdr` and a quality of service, and times are in order.
///
/// # Errors
/// [`RecordingError`] if `from` holds no message of this program, or `to` exists already or cannot be written.
pub fn export_ros2(
    from: &Path,
    to: &Path,
    times: ExportTimes,
    mount: &Mount,
    zstd_level: Option<u32>,
) -> Result<ExportReport, RecordingError> {
    let recording = Recording::open(from)?;
    let entries = recording.entries().iter();
    let wanted = entries.filter(|entry| Translator::wants(&entry.key.topic));
    let wanted: Vec<&Entry> = wanted.collect();
    let timed = in_order(&wanted, |entry| match times {
        ExportTimes::Capture if matches!(entry.key.topic, Topic::Stats(_)) => None,
        ExportTimes::Capture => Some(entry.header.stamp.capture_nanos),
        ExportTimes::Arrival => Some(entry.arrived_nanos),
    });
    if timed.is_empty() {
        let reason = "it holds no message that can be read and that ROS 2 has a type for; recordings of other versions of this program cannot be read";
        return Err(RecordingError::not_ours(from, reason));
    }
    let options = RecordingOptions {
        zstd_level,
        contents: Contents::Ros2,
    };
    let vehicles = wanted.iter().filter_map(|entry| match &entry.key.topic {
        Topic::Stream { cav, .. } => Some(cav.clone()),
        _ => None,
    });
    let vehicles: BTreeSet<CavId> = vehicles.collect();
    let messages = RecordingWriter::whole(to, options, |writer| {
        // The mounts come before the first sweep, whose frame refers to them.
        if let Some((first, _)) = timed.first().filter(|_| !vehicles.is_empty()) {
            writer.write_static_transforms(*first, &vehicles, mount)?;
        }
        for (nanos, entry) in timed {
            writer.write(&entry.key, nanos, &recording.read(entry)?)?;
        }
        writer.finish()?;
        Ok(writer.whole_messages())
    })?;
    Ok(ExportReport {
        messages,
        left_out: (recording.entries().len() as u64).saturating_sub(messages),
        damage: recording.damage().to_vec(),
    })
}

/// Entries by time. One without a time of its own gets that of the entry before it.
fn in_order<'a>(
    entries: &[&'a Entry],
    nanos: impl Fn(&Entry) -> Option<u64>,
) -> Vec<(u64, &'a Entry)> {
    let mut latest = entries.iter().find_map(|entry| nanos(entry)).unwrap_or(0);
    let timed = entries.iter().map(|entry| {
        latest = nanos(entry).unwrap_or(latest);
        (latest, *entry)
    });
    let mut timed: Vec<_> = timed.collect();
    // A stable sort: messages of the same time keep the order of the recording.
    timed.sort_by_key(|(nanos, _)| *nanos);
    timed
}
