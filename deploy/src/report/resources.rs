//! Stages, CPU time, memory and bytes of the processes of a run.

use std::collections::BTreeMap;

use protocol::{Role, Topic};
use serde::{Deserialize, Serialize};

use super::RunPace;
use super::pace::sweeps;
use crate::score::ProcessStats;

/// Durations of one stage in the processes of one kind. Of several processes those of the slowest, for which the ego
/// waits.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct StageReport {
    /// Kind of process: its role.
    pub kind: String,
    /// Number of processes with this stage.
    pub processes: usize,
    /// Name of the stage.
    pub stage: String,
    /// Number of frames, over all processes.
    pub count: u64,
    /// Median, milliseconds.
    pub p50_ms: f64,
    /// 95th percentile, milliseconds.
    pub p95_ms: f64,
    /// Maximum, milliseconds.
    pub max_ms: f64,
}

/// CPU time and memory of a process, over all its instances.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ProcessResources {
    /// Name of the process. `scorer` is `v2vloc up` itself.
    pub process: String,
    /// Number of instances: 1, and one for each restart.
    pub instances: usize,
    /// CPU time in total, seconds.
    pub cpu_s: f64,
    /// CPU time from the first tick on, seconds.
    pub playing_cpu_s: f64,
    /// Mean number of cores in use from the first tick to the last detections.
    pub cores: Option<f64>,
    /// CPU time from the first tick on, per frame: of an agent per computed sweep, of an ego per result, of others per
    /// tick, milliseconds.
    pub cpu_ms_per_frame: Option<f64>,
    /// Time of the stages that compute, per frame, milliseconds: on an idle machine the CPU time that a stage names.
    pub stages_ms_per_frame: Option<f64>,
    /// CPU time from the first tick on by thread, the largest first, and that of threads that have ended: the sum is
    /// `cpu_ms_per_frame`.
    #[serde(default)]
    pub threads: Vec<ThreadResources>,
    /// Largest resident memory of an instance, bytes.
    pub peak_resident_bytes: u64,
}

/// CPU time of the threads of a name in a process, over all its instances.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ThreadResources {
    /// Name of the threads.
    pub name: String,
    /// CPU time from the first tick on, per frame, milliseconds.
    pub cpu_ms_per_frame: f64,
}

/// Published messages of one stream, over all vehicles.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct StreamBytes {
    /// Name of the stream; those behind the link emulation as `rx/STREAM`.
    pub stream: String,
    /// Number of messages, each counted once for all its receivers.
    pub messages: u64,
    /// Bytes of header, metadata and body.
    pub bytes: u64,
}

/// Stages by kind of process, in the order of the data flow, then of their names.
pub(super) fn stages(processes: &[ProcessStats]) -> Vec<StageReport> {
    let mut all = BTreeMap::<(usize, String, String), StageReport>::new();
    for stats in processes {
        let (order, kind) = kind_of(stats.process.as_str());
        for stage in &stats.stages {
            let key = (order, kind.clone(), stage.stage.clone());
            let times = all.entry(key).or_default();
            times.kind.clone_from(&kind);
            times.stage.clone_from(&stage.stage);
            times.processes += 1;
            times.count += stage.count;
            times.p50_ms = times.p50_ms.max(stage.p50_ms);
            times.p95_ms = times.p95_ms.max(stage.p95_ms);
            times.max_ms = times.max_ms.max(stage.max_ms);
        }
    }
    all.into_values().collect()
}

/// Kind of a process, and its place in the data flow.
fn kind_of(process: &str) -> (usize, String) {
    use Role::{Agent, Ego, Link, Replay, Scorer};
    const ORDER: [Role; 5] = [Replay, Agent, Link, Ego, Scorer];
    let name = process.split('-').next();
    match { ORDER.into_iter() }.position(|role| name == Some(role.as_str())) {
        Some(place) => (place, ORDER[place].to_string()),
        None => (ORDER.len(), process.to_owned()),
    }
}

/// CPU time and memory of every process, in the order of the data flow.
pub(super) fn processes(processes: &[ProcessStats], pace: &RunPace) -> Vec<ProcessResources> {
    let mut all = BTreeMap::<(usize, String), (ProcessResources, ProcessTimes, u64)>::new();
    for stats in processes {
        let name = stats.process.to_string();
        let (order, kind) = kind_of(&name);
        let (sum, times, frames) = all.entry((order, name.clone())).or_default();
        sum.process = name;
        sum.instances += 1;
        sum.cpu_s += stats.usage.cpu_s;
        sum.playing_cpu_s += (stats.usage.cpu_s - stats.usage_before.cpu_s).max(0.0);
        sum.peak_resident_bytes = sum.peak_resident_bytes.max(stats.usage.peak_resident_bytes);
        times.add(stats);
        // Sweeps add up over the instances. Answers and ticks are of the whole run already.
        *frames = match kind.as_str() {
            "agent" => *frames + sweeps(stats),
            "ego" => pace.answered,
            _ => pace.ticks,
        };
    }
    let finished = all.into_values().map(|(sum, times, frames)| {
        let per_frame = |ms: f64| (frames > 0).then(|| ms / frames as f64);
        ProcessResources {
            cores: (pace.seconds > 0.0).then(|| sum.playing_cpu_s / pace.seconds),
            cpu_ms_per_frame: per_frame(sum.playing_cpu_s * 1e3),
            stages_ms_per_frame: per_frame(times.stages_ms).filter(|ms| *ms > 0.0),
            threads: times.threads(sum.playing_cpu_s * 1e3, per_frame),
            ..sum
        }
    });
    finished.collect()
}

/// Name of the threads that have ended, and of what the kernel counts for the process alone.
const ENDED: &str = "(ended)";

/// Times of the stages and threads of a process, over all its instances.
#[derive(Default)]
struct ProcessTimes {
    stages_ms: f64,
    threads_ms: BTreeMap<String, f64>,
}

impl ProcessTimes {
    fn add(&mut self, stats: &ProcessStats) {
        let stages = stats.stages.iter().filter(|stage| computes(&stage.stage));
        self.stages_ms += stages.map(|stage| stage.sum_ms).sum::<f64>();
        for thread in &stats.usage.threads {
            let mut before = stats.usage_before.threads.iter();
            let before_s = before.find(|one| one.name == thread.name);
            let playing_s = thread.cpu_s - before_s.map_or(0.0, |one| one.cpu_s);
            *self.threads_ms.entry(thread.name.clone()).or_default() += playing_s.max(0.0) * 1e3;
        }
    }

    /// None where the system does not tell.
    fn threads(self, all_ms: f64, per_frame: impl Fn(f64) -> Option<f64>) -> Vec<ThreadResources> {
        let running_ms: f64 = self.threads_ms.values().sum();
        let ended_ms = (all_ms - running_ms).max(0.0);
        let ended = (running_ms > 0.0).then(|| (ENDED.to_owned(), ended_ms));
        let threads = self.threads_ms.into_iter().chain(ended);
        let threads = threads.filter_map(|(name, ms)| {
            let cpu_ms_per_frame = per_frame(ms)?;
            Some(ThreadResources {
                name,
                cpu_ms_per_frame,
            })
        });
        let mut threads: Vec<_> = threads.collect();
        threads.sort_by(|a, b| b.cpu_ms_per_frame.total_cmp(&a.cpu_ms_per_frame));
        threads
    }
}

/// False for stages that wait for others, and for those that are parts of another one or the sum of others.
fn computes(stage: &str) -> bool {
    match stage.strip_prefix("pose ") {
        Some(part) => part == "measurement",
        None => !matches!(stage, "agent" | "wait") && !stage.ends_with("transport"),
    }
}

/// Published bytes by stream, the largest first.
pub(super) fn streams(processes: &[ProcessStats]) -> Vec<StreamBytes> {
    let mut sums = BTreeMap::<String, StreamBytes>::new();
    for traffic in processes.iter().flat_map(|stats| &stats.traffic) {
        let stream = match &traffic.topic {
            Topic::Stream { stream, .. } => stream.to_string(),
            Topic::Received { stream, .. } => format!("rx/{stream}"),
            other => other.to_string(),
        };
        let sum = sums.entry(stream.clone()).or_default();
        sum.stream = stream;
        sum.messages += traffic.messages;
        sum.bytes = sum.bytes.saturating_add(traffic.bytes);
    }
    let mut streams: Vec<StreamBytes> = sums.into_values().collect();
    streams.sort_by(|a, b| b.bytes.cmp(&a.bytes).then_with(|| a.stream.cmp(&b.stream)));
    streams
}
