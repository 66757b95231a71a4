//! Pose measurement: the pose of one sweep with the standard deviations that its confidence stands for.

use nalgebra::Isometry3;

use crate::covariance_scale::CovarianceScale;
use crate::pgc::pose_solver::FoundPose;

/// Factor on the standard deviation of the position that a sigma stands for: sigma was fitted to sweeps of all kinds,
/// and those near a prediction are better.
const POSITION_FACTOR: f64 = 0.65;
/// Smallest standard deviation of a measured position per axis, metres: errors of one place repeat from sweep to sweep.
const LEAST_POSITION_STD_M: f64 = 0.02;
/// Standard deviations of a measured yaw: smallest and largest, radians.
const YAW_STD_RAD: [f64; 2] = [0.001, 0.2];
/// Factor on the standard deviation of the orientation: errors of neighbouring cells are correlated.
const ROTATION_FACTOR: f64 = 2.0;

/// Pose of one sweep as a measurement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseMeasurement {
    /// Capture time on the clock of the scene, nanoseconds.
    pub capture_nanos: u64,
    /// Measured pose.
    pub world_from_lidar: Isometry3<f64>,
    /// Standard deviation of the position per axis, metres.
    pub position_std_m: f64,
    /// Standard deviation of the yaw, radians.
    pub yaw_std_rad: f64,
}

impl PoseMeasurement {
    /// Measurement from an estimated pose, with its unscaled deviations times the factors that were fitted.
    pub fn new(capture_nanos: u64, found: &FoundPose) -> Self {
        let [position_std_m, yaw_std_rad] = unscaled_std(found);
        let scale = found.covariance_scale.unwrap_or(CovarianceScale::NONE);
        Self {
            capture_nanos,
            world_from_lidar: found.world_from_sensor,
            position_std_m: scale.planar * position_std_m,
            yaw_std_rad: (scale.yaw * yaw_std_rad).min(YAW_STD_RAD[1]),
        }
    }
}

/// Standard deviations of a pose without the fitted factors: of its position per axis, metres, and of its yaw, radians.
///
/// The variance is the squared error that its sigma stands for (Eq. 6), spread over two axes; of a pose that was
/// registered to a map its covariance holds.
pub(crate) fn unscaled_std(found: &FoundPose) -> [f64; 2] {
    let [least, most] = YAW_STD_RAD;
    if found.is_registered {
        let covariance = &found.cell_covariance;
        let variance_m2 = f64::midpoint(covariance[0][0], covariance[1][1]);
        return [variance_m2.sqrt(), covariance[5][5].sqrt().min(most)];
    }
    // Eq. 6 solved for the error. The clamp keeps a sigma of 0 finite.
    let error_m: f64 = (1.0 / found.sigma.clamp(1e-6, 1.0) - 1.0).sqrt();
    let std_m = POSITION_FACTOR * error_m / std::f64::consts::SQRT_2;
    let std_rad = ROTATION_FACTOR * found.evidence.rotation_std_rad;
    [std_m.max(LEAST_POSITION_STD_M), std_rad.clamp(least, most)]
}
