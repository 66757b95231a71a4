//! DiscoNet (Li et al., NeurIPS 2021): a small network weighs each agent's features against the ego's at every cell.
//!
//! The fusion of the published network. Its training by distillation, from a teacher with the points of all agents, is
//! not part of the network; weights trained here had no teacher.

use perception::layers::convolution::Norm;
use perception::model_config::{ConfigError, DetectorConfig};
use protocol::config::within;
use serde::{Deserialize, Serialize};
use tch::nn;
use tch::{TchError, Tensor};

use super::conv_gru::Conv;
use super::f64_tensor::sum_over_first;
use crate::{AlignedMaps, Fusion, FusionOutput, FusionSettings, MethodSpec};

/// DiscoNet.
pub static METHOD: MethodSpec = MethodSpec::of_features::<DiscoNetConfig>(
    "feature maps, a learnt weight per agent and cell (DiscoNet)",
);

/// Sizes of [`DiscoNet`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DiscoNetConfig {
    /// Channels of the feature maps.
    pub channels: i64,
    /// Channels of the layers before the weight.
    pub hidden: [i64; 3],
}

impl DiscoNetConfig {
    /// The published sizes.
    pub fn full(channels: i64) -> Self {
        Self {
            channels,
            hidden: [128, 32, 8],
        }
    }

    /// Checks that a network can be built.
    ///
    /// # Errors
    /// [`ConfigError`] names the field.
    pub fn validate(&self) -> Result<(), ConfigError> {
        within("fusion channels", self.channels, 1, 4096)?;
        self.hidden
            .iter()
            .try_for_each(|&hidden| within("fusion hidden channels", hidden, 1, 4096))?;
        Ok(())
    }
}

impl FusionSettings for DiscoNetConfig {
    const KIND: &'static str = "disconet";

    fn for_detector(detector: &DetectorConfig) -> Self {
        Self::full(detector.feature_channels())
    }

    fn build(&self, path: &nn::Path<'_>) -> Result<Box<dyn Fusion>, ConfigError> {
        Ok(Box::new(DiscoNet::new(path, self)?))
    }
}

/// A weight per agent and cell.
#[derive(Debug)]
pub struct DiscoNet {
    channels: i64,
    layers: [(Conv, Norm); 3],
    weight: Conv,
}

impl DiscoNet {
    /// Parameters `pixel_weight_layer.{conv1_<n>,bn1_<n>}.*` below `path`.
    ///
    /// # Errors
    /// [`ConfigError`] names the field that no network can be built from.
    pub fn new(path: &nn::Path<'_>, config: &DiscoNetConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        let path = path / "pixel_weight_layer";
        let [first, second, third] = config.hidden;
        Ok(Self {
            channels: config.channels,
            layers: [
                (1, [2 * config.channels, first]),
                (2, [first, second]),
                (3, [second, third]),
            ]
            .map(|(index, io)| {
                let norm = Norm::with_defaults(&(&path / format!("bn1_{index}")), io[1]);
                (Conv::new(&(&path / format!("conv1_{index}")), io, 1), norm)
            }),
            weight: Conv::new(&(&path / "conv1_4"), [third, 1], 1),
        })
    }

    /// Weights `[N, 1, H, W]` of aligned maps `[N, C, H, W]`, before the softmax.
    fn scores(&self, maps: &Tensor, train: bool) -> Result<Tensor, TchError> {
        let [(first, norm), rest @ ..] = &self.layers;
        // A pair is (agent, ego); the ego's half is the same for all.
        let of_ego = first.part(&maps.f_narrow(0, 0, 1)?, self.channels, true)?;
        let mut x = norm
            .forward(&(first.part(maps, 0, false)? + of_ego), train)
            .f_relu()?;
        for (conv, norm) in rest {
            x = norm.forward(&conv.apply(&x)?, train).f_relu()?;
        }
        self.weight.apply(&x)?.f_relu()
    }
}

impl Fusion for DiscoNet {
    fn fuse(&self, maps: &AlignedMaps) -> Result<FusionOutput, TchError> {
        let features = &maps.warped.features;
        if maps.warped.count()? == 1 {
            return Ok(features.f_get(0)?.into());
        }
        let scores = self.scores(features, maps.is_training)?;
        // Over the agents. The ego reaches every cell, so no cell is masked for all, which would give NaN.
        let weights = scores
            .f_masked_fill(&maps.warped.mask.f_eq(0.0)?, f64::NEG_INFINITY)?
            .f_softmax(0, None)?;
        Ok(sum_over_first(&(weights * features))?.into())
    }
}

#[cfg(test)]
mod tests {
    use protocol::{BevGrid, Pose};
    use tch::nn::VarStore;
    use tch::{Device, Kind};

    use super::*;
    use crate::MapMetadata;

    #[test]
    fn every_parameter_learns() {
        tch::set_num_threads(1);
        tch::manual_seed(4);
        let variables = VarStore::new(Device::Cpu);
        let network = DiscoNet::new(&variables.root(), &DiscoNetConfig::full(8)).unwrap();
        let features = Tensor::rand([3, 8, 6, 10], (Kind::Float, Device::Cpu));
        let mask = Tensor::ones([3, 1, 6, 10], (Kind::Float, Device::Cpu));
        let grid = BevGrid {
            x_min_m: 0.0,
            y_min_m: 0.0,
            cell_m: 1.0,
            width: 10,
            height: 6,
        };
        let facts: Vec<_> = (0..3)
            .map(|agent| MapMetadata::fresh(agent, Pose::IDENTITY))
            .collect();
        let maps = AlignedMaps {
            is_training: true,
            ..AlignedMaps::newest(&features, &mask, &facts, &grid)
        };
        network
            .fuse(&maps)
            .unwrap()
            .map
            .square()
            .sum(Kind::Float)
            .backward();
        for (name, variable) in variables.variables() {
            if variable.requires_grad() {
                // A bias before a batch norm has no effect.
                let must_move = !(name.contains("conv1_") && name.ends_with("bias"))
                    || name.contains("conv1_4");
                let norm = variable.grad().abs().sum(Kind::Float).double_value(&[]);
                assert!(
                    norm.is_finite() && (norm > 0.0 || !must_move),
                    "{name}: {norm}"
                );
            }
        }
    }
}
