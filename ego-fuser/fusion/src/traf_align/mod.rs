//! TraF-Align (Song et al., CVPR 2025): attention along the trajectories of objects from past maps to now.
//!
//! The maps of an agent, each with an encoding of its age, are summed over time. A small U-Net predicts a trajectory
//! field from the sum, and a convolution predicts from that the offsets of some sampling points around every cell. Each
//! cell then attends to the features at its points, and so gathers earlier features along an object's trajectory.
//! Agents are fused by the maximum.
//!
//! Differences from the published code, and their cost:
//!
//! - Its field and its offsets have losses of their own, derived from tracked objects, and points are rounded to cells.
//!   Here the detection loss trains them, through bilinear sampling. Learning a motion takes longer, and other points
//!   are not penalised where they detect as well.
//! - Its agents are concatenated and fused by a convolution over a fixed number of slots; here by the maximum, its
//!   other option, which is invariant to order and number of agents.
//! - Its output replaces the features. Here it is added to each agent's newest map and is zero at first, so that
//!   training begins as [`MaxFusion`](super::MaxFusion) and a pretrained encoder is useful at once.
//! - Learnt position encodings over the BEV grid are left out: objects move alike everywhere.
//! - `lean` works on tokens of 2 x 2 cells.

mod attention;
mod config;
mod field;

use perception::layers::convolution::ConvLayer;
use perception::model_config::{ConfigError, DetectorConfig};
use perception::tensor_values::tensor;
use tch::nn::{self, Init};
use tch::{Kind, TchError, Tensor};

pub(crate) use config::TrafAlignConfig;

use self::attention::TrajectoryAttention;
use self::field::Trajectories;
use super::f64_tensor::picked;
use super::interface::{Fusion, FusionOutput};
use super::layers::SMALL;
use super::maps::{AlignedMaps, MapMetadata, reaching};
use super::padding::Padding;
use super::settings::{FusionSettings, HistorySpec, Requirements, of_size};
use super::spec::MethodSpec;
use super::warp::WarpedMaps;

/// TraF-Align.
pub(crate) static METHOD: MethodSpec = MethodSpec::of_features::<TrafAlignConfig>(
    "feature maps with history, attention along trajectories (TraF-Align)",
);

impl FusionSettings for TrafAlignConfig {
    const KIND: &'static str = "traf_align";

    fn for_detector(detector: &DetectorConfig) -> Self {
        of_size(detector, Self::lean, Self::full)
    }

    fn build(&self, path: &nn::Path<'_>) -> Result<Box<dyn Fusion>, ConfigError> {
        Ok(Box::new(TrafAlign::new(path, self)?))
    }

    fn requirements(&self) -> Requirements {
        Requirements {
            history: HistorySpec {
                frames: self.frames,
                ..HistorySpec::default()
            },
            ..Requirements::default()
        }
    }
}

/// Trajectory-aware fusion.
#[derive(Debug)]
pub(crate) struct TrafAlign {
    config: TrafAlignConfig,
    tokeniser: ConvLayer,
    /// `[2 K, D]`: sine and cosine of an age to a token's channels.
    age: Tensor,
    trajectories: Trajectories,
    layers: Vec<TrajectoryAttention>,
    /// `[D, C, patch, patch]`.
    decoder: Tensor,
}

/// Wavelengths of the encoding of ages, in steps: powers of two from 2 to `2^WAVES`.
const WAVES: i64 = 4;

impl TrafAlign {
    /// Its variables lie below `path`.
    ///
    /// # Errors
    /// [`ConfigError`] names the field that no network can be built from.
    pub(crate) fn new(path: &nn::Path<'_>, config: &TrafAlignConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        let (channels, patch, dim) = (config.channels, config.patch, config.dim);
        let (tokens, norm) = (path / "tokens", path / "tokens_norm");
        Ok(Self {
            tokeniser: ConvLayer::patches(&tokens, &norm, [channels, dim], patch),
            age: path.var("age", &[2 * WAVES, dim], SMALL),
            trajectories: Trajectories::new(&(path / "trajectories"), config),
            layers: (0..config.layers)
                .map(|index| TrajectoryAttention::new(&(path / "layers" / index), config))
                .collect(),
            decoder: path.var("decoder", &[dim, channels, patch, patch], Init::Const(0.0)),
            config: config.clone(),
        })
    }

    /// `[K, D]` for the ages of `K` maps.
    fn ages(&self, age_secs: &[f64]) -> Result<Tensor, TchError> {
        let waves = age_secs.iter().flat_map(|age| {
            let steps = age / self.config.frame_secs;
            (1..=WAVES as i32).flat_map(move |wave| {
                let (sin, cos) = (std::f64::consts::TAU * steps / f64::from(1 << wave)).sin_cos();
                [sin as f32, cos as f32]
            })
        });
        let waves = waves.collect::<Vec<f32>>();
        tensor(&waves, &[-1, 2 * WAVES], self.age.device())?.f_matmul(&self.age)
    }

    /// One map of tokens per agent: the sum over its frames, `[A, D, h, w]`.
    fn over_time(
        &self,
        WarpedMaps { features, mask }: &WarpedMaps,
        agents: &Agents,
        train: bool,
    ) -> Result<Tensor, TchError> {
        let patch = [self.config.patch; 2];
        let seen = mask.f_max_pool2d(patch, patch, [0, 0], [1, 1], false)?;
        let ages = self.ages(&agents.age_secs)?;
        let ages = ages.f_unsqueeze(-1)?.f_unsqueeze(-1)?;
        // Masked after the addition: tokens out of reach would otherwise consist of the code of their age.
        let tokens = (self.tokeniser.forward(features, train) + ages) * seen;
        let mut size = tokens.size();
        size[0] = agents.newest.len() as i64;
        let owner = tensor(&agents.owner, &[-1], tokens.device())?;
        Tensor::f_zeros(size, (tokens.kind(), tokens.device()))?.f_index_add(0, &owner, &tokens)
    }
}

/// Assignment of maps to agents.
struct Agents {
    /// For each map the index of its agent, the ego being 0.
    owner: Vec<i64>,
    age_secs: Vec<f64>,
    /// For each agent its newest map.
    newest: Vec<i64>,
}

impl Agents {
    fn new(metadata: &[MapMetadata], entries: &[i64]) -> Self {
        let facts = entries.iter().map(|&entry| metadata[entry as usize]);
        let facts: Vec<MapMetadata> = facts.collect();
        let mut names: Vec<usize> = Vec::new();
        let owner: Vec<i64> = (facts.iter())
            .map(|facts| {
                let known = names.iter().position(|name| *name == facts.agent);
                known.unwrap_or_else(|| {
                    names.push(facts.agent);
                    names.len() - 1
                }) as i64
            })
            .collect();
        let age_secs: Vec<f64> = facts.iter().map(|facts| facts.age_secs).collect();
        let newest = (0..names.len() as i64).map(|agent| {
            let of_agent = (0..owner.len()).filter(|&entry| owner[entry] == agent);
            let newest = of_agent.min_by(|&a, &b| age_secs[a].total_cmp(&age_secs[b]));
            newest.unwrap_or(0) as i64
        });
        Self {
            newest: newest.collect(),
            owner,
            age_secs,
        }
    }
}

impl Fusion for TrafAlign {
    fn fuse(&self, maps: &AlignedMaps) -> Result<FusionOutput, TchError> {
        let warped = &maps.warped;
        let entries = reaching(&warped.mask, true)?;
        let agents = Agents::new(&maps.metadata, &entries);
        let present = warped.each(|map| picked(map, &entries)?.f_to_kind(Kind::Float))?;
        let (_, _, height, width) = present.features.size4()?;
        // The U-Net halves the resolution of the tokens once.
        let padded = Padding::to_multiples_of(2 * self.config.patch, &present)?;
        let mut tokens = self.over_time(&padded, &agents, maps.is_training)?;
        let points = self.trajectories.points(&tokens, maps.is_training)?;
        for layer in &self.layers {
            tokens = layer.forward(&tokens, &points)?;
        }
        let (patch, none, bias) = ([self.config.patch; 2], [0_i64; 2], None::<Tensor>);
        let gathered =
            tokens.f_conv_transpose2d(&self.decoder, bias, patch, none, none, 1, [1, 1])?;
        let WarpedMaps { features, mask } = padded.each(|map| picked(map, &agents.newest))?;
        // Padding is out of reach of all maps and becomes minus infinity, which is cropped below.
        let fused = (features + gathered).f_masked_fill(&mask.f_eq(0.0)?, f64::NEG_INFINITY)?;
        let fused = fused
            .f_amax([0i64].as_slice(), false)?
            .f_narrow(1, 0, height)?
            .f_narrow(2, 0, width)?;
        Ok(fused.f_to_kind(warped.features.kind())?.into())
    }
}

#[cfg(test)]
mod tests;
