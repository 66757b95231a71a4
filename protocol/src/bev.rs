//! Bird's-eye-view (BEV) feature maps and the grid of their cells.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::checks::{check_limit, check_size, check_within};
use crate::{Limits, WireError};

/// Bound of the edges of a grid, metres: far beyond any sensor.
const MAX_EDGE_M: f64 = 1e4;
/// Bounds of a cell's edge, metres.
const CELL_RANGE_M: (f64, f64) = (1e-3, 1e3);

/// BEV grid in a LiDAR frame: lower edges, cell size and number of cells.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct BevGrid {
    /// Lower edge of column 0, metres.
    pub x_min_m: f64,
    /// Lower edge of row 0, metres.
    pub y_min_m: f64,
    /// Edge of a cell, metres.
    pub cell_m: f64,
    /// Columns, along x.
    pub width: u32,
    /// Rows, along y.
    pub height: u32,
}

impl BevGrid {
    /// Number of cells.
    pub fn cells(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// The same area with cells `factor` times as large; partial cells at the upper edges count as whole cells.
    pub fn downsampled(&self, factor: u32) -> Self {
        Self {
            cell_m: self.cell_m * f64::from(factor),
            width: self.width.div_ceil(factor),
            height: self.height.div_ceil(factor),
            ..*self
        }
    }

    /// Checks a grid from outside.
    ///
    /// [`WireError::Value`] for an edge that is not a finite number of plausible size, [`WireError::Limit`] for more
    /// cells than permitted, [`WireError::Shape`] for none.
    pub fn check(&self, limits: &Limits) -> Result<(), WireError> {
        let (cell_min, cell_max) = CELL_RANGE_M;
        check_within("grid x_min_m", self.x_min_m, -MAX_EDGE_M, MAX_EDGE_M)?;
        check_within("grid y_min_m", self.y_min_m, -MAX_EDGE_M, MAX_EDGE_M)?;
        check_within("grid cell_m", self.cell_m, cell_min, cell_max)?;
        let cells = u64::from(self.width) * u64::from(self.height);
        // Cells are numbered in u32, whatever the limits permit.
        let max = limits.max_cells.min(u32::MAX.into());
        if cells == 0 {
            check_size("grid cells", cells, 1)?;
        }
        check_limit("grid cells", cells, max)
    }
}

impl fmt::Display for BevGrid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{} x {} cells of {} m from ({}, {}) m",
            self.width, self.height, self.cell_m, self.x_min_m, self.y_min_m
        )
    }
}

/// BEV feature map: `[C, H, W]` `f32`, row-major, on `grid` in the frame of the CAV that made it.
#[derive(Debug, Clone, PartialEq)]
pub struct BevFeatures {
    /// BEV grid.
    pub grid: BevGrid,
    /// Number of channels `C`.
    pub channels: u32,
    /// Channels of the feature map before the sender's learnt compressor, which the receiver's decoder restores;
    /// absent: not compressed.
    pub code_of: Option<u32>,
    /// `C * H * W` values.
    pub values: Vec<f32>,
}
