//! `metrics.json`: metrics of a run and their definitions.

mod contribution;

use std::collections::BTreeMap;

use dataset::LeftOut;
use dataset::evaluation_protocol::{ApOrder, EvaluationProtocol};
use protocol::{CavId, Counts, DropReason, Ledger, PoseError, Topic};
use serde::{Deserialize, Serialize};
use support::provenance::Provenance;
use support::statistics::{SUCCESS_M, mean, quantile, share_below, sorted};

use crate::score::{FrameScores, NeighbourRecord};

pub use contribution::Contribution;

/// File name in the folder of a run.
pub const FILE: &str = "metrics.json";

/// Metrics of one run.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Metrics {
    /// Number of frames that the ego reported.
    pub frames: u64,
    /// Number of ticks of the scene at which the recording has the ego and its true pose; without a network all are
    /// answered.
    #[serde(default)]
    pub ticks: u64,
    /// Number of ticks with detections; the others are unanswered.
    #[serde(default)]
    pub answered: u64,
    /// Duration by `clock`, seconds. `wall`: between the arrivals of the first and the last detections; `stepped`: between
    /// the captures of the first and the last tick; `offline`: wall time of the whole evaluation.
    pub seconds: f64,
    /// Clock: `wall`, `stepped` (simulation time) or `offline` (no time passes).
    pub clock: String,
    /// Fusion method.
    pub method: String,
    /// Name of the pose source.
    pub pose_source: String,
    /// Average precision over the answered ticks, with detections ordered by score over all frames, by IoU threshold.
    /// The headline of runs that answer all, unless the protocol has the other order.
    pub ap_global: ByIou,
    /// Average precision with detections in frame order, by score only within a frame, as the reference code does.
    pub ap_frame_order: ByIou,
    /// `ap_global` under the name that says over which ticks it is.
    #[serde(default)]
    pub ap_answered: ByIou,
    /// The same over all ticks; an unanswered one is a frame without detections.
    #[serde(default)]
    pub ap_unanswered_empty: ByIou,
    /// Streaming average precision (Li et al. 2020, "Towards Streaming Perception"), ordered by score: at each tick the
    /// last detections published until then are moved by the ego's true motion since their capture and compared with
    /// the truth at that tick. Latency and missing results both lower it. `null` if results have no time of publication.
    pub ap_streaming: Option<ByIou>,
    /// `ap_answered` by the distance of the objects from the ego's LiDAR, metres in the plane: bins that have objects.
    #[serde(default)]
    pub ap_by_distance: BTreeMap<String, PartPrecision>,
    /// `ap_answered` by the class of the objects: classes that have objects.
    #[serde(default)]
    pub ap_by_class: BTreeMap<String, PartPrecision>,
    /// Errors of the poses that fusion used.
    pub pose: PoseErrors,
    /// Latencies.
    pub latency_ms: Latencies,
    /// Age of neighbours' data: capture time of the ego's sweep less that of a neighbour's oldest fused message, per
    /// neighbour and frame that was fused, milliseconds.
    #[serde(default)]
    pub age_ms: Percentiles,
    /// Transmitted data.
    pub comm: Communication,
    /// Contribution of the neighbours.
    #[serde(default)]
    pub contribution: Contribution,
    /// Every neighbour from which the ego received messages.
    #[serde(default)]
    pub neighbours: BTreeMap<CavId, NeighbourRecord>,
    /// Totals of the ledger. `wall`: of all processes; `stepped`: of the neighbours' messages to the ego.
    pub messages: Messages,
    /// The evaluation protocol, with the ground-truth range as it was applied.
    pub protocol: Option<EvaluationProtocol>,
    /// Data of the scene that could not be used, and frames that could not be computed. On the wall clock frames that
    /// failed are unanswered, and `messages` counts theirs as dropped.
    #[serde(default)]
    pub left_out: LeftOut,
    /// Command, programs, and the digests of everything that the result was made from.
    pub provenance: Option<Provenance>,
}

impl Metrics {
    /// Metrics from the scores of a run of `seconds`; `sent_bytes` is the size of all messages that neighbours sent, if
    /// known.
    pub fn of(
        scores: &FrameScores,
        clock: &str,
        [method, pose_source]: [&str; 2],
        seconds: f64,
        ledger: &Ledger,
        sent_bytes: Option<u64>,
    ) -> Self {
        let records = scores.records().iter();
        let fused = records.clone().map(|record| record.fused).sum();
        let [ap_global, ap_frame_order] = scores.average_precision();
        let [ap_by_distance, ap_by_class] = scores.average_precision_by_part();
        let latencies_ms = records.clone().filter_map(|record| record.latency_ms);
        let (ticks, answered) = scores.ticks();
        let results = records.filter(|record| record.is_answered());
        let results = results.count() as u64;
        // In an evaluation, where all bytes are known, the own agent has no account, and the ego of one scenario may be a
        // neighbour in another.
        let ego = sent_bytes.is_none().then_some(&scores.ego);
        let messages = match ego {
            Some(_) => Messages::of_run(ledger),
            None => Messages::of_evaluation(ledger, |_| true),
        };
        let mut left_out = LeftOut::default();
        left_out.add_scores(method, &scores.scorer);
        Self {
            left_out,
            frames: answered,
            ticks,
            answered,
            seconds,
            clock: clock.into(),
            method: method.into(),
            pose_source: pose_source.into(),
            ap_global,
            ap_frame_order,
            ap_answered: ap_global,
            ap_unanswered_empty: scores.live.unanswered_empty(),
            ap_streaming: scores.live.streaming(),
            ap_by_distance,
            ap_by_class,
            pose: PoseErrors::of(&scores.pose_errors, scores.no_pose),
            latency_ms: Latencies {
                capture_to_detection: Percentiles::of(&latencies_ms.collect::<Vec<_>>()),
            },
            age_ms: Percentiles::of(&scores.ages_ms),
            comm: Communication::of(&scores.bytes, scores.nominal_values),
            contribution: Contribution::of(results, fused, ego, ledger, sent_bytes),
            neighbours: scores.neighbours.clone(),
            messages,
            ..Self::default()
        }
    }

    /// Order of the average precision that is reported first.
    pub fn ap_order(&self) -> ApOrder {
        ApOrder::of(self.protocol.as_ref())
    }

    /// Average precision over the answered ticks that is reported first.
    pub fn headline(&self) -> ByIou {
        self.ap_in(self.ap_order())
    }

    /// Average precision over the answered ticks in an order.
    pub fn ap_in(&self, order: ApOrder) -> ByIou {
        match order {
            ApOrder::Global => self.ap_global,
            ApOrder::Frame => self.ap_frame_order,
        }
    }
}

/// One value per IoU threshold; `null` without a true object.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct ByIou {
    /// At IoU 0.3.
    #[serde(rename = "0.3")]
    pub at_30: Option<f64>,
    /// At IoU 0.5.
    #[serde(rename = "0.5")]
    pub at_50: Option<f64>,
    /// At IoU 0.7.
    #[serde(rename = "0.7")]
    pub at_70: Option<f64>,
}

impl ByIou {
    /// The values at 0.3, 0.5 and 0.7.
    pub fn values(&self) -> [Option<f64>; 3] {
        [self.at_30, self.at_50, self.at_70]
    }
}

/// Average precision of a part of the objects. Detections on objects of other parts count neither way.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct PartPrecision {
    /// Number of the objects.
    pub objects: usize,
    /// Average precision, ordered by score over all frames.
    #[serde(flatten)]
    pub ap: ByIou,
}

/// Errors of the poses, over all vehicles and frames.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct PoseErrors {
    /// Mean distance, metres.
    pub mean_m: Option<f64>,
    /// Median distance, metres.
    pub p50_m: Option<f64>,
    /// 95th percentile of the distance, metres.
    pub p95_m: Option<f64>,
    /// Mean angle, degrees.
    pub mean_deg: Option<f64>,
    /// Share of poses within 3 m of the truth; a vehicle without a pose fails.
    pub success_3m: Option<f64>,
    /// Frames of vehicles that had no pose.
    pub no_pose: u64,
}

/// Latencies of a run.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Latencies {
    /// From the publication of a sweep to the publication of the detections from it, milliseconds.
    pub capture_to_detection: Percentiles,
}

/// Quantiles of a sample; `null` for an empty one.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Percentiles {
    /// Median.
    pub p50: Option<f64>,
    /// 95th percentile.
    pub p95: Option<f64>,
    /// 99th percentile.
    pub p99: Option<f64>,
}

/// Transmitted data, per neighbour and frame that was fused.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Communication {
    /// Mean bytes of metadata and body of the fused messages.
    pub payload_bytes_mean: Option<f64>,
    /// Mean bytes of all messages that a neighbour sent for a frame, headers and pose message included.
    pub wire_bytes_mean: Option<f64>,
    /// Base-2 logarithm of `payload_bytes_mean`, as papers give communication volume.
    pub log2_payload: Option<f64>,
    /// Base-2 logarithm of the bytes of an uncompressed `f32` feature map of this model.
    pub nominal_fp32_log2: f64,
}

/// Number of messages that may be in flight at the end of any run.
const FEW: u64 = 20;

/// Number of messages, of those that the ledger counts.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Messages {
    /// Published, once per receiver.
    pub sent: u64,
    /// Received and used.
    pub received: u64,
    /// In flight at the end.
    pub in_flight: u64,
    /// Not used, by reason.
    pub dropped: BTreeMap<DropReason, u64>,
    /// Published on topics without a receiver: in none of the others.
    #[serde(default)]
    pub unreceived: u64,
}

impl Percentiles {
    /// Quantiles of `sample`.
    pub fn of(sample: &[f64]) -> Self {
        let sorted = sorted(sample);
        Self {
            p50: quantile(&sorted, 0.50),
            p95: quantile(&sorted, 0.95),
            p99: quantile(&sorted, 0.99),
        }
    }
}

impl Messages {
    fn of(counts: Counts, unreceived: u64) -> Self {
        Self {
            sent: counts.sent,
            received: counts.received,
            in_flight: counts.in_flight,
            dropped: counts.dropped,
            unreceived,
        }
    }

    /// Sums over the receivers of a run.
    pub fn of_run(ledger: &Ledger) -> Self {
        let unreceived = ledger.balance().unreceived;
        let unreceived = unreceived.iter().map(|topic| topic.messages);
        Self::of(ledger.delivered(), unreceived.sum())
    }

    /// Sums of an evaluation, over the topics that `is_counted` selects: each message has one receiver, the ego of its
    /// scenario.
    pub fn of_evaluation(ledger: &Ledger, is_counted: impl Fn(&Topic) -> bool) -> Self {
        let mut total = Counts::default();
        let counted = ledger.iter().filter(|(of, _)| is_counted(&of.topic));
        counted.for_each(|(_, counts)| total.add(counts));
        Self::of(total, 0)
    }

    /// True if most of the messages that were sent neither arrived nor were lost: then the link carries next to
    /// nothing.
    pub fn are_stuck(&self) -> bool {
        self.in_flight >= FEW && self.in_flight > self.sent / 2
    }
}

impl PoseErrors {
    /// Summarises the errors of all poses; `no_pose` is the number of frames of vehicles without a pose.
    pub fn of(errors: &[PoseError], no_pose: u64) -> Self {
        let distances: Vec<f64> = errors.iter().map(|error| error.distance_m).collect();
        let distances = sorted(&distances);
        let tried = errors.len() + no_pose as usize;
        Self {
            mean_m: mean(&distances),
            p50_m: quantile(&distances, 0.50),
            p95_m: quantile(&distances, 0.95),
            mean_deg: mean(&Vec::from_iter(errors.iter().map(|error| error.angle_deg))),
            success_3m: (tried > 0).then(|| share_below(&distances, SUCCESS_M, tried)),
            no_pose,
        }
    }
}

impl Communication {
    /// Summarises `(payload, wire)` bytes of every neighbour and frame; `nominal_values` is the size of a feature map.
    pub fn of(bytes: &[(u64, u64)], nominal_values: u64) -> Self {
        let (payload, wire): (Vec<f64>, Vec<f64>) = bytes
            .iter()
            .map(|(payload, wire)| (*payload as f64, *wire as f64))
            .unzip();
        let payload = mean(&payload);
        Self {
            payload_bytes_mean: payload,
            wire_bytes_mean: mean(&wire),
            // The logarithm of 0 is infinite, which JSON has no number for.
            log2_payload: payload.filter(|bytes| *bytes > 0.0).map(f64::log2),
            nominal_fp32_log2: (4.0 * nominal_values as f64).log2(),
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Metrics of 60 frames of which nothing else is known.
    pub(crate) fn metrics(method: &str) -> Metrics {
        Metrics {
            frames: 60,
            ticks: 60,
            answered: 60,
            seconds: 6.0,
            clock: "wall".into(),
            method: method.into(),
            pose_source: "recorded".into(),
            ..Metrics::default()
        }
    }

    /// True if the value, which has to be known, is the expected one but for rounding.
    pub(crate) fn is_near(found: Option<f64>, expected: f64) -> bool {
        (found.unwrap() - expected).abs() < 1e-9
    }

    fn precision(at_50: f64) -> ByIou {
        ByIou {
            at_50: Some(at_50),
            ..ByIou::default()
        }
    }

    #[test]
    fn the_file_names_the_three_precisions() {
        let metrics = Metrics {
            answered: 29,
            ap_answered: precision(0.9),
            ap_unanswered_empty: precision(0.5),
            ap_streaming: Some(precision(0.25)),
            ..metrics("pastat")
        };
        let json = serde_json::to_value(&metrics).unwrap();
        assert_eq!(
            (&json["answered"], &json["ticks"]),
            (&29.into(), &60.into())
        );
        let at_50 = ["ap_answered", "ap_unanswered_empty", "ap_streaming"]
            .map(|name| json[name]["0.5"].as_f64());
        assert_eq!(at_50, [Some(0.9), Some(0.5), Some(0.25)]);
        assert_eq!(serde_json::from_value::<Metrics>(json).unwrap(), metrics);
    }

    #[test]
    fn the_precision_of_the_protocols_order_comes_first() {
        let by_score = Metrics {
            ap_global: precision(0.9),
            ap_frame_order: precision(0.6),
            ..metrics("max")
        };
        assert_eq!(by_score.headline().at_50, Some(0.9));
        let by_frame = Metrics {
            protocol: EvaluationProtocol::preset("v2v4real"),
            ..by_score
        };
        assert_eq!(by_frame.ap_order(), ApOrder::Frame);
        assert_eq!(by_frame.headline().at_50, Some(0.6));
    }

    #[test]
    fn quantiles_lie_between_neighbours() {
        let percentiles = Percentiles::of(&[3.0, 1.0, 2.0, 4.0, 5.0]);
        assert_eq!(percentiles.p50, Some(3.0));
        assert!((percentiles.p95.unwrap() - 4.8).abs() < 1e-12);
        assert_eq!(Percentiles::of(&[7.0]).p99, Some(7.0));
        assert_eq!(Percentiles::of(&[]), Percentiles::default());
    }

    #[test]
    fn a_vehicle_without_pose_is_no_success() {
        let near = PoseError {
            distance_m: 0.5,
            angle_deg: 1.0,
        };
        let far = PoseError {
            distance_m: 3.5,
            angle_deg: 2.0,
        };
        let errors = PoseErrors::of(&[near, far, near], 1);
        assert_eq!((errors.success_3m, errors.no_pose), (Some(0.5), 1));
        assert_eq!(errors.mean_m, Some(1.5));
        assert_eq!(PoseErrors::of(&[], 0).success_3m, None);
    }

    #[test]
    fn volume_is_the_logarithm_of_the_mean() {
        let comm = Communication::of(&[(1024, 1100), (1024, 1300)], 64 * 96 * 128);
        assert_eq!(
            (comm.payload_bytes_mean, comm.wire_bytes_mean),
            (Some(1024.0), Some(1200.0))
        );
        assert_eq!(comm.log2_payload, Some(10.0));
        assert!((comm.nominal_fp32_log2 - (4.0 * 64.0 * 96.0 * 128.0_f64).log2()).abs() < 1e-12);
        assert_eq!(Communication::of(&[], 1).log2_payload, None);
    }

    #[test]
    fn thresholds_are_named_by_their_numbers() {
        let text = serde_json::to_string(&precision(0.5)).unwrap();
        assert_eq!(text, r#"{"0.3":null,"0.5":0.5,"0.7":null}"#);
    }
}
