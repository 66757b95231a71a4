//! Metrics endpoint: message counters, frames from end to end, stage durations and resources for Prometheus.

mod fleet;

use std::borrow::Cow;
use std::fmt;
use std::net::SocketAddr;

use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeLabelSet, EncodeMetric, text};
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::metrics::{MetricType, TypedMetric};
use prometheus_client::registry::{Registry, Unit};

use protocol::{Account, CavId};

pub use fleet::MetricsPeer;

use super::{FrameStats, MessageStats, process_usage};
use crate::web::{Answer, WebServer};

/// Serves `stats`, and the series of `others`, at `http://<address>/metrics` until dropped; port 0: any free port.
///
/// # Errors
/// When the address cannot be bound.
pub(crate) fn serve(
    address: SocketAddr,
    stats: &MessageStats,
    others: Vec<MetricsPeer>,
) -> std::io::Result<WebServer> {
    let stats = stats.clone();
    WebServer::start(address, move |request| match request.path.as_str() {
        "/metrics" => {
            let own = exposition(&stats);
            let body = if others.is_empty() {
                own
            } else {
                fleet::fleet_exposition(&own, &others)
            };
            Answer::Page {
                content_type: CONTENT_TYPE,
                body: body.into(),
            }
        }
        other => Answer::NotFound(format!("{other} not found; see /metrics")),
    })
}

const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// The counters in the OpenMetrics text format.
fn exposition(stats: &MessageStats) -> String {
    let process = (Cow::from("process"), Cow::from(stats.process().to_string()));
    let mut registry = Registry::with_prefix_and_labels("v2vloc", [process.clone()].into_iter());
    registry.register_collector(Box::new(StatsCollector(stats.clone())));
    // Named as by the client libraries of Prometheus, on which dashboards rely: without our prefix.
    let mut system = Registry::with_labels([process].into_iter());
    system.register_collector(Box::new(ProcessCollector));
    let mut text = String::new();
    // Writing to a string cannot fail.
    let _ = text::encode_registry(&mut text, &registry);
    let _ = text::encode_registry(&mut text, &system);
    let _ = text::encode_eof(&mut text);
    text
}

/// CPU time and memory of this process.
#[derive(Debug)]
struct ProcessCollector;

impl Collector for ProcessCollector {
    fn encode(&self, mut encoder: DescriptorEncoder) -> fmt::Result {
        let usage = process_usage();
        let cpu = ("process_cpu", "User and system time of all threads");
        let seconds = ConstCounter::new(usage.cpu_s);
        encode_value(&mut encoder, cpu, Some(&Unit::Seconds), &seconds)?;
        let resident = ("process_resident_memory", "Resident memory");
        let bytes = gauge(usage.resident_bytes);
        encode_value(&mut encoder, resident, Some(&Unit::Bytes), &bytes)?;
        let help = "Largest resident memory so far";
        let peak = ("process_peak_resident_memory", help);
        let bytes = gauge(usage.peak_resident_bytes);
        encode_value(&mut encoder, peak, Some(&Unit::Bytes), &bytes)
    }
}

fn gauge(count: u64) -> ConstGauge {
    ConstGauge::new(i64::try_from(count).unwrap_or(i64::MAX))
}

type NoLabels = [(&'static str, &'static str); 0];

/// Encodes ticks, answers, fused neighbours and latency of a process that has frames.
fn encode_frames(frames: &FrameStats, encoder: &mut DescriptorEncoder<'_>) -> fmt::Result {
    if frames.ticks > 0 {
        let about = ("ticks", "Ticks of the scene");
        encode_value(encoder, about, None, &ConstCounter::new(frames.ticks))?;
    }
    if frames.ticks + frames.answered == 0 {
        return Ok(());
    }
    let about = ("answered_ticks", "Ticks with detections");
    encode_value(encoder, about, None, &ConstCounter::new(frames.answered))?;
    let help = "Neighbours whose data were fused, over all frames";
    let fused = ConstCounter::new(frames.fused_neighbours);
    encode_value(encoder, ("fused_neighbours", help), None, &fused)?;
    let Some(latency) = &frames.latency else {
        return Ok(());
    };
    let help = "From the publication of a tick to that of its detections";
    let about = ("capture_to_detection", help);
    encode_value(encoder, about, Some(&Unit::Seconds), latency)
}

/// Encodes a metric, given by name and help: a value for each set of labels.
fn encode_series<L: EncodeLabelSet, M: EncodeMetric + TypedMetric>(
    encoder: &mut DescriptorEncoder<'_>,
    (name, help): (&str, &str),
    unit: Option<&Unit>,
    series: impl IntoIterator<Item = (L, M)>,
) -> fmt::Result {
    let mut metric = encoder.encode_descriptor(name, help, unit, M::TYPE)?;
    for (labels, value) in series {
        value.encode(metric.encode_family(&labels)?)?;
    }
    Ok(())
}

/// Encodes a metric of one value, given by name and help.
fn encode_value<M: EncodeMetric + TypedMetric>(
    encoder: &mut DescriptorEncoder<'_>,
    (name, help): (&str, &str),
    unit: Option<&Unit>,
    value: &M,
) -> fmt::Result {
    value.encode(encoder.encode_descriptor(name, help, unit, M::TYPE)?)
}

fn topic_label(account: &Account) -> (&'static str, String) {
    ("topic", account.topic.to_string())
}

fn topic_and_side(account: &Account) -> [(&'static str, String); 2] {
    let side = account.to.as_ref().map_or("sender", |_| "receiver");
    [topic_label(account), ("side", side.to_owned())]
}

fn vehicle_label(cav: &CavId) -> [(&'static str, String); 1] {
    [("vehicle", cav.to_string())]
}

#[derive(Debug)]
struct StatsCollector(MessageStats);

impl Collector for StatsCollector {
    fn encode(&self, mut encoder: DescriptorEncoder) -> fmt::Result {
        let ledger = self.0.ledger();
        let sent = ledger.iter().filter(|(account, _)| account.to.is_none());
        let received = ledger.iter().filter(|(account, _)| account.to.is_some());
        let help = ("messages_sent", "Messages published");
        let series =
            sent.map(|(account, counts)| ([topic_label(account)], ConstCounter::new(counts.sent)));
        encode_series(&mut encoder, help, None, series)?;
        let help = ("messages_received", "Messages accepted and used");
        let series = received
            .map(|(account, counts)| ([topic_label(account)], ConstCounter::new(counts.received)));
        encode_series(&mut encoder, help, None, series)?;
        let help = ("messages_dropped", "Messages lost, by reason");
        let series = ledger.iter().flat_map(|(account, counts)| {
            let [topic, side] = topic_and_side(account);
            counts.dropped.iter().map(move |(reason, count)| {
                let reason = ("reason", reason.to_string());
                (
                    [topic.clone(), side.clone(), reason],
                    ConstCounter::new(*count),
                )
            })
        });
        encode_series(&mut encoder, help, None, series)?;
        let help = ("messages_in_flight", "Messages in flight");
        let series = ledger
            .iter()
            .map(|(account, counts)| (topic_and_side(account), gauge(counts.in_flight)));
        encode_series(&mut encoder, help, None, series)?;
        let help = "Large messages of a process with a pool of shared memory, by their way";
        let series = self.0.shared_memory().into_iter();
        let series =
            series.map(|(way, count)| ([("way", <&str>::from(way))], ConstCounter::new(count)));
        encode_series(&mut encoder, ("shared_memory_messages", help), None, series)?;
        let help = "Bytes of published messages, each counted once for all its receivers";
        let help = ("published", help);
        let series = self.0.traffic().into_iter().map(|traffic| {
            let topic = ("topic", traffic.topic.to_string());
            ([topic], ConstCounter::new(traffic.bytes))
        });
        encode_series(&mut encoder, help, Some(&Unit::Bytes), series)?;
        encode_frames(&self.0.frames(), &mut encoder)?;
        let peers = self.0.peers();
        let help = "Clock of a vehicle minus ours, minus the shortest transit time";
        let seconds = Some(&Unit::Seconds);
        let series = peers.iter().filter_map(|(cav, peer)| {
            Some((vehicle_label(cav), ConstGauge::new(peer.clock?.seconds())))
        });
        encode_series(&mut encoder, ("clock_offset", help), seconds, series)?;
        let help = ("trust", "Trust score of a vehicle, 0 to 1");
        let series = peers
            .iter()
            .filter_map(|(cav, peer)| Some((vehicle_label(cav), ConstGauge::new(peer.trust?))));
        encode_series(&mut encoder, help, None, series)?;
        let help = "Duration of a stage for one frame";
        let mut stages =
            encoder.encode_descriptor("stage", help, seconds, MetricType::Histogram)?;
        for (stage, count, sum_s, buckets) in self.0.histograms() {
            let labels = [("stage", stage.as_str())];
            let mut family = stages.encode_family(&labels)?;
            family.encode_histogram::<NoLabels>(sum_s, count, &buckets, None)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use protocol::{DropReason, ProcessId, Stream, Topic};

    use super::*;

    fn sample() -> MessageStats {
        let stats = MessageStats::new(ProcessId::new("agent-4279").unwrap());
        let cav = CavId::new("4279").unwrap();
        let [lidar, bev] = [Stream::Lidar, Stream::Bev].map(|stream| Topic::Stream {
            cav: cav.clone(),
            stream,
        });
        stats.subscribed(&lidar);
        for _ in 0..5 {
            stats.arrived(&lidar);
        }
        stats.received(&lidar);
        stats.received(&lidar);
        stats.dropped(&lidar, DropReason::Superseded);
        stats.submitted(&bev);
        stats.trusted(&cav, 0.25);
        stats.published(&bev, 1_500);
        stats.published(&bev, 500);
        (0..3).for_each(|_| stats.tick());
        stats.answered(Some(Duration::from_millis(110)), 2);
        stats.answered(None, 1);
        for milliseconds in [0.2, 3.0, 4.0, 40.0, 9_000.0] {
            stats.timed("encode \"x\"", Duration::from_secs_f64(milliseconds / 1e3));
        }
        stats
    }

    #[test]
    fn counters_and_histograms_match() {
        let text = exposition(&sample());
        let process = "process=\"agent-4279\"";
        for line in [
            format!("v2vloc_messages_sent_total{{{process},topic=\"4279/bev\"}} 1"),
            format!("v2vloc_messages_received_total{{{process},topic=\"4279/lidar\"}} 2"),
            format!(
                "v2vloc_messages_dropped_total{{{process},topic=\"4279/lidar\",side=\"receiver\",reason=\"superseded\"}} 1"
            ),
            format!(
                "v2vloc_messages_in_flight{{{process},topic=\"4279/lidar\",side=\"receiver\"}} 2"
            ),
            format!("v2vloc_trust{{{process},vehicle=\"4279\"}} 0.25"),
            format!("v2vloc_published_bytes_total{{{process},topic=\"4279/bev\"}} 2000"),
            format!("v2vloc_ticks_total{{{process}}} 3"),
            format!("v2vloc_answered_ticks_total{{{process}}} 2"),
            format!("v2vloc_fused_neighbours_total{{{process}}} 3"),
            format!("v2vloc_capture_to_detection_seconds_bucket{{{process},le=\"0.1\"}} 0"),
            format!("v2vloc_capture_to_detection_seconds_bucket{{{process},le=\"0.12\"}} 1"),
            format!("v2vloc_capture_to_detection_seconds_sum{{{process}}} 0.11"),
            "# TYPE process_cpu_seconds counter".into(),
            "# TYPE process_resident_memory_bytes gauge".into(),
            "# TYPE v2vloc_stage_seconds histogram".into(),
            "# EOF".into(),
        ] {
            assert!(
                text.lines().any(|found| found == line),
                "{line}\nis not in\n{text}"
            );
        }
        for name in ["process_cpu_seconds_total", "process_resident_memory_bytes"] {
            let line = text
                .lines()
                .find(|line| line.starts_with(&format!("{name}{{{process}}}")));
            let value = line
                .and_then(|line| line.rsplit(' ').next())
                .and_then(|value| value.parse::<f64>().ok());
            assert!(value.is_some_and(|value| value > 0.0), "{name} in\n{text}");
        }
        assert_eq!(text.matches("# EOF").count(), 1);
        let counts = ["0.0025", "0.005", "0.05", "+Inf"].map(|le| {
            let line = text.lines().find(|line| {
                line.contains("stage_seconds_bucket") && line.contains(&format!("le=\"{le}\""))
            });
            line.and_then(|line| line.rsplit(' ').next())
                .and_then(|count| count.parse::<u64>().ok())
        });
        assert_eq!(counts, [Some(1), Some(3), Some(4), Some(5)]);
    }

    #[test]
    fn metrics_can_be_fetched() {
        let server = serve("127.0.0.1:0".parse().unwrap(), &sample(), Vec::new()).unwrap();
        let (status, body) = crate::web::fetch(server.address(), "/metrics").unwrap();
        assert_eq!(status, "HTTP/1.0 200 OK");
        let text = String::from_utf8(body).unwrap();
        assert!(
            text.contains("v2vloc_ticks_total") && text.ends_with("# EOF\n"),
            "{text}"
        );
        assert!(
            crate::web::fetch(server.address(), "/")
                .unwrap()
                .0
                .contains("404")
        );
    }
}
