//! Configuration of a scene encoder.

use protocol::config::{FieldError, require, within};
use serde::{Deserialize, Serialize};

use super::head_config::MAX_PARAMETERS;
use perception::sparse::KERNEL_VOLUME;

/// Largest number of residual groups, and of windows around a cell.
const MAX_ENTRIES: usize = 16;
/// Largest number of cells of the last level from the sensor to the edge: planes of features have four times its
/// square.
const MAX_PLANE_CELLS: f64 = 512.0;

/// Input features of a voxel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum VoxelInput {
    /// Mean of its points in the sensor frame, in units of 10 m: LightLoc's input.
    Coordinates,
    /// Mean of its points relative to its centre in voxels, height above the sensor in units of 10 m, and 1:
    /// independent of the position of the sensor.
    Offsets,
}

impl VoxelInput {
    /// Channels of a voxel.
    pub fn channels(self) -> i64 {
        match self {
            Self::Coordinates => 3,
            Self::Offsets => 5,
        }
    }
}

/// Configuration of a scene encoder.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneEncoderConfig {
    /// Name, in model cards and messages.
    pub name: String,
    /// Edge of a voxel, metres.
    pub voxel_m: f64,
    /// Points farther than this from the sensor in the plane are left out, metres.
    pub range_m: f64,
    /// Lowest and highest point, metres in the sensor frame.
    pub height_m: [f64; 2],
    /// Input features of a voxel.
    pub input: VoxelInput,
    /// Channels of the convolutions: the first at stride 1, every other at stride 2.
    pub widths: Vec<i64>,
    /// Channels of the residual groups on the last level.
    pub residual_widths: Vec<i64>,
    /// True if the level before the last has a residual group of its own, and its sites are the cells, with features of
    /// both.
    pub fine_cells: bool,
    /// Edges of the square windows whose mean feature describes a cell's surroundings, metres.
    pub context_m: Vec<f64>,
}

impl SceneEncoderConfig {
    /// LightLoc's encoder, its channels times `width`: one cell per 8x8x8 voxels of 0.25 m.
    pub fn full(width: f64) -> Self {
        Self {
            name: "full".into(),
            voxel_m: 0.25,
            range_m: 100.0,
            height_m: [-6.0, 40.0],
            input: VoxelInput::Coordinates,
            widths: scaled([32, 64, 128, 256], width),
            residual_widths: scaled([256, 512], width),
            fine_cells: false,
            context_m: Vec::new(),
        }
    }

    /// For one core, live: half the channels, voxels of 0.5 m, cells of 2 m beside those of 4 m, and in place of the
    /// second group the mean over the surroundings.
    pub fn lean() -> Self {
        Self {
            name: "lean".into(),
            voxel_m: 0.5,
            range_m: 64.0,
            height_m: [-6.0, 30.0],
            input: VoxelInput::Offsets,
            widths: vec![16, 32, 64, 128],
            residual_widths: vec![128],
            fine_cells: true,
            context_m: vec![20.0, 60.0],
        }
    }

    /// A configuration by its name: `lean` or `full`.
    pub fn preset(name: &str) -> Option<Self> {
        match name {
            "lean" => Some(Self::lean()),
            "full" => Some(Self::full(1.0)),
            _ => None,
        }
    }

    /// Number of levels, the voxels' own included.
    pub fn levels(&self) -> usize {
        self.widths.len()
    }

    /// Edge of the coarse cells of the last level, metres.
    pub(crate) fn coarse_cell_m(&self) -> f64 {
        self.voxel_m * f64::from(1 << (self.levels() - 1))
    }

    /// Channels of the last level.
    pub(crate) fn coarse_channels(&self) -> i64 {
        let last = self.residual_widths.last().or(self.widths.last());
        last.copied().unwrap_or(0)
    }

    /// Channels of a cell before its surroundings are added.
    pub fn local_channels(&self) -> i64 {
        let fine = self.fine_cells.then(|| self.widths[self.levels() - 2]);
        fine.unwrap_or(0) + self.coarse_channels()
    }

    /// Channels of a cell.
    pub fn cell_channels(&self) -> i64 {
        self.local_channels() + self.context_m.len() as i64 * self.coarse_channels()
    }

    /// Channels of a whole sweep: mean and maximum over its cells.
    pub fn sweep_channels(&self) -> i64 {
        2 * self.coarse_channels()
    }

    /// Checks that a network can be built.
    ///
    /// # Errors
    /// [`FieldError`] of the first field that is wrong.
    pub fn validate(&self) -> Result<(), FieldError> {
        let lengths = [("voxel_m", self.voxel_m), ("range_m", self.range_m)];
        let windows = self.context_m.iter().map(|&edge| ("context_m", edge));
        for (field, metres) in lengths.into_iter().chain(windows) {
            let is_length = metres.is_finite() && metres > 0.0;
            require(is_length, field, metres, "must be above 0")?;
        }
        let [low, high] = self.height_m;
        let rises = low.is_finite() && high.is_finite() && low < high;
        require(rises, "height_m", self.height_m, "must rise")?;
        within("number of widths", self.levels(), 2, 6)?;
        let groups = self.residual_widths.len();
        within("number of residual_widths", groups, 0, MAX_ENTRIES)?;
        within("number of context_m", self.context_m.len(), 0, MAX_ENTRIES)?;
        for &channels in self.widths.iter().chain(&self.residual_widths) {
            within("widths and residual_widths", channels, 1, 4096)?;
        }
        let most_m = (self.voxel_m * 10_000.0).min(self.coarse_cell_m() * MAX_PLANE_CELLS);
        within("range_m", self.range_m, 0.0, most_m)?;
        // Checked before anything of this size is allocated: the file with these numbers may come from anyone.
        let field = "parameters by widths and residual_widths";
        within(field, self.parameters(), 0, MAX_PARAMETERS)
    }

    /// Parameters of the 3x3x3 convolutions, nearly all there are.
    fn parameters(&self) -> i64 {
        let before_last = self.widths[self.levels() - 2];
        let mut products = self.input.channels() * self.widths[0];
        let between = self.widths.windows(2).map(|pair| pair[0] * pair[1]);
        products += between.sum::<i64>();
        // A residual group has two: from its inputs to its outputs, and between its outputs.
        if self.fine_cells {
            products += 2 * before_last * before_last;
        }
        let mut channels = self.widths[self.levels() - 1];
        for &width in &self.residual_widths {
            products += (channels + width) * width;
            channels = width;
        }
        products * KERNEL_VOLUME as i64
    }
}

fn scaled<const N: usize>(channels: [i64; N], factor: f64) -> Vec<i64> {
    let scaled = channels.map(|channels| ((channels as f64 * factor).round() as i64).max(1));
    scaled.into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_match_their_names() {
        let full = SceneEncoderConfig::full(1.0);
        assert_eq!(
            (
                full.coarse_cell_m(),
                full.cell_channels(),
                full.sweep_channels()
            ),
            (2.0, 512, 1024)
        );
        let lean = SceneEncoderConfig::lean();
        assert_eq!(lean.coarse_cell_m(), 4.0);
        assert_eq!((lean.local_channels(), lean.cell_channels()), (192, 448));
        assert!(full.validate().is_ok() && lean.validate().is_ok());
        assert_eq!(SceneEncoderConfig::preset("huge"), None);
    }

    fn is_refused_by_name(config: SceneEncoderConfig, field: &str) -> bool {
        config.validate().unwrap_err().to_string().contains(field)
    }

    #[test]
    fn absurd_configurations_are_rejected_by_name() {
        assert!(is_refused_by_name(
            SceneEncoderConfig {
                voxel_m: 0.0,
                ..SceneEncoderConfig::lean()
            },
            "voxel_m"
        ));
        assert!(is_refused_by_name(
            SceneEncoderConfig {
                voxel_m: 1e-6,
                ..SceneEncoderConfig::lean()
            },
            "range_m"
        ));
        assert!(is_refused_by_name(
            SceneEncoderConfig {
                widths: vec![4],
                ..SceneEncoderConfig::lean()
            },
            "widths"
        ));
        assert!(is_refused_by_name(
            SceneEncoderConfig {
                height_m: [2.0, 1.0],
                ..SceneEncoderConfig::lean()
            },
            "height_m"
        ));
        assert!(is_refused_by_name(
            SceneEncoderConfig {
                context_m: vec![9.0; 17],
                ..SceneEncoderConfig::lean()
            },
            "context_m"
        ));
        for residual_widths in [vec![1; 17], vec![4096; 9]] {
            assert!(is_refused_by_name(
                SceneEncoderConfig {
                    residual_widths,
                    ..SceneEncoderConfig::lean()
                },
                "residual_widths"
            ));
        }
    }
}
