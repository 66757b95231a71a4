//! A report as text for a terminal.

use std::fmt;

use terminal::text_table::{TextTable, number};

use super::resources::ThreadResources;
use super::{RunPace, RunReport, Spread};
use crate::operate::progress::bytes;

/// Bytes of a MiB.
const MIB: f64 = 1_048_576.0;

impl fmt::Display for RunReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(capacity) = &self.capacity {
            writeln!(f, "machine   {capacity}")?;
        }
        write!(f, "{}", self.pace)?;
        let capacity = self.capacity.as_ref();
        if let Some(deviation) = capacity.and_then(|capacity| capacity.deviation(&self.pace)) {
            writeln!(f, "forecast  {deviation}")?;
        }
        let latency = milliseconds(&self.latency_ms);
        writeln!(f, "latency   capture to detection: {latency}")?;
        for cause in &self.causes {
            writeln!(f, "observed  {cause}")?;
        }
        for (cav, clock) in &self.other_clocks {
            writeln!(f, "clock     {cav}: {clock}")?;
        }
        let tables = [
            (self.stages.len(), self.stage_table()),
            (self.processes.len(), self.process_table()),
            (self.threads().count(), self.thread_table()),
            (self.streams.len(), self.stream_table()),
        ];
        for (_, table) in tables.iter().filter(|(rows, _)| *rows > 0) {
            write!(f, "\n{table}")?;
        }
        Ok(())
    }
}

impl fmt::Display for RunPace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (ticks, answered) = (self.ticks, self.answered);
        let share = self.answered_share().map_or("-".into(), percent);
        let rate = self
            .rate_hz
            .map(|rate| format!(", {rate:.1} detections a second"));
        let (rate, interval) = (rate.unwrap_or_default(), milliseconds(&self.interval_ms));
        writeln!(
            f,
            "pace      answered {answered}/{ticks} ({share}){rate}; between detections {interval}"
        )?;
        let agents = self.agents.iter().map(|(cav, pace)| {
            let (computed, sent) = (pace.computed, pace.sent.unwrap_or(ticks));
            format!("{cav} {computed}/{sent} ({})", percent(pace.share))
        });
        match agents.collect::<Vec<_>>().as_slice() {
            [] => Ok(()),
            agents => writeln!(f, "computed  {}", agents.join(", ")),
        }
    }
}

impl RunReport {
    fn stage_table(&self) -> TextTable {
        let numbers = ["frames", "median ms", "95th percentile", "longest"];
        let mut table = TextTable::of(&["process", "stage"], &numbers);
        for stage in &self.stages {
            let kind = match stage.processes {
                1 => stage.kind.clone(),
                several => format!("{}, slowest of {several}", stage.kind),
            };
            let times = [stage.p50_ms, stage.p95_ms, stage.max_ms].map(|ms| format!("{ms:.1}"));
            let stage = [kind, stage.stage.clone(), stage.count.to_string()];
            table.row(stage.into_iter().chain(times));
        }
        table
    }

    fn process_table(&self) -> TextTable {
        let numbers = [
            "CPU s",
            "of these playing",
            "cores",
            "CPU ms per frame",
            "in stages",
            "peak MiB",
        ];
        let mut table = TextTable::of(&["process"], &numbers);
        for process in &self.processes {
            let name = match (shown_name(&process.process), process.instances) {
                (name, 1) => name.to_owned(),
                (name, several) => format!("{name}, started {several} times"),
            };
            table.row([
                name,
                format!("{:.2}", process.cpu_s),
                format!("{:.2}", process.playing_cpu_s),
                number(process.cores, 2),
                number(process.cpu_ms_per_frame, 1),
                number(process.stages_ms_per_frame, 1),
                format!("{:.0}", process.peak_resident_bytes as f64 / MIB),
            ]);
        }
        table
    }

    /// Processes and their threads with at least a tenth of a millisecond a frame.
    fn threads(&self) -> impl Iterator<Item = (&str, &ThreadResources)> {
        let all = self.processes.iter();
        all.flat_map(|of| {
            of.threads
                .iter()
                .map(|thread| (of.process.as_str(), thread))
        })
        .filter(|(_, thread)| thread.cpu_ms_per_frame >= 0.1)
    }

    fn thread_table(&self) -> TextTable {
        let mut table = TextTable::of(&["process", "thread"], &["CPU ms per frame"]);
        for (process, thread) in self.threads() {
            let ms = format!("{:.1}", thread.cpu_ms_per_frame);
            table.row([shown_name(process).to_owned(), thread.name.clone(), ms]);
        }
        table
    }

    fn stream_table(&self) -> TextTable {
        let mut table = TextTable::of(&["stream"], &["messages", "bytes", "per message"]);
        for stream in &self.streams {
            let mean = stream.bytes as f64 / stream.messages.max(1) as f64;
            table.row([
                stream.stream.clone(),
                stream.messages.to_string(),
                bytes(stream.bytes as f64),
                bytes(mean),
            ]);
        }
        table
    }
}

/// Name of a process: the scorer is a part of the program that people start.
fn shown_name(process: &str) -> &str {
    match process {
        "scorer" => "v2vloc (scorer)",
        name => name,
    }
}

/// Median, 95th percentile and maximum.
fn milliseconds(spread: &Spread) -> String {
    match spread.p50 {
        None => "-".into(),
        Some(_) => {
            let [p50, p95, max] = [spread.p50, spread.p95, spread.max].map(|ms| number(ms, 0));
            format!("median {p50} ms, 95th percentile {p95}, longest {max}")
        }
    }
}

fn percent(share: f64) -> String {
    format!("{:.0} %", 100.0 * share)
}
