//! Levelling, an extension: height, roll and pitch of a predicted pose from scene coordinates.
//!
//! Measured gain: none apart. Refinement near a predicted pose needs it, and takes 4.7 ms per sweep in place of 23.4 ms
//! (`deploy/results/localization.md`). The refinement network hardly corrects these: it predicts the height of a cell largely from the height that the
//! pose gives it. Its predictions in the plane depend on them little.

use nalgebra::{Isometry3, Matrix3, Point3, UnitQuaternion, Vector3};

use crate::pgc::scene_coordinates::SceneCoordinates;
use crate::registration::refine::forgiveness;

/// Number of cells that suffice.
pub(crate) const CELLS: usize = 64;
/// Fewest cells of a fit.
const MIN_CELLS: usize = 12;
/// Cells farther from their predicted position in the plane are left out, metres.
const PLANAR_M: f64 = 3.0;
/// Scales of the fits, metres.
const SCALES_M: [f64; 4] = [2.0, 1.0, 0.5, 0.5];
/// Expected error of a cell's height beside the predicted one, metres.
const FLOOR_M: f64 = 0.1;

/// The pose with height, roll and pitch of a weighted fit to the cells; unchanged if these do not constrain them.
///
/// `origin_from_sensor` and the scene coordinates are relative to the head's origin.
pub(crate) fn level(
    coordinates: &SceneCoordinates,
    origin_from_sensor: &Isometry3<f64>,
) -> Isometry3<f64> {
    let mut scales_m = SCALES_M.into_iter();
    let levelled = scales_m.try_fold(*origin_from_sensor, |pose, scale_m| {
        step(coordinates, &pose, scale_m)
    });
    // Not the pose of an earlier, wider scale, which outliers may have pulled.
    levelled.unwrap_or(*origin_from_sensor)
}

fn step(
    coordinates: &SceneCoordinates,
    pose: &Isometry3<f64>,
    scale_m: f64,
) -> Option<Isometry3<f64>> {
    let (mut information, mut moment, mut count) = (Matrix3::zeros(), Vector3::zeros(), 0);
    for (sensor_m, world_m, epsilon_m) in coordinates.cells() {
        let arm = pose.rotation * Point3::from(sensor_m.map(f64::from)).coords;
        let off = Vector3::from(world_m.map(f64::from)) - (pose.translation.vector + arm);
        // Comparisons with NaN are false.
        let is_usable = off.xy().norm() < PLANAR_M && off.z.is_finite() && epsilon_m.is_finite();
        if !is_usable {
            continue;
        }
        let weight =
            forgiveness(off.z.abs(), scale_m) / (FLOOR_M.powi(2) + f64::from(epsilon_m).powi(2));
        // d(z) = dz + wx * y - wy * x, for a small rotation about the sensor.
        let gradient = Vector3::new(1.0, arm.y, -arm.x);
        information += gradient * gradient.transpose() * weight;
        moment += gradient * off.z * weight;
        count += usize::from(weight > 0.0);
    }
    if count < MIN_CELLS {
        return None;
    }
    let [dz, roll, pitch] = (information.try_inverse()? * moment).data.0[0];
    // About horizontal axes of the world: at small angles the heading stays as predicted.
    let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(roll, pitch, 0.0)) * pose.rotation;
    let position = pose.translation.vector + Vector3::new(0.0, 0.0, dz);
    Some(Isometry3::from_parts(position.into(), rotation))
}

#[cfg(test)]
mod tests {
    use nalgebra::Translation3;

    use super::*;
    use crate::pgc::test_scene::SyntheticScene;

    #[test]
    fn height_and_tilt_are_found_and_the_plane_is_left_alone() {
        let scene = SyntheticScene {
            cells: 200,
            ..SyntheticScene::default()
        };
        let coordinates = scene.coordinates(1);
        let mut truth = scene.world_from_sensor(1);
        truth.translation.vector -= Vector3::from(coordinates.origin_m);
        let tilt = UnitQuaternion::from_scaled_axis(Vector3::new(0.03, -0.04, 0.0));
        let position = truth.translation.vector + Vector3::new(0.2, -0.1, 1.5);
        let start = Isometry3::from_parts(Translation3::from(position), tilt * truth.rotation);
        let levelled = level(&coordinates, &start);
        let off = levelled.translation.vector - truth.translation.vector;
        assert!(
            off.z.abs() < 0.1 && (off.xy() - Vector3::new(0.2, -0.1, 0.0).xy()).norm() < 1e-9,
            "{off}"
        );
        assert!(levelled.rotation.angle_to(&truth.rotation) < 0.01);
    }

    #[test]
    fn too_few_cells_leave_the_pose_as_it_is() {
        let start = Isometry3::identity();
        assert_eq!(level(&SceneCoordinates::default(), &start), start);
        let mut coordinates = SyntheticScene::default().coordinates(1);
        coordinates
            .world_m
            .iter_mut()
            .for_each(|point| point[2] = f32::NAN);
        assert_eq!(level(&coordinates, &start), start);
    }
}
