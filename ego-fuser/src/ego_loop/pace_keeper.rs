//! Pace keeper: the pace that an ego asks of the agents, and when it is repeated.

use protocol::Pace;

use crate::pace_control::PaceControl;

/// Period at which the pace is repeated, nanoseconds: for agents that join late, and so that a slower ego of the fleet
/// does not set the pace of one that keeps up.
const REPEAT_NANOS: u64 = 1_000_000_000;

/// Controller of the pace, with its last value.
pub(super) struct PaceKeeper {
    /// None where every sweep is computed in any case.
    control: Option<PaceControl>,
    pace: Pace,
    /// Time at which the pace was published, nanoseconds.
    published_nanos: Option<u64>,
}

impl PaceKeeper {
    pub(super) fn new(is_controlled: bool) -> Self {
        Self {
            control: is_controlled.then(PaceControl::new),
            pace: Pace::EVERY_SWEEP,
            published_nanos: None,
        }
    }

    /// Judges a frame of the own agent that has waited for another one. Returns the pace if that changes.
    pub(super) fn judge(
        &mut self,
        capture_nanos: u64,
        waited_nanos: u64,
        now_nanos: u64,
    ) -> Option<Pace> {
        let control = self.control.as_mut()?;
        let pace = control.judge(capture_nanos, waited_nanos, now_nanos)?;
        let Pace { computed, of, .. } = pace;
        tracing::info!(
            capture_nanos,
            "the pace of the fleet changes to {computed} of {of} sweeps"
        );
        self.pace = pace;
        self.published_nanos = Some(now_nanos);
        Some(pace)
    }

    /// The pace, if it is time to publish it again.
    pub(super) fn repeat(&mut self, now_nanos: u64) -> Option<Pace> {
        let since_nanos = *self.published_nanos.get_or_insert(now_nanos);
        if now_nanos < since_nanos.saturating_add(REPEAT_NANOS) {
            return None;
        }
        self.published_nanos = Some(now_nanos);
        Some(self.pace)
    }
}
