//! Several runs beside each other: a row per quantity, a column per run.

use std::fmt;
use std::path::Path;

use serde::Serialize;
use serde_json::{Value, json};
use support::config_file;
use support::file_error::FileError;
use terminal::text_table::{Side, TextTable, number};

use super::{RunReport, read_json};
use crate::operate::progress::bytes;
use crate::score::metrics::{self, Metrics};

/// Runs that are compared, each with its conditions.
#[derive(Debug)]
pub struct Comparison(Vec<(RunReport, Metrics, Value)>);

/// Name of a quantity, and its value in a run.
type ReportRow = (&'static str, fn(&RunReport, &Metrics) -> String);

const ROWS: [ReportRow; 17] = [
    ("method", |report, _| report.method.clone()),
    ("poses", |report, _| report.pose_source.clone()),
    ("clock", |report, _| report.clock.clone()),
    ("answered", |report, _| {
        format!("{}/{}", report.pace.answered, report.pace.ticks)
    }),
    ("order of AP", |_, metrics| metrics.ap_order().name().into()),
    ("AP@0.3", |_, metrics| number(metrics.headline().at_30, 3)),
    ("AP@0.5", |_, metrics| number(metrics.headline().at_50, 3)),
    ("AP@0.7", |_, metrics| number(metrics.headline().at_70, 3)),
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

/// Data, ego, protocol and number of ticks of a run. Precisions of two runs are comparable only where these are equal.
pub(super) fn conditions(metrics: &Metrics, ego: impl Serialize, ticks: u64) -> Value {
    let data = metrics.provenance.as_ref().map(|of| &of.data_sha256);
    let protocol = &metrics.protocol;
    json!({"SHA-256 of the data": data, "ego": ego, "protocol": protocol, "ticks": ticks})
}

/// Replaces names that several runs have by their folders.
pub fn distinguish(names: &mut [&mut String], folders: &[impl AsRef<Path>]) {
    let all: Vec<String> = names.iter().map(|name| String::clone(name)).collect();
    for (name, folder) in names.iter_mut().zip(folders) {
        if all.iter().filter(|other| *other == *name).count() > 1 {
            **name = folder.as_ref().display().to_string();
        }
    }
}

/// Lines about what differs in the conditions of runs, each after its name; empty where nothing does.
pub(super) fn differences(runs: &[(&str, &Value)]) -> String {
    let mut lines = Vec::new();
    add_differences("", runs, &mut lines);
    if lines.is_empty() {
        return String::new();
    }
    let hint = "The precisions of these runs cannot be compared.";
    format!("\n{}\n{hint}\n", lines.join("\n"))
}

/// Adds a line for each field of some values, one of each run, that differs.
fn add_differences(name: &str, runs: &[(&str, &Value)], lines: &mut Vec<String>) {
    if let Some((_, Value::Object(fields))) = runs.first() {
        for field in fields.keys() {
            let runs = runs.iter().map(|&(run, value)| (run, &value[field]));
            add_differences(&format!("{name} {field}"), &Vec::from_iter(runs), lines);
        }
    } else if runs.windows(2).any(|pair| pair[0].1 != pair[1].1) {
        let values = runs.iter().map(|(run, value)| format!("{run} {value}"));
        let values: Vec<String> = values.collect();
        lines.push(format!("Runs differ in{name}: {}", values.join(", ")));
    }
}

impl Comparison {
    /// Reads report, metrics and conditions in the folders of runs.
    ///
    /// # Errors
    /// [`FileError`] as that of [`RunReport::read`].
    pub fn read(folders: &[impl AsRef<Path>]) -> Result<Self, FileError> {
        let runs = folders.iter().map(|folder| {
            let folder = folder.as_ref();
            let report = RunReport::read(folder)?;
            let metrics: Metrics = read_json(folder.join(metrics::FILE))?;
            let scenario: Value = config_file::read(&folder.join("scenario.yaml"))?;
            let conditions = conditions(&metrics, &scenario["ego"]["id"], metrics.ticks);
            Ok((report, metrics, conditions))
        });
        let mut runs = runs.collect::<Result<Vec<_>, FileError>>()?;
        let names = runs.iter_mut().map(|(report, ..)| &mut report.run);
        distinguish(&mut Vec::from_iter(names), folders);
        Ok(Self(runs))
    }
}

impl fmt::Display for Comparison {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let runs = self.0.iter();
        let runs = runs.map(|(report, ..)| (report.run.as_str(), Side::Right));
        let mut table = TextTable::new([("run", Side::Left)].into_iter().chain(runs));
        for (name, value) in ROWS {
            let runs = self.0.iter();
            let values = runs.map(|(report, metrics, _)| value(report, metrics));
            table.row([name.to_owned()].into_iter().chain(values));
        }
        write!(f, "{table}")?;
        let runs = self.0.iter();
        let conditions = runs.map(|(report, _, of)| (report.run.as_str(), of));
        let differences = differences(&Vec::from_iter(conditions));
        let mut answered = self.0.iter().map(|(_, metrics, _)| metrics.answered);
        let first = answered.next();
        if !differences.is_empty() {
            f.write_str(&differences)?;
        } else if answered.any(|answered| Some(answered) != first) {
            let hint =
                "Runs answered different numbers of ticks: compare \"AP@0.5 all\" and sAP@0.5.";
            writeln!(f, "\n{hint}")?;
        }
        Ok(())
    }
}
