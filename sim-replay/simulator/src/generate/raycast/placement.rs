//! Placements and motions of bodies and sensors during one sweep.

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use std::f64::consts::{PI, TAU};

/// A pose: position in metres, heading, pitch (positive lifts the nose) and roll (positive lifts the left side),
/// radians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placement {
    /// Position in the world.
    pub position_m: Vector3<f64>,
    /// Turn about z, from x towards y.
    pub yaw_rad: f64,
    /// Upward slope of the x axis.
    pub pitch_rad: f64,
    /// Turn about the x axis, from y towards z, before the others.
    pub roll_rad: f64,
}

impl Placement {
    /// A level placement.
    pub fn level(position_m: [f64; 3], yaw_rad: f64) -> Self {
        Self {
            position_m: position_m.into(),
            yaw_rad,
            pitch_rad: 0.0,
            roll_rad: 0.0,
        }
    }

    /// `world_from_self`, the turning part.
    pub fn rotation(&self) -> Matrix3<f64> {
        let (sy, cy) = self.yaw_rad.sin_cos();
        let (sp, cp) = self.pitch_rad.sin_cos();
        // Rz(yaw) Ry(-pitch): a positive pitch lifts the x axis.
        let rotation = Matrix3::new(cy * cp, -sy, -cy * sp, sy * cp, cy, -sy * sp, sp, 0.0, cp);
        if self.roll_rad == 0.0 {
            return rotation;
        }
        let (sr, cr) = self.roll_rad.sin_cos();
        rotation * Matrix3::new(1.0, 0.0, 0.0, 0.0, cr, -sr, 0.0, sr, cr)
    }

    /// `world_from_self`.
    pub fn isometry(&self) -> Isometry3<f64> {
        let rotation = Rotation3::from_matrix_unchecked(self.rotation());
        let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
        Isometry3::from_parts(Translation3::from(self.position_m), rotation)
    }

    /// The placement of something mounted at `offset_m` in this frame, with the same axes.
    pub fn mounted(&self, offset_m: [f64; 3]) -> Self {
        Self {
            position_m: self.position_m + self.rotation() * Vector3::from(offset_m),
            ..*self
        }
    }
}

/// The course of a body or a sensor over one sweep: straight and even from start to end.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Course {
    /// At the sweep's start.
    pub start: Placement,
    /// At the sweep's end.
    pub end: Placement,
}

impl Course {
    /// No motion.
    pub fn still(placement: Placement) -> Self {
        Self {
            start: placement,
            end: placement,
        }
    }

    /// The placement at a time between 0 (start) and 1 (end).
    pub fn at(&self, time: f64) -> Placement {
        // The short way round, also across the step from pi to -pi.
        let turn = wrapped(self.end.yaw_rad - self.start.yaw_rad);
        Placement {
            position_m: self.start.position_m
                + (self.end.position_m - self.start.position_m) * time,
            // Backwards from the end, so that the pose at time 1 is the end to the last bit.
            yaw_rad: self.end.yaw_rad - turn * (1.0 - time),
            pitch_rad: self.start.pitch_rad + (self.end.pitch_rad - self.start.pitch_rad) * time,
            roll_rad: self.start.roll_rad + (self.end.roll_rad - self.start.roll_rad) * time,
        }
    }

    /// The motion of something mounted on this.
    pub fn mounted(&self, offset_m: [f64; 3]) -> Self {
        Self {
            start: self.start.mounted(offset_m),
            end: self.end.mounted(offset_m),
        }
    }
}

/// The angle on the branch from -pi to pi.
pub fn wrapped(angle_rad: f64) -> f64 {
    let turned = (angle_rad + PI).rem_euclid(TAU) - PI;
    if turned.is_finite() { turned } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pitch_lifts_the_nose_and_yaw_turns_left() {
        let turned = Placement {
            pitch_rad: 0.1,
            ..Placement::level([0.0; 3], PI / 2.0)
        };
        let nose = turned.rotation() * Vector3::x();
        assert!((nose - Vector3::new(0.0, 0.1f64.cos(), 0.1f64.sin())).norm() < 1e-12);
    }

    #[test]
    fn roll_lifts_the_left_side_and_leaves_the_nose() {
        let level = Placement {
            pitch_rad: 0.1,
            ..Placement::level([0.0; 3], PI / 2.0)
        };
        let rotation = Placement {
            roll_rad: 0.2,
            ..level
        }
        .rotation();
        assert!((rotation * Vector3::x() - level.rotation() * Vector3::x()).norm() < 1e-12);
        let left = rotation * Vector3::y();
        assert!(
            (left.z - 0.2f64.sin() * 0.1f64.cos()).abs() < 1e-12
                && (left.x + 0.2f64.cos()).abs() < 1e-12,
            "{left}"
        );
    }

    #[test]
    fn a_sweep_turns_the_short_way_round() {
        let start = Placement::level([0.0; 3], 3.1);
        let end = Placement::level([1.0, 0.0, 0.0], -3.1);
        let middle = Course { start, end }.at(0.5);
        assert!(
            wrapped(middle.yaw_rad - PI).abs() < 1e-9 && (middle.position_m.x - 0.5).abs() < 1e-12
        );
        assert_eq!(Course { start, end }.at(1.0).yaw_rad, -3.1);
    }

    #[test]
    fn the_rotation_is_that_of_the_isometry() {
        let placement = Placement {
            position_m: Vector3::new(1.0, 2.0, 3.0),
            yaw_rad: 0.7,
            pitch_rad: -0.2,
            roll_rad: 0.3,
        };
        let difference = placement
            .isometry()
            .rotation
            .to_rotation_matrix()
            .into_inner()
            - placement.rotation();
        assert!(difference.amax() < 1e-12);
    }
}
