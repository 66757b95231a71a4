//! Several runs beside each other: a row per quantity, a column per run.

use std::fmt;
use std::path::Path;

use support::file_error::FileError;
use terminal::text_table::{Side, TextTable, number};

use super::{RunReport, read_json};
use crate::operate::progress::bytes;
use crate::score::metrics::{self, Metrics};

/// Runs that are compared.
#[derive(Debug)]
pub struct Comparison(Vec<(RunReport, Metrics)>);

/// Name of a quantity, and its value in a run.
type ReportRow = (&'static str, fn(&RunReport, &Metrics) -> String);

const ROWS: [ReportRow; 16] = [
    ("method", |report, _| report.method.clone()),
    ("poses", |report, _| report.pose_source.clone()),
    ("clock", |report, _| report.clock.clone()),
    ("answered", |report, _| {
        format!("{}/{}", report.pace.answered, report.pace.ticks)
    }),
    ("AP@0.3", |_, metrics| number(metrics.ap_global.at_30, 3)),
    ("AP@0.5", |_, metrics| number(metrics.ap_global.at_50, 3)),
    ("AP@0.7", |_, metrics| number(metrics.ap_global.at_70, 3)),
    ("AP@0.5 all", |_, metrics| {
        number(metrics.ap_unanswered_empty.at_50, 3)
    }),
    ("sAP@0.5", |_, metrics| {
        number(metrics.ap_streaming.and_then(|ap| ap.at_50), 3)
    }),
    ("neighbours fused per frame", |_, metrics| {
        number(metrics.contribution.fused_per_frame, 2)
    }),
    ("pose error, m", |_, metrics| number(metrics.pose.mean_m, 2)),
    ("latency, median, ms", |report, _| {
        number(report.latency_ms.p50, 0)
    }),
    ("latency, 95th percentile, ms", |report, _| {
        number(report.latency_ms.p95, 0)
    }),
    ("between detections, 95th percentile, ms", |report, _| {
        number(report.pace.interval_ms.p95, 0)
    }),
    ("CPU per frame, all processes, ms", |report, _| {
        let of_all: Option<f64> = report.processes.iter().map(|of| of.cpu_ms_per_frame).sum();
        number(of_all.filter(|_| !report.processes.is_empty()), 0)
    }),
    ("bytes of a neighbour per frame", |_, metrics| {
        metrics.comm.wire_bytes_mean.map_or("-".into(), bytes)
    }),
];

impl Comparison {
    /// Reads report and metrics in the folders of runs.
    ///
    /// # Errors
    /// [`FileError`] as that of [`RunReport::read`].
    pub fn read(folders: &[impl AsRef<Path>]) -> Result<Self, FileError> {
        let runs = folders.iter().map(|folder| {
            let metrics = read_json(folder.as_ref().join(metrics::FILE));
            Ok((RunReport::read(folder.as_ref())?, metrics?))
        });
        runs.collect::<Result<_, _>>().map(Self)
    }
}

impl fmt::Display for Comparison {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let runs = self.0.iter();
        let runs = runs.map(|(report, _)| (report.run.as_str(), Side::Right));
        let mut table = TextTable::new([("run", Side::Left)].into_iter().chain(runs));
        for (name, value) in ROWS {
            let runs = self.0.iter();
            let values = runs.map(|(report, metrics)| value(report, metrics));
            table.row([name.to_owned()].into_iter().chain(values));
        }
        write!(f, "{table}")?;
        let mut answered = self.0.iter().map(|(_, metrics)| metrics.answered);
        let first = answered.next();
        if answered.any(|answered| Some(answered) != first) {
            let hint =
                "Runs answered different numbers of ticks: compare \"AP@0.5 all\" and sAP@0.5.";
            writeln!(f, "\n{hint}")?;
        }
        Ok(())
    }
}
