//! Solid things beside and above the road.

use super::convex::PlanRectangle;
use super::curve::Pose2;

/// Kind of a solid; determines its reflectivity and the objects allowed beside it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum SolidKind {
    /// Part of a building, roof structures included.
    Building,
    /// Garden wall or retaining wall.
    Wall,
    /// Fence.
    Fence,
    /// Hedge or bush.
    Hedge,
    /// Trunk of a tree.
    TreeTrunk,
    /// Crown of a tree.
    TreeCrown,
    /// Lamp post, traffic-light post, sign post, bollard.
    Pole,
    /// Sign plate, traffic-light head, gantry board.
    Sign,
    /// Crash barrier, parapet, median barrier.
    Barrier,
    /// Noise wall along a motorway.
    NoiseWall,
    /// Slab under an elevated road, tunnel roof.
    BridgeDeck,
    /// Pillar under a bridge.
    Pillar,
    /// Side wall of an under-pass or tunnel.
    TunnelWall,
    /// Bus shelter, kiosk, bin, hydrant, cabinet, bench.
    StreetFurniture,
}

/// A convex shape; upright, its own axes turned about z only.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Shape {
    /// Cuboid by its half lengths along its own x, y and z, metres.
    Box {
        /// Half lengths, metres.
        half_m: [f64; 3],
    },
    /// Upright cylinder.
    Cylinder {
        /// Radius, metres.
        radius_m: f64,
        /// Half of the height, metres.
        half_height_m: f64,
    },
    /// Ellipsoid by its radii along its own x, y and z, metres.
    Ellipsoid {
        /// Radii, metres.
        radii_m: [f64; 3],
    },
}

impl Shape {
    /// Half lengths along the shape's own x, y and z of the box around it, metres.
    pub(crate) fn half_m(&self) -> [f64; 3] {
        match *self {
            Self::Box { half_m } | Self::Ellipsoid { radii_m: half_m } => half_m,
            Self::Cylinder {
                radius_m,
                half_height_m,
            } => [radius_m, radius_m, half_height_m],
        }
    }
}

/// One solid in the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Solid {
    /// Kind of the solid.
    pub kind: SolidKind,
    /// Its shape in its own frame.
    pub shape: Shape,
    /// Centre of the shape (not its foot), metres in the world frame.
    pub center_m: [f64; 3],
    /// Turn of its own x axis from the world's, radians.
    pub yaw_rad: f64,
    /// Reflectance in the near infrared, 0 to 1.
    pub reflectivity: f32,
}

impl Solid {
    /// Outline seen from above.
    pub(crate) fn outline(&self) -> PlanRectangle {
        let [half_x, half_y, _] = self.shape.half_m();
        // A round outline needs no turning.
        let is_round = matches!(self.shape, Shape::Cylinder { .. });
        let [x, y, _] = self.center_m;
        let yaw_rad = if is_round { 0.0 } else { self.yaw_rad };
        PlanRectangle::around(Pose2::new(x, y, yaw_rad), [half_x, half_y])
    }

    /// Heights of its lowest and its highest point, metres in the world frame.
    pub(crate) fn z_m(&self) -> [f64; 2] {
        let (middle, [_, _, half]) = (self.center_m[2], self.shape.half_m());
        [middle - half, middle + half]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    impl Solid {
        /// Axis-aligned bounds in the world frame: lowest and highest corner, metres.
        pub(crate) fn bounds_m(&self) -> ([f64; 3], [f64; 3]) {
            let [half_x, half_y, half_z] = self.shape.half_m();
            let (sin, cos) = self.yaw_rad.sin_cos();
            let half = match self.shape {
                Shape::Box { .. } => [
                    (half_x * cos).abs() + (half_y * sin).abs(),
                    (half_x * sin).abs() + (half_y * cos).abs(),
                ],
                Shape::Cylinder { radius_m, .. } => [radius_m, radius_m],
                Shape::Ellipsoid { .. } => [
                    (half_x * cos).hypot(half_y * sin),
                    (half_x * sin).hypot(half_y * cos),
                ],
            };
            let half = [half[0], half[1], half_z];
            (
                std::array::from_fn(|axis| self.center_m[axis] - half[axis]),
                std::array::from_fn(|axis| self.center_m[axis] + half[axis]),
            )
        }
    }

    #[test]
    fn bounds_of_a_turned_box_and_of_an_ellipsoid() {
        let shape = Shape::Box {
            half_m: [2.0, 1.0, 3.0],
        };
        let solid = Solid {
            kind: SolidKind::Building,
            shape,
            center_m: [10.0, 0.0, 3.0],
            yaw_rad: std::f64::consts::FRAC_PI_2,
            reflectivity: 0.4,
        };
        let (low, high) = solid.bounds_m();
        let expected = ([9.0, -2.0, 0.0], [11.0, 2.0, 6.0]);
        for axis in 0..3 {
            assert!(
                (low[axis] - expected.0[axis]).abs() < 1e-12
                    && (high[axis] - expected.1[axis]).abs() < 1e-12
            );
        }
        let shape = Shape::Ellipsoid {
            radii_m: [2.0, 2.0, 1.0],
        };
        let crown = Solid {
            shape,
            center_m: [0.0; 3],
            yaw_rad: 0.7,
            ..solid
        };
        let (low, _) = crown.bounds_m();
        assert!((low[0] + 2.0).abs() < 1e-12 && (low[1] + 2.0).abs() < 1e-12);
    }
}
