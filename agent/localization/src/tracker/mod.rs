//! Pose tracker: follows a vehicle from sweep to sweep with a motion filter; poses of the localizer are measurements.
//!
//! A measurement whose Mahalanobis distance from the prediction is too large is rejected. When several rejected ones in
//! a row can be reached from each other, the vehicle is there: the tracker starts anew. Without measurements the
//! covariance grows, until the vehicle counts as lost.

mod contradictions;
mod course;
mod measurement;
mod motion_filter;
mod track;
mod yaw_rate_trust;

use nalgebra::Isometry3;
use protocol::{EgoMotion, PlanarCovariance};

pub use contradictions::MotionContradiction;
use course::Course;
pub use measurement::PoseMeasurement;
pub(crate) use measurement::unscaled_std;
use motion_filter::MotionFilter;
use track::{SpeedTrust, VehicleTrack};
use yaw_rate_trust::YawRateTrust;

/// Number of rejected measurements in a row that have to agree on another place.
const AGREEING: usize = 3;
/// Largest speed between rejected measurements of one vehicle, metres per second, beside [`SLACK_M`].
const MAX_SPEED_MPS: f64 = 50.0;
/// Largest distance between two good poses of the same place, metres.
const SLACK_M: f64 = 2.5;
/// Standard deviation of a speed from two poses, metres per second.
const SPEED_STD_MPS: f64 = 3.0;
/// Longest time between two poses that a speed is computed from, seconds.
const SPEED_BASE_S: f64 = 1.0;
/// Largest standard deviation of a tracked position along its worst direction, metres: the next good measurement is still
/// near the prediction. Beyond it the vehicle counts as lost.
const MAX_POSITION_STD_M: f64 = 2.0;

/// Tracked pose at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackedState {
    /// Pose of the LiDAR.
    pub world_from_lidar: Isometry3<f64>,
    /// Its covariance; while measurements contradict the prediction, that of both being equally likely.
    pub covariance: PlanarCovariance,
}

/// Effect of a measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Correction {
    /// The vehicle was lost, its one pose before was not confirmed, or it drives on another course than was taken: the
    /// measurement is its pose.
    Started,
    /// It corrected the state.
    Accepted,
    /// It contradicts the prediction.
    Rejected,
    /// It is the last of several that contradict the prediction and agree with each other: the vehicle is there.
    Relocated,
}

/// Follows one vehicle.
#[derive(Debug, Clone, Default)]
pub struct PoseTracker {
    /// Longest time without an accepted measurement, seconds.
    max_coast_s: f64,
    track: Option<VehicleTrack>,
    speed_trust: SpeedTrust,
    yaw_rate_trust: YawRateTrust,
    course: Course,
    /// True if two measurements agree on the track.
    is_confirmed: bool,
    /// Last accepted measurement.
    accepted: Option<PoseMeasurement>,
    /// Rejected measurements in a row that can be reached from each other.
    rejected: Vec<PoseMeasurement>,
    /// Distance between the last rejected measurement and the prediction, metres and radians.
    contradiction: [f64; 2],
}

impl PoseTracker {
    /// Tracker of a vehicle whose place is not known, and which counts as lost after `max_coast_s` seconds without an
    /// accepted measurement.
    pub fn new(max_coast_s: f64) -> Self {
        Self {
            max_coast_s,
            ..Self::default()
        }
    }

    /// Begins with another vehicle, of which nothing is known.
    pub fn begin(&mut self) {
        *self = Self::new(self.max_coast_s);
    }

    /// Moves the state to the capture time of a sweep. `None`: the vehicle is lost, or the clock went back.
    pub fn predict(&mut self, capture_nanos: u64, motion: &EgoMotion) -> Option<TrackedState> {
        if !self.can_predict(capture_nanos) {
            self.track = None;
            self.rejected.clear();
        }
        self.course.is_backward = motion.speed_mps.is_some_and(|speed| speed < 0.0);
        let track = self.track.as_mut()?;
        let (speed, yaw_rate) = (&mut self.speed_trust, &mut self.yaw_rate_trust);
        track.advance(capture_nanos, motion, speed, yaw_rate);
        let covariance = track.filter.planar_covariance();
        if covariance.worst_variance_m2() > MAX_POSITION_STD_M.powi(2) {
            self.track = None;
        }
        self.state()
    }

    fn can_predict(&self, capture_nanos: u64) -> bool {
        let is_recent = self.accepted.as_ref().is_some_and(|accepted| {
            seconds(accepted.capture_nanos, capture_nanos) <= self.max_coast_s
        });
        let track = self.track.as_ref();
        let is_ahead = track.is_some_and(|track| track.filter.capture_nanos <= capture_nanos);
        is_ahead && is_recent
    }

    /// Current state, if the vehicle is not lost.
    pub fn state(&self) -> Option<TrackedState> {
        let track = self.track.as_ref()?;
        let mut covariance = track.filter.planar_covariance();
        if self.is_contradicted() {
            // Two places that are equally likely.
            let [place, yaw] = self.contradiction.map(|off| (off / 2.0).powi(2) as f32);
            covariance.xx_m2 += place;
            covariance.yy_m2 += place;
            covariance.yaw_rad2 += yaw;
        }
        Some(TrackedState {
            world_from_lidar: track.filter.world_from_lidar(),
            covariance,
        })
    }

    /// True if the last measurement was rejected.
    pub fn is_contradicted(&self) -> bool {
        !self.rejected.is_empty()
    }

    /// True if a pose is tracked that two measurements agree on: one alone may be wrong.
    pub fn is_confirmed(&self) -> bool {
        self.track.is_some() && self.is_confirmed
    }

    /// Uses a measurement of the time of the last prediction.
    pub fn correct(&mut self, measurement: &PoseMeasurement) -> Correction {
        // What another course did to the state is undone.
        let is_elsewhere = self.course.is_set_by(measurement);
        let Some(track) = self.track.as_mut().filter(|_| !is_elsewhere) else {
            self.start(measurement);
            return Correction::Started;
        };
        if track.correct(measurement, &mut self.speed_trust) {
            // What a wrong yaw rate did to the state is undone.
            if self.yaw_rate_trust.refutes(measurement) {
                self.start(measurement);
            }
            (self.accepted, self.is_confirmed) = (Some(*measurement), true);
            self.rejected.clear();
            return Correction::Accepted;
        }
        if !self.is_confirmed {
            self.start(measurement);
            return Correction::Started;
        }
        let predicted = track.filter.world_from_lidar();
        let off = predicted.inv_mul(&measurement.world_from_lidar);
        self.contradiction = [off.translation.vector.norm(), off.rotation.angle()];
        self.reject(measurement)
    }

    /// Starts at a pose that is stated, not measured: what was known before is forgotten.
    pub fn restart(&mut self, stated: &PoseMeasurement) {
        // No speed follows from the way to a place that a person points at.
        self.accepted = None;
        self.start(stated);
        self.is_confirmed = true;
    }

    fn reject(&mut self, measurement: &PoseMeasurement) -> Correction {
        let before = self.rejected.last();
        if before.is_some_and(|before| !can_follow(before, measurement)) {
            self.rejected.clear();
        }
        self.rejected.push(*measurement);
        if self.rejected.len() < AGREEING {
            return Correction::Rejected;
        }
        // The rejected pose before this one, not the last accepted one, gives the speed at the new place.
        self.accepted = self.rejected.iter().rev().nth(1).copied();
        self.start(measurement);
        Correction::Relocated
    }

    /// Starts at a measurement; with the speed from the one before it, if that is recent.
    fn start(&mut self, measurement: &PoseMeasurement) {
        let before = self.accepted.replace(*measurement);
        let before = before.filter(|before| can_follow(before, measurement));
        self.is_confirmed = before.is_some();
        let course_rad = self.course.rad;
        let speed = before.map(|from| [speed_mps(&from, measurement, course_rad), SPEED_STD_MPS]);
        let filter = MotionFilter::at(measurement, course_rad, speed);
        self.track = Some(VehicleTrack {
            unaided: filter.clone(),
            filter,
        });
        self.rejected.clear();
        self.yaw_rate_trust.refutes(measurement);
    }

    /// True if a measurement is needed now: the last one was rejected, or the speed is not known well.
    pub fn needs_measurement(&self) -> bool {
        let track = self.track.as_ref();
        self.is_contradicted()
            || track.is_none_or(|track| track.unaided.speed_std_mps() > SPEED_STD_MPS)
    }

    /// Speed and yaw rate that are not used any more, since measured poses contradict them.
    pub fn refuted(&self) -> [Option<MotionContradiction>; 2] {
        let yaw_rate = &self.yaw_rate_trust.contradictions;
        [self.speed_trust.contradictions.refuted, yaw_rate.refuted]
    }
}

/// Time from one capture to a later one, seconds; negative if it is earlier.
pub(crate) fn seconds(from_nanos: u64, to_nanos: u64) -> f64 {
    (to_nanos as f64 - from_nanos as f64) * 1e-9
}

/// True if a vehicle can be at `to` after `from`.
fn can_follow(from: &PoseMeasurement, to: &PoseMeasurement) -> bool {
    let time_s = seconds(from.capture_nanos, to.capture_nanos);
    let off = to.world_from_lidar.translation.vector - from.world_from_lidar.translation.vector;
    // After a second the reach is 52 m already: over a longer time nearly any place could follow.
    time_s > 0.0 && time_s <= SPEED_BASE_S && off.norm() <= SLACK_M + MAX_SPEED_MPS * time_s
}

/// Speed from one pose to the next along the course (radians) at the earlier one, metres per second: reversing is negative.
fn speed_mps(from: &PoseMeasurement, to: &PoseMeasurement, course_rad: f64) -> f64 {
    let moved = from.world_from_lidar.inv_mul(&to.world_from_lidar);
    let (sin, cos) = course_rad.sin_cos();
    let ahead_m = moved.translation.x * cos + moved.translation.y * sin;
    ahead_m / seconds(from.capture_nanos, to.capture_nanos).max(1e-3)
}

#[cfg(test)]
mod tests;
