//! Results as tables for a terminal.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::Path;

use dataset::evaluation_protocol::ApOrder;
use deploy::operate::progress::bytes;
use deploy::score::metrics::{Contribution, Metrics, PartPrecision, Percentiles};
use fusion::{Exchange, Method};
use localization::pgc::wrong_place::wrong_place_hint;
use localization::pose_source::PoseSourceConfig;
use support::output;
use terminal::text_table::{Side, TextTable, number};

use crate::run::loss;
use crate::run::run_fleet::RunResult;

/// Table and report of a run: detections, latency, bytes, then pace, stages and resources.
pub fn run_table(result: &RunResult) -> String {
    table(std::slice::from_ref(&result.metrics)) + &run_report(result) + &run_notes(result)
}

/// Pace, stages, CPU, memory and bytes of a run, under its method.
pub fn run_report(result: &RunResult) -> String {
    format!(
        "\n{} in {}\n{}",
        result.metrics.method,
        result.folder.path().display(),
        result.report
    )
}

/// Prints what was left out and the reasons for exit code 3 to standard error, `with_method` under the method of the
/// run.
pub fn print_loss(result: &RunResult, with_method: bool) {
    result.metrics.left_out.print();
    if let Some(sentence) = loss::sentence(result) {
        let method = with_method.then(|| format!("{}: ", result.metrics.method));
        let method = method.unwrap_or_default();
        output::note(format_args!("exit 3: {method}{sentence}"));
    }
}

/// Prints a hint if no sweep was localized: the head may be of another place. `scene`: folder of the data set.
pub fn print_unlocated(metrics: &Metrics, pose: &PoseSourceConfig, scene: &Path) {
    let Some(head) = pose.head() else {
        return;
    };
    if metrics.pose.mean_m.is_none() && metrics.pose.no_pose > 0 {
        let dataset = dataset::open(scene).ok();
        let map = dataset.and_then(|dataset| dataset.scenarios.first()?.generated_map().ok());
        let (map, no_pose) = (map.map(|map| map.to_string()), metrics.pose.no_pose);
        output::note(wrong_place_hint(no_pose, &head, map.as_deref()));
    }
}

/// Lines about one run below its row of the table.
pub fn run_notes(result: &RunResult) -> String {
    let messages = &result.metrics.messages;
    let mut lines = vec![format!(
        "\nmessages  {} sent, {} received, {} in flight",
        messages.sent, messages.received, messages.in_flight
    )];
    if messages.are_stuck() {
        let stuck =
            "most messages were still in flight at the end: the link carries next to nothing";
        lines.push(format!("stuck     {stuck}"));
    }
    let dropped = messages.dropped.iter();
    let dropped = dropped.map(|(reason, count)| format!("{count} {reason}"));
    let dropped = match messages.dropped.is_empty() {
        true => "none".into(),
        false => dropped.collect::<Vec<_>>().join(", "),
    };
    lines.push(format!("dropped   {dropped}"));
    let verdict = match result.balance.discrepancies.len() {
        0 => "every message is accounted for".into(),
        count => format!("{count} accounts do not add up, see ledger.json"),
    };
    lines.push(format!("ledger    {verdict}"));
    let unreceived = messages.unreceived;
    if unreceived > 0 {
        lines.push(format!(
            "topics    {unreceived} messages on topics without a receiver, see ledger.json"
        ));
    }
    let missed = result.missed;
    if missed > 0 {
        lines.push(format!("missed    {missed} ticks without a result"));
    }
    let killed = result.killed.iter();
    lines.extend(killed.map(|process| format!("killed    {process} did not end in time")));
    let failures = result.failures.iter();
    lines.extend(failures.map(|failure| format!("failed    {failure}")));
    let unwritten = result.unwritten.iter();
    lines.extend(unwritten.map(|what| format!("unwritten {what}")));
    let picture = result.picture.iter();
    lines.extend(picture.map(|picture| format!("picture   {}", picture.display())));
    lines.push(format!("run       {}\n", result.folder.path().display()));
    lines.join("\n")
}

/// A column: whether it is shown, its name, alignment and cells.
type MetricColumn = (bool, &'static str, Side, fn(&Metrics) -> String);

/// One line per run or evaluation, and the facts that are needed to compare the lines.
pub fn table(all: &[Metrics]) -> String {
    let columns = columns(all);
    let mut table = TextTable::new(columns.iter().map(|(_, name, side, _)| (*name, *side)));
    for metrics in all {
        table.row(columns.iter().map(|(.., cell)| cell(metrics)));
    }
    table.to_string() + &comparison(all)
}

/// The columns that are shown.
fn columns(all: &[Metrics]) -> Vec<MetricColumn> {
    use Side::{Left, Right};
    // Streaming AP exists only where results have a time of publication.
    let is_live = all.iter().any(|metrics| metrics.ap_streaming.is_some());
    let has_network = all.iter().any(|of| of.contribution.sent > Some(0));
    let name = if is_live { "answered" } else { "frames" };
    let by_frame = all.iter().any(|of| of.ap_order() == ApOrder::Frame);
    let columns: [MetricColumn; 14] = [
        (true, "method", Left, |of| of.method.clone()),
        (true, "poses", Left, |of| of.pose_source.clone()),
        (true, name, Right, frames),
        (true, "AP@0.3", Right, |of| number(of.headline().at_30, 3)),
        (true, "AP@0.5", Right, |of| number(of.headline().at_50, 3)),
        (true, "AP@0.7", Right, |of| number(of.headline().at_70, 3)),
        (is_live, "AP@0.5 all", Right, |of| {
            number(of.ap_unanswered_empty.at_50, 3)
        }),
        (is_live, "sAP@0.5", Right, |of| {
            number(of.ap_streaming.and_then(|ap| ap.at_50), 3)
        }),
        (!is_live && !by_frame, "frame order 0.5", Right, |of| {
            number(of.ap_frame_order.at_50, 3)
        }),
        (!is_live && by_frame, "global order 0.5", Right, |of| {
            number(of.ap_global.at_50, 3)
        }),
        (has_network, "fused", Right, |of| {
            number(of.contribution.fused_per_frame, 2)
        }),
        (true, "pose m", Right, |of| number(of.pose.mean_m, 2)),
        (true, "latency ms", Right, latency),
        (true, "bytes", Right, |of| {
            of.comm.wire_bytes_mean.map_or("-".into(), bytes)
        }),
    ];
    let columns = columns.into_iter().filter(|(is_shown, ..)| *is_shown);
    columns.collect()
}

/// AP by distance and by class, in the global order, a line for each part of each method.
pub fn breakdown(all: &[Metrics]) -> String {
    let numbers = ["objects", "AP@0.3", "AP@0.5", "AP@0.7"];
    let mut table = TextTable::of(&["method", "part"], &numbers);
    for metrics in all {
        let parts = [(" m", &metrics.ap_by_distance), ("", &metrics.ap_by_class)];
        for (unit, parts) in parts {
            for (part, PartPrecision { objects, ap }) in parts {
                let values = ap.values().map(|value| number(value, 3));
                let head = [
                    metrics.method.clone(),
                    format!("{part}{unit}"),
                    objects.to_string(),
                ];
                table.row(head.into_iter().chain(values));
            }
        }
    }
    table.to_string()
}

/// Notes for a comparison: the protocols, differences between runs, and messages that did not reach an ego.
fn comparison(all: &[Metrics]) -> String {
    let mut text = String::new();
    let protocols: BTreeSet<String> = all
        .iter()
        .filter_map(|metrics| Some(metrics.protocol.as_ref()?.to_string()))
        .collect();
    for protocol in protocols {
        let _ = writeln!(text, "{protocol}");
    }
    if all.windows(2).any(|pair| pair[0].frames != pair[1].frames) {
        text += "\nwarning: rows are evaluated over different frames: ";
        text += match all.iter().any(|metrics| metrics.ap_streaming.is_some()) {
            true => {
                "compare \"AP@0.5 all\" and sAP@0.5, in which unanswered ticks count, and not AP over other frames\n"
            }
            false => "their AP cannot be compared\n",
        };
    }
    for metrics in all {
        let (method, Contribution { sent, used, .. }) = (&metrics.method, metrics.contribution);
        let exchange = method.parse().map(Method::exchange);
        let fuses = exchange.is_ok_and(|exchange| exchange != Exchange::Nothing);
        if let (true, Some(sent), Some(used)) = (fuses && used < sent, sent, used) {
            let mean = metrics.contribution.sent_bytes_mean;
            // Lists of boxes may go beside feature maps, so no size is that of each message.
            let size = mean.map(|mean| format!(" ({} a neighbour and frame)", bytes(mean)));
            let size = size.unwrap_or_default();
            let _ = writeln!(text, "{method}: of {sent} messages{size} {used} were fused");
        }
    }
    text
}

fn frames(metrics: &Metrics) -> String {
    match metrics.ap_streaming {
        Some(_) => format!("{}/{}", metrics.answered, metrics.ticks),
        None => metrics.frames.to_string(),
    }
}

fn latency(metrics: &Metrics) -> String {
    let Percentiles { p50, p95, .. } = metrics.latency_ms.capture_to_detection;
    match p50.or(p95) {
        None => "-".into(),
        Some(_) => format!("{} / {}", number(p50, 0), number(p95, 0)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dataset::evaluation_protocol::EvaluationProtocol;
    use deploy::score::metrics::{ByIou, Latencies};

    fn precision(at_50: Option<f64>) -> ByIou {
        ByIou {
            at_50,
            ..ByIou::default()
        }
    }

    fn metrics(method: &str, at_50: Option<f64>) -> Metrics {
        Metrics {
            ap_global: precision(at_50),
            latency_ms: Latencies {
                capture_to_detection: Percentiles {
                    p50: Some(81.4),
                    ..Percentiles::default()
                },
            },
            frames: 60,
            ticks: 60,
            answered: 60,
            method: method.into(),
            pose_source: "recorded".into(),
            ..Metrics::default()
        }
    }

    fn answered(method: &str, answered: u64, ap: f64) -> Metrics {
        Metrics {
            frames: answered,
            answered,
            ap_unanswered_empty: precision(Some(0.5 * ap)),
            ap_streaming: Some(precision(Some(0.25 * ap))),
            ..metrics(method, Some(ap))
        }
    }

    #[test]
    fn columns_line_up_and_missing_numbers_are_dashes() {
        let text = table(&[metrics("none", None), metrics("attention", Some(0.5))]);
        let lines: Vec<&str> = text.lines().collect();
        assert!(
            lines.len() == 3 && lines.iter().all(|line| line.len() == lines[0].len()),
            "{text}"
        );
        assert!(
            lines[1].contains("81 / -") && lines[2].contains("0.500"),
            "{text}"
        );
        assert!(
            lines[0].contains("frames") && !lines[0].contains("answered"),
            "{text}"
        );
    }

    #[test]
    fn the_order_of_the_protocol_is_reported_first() {
        let by_frame = Metrics {
            ap_frame_order: precision(Some(0.25)),
            protocol: EvaluationProtocol::preset("v2v4real"),
            ..metrics("max", Some(0.75))
        };
        let text = table(&[by_frame]);
        let head = text.lines().next().unwrap();
        assert!(
            head.contains("global order 0.5") && !head.contains("frame order"),
            "{text}"
        );
        assert!(text.find("0.250") < text.find("0.750"), "{text}");
        assert!(text.contains("AP@0.3, 0.5, 0.7 in frame order\n"), "{text}");
        assert!(table(&[metrics("max", Some(0.5))]).contains("frame order 0.5"));
    }

    #[test]
    fn a_live_table_gives_the_answered_ticks_and_warns_where_they_differ() {
        let text = table(&[answered("max", 33, 0.8), answered("pastat", 29, 0.9)]);
        let lines: Vec<&str> = text.lines().collect();
        assert!(
            lines[1].contains("33/60") && lines[2].contains("29/60"),
            "{text}"
        );
        assert!(
            lines[1].contains("0.400") && lines[1].contains("0.200"),
            "all ticks and streaming: {text}"
        );
        assert!(
            text.contains("warning: rows are evaluated over different frames"),
            "{text}"
        );
        assert!(!table(&[answered("max", 60, 0.8), answered("none", 60, 0.7)]).contains("warning"));
    }

    #[test]
    fn bytes_are_those_of_fused_messages_and_a_dash_where_none_was_fused() {
        let row = |wire_bytes_mean| {
            let mut metrics = metrics("max", Some(0.8));
            metrics.contribution.sent_bytes_mean = Some(1_600_000.0);
            metrics.comm.wire_bytes_mean = wire_bytes_mean;
            table(&[metrics]).lines().nth(1).unwrap().to_owned()
        };
        let [fused, nothing] = [Some(1229.0), None].map(row);
        assert!(fused.ends_with(" 1.2 kB"), "{fused}");
        assert!(nothing.ends_with(" -"), "{nothing}");
    }

    #[test]
    fn undelivered_messages_are_reported() {
        let contribution = Contribution {
            fused_per_frame: Some(0.05),
            sent: Some(38),
            used: Some(2),
            sent_bytes_mean: Some(3_150_000.0),
        };
        let latency_ms = Latencies::default();
        let ego_only = Metrics {
            contribution,
            ..metrics("none", Some(0.7))
        };
        assert!(
            !table(&[ego_only]).contains("were fused"),
            "it fuses nothing in any case"
        );
        let text = table(&[Metrics {
            contribution,
            latency_ms,
            ..metrics("max", Some(0.8))
        }]);
        assert!(
            text.contains("  fused  ") && text.contains("0.05"),
            "{text}"
        );
        assert!(
            text.contains("max: of 38 messages (3.1 MB a neighbour and frame) 2 were fused"),
            "{text}"
        );
        assert!(!text.contains(" / "), "no latency is known: {text}");
        assert!(
            !table(&[metrics("max", None)]).contains("fused"),
            "nothing was transmitted"
        );
    }
}
