//! Bird's-eye-view feature maps and the lattice they lie on.

use serde::{Deserialize, Serialize};

/// The lattice of a BEV map in a LiDAR frame: where its first cell begins, how large cells are, how many there are.
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
    #[must_use]
    pub fn cells(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// The same area with cells `factor` times as large; partial cells at the upper edges count as whole ones.
    #[must_use]
    pub fn downsampled(&self, factor: u32) -> Self {
        Self {
            cell_m: self.cell_m * f64::from(factor),
            width: self.width.div_ceil(factor),
            height: self.height.div_ceil(factor),
            ..*self
        }
    }
}

/// A feature map: `[C, H, W]` `f32`, row-major, on `grid` in the frame of the CAV that made it.
#[derive(Debug, Clone, PartialEq)]
pub struct BevFeatures {
    /// The lattice.
    pub grid: BevGrid,
    /// Number of channels `C`.
    pub channels: u32,
    /// `C * H * W` values.
    pub values: Vec<f32>,
}
