//! Recorded run: random access to its scene frames.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use dataset::evaluation_protocol::EvaluationProtocol;
use protocol::{
    Camera, CavId, Descriptor, Detections, Payload, PoseEstimate, Stream, Topic, Tracks, Truth,
};
use recording::{Entry, Recording, RecordingError, Result};
use serde::Serialize;
use support::sampling::distinct;

use super::frame_assembler::{FrameAssembler, ReceivedMessage, decoded};
use super::heat_map::HeatMap;
use super::judgement::{DetectionArea, Judge};
use super::link_series::{LinkSeries, LinkTraffic};
use super::live::Image;
use super::pace_counter::PaceCounter;
use super::scene_frame::{SceneFrame, ShownTrack};
use super::trails::Trails;
use crate::operate::run_folder::{RECORDING, SWEEP_LOG};
use crate::operate::status::RunStatus;
use crate::score::ms_between;

/// Reason why a run cannot be shown.
#[derive(Debug, thiserror::Error)]
pub enum ViewError {
    /// The run was not recorded.
    #[error("{}: there is no recording.mcap in it; record a run with `v2vloc up --record`", .0.display())]
    NotRecorded(PathBuf),
    /// The recording cannot be read.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// No message of the recording can be read.
    #[error("{}: none of its messages can be read: it is of another version of this program", .0.display())]
    OtherVersion(PathBuf),
    /// Neither truth nor detections in the recording.
    #[error("{}: no truth and no detections in it", .0.display())]
    Empty(PathBuf),
}

/// Score from which detections are shown and counted at first.
const SHOWN_SCORE: f32 = 0.2;

/// A run in a file.
pub struct RecordedRun {
    recording: Recording,
    moments: Vec<RecordedMoment>,
    /// One for each ego, in the order of their first results; one for a run without results.
    timelines: Vec<Timeline>,
    /// Arrival time of each sweep at the ego's agent, if the run recorded it.
    arrivals: BTreeMap<u64, u64>,
    /// Entries with the reports of all processes.
    stats: Vec<usize>,
    areas: BTreeMap<CavId, DetectionArea>,
    /// Protocol of the run, if its folder says it.
    protocol: Option<EvaluationProtocol>,
}

/// One scene frame: its messages in the recording.
struct RecordedMoment {
    capture_nanos: u64,
    /// Time of publication of its truth.
    began_nanos: Option<u64>,
    entries: Vec<usize>,
}

/// The results of one ego.
struct Timeline {
    ego: Option<CavId>,
    /// One for each moment.
    summaries: Vec<MomentSummary>,
    tracks: Vec<Option<Tracks>>,
    pace: PaceCounter,
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
    /// Traffic of the links to the ego.
    pub links: Vec<LinkTraffic>,
}

impl RecordedRun {
    /// Opens the recording at `path`, or that of the run folder `path`, and indexes it.
    ///
    /// # Errors
    /// [`ViewError`] when there is none, or it holds nothing to show.
    pub fn open(path: &Path) -> Result<Self, ViewError> {
        let file = if path.is_dir() {
            path.join(RECORDING)
        } else {
            path.to_path_buf()
        };
        if !file.is_file() {
            return Err(ViewError::NotRecorded(path.into()));
        }
        let recording = Recording::open(&file)?;
        for damage in recording.damage() {
            tracing::warn!("{}: {damage}", file.display());
        }
        if recording.entries().is_empty() {
            return Err(ViewError::OtherVersion(file));
        }
        let mut moments = BTreeMap::<u64, Vec<usize>>::new();
        let (mut stats, mut areas) = (Vec::new(), BTreeMap::new());
        for (index, entry) in recording.entries().iter().enumerate() {
            match &entry.key.topic {
                Topic::Stats(_) => stats.push(index),
                Topic::Stream { cav, stream } if *stream == Stream::Descriptor => {
                    if let Some(descriptor) = decoded::<Descriptor>(&recording.read(entry)?) {
                        areas.insert(cav.clone(), DetectionArea::from(&descriptor.grid));
                    }
                }
                Topic::Received { stream, .. } if *stream == Stream::Descriptor => {}
                Topic::Stream { .. } | Topic::Received { .. } | Topic::Truth => {
                    let capture_nanos = entry.header.stamp.capture_nanos;
                    moments.entry(capture_nanos).or_default().push(index);
                }
                Topic::Control(_) | Topic::Ready(_) | Topic::Alive { .. } => {}
            }
        }
        let arrivals =
            support::sweep_log::read(&file.with_file_name(SWEEP_LOG)).unwrap_or_default();
        let mut run = Self {
            recording,
            moments: Vec::new(),
            timelines: Vec::new(),
            arrivals,
            stats,
            areas,
            protocol: file
                .parent()
                .and_then(|folder| RunStatus::read(folder).ok()?.protocol),
        };
        let shown = moments
            .into_iter()
            .filter_map(|(at, entries)| run.moment(at, entries));
        run.moments = shown.collect();
        if run.moments.is_empty() {
            return Err(ViewError::Empty(file));
        }
        let egos = run.egos_with_results();
        let no_ego = egos.is_empty().then_some(None);
        run.timelines = egos
            .into_iter()
            .map(Some)
            .chain(no_ego)
            .map(|ego| run.timeline_of(ego))
            .collect::<Result<_, _>>()?;
        Ok(run)
    }

    /// Name of the run.
    pub fn name(&self) -> &str {
        let first = self.recording.entries().first();
        first.map_or("", |entry| entry.key.run.as_str())
    }

    /// Number of scene frames, at least one.
    pub fn count(&self) -> usize {
        self.moments.len()
    }

    /// Entries of the timeline of an ego, or of the first ego.
    pub(crate) fn timeline(&self, ego: Option<&CavId>) -> &[MomentSummary] {
        self.shown(ego).map_or(&[], |timeline| &timeline.summaries)
    }

    /// A scene frame, counted from 0, with the results of an ego, or of the first ego; `None` after the last.
    ///
    /// # Errors
    /// [`RecordingError`] when the file has changed.
    pub fn frame(&self, index: usize, ego: Option<&CavId>) -> Result<Option<SceneFrame>> {
        let (Some(moment), Some(timeline)) = (self.moments.get(index), self.shown(ego)) else {
            return Ok(None);
        };
        let mut assembly = FrameAssembler::new(self.protocol.clone(), self.areas.clone())
            .for_ego(timeline.ego.clone());
        let arrivals = self.entries_of(moment).map(|entry| entry.arrived_nanos);
        // Reports until the last message of the moment: what was known at that time.
        let until = arrivals.max().unwrap_or(0);
        // Results come last, and complete the scene frame.
        let (results, others): (Vec<usize>, Vec<usize>) = moment
            .entries
            .iter()
            .partition(|at| is_result(&self.entry(**at).key.topic));
        // Last report of every process until then.
        let mut last = BTreeMap::new();
        for &index in &self.stats {
            let entry = self.entry(index);
            if entry.arrived_nanos <= until {
                last.insert(&entry.key.topic, index);
            }
        }
        let reports = last.into_values();
        for number in reports.chain(others).chain(results) {
            let entry = self.entry(number);
            let payload = is_wanted(&entry.key.topic)
                .then(|| self.recording.read(entry))
                .transpose()?;
            let shown = assembly.add(&ReceivedMessage {
                topic: &entry.key.topic,
                header: &entry.header,
                arrived_nanos: entry.arrived_nanos,
                payload: payload.as_deref(),
            });
            if let Some(frame) = shown {
                return Ok(Some(self.complete(frame, index, timeline)));
            }
        }
        let frame = assembly.show(moment.capture_nanos);
        Ok(frame.map(|frame| self.complete(frame, index, timeline)))
    }

    /// The image of a camera at a scene frame; `None` if there is none.
    ///
    /// # Errors
    /// [`RecordingError`] when the file has changed.
    pub(super) fn image(&self, index: usize, cav: &CavId, number: u8) -> Result<Option<Image>> {
        let bytes = self.message(index, cav, Stream::Camera(number))?;
        let camera = bytes.and_then(|bytes| decoded::<Camera>(&bytes));
        Ok(camera.map(|Camera { metadata, image }| (metadata.format, image.into())))
    }

    /// The heat map of a vehicle's feature map at a scene frame; `None` if it published none.
    ///
    /// # Errors
    /// [`RecordingError`] when the file has changed.
    pub(super) fn heat_map(&self, index: usize, cav: &CavId) -> Result<Option<HeatMap>> {
        let bytes = self.message(index, cav, Stream::Bev)?;
        Ok(bytes.and_then(|bytes| HeatMap::of(&bytes)))
    }

    fn message(&self, index: usize, cav: &CavId, stream: Stream) -> Result<Option<Vec<u8>>> {
        let topic = Topic::stream(cav, stream);
        let moment = self.moments.get(index).into_iter();
        let mut entries = moment.flat_map(|moment| self.entries_of(moment));
        let entry = entries.find(|entry| entry.key.topic == topic);
        entry.map(|entry| self.recording.read(entry)).transpose()
    }

    /// Numbers of the cameras of any vehicle.
    pub(super) fn cameras(&self) -> BTreeSet<u8> {
        let numbers = self.streams().filter_map(|(_, stream)| match stream {
            Stream::Camera(number) => Some(number),
            _ => None,
        });
        numbers.collect()
    }

    /// All egos, in the order of their first results.
    pub(super) fn egos(&self) -> impl Iterator<Item = &CavId> + Clone {
        self.timelines.iter().filter_map(|of| of.ego.as_ref())
    }

    /// Vehicle and stream of each message that a vehicle published.
    pub(super) fn streams(&self) -> impl Iterator<Item = (&CavId, Stream)> + Clone {
        let entries = self.recording.entries().iter();
        entries.filter_map(|entry| match &entry.key.topic {
            Topic::Stream { cav, stream } => Some((cav, *stream)),
            _ => None,
        })
    }

    fn shown(&self, ego: Option<&CavId>) -> Option<&Timeline> {
        let mut timelines = self.timelines.iter();
        let asked = timelines.find(|timeline| ego.is_some() && timeline.ego.as_ref() == ego);
        asked.or(self.timelines.first())
    }

    /// All egos, in the order of their first results.
    fn egos_with_results(&self) -> Vec<CavId> {
        let moments = self.moments.iter();
        let entries = moments.flat_map(|moment| self.entries_of(moment));
        let egos = entries.filter_map(|entry| match &entry.key.topic {
            topic @ Topic::Stream { cav, .. } if is_result(topic) => Some(cav),
            _ => None,
        });
        distinct(egos).into_iter().cloned().collect()
    }

    /// `None` if there is neither truth nor result.
    fn moment(&self, capture_nanos: u64, entries: Vec<usize>) -> Option<RecordedMoment> {
        let mut all = entries.iter().map(|index| self.entry(*index));
        let truth = all.clone().find(|entry| entry.key.topic == Topic::Truth);
        let began_nanos = truth.map(|entry| entry.header.stamp.publish_nanos);
        let is_shown = truth.is_some() || all.any(|entry| is_result(&entry.key.topic));
        is_shown.then_some(RecordedMoment {
            capture_nanos,
            began_nanos,
            entries,
        })
    }

    fn timeline_of(&self, ego: Option<CavId>) -> Result<Timeline> {
        let links = ego
            .as_ref()
            .map(|ego| LinkSeries::new(self.recording.entries(), ego));
        let links = links.unwrap_or_default();
        let (mut pace, mut judge) = (PaceCounter::default(), Judge::new(self.protocol.clone()));
        let mut summaries = Vec::with_capacity(self.moments.len());
        let mut tracks = Vec::with_capacity(self.moments.len());
        for (index, moment) in self.moments.iter().enumerate() {
            let mut summary = self.summary(moment, ego.as_ref(), &mut judge)?;
            summary.links = links.at(moment.capture_nanos, moment.began_nanos);
            if let Some(began) = moment.began_nanos {
                let done = summary
                    .latency_ms
                    .map(|ms| began.saturating_add((ms * 1e6) as u64));
                pace.tick(done);
            }
            summaries.push(summary);
            let ego = ego.as_ref();
            let found = ego.map(|ego| self.message(index, ego, Stream::Tracks));
            let found = found.transpose()?.flatten();
            tracks.push(found.and_then(|bytes| decoded(&bytes)));
        }
        Ok(Timeline {
            ego,
            summaries,
            tracks,
            pace,
        })
    }

    /// Adds what is known of a whole recording.
    fn complete(&self, frame: SceneFrame, index: usize, timeline: &Timeline) -> SceneFrame {
        let times = self.moments.get(index).and_then(|moment| {
            let arrived = *self.arrivals.get(&moment.capture_nanos)?;
            Some((moment.began_nanos?, arrived))
        });
        let swept_ms = times.map(|(began, arrived)| ms_between(began, arrived));
        let summary = timeline.summaries.get(index);
        SceneFrame {
            swept_ms,
            tracks: self.tracks_at(index, timeline),
            pace: timeline.pace.pace(),
            ap_50: summary.and_then(|summary| summary.ap_50),
            egos: self.egos().cloned().collect(),
            ..frame
        }
    }

    /// Tracks of a scene frame with their trails, the same on every way to it.
    fn tracks_at(&self, index: usize, timeline: &Timeline) -> Vec<ShownTrack> {
        let (mut trails, mut shown) = (Trails::default(), Vec::new());
        let now = self.moments.get(index);
        let now_nanos = now.map_or(0, |moment| moment.capture_nanos);
        let until = self.moments.iter().zip(&timeline.tracks).take(index + 1);
        for (RecordedMoment { capture_nanos, .. }, tracks) in until {
            if Trails::covers(now_nanos, *capture_nanos) {
                let tracks = tracks.as_ref();
                shown = tracks.map_or(Vec::new(), |tracks| trails.add(*capture_nanos, tracks));
            }
        }
        shown
    }

    fn entries_of<'a>(&'a self, moment: &'a RecordedMoment) -> impl Iterator<Item = &'a Entry> {
        moment.entries.iter().map(|index| self.entry(*index))
    }

    fn entry(&self, index: usize) -> &Entry {
        &self.recording.entries()[index]
    }

    fn summary(
        &self,
        moment: &RecordedMoment,
        ego: Option<&CavId>,
        judge: &mut Judge,
    ) -> Result<MomentSummary> {
        let mut summary = MomentSummary {
            capture_s: moment.capture_nanos as f64 / 1e9,
            ..MomentSummary::default()
        };
        let (mut truth, mut result) = (None, None);
        for entry in self.entries_of(moment) {
            match &entry.key.topic {
                Topic::Truth => truth = self.published::<Truth>(entry)?,
                topic @ Topic::Stream { cav, .. } if is_result(topic) && Some(cav) == ego => {
                    result = self.published::<Detections>(entry)?;
                }
                _ => {}
            }
        }
        if let Some((done, result)) = &result {
            summary.detected = result.detections.len();
            summary.fused = result.fused.len();
            if let Some((began, truth)) = &truth {
                summary.latency_ms = Some(ms_between(*began, *done));
                summary.ego_error_m = ego_error_m(&result.pose, truth, result);
                let area = self.areas.get(&result.ego);
                summary.judged =
                    area.map(|area| judge.judge(result, truth, area).counts(result, SHOWN_SCORE));
            }
        }
        summary.ap_50 = judge.average_precision();
        Ok(summary)
    }

    /// Time of publication and content of a message; `None` if it is damaged.
    fn published<M: Payload>(&self, entry: &Entry) -> Result<Option<(u64, M)>> {
        let message = decoded(&self.recording.read(entry)?);
        Ok(message.map(|message| (entry.header.stamp.publish_nanos, message)))
    }
}

fn ego_error_m(pose: &PoseEstimate, truth: &Truth, result: &Detections) -> Option<f64> {
    let agent = truth.agents.iter().find(|agent| agent.cav == result.ego)?;
    Some(protocol::PoseError::between(pose.world_from_cav()?, &agent.world_from_lidar).distance_m)
}

fn is_result(topic: &Topic) -> bool {
    matches!(topic, Topic::Stream { stream, .. } if *stream == Stream::Detections)
}

/// True if a message's content is shown, and not only its arrival.
fn is_wanted(topic: &Topic) -> bool {
    use Stream::{Boxes, Detections, Lidar, Pose};
    match topic {
        Topic::Stream { stream, .. } => [Lidar, Pose, Boxes, Detections].contains(stream),
        _ => matches!(topic, Topic::Truth | Topic::Stats(_)),
    }
}
