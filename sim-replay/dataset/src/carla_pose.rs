//! Poses as CARLA writes them, and the one mirror between its left-handed world and ours.
//!
//! CARLA's world is x forward, y right, z up; a pose is x, y, z in metres and roll, yaw, pitch in degrees, in this
//! order. Its matrix is OpenCOOD's `x_to_world` (`opencood/utils/transformation_utils.py`). Ours is x forward, y left:
//! with `S = diag(1, -1, 1)` a point becomes `S p` and a rotation `S R S`.

use nalgebra::{Isometry3, Matrix3, Matrix4, Rotation3, Translation3, UnitQuaternion};
use protocol::Pose;

/// Largest angle, degrees: sums of turns occur in files, larger values are errors.
const MAX_ANGLE_DEG: f64 = 1e5;
/// Largest inclination of a box, degrees: no street is as steep.
const MAX_TILT_DEG: f64 = 45.0;

/// x, y, z in metres and roll, yaw, pitch in degrees, left-handed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CarlaPose {
    /// x forward, y right, z up, metres.
    pub position_m: [f64; 3],
    /// Roll, yaw, pitch in degrees: yaw turns x towards y, positive pitch lifts the nose.
    pub roll_yaw_pitch_deg: [f64; 3],
}

impl From<[f64; 6]> for CarlaPose {
    fn from([x, y, z, roll, yaw, pitch]: [f64; 6]) -> Self {
        Self {
            position_m: [x, y, z],
            roll_yaw_pitch_deg: [roll, yaw, pitch],
        }
    }
}

impl From<CarlaPose> for [f64; 6] {
    fn from(pose: CarlaPose) -> Self {
        let ([x, y, z], [roll, yaw, pitch]) = (pose.position_m, pose.roll_yaw_pitch_deg);
        [x, y, z, roll, yaw, pitch]
    }
}

impl CarlaPose {
    /// The pose of a box from the actor it belongs to: `center_m`, the offset of the box's centre, is added to
    /// `location_m` without rotation, as OpenCOOD does (`opencood/utils/box_utils.py`).
    pub fn of_box(location_m: [f64; 3], roll_yaw_pitch_deg: [f64; 3], center_m: [f64; 3]) -> Self {
        let ([x, y, z], [dx, dy, dz]) = (location_m, center_m);
        Self {
            position_m: [x + dx, y + dy, z + dz],
            roll_yaw_pitch_deg,
        }
    }

    /// The pose, if its angles can be degrees.
    pub(crate) fn in_degrees(self) -> Result<Self, String> {
        let angles = self.roll_yaw_pitch_deg;
        let are_sound = angles.iter().all(|angle| angle.abs() <= MAX_ANGLE_DEG);
        let fault = || format!("{angles:?}, expected angles in degrees");
        are_sound.then_some(self).ok_or_else(fault)
    }

    /// The pose, if its z axis is at most [`MAX_TILT_DEG`] from that of the world.
    pub(crate) fn upright(self) -> Result<Self, String> {
        let angles = self.roll_yaw_pitch_deg;
        let [roll, _, pitch] = angles.map(|angle| angle.to_radians().cos());
        let is_upright = roll * pitch >= MAX_TILT_DEG.to_radians().cos();
        let fault = || format!("{angles:?}, expected roll and pitch within {MAX_TILT_DEG} degrees");
        is_upright.then_some(self).ok_or_else(fault)
    }

    /// Local-to-world matrix, still left-handed.
    pub fn left_handed_matrix(&self) -> Matrix4<f64> {
        let [(sr, cr), (sy, cy), (sp, cp)] = self
            .roll_yaw_pitch_deg
            .map(|deg| deg.to_radians().sin_cos());
        // By columns.
        let rotation = Matrix3::from([
            [cp * cy, sy * cp, sp],
            [cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, -cp * sr],
            [-cy * sp * cr - sy * sr, -sy * sp * cr + cy * sr, cp * cr],
        ]);
        let mut matrix = rotation.to_homogeneous();
        let mut translation = matrix.fixed_view_mut::<3, 1>(0, 3);
        translation.copy_from_slice(&self.position_m);
        matrix
    }

    /// The same pose in our right-handed convention.
    pub fn to_pose(&self) -> Pose {
        let rotation: Matrix3<f64> = self.left_handed_matrix().fixed_view::<3, 3>(0, 0).into();
        let rotation = Rotation3::from_matrix_unchecked(mirrored_rotation(&rotation));
        let translation = Translation3::from(mirrored_point(self.position_m));
        Isometry3::from_parts(translation, UnitQuaternion::from_rotation_matrix(&rotation)).into()
    }

    /// Inverse conversion: the pose as CARLA would write it, angles within +-180 degrees (pitch within +-90).
    pub fn from_pose(pose: &Pose) -> Self {
        let rotation = mirrored_rotation(pose.isometry().rotation.to_rotation_matrix().matrix());
        Self::from_parts(mirrored_point(pose.translation_m), &rotation)
    }

    /// The numbers for which [`Self::left_handed_matrix`] is the matrix of a right-handed pose, without mirroring:
    /// V2V4Real and V2X-Real use the formula in right-handed axes.
    pub fn from_right_handed(pose: &Pose) -> Self {
        Self::from_parts(
            pose.translation_m,
            pose.isometry().rotation.to_rotation_matrix().matrix(),
        )
    }

    fn from_parts(position_m: [f64; 3], rotation: &Matrix3<f64>) -> Self {
        // Rounding may lift the sine above 1, where `asin` is NaN.
        let pitch = rotation[(2, 0)].clamp(-1.0, 1.0).asin();
        let roll = (-rotation[(2, 1)]).atan2(rotation[(2, 2)]);
        let yaw = rotation[(1, 0)].atan2(rotation[(0, 0)]);
        Self {
            position_m,
            roll_yaw_pitch_deg: [roll, yaw, pitch].map(f64::to_degrees),
        }
    }
}

/// A point with y negated, which changes its handedness.
pub fn mirrored_point([x, y, z]: [f64; 3]) -> [f64; 3] {
    [x, -y, z]
}

/// `S R S` with `S = diag(1, -1, 1)`: the entries with exactly one index on y change sign.
fn mirrored_rotation(rotation: &Matrix3<f64>) -> Matrix3<f64> {
    rotation.component_mul(&Matrix3::new(
        1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0,
    ))
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Vector4};
    use proptest::prelude::*;

    use super::*;

    fn any_pose() -> impl Strategy<Value = CarlaPose> {
        (
            prop::array::uniform3(-1e4..1e4f64),
            -180.0..180.0f64,
            -180.0..180.0f64,
            -89.0..89.0f64,
        )
            .prop_map(|([x, y, z], roll, yaw, pitch)| [x, y, z, roll, yaw, pitch].into())
    }

    proptest! {
        #[test]
        fn mirroring_a_moved_point_is_moving_the_mirrored_point(
            pose in any_pose(), [x, y, z] in prop::array::uniform3(-200.0..200.0f64),
        ) {
            let world = pose.left_handed_matrix() * Vector4::new(x, y, z, 1.0);
            let ours = pose.to_pose().isometry() * Point3::from(mirrored_point([x, y, z]));
            prop_assert!((ours - Point3::from(mirrored_point([world.x, world.y, world.z]))).norm() < 1e-8);
        }

        #[test]
        fn six_numbers_survive_the_way_there_and_back(pose in any_pose()) {
            let back: [f64; 6] = CarlaPose::from_pose(&pose.to_pose()).into();
            for (ours, theirs) in back.into_iter().zip(<[f64; 6]>::from(pose)) {
                prop_assert!((ours - theirs).abs() < 1e-6, "{back:?} {pose:?}");
            }
        }

        #[test]
        fn the_matrix_of_right_handed_numbers_is_that_of_the_pose(pose in any_pose()) {
            let ours = pose.to_pose();
            let matrix = CarlaPose::from_right_handed(&ours).left_handed_matrix();
            prop_assert!((matrix - ours.isometry().to_homogeneous()).amax() < 1e-9);
        }
    }

    #[test]
    fn yaw_to_the_right_is_negative_with_us() {
        let pose = CarlaPose::from([1.0, 2.0, 3.0, 0.0, 90.0, 0.0]).to_pose();
        assert_eq!(pose.translation_m, [1.0, -2.0, 3.0]);
        assert!((pose.yaw_rad().to_degrees() + 90.0).abs() < 1e-9);
    }

    #[test]
    fn a_box_is_upright_by_its_axis_and_not_by_single_angles() {
        for (angles_deg, is_upright) in [
            ([0.0, 170.0, 0.0], true),
            ([180.0, 20.0, -180.0], true),
            ([30.0, 20.0, 30.0], true),
            ([-90.0, 20.0, 0.0], false),
            ([180.0, 20.0, 0.0], false),
            ([3.0, 0.0, 46.0], false),
        ] {
            let pose = CarlaPose::of_box([0.0; 3], angles_deg, [0.0; 3]);
            assert_eq!(pose.upright().is_ok(), is_upright, "{angles_deg:?}");
        }
    }

    #[test]
    fn positive_pitch_lifts_the_nose() {
        let pose = CarlaPose::from([0.0, 0.0, 0.0, 0.0, 0.0, 30.0]).to_pose();
        assert!((pose.isometry() * Point3::new(1.0, 0.0, 0.0)).z > 0.49);
    }
}
