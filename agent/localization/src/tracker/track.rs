//! Track: motion filter that uses the vehicle's speed, and one beside it that does not and so can contradict that speed.

use protocol::EgoMotion;

use super::contradictions::Contradictions;
use super::measurement::PoseMeasurement;
use super::motion_filter::MotionFilter;
use super::seconds;
use super::yaw_rate_trust::YawRateTrust;

/// Squared Mahalanobis distance between a measured speed and that of the poses from which on they contradict each other:
/// four standard deviations, since a vehicle that brakes hard is ahead of the poses.
const SPEED_GATE: f64 = 16.0;
/// Gate of a measured pose: 99.9 % quantile of the chi-square distribution with three degrees of freedom.
const POSE_GATE: f64 = 16.27;
/// Contradictions in a row after which a speed is not used any more: a second of sweeps, longer than wheels slip.
const MOST_CONTRADICTIONS: u32 = 10;

/// Trust in the speed that a vehicle measures.
#[derive(Debug, Clone, Default)]
pub(super) struct SpeedTrust(pub(super) Contradictions);

impl SpeedTrust {
    /// Judges a speed by a filter that has not used it; true if it can be used.
    fn admits(&mut self, unaided: &MotionFilter, measured_mps: f64) -> bool {
        let is_admitted = unaided.speed_distance_squared(measured_mps) <= SPEED_GATE;
        if self.0.refuted.is_none() {
            let speeds = [measured_mps, unaided.speed_mps()];
            self.0.count(!is_admitted, MOST_CONTRADICTIONS, speeds);
        }
        is_admitted && self.0.refuted.is_none()
    }
}

/// State of a vehicle that is not lost.
#[derive(Debug, Clone)]
pub(super) struct VehicleTrack {
    pub(super) filter: MotionFilter,
    /// Filter without the measured speed: its speed is that which the poses alone give.
    pub(super) unaided: MotionFilter,
}

impl VehicleTrack {
    /// Track from a first pose on, at a speed with its standard deviation if one is known (metres per second).
    pub(super) fn at(measurement: &PoseMeasurement, speed_mps: Option<[f64; 2]>) -> Self {
        let mut filter = MotionFilter::at(measurement);
        if let Some([speed_mps, std_mps]) = speed_mps {
            filter.set_speed(speed_mps, std_mps);
        }
        Self {
            unaided: filter.clone(),
            filter,
        }
    }

    /// Moves to a later capture time. A speed that the poses contradict is not used, and what it did before is undone.
    pub(super) fn advance(
        &mut self,
        capture_nanos: u64,
        motion: &EgoMotion,
        trust: &mut SpeedTrust,
        yaw_rate_trust: &mut YawRateTrust,
    ) {
        let time_s = seconds(self.filter.capture_nanos, capture_nanos);
        let yaw_rate_rad_s = yaw_rate_trust.admitted(time_s, motion.yaw_rate_rad_s);
        for filter in [&mut self.filter, &mut self.unaided] {
            filter.advance(capture_nanos, yaw_rate_rad_s);
        }
        match motion.speed_mps.filter(|speed| speed.is_finite()) {
            Some(speed) if trust.admits(&self.unaided, speed) => {
                self.filter.correct_speed(speed, time_s);
            }
            Some(_) => self.filter = self.unaided.clone(),
            None => {}
        }
    }

    /// Uses a pose of the same time; false if it contradicts the track. A pose that only the filter without the speed
    /// expects is right, and the speed wrong.
    pub(super) fn correct(&mut self, measurement: &PoseMeasurement) -> bool {
        let is_expected = [&self.filter, &self.unaided].map(|filter| {
            filter.capture_nanos == measurement.capture_nanos
                && filter.distance_squared(measurement) <= POSE_GATE
        });
        match is_expected {
            [false, false] => return false,
            // The pose corrects this copy below as well.
            [false, true] => self.filter = self.unaided.clone(),
            [true, _] => {}
        }
        self.filter.correct(measurement);
        self.unaided.correct(measurement);
        true
    }
}
