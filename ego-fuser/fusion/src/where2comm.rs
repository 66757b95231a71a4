//! Method Where2comm (Hu et al., NeurIPS 2022): agents send only the cells around likely vehicles.
//!
//! Each agent selects cells before it sends, see [`protocol::ConfidenceGate`]; the fusion is per-cell attention or the
//! maximum over the received cells. In training, without a link, a random share of the most confident cells is kept
//! instead of those above a threshold, as published.
//!
//! The published networks fuse at several levels of the backbone; that is `multi_scale`, for imported weights.

use perception::model_config::{ConfigError, DetectorConfig};
use protocol::config::{require, within};
use protocol::{ConfidenceGate, Smoothing};
use serde::{Deserialize, Serialize};
use tch::nn::{self, Init};
use tch::{Kind, TchError, Tensor};

use super::attention::attended;
use super::max::maximum;
use crate::warp::WarpedMaps;
use crate::{AlignedMaps, Fusion, FusionOutput, FusionSettings, MethodSpec, Requirements};

/// Where2comm.
pub static METHOD: MethodSpec = MethodSpec {
    gate: Some(GATE),
    ..MethodSpec::of_features::<Where2commConfig>(
        "feature maps, only the cells around which a vehicle is likely (Where2comm)",
    )
};

/// Twice the published threshold: `lean` heads score the background just above that one. On validation scenes a fifth
/// of the bytes is left then, and AP@0.5 is unchanged.
const GATE: ConfidenceGate = ConfidenceGate {
    threshold: 0.02,
    smoothing: Some(Smoothing {
        kernel: 5,
        sigma: 1.0,
    }),
};

/// Operation that fuses the features of a cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MapAggregation {
    /// Attention of the ego over all, without parameters.
    #[default]
    Attention,
    /// Element-wise maximum.
    Max,
}

/// Value of a cell that was not received, because it was not sent or lies beyond the sender's map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Missing {
    /// No value: the agent does not take part there.
    #[default]
    Absent,
    /// Features of zero, as in the published code: attention to them dilutes the features of the others. Imported
    /// weights were trained with this.
    Zero,
}

/// Settings of [`Where2comm`]; by default attention over the agents that sent the cell.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Where2commConfig {
    /// Operation that fuses the features of a cell.
    pub aggregation: MapAggregation,
    /// Value of cells that were not received.
    #[serde(default)]
    pub missing: Missing,
}

impl FusionSettings for Where2commConfig {
    const KIND: &'static str = "where2comm";

    fn for_detector(_detector: &DetectorConfig) -> Self {
        Self::default()
    }

    fn build(&self, _path: &nn::Path<'_>) -> Result<Box<dyn Fusion>, ConfigError> {
        Ok(Box::new(Where2comm(self.clone())))
    }

    fn requirements(&self) -> Requirements {
        Requirements {
            partial_maps_in_training: true,
            ..Requirements::default()
        }
    }
}

/// Fuses the cells that agents selected. It has no parameters.
#[derive(Debug)]
pub struct Where2comm(pub Where2commConfig);

impl Fusion for Where2comm {
    fn fuse(&self, AlignedMaps { warped, .. }: &AlignedMaps) -> Result<FusionOutput, TchError> {
        let mask = match self.0.missing {
            Missing::Absent => warped.mask.shallow_clone(),
            // Maps are zero wherever their mask is.
            Missing::Zero => warped.mask.f_ones_like()?,
        };
        let maps = WarpedMaps::new(warped.features.shallow_clone(), mask);
        Ok(match self.0.aggregation {
            MapAggregation::Attention => attended(&maps)?,
            MapAggregation::Max => maximum(&maps)?,
        }
        .into())
    }
}

/// Sizes of [`SparseCommunication`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CommunicationConfig {
    /// Smoothed confidence that a cell must exceed to be sent.
    pub threshold: f64,
    /// Spatial smoothing of the confidence before the threshold.
    pub smoothing: Option<Smoothing>,
}

/// The published selection on tensors, its window being part of the weights.
#[derive(Debug)]
pub struct SparseCommunication {
    threshold: f64,
    /// `[1, 1, k, k]` and `[1]`.
    window: Option<(Tensor, Tensor)>,
}

impl SparseCommunication {
    /// The window is `gaussian_filter.*` below `path`; it is not trained.
    ///
    /// # Errors
    /// [`ConfigError`] when the size of the window is even.
    pub fn new(path: &nn::Path<'_>, config: &CommunicationConfig) -> Result<Self, ConfigError> {
        let window = config.smoothing.map(|Smoothing { kernel, .. }| {
            let kernel = i64::from(kernel);
            within("kernel of the smoothing", kernel, 1, 63)?;
            let is_odd = kernel % 2 == 1;
            require(is_odd, "kernel of the smoothing", kernel, "must be odd")?;
            let path = path / "gaussian_filter";
            let weight = path.var("weight", &[1, 1, kernel, kernel], Init::Const(0.0));
            let bias = path.var("bias", &[1], Init::Const(0.0));
            let [weight, bias] = [weight, bias].map(|fixed| fixed.set_requires_grad(false));
            Ok::<_, ConfigError>((weight, bias))
        });
        Ok(Self {
            threshold: config.threshold,
            window: window.transpose()?,
        })
    }

    /// Mask of the cells that each agent would send: logits `[N, A, H, W]` to `[N, 1, H, W]` of 0 and 1.
    ///
    /// # Errors
    /// [`TchError`] when the shape is another.
    pub fn masks(&self, logits: &Tensor) -> Result<Tensor, TchError> {
        let confidence = logits.f_sigmoid()?.f_amax([1i64].as_slice(), true)?;
        let smoothed = match &self.window {
            Some((weight, bias)) => {
                let padding = weight.size()[2] / 2;
                confidence.f_conv2d(weight, Some(bias), [1, 1], [padding; 2], [1, 1], 1)?
            }
            None => confidence,
        };
        smoothed.f_gt(self.threshold)?.f_to_kind(Kind::Float)
    }
}

/// Random selection for training: of each map `[N, 1, H, W]` of confidences the `share` (0..1) that is most confident.
///
/// # Errors
/// [`TchError`] when the shape is another.
pub fn most_confident(confidence: &Tensor, share: f64) -> Result<Tensor, TchError> {
    let (maps, _, height, width) = confidence.size4()?;
    let cells = height * width;
    let count = ((cells as f64 * share) as i64).clamp(0, cells);
    let flat = confidence.f_reshape([maps, cells])?;
    let (_, best) = flat.f_topk(count, -1, true, false)?;
    let mask = Tensor::f_zeros([maps, cells], (Kind::Float, confidence.device()))?;
    mask.f_scatter_value(-1, &best, 1.0)?
        .f_view([maps, 1, height, width])
}

#[cfg(test)]
mod tests {
    use protocol::{BevGrid, Pose};
    use tch::Device;

    use super::*;
    use crate::MapMetadata;

    const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);

    #[test]
    fn missing_cells_dilute_attention_only_if_configured() {
        let mask = Tensor::ones([2, 1, 1, 2], FLOAT);
        let _ = mask.get(1).narrow(2, 1, 1).fill_(0.0);
        let features = Tensor::ones([2, 3, 1, 2], FLOAT) * &mask;
        let grid = BevGrid {
            x_min_m: 0.0,
            y_min_m: 0.0,
            cell_m: 1.0,
            width: 2,
            height: 1,
        };
        let facts = [0, 1].map(|agent| MapMetadata::fresh(agent, Pose::IDENTITY));
        let maps = AlignedMaps::newest(&features, &mask, &facts, &grid);
        for (missing, expected) in [
            (Missing::Absent, 1.0),
            (Missing::Zero, 1.0 / (1.0 + (-(3f64.sqrt())).exp())),
        ] {
            let config = Where2commConfig {
                missing,
                ..Where2commConfig::default()
            };
            let fused = Where2comm(config).fuse(&maps).unwrap().map;
            assert!((fused.double_value(&[0, 0, 0]) - 1.0).abs() < 1e-6);
            assert!(
                (fused.double_value(&[0, 0, 1]) - expected).abs() < 1e-6,
                "{missing:?}"
            );
        }
    }

    #[test]
    fn the_most_confident_share_is_kept() {
        let confidence =
            Tensor::from_slice(&[0.1f32, 0.9, 0.5, 0.2, 0.8, 0.3, 0.7, 0.6]).view([2, 1, 2, 2]);
        let mask = most_confident(&confidence, 0.5).unwrap();
        assert_eq!(
            Vec::<f32>::try_from(mask.view(-1)).unwrap(),
            [0.0, 1.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0]
        );
        assert_eq!(
            most_confident(&confidence, 0.0)
                .unwrap()
                .sum(Kind::Float)
                .double_value(&[]),
            0.0
        );
        assert_eq!(
            most_confident(&confidence, 1.0)
                .unwrap()
                .sum(Kind::Float)
                .double_value(&[]),
            8.0
        );
    }
}
