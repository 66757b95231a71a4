//! Pose of a CAV: SE(3) as translation and unit quaternion.

use nalgebra::{Isometry3, Matrix3, Matrix4, Quaternion, Rotation3, Translation3, UnitQuaternion};
use serde::{Deserialize, Serialize};

/// Largest absolute coordinate that is accepted from outside, metres.
const MAX_ABS_M: f64 = 1e7;
/// Tolerance of a quaternion's norm, and of a matrix's orthonormality.
const UNIT_TOLERANCE: f64 = 1e-4;

/// Error of numbers from outside that are not a pose.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("pose {0}")]
pub struct InvalidPose(String);

/// A rigid transform, target-from-source: metres and a unit quaternion.
///
/// Defined here rather than taken from `nalgebra`, so that the layout of another crate never defines the wire format.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// Translation x, y, z in metres.
    pub translation_m: [f64; 3],
    /// Rotation as quaternion w, x, y, z.
    pub rotation_wxyz: [f64; 4],
}

impl Pose {
    /// The identity transform.
    pub const IDENTITY: Self = Self {
        translation_m: [0.0; 3],
        rotation_wxyz: [1.0, 0.0, 0.0, 0.0],
    };

    /// A planar pose: position, height and heading.
    pub fn from_xyz_yaw(translation_m: [f64; 3], yaw_rad: f64) -> Self {
        let (sin, cos) = (yaw_rad / 2.0).sin_cos();
        Self {
            translation_m,
            rotation_wxyz: [cos, 0.0, 0.0, sin],
        }
    }

    /// Reads a row-major 4x4 matrix from outside.
    ///
    /// # Errors
    /// [`InvalidPose`] when an entry is not finite, the last row is not `0 0 0 1` or the rotation is off orthonormal by
    /// more than 1e-4.
    pub fn from_matrix(matrix: &Matrix4<f64>) -> Result<Self, InvalidPose> {
        for &entry in matrix.iter() {
            check_bounded(entry)?;
        }
        let last: [f64; 4] = std::array::from_fn(|column| matrix[(3, column)]);
        if last != [0.0, 0.0, 0.0, 1.0] {
            let problem = format!("matrix ends in the row {last:?}, not 0 0 0 1");
            return Err(InvalidPose(problem));
        }
        let rotation: Matrix3<f64> = matrix.fixed_view::<3, 3>(0, 0).into();
        let deviation = (rotation * rotation.transpose() - Matrix3::identity()).amax();
        let determinant = rotation.determinant();
        // Orthonormal with a negative determinant is a mirror, as from left-handed axes.
        if deviation > UNIT_TOLERANCE || determinant < 0.0 {
            let problem = "matrix is not a rotation: largest deviation from orthonormality";
            return Err(InvalidPose(format!(
                "{problem} {deviation:.2e}, determinant {determinant:.6}"
            )));
        }
        let rotation =
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
        let translation = Translation3::new(matrix[(0, 3)], matrix[(1, 3)], matrix[(2, 3)]);
        Ok(Isometry3::from_parts(translation, rotation).into())
    }

    /// Checks a pose from outside.
    ///
    /// # Errors
    /// [`InvalidPose`] when a number is not finite, beyond 10,000 km, or the quaternion is not of length one.
    pub fn validate(&self) -> Result<(), InvalidPose> {
        for &component in self.translation_m.iter().chain(&self.rotation_wxyz) {
            check_bounded(component)?;
        }
        let norm = self.rotation_wxyz.iter().map(|q| q * q).sum::<f64>().sqrt();
        if (norm - 1.0).abs() > UNIT_TOLERANCE {
            return Err(InvalidPose(format!("quaternion has length {norm}, not 1")));
        }
        Ok(())
    }

    /// Heading: the angle from the target's x axis to the source's, seen from above, in radians.
    pub fn yaw_rad(&self) -> f64 {
        let [w, x, y, z] = self.rotation_wxyz;
        (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z))
    }

    /// The transform as a `nalgebra` type.
    pub fn isometry(&self) -> Isometry3<f64> {
        let [w, x, y, z] = self.rotation_wxyz;
        let [tx, ty, tz] = self.translation_m;
        Isometry3::from_parts(
            Translation3::new(tx, ty, tz),
            // `validate` permits a small deviation from length one.
            UnitQuaternion::new_normalize(Quaternion::new(w, x, y, z)),
        )
    }

    /// The rows of the transform as a homogeneous matrix.
    pub fn matrix_rows(&self) -> [[f64; 4]; 4] {
        // Stored by columns.
        self.isometry().to_homogeneous().transpose().data.0
    }

    /// The same motion in a world whose y axis points the other way.
    pub fn mirrored_y(&self) -> Self {
        let ([x, y, z], [qw, qx, qy, qz]) = (self.translation_m, self.rotation_wxyz);
        Self {
            translation_m: [x, -y, z],
            // A rotation axis is an axial vector: only its part along the mirrored axis stays.
            rotation_wxyz: [qw, -qx, qy, -qz],
        }
    }

    /// Distance from another pose in the plane of the world, metres: what a communication range is compared with.
    pub fn planar_distance_m(&self, other: &Self) -> f64 {
        let ([x, y, _], [other_x, other_y, _]) = (self.translation_m, other.translation_m);
        (other_x - x).hypot(other_y - y)
    }

    /// `target_from_source` from two poses in one world: `self` is `world_from_target`.
    pub fn from_world(&self, world_from_source: &Self) -> Self {
        self.isometry()
            .inv_mul(&world_from_source.isometry())
            .into()
    }
}

impl From<Isometry3<f64>> for Pose {
    fn from(isometry: Isometry3<f64>) -> Self {
        let q = isometry.rotation.quaternion();
        Self {
            translation_m: isometry.translation.vector.into(),
            rotation_wxyz: [q.w, q.i, q.j, q.k],
        }
    }
}

fn check_bounded(value: f64) -> Result<(), InvalidPose> {
    if value.abs() <= MAX_ABS_M {
        return Ok(());
    }
    let problem = format!("component {value} is not a finite number within {MAX_ABS_M:e}");
    Err(InvalidPose(problem))
}

/// Error of one pose: distance and angle to the true one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseError {
    /// Distance to the true position, metres.
    pub distance_m: f64,
    /// Angle to the true orientation, degrees.
    pub angle_deg: f64,
}

impl PoseError {
    /// Error of `found` against `truth`; both are poses in the same world.
    pub fn between(found: &Pose, truth: &Pose) -> Self {
        let difference = truth.isometry().inv_mul(&found.isometry());
        Self {
            distance_m: difference.translation.vector.norm(),
            angle_deg: difference.rotation.angle().to_degrees(),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use proptest::prelude::*;

    use super::*;

    fn any_pose() -> impl Strategy<Value = Pose> {
        (
            prop::array::uniform3(-1e4..1e4),
            -PI..PI,
            -1.5..1.5,
            -PI..PI,
        )
            .prop_map(|(t, roll, pitch, yaw)| {
                Isometry3::from_parts(
                    Translation3::from(t),
                    UnitQuaternion::from_euler_angles(roll, pitch, yaw),
                )
                .into()
            })
    }

    #[test]
    fn a_pose_error_is_distance_and_angle() {
        let truth = Pose::from_xyz_yaw([1.0, 2.0, 0.0], 0.0);
        let found = Pose::from_xyz_yaw([4.0, 6.0, 0.0], FRAC_PI_2);
        let error = PoseError::between(&found, &truth);
        assert!((error.distance_m - 5.0).abs() < 1e-12 && (error.angle_deg - 90.0).abs() < 1e-9);
    }

    proptest! {
        #[test]
        fn matrix_round_trip(pose in any_pose()) {
            let back = Pose::from_matrix(&pose.isometry().to_homogeneous()).unwrap();
            let error = pose.isometry().inv_mul(&back.isometry());
            prop_assert!(error.translation.vector.norm() < 1e-6 && error.rotation.angle() < 1e-6);
        }

        #[test]
        fn from_world_of_itself_is_identity(pose in any_pose()) {
            let identity = pose.from_world(&pose).isometry();
            prop_assert!(identity.translation.vector.norm() < 1e-8 && identity.rotation.angle() < 1e-7);
        }
    }

    #[test]
    fn a_range_is_measured_in_the_plane_of_the_world() {
        let at = |translation_m| Pose {
            translation_m,
            ..Pose::IDENTITY
        };
        let distance_m = at([1.0, 2.0, 0.0]).planar_distance_m(&at([4.0, 6.0, 75.0]));
        assert!((distance_m - 5.0).abs() < 1e-12, "{distance_m}");
    }

    proptest! {
        #[test]
        fn a_mirrored_pose_moves_mirrored_points(pose in any_pose(), point in prop::array::uniform3(-50.0..50.0f64)) {
            let [x, y, z] = point;
            let here = pose.isometry() * nalgebra::Point3::new(x, y, z);
            let there = pose.mirrored_y().isometry() * nalgebra::Point3::new(x, -y, z);
            prop_assert!((here - nalgebra::Point3::new(there.x, -there.y, there.z)).norm() < 1e-6);
        }
    }

    #[test]
    fn a_quarter_turn_takes_forward_to_left() {
        let pose = Pose::from_xyz_yaw([1.0, 2.0, 3.0], FRAC_PI_2);
        let moved = pose.isometry() * nalgebra::Point3::new(1.0, 0.0, 0.0);
        assert!((moved - nalgebra::Point3::new(1.0, 3.0, 3.0)).norm() < 1e-12);
        assert!((pose.yaw_rad() - FRAC_PI_2).abs() < 1e-12);
    }

    #[test]
    fn refuses_what_is_no_pose() {
        for value in [f64::NAN, f64::INFINITY, 1e30] {
            let pose = Pose {
                translation_m: [0.0, value, 0.0],
                ..Pose::IDENTITY
            };
            let error = pose.validate().unwrap_err().to_string();
            assert!(error.contains("not a finite number"), "{error}");
        }
        let short = Pose {
            rotation_wxyz: [0.5, 0.0, 0.0, 0.0],
            ..Pose::IDENTITY
        };
        let error = short.validate().unwrap_err().to_string();
        assert_eq!(error, "pose quaternion has length 0.5, not 1");
        let mirror = Matrix4::from_diagonal(&[1.0, -1.0, 1.0, 1.0].into());
        let error = Pose::from_matrix(&mirror).unwrap_err().to_string();
        assert!(error.contains("is not a rotation"), "{error}");
    }
}
