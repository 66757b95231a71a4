//! Localization by DiffLoc: from a sweep to a pose.

use std::path::Path;
use std::time::Instant;

use protocol::{NoPoseReason, PointCloud, PoseEstimate};
use tch::nn::VarStore;
use tch::{Device, Tensor, no_grad};

use super::config::DiffLocConfig;
use super::denoiser::Windows;
use super::network::DiffLoc;
use super::range_image::CHANNELS;
use crate::competitors::end_to_end_localizer::{FULL_CONFIDENCE, no_pose, upright};
use crate::pgc::pose_solver::MIN_CELLS;
use crate::pgc::{Localization, Localize, LocalizerError, LocalizerTimes};
use perception::weights::Weights;

/// A DiffLoc network of one scene, for single sweeps.
///
/// The denoised pose is used unchanged, with full confidence.
#[derive(Debug)]
pub struct DiffLocLocalizer {
    network: DiffLoc,
    device: Device,
    sha256: String,
}

impl DiffLocLocalizer {
    /// Kind of the weights, as in their file.
    pub const KIND: &'static str = "DiffLoc";

    /// Reads the output of `agent train diffloc`.
    ///
    /// # Errors
    /// [`LocalizerError`] when the file is missing, truncated or of another kind, or its tensors are not those of its
    /// configuration.
    pub fn load(path: &Path, device: Device) -> Result<Self, LocalizerError> {
        let weights = Weights::load(path)?;
        weights.check_kind(Self::KIND)?;
        let config: DiffLocConfig = weights.config()?;
        let mut variables = VarStore::new(device);
        let network = DiffLoc::new(&variables.root(), &config)?;
        weights.copy_into(&variables)?;
        variables.freeze();
        Ok(Self { network, device, sha256: weights.sha256().to_owned() })
    }

    /// SHA-256 of the weights.
    #[must_use]
    pub fn sha256(&self) -> &str {
        &self.sha256
    }

    /// Configuration: sizes and scene.
    #[must_use]
    pub fn config(&self) -> &DiffLocConfig {
        self.network.config()
    }
}

impl Localize for DiffLocLocalizer {
    fn localize(&mut self, cloud: &PointCloud) -> Result<Localization, LocalizerError> {
        let mut times = LocalizerTimes::default();
        let start = Instant::now();
        let config = self.network.config();
        let values = config.image.image(&cloud.xyzi);
        times.voxelise = start.elapsed();
        if values[..config.image.pixels()].iter().filter(|&&range| range > 0.0).count() < MIN_CELLS {
            return Ok(no_pose(NoPoseReason::TooFewPoints, times));
        }
        let start = Instant::now();
        let shape = [1, CHANNELS as i64, config.image.rows as i64, config.image.columns as i64];
        let image = Tensor::f_from_slice(&values)?.f_view(shape)?.f_to_device(self.device)?;
        let features = no_grad(|| self.network.encoder().forward(&image, false))?.features;
        times.encode = start.elapsed();
        let start = Instant::now();
        let poses = self.network.poses(&features.f_unsqueeze(1)?, Windows::Single)?;
        let answer: Vec<f32> = Vec::try_from(&poses.f_reshape([-1])?.f_to_device(Device::Cpu)?)?;
        times.regress = start.elapsed();
        Ok(match upright(&scaled(&answer, config.scale_m), config.origin_m) {
            Some(pose) => Localization::from_estimate(PoseEstimate::new(pose.into(), FULL_CONFIDENCE), times),
            None => no_pose(NoPoseReason::Failed, times),
        })
    }
}

/// A normalised pose with its position in metres.
fn scaled(answer: &[f32], scale_m: [f64; 3]) -> Vec<f32> {
    let scales = scale_m.iter().map(|&scale| scale as f32).chain([1.0; 2]);
    answer.iter().zip(scales).map(|(value, scale)| value * scale).collect()
}
