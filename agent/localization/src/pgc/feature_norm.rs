//! Normalisation of features to mean 0 and deviation 1.

use tch::{Kind, Tensor, nn, no_grad};

/// Smallest deviation: constant channels are scaled as if they had this one.
const LEAST_DEVIATION: f64 = 1e-4;

/// Normalises features to mean 0 and deviation 1 per channel; its statistics are computed, not learnt.
#[derive(Debug)]
pub(crate) struct FeatureNorm {
    mean: Tensor,
    scale: Tensor,
}

impl FeatureNorm {
    /// Identity until [`Self::fit`].
    pub(crate) fn new(path: &nn::Path<'_>, channels: i64) -> Self {
        Self {
            mean: path.zeros_no_train("mean", &[channels]),
            scale: path.ones_no_train("scale", &[channels]),
        }
    }

    /// Sets mean and deviation of `[N, channels]`.
    pub(crate) fn fit(&mut self, features: &Tensor) -> tch::Result<()> {
        let features = features.f_to_kind(Kind::Float)?;
        let deviation = features.f_std_dim(0_i64, false, false)?;
        no_grad(|| {
            self.mean
                .f_copy_(&features.f_mean_dim(0_i64, false, Kind::Float)?)?;
            self.scale
                .f_copy_(&deviation.f_clamp_min(LEAST_DEVIATION)?.f_reciprocal()?)
        })
    }

    /// In single precision.
    pub(crate) fn forward(&self, x: &Tensor) -> tch::Result<Tensor> {
        Ok((x.f_to_kind(Kind::Float)? - &self.mean) * &self.scale)
    }
}
