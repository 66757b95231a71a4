//! Timeouts of a run.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Timeouts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Timeouts {
    /// Until every process is ready before the first tick, seconds.
    pub ready_s: f64,
    /// Until the last detections after the last tick, seconds.
    pub drain_s: f64,
    /// Until the processes have ended, before they are killed, seconds.
    pub stop_s: f64,
    /// Largest number of restarts of a process that keeps failing.
    pub restarts: u32,
    /// Longest silence of a process before it is killed and restarted, seconds. A process whose worker is stalled is
    /// silent too: longer than the slowest frame takes.
    pub hang_s: f64,
}

impl Default for Timeouts {
    fn default() -> Self {
        Self {
            ready_s: 60.0,
            drain_s: 3.0,
            stop_s: 4.0,
            restarts: 5,
            hang_s: 15.0,
        }
    }
}
