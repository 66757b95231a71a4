//! Motion filter: extended Kalman filter of a vehicle that turns at a constant rate (CTRV), and of its height.
//!
//! Four constants of the vehicle are states too: the bias of its gyroscope, the scale of its speed, the course (the direction
//! of travel in the LiDAR's frame), and the place of the LiDAR ahead of the point that moves straight along the course (the
//! middle of the rear axle), which swings the LiDAR sideways in a turn.

use std::f64::consts::{PI, TAU};

use nalgebra::{
    Isometry3, Matrix2, RowSVector, RowVector2, SMatrix, SVector, Translation3, UnitQuaternion,
    Vector2, Vector3,
};
use protocol::PlanarCovariance;

use super::measurement::PoseMeasurement;

/// Standard deviation of the acceleration, metres per second squared.
const ACCELERATION_STD: f64 = 2.0;
/// Standard deviation of the yaw acceleration where the yaw rate is not measured, radians per second squared.
const YAW_ACCELERATION_STD: f64 = 0.8;
/// The same where it is: what a mean rate does not show, or one that is of the end of the interval alone.
pub(super) const RESIDUAL_YAW_ACCELERATION_STD: f64 = 0.25;
/// Standard deviation of the side slip after one second, metres.
const SLIP_STD_M: f64 = 0.05;
/// Standard deviation of the vertical acceleration beside that of the slope, metres per second squared.
const VERTICAL_ACCELERATION_STD: f64 = 0.1;
/// Standard deviation of a measured speed without its scale, metres per second: OpenCDA's.
const SPEED_STD_MPS: f64 = 0.2;
/// Time within which errors of a measured speed repeat, seconds: a speed that is late, or smoothed.
const SPEED_ERROR_TIME_S: f64 = 0.3;
/// Standard deviation of the unknown scale of the speed: radius of the wheels, tyres, calibration.
const SCALE_STD: f64 = 0.1;
/// Standard deviation of the change of that scale after one second.
const SCALE_DRIFT_STD: f64 = 0.001;
/// Standard deviation of a measured yaw rate without its bias, radians per second: 0.1 degrees/s, as of a MEMS gyroscope.
const YAW_RATE_STD: f64 = 0.002;
/// Standard deviation of the gyroscope's unknown bias, radians per second: 0.6 degrees/s, not calibrated.
pub(super) const BIAS_STD: f64 = 0.01;
/// Standard deviation of the change of that bias after one second, radians per second.
const BIAS_DRIFT_STD: f64 = 0.0002;
/// Standard deviation of the LiDAR's unknown place ahead of the rear axle, metres.
const LEVER_STD_M: f64 = 1.5;
/// Standard deviation of the course from the one a track begins with, radians: a LiDAR that is mounted not quite straight.
const COURSE_STD_RAD: f64 = 0.1;
/// Standard deviation of the unknown speed and yaw rate at the first pose, metres and radians per second.
const FIRST_STD: [f64; 2] = [15.0, 0.3];
/// Time after which roll and pitch are those of later measurements by 63 %, seconds.
const TILT_TIME_S: f64 = 0.56;

// Places in the state.
const X: usize = 0;
const Y: usize = 1;
const YAW: usize = 2;
const SPEED: usize = 3;
const YAW_RATE: usize = 4;
const BIAS: usize = 5;
const LEVER: usize = 6;
const SCALE: usize = 7;
const COURSE: usize = 8;
const STATES: usize = 9;

type CavState = SVector<f64, STATES>;
type Covariance = SMatrix<f64, STATES, STATES>;

/// State of a vehicle at one time, with its covariance.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct MotionFilter {
    /// Capture time of the state, nanoseconds.
    pub(super) capture_nanos: u64,
    /// x, y (metres, world) and yaw (radians) of the LiDAR, speed along the course (m/s), yaw rate (rad/s), bias of the
    /// gyroscope (rad/s), the LiDAR's place ahead of the rear axle (metres), the share of the measured speed by which the
    /// true one exceeds it, and the course (radians from the LiDAR's x axis).
    state: CavState,
    covariance: Covariance,
    /// Height (metres, world) and vertical speed beside that of the slope (m/s).
    height: Vector2<f64>,
    height_covariance: Matrix2<f64>,
    roll_rad: f64,
    pitch_rad: f64,
    /// Capture time of the last measurement, nanoseconds.
    measured_nanos: u64,
}

impl MotionFilter {
    /// State of a vehicle at its first pose, on about this course (radians), at a speed with its standard deviation (metres
    /// per second) or at any.
    pub(super) fn at(
        measurement: &PoseMeasurement,
        course_rad: f64,
        speed_mps: Option<[f64; 2]>,
    ) -> Self {
        let [x, y, z] = measurement.world_from_lidar.translation.vector.data.0[0];
        let (roll_rad, pitch_rad, yaw) = measurement.world_from_lidar.rotation.euler_angles();
        let (position, [speed_std, yaw_rate_std]) = (measurement.position_std_m, FIRST_STD);
        let [speed, speed_std] = speed_mps.unwrap_or([0.0, speed_std]);
        let std = CavState::from([
            position,
            position,
            measurement.yaw_std_rad,
            speed_std,
            yaw_rate_std,
            BIAS_STD,
            LEVER_STD_M,
            SCALE_STD,
            COURSE_STD_RAD,
        ]);
        Self {
            capture_nanos: measurement.capture_nanos,
            state: CavState::from([x, y, yaw, speed, 0.0, 0.0, 0.0, 0.0, course_rad]),
            covariance: Covariance::from_diagonal(&std.component_mul(&std)),
            height: Vector2::new(z, 0.0),
            height_covariance: Matrix2::new(position * position, 0.0, 0.0, 1.0),
            roll_rad,
            pitch_rad,
            measured_nanos: measurement.capture_nanos,
        }
    }

    /// Moves the state to a later capture time, at the yaw rate (rad/s) that the gyroscope measured until then, if there is one.
    pub(super) fn advance(&mut self, capture_nanos: u64, measured: Option<f64>) {
        let time_s = capture_nanos.saturating_sub(self.capture_nanos) as f64 * 1e-9;
        self.capture_nanos = capture_nanos;
        let yaw_acceleration_std = match measured {
            Some(_) => RESIDUAL_YAW_ACCELERATION_STD,
            None => YAW_ACCELERATION_STD,
        };
        // Before the state moves: the rate is that of the interval which ends now.
        if let Some(rate) = measured {
            // Replaces the yaw rate by a measured one less the bias: their errors are the same, beside the noise.
            self.state[YAW_RATE] = rate - self.state[BIAS];
            // Error of the rate = noise - error of the bias: its covariances are those of the bias, negated.
            let mut of_bias = -self.covariance.column(BIAS);
            of_bias[YAW_RATE] = self.covariance[(BIAS, BIAS)] + YAW_RATE_STD * YAW_RATE_STD;
            self.covariance.set_column(YAW_RATE, &of_bias);
            self.covariance.set_row(YAW_RATE, &of_bias.transpose());
        }
        self.advance_plane(time_s, yaw_acceleration_std);
        self.advance_height(time_s);
    }

    fn advance_plane(&mut self, time_s: f64, yaw_acceleration_std: f64) {
        let [_, _, yaw, speed, yaw_rate, _, lever_m, _, course] = self.state.data.0[0];
        // Midpoint rule: the direction of travel half way.
        let (sin, cos) = (yaw + course + yaw_rate * time_s / 2.0).sin_cos();
        let (ahead_m, aside_m) = (speed * time_s, lever_m * yaw_rate * time_s);
        let [moved_x, moved_y] = [ahead_m * cos - aside_m * sin, ahead_m * sin + aside_m * cos];
        self.state[X] += moved_x;
        self.state[Y] += moved_y;
        self.state[YAW] = wrapped_rad(yaw + yaw_rate * time_s);

        // Step: Jacobian of the motion. The yaw rate enters the direction half way with half of the time.
        let mut step = Covariance::identity();
        for direction in [YAW, COURSE] {
            step[(X, direction)] = -moved_y;
            step[(Y, direction)] = moved_x;
        }
        step[(X, SPEED)] = time_s * cos;
        step[(Y, SPEED)] = time_s * sin;
        step[(X, YAW_RATE)] = (-moved_y / 2.0 - lever_m * sin) * time_s;
        step[(Y, YAW_RATE)] = (moved_x / 2.0 + lever_m * cos) * time_s;
        step[(X, LEVER)] = -sin * yaw_rate * time_s;
        step[(Y, LEVER)] = cos * yaw_rate * time_s;
        step[(YAW, YAW_RATE)] = time_s;
        let half_square = time_s * time_s / 2.0;
        // Step: process noise. An acceleration is constant within a step: its effects are fully correlated.
        let (push_x, push_y) = (half_square * cos, half_square * sin);
        let spread = |x, y, yaw, speed, yaw_rate| {
            CavState::from([x, y, yaw, speed, yaw_rate, 0.0, 0.0, 0.0, 0.0])
        };
        let pushed = spread(push_x, push_y, 0.0, time_s, 0.0) * ACCELERATION_STD;
        let turned = spread(0.0, 0.0, half_square, 0.0, time_s) * yaw_acceleration_std;
        // A random walk: its variance, not its deviation, grows with time.
        let slipped = spread(-sin, cos, 0.0, 0.0, 0.0) * SLIP_STD_M * time_s.sqrt();
        self.covariance = step * self.covariance * step.transpose()
            + pushed * pushed.transpose()
            + turned * turned.transpose()
            + slipped * slipped.transpose();
        self.covariance[(BIAS, BIAS)] += BIAS_DRIFT_STD * BIAS_DRIFT_STD * time_s;
        self.covariance[(SCALE, SCALE)] += SCALE_DRIFT_STD * SCALE_DRIFT_STD * time_s;
    }

    fn advance_height(&mut self, time_s: f64) {
        let step = Matrix2::new(1.0, time_s, 0.0, 1.0);
        let lifted = Vector2::new(time_s * time_s / 2.0, time_s) * VERTICAL_ACCELERATION_STD;
        let (sin, cos) = self.state[COURSE].sin_cos();
        let ahead = self.world_from_lidar().rotation * Vector3::new(cos, sin, 0.0);
        let climbed_m = self.state[SPEED] * ahead.z * time_s;
        self.height = step * self.height + Vector2::new(climbed_m, 0.0);
        self.height_covariance =
            step * self.height_covariance * step.transpose() + lifted * lifted.transpose();
    }

    /// Uses the speed that the vehicle measured at the time of the state, `time_s` after the one before it. All that are
    /// measured while errors repeat count as one.
    pub(super) fn correct_speed(&mut self, speed_mps: f64, time_s: f64) {
        let repeated = (SPEED_ERROR_TIME_S / time_s).max(1.0);
        let (off, variance, selects) = self.speed_innovation(speed_mps, repeated);
        let gain = self.covariance * selects.transpose() / variance;
        self.move_by(&(gain * off), &(Covariance::identity() - gain * selects));
    }

    /// Squared Mahalanobis distance between a speed that the vehicle measured at the time of the state and the state.
    pub(super) fn speed_distance_squared(&self, speed_mps: f64) -> f64 {
        let (off, variance, _) = self.speed_innovation(speed_mps, 1.0);
        off * off / variance
    }

    /// Measured speed at its scale minus that of the state (m/s), the variance of the difference, and its derivative by
    /// the state, negative; the error of the speed counts `repeated` times. It is linear in the state: the speed of the
    /// state need not be known.
    fn speed_innovation(
        &self,
        speed_mps: f64,
        repeated: f64,
    ) -> (f64, f64, RowSVector<f64, STATES>) {
        let mut selects = RowSVector::<f64, STATES>::zeros();
        selects[SPEED] = 1.0;
        selects[SCALE] = -speed_mps;
        let off = speed_mps * (1.0 + self.state[SCALE]) - self.state[SPEED];
        // The noise is that of the measurement alone: the error of the scale is in the covariance.
        let noise = repeated * SPEED_STD_MPS * SPEED_STD_MPS;
        let variance = (selects * self.covariance * selects.transpose())[0] + noise;
        (off, variance, selects)
    }

    /// Squared Mahalanobis distance between a pose and the state: x, y and yaw. Infinite at another time.
    pub(super) fn distance_squared(&self, measurement: &PoseMeasurement) -> f64 {
        let (off, spread) = self.innovation(measurement);
        let is_now = self.capture_nanos == measurement.capture_nanos;
        let factor = spread.cholesky().filter(|_| is_now);
        factor.map_or(f64::INFINITY, |factor| off.dot(&factor.solve(&off)))
    }

    /// Uses a pose of the same time.
    pub(super) fn correct(&mut self, measurement: &PoseMeasurement) {
        let (off, spread) = self.innovation(measurement);
        let Some(inverse) = spread.try_inverse() else {
            return;
        };
        let gain = self.covariance.fixed_columns::<3>(0) * inverse;
        let selects = SMatrix::<f64, 3, STATES>::identity();
        self.move_by(&(gain * off), &(Covariance::identity() - gain * selects));

        // The height has a filter of its own: its errors count as independent of those in the plane.
        let off_m = measurement.world_from_lidar.translation.z - self.height[0];
        let variance = self.height_covariance[(0, 0)] + measurement.position_std_m.powi(2);
        let gain = self.height_covariance.column(0) / variance;
        self.height += gain * off_m;
        self.height_covariance =
            (Matrix2::identity() - gain * RowVector2::new(1.0, 0.0)) * self.height_covariance;
        // Roll and pitch move towards the measured ones, the further the longer ago the last measurement was.
        let (roll_rad, pitch_rad, _) = measurement.world_from_lidar.rotation.euler_angles();
        let (before, now) = (self.measured_nanos, measurement.capture_nanos);
        let time_s = now.saturating_sub(before) as f64 * 1e-9;
        let weight = 1.0 - (-time_s / TILT_TIME_S).exp();
        self.roll_rad += weight * wrapped_rad(roll_rad - self.roll_rad);
        self.pitch_rad += weight * wrapped_rad(pitch_rad - self.pitch_rad);
        self.measured_nanos = measurement.capture_nanos;
    }

    /// Pose of the state.
    pub(super) fn world_from_lidar(&self) -> Isometry3<f64> {
        let position = Translation3::new(self.state[X], self.state[Y], self.height[0]);
        let rotation =
            UnitQuaternion::from_euler_angles(self.roll_rad, self.pitch_rad, self.state[YAW]);
        Isometry3::from_parts(position, rotation)
    }

    /// Covariance of position and yaw.
    pub(super) fn planar_covariance(&self) -> PlanarCovariance {
        PlanarCovariance {
            xx_m2: self.covariance[(X, X)] as f32,
            xy_m2: self.covariance[(X, Y)] as f32,
            yy_m2: self.covariance[(Y, Y)] as f32,
            yaw_rad2: self.covariance[(YAW, YAW)] as f32,
        }
    }

    /// Speed along the course, metres per second.
    pub(super) fn speed_mps(&self) -> f64 {
        self.state[SPEED]
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
            // Wrapped: at a heading of 180 degrees both signs are the same direction.
            wrapped_rad(pose.rotation.euler_angles().2 - self.state[YAW]),
        );
        let [position, yaw] =
            [measurement.position_std_m, measurement.yaw_std_rad].map(|std| std * std);
        let noise = SMatrix::from_diagonal(&Vector3::new(position, position, yaw));
        (off, self.covariance.fixed_view::<3, 3>(0, 0) + noise)
    }

    /// Moves the state by `change` and keeps `remaining` of the covariance.
    fn move_by(&mut self, change: &CavState, remaining: &Covariance) {
        self.state += change;
        self.state[YAW] = wrapped_rad(self.state[YAW]);
        let covariance = remaining * self.covariance;
        // Rounding must not make it asymmetric.
        self.covariance = (covariance + covariance.transpose()) / 2.0;
    }
}

/// The same angle between -pi and pi.
pub(super) fn wrapped_rad(angle_rad: f64) -> f64 {
    (angle_rad + PI).rem_euclid(TAU) - PI
}
