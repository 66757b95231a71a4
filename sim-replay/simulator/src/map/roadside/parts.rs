//! Builders of small solids, relative to a foot pose.

use super::super::curve::Pose2;
use super::super::{Shape, Solid, SolidKind};

/// Foot of a group of solids: plan pose and height, metres.
#[derive(Debug, Clone, Copy)]
pub(super) struct PartFootprint {
    pub pose: Pose2,
    pub z_m: f64,
}

impl PartFootprint {
    /// A foot at a pose and height.
    pub(super) fn new(pose: Pose2, z_m: f64) -> Self {
        Self { pose, z_m }
    }

    /// A box of full `size_m` over the middle of the foot, standing `lift_m` over it.
    pub(super) fn standing(
        &self,
        kind: SolidKind,
        lift_m: f64,
        size_m: [f64; 3],
        reflectivity: f32,
    ) -> Solid {
        self.cuboid(kind, [0.0, 0.0, lift_m], size_m, reflectivity)
    }

    /// A cylinder of this radius and height over the middle of the foot, standing `lift_m` over it.
    pub(super) fn post(
        &self,
        kind: SolidKind,
        lift_m: f64,
        size_m: [f64; 2],
        reflectivity: f32,
    ) -> Solid {
        self.cylinder(kind, [0.0, 0.0, lift_m], size_m, reflectivity)
    }

    /// A box of full `size_m`, its middle `u` ahead and `v` to the left, standing `lift_m` over the foot.
    pub(super) fn cuboid(
        &self,
        kind: SolidKind,
        [u, v, lift_m]: [f64; 3],
        size_m: [f64; 3],
        reflectivity: f32,
    ) -> Solid {
        let half_m = size_m.map(|length| length / 2.0);
        let center_m = [u, v, lift_m + half_m[2]];
        self.solid(kind, Shape::Box { half_m }, center_m, reflectivity)
    }

    /// An upright cylinder.
    pub(super) fn cylinder(
        &self,
        kind: SolidKind,
        [u, v, lift_m]: [f64; 3],
        [radius_m, height_m]: [f64; 2],
        reflectivity: f32,
    ) -> Solid {
        let shape = Shape::Cylinder {
            radius_m,
            half_height_m: height_m / 2.0,
        };
        self.solid(kind, shape, [u, v, lift_m + height_m / 2.0], reflectivity)
    }

    /// A solid with its middle at `at` from the foot.
    pub(super) fn solid(
        &self,
        kind: SolidKind,
        shape: Shape,
        at: [f64; 3],
        reflectivity: f32,
    ) -> Solid {
        let [u, v, w] = at;
        let Pose2 { x, y, .. } = self.pose.moved(u, v, 0.0);
        Solid {
            kind,
            shape,
            center_m: [x, y, self.z_m + w],
            yaw_rad: self.pose.heading_rad,
            reflectivity,
        }
    }
}

/// A straight wall-like box from one place to another: `bottom_m` to `top_m`, `thickness_m` across.
pub(super) fn wall(
    kind: SolidKind,
    from: [f64; 2],
    to: [f64; 2],
    [bottom_m, top_m]: [f64; 2],
    thickness_m: f64,
    reflectivity: f32,
) -> Solid {
    let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
    let half_m = [dx.hypot(dy), thickness_m, top_m - bottom_m].map(|size_m| size_m / 2.0);
    let center_m = [from[0] + to[0], from[1] + to[1], bottom_m + top_m].map(|sum| sum / 2.0);
    Solid {
        kind,
        shape: Shape::Box { half_m },
        center_m,
        yaw_rad: dy.atan2(dx),
        reflectivity,
    }
}
