//! Pace: share of the ticks that every agent computed and that the ego answered, and intervals between detections.

use std::collections::BTreeMap;

use protocol::{Account, CavId, Role, Stream, Topic};
use serde::{Deserialize, Serialize};

use super::Spread;
use crate::score::metrics::Metrics;
use crate::score::{FrameRecord, ProcessStats};

/// Stage that an agent times once for every sweep that it computes in full.
const WHOLE_SWEEP: &str = "agent";

/// Pace of a run.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct RunPace {
    /// Number of ticks of the scene.
    pub ticks: u64,
    /// Number of ticks with detections.
    pub answered: u64,
    /// Sweeps that each agent computed, by vehicle; empty in simulation time, where all are.
    pub agents: BTreeMap<String, AgentPace>,
    /// Between the publications of two detections that follow each other, milliseconds.
    pub interval_ms: Spread,
    /// Detections per second, from the first to the last.
    pub rate_hz: Option<f64>,
    /// From the first tick to the last publication, seconds.
    pub seconds: f64,
}

/// Sweeps of one agent.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct AgentPace {
    /// Number of sweeps computed, over all instances of the process.
    pub computed: u64,
    /// Number of sweeps that were sent to it; `None`: not known, the ticks count.
    #[serde(default)]
    pub sent: Option<u64>,
    /// Share of these, 0..=1.
    pub share: f64,
}

impl RunPace {
    pub(super) fn of(
        metrics: &Metrics,
        records: &[FrameRecord],
        processes: &[ProcessStats],
    ) -> Self {
        let mut published_s: Vec<f64> = records.iter().filter_map(published_s).collect();
        // Records are in the order of capture, not of publication.
        published_s.sort_by(f64::total_cmp);
        let intervals_ms = published_s.windows(2).map(|pair| (pair[1] - pair[0]) * 1e3);
        let intervals_ms: Vec<f64> = intervals_ms.collect();
        let first_s = records.iter().map(began_s).reduce(f64::min);
        let began_s = records.iter().map(began_s);
        let last_s = began_s.chain(published_s.iter().copied()).reduce(f64::max);
        let ends = published_s.first().zip(published_s.last());
        let span_s = ends.map_or(0.0, |(first, last)| last - first);
        Self {
            ticks: metrics.ticks,
            answered: metrics.answered,
            agents: agents(processes, metrics.ticks),
            interval_ms: Spread::of(&intervals_ms),
            rate_hz: (span_s > 0.0).then(|| intervals_ms.len() as f64 / span_s),
            seconds: first_s
                .zip(last_s)
                .map_or(0.0, |(first, last)| last - first),
        }
    }

    /// Share of answered ticks, 0..=1; `None` without ticks.
    pub fn answered_share(&self) -> Option<f64> {
        (self.ticks > 0).then(|| self.answered as f64 / self.ticks as f64)
    }
}

/// Time of publication of a tick; in simulation time its capture, seconds.
fn began_s(record: &FrameRecord) -> f64 {
    record.stamps.began_nanos.unwrap_or(record.capture_nanos) as f64 * 1e-9
}

/// Time of publication of its detections, seconds.
fn published_s(record: &FrameRecord) -> Option<f64> {
    Some(began_s(record) + record.latency_ms? * 1e-3)
}

fn agents(processes: &[ProcessStats], ticks: u64) -> BTreeMap<String, AgentPace> {
    let mut agents = BTreeMap::<String, AgentPace>::new();
    for stats in processes {
        let name = stats.process.as_str().strip_prefix(Role::Agent.as_str());
        let Some(cav) = name.and_then(|rest| rest.strip_prefix('-')) else {
            continue;
        };
        agents.entry(cav.to_owned()).or_default().computed += sweeps(stats);
    }
    for (cav, pace) in &mut agents {
        // A vehicle may be there for a part of the scene.
        pace.sent = sent(processes, cav).filter(|sent| *sent > 0);
        let of = pace.sent.unwrap_or(ticks);
        if of > 0 {
            pace.share = pace.computed as f64 / of as f64;
        }
    }
    agents
}

/// Number of sweeps that all instances of the replay, or of its sender, sent to a vehicle.
fn sent(processes: &[ProcessStats], cav: &str) -> Option<u64> {
    let account = Account::published(Topic::stream(&CavId::new(cav).ok()?, Stream::Lidar));
    let counts = processes.iter().filter_map(|of| of.ledger.get(&account));
    Some(counts.map(|counts| counts.sent).sum())
}

/// Number of sweeps that an agent has computed.
pub(super) fn sweeps(stats: &ProcessStats) -> u64 {
    let mut stages = stats.stages.iter();
    let whole = stages.find(|stage| stage.stage == WHOLE_SWEEP);
    whole.map_or(0, |stage| stage.count)
}
