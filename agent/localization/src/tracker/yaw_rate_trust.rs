//! Trust in the yaw rate that a vehicle measures: its turn from one pose to the next against that of the poses.

use super::contradictions::Contradictions;
use super::measurement::PoseMeasurement;
use super::motion_filter::{BIAS_STD, RESIDUAL_YAW_ACCELERATION_STD, wrapped_rad};
use super::seconds;

/// Shortest time between two poses whose turn is compared, seconds.
const LEAST_TIME_S: f64 = 0.25;
/// Standard deviations beyond which two turns contradict each other.
const GATE_STD: f64 = 4.0;
/// Contradictions after which a yaw rate is not used any more, since one wrong pose makes two, and what an agreement takes
/// off: a late rate is wrong at both ends of a turn and right between.
const MOST_CONTRADICTIONS: [f64; 2] = [3.0, 0.5];

/// Trust in a yaw rate, over all tracks of a vehicle.
#[derive(Debug, Clone, Default)]
pub(super) struct YawRateTrust {
    /// Last pose that was compared, the turn since then by the measured yaw rates, radians, and the longest time between two
    /// of them, seconds; `None` where one is missing.
    since: Option<(PoseMeasurement, f64, f64)>,
    pub(super) contradictions: Contradictions,
}

impl YawRateTrust {
    /// The yaw rate that was measured over a time, if it can be used.
    pub(super) fn admitted(&mut self, time_s: f64, yaw_rate_rad_s: Option<f64>) -> Option<f64> {
        let is_trusted = self.contradictions.refuted.is_none();
        let rate = yaw_rate_rad_s.filter(|rate| rate.is_finite() && is_trusted);
        let since = self.since.zip(rate);
        self.since = since.map(|((from, turned_rad, step_s), rate)| {
            (from, turned_rad + rate * time_s, step_s.max(time_s))
        });
        rate
    }

    /// Compares the turn to a pose that is taken with that of the yaw rates; true if this refutes them.
    pub(super) fn refutes(&mut self, pose: &PoseMeasurement) -> bool {
        let since = self.since.replace((*pose, 0.0, 0.0));
        let Some((from, measured_rad, step_s)) = since else {
            return false;
        };
        let time_s = seconds(from.capture_nanos, pose.capture_nanos);
        // Negative after a restart of the scene.
        if (0.0..LEAST_TIME_S).contains(&time_s) {
            self.since = since;
            return false;
        }
        let turn = from.world_from_lidar.inv_mul(&pose.world_from_lidar);
        let turned_rad = turn.rotation.euler_angles().2;
        let drift_rad = BIAS_STD * time_s;
        // A rate of the end of its interval alone is off by half of the change in it.
        let residual_rad = RESIDUAL_YAW_ACCELERATION_STD * time_s * step_s / 2.0;
        let stds = [from.yaw_std_rad, pose.yaw_std_rad, drift_rad, residual_rad];
        let variance = stds.iter().map(|std| std * std).sum::<f64>();
        let gate_rad = GATE_STD * variance.sqrt();
        let is_contradicted = wrapped_rad(turned_rad - measured_rad).abs() > gate_rad;
        // On a straight a late rate agrees as well: that says nothing.
        if is_contradicted || turned_rad.abs().max(measured_rad.abs()) > gate_rad {
            let rates = [measured_rad, turned_rad].map(|turn_rad| turn_rad / time_s);
            self.contradictions
                .count(is_contradicted, MOST_CONTRADICTIONS, rates);
        }
        self.contradictions.refuted.is_some()
    }
}
