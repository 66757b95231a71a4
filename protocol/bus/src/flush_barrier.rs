//! Whether what was sent has left this machine.

use std::time::{Duration, Instant};

use protocol::{KeyExpr, RunId};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Session, Wait};

/// How long one question waits. zenoh keeps a timer for each until then, answered or not: with many questions a second
/// that is memory.
const ROUND: Duration = Duration::from_secs(2);

/// Tells when the router has everything that was put before.
pub(super) struct FlushBarrier {
    session: Session,
    asked: KeyExpr,
    priority: Priority,
}

impl FlushBarrier {
    /// Of what is sent with `priority` and before all that has a lower one.
    pub(super) fn new(session: &Session, run: &RunId, priority: Priority) -> Self {
        Self { session: session.clone(), asked: KeyExpr::none(run), priority }
    }

    /// Waits for it, in at most `limit`. A question that nobody answers comes back from the router at once, and has to go
    /// through the same queue as the messages before it. A connection that is lost ends the waiting too.
    pub(super) fn wait(&self, limit: Duration) {
        let begun = Instant::now();
        while begun.elapsed() < limit && !self.answered() {}
        if begun.elapsed() >= limit {
            tracing::warn!(?limit, "the router has not said that it has everything: what was sent last may be lost");
        }
    }

    /// Asks once; whether the waiting is over.
    fn answered(&self) -> bool {
        let asked = (self.session.get(self.asked.as_str()))
            .priority(self.priority)
            .congestion_control(CongestionControl::Block)
            .timeout(ROUND)
            .wait();
        match asked {
            Ok(answers) => {
                let mut is_over = true;
                while let Ok(answer) = answers.recv() {
                    // Nobody answers, so this is zenoh saying that the time is over.
                    is_over &= answer.result().is_ok();
                }
                is_over
            }
            Err(cause) => {
                tracing::debug!("nobody to ask for a receipt: {cause}");
                true
            }
        }
    }
}
