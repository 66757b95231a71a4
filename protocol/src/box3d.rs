//! Oriented boxes and detections.

use nalgebra::{Isometry3, Point3, Vector3};
use serde::{Deserialize, Serialize};

use crate::checks::check_within;
use crate::{CavId, WireError};

/// An upright box: centre, full sizes, heading.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Box3d {
    /// Centre x, y, z in metres.
    pub center_m: [f64; 3],
    /// Full length (along the heading), width and height in metres.
    pub size_m: [f64; 3],
    /// Rotation about z from x towards y, radians.
    pub heading_rad: f64,
}

impl Box3d {
    /// Corners in metres: bottom face `(+l, -w) (+l, +w) (-l, +w) (-l, -w)`, then the top face in the same order.
    pub fn corners(&self) -> [[f64; 3]; 8] {
        let [a, b, c, d] = [(1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0)];
        let (sin, cos) = self.heading_rad.sin_cos();
        let [x, y, z] = self.center_m;
        let [half_l, half_w, half_h] = self.size_m.map(|size| size / 2.0);
        let [bottom, top] = [-half_h, half_h].map(|h| {
            [a, b, c, d].map(|(sign_l, sign_w): (f64, f64)| {
                let (l, w) = (sign_l * half_l, sign_w * half_w);
                [x + cos * l - sin * w, y + sin * l + cos * w, z + h]
            })
        });
        let ([a, b, c, d], [e, f, g, h]) = (bottom, top);
        [a, b, c, d, e, f, g, h]
    }

    /// Checks that messages accept the box: finite, sizes of 1 mm to 1 km, bounded centre and heading.
    ///
    /// # Errors
    /// [`WireError::Value`] with the first value that is not valid.
    pub fn check(&self) -> Result<(), WireError> {
        self.check_from(1e-3)
    }

    /// [`Self::check`] with another smallest size, metres.
    pub(crate) fn check_from(&self, min_size_m: f64) -> Result<(), WireError> {
        for coordinate in self.center_m {
            check_within("box center_m", coordinate, -1e7, 1e7)?;
        }
        for size in self.size_m {
            check_within("box size_m", size, min_size_m, 1e3)?;
        }
        check_within("box heading_rad", self.heading_rad, -1e3, 1e3)
    }

    /// The same box in a world whose y axis points the other way.
    pub fn mirrored_y(&self) -> Self {
        let [x, y, z] = self.center_m;
        Self {
            center_m: [x, -y, z],
            heading_rad: -self.heading_rad,
            ..*self
        }
    }

    /// The box in another frame. Roll and pitch that the transform adds are dropped, as boxes stay upright.
    pub fn transformed(&self, target_from_source: &Isometry3<f64>) -> Self {
        let center = target_from_source * Point3::from(self.center_m);
        let (sin, cos) = self.heading_rad.sin_cos();
        // A vector, not a point: the translation does not apply.
        let forward = target_from_source * Vector3::new(cos, sin, 0.0);
        Self {
            center_m: center.into(),
            heading_rad: forward.y.atan2(forward.x),
            ..*self
        }
    }
}

/// True if all corners lie within x, y of the lower and the upper corner of `range_m`, edges included.
pub fn corners_within(corners: &[[f64; 3]; 8], range_m: [f64; 4]) -> bool {
    let [x_low, y_low, x_high, y_high] = range_m;
    corners
        .iter()
        .all(|&[x, y, _]| (x_low..=x_high).contains(&x) && (y_low..=y_high).contains(&y))
}

/// A box that a detector reports.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Detection {
    /// Box in the ego's LiDAR frame.
    #[serde(rename = "box")]
    pub box3d: Box3d,
    /// Confidence, 0..1.
    pub score: f32,
    /// The CAV that detected it, if a single one did (late fusion).
    pub source: Option<CavId>,
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use super::*;

    const CAR: Box3d = Box3d {
        center_m: [10.0, 2.0, 0.5],
        size_m: [4.0, 2.0, 1.5],
        heading_rad: 0.0,
    };

    #[test]
    fn corners_start_at_the_front_right() {
        let corners = CAR.corners();
        assert_eq!(corners[0], [12.0, 1.0, -0.25]);
        assert_eq!(corners[6], [8.0, 3.0, 1.25]);
    }

    #[test]
    fn a_quarter_turn_moves_and_turns_the_box() {
        let turn = Isometry3::rotation(Vector3::z() * FRAC_PI_2);
        let turned = CAR.transformed(&turn);
        assert!(
            (turned.center_m[0] + 2.0).abs() < 1e-12 && (turned.center_m[1] - 10.0).abs() < 1e-12
        );
        assert!((turned.heading_rad - FRAC_PI_2).abs() < 1e-12);
        assert_eq!(turned.size_m, CAR.size_m);
    }
}
