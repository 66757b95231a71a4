//! Configuration of a DiffLoc network: sizes, and the scene that it was trained on.

use serde::{Deserialize, Serialize};

use super::range_image::RangeImageConfig;
use crate::pgc::LocalizerError;

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
    #[must_use]
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
    #[must_use]
    pub fn tokens(&self) -> i64 {
        (self.image.rows as i64 / self.patch[0].max(1))
            * (self.image.columns as i64 / self.patch[1].max(1))
    }

    /// Checks sizes that come from a file.
    ///
    /// # Errors
    /// [`LocalizerError::Config`] names the field that is wrong.
    pub fn validate(&self) -> Result<(), LocalizerError> {
        let wrong = |text: String| Err(LocalizerError::Config(format!("DiffLoc: {text}")));
        let RangeImageConfig {
            rows,
            columns,
            elevations_deg: [low, high],
            ..
        } = self.image;
        let side = 1..=4096;
        if !side.contains(&rows) || !side.contains(&columns) {
            return wrong(format!(
                "image of {rows} x {columns}, expected 1 to 4096 rows and columns"
            ));
        }
        if !(-90.0..=90.0).contains(&low) || !(-90.0..=90.0).contains(&high) || low >= high {
            return wrong(format!("elevations_deg from {low} to {high}"));
        }
        let [height, width] = self.patch;
        if height < 1 || width < 1 || rows as i64 % height != 0 || columns as i64 % width != 0 {
            return wrong(format!(
                "patch {height} x {width} does not divide an image of {rows} x {columns}"
            ));
        }
        for (name, width) in [
            ("width", self.width),
            ("denoiser_width", self.denoiser_width),
        ] {
            if self.heads < 1 || !(1..=4096).contains(&width) || width % self.heads != 0 {
                return wrong(format!("{name} {width} for {} heads", self.heads));
            }
        }
        if self
            .stem
            .iter()
            .any(|channels| !(1..=1024).contains(channels))
        {
            return wrong(format!(
                "stem of {:?} channels, expected 1 to 1024",
                self.stem
            ));
        }
        if self.layers > 64 || self.denoiser_layers > 64 || !(1..=16).contains(&self.frames) {
            let Self {
                layers,
                denoiser_layers,
                frames,
                ..
            } = self;
            return wrong(format!(
                "{layers} and {denoiser_layers} layers for {frames} frames"
            ));
        }
        if !(0.0..1.0).contains(&self.drop_path) {
            return wrong(format!("drop_path {}, expected 0 to 1", self.drop_path));
        }
        let scaled = self
            .scale_m
            .iter()
            .all(|axis| axis.is_finite() && *axis > 0.0);
        if !scaled || !self.origin_m.iter().all(|axis| axis.is_finite()) {
            return wrong(format!(
                "origin_m {:?}, scale_m {:?}",
                self.origin_m, self.scale_m
            ));
        }
        Ok(())
    }
}
