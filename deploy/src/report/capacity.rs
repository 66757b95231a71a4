//! Capacity: what a machine was expected to carry before a run, as its report states it.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::RunPace;

/// Share of the ticks from which a run counts as keeping up.
const KEEPS_UP: f64 = 0.99;

/// Deviation of the answered from the expected frames that a report states, as a share of these.
const DEVIATION: f64 = 0.15;

/// Cores and instruction set.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Machine {
    /// Number of cores that this process may use.
    pub cores: usize,
    /// Vector instructions, for example `AVX-512, VNNI, AMX`.
    pub instructions: String,
}

/// Estimate of the pace of a live run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Capacity {
    /// The machine.
    pub machine: Machine,
    /// Fusion method.
    pub method: String,
    /// Number of vehicles.
    pub vehicles: usize,
    /// Number of these whose agents run on this machine.
    pub local_vehicles: usize,
    /// CPU time of an agent per frame while the other cores compute too, milliseconds.
    pub agent_ms: f64,
    /// CPU time of the fusion per frame, milliseconds.
    pub fuse_ms: f64,
    /// CPU time per frame of messages, replay, router and scorer, milliseconds.
    pub messages_ms: f64,
    /// Time between two frames, milliseconds.
    pub period_ms: f64,
    /// Time of one 3x3 convolution from 64 to 64 channels on 96 x 128, in 32 bits, on one thread that is held to AVX2,
    /// milliseconds: the unit in which machines compare.
    #[serde(default)]
    pub unit_ms: f64,
    /// Medians of the stages of an agent, then of the ego, milliseconds.
    #[serde(default)]
    pub stages: [Vec<(String, f64)>; 2],
    /// Share of a core that other programs leave, 0..=1.
    #[serde(alias = "shared_speed")]
    pub free_share: f64,
    /// CPU time per frame of all processes on this machine, milliseconds.
    pub needed_ms: f64,
    /// CPU time that the cores give per frame, milliseconds.
    pub available_ms: f64,
    /// Expected share of answered frames, 0..=1.
    pub expected_share: f64,
}

impl Capacity {
    /// True if all frames are expected to be answered.
    pub fn keeps_up(&self) -> bool {
        self.expected_share >= KEEPS_UP
    }

    /// Expected and answered frames of a run, if they differ by more than 15 %.
    pub(super) fn deviation(&self, pace: &RunPace) -> Option<String> {
        let expected = self.expected_share * pace.ticks as f64;
        let deviation = pace.answered as f64 / expected - 1.0;
        (deviation.abs() > DEVIATION).then(|| {
            format!(
                "expected {expected:.0} of {} frames, answered {} ({:+.0} %)",
                pace.ticks,
                pace.answered,
                100.0 * deviation
            )
        })
    }

    /// Replay rate at which the machine is expected to keep up, relative to the current one: a multiple of 0.05 below
    /// the expected share.
    pub fn relative_rate(&self) -> f64 {
        // In steps of 0.05, with 5 % in reserve.
        ((self.expected_share * 20.0 * 0.95).floor() / 20.0).max(0.05)
    }
}

impl fmt::Display for Capacity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (cores, vehicles) = (self.machine.cores, self.vehicles);
        let plurals = [cores, vehicles].map(|count| if count == 1 { "" } else { "s" });
        // All ten are those of a machine that keeps up.
        let most = if self.keeps_up() { 10.0 } else { 9.0 };
        write!(
            f,
            "{cores} core{}, {}; {} with {vehicles} vehicle{} needs about {:.0} ms of CPU per frame of {:.0} available: \
             expect about {} of 10 frames answered",
            plurals[0],
            self.machine.instructions,
            self.method,
            plurals[1],
            self.needed_ms,
            self.available_ms,
            (10.0 * self.expected_share).round().min(most)
        )
    }
}
