//! Driven area of a head: the cells of a grid in which there are sweeps that it was trained on.

use std::collections::BTreeMap;
use std::path::Path;

use perception::weights::{FileError, Weights, annotate};
use protocol::config::{FieldError, require, within};
use serde::{Deserialize, Serialize};

/// Key of the metadata of a head's file that contains its driven area.
pub(super) const DRIVEN_AREA_KEY: &str = "driven_area";
/// Smallest edge of a cell, metres.
const CELL_M: f64 = 25.0;
/// Most cells along an edge of the area.
const MOST_CELLS: f64 = 60.0;
/// Fewest sweeps around a covered place, in multiples of those of the median cell. On validation drives of town 4 in
/// sunshine and snow each sweep without a pose has fewer around it, in fog none.
const LEAST_RATIO: usize = 2;

/// Cells with sweeps in them, in the frame of the map.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DrivenArea {
    /// Edge of a cell, metres.
    pub cell_m: f64,
    /// Cells with sweeps in them: south-west corner, metres, and number of sweeps.
    pub cells: Vec<DrivenCell>,
}

/// A cell of the grid.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DrivenCell {
    /// x and y of the south-west corner, metres.
    pub corner_m: [f64; 2],
    /// Number of sweeps.
    pub sweeps: usize,
}

impl DrivenArea {
    /// Area of positions of sweeps, metres.
    pub fn of(positions_m: &[[f64; 2]]) -> Self {
        let edges_m = [0, 1].map(|axis: usize| {
            let along = positions_m.iter().map(|position| position[axis]);
            along.clone().fold(f64::NEG_INFINITY, f64::max) - along.fold(f64::INFINITY, f64::min)
        });
        let edge_m = edges_m[0].max(edges_m[1]);
        let cell_m = CELL_M.max((edge_m / MOST_CELLS / CELL_M).ceil() * CELL_M);
        Self::counted(cell_m, positions_m.iter().map(|position| (*position, 1)))
    }

    /// Area of cells of this edge, metres, from places with their numbers of sweeps.
    fn counted(cell_m: f64, places: impl Iterator<Item = ([f64; 2], usize)>) -> Self {
        let mut counts: BTreeMap<[i64; 2], usize> = BTreeMap::new();
        for (place_m, sweeps) in places {
            // Floor, as coordinates may be negative: a cast alone rounds towards zero.
            let cell = place_m.map(|metres| (metres / cell_m).floor() as i64);
            let count = counts.entry(cell).or_default();
            *count = count.saturating_add(sweeps);
        }
        let cells = counts.into_iter().map(|(cell, sweeps)| DrivenCell {
            corner_m: cell.map(|k| k as f64 * cell_m),
            sweeps,
        });
        Self {
            cell_m,
            cells: cells.collect(),
        }
    }

    /// This area together with that of earlier drives, on the coarser of the two grids.
    pub fn merged(&self, earlier: &Self) -> Self {
        let cell_m = self.cell_m.max(earlier.cell_m);
        let places = [self, earlier].into_iter().flat_map(|area| {
            // By its middle, as grids need not have corners in common.
            let middle = move |metres: f64| metres + 0.5 * area.cell_m;
            let cells = area.cells.iter();
            cells.map(move |cell| (cell.corner_m.map(middle), cell.sweeps))
        });
        Self::counted(cell_m, places)
    }

    /// The area that a head states, if it states a valid one.
    pub fn of_head(head: &Weights) -> Option<Self> {
        let area: Self = head.metadata_json(DRIVEN_AREA_KEY).ok()?;
        area.check().is_ok().then_some(area)
    }

    /// Writes the area into the file of a head; returns the digest of the file.
    ///
    /// # Errors
    /// [`FileError`] when the file is missing, not a complete safetensors file or not writable.
    pub fn state_in(&self, head: &Path) -> Result<String, FileError> {
        let text = serde_json::to_string(self).map_err(|error| FileError::new(head, error))?;
        annotate(head, DRIVEN_AREA_KEY, &text)
    }

    /// Checks an area that was read.
    ///
    /// # Errors
    /// [`FieldError`] of the first value that is wrong.
    pub(super) fn check(&self) -> Result<(), FieldError> {
        within("cell_m", self.cell_m, 1.0, 1e5)?;
        let counts = self.cells.iter().map(|cell| cell.sweeps);
        let sweeps = counts.fold(0, usize::saturating_add);
        // So that sums of counts cannot overflow.
        within("cells.sweeps", sweeps, 1, 1 << 31)?;
        let mut corners_m = self.cells.iter().map(|cell| cell.corner_m);
        let unknown = corners_m.find(|corner_m| !corner_m.iter().all(|metres| metres.is_finite()));
        require(
            unknown.is_none(),
            "cells.corner_m",
            unknown,
            "must be finite",
        )
    }

    /// True if enough sweeps are around a position, metres: in its cell and the eight about it twice as many as in the
    /// median cell.
    pub fn covers(&self, position_m: [f64; 2]) -> bool {
        let around = self.cells.iter().filter(|cell| {
            let [x, y] = [0, 1].map(|axis| {
                // In cells from the south-west corner.
                (position_m[axis] - cell.corner_m[axis]) / self.cell_m
            });
            [x, y].iter().all(|cells| (-1.0..2.0).contains(cells))
        });
        let mut counts: Vec<usize> = self.cells.iter().map(|cell| cell.sweeps).collect();
        counts.sort_unstable();
        let sweeps: usize = around.map(|cell| cell.sweeps).sum();
        // A small place has all its sweeps around each of them.
        let median = counts.get(counts.len() / 2);
        median.is_some_and(|median| sweeps >= (LEAST_RATIO * median).min(counts.iter().sum()))
    }

    /// The area in one line.
    pub fn text(&self) -> String {
        let (cells, cell_m) = (self.cells.len(), self.cell_m);
        let [[west, east], [south, north]] = [0, 1].map(|axis: usize| {
            let corners_m = self.cells.iter().map(|cell| cell.corner_m[axis]);
            let low_m = corners_m.clone().fold(f64::INFINITY, f64::min);
            [low_m, corners_m.fold(low_m, f64::max) + cell_m]
        });
        format!(
            "{cells} cells of {cell_m:.0} m, x {west:.0} to {east:.0} m, y {south:.0} to {north:.0} m"
        )
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
            text.extend((west..=east).map(|x| if places.contains(&[x, y]) { '#' } else { '.' }));
            text.push('\n');
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_is_covered_where_drives_passed() {
        let east = (0..=10).map(|k| [f64::from(k) * 10.0, 30.0]);
        let area = DrivenArea::of(&east.chain([[90.0, -10.0]]).collect::<Vec<_>>());
        assert_eq!(area.picture(), "#####\n.....\n...#.\n");
        assert_eq!(area.text(), "6 cells of 25 m, x 0 to 125 m, y -25 to 50 m");
        let sweeps: usize = area.cells.iter().map(|cell| cell.sweeps).sum();
        assert_eq!((area.cell_m, sweeps), (25.0, 12));
        // Median: two sweeps in a cell. The cells of the road reach from y 25 to 50, x 0 to 125.
        let places = [[60.0, 74.0], [60.0, 76.0], [-17.0, 30.0], [90.0, -20.0]];
        let covered = [true, false, false, false];
        assert_eq!(places.map(|place| area.covers(place)), covered);
        assert!(
            DrivenArea::of(&[[1.0, 2.0]; 3]).covers([5.0, 0.0]),
            "one cell"
        );
        assert!(!DrivenArea::of(&[]).covers([0.0, 0.0]));
    }

    #[test]
    fn areas_are_merged_on_the_coarser_grid() {
        let [west, east] =
            [[0.0, 60.0], [60.0, 100.0]].map(|xs| DrivenArea::of(&xs.map(|x| [x, 30.0])));
        let both = west.merged(&east);
        assert_eq!((both.picture().as_str(), both.cell_m), ("#.#.#\n", 25.0));
        let sweeps = Vec::from_iter(both.cells.iter().map(|cell| cell.sweeps));
        assert_eq!(sweeps, [1, 2, 1]);
        let large = DrivenArea::of(&[[0.0, 0.0], [9_000.0, 0.0]]);
        let all = both.merged(&large);
        assert_eq!(all, large.merged(&both));
        // All of the road lies in the first cell of 150 m.
        assert_eq!(
            (all.cell_m, all.cells[0].sweeps, all.cells.len()),
            (150.0, 5, 2)
        );
    }

    #[test]
    fn cells_of_a_large_place_are_larger() {
        let area = DrivenArea::of(&[[0.0, 0.0], [9_000.0, 0.0]]);
        assert_eq!(area.cell_m, 150.0);
        area.check().unwrap();
        let mut endless = area.clone();
        endless.cells[0].corner_m[1] = f64::NAN;
        let error = endless.check().unwrap_err().to_string();
        assert!(
            error.contains("corner_m") && error.contains("NaN"),
            "{error}"
        );
        let error = DrivenArea::of(&[]).check().unwrap_err().to_string();
        assert!(error.contains("cells.sweeps"), "{error}");
        let mut crowded = area;
        crowded
            .cells
            .iter_mut()
            .for_each(|cell| cell.sweeps = usize::MAX);
        let error = crowded.check().unwrap_err().to_string();
        assert!(error.contains("cells.sweeps"), "{error}");
    }
}
