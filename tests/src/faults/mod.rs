//! Faults of a running fleet: processes killed, stopped and ended, virtual links cut and silent, the router gone. Kind,
//! time and duration come from a seed.

mod check;
mod endurance;
mod fleet;
mod proxy;

use std::fmt;
use std::time::Duration;

use support::random::derive_seed;

pub use check::{Findings, Result, Results};
pub use endurance::{ColdStart, Soak, cold_start, soak, write_scenario};
pub use fleet::{FaultyFleet, Report};
pub(crate) use proxy::Proxy;

/// The vehicles; the first is the ego's.
pub const VEHICLES: [&str; 4] = ["10", "20", "30", "40"];

fn unix_ms() -> u64 {
    bus::unix_nanos() / 1_000_000
}

/// Kind of a fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Kind {
    /// `kill -9`.
    Kill,
    /// SIGTERM, as an operator ends a process.
    End,
    /// SIGSTOP, and after a while SIGCONT.
    Stop,
    /// The connection is cut; the process may connect again at once.
    Cut,
    /// Nothing is transmitted for a while, but the connection stays open.
    Silence,
}

/// Target of a fault.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Target {
    /// A process, by its name.
    Process(String),
    /// The router of the run: gone, and restarted after a while.
    Router,
}

/// One fault.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fault {
    /// Kind of the fault.
    pub kind: Kind,
    /// Its target.
    pub target: Target,
    /// Its duration, for kinds with one.
    pub lasts: Duration,
    /// Time from recovery to the fault.
    pub after: Duration,
}

impl Fault {
    /// True if no results can be expected of the ego meanwhile: its inputs are hit, or the connection to the scorer.
    #[must_use]
    pub(crate) fn silences_ego(&self) -> bool {
        let own = [
            format!("agent-{}", VEHICLES[0]),
            format!("ego-{}", VEHICLES[0]),
            "replay".into(),
        ];
        match &self.target {
            Target::Router => true,
            Target::Process(name) => own.contains(name),
        }
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = self.lasts.as_secs_f64();
        let Target::Process(target) = &self.target else {
            return write!(f, "the router gone for {seconds:.1} s");
        };
        match self.kind {
            Kind::Kill => write!(f, "{target} killed"),
            Kind::End => write!(f, "{target} ended"),
            Kind::Stop => write!(f, "{target} stopped for {seconds:.1} s"),
            Kind::Cut => write!(f, "{target} cut off"),
            Kind::Silence => write!(f, "{target} silent for {seconds:.1} s"),
        }
    }
}

/// `count` faults, the same for the same seed: all kinds, on all processes of the fleet and on its router.
#[must_use]
pub fn plan(seed: u64, count: usize) -> Vec<Fault> {
    let draw =
        |number: usize, what: u64, below: u64| derive_seed(seed, &[number as u64, what]) % below;
    let mut targets: Vec<String> = VEHICLES.iter().map(|cav| format!("agent-{cav}")).collect();
    targets.extend([
        format!("ego-{}", VEHICLES[0]),
        format!("link-{}", VEHICLES[0]),
        "replay".into(),
    ]);
    let fault = |number: usize| {
        let after = Duration::from_millis(draw(number, 0, 400));
        let long = draw(number, 1, 50) == 0;
        let lasts = Duration::from_millis(if long {
            10_000
        } else {
            100 + draw(number, 2, 1900)
        });
        let place = draw(number, 3, targets.len() as u64 + 1) as usize;
        let Some(name) = targets.get(place).cloned() else {
            return Fault {
                kind: Kind::Stop,
                target: Target::Router,
                lasts: lasts.min(Duration::from_secs(2)),
                after,
            };
        };
        // The replay is the clock of the run: a requested end of it, other than a crash, ends the run.
        let kinds: &[Kind] = if name == "replay" {
            &[Kind::Kill, Kind::Stop, Kind::Cut, Kind::Silence]
        } else {
            &[
                Kind::Kill,
                Kind::Kill,
                Kind::End,
                Kind::Stop,
                Kind::Cut,
                Kind::Silence,
            ]
        };
        let kind = kinds[draw(number, 4, kinds.len() as u64) as usize];
        Fault {
            kind,
            target: Target::Process(name),
            lasts,
            after,
        }
    };
    (0..count).map(fault).collect()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn a_plan_comes_from_its_seed_and_hits_everyone_in_every_way() {
        let faults = plan(1, 500);
        assert_eq!(faults, plan(1, 500));
        assert_eq!(faults[..20], plan(1, 20));
        assert_ne!(faults, plan(2, 500));
        let hit: BTreeSet<_> = faults
            .iter()
            .map(|fault| (&fault.target, fault.kind))
            .collect();
        // Six processes in five ways, the replay in four, the router.
        assert_eq!(hit.len(), 6 * 5 + 4 + 1);
        assert!(
            faults
                .iter()
                .all(|fault| fault.lasts <= Duration::from_secs(10))
        );
    }
}
