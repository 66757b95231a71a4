//! Statistics of a process: ledger and durations of stages.

use serde::{Deserialize, Serialize};

use super::{check_count, check_name, check_nanos, check_within, metadata_only};
use crate::Ledger;
use crate::Limits;
use crate::ProcessId;
use crate::WireError;

/// Ledger and stage durations of a process: any process to the operator, regularly and at the end.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Stats {
    /// Process of these statistics.
    pub process: ProcessId,
    /// All counters since the process started.
    pub ledger: Ledger,
    /// Durations of its stages.
    pub stages: Vec<StageSummary>,
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
    #[must_use]
    pub fn new(stage: &str, time: std::time::Duration) -> Self {
        Self { stage: stage.into(), nanos: u64::try_from(time.as_nanos()).unwrap_or(u64::MAX) }
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
        for summary in &self.stages {
            check_name("stage", &summary.stage)?;
            for time_ms in [summary.p50_ms, summary.p95_ms, summary.p99_ms, summary.max_ms] {
                check_within("stage milliseconds", time_ms, 0.0, 1e9)?;
            }
        }
        Ok(())
    }
}

metadata_only!(Stats, Stats);
