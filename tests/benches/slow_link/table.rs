//! Table of the results, one row per run.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use anyhow::Result;
use protocol::DropReason;
use support::statistics;
use tests::machine;

use super::ends::Measurement;
use super::{Cell, Way};

/// Longest time that a publisher may block its caller, milliseconds.
const SUBMIT_TARGET_MS: f64 = 5.0;

/// One line of the table. Times in milliseconds.
pub(crate) struct Row {
    pub(crate) way: &'static str,
    rate_mbps: f64,
    bytes: usize,
    seconds: f64,
    submitted: usize,
    arrived: usize,
    /// By reason, and the number of unexplained losses.
    dropped: BTreeMap<DropReason, u64>,
    unexplained: i64,
    submit_max_ms: f64,
    transport_p50_ms: f64,
    age_p50_ms: f64,
    age_p95_ms: f64,
    age_target_ms: f64,
    throughput_mbps: f64,
}

impl Row {
    pub(crate) fn of(cell: &Cell, way: Way, seen: &Measurement) -> Self {
        let ages = ages_ms(seen);
        let took = seen
            .arrivals
            .iter()
            .map(|arrival| millis(arrival.capture_nanos, arrival.nanos));
        let mut dropped = seen.ledger.total().dropped;
        // The queue of the link has room for all: it drops only what a newer message replaces.
        if let Some(replaced) = dropped.remove(&DropReason::LinkQueue) {
            *dropped.entry(DropReason::Superseded).or_default() += replaced;
        }
        let in_flight = |at_receivers: bool| -> u64 {
            let accounts = seen.ledger.iter();
            let accounts = accounts.filter(|(of, _)| of.to.is_some() == at_receivers);
            accounts.map(|(_, counts)| counts.in_flight).sum()
        };
        // The link holds them at the end.
        let held = in_flight(true);
        if held > 0 {
            *dropped.entry(DropReason::Stale).or_default() += held;
        }
        let unexplained = if seen.ledger.is_empty() {
            // zenoh reports no drops.
            seen.submissions.len() as i64 - seen.arrivals.len() as i64
        } else if seen.ledger.balance().is_exact() {
            in_flight(false) as i64
        } else {
            i64::MAX
        };
        Self {
            way: way.name(),
            rate_mbps: cell.rate_mbps,
            bytes: cell.bytes,
            seconds: cell.duration.as_secs_f64(),
            submitted: seen.submissions.len(),
            arrived: seen.arrivals.len(),
            dropped,
            unexplained,
            submit_max_ms: seen
                .submissions
                .iter()
                .map(|submit| submit.waited_nanos as f64 / 1e6)
                .fold(0.0, f64::max),
            transport_p50_ms: quantile(&took.collect::<Vec<_>>(), 0.5),
            age_p50_ms: quantile(&ages, 0.5),
            age_p95_ms: quantile(&ages, 0.95),
            age_target_ms: cell.age_target_ms(),
            throughput_mbps: throughput_mbps(seen),
        }
    }

    /// True if no message is missing, no call blocked and the newest feature map is new enough.
    pub(crate) fn is_on_target(&self) -> bool {
        self.unexplained == 0
            && self.submit_max_ms <= SUBMIT_TARGET_MS
            && self.age_p95_ms <= self.age_target_ms
    }

    pub(crate) fn markdown(&self) -> String {
        let reasons: Vec<String> = self
            .dropped
            .iter()
            .map(|(reason, count)| format!("{reason} {count}"))
            .collect();
        let unexplained = match self.unexplained {
            0 => String::new(),
            i64::MAX => "**ledger does not balance**".to_owned(),
            count => format!("**unknown {count}**"),
        };
        let reasons: Vec<String> = reasons
            .into_iter()
            .chain(Some(unexplained).filter(|text| !text.is_empty()))
            .collect();
        format!(
            "| {} | {} | {} | {:.0} | {} of {} | {} | {:.2} | {:.1} | {:.1} | {:.1} | {:.1} | {:.2} | {} |",
            self.rate_mbps,
            size(self.bytes),
            self.way,
            self.seconds,
            self.arrived,
            self.submitted,
            if reasons.is_empty() {
                "-".to_owned()
            } else {
                reasons.join(", ")
            },
            self.submit_max_ms,
            self.transport_p50_ms,
            self.age_p50_ms,
            self.age_p95_ms,
            self.age_target_ms,
            self.throughput_mbps,
            if self.is_on_target() { "yes" } else { "no" },
        )
    }

    fn csv(&self) -> String {
        let dropped = |reason| self.dropped.get(&reason).copied().unwrap_or(0);
        let is_own_column =
            |reason: &&DropReason| ![DropReason::Superseded, DropReason::Stale].contains(reason);
        let other: u64 = self
            .dropped
            .keys()
            .filter(is_own_column)
            .map(|reason| dropped(*reason))
            .sum();
        format!(
            "{},{},{},{:.1},{},{},{},{},{},{},{:.3},{:.1},{:.1},{:.1},{:.1},{:.3},{}",
            self.way,
            self.rate_mbps,
            self.bytes,
            self.seconds,
            self.submitted,
            self.arrived,
            dropped(DropReason::Superseded),
            dropped(DropReason::Stale),
            other,
            self.unexplained,
            self.submit_max_ms,
            self.transport_p50_ms,
            self.age_p50_ms,
            self.age_p95_ms,
            self.age_target_ms,
            self.throughput_mbps,
            self.is_on_target(),
        )
    }
}

/// Writes both tables.
pub(crate) fn write(folder: &Path, arguments: &str, rows: &[Row]) -> Result<()> {
    fs::create_dir_all(folder)?;
    let mut csv =
        "way,rate_mbps,bytes,seconds,submitted,arrived,superseded,under_way_at_end,dropped_otherwise,unexplained,\
        submit_max_ms,transport_p50_ms,age_p50_ms,age_p95_ms,age_target_ms,throughput_mbps,on_target\n"
            .to_owned();
    let mut markdown = format!(
        "`cargo bench -p tests --bench slow_link -- {arguments}`\n\n{}\n\n\
        | Mbit/s | size | way | s | arrived | not arrived | call max ms | on the way p50 ms | age p50 ms | age p95 ms | \
        target ms | Mbit/s arrived | on target |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|\n",
        machine::describe(),
    );
    for row in rows {
        writeln!(csv, "{}", row.csv())?;
        writeln!(markdown, "{}", row.markdown())?;
    }
    fs::write(folder.join("slow_link.csv"), csv)?;
    fs::write(folder.join("slow_link.md"), markdown)?;
    Ok(())
}

/// Age of the newest feature map at every millisecond from the first arrival to the last submission.
fn ages_ms(seen: &Measurement) -> Vec<f64> {
    let end_nanos = seen
        .submissions
        .last()
        .map_or(0, |submit| submit.capture_nanos);
    let mut arrivals = seen.arrivals.iter().peekable();
    let mut newest_nanos = 0;
    let mut ages = Vec::new();
    let mut nanos = seen
        .arrivals
        .first()
        .map_or(u64::MAX, |arrival| arrival.nanos);
    while nanos <= end_nanos {
        while let Some(arrival) = arrivals.next_if(|arrival| arrival.nanos <= nanos) {
            newest_nanos = newest_nanos.max(arrival.capture_nanos);
        }
        ages.push(millis(newest_nanos, nanos));
        nanos += 1_000_000;
    }
    ages
}

/// Between the first arrival and the last.
fn throughput_mbps(seen: &Measurement) -> f64 {
    let [Some(first), Some(last)] = [seen.arrivals.first(), seen.arrivals.last()] else {
        return 0.0;
    };
    let bytes: u64 = seen.arrivals[1..].iter().map(|arrival| arrival.bytes).sum();
    let ms = millis(first.nanos, last.nanos);
    if ms > 0.0 {
        bytes as f64 * 8e-3 / ms
    } else {
        0.0
    }
}

fn millis(from_nanos: u64, to_nanos: u64) -> f64 {
    (to_nanos as f64 - from_nanos as f64) / 1e6
}

/// NaN without values: no target holds then.
fn quantile(values: &[f64], quantile: f64) -> f64 {
    statistics::quantile(&statistics::sorted(values), quantile).unwrap_or(f64::NAN)
}

fn size(bytes: usize) -> String {
    if bytes >= 1 << 20 {
        format!("{} MiB", bytes >> 20)
    } else {
        format!("{} KiB", bytes >> 10)
    }
}
