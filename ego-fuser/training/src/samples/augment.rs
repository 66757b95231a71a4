//! Augmentation: random changes of a scene that keep it consistent.
//!
//! Mirroring and scaling are common to all vehicles of a scene; every vehicle's own frame is rotated by its own angle,
//! and the relative poses are changed accordingly. So views, boxes and poses remain consistent.

use std::f64::consts::PI;

use nalgebra::{Isometry3, Matrix3, Rotation3, UnitQuaternion, Vector3};
use protocol::{Box3d, Pose};
use rand::Rng;

/// Limits of the changes of a scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Augmentation {
    /// Probability of mirroring left and right.
    pub mirror: f64,
    /// Largest rotation of a vehicle's frame, radians.
    pub turn_rad: f64,
    /// Scale is drawn from 1 - this to 1 + this.
    pub scale: f64,
}

impl Augmentation {
    /// No changes.
    pub(crate) const OFF: Self = Self {
        mirror: 0.0,
        turn_rad: 0.0,
        scale: 0.0,
    };

    /// Draws the changes of the views of a scene's vehicles.
    pub fn views(&self, vehicles: usize, rng: &mut impl Rng) -> Vec<ViewAugment> {
        let mirrored = rng.random_bool(self.mirror);
        let scale = 1.0 + self.scale * (2.0 * rng.random::<f64>() - 1.0);
        let views = (0..vehicles).map(|_| ViewAugment {
            mirrored,
            scale,
            turn_rad: self.turn_rad * (2.0 * rng.random::<f64>() - 1.0),
        });
        views.collect()
    }
}

impl Default for Augmentation {
    fn default() -> Self {
        Self {
            mirror: 0.5,
            turn_rad: PI / 4.0,
            scale: 0.05,
        }
    }
}

/// The change of one vehicle's frame: mirror y, rotate about z, scale.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewAugment {
    mirrored: bool,
    scale: f64,
    turn_rad: f64,
}

impl ViewAugment {
    /// Changes points of that frame in place.
    pub fn points(&self, points: &mut [[f32; 4]]) {
        let (sin, cos) = self.turn_rad.sin_cos();
        let [sin, cos, scale] =
            [sin * self.scale, cos * self.scale, self.scale].map(|of| of as f32);
        let side = if self.mirrored { -1.0f32 } else { 1.0 };
        for [x, y, z, _] in points {
            // Mirrored before it is rotated, as boxes and poses are.
            let (old_x, old_y) = (*x, *y * side);
            *x = cos * old_x - sin * old_y;
            *y = sin * old_x + cos * old_y;
            *z *= scale;
        }
    }

    /// A box of that frame after the change.
    pub fn box3d(&self, box3d: &Box3d) -> Box3d {
        let side = if self.mirrored { -1.0 } else { 1.0 };
        Box3d {
            center_m: self.moved(box3d.center_m).into(),
            size_m: box3d.size_m.map(|size| size * self.scale),
            heading_rad: side * box3d.heading_rad + self.turn_rad,
        }
    }

    /// `ego_from_cav` between two changed frames: `self` is the ego's change, `cav` the other's.
    pub fn pose(&self, ego_from_cav: &Pose, cav: &Self) -> Pose {
        let isometry = ego_from_cav.isometry();
        let translation = self.moved(ego_from_cav.translation_m);
        let mut rotation = *isometry.rotation.to_rotation_matrix().matrix();
        if self.mirrored {
            // S R S with S = diag(1, -1, 1): the product of two reflections and a rotation is a rotation.
            let side = Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, 1.0));
            rotation = side * rotation * side;
        }
        let rotation = Rotation3::from_matrix_unchecked(rotation);
        // From right to left: old frame of the other from its new one, the pose, new ego from old.
        let rotation =
            self.turn() * UnitQuaternion::from_rotation_matrix(&rotation) * cav.turn().inverse();
        Isometry3::from_parts(translation.into(), rotation).into()
    }

    fn turn(&self) -> UnitQuaternion<f64> {
        UnitQuaternion::from_axis_angle(&Vector3::z_axis(), self.turn_rad)
    }

    /// A point of that frame after the change.
    fn moved(&self, [x, y, z]: [f64; 3]) -> Vector3<f64> {
        let y = if self.mirrored { -y } else { y };
        self.turn() * Vector3::new(x, y, z) * self.scale
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn a_point_seen_by_two_vehicles_stays_one_point() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let ego_from_cav = Pose::from_xyz_yaw([12.0, -4.0, 0.3], 2.0);
        let in_cav = [3.0f32, -2.0, 0.5, 0.0];
        let in_ego = ego_from_cav.isometry() * Point3::new(3.0, -2.0, 0.5);
        for _ in 0..20 {
            let views = Augmentation::default().views(2, &mut rng);
            let (ego, cav) = (views[0], views[1]);
            let mut points = [in_cav];
            cav.points(&mut points);
            let pose = ego.pose(&ego_from_cav, &cav);
            pose.validate().unwrap();
            let through_cav = pose.isometry()
                * Point3::from([points[0][0], points[0][1], points[0][2]].map(f64::from));
            let mut points = [[in_ego.x as f32, in_ego.y as f32, in_ego.z as f32, 0.0]];
            ego.points(&mut points);
            let direct = Point3::from([points[0][0], points[0][1], points[0][2]].map(f64::from));
            assert!((through_cav - direct).norm() < 1e-4);
        }
    }

    #[test]
    fn the_corners_of_a_box_move_like_points() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let car = Box3d {
            center_m: [5.0, 7.0, -1.0],
            size_m: [4.0, 1.8, 1.5],
            heading_rad: 0.7,
        };
        for _ in 0..20 {
            let view = Augmentation::default().views(1, &mut rng)[0];
            let mut moved: Vec<[f32; 4]> = car
                .corners()
                .iter()
                .map(|[x, y, z]| [*x as f32, *y as f32, *z as f32, 0.0])
                .collect();
            view.points(&mut moved);
            for corner in view.box3d(&car).corners() {
                let nearest = moved.iter().map(|point| {
                    (0..3)
                        .map(|axis| (f64::from(point[axis]) - corner[axis]).powi(2))
                        .sum::<f64>()
                        .sqrt()
                });
                assert!(nearest.fold(f64::INFINITY, f64::min) < 1e-4);
            }
        }
    }

    #[test]
    fn off_changes_nothing() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let view = Augmentation::OFF.views(1, &mut rng)[0];
        let mut points = [[1.5f32, -2.5, 0.25, 0.5]];
        view.points(&mut points);
        assert_eq!(points, [[1.5, -2.5, 0.25, 0.5]]);
    }
}
