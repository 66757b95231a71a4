//! Purposes of random draws: a draw depends on the message and the purpose only, not on earlier decisions.

use support::random::derive_seed;

/// Purpose of a random decision.
#[derive(Debug, Clone, Copy)]
pub(super) enum Purpose {
    Delay = 1,
    Loss = 2,
    Reorder = 3,
    Duplicate = 4,
}

/// A number for a name that does not depend on the order in which names are listed.
pub(super) fn label(name: &str) -> u64 {
    derive_seed(0, &name.bytes().map(u64::from).collect::<Vec<_>>())
}
