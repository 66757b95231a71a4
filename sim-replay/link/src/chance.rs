//! Randomness per message: depends on the message and the purpose only, not on earlier decisions.

use protocol::CavId;

use support::random::{SplitMix64, derive_seed};

/// Purpose of a random decision.
#[derive(Debug, Clone, Copy)]
pub(super) enum Purpose {
    Delay = 1,
    Loss = 2,
    Reorder = 3,
    Duplicate = 4,
}

/// Random numbers of one direction of one link.
#[derive(Debug, Clone, Copy)]
pub(super) struct Chance {
    seed: u64,
}

impl Chance {
    pub(super) fn new(seed: u64, from: &CavId, to: &CavId) -> Self {
        Self {
            // From names, not from indices: another vehicle does not change the draws of this pair.
            seed: derive_seed(seed, &[from, to].map(|cav| label(cav.as_str()))),
        }
    }

    /// Random numbers for one decision about one message.
    pub(super) fn of(self, purpose: Purpose, stream: u64, sequence: u64) -> SplitMix64 {
        SplitMix64::derived(self.seed, &[purpose as u64, stream, sequence])
    }
}

/// A number for a name that does not depend on the order in which names are listed.
pub(super) fn label(name: &str) -> u64 {
    derive_seed(0, &name.bytes().map(u64::from).collect::<Vec<_>>())
}
