//! Coverage of drives: extent, length, and the cells of a grid that were driven through.

use std::collections::BTreeMap;
use std::fmt::Write;

use nalgebra::Vector3;
use serde::Serialize;

/// Smallest edge of a cell, metres.
const CELL_M: f64 = 25.0;
/// Most cells along an edge of the picture.
const MOST_CELLS: f64 = 60.0;

/// Area of a place that has been driven, in the frame of the map.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Coverage {
    /// Number of sweeps.
    pub sweeps: usize,
    /// Length of all drives, metres.
    pub length_m: f64,
    /// Smallest x and y of the sensor, metres.
    pub low_m: [f64; 2],
    /// Largest x and y of the sensor, metres.
    pub high_m: [f64; 2],
    /// Edge of a cell of the grid, metres.
    pub cell_m: f64,
    /// Cells with sweeps in them: south-west corner, metres, and number of sweeps.
    pub cells: Vec<CoveredCell>,
}

/// A cell of the grid.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct CoveredCell {
    /// x and y of the south-west corner, metres.
    pub corner_m: [f64; 2],
    /// Number of sweeps.
    pub sweeps: usize,
}

impl Coverage {
    /// Coverage of drives, each the positions of its sweeps in the order of time, metres; `None` without sweeps.
    pub(super) fn of(drives: &[Vec<Vector3<f64>>]) -> Option<Self> {
        let all = drives.iter().flatten();
        let first = all.clone().next()?;
        let (mut low_m, mut high_m) = ([first.x, first.y], [first.x, first.y]);
        for position in all.clone() {
            for axis in 0..2 {
                low_m[axis] = low_m[axis].min(position[axis]);
                high_m[axis] = high_m[axis].max(position[axis]);
            }
        }
        let edge_m = (high_m[0] - low_m[0]).max(high_m[1] - low_m[1]);
        let cell_m = CELL_M.max((edge_m / MOST_CELLS / CELL_M).ceil() * CELL_M);
        let mut counts: BTreeMap<[i64; 2], usize> = BTreeMap::new();
        for position in all.clone() {
            // Floor, as coordinates may be negative: a cast alone rounds towards zero.
            *counts
                .entry([0, 1].map(|axis| (position[axis] / cell_m).floor() as i64))
                .or_default() += 1;
        }
        let cells = counts.into_iter().map(|(cell, sweeps)| CoveredCell {
            corner_m: cell.map(|k| k as f64 * cell_m),
            sweeps,
        });
        let steps = drives.iter().flat_map(|drive| drive.windows(2));
        let length_m = steps.map(|pair| (pair[1] - pair[0]).norm()).sum();
        Some(Self {
            sweeps: all.count(),
            length_m,
            low_m,
            high_m,
            cell_m,
            cells: cells.collect(),
        })
    }

    /// The grid as text, north up: `#` where there are sweeps, `.` where there are none.
    pub fn picture(&self) -> String {
        let corners_m = self.cells.iter().map(|cell| cell.corner_m);
        let places: Vec<[i64; 2]> = corners_m
            .map(|corner_m| corner_m.map(|metres| (metres / self.cell_m).round() as i64))
            .collect();
        let [xs, ys] = [0, 1].map(|axis: usize| places.iter().map(move |place| place[axis]));
        let (west, east) = (xs.clone().min().unwrap_or(0), xs.max().unwrap_or(-1));
        let (south, north) = (ys.clone().min().unwrap_or(0), ys.max().unwrap_or(-1));
        let mut text = String::new();
        for y in (south..=north).rev() {
            let line = (west..=east).map(|x| if places.contains(&[x, y]) { '#' } else { '.' });
            // Writing into a string cannot fail.
            let _ = writeln!(text, "{}", line.collect::<String>());
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_drive_is_measured_and_drawn() {
        let east: Vec<_> = (0..=10)
            .map(|k| Vector3::new(f64::from(k) * 10.0, 30.0, 0.0))
            .collect();
        let south = vec![
            Vector3::new(90.0, 30.0, 0.0),
            Vector3::new(90.0, -10.0, 0.0),
        ];
        let coverage = Coverage::of(&[east, south]).unwrap();
        assert_eq!(
            (coverage.sweeps, coverage.length_m, coverage.cell_m),
            (13, 140.0, 25.0)
        );
        assert_eq!(
            (coverage.low_m, coverage.high_m),
            ([0.0, -10.0], [100.0, 30.0])
        );
        assert_eq!(coverage.picture(), "#####\n.....\n...#.\n");
        assert_eq!(
            coverage.cells.iter().map(|cell| cell.sweeps).sum::<usize>(),
            13
        );
        assert_eq!(Coverage::of(&[Vec::new()]), None);
    }

    #[test]
    fn cells_of_a_large_place_are_larger() {
        let far = vec![Vector3::zeros(), Vector3::new(9_000.0, 0.0, 0.0)];
        assert_eq!(Coverage::of(&[far]).unwrap().cell_m, 150.0);
    }
}
