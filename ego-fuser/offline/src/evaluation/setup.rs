//! Setup of an evaluation: models, vehicles, ego and delivery, in the types of the processes' configurations.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use agent::attack::AttackConfig;
use agent::config::{AgentSettings, ModelConfig};
use dataset::evaluation_protocol::EvaluationProtocol;
use dataset::{Scenario, Tick, period_nanos};
use ego_fuser::config::EgoSettings;
use ego_fuser::ego_loop::LoopOptions;
use ego_fuser::pairing::PairingConfig;
use fusion::method::Method;
use link::{LatencyModel, LinkConfig, LinkEmulator, LinkError};
use protocol::CavId;
use support::random::scenario_seed;

use super::stepped::ComputeTimes;

/// Everything that an evaluation does besides the data.
#[derive(Debug, Clone, Default)]
pub struct Setup {
    /// Weights of encoder and head, and their number format; everything is computed on the CPU.
    pub models: ModelConfig,
    /// The method; absent: that of the weights.
    pub method: Option<Method>,
    /// Settings of every vehicle, unless `vehicles` has others; maps without a gate have the method's own.
    pub agents: AgentSettings,
    /// Settings of single vehicles.
    pub vehicles: BTreeMap<CavId, AgentSettings>,
    /// Attacking neighbours; absent: none.
    pub attack: Option<AttackConfig>,
    /// Misbehaviour detection of the ego, and its limits: the deadline over a link alone. `id` is not read.
    pub ego: EgoSettings,
    /// Link emulation in simulation time. Absent: all messages arrive `delay_ms` after their sweep; the ego waits for
    /// none and fuses the newest of each neighbour, up to `ego.max_age_ms` on top of the delay; computing takes no time,
    /// and nothing is counted.
    pub link: Option<EmulatedLink>,
    /// Delay of the messages of neighbours without a link, milliseconds.
    pub delay_ms: u64,
    /// Compute times of all processes, over a link.
    pub compute: ComputeTimes,
    /// Agents whose messages and annotations count, and objects that count; absent: vehicles completely over the area
    /// of the network, of all agents within 70 m.
    pub protocol: Option<EvaluationProtocol>,
    /// Vehicles that take part.
    pub pool: AgentPool,
    /// First tick of a scenario.
    pub seek: usize,
    /// Largest number of ticks of a scenario; absent: all.
    pub frames: Option<usize>,
    /// A variant of the sweeps, see [`Scenario::lidar_variants`].
    pub lidar_variant: Option<String>,
}

/// The link between the neighbours and the ego.
#[derive(Debug, Clone, PartialEq)]
pub struct EmulatedLink {
    /// Its stages.
    pub config: LinkConfig,
    /// Base folder of the paths of traces in it.
    pub folder: PathBuf,
    /// Seed of losses and delays. Every scenario derives its own from it.
    pub seed: u64,
}

/// Vehicles of an evaluation.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum AgentPool {
    /// All of a scenario; the first is the ego.
    #[default]
    All,
    /// The first so many. Annotations of the others count all the same, so that the ground truth does not depend on the
    /// number of senders.
    First(usize),
    /// These, the ego first; the others are ignored completely.
    Named(Vec<CavId>),
}

impl EmulatedLink {
    /// The link of a preset or of a file.
    ///
    /// # Errors
    /// [`LinkError`] when it is neither.
    pub fn open(model: &str, seed: u64) -> Result<Self, LinkError> {
        let (config, folder) = LinkConfig::open(model)?;
        Ok(Self {
            config,
            folder,
            seed,
        })
    }
}

impl Setup {
    /// The link of a scenario.
    pub(super) fn emulator(&self, scenario: &Scenario) -> Result<LinkEmulator, LinkError> {
        let Some(link) = &self.link else {
            // Without an emulated link there is the delay alone, which no seed changes.
            let config = LinkConfig {
                latency: LatencyModel::ConstantMs(self.delay_ms as f64),
                ..LinkConfig::default()
            };
            return LinkEmulator::new(config, Path::new("."), 0);
        };
        let seed = scenario_seed(link.seed, &scenario.name);
        LinkEmulator::new(link.config.clone(), &link.folder, seed)
    }

    /// True if results have a latency. Without a link no time passes; without a compute time a result is as old as its
    /// sweep by definition.
    pub fn is_timed(&self) -> bool {
        self.link.is_some() && self.compute != ComputeTimes::default()
    }

    /// Options of an ego's loop in a scenario.
    pub(super) fn loop_options(&self, scenario: &Scenario) -> LoopOptions {
        let options = LoopOptions::stepped(&self.ego);
        if self.link.is_some() {
            return options;
        }
        let delay_nanos = self.delay_ms.saturating_mul(1_000_000);
        let live_nanos = options.pairing.max_age_nanos;
        let max_age_nanos = max_age_nanos(delay_nanos, live_nanos, &scenario.ticks);
        LoopOptions {
            // The ego waits for none, and takes none that was captured after its own sweep.
            deadline_nanos: 0,
            pairing: PairingConfig {
                max_lead_nanos: 0,
                ..PairingConfig::with_max_age_nanos(max_age_nanos)
            },
            ..options
        }
    }
}

/// Largest age of a message that arrives after a constant delay: that of a live run on top of the delay. Where sweeps are
/// rarer, less than a step on top of it: a late message is not one that a neighbour lacks. All nanoseconds.
fn max_age_nanos(delay_nanos: u64, live_nanos: u64, ticks: &[Tick]) -> u64 {
    if delay_nanos == 0 {
        return live_nanos;
    }
    let step_nanos = period_nanos(ticks).unwrap_or(0);
    delay_nanos.saturating_add(live_nanos.max(step_nanos.saturating_sub(1)))
}

impl AgentPool {
    /// Indices of the participants among the agents of a scenario, the ego first, and of those that only contribute
    /// annotations.
    pub(super) fn places(&self, scenario: &Scenario) -> (Vec<usize>, Vec<usize>) {
        let all = 0..scenario.agents.len();
        match self {
            Self::All => (all.collect(), Vec::new()),
            Self::First(count) => all.partition(|place| place < count),
            Self::Named(names) => {
                let (names, agents) = (names.iter(), &scenario.agents);
                let places = names.filter_map(|name| agents.iter().position(|it| it == name));
                (places.collect(), Vec::new())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    #[test]
    fn results_have_a_latency_over_a_link_with_a_compute_time() {
        let compute = ComputeTimes {
            fuse_ms: 1.0,
            ..ComputeTimes::default()
        };
        let ideal = EmulatedLink::open("ideal", 0).unwrap();
        for (link, compute, is_timed) in [
            (None, compute, false),
            (Some(ideal.clone()), ComputeTimes::default(), false),
            (Some(ideal), compute, true),
        ] {
            let setup = Setup {
                link,
                compute,
                ..Setup::default()
            };
            assert_eq!(setup.is_timed(), is_timed, "{compute:?}");
        }
    }

    #[test]
    fn a_pause_in_a_recording_makes_no_old_map_young_enough() {
        let of = |delay_ms: u64, captures_ms: &[u64]| {
            let ticks = captures_ms.iter().map(|capture_ms| Tick {
                stem: capture_ms.to_string(),
                capture_nanos: capture_ms * MS,
            });
            max_age_nanos(delay_ms * MS, 150 * MS, &Vec::from_iter(ticks))
        };
        // The limit of a live run, as over a link.
        assert_eq!(of(0, &[0, 100, 200]), 150 * MS);
        assert_eq!(of(0, &[0, 500, 1000]), 150 * MS);
        assert_eq!(of(100, &[0, 100, 200, 300, 5300]), 250 * MS);
        // At 2 Hz a map of the tick before has just arrived, and one of two ticks before is too old.
        assert_eq!(of(500, &[0, 500, 1000, 1500, 9000]), 1000 * MS - 1);
        assert_eq!(of(100, &[0]), 250 * MS);
    }
}
