//! Statistics of a process: ledger, durations of stages, CPU time, memory and published bytes.

use serde::{Deserialize, Serialize};

use super::{check_count, check_nanos, check_text, check_within, metadata_only};
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
    /// Problems: reasons why the process cannot work, each with its duration: `no pose (for 12 s)`. At most 256 bytes
    /// each, without control characters, as all texts of messages.
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
    /// Name of the threads, without a number at its end, at most 256 bytes.
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
    /// Name of the stage, at most 256 bytes.
    pub stage: String,
    /// Duration, nanoseconds.
    pub nanos: u64,
}

/// Duration of one stage over many frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageSummary {
    /// Name of the stage, at most 256 bytes.
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
            check_text("stage", &timing.stage)?;
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
        let mut problems = self.problems.iter();
        problems.try_for_each(|problem| check_text("problem", problem))?;
        check_within("cpu_s", self.usage.cpu_s, 0.0, MAX_CPU_S)?;
        for thread in &self.usage.threads {
            check_text("thread", &thread.name)?;
            check_within("thread cpu_s", thread.cpu_s, 0.0, MAX_CPU_S)?;
        }
        for summary in &self.stages {
            check_text("stage", &summary.stage)?;
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{CavId, Stamp, wire};

    fn encoded(problem: &str, thread: &str) -> Result<(), String> {
        let threads = vec![ThreadUsage {
            name: thread.into(),
            cpu_s: 0.0,
        }];
        let stats = Stats {
            process: ProcessId::new("agent-1").unwrap(),
            ledger: Ledger::default(),
            stages: Vec::new(),
            usage: ProcessUsage {
                threads,
                ..ProcessUsage::default()
            },
            traffic: Vec::new(),
            problems: vec![problem.into()],
        };
        let stamp = Stamp {
            cav: CavId::new("1").unwrap(),
            epoch: 1,
            sequence: 0,
            capture_nanos: 0,
            publish_nanos: 0,
        };
        let encoded = wire::encode(&stamp, stats);
        encoded.map(drop).map_err(|error| error.to_string())
    }

    #[test]
    fn texts_that_would_forge_lines_of_a_terminal_or_fill_it_are_refused() {
        assert_eq!(encoded("no pose – 3 points (for 12 s)", "rx"), Ok(()));
        assert_eq!(encoded(&"p".repeat(256), &"t".repeat(256)), Ok(()));
        let found = encoded(&"p".repeat(257), "rx").unwrap_err();
        assert_eq!(found, "problem: 257, at most 256 are permitted");
        for (text, letter) in [
            ("\x1b[2J", '\x1b'),
            ("ready\nagent-2", '\n'),
            ("\u{9b}2J", '\u{9b}'),
        ] {
            let found = [encoded(text, "rx"), encoded("late", text)].map(Result::unwrap_err);
            let expected = ["problem", "thread"]
                .map(|what| format!("{what}: control character {letter:?}, none is permitted"));
            assert_eq!(found, expected);
        }
    }
}
