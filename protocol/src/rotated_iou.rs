//! Exact overlap of boxes seen from above, by clipping of convex polygons.

#![expect(
    clippy::indexing_slicing,
    reason = "axes and corners of arrays of fixed size; `len` never exceeds MAX_CORNERS"
)]

/// Corners of a footprint, metres, in order around it.
pub type Footprint = [[f64; 2]; 4];

/// A quadrilateral clipped by four half planes has at most eight corners; each clip adds one.
const MAX_CORNERS: usize = 8;

/// A footprint with precomputed bounds and area.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Polygon {
    corners: Footprint,
    low: [f64; 2],
    high: [f64; 2],
    area: f64,
}

impl Polygon {
    /// A convex quadrilateral from its corners, in either direction around it.
    pub fn new(mut corners: Footprint) -> Self {
        let mut area = signed_area(&corners);
        // Clipping keeps what is left of each edge: the inside, if corners are counter-clockwise.
        if area < 0.0 {
            corners.reverse();
            area = -area;
        }
        let [low, high]: [[f64; 2]; 2] = [f64::min as fn(f64, f64) -> f64, f64::max].map(|pick| {
            std::array::from_fn(|axis| {
                let along = corners.iter().map(|corner| corner[axis]);
                along.fold(corners[0][axis], pick)
            })
        });
        Self {
            corners,
            low,
            high,
            area,
        }
    }

    /// The footprint of a box: its first four corners ([`crate::Box3d::corners`]), seen from above.
    pub fn footprint(corners: &[[f64; 3]; 8]) -> Self {
        let [a, b, c, d, ..] = corners.map(|[x, y, _]| [x, y]);
        Self::new([a, b, c, d])
    }

    /// Area, square metres.
    pub fn area(&self) -> f64 {
        self.area
    }

    /// Area of overlap of the axis-aligned bounds, square metres: never less than that of the polygons.
    fn bounds_overlap(&self, other: &Self) -> f64 {
        let [x, y] = [0, 1].map(|axis: usize| {
            self.high[axis].min(other.high[axis]) - self.low[axis].max(other.low[axis])
        });
        x.max(0.0) * y.max(0.0)
    }

    /// Area of the intersection, square metres.
    pub fn intersection(&self, other: &Self) -> f64 {
        if self.bounds_overlap(other) <= 0.0 {
            return 0.0;
        }
        let mut clipped = Clipped::default();
        self.corners.iter().for_each(|corner| clipped.push(*corner));
        for edge in 0..4 {
            clipped = clipped.keep_left_of(other.corners[edge], other.corners[(edge + 1) % 4]);
            if clipped.len < 3 {
                return 0.0;
            }
        }
        // Rounding may give a little more than the smaller polygon, or less than nothing.
        signed_area(&clipped.corners[..clipped.len]).clamp(0.0, self.area.min(other.area))
    }

    /// Intersection over union, 0..1; 0 if neither has an area.
    pub fn iou(&self, other: &Self) -> f64 {
        let intersection = self.intersection(other);
        let union = self.area + other.area - intersection;
        if union > 0.0 {
            intersection / union
        } else {
            0.0
        }
    }

    /// True if the IoU is above `threshold`; decided without clipping if bounds and areas suffice.
    #[expect(clippy::cast_possible_truncation, reason = "compared in f32")]
    pub fn overlaps_more_than(&self, other: &Self, threshold: f64) -> bool {
        let most = self.bounds_overlap(other).min(self.area).min(other.area);
        // IoU rises with the intersection, so the polygons cannot exceed the bound.
        if most <= threshold * (self.area + other.area - most) {
            return false;
        }
        // The reference compares in f32; so does this, or a pair at the threshold could differ.
        self.iou(other) as f32 > threshold as f32
    }
}

/// A polygon during clipping.
#[derive(Clone, Copy, Default)]
struct Clipped {
    corners: [[f64; 2]; MAX_CORNERS],
    len: usize,
}

impl Clipped {
    /// The part to the left of the line from `a` to `b` (Sutherland and Hodgman's step).
    ///
    /// A cut is on the segment between its two corners whatever the rounding, so touching and coinciding edges cannot
    /// move a corner far away.
    fn keep_left_of(&self, a: [f64; 2], b: [f64; 2]) -> Self {
        let mut kept = Self::default();
        let mut previous = self.corners[self.len - 1];
        let mut previous_side = side(previous, a, b);
        for &corner in &self.corners[..self.len] {
            let corner_side = side(corner, a, b);
            if (previous_side < 0.0) != (corner_side < 0.0) {
                let t = previous_side / (previous_side - corner_side);
                kept.push(std::array::from_fn(|axis| {
                    previous[axis] + t * (corner[axis] - previous[axis])
                }));
            }
            if corner_side >= 0.0 {
                kept.push(corner);
            }
            (previous, previous_side) = (corner, corner_side);
        }
        kept
    }

    /// Rounding on nearly coinciding edges can produce a ninth corner; it is within rounding of another one.
    fn push(&mut self, corner: [f64; 2]) {
        if self.len < MAX_CORNERS {
            self.corners[self.len] = corner;
            self.len += 1;
        }
    }
}

/// Positive for a point to the left of the line from `a` to `b`.
fn side(p: [f64; 2], a: [f64; 2], b: [f64; 2]) -> f64 {
    (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0])
}

/// Area of a polygon, positive if counter-clockwise. Coordinates are taken relative to the first corner: far from the
/// origin the products would lose their significant digits.
fn signed_area(corners: &[[f64; 2]]) -> f64 {
    let [x0, y0] = corners[0];
    let mut doubled = 0.0;
    // The pair from the last corner back to the first adds nothing: relative to the first it is zero.
    for pair in corners.windows(2) {
        doubled += (pair[0][0] - x0) * (pair[1][1] - y0) - (pair[1][0] - x0) * (pair[0][1] - y0);
    }
    doubled / 2.0
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_4, PI};

    use crate::Box3d;
    use proptest::prelude::*;

    use super::*;

    fn polygon(x: f64, y: f64, l: f64, w: f64, heading_rad: f64) -> Polygon {
        let box3d = Box3d {
            center_m: [x, y, 0.0],
            size_m: [l, w, 1.0],
            heading_rad,
        };
        let corners = box3d.corners();
        Polygon::new(std::array::from_fn(|corner| {
            [corners[corner][0], corners[corner][1]]
        }))
    }

    #[test]
    fn known_overlaps() {
        let car = polygon(100.0, -30.0, 4.0, 2.0, 0.3);
        assert!((car.iou(&car) - 1.0).abs() < 1e-12);
        assert!((car.iou(&polygon(100.0, -30.0, 4.0, 2.0, 0.3 + PI)) - 1.0).abs() < 1e-9);
        let half = polygon(0.0, 0.0, 4.0, 2.0, 0.0).iou(&polygon(2.0, 0.0, 4.0, 2.0, 0.0));
        assert!((half - 4.0 / 12.0).abs() < 1e-12);
        // A square and the same square rotated by 45 degrees intersect in a regular octagon.
        let octagon =
            polygon(0.0, 0.0, 2.0, 2.0, 0.0).intersection(&polygon(0.0, 0.0, 2.0, 2.0, FRAC_PI_4));
        assert!((octagon - 8.0 * (2.0_f64.sqrt() - 1.0)).abs() < 1e-12);
    }

    #[test]
    fn touching_boxes_do_not_overlap_and_a_point_has_no_area() {
        let left = polygon(0.0, 0.0, 2.0, 2.0, 0.0);
        assert_eq!(left.iou(&polygon(2.0, 0.0, 2.0, 2.0, 0.0)), 0.0);
        assert_eq!(left.iou(&polygon(2.0, 2.0, 2.0, 2.0, 0.0)), 0.0);
        let point = Polygon::new([[0.5, 0.5]; 4]);
        assert_eq!((left.iou(&point), point.iou(&point)), (0.0, 0.0));
    }

    #[test]
    fn clockwise_corners_are_taken_as_well() {
        let mut corners = [[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]];
        let counter_clockwise = Polygon::new(corners);
        corners.reverse();
        assert!((Polygon::new(corners).iou(&counter_clockwise) - 1.0).abs() < 1e-12);
    }

    fn any_polygon() -> impl Strategy<Value = Polygon> {
        (-5.0..5.0, -5.0..5.0, 0.5..6.0, 0.5..3.0, -PI..PI)
            .prop_map(|(x, y, l, w, yaw)| polygon(x, y, l, w, yaw))
    }

    proptest! {
        #[test]
        fn iou_is_symmetric_and_the_short_cut_agrees(a in any_polygon(), b in any_polygon(), threshold in 0.0_f64..0.9) {
            let iou: f64 = a.iou(&b);
            prop_assert!((0.0..=1.0).contains(&iou) && (iou - b.iou(&a)).abs() < 1e-9);
            prop_assume!((iou - threshold).abs() > 1e-6);
            prop_assert_eq!(a.overlaps_more_than(&b, threshold), iou > threshold);
        }

        #[test]
        fn a_box_nearly_on_itself_overlaps_nearly_fully(a in any_polygon(), shift in -1e-9..1e-9) {
            let moved = Polygon::new(a.corners.map(|[x, y]| [x + shift, y - shift]));
            prop_assert!(a.iou(&moved) > 1.0 - 1e-6);
        }
    }
}
