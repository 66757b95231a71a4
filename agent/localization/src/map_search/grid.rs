//! Upright planes of a place on a grid in the plane, with windows of doubling size for branch and bound.

use std::f64::consts::PI;

use nalgebra::Vector2;

use crate::registration::icp::Plane;

/// Side of a cell, metres.
pub(super) const CELL_M: f64 = 1.0;
/// Windows of the coarsest level have a side of two to this power, cells.
pub(super) const COARSEST: u32 = 5;
/// Farthest planes of a sweep that are used, metres.
pub(super) const RANGE_M: f64 = 50.0;
/// Cells around the place, so that all of a sweep lies on the grid, wherever in the place its sensor is.
const MARGIN: usize = (RANGE_M / CELL_M) as usize + 2 + (1 << COARSEST);
/// Largest place, square metres: a search begins with 240 windows on each of its squares of 32 m.
const MAX_AREA_M2: f64 = 8e6;
/// Largest vertical part of the normal of an upright plane.
const UPRIGHT_NORMAL_Z: f64 = 0.5;
/// Directions of normals that are told apart, over half a turn.
const DIRECTIONS: u32 = u16::BITS;

/// An upright plane, seen from above.
#[derive(Debug, Clone, Copy)]
pub(super) struct UprightPlane {
    pub(super) at_m: Vector2<f64>,
    /// Direction of its normal, radians.
    pub(super) normal_rad: f64,
}

impl UprightPlane {
    /// A plane, if it is upright.
    pub(super) fn of(plane: &Plane) -> Option<Self> {
        (plane.normal.z.abs() < UPRIGHT_NORMAL_Z).then(|| Self {
            at_m: plane.centre_m.xy(),
            normal_rad: plane.normal.y.atan2(plane.normal.x),
        })
    }
}

/// Bit of the direction of a normal of either sign.
pub(super) fn direction_bit(normal_rad: f64) -> u16 {
    let half_turns = (normal_rad / PI).rem_euclid(1.0);
    // Rounding can make the remainder 1.
    1 << ((half_turns * f64::from(DIRECTIONS)) as u32 % DIRECTIONS)
}

/// Directions of the upright planes in each cell, and in windows of 2, 4, .. cells from each cell on.
#[derive(Debug)]
pub(super) struct UprightGrid {
    /// Corner of the first cell, metres.
    corner_m: Vector2<f64>,
    pub(super) columns: usize,
    /// Columns and rows in which a sensor may be.
    pub(super) place: [usize; 2],
    /// By size of the window, row by row: bits of [`direction_bit`].
    pub(super) levels: Vec<Vec<u16>>,
}

impl UprightGrid {
    /// The grid of the planes of a place; `None` of a place without one, or of more than [`MAX_AREA_M2`].
    pub(super) fn of(planes: &[Plane]) -> Option<Self> {
        let first = planes.first()?.centre_m.xy();
        let (lowest, highest) = planes.iter().fold((first, first), |(low, high), plane| {
            let at_m = plane.centre_m.xy();
            (low.inf(&at_m), high.sup(&at_m))
        });
        let place: [usize; 2] = ((highest - lowest) / CELL_M)
            .map(|cells| cells as usize + 1)
            .into();
        let area_m2 = place[0] as f64 * place[1] as f64 * CELL_M.powi(2);
        if area_m2 > MAX_AREA_M2 {
            return None;
        }
        let [columns, rows] = place.map(|cells| cells + 2 * MARGIN);
        let mut grid = Self {
            corner_m: lowest - Vector2::repeat(MARGIN as f64 * CELL_M),
            columns,
            place,
            levels: vec![vec![0; columns * rows]],
        };
        for plane in planes.iter().filter_map(UprightPlane::of) {
            let cell = (plane.at_m - grid.corner_m) / CELL_M;
            let bit = direction_bit(plane.normal_rad);
            // The directions beside it too: normals have errors, and a heading of the search is half a step off.
            grid.levels[0][cell.y as usize * columns + cell.x as usize] |=
                bit | bit.rotate_left(1) | bit.rotate_right(1);
        }
        for level in 0..COARSEST {
            let windows = doubled(&grid.levels[level as usize], columns, 1 << level);
            grid.levels.push(windows);
        }
        Some(grid)
    }

    /// The cell of a column and row of the place.
    pub(super) fn cell(&self, [column, row]: [usize; 2]) -> usize {
        (row + MARGIN) * self.columns + column + MARGIN
    }

    /// Centre of a column and row of the place, metres.
    pub(super) fn centre_m(&self, position: [usize; 2]) -> Vector2<f64> {
        let cell = Vector2::from(position).map(|cell| (cell + MARGIN) as f64 + 0.5);
        self.corner_m + cell * CELL_M
    }
}

/// Windows of twice the side, of those of `side` cells.
fn doubled(windows: &[u16], columns: usize, side: usize) -> Vec<u16> {
    let at = |cell: usize| windows.get(cell).copied().unwrap_or(0);
    let below = side * columns;
    let cells = 0..windows.len();
    cells
        .map(|cell| at(cell) | at(cell + side) | at(cell + below) | at(cell + below + side))
        .collect()
}
