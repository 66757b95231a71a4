//! Configuration of a DiffLoc network: sizes, and the scene that it was trained on.

use protocol::config::{FieldError, require, within};
use serde::{Deserialize, Serialize};

use super::range_image::RangeImageConfig;
use crate::baselines::regressed_pose::require_scale;

/// Sizes of the network, and the normalisation of poses.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DiffLocConfig {
    /// Name of the scene.
    pub scene_name: String,
    /// Mean of the training positions, metres in the world.
    pub origin_m: [f64; 3],
    /// Standard deviation of the training positions, metres.
    pub scale_m: [f64; 3],
    /// Range image of a sweep.
    pub image: RangeImageConfig,
    /// Rows and columns of the image behind one token.
    pub patch: [i64; 2],
    /// Channels of the three blocks at the image's resolution, and of the last one.
    pub stem: [i64; 2],
    /// Channels of a token.
    pub width: i64,
    /// Attention heads.
    pub heads: i64,
    /// Layers of the transformer over the tokens of a sweep.
    pub layers: usize,
    /// Share of samples for which the last of these layers is skipped in training; falls to 0 at the first.
    pub drop_path: f64,
    /// Channels of the denoiser.
    pub denoiser_width: i64,
    /// Layers of the denoiser.
    pub denoiser_layers: usize,
    /// Sweeps of a window in training.
    pub frames: i64,
}

impl DiffLocConfig {
    /// The small network: 16 x 256 images, 256 tokens of 128 channels.
    pub fn small() -> Self {
        Self {
            scene_name: "scene".into(),
            origin_m: [0.0; 3],
            scale_m: [1.0; 3],
            image: RangeImageConfig::default(),
            patch: [2, 8],
            stem: [16, 32],
            width: 128,
            heads: 2,
            layers: 4,
            drop_path: 0.1,
            denoiser_width: 192,
            denoiser_layers: 3,
            frames: 3,
        }
    }

    /// Number of tokens of a sweep.
    pub fn tokens(&self) -> i64 {
        (self.image.rows as i64 / self.patch[0].max(1))
            * (self.image.columns as i64 / self.patch[1].max(1))
    }

    /// Checks sizes that come from a file.
    ///
    /// # Errors
    /// [`FieldError`] of the first field that is wrong.
    pub fn validate(&self) -> Result<(), FieldError> {
        let RangeImageConfig {
            rows,
            columns,
            elevations_deg,
            ..
        } = self.image;
        within("image.rows", rows, 1, 4096)?;
        within("image.columns", columns, 1, 4096)?;
        let [low, high] = elevations_deg;
        let rises = -90.0 <= low && low < high && high <= 90.0;
        let rule = "must rise, from -90 to 90";
        require(rises, "image.elevations_deg", elevations_deg, rule)?;
        let [height, width] = self.patch;
        let divides =
            height >= 1 && width >= 1 && rows as i64 % height == 0 && columns as i64 % width == 0;
        require(divides, "patch", self.patch, "must divide the image")?;
        let widths = [
            ("width", self.width),
            ("denoiser_width", self.denoiser_width),
        ];
        for (field, width) in widths {
            within(field, width, 1, 4096)?;
            let is_shared = self.heads >= 1 && width % self.heads == 0;
            let rule = format!("must be a multiple of the {} heads", self.heads);
            require(is_shared, field, width, rule)?;
        }
        for &channels in &self.stem {
            within("stem", channels, 1, 1024)?;
        }
        within("layers", self.layers, 0, 64)?;
        within("denoiser_layers", self.denoiser_layers, 0, 64)?;
        within("frames", self.frames, 1, 16)?;
        let is_share = (0.0..1.0).contains(&self.drop_path);
        require(is_share, "drop_path", self.drop_path, "must be 0 to 1")?;
        require_scale(self.origin_m, self.scale_m)
    }
}
