//! Recorded run: random access to its scene frames.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use bytes::Bytes;
use protocol::{Camera, CavId, Descriptor, Detections, ImageFormat, Limits, PoseEstimate, Stream, Topic, Truth, wire};
use recording::{Entry, Recording, RecordingError};
use serde::Serialize;

use super::frame_assembler::{FrameAssembler, ReceivedMessage};
use super::judgement::{DetectionArea, Judge};
use super::pace_counter::PaceCounter;
use super::scene_frame::SceneFrame;
use crate::operate::run_folder::{RECORDING, SWEEP_LOG};

/// Reason why a run cannot be shown.
#[derive(Debug, thiserror::Error)]
pub enum ViewError {
    /// The run was not recorded.
    #[error("{}: there is no recording.mcap in it; record a run with `v2vloc up --record`", .0.display())]
    NotRecorded(PathBuf),
    /// The recording cannot be read.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// Neither truth nor detections in the recording.
    #[error("{}: no truth and no detections in it", .0.display())]
    Empty(PathBuf),
}

/// Score from which detections are shown and counted at first.
const SHOWN_SCORE: f32 = 0.2;

/// A run in a file.
pub struct RecordedRun {
    recording: Recording,
    name: String,
    moments: Vec<Moment>,
    /// Arrival time of each sweep at the ego's agent, if the run recorded it.
    swept: BTreeMap<u64, u64>,
    /// Entries with the reports of all processes.
    stats: Vec<usize>,
    pace: PaceCounter,
    assembly: Mutex<FrameAssembler>,
}

/// One scene frame: its messages in the recording, and its entry in the timeline.
struct Moment {
    capture_nanos: u64,
    /// Time of publication of its truth.
    began_nanos: Option<u64>,
    entries: Vec<usize>,
    summary: MomentSummary,
}

/// Entry of a scene frame in the timeline.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(crate) struct MomentSummary {
    /// Capture time on the scene's clock, seconds.
    pub capture_s: f64,
    /// From the publication of the tick to that of its detections, milliseconds; `None` without detections.
    pub latency_ms: Option<f64>,
    /// Number of detected boxes.
    pub detected: usize,
    /// True positives, false positives and missed objects at a score of 0.2; `None` if that is not known.
    pub judged: Option<[usize; 3]>,
    /// Average precision at an IoU of 0.5 until this frame.
    pub ap_50: Option<f64>,
    /// Number of fused neighbours.
    pub fused: usize,
    /// Distance of the ego's pose from the truth, metres.
    pub ego_error_m: Option<f64>,
}

impl RecordedRun {
    /// Opens the recording at `path`, or that of the run folder `path`, and indexes it.
    ///
    /// # Errors
    /// [`ViewError`] when there is none, or it holds nothing to show.
    pub fn open(path: &Path) -> Result<Self, ViewError> {
        let file = if path.is_dir() { path.join(RECORDING) } else { path.to_path_buf() };
        if !file.is_file() {
            return Err(ViewError::NotRecorded(path.into()));
        }
        let recording = Recording::open(&file)?;
        for damage in recording.damage() {
            tracing::warn!("{}: {damage}", file.display());
        }
        let name = recording.entries().first().map_or(String::new(), |entry| entry.key.run.to_string());
        let mut moments = BTreeMap::<u64, Vec<usize>>::new();
        let (mut stats, mut areas) = (Vec::new(), BTreeMap::new());
        for (index, entry) in recording.entries().iter().enumerate() {
            match &entry.key.topic {
                Topic::Stats(_) => stats.push(index),
                Topic::Stream { cav, stream: Stream::Descriptor } => {
                    let bytes = recording.read(entry)?;
                    if let Ok((_, descriptor)) = wire::decode::<Descriptor>([bytes.as_slice()], &Limits::DEFAULT) {
                        areas.insert(cav.clone(), DetectionArea::from(&descriptor.grid));
                    }
                }
                Topic::Received { stream: Stream::Descriptor, .. } => {}
                Topic::Stream { .. } | Topic::Received { .. } | Topic::Truth => {
                    moments.entry(entry.header.stamp.capture_nanos).or_default().push(index);
                }
                Topic::Control(_) | Topic::Ready(_) | Topic::Alive { .. } => {}
            }
        }
        let swept = support::sweep_log::read(&file.with_file_name(SWEEP_LOG)).unwrap_or_default();
        let (pace, mut judge) = (PaceCounter::default(), Judge::default());
        let assembly = Mutex::new(FrameAssembler::with_areas(areas.clone()));
        let mut run = Self { recording, name, moments: Vec::new(), swept, stats, pace, assembly };
        for (capture_nanos, entries) in moments {
            if let Some(summary) = run.summary(capture_nanos, &entries, &areas, &mut judge)? {
                let truth = entries.iter().map(|index| run.entry(*index)).find(|entry| entry.key.topic == Topic::Truth);
                let began_nanos = truth.map(|entry| entry.header.stamp.publish_nanos);
                if let Some(began) = began_nanos {
                    run.pace.tick(summary.latency_ms.map(|latency_ms| began.saturating_add((latency_ms * 1e6) as u64)));
                }
                run.moments.push(Moment { capture_nanos, began_nanos, entries, summary });
            }
        }
        if run.moments.is_empty() { Err(ViewError::Empty(file)) } else { Ok(run) }
    }

    /// Name of the run.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Number of scene frames.
    #[must_use]
    pub fn len(&self) -> usize {
        self.moments.len()
    }

    /// Always false: an empty recording cannot be opened.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.moments.is_empty()
    }

    /// Entries of the timeline.
    pub(crate) fn timeline(&self) -> impl Iterator<Item = &MomentSummary> {
        self.moments.iter().map(|moment| &moment.summary)
    }

    /// A scene frame, counted from 0; `None` after the last.
    ///
    /// # Errors
    /// [`RecordingError`] when the file has changed.
    pub fn frame(&self, index: usize) -> Result<Option<SceneFrame>, RecordingError> {
        let Some(moment) = self.moments.get(index) else { return Ok(None) };
        let mut assembly = self.assembly.lock().unwrap_or_else(PoisonError::into_inner);
        assembly.rewind();
        let until = moment.entries.iter().map(|entry| self.entry(*entry).arrived_nanos).max().unwrap_or(0);
        // Results come last, and complete the scene frame.
        let (results, others): (Vec<usize>, Vec<usize>) =
            moment.entries.iter().partition(|entry| is_result(&self.entry(**entry).key.topic));
        for index in self.reports_until(until).into_iter().chain(others).chain(results) {
            let entry = self.entry(index);
            let payload = if is_wanted(&entry.key.topic) { Some(self.recording.read(entry)?) } else { None };
            let Entry { key, header, arrived_nanos, .. } = entry;
            let (topic, payload) = (&key.topic, payload.as_deref());
            let shown = assembly.add(&ReceivedMessage { topic, header, arrived_nanos: *arrived_nanos, payload });
            if shown.is_some() {
                return Ok(shown.map(|frame| self.with_sweep(frame, moment)));
            }
        }
        Ok(assembly.show(moment.capture_nanos).map(|frame| self.with_sweep(frame, moment)))
    }

    /// The image of a camera at a scene frame; `None` if there is none.
    ///
    /// # Errors
    /// [`RecordingError`] when the file has changed.
    pub(super) fn image(
        &self,
        index: usize,
        cav: &CavId,
        number: u8,
    ) -> Result<Option<(ImageFormat, Bytes)>, RecordingError> {
        let topic = Topic::Stream { cav: cav.clone(), stream: Stream::Camera(number) };
        let entries = self.moments.get(index).into_iter().flat_map(|moment| &moment.entries);
        let Some(entry) = entries.map(|entry| self.entry(*entry)).find(|entry| entry.key.topic == topic) else {
            return Ok(None);
        };
        let bytes = self.recording.read(entry)?;
        let decoded = wire::decode::<Camera>([bytes.as_slice()], &Limits::DEFAULT).ok();
        Ok(decoded.map(|(_, Camera { metadata, image })| (metadata.format, image.into())))
    }

    /// Numbers of the cameras of any vehicle.
    pub(super) fn cameras(&self) -> BTreeSet<u8> {
        let numbers = self.recording.entries().iter().filter_map(|entry| match entry.key.topic {
            Topic::Stream { stream: Stream::Camera(number), .. } => Some(number),
            _ => None,
        });
        numbers.collect()
    }

    fn with_sweep(&self, frame: SceneFrame, moment: &Moment) -> SceneFrame {
        let swept = self.swept.get(&moment.capture_nanos).zip(moment.began_nanos);
        let swept_ms = swept.map(|(swept, began)| (*swept as f64 - began as f64) / 1e6);
        SceneFrame { swept_ms, pace: self.pace.pace(), ap_50: moment.summary.ap_50, ..frame }
    }

    fn entry(&self, index: usize) -> &Entry {
        &self.recording.entries()[index]
    }

    /// Last report of every process until `nanos`.
    fn reports_until(&self, nanos: u64) -> Vec<usize> {
        let mut last = BTreeMap::new();
        for index in self.stats.iter().copied().filter(|index| self.entry(*index).arrived_nanos <= nanos) {
            last.insert(&self.entry(index).key.topic, index);
        }
        last.into_values().collect()
    }

    /// `None` if there is neither truth nor result.
    fn summary(
        &self,
        capture_nanos: u64,
        entries: &[usize],
        areas: &BTreeMap<CavId, DetectionArea>,
        judge: &mut Judge,
    ) -> Result<Option<MomentSummary>, RecordingError> {
        let mut summary = MomentSummary { capture_s: capture_nanos as f64 / 1e9, ..MomentSummary::default() };
        let (mut truth, mut result) = (None, None);
        for entry in entries.iter().map(|index| self.entry(*index)) {
            let is_truth = entry.key.topic == Topic::Truth;
            if !is_truth && !is_result(&entry.key.topic) {
                continue;
            }
            let bytes = self.recording.read(entry)?;
            let published = entry.header.stamp.publish_nanos;
            if is_truth {
                truth = wire::decode::<Truth>([bytes.as_slice()], &Limits::DEFAULT).ok().map(|(_, it)| (published, it));
            } else {
                result = wire::decode::<Detections>([bytes.as_slice()], &Limits::DEFAULT)
                    .ok()
                    .map(|(_, it)| (published, it));
            }
        }
        if let Some((done, result)) = &result {
            summary.detected = result.detections.len();
            summary.fused = result.fused.len();
            if let Some((began, truth)) = &truth {
                summary.latency_ms = Some((*done as f64 - *began as f64) / 1e6);
                summary.ego_error_m = ego_error_m(&result.pose, truth, result);
                let area = areas.get(&result.ego);
                summary.judged = area.map(|area| judge.judge(result, truth, area).counts(result, SHOWN_SCORE));
            }
        }
        summary.ap_50 = judge.average_precision();
        Ok((truth.is_some() || result.is_some()).then_some(summary))
    }
}

fn ego_error_m(pose: &PoseEstimate, truth: &Truth, result: &Detections) -> Option<f64> {
    let agent = truth.agents.iter().find(|agent| agent.cav == result.ego)?;
    Some(protocol::PoseError::between(pose.world_from_cav()?, &agent.world_from_lidar).distance_m)
}

fn is_result(topic: &Topic) -> bool {
    matches!(topic, Topic::Stream { stream: Stream::Detections, .. })
}

/// True if a message's content is shown, and not only its arrival.
fn is_wanted(topic: &Topic) -> bool {
    const SHOWN: [Stream; 4] = [Stream::Lidar, Stream::Pose, Stream::Boxes, Stream::Detections];
    matches!(topic, Topic::Truth | Topic::Stats(_))
        || matches!(topic, Topic::Stream { stream, .. } if SHOWN.contains(stream))
}
