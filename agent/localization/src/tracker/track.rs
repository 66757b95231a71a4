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
/// Contradictions after which a speed is not used any more, a second of sweeps, longer than wheels slip, and what an
/// agreement takes off: all, they have to be in a row.
const MOST_CONTRADICTIONS: [f64; 2] = [10.0, 10.0];

/// Weight of a pose in the mean distances: they are of the last ten poses or so.
const MEAN_WEIGHT: f64 = 0.1;
/// Largest squared Mahalanobis distance that counts in them.
const MOST_DISTANCE: f64 = 25.0;
/// Expected squared Mahalanobis distance of a pose: x, y and yaw.
const EXPECTED_DISTANCE: f64 = 3.0;
/// Ratio of the mean distance with the speed to that without from which on the speed is wrong (late, or stuck): simulated
/// sound drives had at most 1.0, and 1.5 where an eighth of the poses were four times as far off as they stated.
const MOST_DISTANCE_RATIO: f64 = 1.8;

/// Trust in the speed that a vehicle measures.
#[derive(Debug, Clone, Default)]
pub(super) struct SpeedTrust {
    pub(super) contradictions: Contradictions,
    /// Last measured speed and that of the poses, metres per second.
    speeds_mps: [f64; 2],
    /// Mean squared Mahalanobis distances of poses from the filter with the speed and from that without.
    distances: [f64; 2],
}

impl SpeedTrust {
    /// Judges a speed by a filter that has not used it; true if it can be used.
    fn admits(&mut self, unaided: &MotionFilter, measured_mps: f64) -> bool {
        let is_admitted = unaided.speed_distance_squared(measured_mps) <= SPEED_GATE;
        self.speeds_mps = [measured_mps, unaided.speed_mps()];
        self.contradictions
            .count(!is_admitted, MOST_CONTRADICTIONS, self.speeds_mps);
        is_admitted && self.contradictions.refuted.is_none()
    }

    /// Weighs the squared Mahalanobis distances of a pose from the filter with the speed and from that without: a speed
    /// that makes the predictions worse is not used any more.
    fn weigh(&mut self, distances: [f64; 2]) {
        for (mean, distance) in self.distances.iter_mut().zip(distances) {
            *mean += MEAN_WEIGHT * (distance.min(MOST_DISTANCE) - *mean);
        }
        let [with, without] = self.distances;
        if with > MOST_DISTANCE_RATIO * without.max(EXPECTED_DISTANCE) {
            self.contradictions.refute(self.speeds_mps);
        }
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
    pub(super) fn correct(&mut self, measured: &PoseMeasurement, trust: &mut SpeedTrust) -> bool {
        let distances =
            [&self.filter, &self.unaided].map(|filter| filter.distance_squared(measured));
        match distances.map(|distance| distance <= POSE_GATE) {
            [false, false] => return false,
            // The pose corrects this copy below as well.
            [false, true] => self.filter = self.unaided.clone(),
            [true, _] => {}
        }
        trust.weigh(distances);
        self.filter.correct(measured);
        self.unaided.correct(measured);
        true
    }
}
