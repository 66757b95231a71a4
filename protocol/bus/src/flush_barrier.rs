//! Flush barrier: waits until all published messages have reached the router.

use std::time::{Duration, Instant};

use protocol::{KeyExpr, RunId};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Session, Wait};

/// Timeout of one query. zenoh keeps a timer for each until then, answered or not: many queries per second would use
/// memory.
const ROUND: Duration = Duration::from_secs(2);

/// Reports when the router has received everything published before.
pub(super) struct FlushBarrier {
    session: Session,
    key: KeyExpr,
    priority: Priority,
}

impl FlushBarrier {
    /// A barrier for messages of `priority` and of all higher ones.
    pub(super) fn new(session: &Session, run: &RunId, priority: Priority) -> Self {
        Self {
            session: session.clone(),
            key: KeyExpr::none(run),
            priority,
        }
    }

    /// Waits for at most `limit`. A query without an answerer is returned by the router at once, and it passes through
    /// the same queue as the messages before it. A lost connection ends the wait too.
    pub(super) fn wait(&self, limit: Duration) {
        let begun = Instant::now();
        while begun.elapsed() < limit && !self.answered() {}
        if begun.elapsed() >= limit {
            tracing::warn!(
                ?limit,
                "the router has not confirmed the flush: the last messages may be lost"
            );
        }
    }

    /// Sends one query; true if the wait is over.
    fn answered(&self) -> bool {
        let query = (self.session.get(self.key.as_str()))
            .priority(self.priority)
            .congestion_control(CongestionControl::Block)
            .timeout(ROUND)
            .wait();
        match query {
            Ok(answers) => {
                let mut is_over = true;
                while let Ok(answer) = answers.recv() {
                    // No process answers, so an error is the timeout of zenoh.
                    is_over &= answer.result().is_ok();
                }
                is_over
            }
            Err(cause) => {
                tracing::debug!("flush query failed: {cause}");
                true
            }
        }
    }
}
