//! The network of DiffLoc: transformer over the tokens of a sweep, denoiser of poses, and the way from one to the other.

use perception::layers::convolution::Norm;
use perception::tensor_values::tensor;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use tch::nn::{self, Init};
use tch::{Kind, Tensor, no_grad};

use super::denoiser::{FEATURES, PoseDenoiser};
use super::noise_schedule::NoiseSchedule;
use super::transformer::{NORM_EPS, TransformerLayer};
use crate::baselines::layers::TokenNorm;
use crate::baselines::place_classes::{POSE, PlaceClasses, PlaceHead};
use crate::baselines::regressed_pose::{PoseRegressor, RegressPose};
use crate::baselines::tokens::TOKENS;
use crate::pgc::dense::Dense;

/// Channels of a token.
const TOKEN_WIDTH: i64 = 128;
/// Layers over tokens.
const LAYERS: usize = 2;
/// Channels of the perceptrons, relative to those of a token.
const EXPANSION: i64 = 4;
/// Share of samples for which the last layer is skipped in training.
const DROP_PATH: f64 = 0.1;
/// Steps from noise to poses.
const DENOISING_STEPS: usize = 10;
/// Seed of the noise that every search starts from.
const START_SEED: u64 = 7;

/// A DiffLoc network of one scene, for single sweeps, output of `agent train diffloc`.
pub type DiffLocLocalizer = PoseRegressor<DiffLoc>;

/// Transformer and denoiser of one scene.
#[derive(Debug)]
pub struct DiffLoc {
    inward: Dense,
    positions: Tensor,
    layers: Vec<TransformerLayer>,
    norm: TokenNorm,
    mask: Dense,
    outward: Dense,
    sweep_norm: Norm,
    head: PlaceHead,
    /// Denoiser of poses.
    pub denoiser: PoseDenoiser,
    /// Noise schedule.
    pub schedule: NoiseSchedule,
}

/// Described sweeps, single precision.
#[derive(Debug)]
pub struct DescribedTokens {
    /// `[N, FEATURES]`.
    pub features: Tensor,
    /// `[N, K]`: logits of the place classes.
    pub places: Tensor,
    /// `[N, TOKENS]`: logit that a token shows static objects.
    pub static_logits: Tensor,
}

impl DiffLoc {
    /// Describes sweeps with tokens `[N, TOKENS, channels]`; products are computed in `kind`.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn describe(
        &self,
        tokens: &Tensor,
        kind: Kind,
        train: bool,
    ) -> tch::Result<DescribedTokens> {
        let x = self.inward.forward(&tokens.f_to_kind(kind)?)?;
        let x = x.f_add(&self.positions.f_to_kind(kind)?)?;
        let mut layers = self.layers.iter();
        let x = layers.try_fold(x, |x, layer| layer.forward(&x, None, train))?;
        let x = self.norm.forward(&x)?;
        let logits = self.mask.forward(&x)?;
        let weighted = x.f_add(&x.f_mul(&logits.f_sigmoid()?)?)?;
        let features = self.outward.forward(&weighted.f_flatten(1, 2)?)?;
        let features = features.f_to_kind(Kind::Float)?;
        let features = self.sweep_norm.forward(&features, train).f_relu()?;
        Ok(DescribedTokens {
            places: self.head.logits.forward(&features)?,
            static_logits: logits.f_squeeze_dim(2)?.f_to_kind(Kind::Float)?,
            features,
        })
    }

    /// Condition of the denoiser for sweeps with `features` `[N, FEATURES]` in `classes` `[N]`.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn of_class(&self, features: &Tensor, classes: &Tensor) -> tch::Result<Tensor> {
        self.head.of_class(features, classes)
    }

    /// Poses `[W, F, 5]` relative to their classes of sweeps with features [of their classes](Self::of_class)
    /// `[W, F, FEATURES]`, each sweep alone; without gradients. The same features give the same poses.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn denoised(&self, features: &Tensor) -> tch::Result<Tensor> {
        let (count, frames, _) = features.size3()?;
        let device = features.device();
        let mut random = ChaCha8Rng::seed_from_u64(START_SEED);
        let noise = (0..POSE).map(|_| StandardNormal.sample(&mut random));
        let start = tensor::<f32>(&noise.collect::<Vec<_>>(), &[POSE], device)?;
        let start = start.f_expand([count, frames, POSE], false)?;
        no_grad(|| {
            self.schedule
                .denoise(&start, DENOISING_STEPS, |noisy, step| {
                    let steps = Tensor::f_full([count], step, (Kind::Int64, device))?;
                    self.denoiser.forward(noisy, &steps, features, None)
                })
        })
    }
}

impl RegressPose for DiffLoc {
    const KIND: &'static str = "DiffLoc";

    fn build(path: &nn::Path<'_>, channels: i64, classes: i64) -> tch::Result<Self> {
        let (mean, stdev) = (0.0, 0.02);
        let (size, random) = ([TOKENS, TOKEN_WIDTH], Init::Randn { mean, stdev });
        Ok(Self {
            inward: Dense::new(&(path / "inward"), channels, TOKEN_WIDTH, 0.7),
            positions: path.var("positions", &size, random),
            layers: (0..LAYERS)
                .map(|number| {
                    let drop_path = DROP_PATH * number as f64 / (LAYERS - 1) as f64;
                    let path = path / "layers" / number;
                    TransformerLayer::new(&path, TOKEN_WIDTH, EXPANSION, drop_path)
                })
                .collect(),
            norm: TokenNorm::new(&(path / "norm"), TOKEN_WIDTH, NORM_EPS),
            mask: Dense::new(&(path / "mask"), TOKEN_WIDTH, 1, 0.1),
            outward: Dense::new(&(path / "outward"), TOKENS * TOKEN_WIDTH, FEATURES, 0.7),
            sweep_norm: Norm::with_defaults(&(path / "sweep_norm"), FEATURES),
            head: PlaceHead::new(&(path / "head"), FEATURES, classes),
            denoiser: PoseDenoiser::new(&(path / "denoiser"))?,
            schedule: NoiseSchedule::new(path.device())?,
        })
    }

    /// Each sweep is alone in its window.
    fn poses(&self, tokens: &Tensor, places: &PlaceClasses, kind: Kind) -> tch::Result<Tensor> {
        let described = self.describe(tokens, kind, false)?;
        let classes = described.places.f_argmax(1, false)?;
        let features = self.of_class(&described.features, &classes)?;
        let found = self.denoised(&features.f_unsqueeze(1)?)?;
        places.absolute(&found.f_squeeze_dim(1)?, &classes)
    }
}
