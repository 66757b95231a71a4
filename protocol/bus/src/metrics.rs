//! Metrics endpoint: message counters and stage durations for Prometheus.

use std::borrow::Cow;
use std::fmt;
use std::net::SocketAddr;

use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric, text};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::registry::{Registry, Unit};

use super::MessageStats;
use crate::web::{Answer, WebServer};

/// Serves the counters of a process at `http://<address>/metrics` until dropped.
pub(crate) struct MetricsServer(WebServer);

impl MetricsServer {
    /// Starts to serve `stats`; port 0: any free port.
    ///
    /// # Errors
    /// When the address cannot be bound.
    pub(crate) fn start(address: SocketAddr, stats: &MessageStats) -> std::io::Result<Self> {
        let stats = stats.clone();
        let server = WebServer::start(address, move |request| match request.path.as_str() {
            "/metrics" => Answer::Page { content_type: CONTENT_TYPE, body: exposition(&stats).into() },
            other => Answer::NotFound(format!("{other} not found; see /metrics")),
        })?;
        Ok(Self(server))
    }

    /// Address of the server.
    #[must_use]
    pub(crate) fn address(&self) -> SocketAddr {
        self.0.address()
    }
}

const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// The counters in the OpenMetrics text format.
#[must_use]
pub(crate) fn exposition(stats: &MessageStats) -> String {
    let process = (Cow::from("process"), Cow::from(stats.process().to_string()));
    let mut registry = Registry::with_prefix_and_labels("v2vloc", [process].into_iter());
    registry.register_collector(Box::new(StatsCollector(stats.clone())));
    let mut text = String::new();
    // Writing to a string cannot fail.
    let _ = text::encode(&mut text, &registry);
    text
}

struct StatsCollector(MessageStats);

impl fmt::Debug for StatsCollector {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "message counters of {}", self.0.process())
    }
}

impl Collector for StatsCollector {
    fn encode(&self, mut encoder: DescriptorEncoder) -> fmt::Result {
        let ledger = self.0.ledger();
        let topics: Vec<(String, _)> = ledger
            .iter()
            .map(|(account, counts)| (account.topic.to_string(), (account.to.is_some(), counts)))
            .collect();
        let mut sent = encoder.encode_descriptor("messages_sent", "Messages published", None, MetricType::Counter)?;
        for (topic, (_, counts)) in topics.iter().filter(|(_, (is_received, _))| !is_received) {
            ConstCounter::new(counts.sent).encode(sent.encode_family(&[("topic", topic.as_str())])?)?;
        }
        let mut received =
            encoder.encode_descriptor("messages_received", "Messages accepted and used", None, MetricType::Counter)?;
        for (topic, (_, counts)) in topics.iter().filter(|(_, (is_received, _))| *is_received) {
            ConstCounter::new(counts.received).encode(received.encode_family(&[("topic", topic.as_str())])?)?;
        }
        let mut dropped =
            encoder.encode_descriptor("messages_dropped", "Messages lost, by reason", None, MetricType::Counter)?;
        for (topic, (is_received, counts)) in &topics {
            let side = if *is_received { "receiver" } else { "sender" };
            for (reason, count) in &counts.dropped {
                let labels = [("topic", topic.as_str()), ("side", side), ("reason", reason.as_str())];
                ConstCounter::new(*count).encode(dropped.encode_family(&labels)?)?;
            }
        }
        let mut in_flight =
            encoder.encode_descriptor("messages_in_flight", "Messages in flight", None, MetricType::Gauge)?;
        for (topic, (is_received, counts)) in &topics {
            let side = if *is_received { "receiver" } else { "sender" };
            let count = i64::try_from(counts.in_flight).unwrap_or(i64::MAX);
            let labels = [("topic", topic.as_str()), ("side", side)];
            ConstGauge::new(count).encode(in_flight.encode_family(&labels)?)?;
        }
        let mut shared = encoder.encode_descriptor(
            "shared_memory_messages",
            "Large messages of a process with a pool of shared memory, by their way",
            None,
            MetricType::Counter,
        )?;
        for (way, count) in self.0.shared_memory() {
            ConstCounter::new(count).encode(shared.encode_family(&[("way", way.as_str())])?)?;
        }
        let seconds = Unit::Seconds;
        let peers = self.0.peers();
        let mut clocks = encoder.encode_descriptor(
            "clock_offset",
            "Clock of a vehicle minus ours, minus the shortest transit time",
            Some(&seconds),
            MetricType::Gauge,
        )?;
        for (cav, offset_s) in peers.iter().filter_map(|peer| Some((&peer.cav, peer.clock_offset_s?))) {
            ConstGauge::new(offset_s).encode(clocks.encode_family(&[("vehicle", cav.as_str())])?)?;
        }
        let mut trust =
            encoder.encode_descriptor("trust", "Trust score of a vehicle, 0 to 1", None, MetricType::Gauge)?;
        for (cav, value) in peers.iter().filter_map(|peer| Some((&peer.cav, peer.trust?))) {
            ConstGauge::new(value).encode(trust.encode_family(&[("vehicle", cav.as_str())])?)?;
        }
        let mut stages = encoder.encode_descriptor(
            "stage",
            "Duration of a stage for one frame",
            Some(&seconds),
            MetricType::Histogram,
        )?;
        for histogram in self.0.histograms() {
            let labels = [("stage", histogram.stage.as_str())];
            let mut family = stages.encode_family(&labels)?;
            family.encode_histogram::<[(&str, &str); 0]>(histogram.sum_s, histogram.count, &histogram.buckets, None)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use protocol::{CavId, DropReason, ProcessId, Stream, Topic};

    use super::*;

    fn sample() -> MessageStats {
        let stats = MessageStats::new(ProcessId::new("agent-4279").unwrap());
        let cav = CavId::new("4279").unwrap();
        let [lidar, bev] = [Stream::Lidar, Stream::Bev].map(|stream| Topic::Stream { cav: cav.clone(), stream });
        stats.subscribed(&lidar);
        for _ in 0..5 {
            stats.arrived(&lidar);
        }
        stats.received(&lidar);
        stats.received(&lidar);
        stats.dropped(&lidar, DropReason::Superseded);
        stats.submitted(&bev);
        stats.trusted(&cav, 0.25);
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
            format!("v2vloc_messages_in_flight{{{process},topic=\"4279/lidar\",side=\"receiver\"}} 2"),
            format!("v2vloc_trust{{{process},vehicle=\"4279\"}} 0.25"),
            "# TYPE v2vloc_stage_seconds histogram".into(),
            "# EOF".into(),
        ] {
            assert!(text.lines().any(|found| found == line), "{line}\nis not in\n{text}");
        }
        let bucket = |le: &str| {
            let line = text.lines().find(|line| line.contains("_bucket") && line.contains(&format!("le=\"{le}\"")));
            line.and_then(|line| line.rsplit(' ').next()).and_then(|count| count.parse::<u64>().ok())
        };
        assert_eq!(
            [bucket("0.0025"), bucket("0.005"), bucket("0.05"), bucket("+Inf")],
            [Some(1), Some(3), Some(4), Some(5)]
        );
    }

    #[test]
    fn metrics_can_be_fetched() {
        let server = MetricsServer::start("127.0.0.1:0".parse().unwrap(), &sample()).unwrap();
        let (status, body) = crate::web::fetch(server.address(), "/metrics").unwrap();
        assert_eq!(status, "HTTP/1.0 200 OK");
        assert_eq!(String::from_utf8(body).unwrap(), exposition(&sample()));
        assert!(crate::web::fetch(server.address(), "/").unwrap().0.contains("404"));
    }
}
