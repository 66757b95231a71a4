//! Frames of a recording: its messages by capture time, in any order of access.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use dataset::LoadOptions;
use dataset::evaluation_protocol::{EvaluationProtocol, ScoredRun};
use protocol::{Kind, Stream, Topic};
use recording::{Entry, Recording};

use crate::frame_parts::{FrameParts, is_part_of_frames};

/// A recording, and the messages of each of its frames.
pub(crate) struct RecordingFrames {
    recording: Recording,
    /// Name of the recorded run.
    pub(crate) run: String,
    /// Capture times and indices of their messages, in order.
    pub(crate) frames: Vec<(u64, Vec<usize>)>,
    /// Protocol by which the run was scored; `None` outside of a run folder.
    pub(crate) protocol: Option<EvaluationProtocol>,
    /// The scored ego; outside of a run folder the first by name.
    ego: Option<String>,
    /// Parts of the files that cannot be read, and several egos of which none is the scored one.
    pub(crate) problems: Vec<String>,
}

impl RecordingFrames {
    pub(crate) fn open(
        path: &Path,
        options: &LoadOptions,
    ) -> Result<Self, recording::RecordingError> {
        let recording = Recording::open(path)?;
        let mut frames: BTreeMap<u64, Vec<usize>> = BTreeMap::new();
        let mut egos = BTreeSet::new();
        for (index, Entry { key, header, .. }) in recording.entries().iter().enumerate() {
            if is_part_of_frames(&key.topic) && is_wanted(&key.topic, options) {
                let messages = frames.entry(header.stamp.capture_nanos).or_default();
                messages.push(index);
            }
            if let Topic::Stream { cav, stream } = &key.topic
                && *stream == Stream::Detections
            {
                egos.insert(cav.to_string());
            }
        }
        let first = recording.entries().first();
        let run = first.map_or_else(String::new, |entry| entry.key.run.to_string());
        let damage = recording.damage().iter().map(ToString::to_string);
        let mut problems: Vec<String> = damage.collect();
        let scores = ScoredRun::beside(path).unwrap_or_else(|cause| {
            problems.push(cause.to_string());
            ScoredRun::default()
        });
        let ego = scores.ego.map(|ego| ego.to_string());
        let scored = ego.filter(|ego| egos.contains(ego));
        if scored.is_none() && egos.len() > 1 {
            problems.push(format!("results of {egos:?}: Frame.ego is the first"));
        }
        Ok(Self {
            recording,
            run,
            frames: frames.into_iter().collect(),
            protocol: scores.protocol,
            ego: scored.or_else(|| egos.pop_first()),
            problems,
        })
    }

    /// Reads the messages of a frame. One that cannot be read or decoded is left out and named.
    pub(crate) fn load(&self, index: usize, protocol: &EvaluationProtocol) -> Option<FrameParts> {
        let (capture_nanos, messages) = self.frames.get(index)?;
        let mut parts = FrameParts::empty(&self.run, *capture_nanos, protocol);
        parts.ego.clone_from(&self.ego);
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
