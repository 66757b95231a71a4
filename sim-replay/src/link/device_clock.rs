//! The clock of a vehicle, which is not the scene's.

use serde::{Deserialize, Serialize};

/// How far a vehicle's clock is off.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DeviceClock {
    /// Ahead of the scene's clock at time 0, milliseconds.
    pub offset_ms: f64,
    /// Gains so many microseconds a second.
    pub drift_ppm: f64,
}

impl DeviceClock {
    /// What the vehicle's clock shows at a time of the scene; never below 0.
    #[must_use]
    pub fn shown_nanos(&self, scene_nanos: u64) -> u64 {
        let ahead_nanos = self.offset_ms * 1e6 + self.drift_ppm * 1e-6 * scene_nanos as f64;
        let shown = i128::from(scene_nanos) + ahead_nanos.round() as i128;
        u64::try_from(shown.max(0)).unwrap_or(u64::MAX)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_is_off_by_its_offset_and_gains_by_its_drift() {
        assert_eq!(DeviceClock::default().shown_nanos(123), 123);
        let clock = DeviceClock { offset_ms: -5.0, drift_ppm: 100.0 };
        assert_eq!(clock.shown_nanos(0), 0);
        assert_eq!(clock.shown_nanos(1_000_000_000), 995_100_000);
        assert_eq!(clock.shown_nanos(1_700_000_000_000_000_000) - 1_700_000_000_000_000_000, 169_999_995_000_000);
    }
}
