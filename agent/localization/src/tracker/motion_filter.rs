//! Motion filter: extended Kalman filter of a vehicle that turns at a constant rate (CTRV), and of its height.

use std::f64::consts::{PI, TAU};

use nalgebra::{Isometry3, Matrix2, Matrix5, RowVector2, RowVector5, SMatrix, Translation3, UnitQuaternion, Vector2};
use nalgebra::{Vector3, Vector5};
use protocol::{EgoMotion, PlanarCovariance};

use super::measurement::PoseMeasurement;

/// Standard deviation of the acceleration, metres per second squared.
const ACCELERATION_STD: f64 = 2.0;
/// Standard deviation of the yaw acceleration, radians per second squared.
const YAW_ACCELERATION_STD: f64 = 0.8;
/// Standard deviation of the side slip after one second, metres.
const SLIP_STD_M: f64 = 0.1;
/// Standard deviation of the vertical acceleration, metres per second squared.
const VERTICAL_ACCELERATION_STD: f64 = 0.5;
/// Standard deviation of a measured speed, metres per second.
const SPEED_STD_MPS: f64 = 0.05;
/// Standard deviation of a measured yaw rate, radians per second.
const YAW_RATE_STD: f64 = 0.005;
/// Standard deviation of the unknown speed and yaw rate at the first pose, metres and radians per second.
const FIRST_STD: [f64; 2] = [15.0, 0.3];
/// Weight of a measurement's roll and pitch.
const TILT_WEIGHT: f64 = 0.3;

// Places in the state.
const X: usize = 0;
const Y: usize = 1;
const YAW: usize = 2;
const SPEED: usize = 3;
const YAW_RATE: usize = 4;

/// State of a vehicle at one time, with its covariance.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct MotionFilter {
    /// Capture time of the state, nanoseconds.
    pub(super) capture_nanos: u64,
    /// x, y (metres, world), yaw (radians), speed along the heading (m/s), yaw rate (rad/s).
    state: Vector5<f64>,
    covariance: Matrix5<f64>,
    /// Height (metres, world) and vertical speed (m/s).
    height: Vector2<f64>,
    height_covariance: Matrix2<f64>,
    roll_rad: f64,
    pitch_rad: f64,
}

impl MotionFilter {
    /// State of a vehicle at its first pose, at any speed.
    pub(super) fn at(measurement: &PoseMeasurement) -> Self {
        let [x, y, z] = measurement.world_from_lidar.translation.vector.data.0[0];
        let (roll_rad, pitch_rad, yaw) = measurement.world_from_lidar.rotation.euler_angles();
        let position = measurement.position_std_m.powi(2);
        let [speed, yaw_rate] = FIRST_STD.map(|std| std * std);
        let diagonal = Vector5::new(position, position, measurement.yaw_std_rad.powi(2), speed, yaw_rate);
        Self {
            capture_nanos: measurement.capture_nanos,
            state: Vector5::new(x, y, yaw, 0.0, 0.0),
            covariance: Matrix5::from_diagonal(&diagonal),
            height: Vector2::new(z, 0.0),
            height_covariance: Matrix2::new(position, 0.0, 0.0, 1.0),
            roll_rad,
            pitch_rad,
        }
    }

    /// Moves the state to a later capture time.
    pub(super) fn advance(&mut self, capture_nanos: u64) {
        let time_s = capture_nanos.saturating_sub(self.capture_nanos) as f64 * 1e-9;
        self.capture_nanos = capture_nanos;
        let [.., speed, yaw_rate] = self.state.data.0[0];
        // Midpoint rule: the heading half way.
        let (sin, cos) = (self.state[YAW] + yaw_rate * time_s / 2.0).sin_cos();
        let distance_m = speed * time_s;
        self.state[X] += distance_m * cos;
        self.state[Y] += distance_m * sin;
        self.state[YAW] = wrapped_rad(self.state[YAW] + yaw_rate * time_s);

        let mut step = Matrix5::identity();
        step[(X, YAW)] = -distance_m * sin;
        step[(Y, YAW)] = distance_m * cos;
        step[(X, SPEED)] = time_s * cos;
        step[(Y, SPEED)] = time_s * sin;
        step[(X, YAW_RATE)] = -distance_m * sin * time_s / 2.0;
        step[(Y, YAW_RATE)] = distance_m * cos * time_s / 2.0;
        step[(YAW, YAW_RATE)] = time_s;
        let half_square = time_s * time_s / 2.0;
        let pushed = Vector5::new(half_square * cos, half_square * sin, 0.0, time_s, 0.0) * ACCELERATION_STD;
        let turned = Vector5::new(0.0, 0.0, half_square, 0.0, time_s) * YAW_ACCELERATION_STD;
        let slipped = Vector5::new(-sin, cos, 0.0, 0.0, 0.0) * SLIP_STD_M * time_s.sqrt();
        self.covariance = step * self.covariance * step.transpose()
            + pushed * pushed.transpose()
            + turned * turned.transpose()
            + slipped * slipped.transpose();

        let step = Matrix2::new(1.0, time_s, 0.0, 1.0);
        let lifted = Vector2::new(half_square, time_s) * VERTICAL_ACCELERATION_STD;
        self.height = step * self.height;
        self.height_covariance = step * self.height_covariance * step.transpose() + lifted * lifted.transpose();
    }

    /// Uses speed and yaw rate that the vehicle measured at the time of the state.
    pub(super) fn correct_motion(&mut self, motion: &EgoMotion) {
        let measured = [(SPEED, motion.speed_mps, SPEED_STD_MPS), (YAW_RATE, motion.yaw_rate_rad_s, YAW_RATE_STD)];
        for (place, value, std) in measured {
            let Some(value) = value.filter(|value| value.is_finite()) else { continue };
            let mut selects = RowVector5::zeros();
            selects[place] = 1.0;
            let variance = self.covariance[(place, place)] + std * std;
            let gain = self.covariance.column(place) / variance;
            let off = value - self.state[place];
            self.move_by(&(gain * off), &(Matrix5::identity() - gain * selects));
        }
    }

    /// Squared Mahalanobis distance between a pose of the same time and the state: x, y and yaw.
    pub(super) fn distance_squared(&self, measurement: &PoseMeasurement) -> f64 {
        let (off, spread) = self.innovation(measurement);
        spread.cholesky().map_or(f64::INFINITY, |factor| off.dot(&factor.solve(&off)))
    }

    /// Uses a pose of the same time.
    pub(super) fn correct(&mut self, measurement: &PoseMeasurement) {
        let (off, spread) = self.innovation(measurement);
        let Some(inverse) = spread.try_inverse() else { return };
        let gain = self.covariance.fixed_columns::<3>(0) * inverse;
        let mut selects = SMatrix::<f64, 3, 5>::zeros();
        selects.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
        self.move_by(&(gain * off), &(Matrix5::identity() - gain * selects));

        let off_m = measurement.world_from_lidar.translation.z - self.height[0];
        let variance = self.height_covariance[(0, 0)] + measurement.position_std_m.powi(2);
        let gain = self.height_covariance.column(0) / variance;
        self.height += gain * off_m;
        self.height_covariance = (Matrix2::identity() - gain * RowVector2::new(1.0, 0.0)) * self.height_covariance;
        let (roll_rad, pitch_rad, _) = measurement.world_from_lidar.rotation.euler_angles();
        self.roll_rad += TILT_WEIGHT * wrapped_rad(roll_rad - self.roll_rad);
        self.pitch_rad += TILT_WEIGHT * wrapped_rad(pitch_rad - self.pitch_rad);
    }

    /// Sets a speed that is known from elsewhere, metres per second.
    pub(super) fn set_speed(&mut self, speed_mps: f64, std_mps: f64) {
        self.state[SPEED] = speed_mps;
        self.covariance[(SPEED, SPEED)] = std_mps * std_mps;
    }

    /// Pose of the state.
    pub(super) fn world_from_lidar(&self) -> Isometry3<f64> {
        let position = Translation3::new(self.state[X], self.state[Y], self.height[0]);
        let rotation = UnitQuaternion::from_euler_angles(self.roll_rad, self.pitch_rad, self.state[YAW]);
        Isometry3::from_parts(position, rotation)
    }

    /// Covariance of position and yaw.
    pub(super) fn planar_covariance(&self) -> PlanarCovariance {
        let entry = |row, column| self.covariance[(row, column)] as f32;
        PlanarCovariance { xx_m2: entry(X, X), xy_m2: entry(X, Y), yy_m2: entry(Y, Y), yaw_rad2: entry(YAW, YAW) }
    }

    /// Standard deviation of the speed, metres per second.
    pub(super) fn speed_std_mps(&self) -> f64 {
        self.covariance[(SPEED, SPEED)].sqrt()
    }

    /// Measured minus expected pose (x, y in metres, yaw in radians), and its covariance.
    fn innovation(&self, measurement: &PoseMeasurement) -> (Vector3<f64>, SMatrix<f64, 3, 3>) {
        let pose = &measurement.world_from_lidar;
        let off = Vector3::new(
            pose.translation.x - self.state[X],
            pose.translation.y - self.state[Y],
            wrapped_rad(pose.rotation.euler_angles().2 - self.state[YAW]),
        );
        let [position, yaw] = [measurement.position_std_m, measurement.yaw_std_rad].map(|std| std * std);
        let noise = SMatrix::from_diagonal(&Vector3::new(position, position, yaw));
        (off, self.covariance.fixed_view::<3, 3>(0, 0) + noise)
    }

    /// Moves the state by `change` and keeps `remaining` of the covariance.
    fn move_by(&mut self, change: &Vector5<f64>, remaining: &Matrix5<f64>) {
        self.state += change;
        self.state[YAW] = wrapped_rad(self.state[YAW]);
        let covariance = remaining * self.covariance;
        // Rounding must not make it asymmetric.
        self.covariance = (covariance + covariance.transpose()) / 2.0;
    }
}

/// The same angle between -pi and pi.
fn wrapped_rad(angle_rad: f64) -> f64 {
    (angle_rad + PI).rem_euclid(TAU) - PI
}
