//! Footprints of vehicles seen from above, and their overlap.

use crate::generate::raycast::Placement;

/// A turned rectangle in the plane, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Rectangle {
    pub(crate) center_m: [f64; 2],
    /// Unit vector along the length.
    pub(crate) axis: [f64; 2],
    /// Half length and half width.
    pub(crate) half_m: [f64; 2],
    /// Height of the ground below: footprints on different levels do not touch.
    pub(crate) z_m: f64,
}

/// Road surfaces farther apart than this in height pass above each other, metres.
const LEVEL_M: f64 = 3.0;

impl Rectangle {
    pub(crate) fn new(placement: &Placement, size_m: &[f64; 3]) -> Self {
        let (sin, cos) = placement.yaw_rad.sin_cos();
        let [x, y, z_m] = placement.position_m.into();
        // On a banked road vehicles side by side are closer to each other as seen from above.
        let half_width_m = 0.5 * size_m[1] * placement.roll_rad.cos();
        Self {
            center_m: [x, y],
            axis: [cos, sin],
            half_m: [0.5 * size_m[0], half_width_m],
            z_m,
        }
    }

    /// Grown by `margin_m` on every side.
    pub(crate) fn grown(&self, margin_m: f64) -> Self {
        Self {
            half_m: self.half_m.map(|half| half + margin_m),
            ..*self
        }
    }

    /// Radius of the circle around it.
    pub(crate) fn radius_m(&self) -> f64 {
        self.half_m[0].hypot(self.half_m[1])
    }

    /// True if both lie on one level and share a point (separating axes).
    pub(crate) fn overlaps(&self, other: &Self) -> bool {
        let offset = [0, 1].map(|axis| other.center_m[axis] - self.center_m[axis]);
        // Level and circles first: they settle most pairs cheaply.
        if (self.z_m - other.z_m).abs() > LEVEL_M
            || offset[0].hypot(offset[1]) > self.radius_m() + other.radius_m()
        {
            return false;
        }
        let axes = [self.axis, other.axis].map(|[x, y]| [[x, y], [-y, x]]);
        let mut axes = axes.iter().flatten();
        axes.all(|axis| dot(*axis, offset).abs() <= self.reach(axis) + other.reach(axis))
    }

    /// Distance of a point from the rectangle, 0 inside, metres.
    pub(crate) fn distance_m(&self, point: [f64; 2]) -> f64 {
        let offset = [point[0] - self.center_m[0], point[1] - self.center_m[1]];
        let along = (dot(self.axis, offset).abs() - self.half_m[0]).max(0.0);
        let aside =
            ((self.axis[0] * offset[1] - self.axis[1] * offset[0]).abs() - self.half_m[1]).max(0.0);
        along.hypot(aside)
    }

    fn reach(&self, axis: &[f64; 2]) -> f64 {
        let side = [-self.axis[1], self.axis[0]];
        self.half_m[0] * dot(self.axis, *axis).abs() + self.half_m[1] * dot(side, *axis).abs()
    }
}

fn dot(a: [f64; 2], b: [f64; 2]) -> f64 {
    a[0] * b[0] + a[1] * b[1]
}

/// Edge of a cell of the index, metres; no vehicle's circle is larger.
const CELL_M: f64 = 16.0;

/// Neighbour index: indices of vehicles by cell of a coarse grid.
#[derive(Debug, Clone, Default)]
pub(crate) struct NeighbourIndex {
    cells: std::collections::HashMap<(i32, i32), Vec<u32>>,
}

impl NeighbourIndex {
    fn cell(point: [f64; 2]) -> (i32, i32) {
        point.map(|metres| (metres / CELL_M).floor() as i32).into()
    }

    pub(crate) fn insert(&mut self, index: u32, point: [f64; 2]) {
        self.cells.entry(Self::cell(point)).or_default().push(index);
    }

    /// Moves an entry from one position to another.
    pub(crate) fn relocate(&mut self, index: u32, from: [f64; 2], to: [f64; 2]) {
        if Self::cell(from) == Self::cell(to) {
            return;
        }
        self.remove(index, from);
        self.insert(index, to);
    }

    /// Removes an entry.
    pub(crate) fn remove(&mut self, index: u32, point: [f64; 2]) {
        if let Some(cell) = self.cells.get_mut(&Self::cell(point)) {
            cell.retain(|&entry| entry != index);
        }
    }

    /// All entries in the cells within `radius_m` of `point`, in an order that depends on the contents alone.
    pub(crate) fn near(&self, point: [f64; 2], radius_m: f64, found: &mut Vec<u32>) {
        found.clear();
        let low = Self::cell(point.map(|metres| metres - radius_m));
        let high = Self::cell(point.map(|metres| metres + radius_m));
        for x in low.0..=high.0 {
            for y in low.1..=high.1 {
                found.extend(self.cells.get(&(x, y)).into_iter().flatten());
            }
        }
        found.sort_unstable();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn car(x: f64, y: f64, yaw: f64) -> Rectangle {
        Rectangle::new(&Placement::level([x, y, 0.0], yaw), &[4.0, 2.0, 1.5])
    }

    #[test]
    fn rectangles_touch_by_their_sides_and_corners() {
        assert!(car(0.0, 0.0, 0.0).overlaps(&car(3.9, 0.0, 0.0)));
        assert!(!car(0.0, 0.0, 0.0).overlaps(&car(4.1, 0.0, 0.0)));
        assert!(!car(0.0, 0.0, 0.0).overlaps(&car(0.0, 2.1, 0.0)));
        // Across: half a length and half a width meet.
        assert!(car(0.0, 0.0, 0.0).overlaps(&car(2.9, 0.0, std::f64::consts::FRAC_PI_2)));
        assert!(!car(0.0, 0.0, 0.0).overlaps(&car(3.1, 0.0, std::f64::consts::FRAC_PI_2)));
        // Boxes along the axes would meet at this corner, the turned ones do not.
        assert!(!car(0.0, 0.0, 0.0).overlaps(&car(3.7, 2.4, std::f64::consts::FRAC_PI_4)));
        let mut above = car(0.0, 0.0, 0.0);
        above.z_m = 6.0;
        assert!(!car(0.0, 0.0, 0.0).overlaps(&above));
    }

    #[test]
    fn distance_is_zero_inside() {
        assert_eq!(car(0.0, 0.0, 0.3).distance_m([0.1, 0.2]), 0.0);
        assert!((car(0.0, 0.0, 0.0).distance_m([5.0, 5.0]) - 5.0).abs() < 1e-12);
    }
}
