//! Frames of a recording: its messages by capture time, in any order of access.

use std::collections::BTreeMap;
use std::path::Path;

use dataset::LoadOptions;
use dataset::evaluation_protocol::EvaluationProtocol;
use protocol::{Kind, Topic};
use recording::{Entry, Recording};

use crate::frame_parts::{FrameParts, is_part_of_frames};

/// A recording, and the messages of each of its frames.
pub(crate) struct RecordingFrames {
    recording: Recording,
    /// Name of the recorded run.
    pub(crate) run: String,
    /// Capture times and indices of their messages, in order.
    pub(crate) frames: Vec<(u64, Vec<usize>)>,
}

impl RecordingFrames {
    pub(crate) fn open(
        path: &Path,
        options: &LoadOptions,
    ) -> Result<Self, recording::RecordingError> {
        let recording = Recording::open(path)?;
        let mut frames: BTreeMap<u64, Vec<usize>> = BTreeMap::new();
        for (index, Entry { key, header, .. }) in recording.entries().iter().enumerate() {
            if is_part_of_frames(&key.topic) && is_wanted(&key.topic, options) {
                let messages = frames.entry(header.stamp.capture_nanos).or_default();
                messages.push(index);
            }
        }
        let first = recording.entries().first();
        let run = first.map_or_else(String::new, |entry| entry.key.run.to_string());
        Ok(Self {
            recording,
            run,
            frames: frames.into_iter().collect(),
        })
    }

    /// Parts of the file that cannot be read.
    pub(crate) fn problems(&self) -> Vec<String> {
        let damage = self.recording.damage().iter();
        damage.map(ToString::to_string).collect()
    }

    /// Reads the messages of a frame. One that cannot be read or decoded is left out and named.
    pub(crate) fn load(&self, index: usize, protocol: &EvaluationProtocol) -> Option<FrameParts> {
        let (capture_nanos, messages) = self.frames.get(index)?;
        let mut parts = FrameParts::empty(&self.run, *capture_nanos, protocol);
        let entries = self.recording.entries();
        for entry in messages.iter().filter_map(|&index| entries.get(index)) {
            let bytes = self.recording.read(entry);
            let added = bytes.map_err(|cause| cause.to_string()).and_then(|bytes| {
                let added = parts.add(&entry.key.topic, [bytes.as_slice()]);
                added.map_err(|cause| cause.to_string())
            });
            if let Err(cause) = added {
                parts.problems.push(format!("{}: {cause}", entry.key));
            }
        }
        Some(parts)
    }
}

fn is_wanted(topic: &Topic, options: &LoadOptions) -> bool {
    match topic.kind() {
        Some(Kind::Lidar | Kind::Points) => options.points,
        Some(Kind::Radar) => options.radar,
        Some(Kind::Camera) => options.cameras,
        _ => true,
    }
}
