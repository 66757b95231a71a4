//! Encoder of sweeps: range images to one feature each, with a mask of static objects.

use perception::layers::convolution::Norm;
use tch::nn::{self, Init};
use tch::{Kind, TchError, Tensor};

use super::config::DiffLocConfig;
use super::context_stem::ContextStem;
use super::transformer::{NORM_EPS, TransformerLayer};
use crate::baselines::layers::LayerNorm;
use crate::pgc::dense::Dense;

/// Channels of the perceptrons, relative to those of a token.
const EXPANSION: i64 = 4;

/// Stem, transformer and static-object-aware pooling.
#[derive(Debug)]
pub struct SweepEncoder {
    stem: ContextStem,
    places: Tensor,
    layers: Vec<TransformerLayer>,
    norm: LayerNorm,
    mask: Dense,
    feature_norm: Norm,
}

/// Encoded range images.
#[derive(Debug)]
pub struct EncodedSweeps {
    /// `[B, width]`, single precision.
    pub features: Tensor,
    /// `[B, T]`: logit that a token shows static objects, single precision.
    pub static_logits: Tensor,
}

impl SweepEncoder {
    /// Builds the layers below `path`.
    pub fn new(path: &nn::Path<'_>, config: &DiffLocConfig) -> Self {
        let (width, last) = (config.width, (config.layers.max(2) - 1) as f64);
        let layer = |number: usize| {
            let (path, drop) = (
                path / "layers" / number,
                config.drop_path * number as f64 / last,
            );
            TransformerLayer::new(&path, width, config.heads, EXPANSION, drop)
        };
        let (mean, stdev) = (0.0, 0.02);
        let places = Init::Randn { mean, stdev };
        Self {
            stem: ContextStem::new(&(path / "stem"), config),
            places: path.var("places", &[config.tokens(), width], places),
            layers: (0..config.layers).map(layer).collect(),
            norm: LayerNorm::new(&(path / "norm"), width, NORM_EPS),
            mask: Dense::new(&(path / "mask"), width, 1, 0.1),
            feature_norm: Norm::with_defaults(&(path / "feature_norm"), width),
        }
    }

    /// Encodes `[B, CHANNELS, rows, columns]`; products are computed in the precision of the images.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn forward(&self, images: &Tensor, train: bool) -> Result<EncodedSweeps, TchError> {
        let places = self.places.f_to_kind(images.kind())?;
        let x = self.stem.forward(images, train)?.f_add(&places)?;
        let mut layers = self.layers.iter();
        let x = layers.try_fold(x, |x, layer| layer.forward(&x, None, train))?;
        let x = self.norm.forward(&x)?.f_to_kind(Kind::Float)?;
        let logits = self.mask.forward(&x)?;
        let weighted = x.f_add(&x.f_mul(&logits.f_sigmoid()?)?)?;
        let features = weighted.f_mean_dim(1_i64, false, Kind::Float)?;
        Ok(EncodedSweeps {
            // Means over tokens are nearly the same for all sweeps.
            features: self.feature_norm.forward(&features, train),
            static_logits: logits.f_squeeze_dim(2)?,
        })
    }
}
