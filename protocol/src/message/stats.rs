//! Statistics of a process: ledger, durations of stages, CPU time, memory and published bytes.

use serde::{Deserialize, Serialize};

use super::{check_count, check_name, check_nanos, check_within, metadata_only};
use crate::{Ledger, Limits, ProcessId, Topic, WireError};

/// Largest CPU time of a process that a receiver accepts, seconds: a thousand cores for a year.
const MAX_CPU_S: f64 = 3.2e10;

/// Ledger, stage durations and resources of a process: any process to the operator, regularly and at the end.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Stats {
    /// Process of these statistics.
    pub process: ProcessId,
    /// All counters since the process started.
    pub ledger: Ledger,
    /// Durations of its stages.
    pub stages: Vec<StageSummary>,
    /// CPU time and memory since the process started.
    pub usage: ProcessUsage,
    /// Published bytes, by topic.
    pub traffic: Vec<TopicTraffic>,
    /// Problems: reasons why the process cannot work, each with its duration: `no pose (for 12 s)`.
    pub problems: Vec<String>,
}

/// CPU time and memory of a process, 0 where the system does not tell.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ProcessUsage {
    /// User and system time of all its threads, seconds.
    pub cpu_s: f64,
    /// Resident memory, bytes.
    pub resident_bytes: u64,
    /// Largest resident memory so far, bytes.
    pub peak_resident_bytes: u64,
    /// CPU time of the threads that it has now, by name.
    pub threads: Vec<ThreadUsage>,
}

/// CPU time of the threads of a name.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ThreadUsage {
    /// Name of the threads, without a number at its end, at most 64 bytes.
    pub name: String,
    /// User and system time, seconds.
    pub cpu_s: f64,
}

/// Messages that a process has published on one topic, each counted once for all its receivers.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TopicTraffic {
    /// The topic.
    pub topic: Topic,
    /// Number of messages.
    pub messages: u64,
    /// Bytes of header, metadata and body of these.
    pub bytes: u64,
}

/// Duration of one stage for one frame.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct StageTiming {
    /// Name of the stage, at most 64 bytes.
    pub stage: String,
    /// Duration, nanoseconds.
    pub nanos: u64,
}

/// Duration of one stage over many frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageSummary {
    /// Name of the stage, at most 64 bytes.
    pub stage: String,
    /// Number of frames.
    pub count: u64,
    /// Sum over all frames, milliseconds.
    pub sum_ms: f64,
    /// Median, milliseconds.
    pub p50_ms: f64,
    /// 95th percentile, milliseconds.
    pub p95_ms: f64,
    /// 99th percentile, milliseconds.
    pub p99_ms: f64,
    /// Maximum, milliseconds.
    pub max_ms: f64,
}

impl StageTiming {
    /// Duration of one stage.
    pub fn new(stage: &str, time: std::time::Duration) -> Self {
        Self {
            stage: stage.into(),
            nanos: u64::try_from(time.as_nanos()).unwrap_or(u64::MAX),
        }
    }

    pub(super) fn check_all(stages: &[Self], limits: &Limits) -> Result<(), WireError> {
        check_count("stages", stages.len(), limits.max_entries)?;
        stages.iter().try_for_each(|timing| {
            check_name("stage", &timing.stage)?;
            check_nanos("stage nanos", timing.nanos)
        })
    }
}

impl Stats {
    fn check_values(&self, limits: &Limits) -> Result<(), WireError> {
        check_count("accounts", self.ledger.len(), limits.max_entries)?;
        check_count("stages", self.stages.len(), limits.max_entries)?;
        check_count("topics", self.traffic.len(), limits.max_entries)?;
        check_count("problems", self.problems.len(), limits.max_entries)?;
        check_count("threads", self.usage.threads.len(), limits.max_entries)?;
        check_within("cpu_s", self.usage.cpu_s, 0.0, MAX_CPU_S)?;
        for thread in &self.usage.threads {
            check_name("thread", &thread.name)?;
            check_within("thread cpu_s", thread.cpu_s, 0.0, MAX_CPU_S)?;
        }
        for summary in &self.stages {
            check_name("stage", &summary.stage)?;
            check_within("stage sum_ms", summary.sum_ms, 0.0, MAX_CPU_S * 1e3)?;
            for time_ms in [
                summary.p50_ms,
                summary.p95_ms,
                summary.p99_ms,
                summary.max_ms,
            ] {
                check_within("stage milliseconds", time_ms, 0.0, 1e9)?;
            }
        }
        Ok(())
    }
}

metadata_only!(Stats, Stats);
