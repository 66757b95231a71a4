//! `report.json`: pace, latency, stages, CPU, memory and bytes of a run that has ended.

mod capacity;
mod clocks;
mod comparison;
mod pace;
mod resources;
mod text;
mod tracks;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use protocol::{CavId, Role, RunId};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use support::bounded_file;
use support::file_error::{AtFile, FileError};
use support::statistics::{quantile, sorted};

pub use capacity::{Capacity, Machine};
pub use clocks::OtherClock;
pub use comparison::{Comparison, distinguish};
pub use pace::{AgentPace, RunPace};
pub use resources::{ProcessResources, StageReport, StreamBytes};
pub use tracks::{TrackReport, track_table};

use crate::score::metrics::Metrics;
use crate::score::{FrameRecord, ProcessStats};

/// File name.
pub const FILE: &str = "report.json";
/// Largest file that is read, bytes: a report of 65 vehicles has less than one.
const MAX_BYTES: u64 = 16 << 20;

/// Report of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunReport {
    /// Name of the run.
    pub run: String,
    /// Fusion method.
    pub method: String,
    /// Name of the pose source.
    pub pose_source: String,
    /// Clock of the run: `wall` or `stepped`.
    pub clock: String,
    /// Estimate from before the run; `None` if none was made.
    pub capacity: Option<Capacity>,
    /// Share of answered ticks, and intervals between detections.
    pub pace: RunPace,
    /// From the publication of a tick to that of its detections, milliseconds.
    pub latency_ms: Spread,
    /// Stages by kind of process.
    pub stages: Vec<StageReport>,
    /// CPU time and memory of every process.
    pub processes: Vec<ProcessResources>,
    /// Published bytes by stream.
    pub streams: Vec<StreamBytes>,
    /// Observed causes of lost messages: outages of the router, pauses of the run and of processes, ends
    /// of processes.
    #[serde(default)]
    pub causes: Vec<String>,
    /// Vehicles whose clocks differ from the ego's.
    #[serde(default)]
    pub other_clocks: BTreeMap<CavId, OtherClock>,
}

/// Quantiles of a sample; `null` for an empty one.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Spread {
    /// Median.
    pub p50: Option<f64>,
    /// 95th percentile.
    pub p95: Option<f64>,
    /// Maximum.
    pub max: Option<f64>,
}

impl Spread {
    /// Quantiles of `sample`.
    fn of(sample: &[f64]) -> Self {
        let sorted = sorted(sample);
        Self {
            p50: quantile(&sorted, 0.50),
            p95: quantile(&sorted, 0.95),
            max: sorted.last().copied(),
        }
    }
}

impl RunReport {
    /// Report from the ticks of a run, its metrics, and the last reports of its processes (none in simulation time).
    pub fn new(
        run: &RunId,
        metrics: &Metrics,
        records: &[FrameRecord],
        processes: &[ProcessStats],
        capacity: Option<Capacity>,
    ) -> Self {
        let latencies = records.iter().filter_map(|record| record.latency_ms);
        let pace = RunPace::of(metrics, records, processes);
        let mut names = processes.iter().map(|of| of.process.as_str());
        let over_link = names.any(|name| name.starts_with(Role::Link.as_str()));
        Self {
            run: run.to_string(),
            method: metrics.method.clone(),
            pose_source: metrics.pose_source.clone(),
            clock: metrics.clock.clone(),
            capacity,
            latency_ms: Spread::of(&latencies.collect::<Vec<_>>()),
            stages: resources::stages(processes),
            processes: resources::processes(processes, &pace),
            streams: resources::streams(processes),
            causes: Vec::new(),
            other_clocks: clocks::others(&metrics.neighbours, over_link),
            pace,
        }
    }

    /// Reads the report in the folder of a run.
    ///
    /// # Errors
    /// [`FileError`] names the file, or the folder of a run that ended before its first tick.
    pub fn read(folder: &Path) -> Result<Self, FileError> {
        let report: Self = read_json(folder.join(FILE))?;
        // Results that cannot be compared with a truth take their time too.
        if report.pace.ticks == 0 && report.pace.seconds <= 0.0 {
            let problem = "nothing was played in this run: it ended before its first tick";
            return Err(FileError::new(folder, problem));
        }
        Ok(report)
    }
}

/// Reads a file of a run.
fn read_json<T: DeserializeOwned>(path: PathBuf) -> Result<T, FileError> {
    let text = bounded_file::read_text(&path, MAX_BYTES).map_err(|error| {
        let hint = "is it the folder of a run that has ended?";
        FileError::new(&path, format_args!("{error}; {hint}"))
    })?;
    serde_json::from_str(&text).at(&path)
}

#[cfg(test)]
mod tests;
