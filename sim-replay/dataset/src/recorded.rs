//! Recordings of live runs ([`recording`]) as scenes: sensor data and ground truth as they were published.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use protocol::{
    CavId, EgoMotion, Gnss, Handedness, Lidar, Limits, Payload, Radar, Role, Stream, Topic, Truth,
    wire,
};

use super::layout::{LayoutReader, LayoutRow};
use super::{
    Dataset, FrameSource, Layout, MissingFrame, OpenOptions, ReadError, Result, Scenario, Tick,
    reasons,
};
use crate::faults::Faults;
use crate::frame::Frame;
use crate::pcd::{IntensityKind, IntensityOrigin, PcdCloud};
use recording::{Entry, Recording, RecordingError};

/// A recording of a live run ([`recording`]).
pub(crate) static RECORDING: LayoutRow = LayoutRow {
    key: "recording",
    name: "recording of a live run",
    data_sets: "runs of v2vloc",
    files: "a file <name>.mcap, or recording.mcap in a run folder",
    protocol: "opv2v",
    reader: Some(LayoutReader::DataSet(open_given)),
};

/// Name of the recording in a run folder.
const IN_RUN_FOLDER: &str = "recording.mcap";

/// The recording that `path` names: the file itself, or that of a run folder. A file of another program looks alike.
pub fn recording_of(path: &Path) -> Option<PathBuf> {
    let mut files = [path.to_path_buf(), path.join(IN_RUN_FOLDER)].into_iter();
    files.find(|file| file.is_file() && file.extension().is_some_and(|kind| kind == "mcap"))
}

/// Opens the recording that a path names.
fn open_given(path: &Path, _: &OpenOptions) -> Result<Option<Dataset>> {
    let Some(file) = recording_of(path) else {
        return Ok(None);
    };
    match Recording::open(&file) {
        Ok(recording) => open(&file, recording).map(Some),
        // A bag of ROS 2, perhaps.
        Err(RecordingError::Foreign { .. }) => Ok(None),
        Err(error) => Err(as_read_error(error)),
    }
}

/// Opens a recording as a data set of one scenario. A truncated end is reported in [`Dataset::problems`].
fn open(file: &Path, recording: Recording) -> Result<Dataset> {
    let damage = recording.damage().iter().map(ToString::to_string);
    let damage = damage.map(|damage| ReadError::malformed(file, damage));
    let mut problems: Vec<ReadError> = damage.collect();
    let name = file.file_stem().unwrap_or("recording".as_ref());
    let name = name.to_string_lossy().into_owned();
    let source = Recorded::new(recording, &mut problems)?;
    let agents = source.agents.clone();
    let (ticks, missing) = source.sweep_times();
    let mut streams = source.sensors.keys().map(|(_, _, stream)| *stream);
    let scenario = Scenario {
        cameras: source.cameras(),
        has_radar: streams.any(|stream| stream == Stream::Radar),
        ..Scenario::new(name, Layout::RECORDING, agents, ticks, Arc::new(source))
    };
    Ok(Dataset {
        layout: Layout::RECORDING,
        scenarios: vec![scenario.with_ticks(None, missing)],
        problems,
    })
}

/// The sensors and the truth of a recording, by capture time.
#[derive(Debug)]
struct Recorded {
    recording: Recording,
    agents: Vec<CavId>,
    sensors: BTreeMap<(u64, CavId, Stream), Entry>,
    truth: BTreeMap<u64, Truth>,
}

/// The first of the messages of a replay at each capture time, by topic. The others are faults.
fn firsts_of<'a>(
    recording: &'a Recording,
    problems: &mut Vec<ReadError>,
) -> BTreeMap<(u64, &'a Topic), &'a Entry> {
    let mut firsts = BTreeMap::new();
    let [mut misplaced, mut repeated] = [(); 2].map(|()| Faults::default());
    for entry in recording.entries() {
        let (topic, stamp) = (&entry.key.topic, &entry.header.stamp);
        let fault = |what: &str| {
            let reason = format!("{} at {} ns: {what}", entry.key, stamp.capture_nanos);
            ReadError::malformed(recording.path(), reason)
        };
        let is_stated = match topic {
            // A replay sends the data of the sensors, and previews of the sweeps.
            Topic::Stream { cav, stream }
                if stream.sender() == Role::Replay && *stream != Stream::Preview =>
            {
                if stamp.cav != *cav {
                    misplaced.push(fault(&format!("its header names {}", stamp.cav)));
                    continue;
                }
                // A person may state a pose beside the recorded one.
                *stream == Stream::Gnss
            }
            Topic::Truth => false,
            _ => continue,
        };
        let first: &mut &Entry = firsts.entry((stamp.capture_nanos, topic)).or_insert(entry);
        // In the same epoch it is the same replay: a repeated message, and nothing to report.
        if !is_stated && first.header.stamp.epoch != stamp.epoch {
            repeated.push(fault("published by a second replay"));
        }
    }
    misplaced.report("message", problems);
    repeated.report("message", problems);
    firsts
}

/// Steps of the ego within which an agent has sweeps before it counts as not synchronised: while the ego is away, all
/// are within one, and losses alone spare every common tick hardly ever.
const MIN_STEPS: usize = 3;

/// Smallest distance of sweeps from the ticks around them, nanoseconds; `None` where one is at a tick, or too few are
/// between ticks.
fn off_nanos(ticks: &[u64], sweeps: &[u64]) -> Option<u64> {
    let (mut steps, mut least) = (BTreeSet::new(), u64::MAX);
    for at in sweeps {
        let next = ticks.binary_search(at).err()?;
        let before = ticks.get(next.wrapping_sub(1));
        if let Some((before, after)) = before.zip(ticks.get(next)) {
            steps.insert(next);
            least = least.min(at - before).min(after - at);
        }
    }
    (steps.len() >= MIN_STEPS).then_some(least)
}

impl Recorded {
    /// An unreadable ground truth is a problem of its tick, and not of the scene. Of two replays of one tick the first
    /// is used, sweeps and ground truth alike.
    fn new(recording: Recording, problems: &mut Vec<ReadError>) -> Result<Self> {
        let firsts = firsts_of(&recording, problems);
        let (mut sensors, mut truth) = (BTreeMap::new(), BTreeMap::new());
        for ((capture_nanos, topic), entry) in firsts {
            if let Topic::Stream { cav, stream } = topic {
                sensors.insert((capture_nanos, cav.clone(), *stream), entry.clone());
                continue;
            }
            match message::<Truth>(&recording, entry) {
                Ok(message) => drop(truth.insert(capture_nanos, message)),
                Err(problem) => problems.push(problem),
            }
        }
        let mut recorded = Self {
            recording,
            agents: Vec::new(),
            sensors,
            truth,
        };
        recorded.agents = recorded.in_order();
        let path = recorded.recording.path();
        let apart = recorded.unsynchronised().into_iter();
        problems.extend(apart.map(|reason| ReadError::malformed(path, reason)));
        if recorded.agents.is_empty() {
            let reason = match recorded.recording.entries() {
                [] => "none of its messages can be read: it is of another version of this program",
                _ => "no sweep of any vehicle in it: recorded --without lidar?",
            };
            let reason = format!("{reason}{}", reasons(problems.iter()));
            return Err(ReadError::malformed(path, reason));
        }
        Ok(recorded)
    }

    /// Agents whose sweeps are between those of the ego, and never with one: they take part in no tick.
    fn unsynchronised(&self) -> Vec<String> {
        let Some((ego, others)) = self.agents.split_first() else {
            return Vec::new();
        };
        let ticks = self.captures(ego);
        let named = others.iter().filter_map(|cav| {
            let off_ms = off_nanos(&ticks, &self.captures(cav))? as f64 / 1e6;
            Some(format!(
                "{cav} has sweeps {off_ms} ms and more off every sweep of {ego}: it takes part in no tick"
            ))
        });
        named.collect()
    }

    /// All agents with sweeps, in the order of the scene, which is that of the ground truth: the ego comes first.
    fn in_order(&self) -> Vec<CavId> {
        let truths = self.truth.values();
        let listed = truths.flat_map(|truth| truth.agents.iter().map(|agent| &agent.cav));
        let sweeps = self.sensors.keys();
        let sweeps = sweeps.filter(|(_, _, stream)| *stream == Stream::Lidar);
        let unlisted = sweeps.map(|(_, cav, _)| cav);
        let with_sweeps: BTreeSet<&CavId> = unlisted.clone().collect();
        let mut agents: Vec<CavId> = Vec::new();
        for cav in listed.chain(unlisted) {
            if with_sweeps.contains(cav) && !agents.contains(cav) {
                agents.push(cav.clone());
            }
        }
        agents
    }

    /// The capture times of the sweeps of an agent, in order.
    fn captures(&self, agent: &CavId) -> Vec<u64> {
        let keys = self.sensors.keys();
        let sweeps = keys.filter(|(_, cav, stream)| cav == agent && *stream == Stream::Lidar);
        sweeps.map(|(at, _, _)| *at).collect()
    }

    /// The capture times of all sweeps, and the sweeps that agents lack at them.
    fn sweep_times(&self) -> (Vec<Tick>, Vec<MissingFrame>) {
        let keys = self.sensors.keys();
        let sweeps = keys.filter(|(_, _, stream)| *stream == Stream::Lidar);
        let mut captures: Vec<u64> = sweeps.map(|(at, _, _)| *at).collect();
        // Keys are ordered by capture time first, so equal times are neighbours.
        captures.dedup();
        let (mut ticks, mut missing) = (Vec::new(), Vec::new());
        for capture_nanos in captures {
            let stem = capture_nanos.to_string();
            let agents = self.agents.iter();
            let lacking = agents.filter(|cav| !self.has(cav, capture_nanos, Stream::Lidar));
            missing.extend(lacking.map(|cav| MissingFrame::new(cav, &stem)));
            ticks.push(Tick::new(stem, capture_nanos));
        }
        (ticks, missing)
    }

    /// Numbers of the cameras that have images.
    fn cameras(&self) -> Vec<u8> {
        let keys = self.sensors.keys();
        let numbers = keys.filter_map(|(_, _, stream)| match stream {
            Stream::Camera(number) => Some(*number),
            _ => None,
        });
        numbers.collect::<BTreeSet<u8>>().into_iter().collect()
    }

    fn has(&self, agent: &CavId, capture_nanos: u64, stream: Stream) -> bool {
        let key = (capture_nanos, agent.clone(), stream);
        self.sensors.contains_key(&key)
    }

    fn sensor<M: Payload>(&self, agent: &CavId, tick: &Tick, stream: Stream) -> Result<M> {
        let key = (tick.capture_nanos, agent.clone(), stream);
        let entry = self.sensors.get(&key).ok_or_else(|| {
            let reason = format!("no {agent}/{stream} at {}", tick.stem);
            ReadError::malformed(self.recording.path(), reason)
        });
        message(&self.recording, entry?)
    }
}

impl FrameSource for Recorded {
    fn frame(&self, agent: &CavId, tick: &Tick) -> Result<Frame> {
        let truth = self.truth.get(&tick.capture_nanos);
        let mut truths = truth.into_iter().flat_map(|truth| &truth.agents);
        let truth = truths.find(|known| known.cav == *agent);
        let without = || Frame::empty(agent.clone(), 0, Handedness::Right);
        let mut frame = truth.map_or_else(without, Frame::of_truth);
        frame.capture_nanos = tick.capture_nanos;
        // A receiver errs, and a person states roughly: where there is a ground truth, they are none at a tick without it.
        if self.truth.is_empty() && self.has(agent, tick.capture_nanos, Stream::Gnss) {
            let gnss: Gnss = self.sensor(agent, tick, Stream::Gnss)?;
            frame.world_from_lidar = Some(gnss.world_from_lidar);
        }
        if self.has(agent, tick.capture_nanos, Stream::Imu) {
            let motion: EgoMotion = self.sensor(agent, tick, Stream::Imu)?;
            (frame.speed_mps, frame.yaw_rate_rad_s) = (motion.speed_mps, motion.yaw_rate_rad_s);
        }
        Ok(frame)
    }

    fn points(&self, agent: &CavId, tick: &Tick, _: Option<&str>) -> Result<PcdCloud> {
        let Lidar { points } = self.sensor(agent, tick, Stream::Lidar)?;
        let intensity = Some(IntensityOrigin::stored("intensity", IntensityKind::Number));
        Ok(PcdCloud {
            points,
            intensity,
            form: "recorded message",
            ..PcdCloud::default()
        })
    }

    fn radar(&self, agent: &CavId, tick: &Tick) -> Result<PcdCloud> {
        let Radar { points } = self.sensor(agent, tick, Stream::Radar)?;
        Ok(PcdCloud {
            points,
            ..PcdCloud::default()
        })
    }

    fn cameras(&self, agent: &CavId, tick: &Tick, numbers: &[u8], frame: &mut Frame) {
        for &number in numbers {
            let stream = Stream::Camera(number);
            if self.has(agent, tick.capture_nanos, stream) {
                frame.add_camera(number, self.sensor(agent, tick, stream));
            }
        }
    }

    /// None besides that of the sweeps.
    fn shared_files(&self, _: &CavId) -> Vec<PathBuf> {
        Vec::new()
    }

    fn points_path(&self, _: &CavId, _: &Tick, _: Option<&str>) -> PathBuf {
        self.recording.path().into()
    }
}

fn message<M: Payload>(recording: &Recording, entry: &Entry) -> Result<M> {
    let bytes = recording.read(entry).map_err(as_read_error)?;
    let decoded = wire::decode([bytes.as_slice()], &Limits::DEFAULT);
    decoded
        .map(|(_, message)| message)
        .map_err(|error| ReadError::malformed(recording.path(), format!("{}: {error}", entry.key)))
}

pub(super) fn as_read_error(error: RecordingError) -> ReadError {
    match error {
        RecordingError::Foreign { ref path, .. } => ReadError::malformed(path, error.to_string()),
        RecordingError::Io { path, source } => ReadError::Io { path, source },
        RecordingError::NotOurs(file) => ReadError::malformed(&file.path, file.problem),
        RecordingError::Ended { path, reason } => ReadError::malformed(&path, reason),
        RecordingError::Malformed {
            path,
            offset,
            reason,
        } => ReadError::malformed(&path, format!("byte {offset}: {reason}")),
    }
}
