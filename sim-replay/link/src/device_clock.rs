//! Clock of a vehicle: offset, drift and steps relative to the scene's clock.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Error of a vehicle's clock.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct DeviceClock {
    /// Offset from the scene's clock at time 0, milliseconds; positive is ahead.
    pub offset_ms: f64,
    /// Drift, microseconds per second.
    pub drift_ppm: f64,
    /// A step in the middle of the scene.
    pub step: Option<ClockStep>,
}

/// A step of a clock, as a time server or an operator causes it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ClockStep {
    /// Time since the beginning of the scene, seconds.
    pub at_s: f64,
    /// Additional offset from then on, milliseconds.
    pub by_ms: f64,
}

impl DeviceClock {
    /// True if it shows the scene's time.
    pub fn is_right(&self) -> bool {
        *self == Self::default()
    }

    /// The time of the vehicle's clock at a time of a scene that began at `began_nanos`: at the beginning it differs by
    /// its offset. Never below 0.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "a cast from a float saturates"
    )]
    pub fn shown_since(&self, began_nanos: u64, scene_nanos: u64) -> u64 {
        let since_nanos = scene_nanos.saturating_sub(began_nanos);
        // The step is at a time of the scene, not of the clock, which would reach it twice after a step back.
        let step = self.step.as_ref();
        let set = step.filter(|step| since_nanos as f64 >= step.at_s * 1e9);
        let offset_ms = self.offset_ms + set.map_or(0.0, |step| step.by_ms);
        let ahead_nanos = offset_ms * 1e6 + self.drift_ppm * 1e-6 * since_nanos as f64;
        let shown = i128::from(scene_nanos) + ahead_nanos.round() as i128;
        u64::try_from(shown.max(0)).unwrap_or(u64::MAX)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_is_off_by_its_offset_and_gains_by_its_drift() {
        assert_eq!(DeviceClock::default().shown_since(7, 123), 123);
        let clock = DeviceClock {
            offset_ms: -5.0,
            drift_ppm: 100.0,
            step: None,
        };
        assert_eq!(clock.shown_since(0, 0), 0, "no time is before 0");
        assert_eq!(clock.shown_since(0, 1_000_000_000), 995_100_000);
        assert_eq!(
            clock.shown_since(1_000_000_000, 2_000_000_000),
            1_995_100_000
        );
    }

    #[test]
    fn a_clock_that_is_set_jumps_once() {
        let clock = DeviceClock {
            step: Some(ClockStep {
                at_s: 2.0,
                by_ms: -500.0,
            }),
            ..DeviceClock::default()
        };
        assert_eq!(clock.shown_since(0, 1_999_999_999), 1_999_999_999);
        assert_eq!(clock.shown_since(0, 2_000_000_000), 1_500_000_000);
        assert_eq!(
            clock.shown_since(1_000_000_000, 3_500_000_000),
            3_000_000_000
        );
    }
}
