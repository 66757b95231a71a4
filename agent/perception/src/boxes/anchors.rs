//! Anchors: prior boxes of the head.

use protocol::Box3d;

use crate::model_config::DetectorConfig;

/// Anchors of a head: a regular grid with the same boxes at every point.
///
/// Anchor `a` of row `r` and column `c` has the index `(r * W + c) * A + a`: the order H, W, anchor of the reference.
#[derive(Debug, Clone, PartialEq)]
pub struct Anchors {
    /// Columns of the grid, metres.
    pub x_m: Vec<f64>,
    /// Rows of the grid, metres.
    pub y_m: Vec<f64>,
    /// Centre height, metres.
    pub z_m: f64,
    /// Length, width and height, metres.
    pub size_lwh_m: [f64; 3],
    /// Headings, radians.
    pub yaws_rad: Vec<f64>,
}

impl Anchors {
    /// The anchors of a detector, each cell of whose head covers a stride of pillars along an axis.
    ///
    /// As in the reference they are evenly spaced from one pillar inside the lower edge to one inside the upper. For
    /// stride 2 these are the centres of the cells; for stride 4 they lie 1.6046 m apart on cells of 1.6 m. Trained
    /// weights depend on it, so it is kept.
    pub fn for_detector(config: &DetectorConfig) -> Self {
        let stride = usize::try_from(config.feature_stride()).unwrap_or(1).max(1);
        let (grid, anchors) = (config.pillar_grid(), &config.anchors);
        let [x_m, y_m] = [0, 1].map(|axis: usize| {
            let low = config.lidar_range_m[axis] + config.voxel_size_m[axis];
            let high = config.lidar_range_m[axis + 3] - config.voxel_size_m[axis];
            linspace(low, high, grid[axis] / stride)
        });
        let yaws_deg = anchors.yaws_deg.iter();
        Self {
            x_m,
            y_m,
            z_m: anchors.center_z_m,
            size_lwh_m: anchors.size_lwh_m,
            yaws_rad: yaws_deg.map(|yaw| yaw.to_radians()).collect(),
        }
    }

    /// Number of anchors.
    pub fn len(&self) -> usize {
        self.x_m.len() * self.y_m.len() * self.yaws_rad.len()
    }

    /// True if there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The anchor with this index as a box.
    ///
    /// # Panics
    /// When `index` is not below [`Self::len`].
    pub fn box_at(&self, index: usize) -> Box3d {
        let (cell, anchor) = (index / self.yaws_rad.len(), index % self.yaws_rad.len());
        let (row, column) = (cell / self.x_m.len(), cell % self.x_m.len());
        Box3d {
            center_m: [self.x_m[column], self.y_m[row], self.z_m],
            size_m: self.size_lwh_m,
            heading_rad: self.yaws_rad[anchor],
        }
    }
}

/// `count` numbers from `low` to `high`, both included.
fn linspace(low: f64, high: f64, count: usize) -> Vec<f64> {
    let step = (high - low) / count.saturating_sub(1).max(1) as f64;
    let mut numbers: Vec<f64> = (0..count).map(|index| low + step * index as f64).collect();
    if let [_, .., last] = numbers.as_mut_slice() {
        *last = high;
    }
    numbers
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn anchors_of_stride_two_are_the_centres_of_the_cells() {
        let config = DetectorConfig::lean();
        let (anchors, grid) = (Anchors::for_detector(&config), config.feature_grid());
        assert_eq!(
            (anchors.x_m.len(), anchors.y_m.len()),
            (grid.width as usize, grid.height as usize)
        );
        for (column, x) in anchors.x_m.iter().enumerate() {
            assert!((x - (grid.x_min_m + (column as f64 + 0.5) * grid.cell_m)).abs() < 1e-9);
        }
    }

    #[test]
    fn the_anchor_runs_fastest_then_the_column() {
        let anchors = Anchors::for_detector(&DetectorConfig::lean());
        let [first, second, third] = [0, 1, 2].map(|index| anchors.box_at(index));
        assert_eq!(second.center_m[..2], first.center_m[..2]);
        assert!((second.heading_rad - std::f64::consts::FRAC_PI_2).abs() < 1e-12);
        assert!((third.center_m[0] - anchors.x_m[1]).abs() < 1e-12);
        assert_eq!(anchors.len(), 96 * 128 * 2);
    }
}
