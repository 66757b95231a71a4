//! Localization by HypLiLoc: from a sweep to a pose.

use std::path::Path;
use std::time::Instant;

use protocol::{NoPoseReason, PointCloud, PoseEstimate};
use tch::nn::VarStore;
use tch::{Device, Kind, TchError, Tensor, no_grad};

use super::config::HypLiLocConfig;
use super::network::HypLiLoc;
use super::sweep_input::{InputBatch, SweepInput};
use crate::competitors::end_to_end_localizer::{FULL_CONFIDENCE, no_pose, upright};
use crate::pgc::{Localization, Localize, LocalizerError, LocalizerTimes};
use perception::weights::Weights;

/// Shortest heading that is a direction.
const LEAST_HEADING: f32 = 1e-3;

/// A trained network of one scene. Every pose has full confidence: the network predicts no error.
#[derive(Debug)]
pub struct HypLiLocLocalizer {
    network: HypLiLoc,
    config: HypLiLocConfig,
    device: Device,
}

impl HypLiLocLocalizer {
    /// Kind of the weights, as in their file.
    pub const KIND: &'static str = "HypLiLoc";

    /// Reads the output of `agent train hypliloc`.
    ///
    /// # Errors
    /// [`LocalizerError`] when the file is missing, truncated or of another kind, or its tensors are not those of the
    /// network.
    pub fn load(path: &Path, device: Device) -> Result<Self, LocalizerError> {
        let weights = Weights::load(path)?;
        weights.check_kind(Self::KIND)?;
        let config: HypLiLocConfig = weights.config()?;
        config.validate()?;
        let mut variables = VarStore::new(device);
        let network = HypLiLoc::new(&variables.root());
        weights.copy_into(&variables)?;
        variables.freeze();
        Ok(Self { network, config, device })
    }

    /// Configuration: scene, origin and scale of its positions.
    #[must_use]
    pub fn config(&self) -> &HypLiLocConfig {
        &self.config
    }

    /// Position relative to the origin, metres, cosine and sine of the heading.
    fn regress(&self, input: SweepInput) -> Result<Vec<f32>, TchError> {
        let batch = InputBatch::new(&[input], self.device)?;
        let poses = self.network.forward(&batch, Kind::Float, false)?.fusion;
        let answer = Tensor::f_cat(&[poses.position, poses.heading], 1)?;
        Vec::try_from(&answer.f_reshape([-1])?.f_to_device(Device::Cpu)?)
    }
}

impl Localize for HypLiLocLocalizer {
    fn localize(&mut self, cloud: &PointCloud) -> Result<Localization, LocalizerError> {
        let mut times = LocalizerTimes::default();
        let start = Instant::now();
        let points_m: Vec<[f32; 3]> = cloud.xyzi.iter().map(|&[x, y, z, _]| [x, y, z]).collect();
        let input = SweepInput::new(&points_m);
        times.voxelise = start.elapsed();
        let Some(input) = input else { return Ok(no_pose(NoPoseReason::TooFewPoints, times)) };
        let start = Instant::now();
        let mut answer = no_grad(|| self.regress(input))?;
        times.regress = start.elapsed();
        answer.iter_mut().zip(self.config.scale_m).for_each(|(axis, scale)| *axis *= scale as f32);
        Ok(match of_length_one(&mut answer).then(|| upright(&answer, self.config.origin_m)).flatten() {
            Some(pose) => Localization::from_estimate(PoseEstimate::new(pose.into(), FULL_CONFIDENCE), times),
            None => no_pose(NoPoseReason::Failed, times),
        })
    }
}

/// Scales the heading after the position to length 1; false if it has no direction.
fn of_length_one(answer: &mut [f32]) -> bool {
    let [.., cosine, sine] = answer else { return false };
    let length = cosine.hypot(*sine);
    (*cosine, *sine) = (*cosine / length, *sine / length);
    length >= LEAST_HEADING
}
