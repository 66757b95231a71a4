//! Contribution of the neighbours to the frames of a run.

use std::collections::BTreeMap;

use protocol::{CavId, Ledger, Role, Stream, Topic};
use serde::{Deserialize, Serialize};

/// Use of the data that neighbours shared.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Contribution {
    /// Neighbours whose data are in the result, mean over the frames.
    pub fused_per_frame: Option<f64>,
    /// Number of feature maps, boxes or clouds that neighbours have sent; `null` without a network, as nothing is sent.
    pub sent: Option<u64>,
    /// Number of those that arrived in time and were used; `null` as above.
    pub used: Option<u64>,
    /// Mean bytes of all messages that a neighbour sent for a frame, headers and pose message included, used or not.
    pub sent_bytes_mean: Option<f64>,
}

impl Contribution {
    /// Summarises a ledger: in `frames` frames `fused` neighbours were fused. Messages of `ego`, if given, are its own
    /// agent's. `sent_bytes` is the size of all messages that were sent, if known.
    pub(crate) fn of(
        frames: u64,
        fused: usize,
        ego: Option<&CavId>,
        ledger: &Ledger,
        sent_bytes: Option<u64>,
    ) -> Self {
        let ego_process = format!("{}-", Role::Ego);
        let mut sent_frames = BTreeMap::<&CavId, u64>::new();
        let (mut sent, mut used) = (0, 0);
        for (account, counts) in ledger.iter().filter(|(of, _)| shares(&of.topic, ego)) {
            // Counted at the sender: what comes out of a link is the same message on another topic.
            if let Topic::Stream { cav, .. } = &account.topic {
                sent += counts.sent;
                // Beside a map boxes are a second message of the same frame.
                let frames = sent_frames.entry(cav).or_default();
                *frames = counts.sent.max(*frames);
            }
            if { account.to.as_ref() }.is_some_and(|to| to.as_str().starts_with(&ego_process)) {
                used += counts.received;
            }
        }
        let sent_frames: u64 = sent_frames.values().sum();
        let has_network = ledger.iter().next().is_some();
        Self {
            fused_per_frame: (frames > 0).then(|| fused as f64 / frames as f64),
            sent: has_network.then_some(sent),
            used: has_network.then_some(used),
            sent_bytes_mean: sent_bytes
                .filter(|_| sent > 0)
                .map(|bytes| bytes as f64 / sent_frames as f64),
        }
    }
}

/// True if a topic carries perception data of another vehicle than `ego`.
fn shares(topic: &Topic, ego: Option<&CavId>) -> bool {
    match topic {
        Topic::Stream { cav, stream } | Topic::Received { cav, stream, .. } => {
            ego != Some(cav) && matches!(stream, Stream::Bev | Stream::Boxes | Stream::Points)
        }
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use dataset::ground_truth::GroundTruthRule;
    use protocol::{Account, DropReason, ProcessId};

    use super::*;
    use crate::score::FrameScores;
    use crate::score::metrics::Metrics;

    fn ledger() -> (Ledger, CavId) {
        let (ego, to) = (CavId::new("1").unwrap(), ProcessId::new("ego-1").unwrap());
        let mut ledger = Ledger::default();
        for cav in ["1", "2", "3"].map(|name| CavId::new(name).unwrap()) {
            for stream in [Stream::Pose, Stream::Bev] {
                let published = Account::published(Topic::stream(&cav, stream));
                let towards = Account::towards(Topic::stream(&cav, stream), &to);
                for tick in 0..4 {
                    ledger.sent(&published);
                    match (tick, stream) {
                        (0, _) | (_, Stream::Pose) => ledger.received(&towards),
                        _ => ledger.dropped(&towards, DropReason::Stale),
                    }
                }
            }
        }
        (ledger, ego)
    }

    #[test]
    fn maps_of_neighbours_are_counted_and_neither_poses_nor_the_egos_own() {
        let (ledger, ego) = ledger();
        let contribution = Contribution::of(4, 2, Some(&ego), &ledger, Some(800));
        assert_eq!((contribution.sent, contribution.used), (Some(8), Some(2)));
        assert_eq!(
            (contribution.fused_per_frame, contribution.sent_bytes_mean),
            (Some(0.5), Some(100.0))
        );
    }

    #[test]
    fn in_an_evaluation_the_ego_of_the_last_scenario_is_a_neighbour_of_others() {
        let (ledger, ego) = ledger();
        let scores = FrameScores::new(ego, GroundTruthRule::OPV2V, 1);
        let sent = |bytes: Option<u64>| {
            let metrics = Metrics::of(&scores, "", ["max", "recorded"], 1.0, &ledger, bytes);
            (metrics.contribution.sent, metrics.contribution.used)
        };
        let in_run = (Some(8), Some(2));
        assert_eq!((sent(Some(800)), sent(None)), ((Some(12), Some(3)), in_run));
    }

    #[test]
    fn boxes_beside_a_map_are_of_the_same_frame() {
        let (mut ledger, ego) = ledger();
        for cav in ["2", "3"].map(|name| CavId::new(name).unwrap()) {
            let boxes = Topic::Stream {
                cav,
                stream: Stream::Boxes,
            };
            (0..3).for_each(|_| ledger.sent(&Account::published(boxes.clone())));
        }
        let contribution = Contribution::of(4, 2, Some(&ego), &ledger, Some(800));
        assert_eq!(
            (contribution.sent, contribution.sent_bytes_mean),
            (Some(14), Some(100.0))
        );
    }

    #[test]
    fn what_a_live_link_passes_on_is_sent_once() {
        let (mut ledger, ego) = ledger();
        let cav = CavId::new("2").unwrap();
        let passed = Topic::Received {
            ego: ego.clone(),
            cav: cav.clone(),
            stream: Stream::Bev,
        };
        ledger.received(&Account::towards(
            Topic::Stream {
                cav,
                stream: Stream::Bev,
            },
            &ProcessId::new("link").unwrap(),
        ));
        ledger.sent(&Account::published(passed.clone()));
        ledger.received(&Account::towards(passed, &ProcessId::new("ego-1").unwrap()));
        let contribution = Contribution::of(4, 2, Some(&ego), &ledger, None);
        assert_eq!((contribution.sent, contribution.used), (Some(8), Some(3)));
    }

    #[test]
    fn without_frames_and_network_all_values_are_absent() {
        let nothing = Contribution::of(0, 0, None, &Ledger::default(), Some(0));
        assert_eq!(nothing, Contribution::default());
        let fused = Contribution::of(4, 8, None, &Ledger::default(), Some(0));
        assert_eq!((fused.fused_per_frame, fused.sent), (Some(2.0), None));
    }
}
