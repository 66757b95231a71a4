//! Configuration of a detector: area, pillars, backbone, head.

use protocol::BevGrid;
use protocol::config::{FieldError, require, within};
use serde::{Deserialize, Serialize};
use support::file_error::FileError;

/// Number of values that describe a box relative to its anchor: x, y, z, h, w, l, yaw.
pub const BOX_CODE: i64 = 7;

/// Reason why a [`DetectorConfig`] is invalid.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ConfigError {
    /// A setting is out of range, or contradicts another.
    #[error("detector configuration: {0}")]
    Value(#[from] FieldError),
    /// A module's file cannot be read, or the module not loaded.
    #[error(transparent)]
    File(#[from] FileError),
}

/// Reduction of the concatenated backbone levels to the transmitted feature map.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum ShrinkConfig {
    /// OpenCOOD's `DownsampleConv`: 3x3 convolution with `stride`, ReLU, 3x3 convolution, ReLU, both with bias.
    DoubleConv {
        /// Output channels.
        channels: i64,
        /// Stride of the first convolution.
        stride: i64,
    },
    /// 1x1 convolution without bias, batch norm, ReLU: four times cheaper per cell and channel than 3x3.
    Pointwise {
        /// Output channels.
        channels: i64,
    },
}

/// Kind of the backbone's blocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BlockKind {
    /// PointPillars: a strided convolution and `layer_nums` more.
    #[default]
    Plain,
    /// CoAlign: `layer_nums` residual blocks, the first strided.
    Residual,
}

/// Side towards which y grows in the frame that a network was trained in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum YAxis {
    /// Left, as everywhere in this program.
    #[default]
    Left,
    /// Right, as in CARLA and the public reference codes: weights from there belong to a mirrored frame. Clouds are
    /// mirrored before such a network and boxes behind it; its feature maps are transmitted mirrored, for others of the
    /// same network.
    Right,
}

/// Prior boxes at every cell of the head.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AnchorConfig {
    /// Length, width and height, metres.
    pub size_lwh_m: [f64; 3],
    /// Height of the centre above the LiDAR, metres.
    pub center_z_m: f64,
    /// Headings, degrees, in the order of the head's channels.
    pub yaws_deg: Vec<f64>,
}

/// Configuration of a PointPillars detector, from its area to its head.
///
/// It is stored as JSON in the metadata of a weights file, so that the file is self-contained.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DetectorConfig {
    /// Name of the configuration, in reports.
    pub name: String,
    /// x, y, z of the lower corner, then of the upper, metres in the LiDAR frame.
    pub lidar_range_m: [f64; 6],
    /// Edges of a pillar along x, y, z, metres.
    pub voxel_size_m: [f64; 3],
    /// Largest number of points of a pillar; the first ones are kept.
    pub max_points_per_pillar: usize,
    /// Largest number of pillars of a sweep; the first ones are kept.
    pub max_pillars: usize,
    /// Channels of the pillar encoder.
    pub pillar_channels: i64,
    /// Kind of the blocks.
    #[serde(default)]
    pub blocks: BlockKind,
    /// Side towards which y grows; a mirrored network has an area as wide to the left as to the right.
    #[serde(default)]
    pub y_axis: YAxis,
    /// Layers of each block after its strided one; for residual blocks: their number.
    pub layer_nums: Vec<usize>,
    /// Stride of each block.
    pub layer_strides: Vec<i64>,
    /// Channels of each block.
    pub num_filters: Vec<i64>,
    /// Up-sampling factor of each block before the concatenation.
    pub upsample_strides: Vec<i64>,
    /// Channels of each up-sampled block.
    pub num_upsample_filters: Vec<i64>,
    /// Reduction of the concatenated map; absent: it is transmitted as it is.
    pub shrink: Option<ShrinkConfig>,
    /// Ratio of channels to transmitted channels of the learnt compressor; absent: none.
    pub compress_ratio: Option<i64>,
    /// Anchors of the head.
    pub anchors: AnchorConfig,
    /// Box of the vehicle's own body that is cut out: x and y of the lower, then of the upper corner, metres.
    pub own_body_m: Option<[f64; 4]>,
}

impl DetectorConfig {
    /// OpenCOOD's configuration: x +-140.8 m, y +-38.4 m, a 256 x 48 x 176 feature map at 1.6 m.
    pub fn full() -> Self {
        Self {
            name: "full".into(),
            lidar_range_m: [-140.8, -38.4, -3.0, 140.8, 38.4, 1.0],
            voxel_size_m: [0.4, 0.4, 4.0],
            max_points_per_pillar: 32,
            max_pillars: 70_000,
            pillar_channels: 64,
            blocks: BlockKind::Plain,
            y_axis: YAxis::Left,
            layer_nums: vec![3, 5, 8],
            layer_strides: vec![2, 2, 2],
            num_filters: vec![64, 128, 256],
            upsample_strides: vec![1, 2, 4],
            num_upsample_filters: vec![128; 3],
            shrink: Some(ShrinkConfig::DoubleConv {
                channels: 256,
                stride: 2,
            }),
            compress_ratio: None,
            anchors: AnchorConfig {
                size_lwh_m: [3.9, 1.6, 1.56],
                center_z_m: -1.0,
                yaws_deg: vec![0.0, 90.0],
            },
            own_body_m: Some(OWN_BODY_M),
        }
    }

    /// For two cores and live traffic: x +-51.2 m, y +-38.4 m, a 64 x 96 x 128 feature map at 0.8 m.
    pub fn lean() -> Self {
        Self {
            name: "lean".into(),
            lidar_range_m: [-51.2, -38.4, -3.0, 51.2, 38.4, 1.0],
            max_pillars: 20_000,
            pillar_channels: 32,
            layer_nums: vec![2, 3, 3],
            num_filters: vec![32, 64, 128],
            num_upsample_filters: vec![64; 3],
            shrink: Some(ShrinkConfig::Pointwise { channels: 64 }),
            ..Self::full()
        }
    }

    /// The preset of that name: `full` or `lean`.
    pub fn preset(name: &str) -> Option<Self> {
        match name {
            "full" => Some(Self::full()),
            "lean" => Some(Self::lean()),
            _ => None,
        }
    }

    /// Number of pillars along x, y, z.
    pub fn pillar_grid(&self) -> [usize; 3] {
        std::array::from_fn(|axis| {
            let extent = self.lidar_range_m[axis + 3] - self.lidar_range_m[axis];
            // Rounded and not truncated: 76.8 / 0.4 is 191.99999999999997 in floating point.
            (extent / self.voxel_size_m[axis]).round() as usize
        })
    }

    /// Pillars per cell of the transmitted feature map, along one axis.
    pub(crate) fn feature_stride(&self) -> i64 {
        let shrink = match self.shrink {
            Some(ShrinkConfig::DoubleConv { stride, .. }) => stride,
            Some(ShrinkConfig::Pointwise { .. }) | None => 1,
        };
        // All levels are up-sampled to one BEV grid, so the first stands for all.
        let [down, up] = [&self.layer_strides, &self.upsample_strides]
            .map(|strides| strides.first().copied().unwrap_or(1));
        down / up * shrink
    }

    /// Channels of the concatenated backbone levels.
    pub fn backbone_channels(&self) -> i64 {
        self.num_upsample_filters.iter().sum()
    }

    /// Channels of the fused feature map and of the head's input.
    pub fn feature_channels(&self) -> i64 {
        match self.shrink {
            Some(
                ShrinkConfig::DoubleConv { channels, .. } | ShrinkConfig::Pointwise { channels },
            ) => channels,
            None => self.backbone_channels(),
        }
    }

    /// Channels of the transmitted feature map: of the code, if there is a compressor.
    pub fn sent_channels(&self) -> i64 {
        let channels = self.feature_channels();
        self.compress_ratio
            .map_or(channels, |ratio: i64| (channels / ratio).max(1))
    }

    /// BEV grid of the transmitted feature map.
    pub fn feature_grid(&self) -> BevGrid {
        let pillars = self.pillar_grid();
        let [width, height, _] = pillars.map(|count| u32::try_from(count).unwrap_or(u32::MAX));
        let pillars = BevGrid {
            x_min_m: self.lidar_range_m[0],
            y_min_m: self.lidar_range_m[1],
            cell_m: self.voxel_size_m[0],
            width,
            height,
        };
        pillars.downsampled(u32::try_from(self.feature_stride()).unwrap_or(1).max(1))
    }

    /// Checks that a network can be built and that all levels have one BEV grid.
    ///
    /// # Errors
    /// [`ConfigError`] names the field, its value and what it must be.
    pub fn validate(&self) -> Result<(), ConfigError> {
        self.check_area()?;
        // Before the sizes, whose check indexes these lists.
        self.check_levels()?;
        let points = i64::try_from(self.max_points_per_pillar).unwrap_or(0);
        for (field, value) in [
            ("max_points_per_pillar", points),
            ("pillar_channels", self.pillar_channels),
            ("shrink channels", self.feature_channels()),
            ("number of anchor yaws", self.anchors.yaws_deg.len() as i64),
            ("compress_ratio", self.compress_ratio.unwrap_or(1)),
        ] {
            within(field, value, 1, 4096)?;
        }
        if let Some(ShrinkConfig::DoubleConv { stride, .. }) = self.shrink {
            within("shrink stride", stride, 1, 4096)?;
        }
        within("max_pillars", self.max_pillars, 1, MAX_CELLS)?;
        require_positive("anchors.size_lwh_m", self.anchors.size_lwh_m)?;
        Ok(self.check_sizes()?)
    }

    /// Checked before anything of this size is allocated: the file with these numbers may come from anyone.
    fn check_sizes(&self) -> Result<(), FieldError> {
        let [x, y, _] = self.pillar_grid().map(|count| count as i64);
        let canvas = x * y * self.pillar_channels;
        within("pillar grid times pillar_channels", canvas, 0, MAX_VALUES)?;
        let step = self.layer_strides[0] / self.upsample_strides[0];
        let (features, head) = (self.feature_channels(), self.head_channels());
        let layers = [self.backbone_channels(), features, head];
        let widest = self.num_filters.iter().chain(&layers).max();
        let map = (x / step) * (y / step) * widest.copied().unwrap_or(0);
        let field = "cells of a feature map times the largest of num_filters, num_upsample_filters, shrink and anchors";
        within(field, map, 0, MAX_VALUES)?;
        let field = "layer_nums, num_filters, upsample_strides and shrink: number of parameters";
        within(field, self.parameters(), 0, MAX_PARAMETERS)
    }

    /// Channels of the head's output.
    fn head_channels(&self) -> i64 {
        (1 + BOX_CODE) * self.anchors.yaws_deg.len() as i64
    }

    /// Parameters of the convolutions, nearly all there are.
    fn parameters(&self) -> i64 {
        let mut input = self.pillar_channels;
        let mut count = 0;
        for (level, &filters) in self.num_filters.iter().enumerate() {
            let layers = self.layer_nums[level] as i64;
            let more = match self.blocks {
                BlockKind::Residual => 2 * layers - 1,
                BlockKind::Plain => layers,
            };
            // The first convolution of a level reads `input` channels, the others `filters`.
            count += 9 * filters * (input + more * filters);
            let edge = self.upsample_strides[level];
            count += edge.pow(2) * filters * self.num_upsample_filters[level];
            input = filters;
        }
        let channels = self.feature_channels();
        count += match self.shrink {
            Some(ShrinkConfig::DoubleConv { .. }) => {
                9 * channels * (self.backbone_channels() + channels)
            }
            Some(ShrinkConfig::Pointwise { .. }) => channels * self.backbone_channels(),
            None => 0,
        };
        if self.compress_ratio.is_some() {
            count += 9 * channels * (2 * self.sent_channels() + channels);
        }
        count + channels * self.head_channels()
    }

    fn check_area(&self) -> Result<(), FieldError> {
        let range = self.lidar_range_m;
        let is_area = range.iter().all(|edge| edge.is_finite())
            && (0..3).all(|axis| range[axis] < range[axis + 3]);
        let rule = "must be finite, lower below upper";
        require(is_area, "lidar_range_m", range, rule)?;
        let voxel_m = self.voxel_size_m;
        require_positive("voxel_size_m", voxel_m)?;
        // `BevGrid` has one cell size for both axes.
        let is_square = (voxel_m[0] - voxel_m[1]).abs() <= 1e-9;
        let rule = "must be equal along x and y";
        require(is_square, "voxel_size_m", voxel_m, rule)?;
        let is_even = self.y_axis == YAxis::Left || (range[1] + range[4]).abs() <= 1e-9;
        let rule = "must be as wide to the left as to the right if y_axis is right";
        require(is_even, "lidar_range_m", range, rule)?;
        let own @ [x_low, y_low, x_high, y_high] = self.own_body_m.unwrap_or(OWN_BODY_M);
        let is_box = x_low < x_high && y_low < y_high;
        require(is_box, "own_body_m", own, "must be lower below upper")?;
        let [x, y, z] = self.pillar_grid();
        within("pillar layers along z", z, 1, 1)?;
        // A wrong range has huge counts, whose product must not overflow.
        let cells = x.saturating_mul(y);
        within("cells of the pillar grid", cells, 1, MAX_CELLS)
    }

    fn check_levels(&self) -> Result<(), FieldError> {
        let levels = self.layer_nums.len();
        within("number of layer_nums", levels, 1, 8)?;
        let lists: [(&'static str, &[i64]); 4] = [
            ("layer_strides", &self.layer_strides),
            ("num_filters", &self.num_filters),
            ("upsample_strides", &self.upsample_strides),
            ("num_upsample_filters", &self.num_upsample_filters),
        ];
        for (field, list) in lists {
            let fits = list.len() == levels && list.iter().all(|value| (1..=4096).contains(value));
            let rule = format!("must be {levels} numbers, as layer_nums is, of 1 to 4096");
            require(fits, field, list, rule)?;
        }
        let fewest = usize::from(self.blocks == BlockKind::Residual);
        let layers = &self.layer_nums;
        let fits = layers.iter().all(|layers| (fewest..=64).contains(layers));
        let rule = "must be at most 64 each, residual blocks at least 1";
        require(fits, "layer_nums", layers, rule)?;
        self.check_strides()
    }

    /// Every level must be up-sampled to the same BEV grid, without a remainder.
    fn check_strides(&self) -> Result<(), FieldError> {
        let mut down = 1;
        for (stride, up) in self.layer_strides.iter().zip(&self.upsample_strides) {
            // A level that passes has `down` at most 4096 * 4096, so the next product does not overflow.
            down *= stride;
            let fits =
                down % up == 0 && down / up == self.layer_strides[0] / self.upsample_strides[0];
            let rule = "must bring all levels to one BEV grid";
            require(fits, "upsample_strides", &self.upsample_strides, rule)?;
        }
        let [x, y, _] = self.pillar_grid();
        let down = usize::try_from(down).unwrap_or(usize::MAX);
        let fits = x % down == 0 && y % down == 0;
        let rule = "must be a multiple of the product of layer_strides";
        require(fits, "pillar grid", [x, y], rule)
    }
}

/// Refuses sizes that are not all finite and above zero.
fn require_positive(field: &str, sizes: [f64; 3]) -> Result<(), FieldError> {
    let is_size = sizes.iter().all(|size| size.is_finite() && *size > 0.0);
    require(is_size, field, sizes, "must be positive")
}

/// Box of the car under the LiDAR, as in OpenCOOD: x and y of the lower and the upper corner, metres.
pub const OWN_BODY_M: [f64; 4] = [-1.95, -1.1, 2.95, 1.1];

/// Largest number of cells, more than any map in use has; bounds the memory that a wrong number can take.
const MAX_CELLS: usize = 1 << 24;
/// Largest number of values of a map, for the same reason: 1 GiB.
const MAX_VALUES: i64 = 1 << 28;
/// Largest number of parameters of a network, for the same reason: nearly 1 GiB.
const MAX_PARAMETERS: i64 = 256_000_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_have_the_documented_maps() {
        let full = DetectorConfig::full();
        full.validate().unwrap();
        let grid = full.feature_grid();
        assert_eq!(
            (
                full.feature_channels(),
                grid.height,
                grid.width,
                grid.cell_m
            ),
            (256, 48, 176, 1.6)
        );
        let lean = DetectorConfig::lean();
        lean.validate().unwrap();
        let grid = lean.feature_grid();
        assert_eq!(
            (
                lean.feature_channels(),
                grid.height,
                grid.width,
                grid.cell_m
            ),
            (64, 96, 128, 0.8)
        );
        assert_eq!(
            (lean.pillar_grid(), lean.sent_channels()),
            ([256, 192, 1], 64)
        );
        for (ratio, sent_channels) in [(1, 64), (32, 2), (100, 1)] {
            let compressed = DetectorConfig {
                compress_ratio: Some(ratio),
                ..DetectorConfig::lean()
            };
            assert_eq!(compressed.sent_channels(), sent_channels);
            assert_eq!(
                compressed.feature_channels(),
                64,
                "the receiver has the full number of channels"
            );
        }
    }

    #[test]
    fn json_round_trip_keeps_everything_and_rejects_misspelt_fields() {
        let full = DetectorConfig::full();
        let mut json = serde_json::to_value(&full).unwrap();
        assert_eq!(
            serde_json::from_value::<DetectorConfig>(json.clone()).unwrap(),
            full
        );
        json["max_pilars"] = 7.into();
        assert!(
            serde_json::from_value::<DetectorConfig>(json)
                .unwrap_err()
                .to_string()
                .contains("max_pilars")
        );
    }

    fn assert_refused(config: &DetectorConfig, field: &str, value: &str) {
        let message = config.validate().unwrap_err().to_string();
        assert!(
            message.contains(field) && message.contains(value),
            "{message}"
        );
    }

    #[test]
    fn sizes_beyond_memory_are_rejected_before_allocation() {
        let wide = DetectorConfig {
            lidar_range_m: [-819.2, -819.2, -3.0, 819.2, 819.2, 1.0],
            pillar_channels: 8,
            ..DetectorConfig::lean()
        };
        assert_refused(
            &DetectorConfig {
                pillar_channels: 4096,
                ..wide.clone()
            },
            "pillar_channels",
            "68719476736",
        );
        assert_refused(
            &DetectorConfig {
                num_filters: vec![4096; 3],
                ..wide
            },
            "num_filters",
            "17179869184",
        );
        assert_refused(
            &DetectorConfig {
                layer_nums: vec![64; 3],
                num_filters: vec![1024; 3],
                ..DetectorConfig::lean()
            },
            "layer_nums",
            "256000000",
        );
        let ratio = DetectorConfig {
            shrink: Some(ShrinkConfig::Pointwise { channels: 4096 }),
            compress_ratio: Some(1),
            ..DetectorConfig::lean()
        };
        assert_refused(&ratio, "number of parameters", "256000000");
    }

    #[test]
    fn an_own_body_whose_edges_are_swapped_is_refused() {
        let [x_low, y_low, x_high, y_high] = OWN_BODY_M;
        let swapped = DetectorConfig {
            own_body_m: Some([x_high, y_low, x_low, y_high]),
            ..DetectorConfig::lean()
        };
        assert_refused(&swapped, "own_body_m", "[2.95, -1.1, -1.95, 1.1]");
        let none = DetectorConfig {
            own_body_m: None,
            ..DetectorConfig::lean()
        };
        none.validate().unwrap();
    }

    #[test]
    fn rejects_levels_of_different_grids() {
        let mut config = DetectorConfig::lean();
        config.upsample_strides = vec![1, 2, 2];
        let message = config.validate().unwrap_err().to_string();
        assert!(
            message.contains("upsample_strides") && message.contains("[1, 2, 2]"),
            "{message}"
        );
        config.upsample_strides.pop();
        let message = config.validate().unwrap_err().to_string();
        assert!(
            message.contains("upsample_strides is [1, 2]: must be 3"),
            "{message}"
        );
        let mut config = DetectorConfig::lean();
        config.lidar_range_m[3] = f64::NAN;
        assert!(config.validate().is_err());
    }
}
