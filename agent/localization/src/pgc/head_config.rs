//! Configuration of a scene head.

use std::path::Path;

use perception::weights::FileError;
use protocol::config::{FieldError, require, within};
use serde::{Deserialize, Serialize};
use support::file_error::Result;

/// Largest number of values of a key grid.
const MAX_KEY_GRID: i64 = 64_000_000;
/// Largest reach of a refiner around a cell along each direction, corners.
const MAX_REACH: i64 = 16;
/// Largest number of parameters of a network, head or encoder: bounds the memory that a wrong number can take.
pub(super) const MAX_PARAMETERS: i64 = 256_000_000;

/// Configuration of the head of one scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneHeadConfig {
    /// Name of the scene, in model cards and messages.
    #[serde(rename = "town")]
    pub scene_name: String,
    /// SHA-256 of the encoder whose features it was trained on: of its file, or of the encoder inside a detector's.
    pub encoder_sha256: String,
    /// Channels of a cell.
    pub cell_channels: i64,
    /// Channels of a sweep.
    pub sweep_channels: i64,
    /// Clusters of sensor positions that sweeps are classified into.
    pub classes: i64,
    /// Clusters of world coordinates, the reference points of a cell's offset.
    pub centres: i64,
    /// Hidden channels.
    pub width: i64,
    /// Residual blocks of three layers.
    pub blocks: usize,
    /// Centre of the training positions, metres in the world: coordinates are relative to it.
    pub origin_m: [f64; 3],
    /// Largest number of cells of a sweep that are regressed.
    pub max_cells: usize,
    /// Pose refinement; `None` for none.
    pub refiner: Option<RefinerConfig>,
    /// Median number of points within the encoder's range in the sweeps that it was trained on; `None` where it was not
    /// counted. Clouds of another LiDAR have another number.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sweep_points: Option<usize>,
}

/// Configuration of the refiner of a head.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RefinerConfig {
    /// Channels of a cell that enter the refiner: those before the surroundings.
    pub local_channels: i64,
    /// South-west corner of the scene, metres relative to the head's origin.
    pub low_m: [f64; 2],
    /// North-east corner of the scene, metres relative to the head's origin.
    pub high_m: [f64; 2],
    /// Distance between corners of the key grid, metres.
    pub spacing_m: f64,
    /// Number of candidate corners to each side.
    pub reach: i64,
    /// Channels of a key.
    pub keys: i64,
    /// Hidden channels.
    pub width: i64,
}

impl RefinerConfig {
    /// Number of corners along x and y.
    pub fn corners(&self) -> [i64; 2] {
        std::array::from_fn(|axis| {
            let steps = ((self.high_m[axis] - self.low_m[axis]) / self.spacing_m).ceil() as i64;
            // At least one whole window: the refiner clamps windows onto the grid.
            (steps + 1).max(2 * self.reach + 1)
        })
    }

    /// The part of the key grid between two corners (metres relative to the origin), and the rows of the full grid that
    /// its rows are.
    pub fn cropped(&self, low_m: [f64; 2], high_m: [f64; 2]) -> (Self, Vec<i64>) {
        let whole = self.corners();
        let [low, high] = [low_m, high_m]
            .map(|place_m| [0, 1].map(|axis| (place_m[axis] - self.low_m[axis]) / self.spacing_m));
        let first = [0, 1].map(|axis| (low[axis].floor() as i64).clamp(0, whole[axis] - 1));
        let last =
            [0, 1].map(|axis| (high[axis].ceil() as i64).clamp(first[axis], whole[axis] - 1));
        let [low_m, high_m] = [first, last]
            .map(|steps| [0, 1].map(|axis| self.low_m[axis] + steps[axis] as f64 * self.spacing_m));
        let cropped = Self {
            low_m,
            // A little less than the last corner, so that rounding does not ask for one more.
            high_m: high_m.map(|high_m| high_m - 0.01 * self.spacing_m),
            ..self.clone()
        };
        let [columns, rows] = cropped.corners();
        let mut kept = Vec::new();
        for y in 0..rows {
            // A part smaller than a window has corners beyond the full grid: they repeat its last ones.
            let row = (first[1] + y).min(whole[1] - 1) * whole[0];
            kept.extend((0..columns).map(|x| row + (first[0] + x).min(whole[0] - 1)));
        }
        (cropped, kept)
    }

    /// Checks that a network can be built.
    ///
    /// # Errors
    /// [`FieldError`] of the first field that is wrong.
    pub fn validate(&self) -> Result<(), FieldError> {
        within("refiner.local_channels", self.local_channels, 1, 4096)?;
        within("refiner.keys", self.keys, 1, 4096)?;
        within("refiner.width", self.width, 1, 4096)?;
        // The size of the neighbourhood of every cell grows with its square.
        within("refiner.reach", self.reach, 1, MAX_REACH)?;
        for axis in 0..2 {
            let edge_m = self.high_m[axis] - self.low_m[axis];
            let is_edge = edge_m > 0.0 && edge_m < 1e5;
            let rule = "must be above low_m, less than 100 km away";
            require(is_edge, "refiner.high_m", self.high_m, rule)?;
        }
        within("refiner.spacing_m", self.spacing_m, 0.1, 100.0)?;
        let [columns, rows] = self.corners();
        // Checked before anything of this size is allocated: the file with these numbers may come from anyone.
        let values = columns.saturating_mul(rows).saturating_mul(self.keys);
        let field = format!("refiner: {columns} x {rows} corners of {} keys", self.keys);
        within(&field, values, 1, MAX_KEY_GRID)
    }
}

impl SceneHeadConfig {
    /// South-west and north-east corner of the scene, metres in the world; `None` without a refiner.
    pub fn corners_m(&self) -> Option<[[f64; 2]; 2]> {
        let refiner = self.refiner.as_ref()?;
        let world = |corner_m: [f64; 2]| [0, 1].map(|axis| self.origin_m[axis] + corner_m[axis]);
        Some([refiner.low_m, refiner.high_m].map(world))
    }

    /// Rejects the head of a file for an encoder that it was not trained with.
    ///
    /// # Errors
    /// [`FileError`] with both digests.
    pub fn check_encoder(&self, head: &Path, encoder: &Path, sha256: &str) -> Result<()> {
        let (expected, encoder) = (&self.encoder_sha256, encoder.display());
        if expected == sha256 {
            return Ok(());
        }
        let problem =
            format_args!("trained on encoder {expected}, but {encoder} is {sha256} (SHA-256)");
        Err(FileError::new(head, problem))
    }

    /// Checks that a network can be built.
    ///
    /// # Errors
    /// [`FieldError`] of the first field that is wrong.
    pub fn validate(&self) -> Result<(), FieldError> {
        for (field, size) in [
            ("cell_channels", self.cell_channels),
            ("sweep_channels", self.sweep_channels),
            ("classes", self.classes),
            ("centres", self.centres),
            ("width", self.width),
            ("blocks", self.blocks as i64),
            ("max_cells", self.max_cells as i64),
        ] {
            within(field, size, 1, 16_384)?;
        }
        let is_place = self.origin_m.iter().all(|axis| axis.is_finite());
        require(is_place, "origin_m", self.origin_m, "must be finite")?;
        let (width, blocks) = (self.width, self.blocks);
        let field = format!("width {width} with {blocks} blocks: parameters");
        within(&field, self.parameters(), 0, MAX_PARAMETERS)
    }

    /// Parameters of the regressing layers; those of the classifier are few in any case.
    fn parameters(&self) -> i64 {
        let blocks = self.blocks as i64 * 3 * self.width;
        (self.cell_channels + self.classes + blocks + self.centres + 4) * self.width
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_grid_too_large_for_memory_is_rejected_with_its_size() {
        let huge = RefinerConfig {
            local_channels: 4,
            low_m: [0.0; 2],
            high_m: [5e4; 2],
            spacing_m: 1.5,
            reach: 2,
            keys: 4096,
            width: 8,
        };
        let message = huge.validate().unwrap_err().to_string();
        assert!(
            message.contains("33335 x 33335") && message.contains("4096 keys"),
            "{message}"
        );
        let far = RefinerConfig {
            reach: 4096,
            high_m: [50.0; 2],
            keys: 4,
            ..huge
        };
        assert_eq!(
            far.validate().unwrap_err().to_string(),
            "refiner.reach is 4096: must be 1 to 16"
        );
    }

    #[test]
    fn a_head_too_large_for_memory_is_rejected_with_its_size() {
        let head = SceneHeadConfig {
            scene_name: "test".into(),
            encoder_sha256: String::new(),
            cell_channels: 448,
            sweep_channels: 256,
            classes: 150,
            centres: 1400,
            width: 448,
            blocks: 3,
            origin_m: [0.0; 3],
            max_cells: 1024,
            refiner: None,
            sweep_points: None,
        };
        assert_eq!(head.validate(), Ok(()));
        let message = SceneHeadConfig {
            width: 16_384,
            blocks: 16_384,
            ..head
        }
        .validate()
        .unwrap_err()
        .to_string();
        assert!(
            message.contains("width 16384") && message.contains("256000000"),
            "{message}"
        );
    }

    #[test]
    fn a_cropped_key_grid_keeps_the_positions_of_its_corners() {
        let whole = RefinerConfig {
            local_channels: 4,
            low_m: [-50.0, -40.0],
            high_m: [50.0, 40.0],
            spacing_m: 1.5,
            reach: 2,
            keys: 4,
            width: 8,
        };
        let [columns, _] = whole.corners();
        let (cropped, rows) = whole.cropped([-20.2, -11.0], [30.1, 25.0]);
        let [cropped_columns, cropped_rows] = cropped.corners();
        assert_eq!(rows.len() as i64, cropped_columns * cropped_rows);
        assert!(cropped.low_m[0] <= -20.2 && cropped.high_m[0] >= 30.0 && rows.len() < 1000);
        for (place, &row) in rows.iter().enumerate() {
            let (x, y) = (
                place as i64 % cropped_columns,
                place as i64 / cropped_columns,
            );
            for (axis, step, of_whole) in [(0, x, row % columns), (1, y, row / columns)] {
                let here = cropped.low_m[axis] + step as f64 * cropped.spacing_m;
                let there = whole.low_m[axis] + of_whole as f64 * whole.spacing_m;
                assert!((here - there).abs() < 1e-9, "{here} {there}");
            }
        }
    }
}
