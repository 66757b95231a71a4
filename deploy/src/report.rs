//! Results as tables for people.

use std::fmt::Write as _;

use crate::metrics::{ByIou, Metrics};
use crate::progress::bytes;
use crate::up::RunResult;

/// A run as a table: what was found, how fast, at which price.
#[must_use]
pub fn run_table(result: &RunResult) -> String {
    table(std::slice::from_ref(&result.metrics)) + &run_notes(result)
}

/// What there is to say of one run below its line in the table.
#[must_use]
pub fn run_notes(result: &RunResult) -> String {
    let mut text = String::new();
    let messages = &result.metrics.messages;
    // Writing to a string cannot fail.
    let _ = writeln!(
        text,
        "\nmessages  {} sent, {} received, {} in flight",
        messages.sent, messages.received, messages.in_flight
    );
    if messages.are_stuck() {
        let _ =
            writeln!(text, "stuck     most messages were still in flight at the end: the link carries next to nothing");
    }
    let dropped: Vec<String> = messages.dropped.iter().map(|(reason, count)| format!("{count} {reason}")).collect();
    let _ = writeln!(text, "dropped   {}", if dropped.is_empty() { "none".into() } else { dropped.join(", ") });
    let verdict = if result.balance.is_exact() {
        "every message is accounted for".into()
    } else {
        format!("{} accounts do not add up, see ledger.json", result.balance.differences.len())
    };
    let _ = writeln!(text, "ledger    {verdict}");
    if result.missed > 0 {
        let _ = writeln!(text, "missed    {} ticks without a result", result.missed);
    }
    for process in &result.killed {
        let _ = writeln!(text, "killed    {process} did not end in time");
    }
    for failure in &result.failures {
        let _ = writeln!(text, "failed    {failure}");
    }
    for what in &result.unwritten {
        let _ = writeln!(text, "unwritten {what}");
    }
    if let Some(picture) = &result.picture {
        let _ = writeln!(text, "picture   {}", picture.display());
    }
    let _ = writeln!(text, "run       {}", result.folder.path().display());
    text
}

/// One line per run or evaluation.
#[must_use]
pub fn table(all: &[Metrics]) -> String {
    let mut text = String::from(
        "method     poses     frames  AP@0.3  AP@0.5  AP@0.7  frame order 0.5  pose error m  latency ms p50/p95  bytes per neighbour\n",
    );
    for metrics in all {
        let ByIou { at_30, at_50, at_70 } = metrics.ap_global;
        let latency = &metrics.latency_ms.capture_to_detection;
        let _ = writeln!(
            text,
            "{:<10} {:<9} {:>6}  {:>6}  {:>6}  {:>6}  {:>15}  {:>12}  {:>18}  {:>19}",
            metrics.method,
            metrics.pose_source,
            metrics.frames,
            number(at_30, 3),
            number(at_50, 3),
            number(at_70, 3),
            number(metrics.ap_frame_order.at_50, 3),
            number(metrics.pose.mean_m, 2),
            format!("{} / {}", number(latency.p50, 0), number(latency.p95, 0)),
            metrics.comm.wire_bytes_mean.map_or("-".into(), bytes),
        );
    }
    text
}

fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or("-".into(), |value| format!("{value:.digits$}"))
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::metrics::{Communication, Latencies, Messages, Percentiles, PoseErrors};

    #[test]
    fn columns_line_up_and_missing_numbers_are_dashes() {
        let metrics = |method: &str, at_50| Metrics {
            frames: 60,
            seconds: 6.0,
            clock: "wall".into(),
            method: method.into(),
            pose_source: "recorded".into(),
            ap_global: ByIou { at_50, ..ByIou::default() },
            ap_frame_order: ByIou::default(),
            pose: PoseErrors::default(),
            latency_ms: Latencies { capture_to_detection: Percentiles { p50: Some(81.4), ..Percentiles::default() } },
            age_ms: Percentiles::default(),
            neighbours: BTreeMap::new(),
            comm: Communication::default(),
            messages: Messages::default(),
        };
        let text = table(&[metrics("none", None), metrics("attention", Some(0.5))]);
        let lines: Vec<&str> = text.lines().collect();
        assert!(lines.iter().all(|line| line.len() == lines[0].len()), "{text}");
        assert!(lines[1].contains("81 / -") && lines[2].contains("0.500"), "{text}");
    }
}
