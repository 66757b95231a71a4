//! Head of a branch: position and heading from the mean of its tokens.

use perception::layers::convolution::Norm;
use tch::{Kind, TchError, Tensor, nn};

use super::network::WIDTH;
use crate::pgc::dense::Dense;

/// Poses as the network states them.
#[derive(Debug)]
pub struct NormalisedPoses {
    /// `[S, 3]` relative to the mean, in standard deviations of the training positions.
    pub position: Tensor,
    /// `[S, 2]` cosine and sine of the heading, of any length.
    pub heading: Tensor,
}

/// Layers from the mean token to a pose.
#[derive(Debug)]
pub(super) struct PoseHead {
    norm: Norm,
    position: [Dense; 3],
    heading: [Dense; 3],
}

impl PoseHead {
    /// Builds the layers below `path`.
    pub(super) fn new(path: &nn::Path<'_>) -> Self {
        let chain = |name: &str, outputs| {
            let path = path / name;
            [
                Dense::new(&(&path / 0), WIDTH, 128, 1.0),
                Dense::new(&(&path / 1), 128, 64, 1.0),
                Dense::new(&(&path / 2), 64, outputs, 0.1),
            ]
        };
        Self {
            norm: Norm::with_defaults(&(path / "norm"), WIDTH),
            position: chain("position", 3),
            heading: chain("heading", 2),
        }
    }

    /// `[S, WIDTH]`: batch norm of the mean of tokens `[S, T, WIDTH]`, which is nearly the same for all sweeps.
    pub(super) fn features(&self, tokens: &Tensor, train: bool) -> Result<Tensor, TchError> {
        let mean = tokens.f_mean_dim(1_i64, false, Kind::Float)?;
        Ok(self.norm.forward(&mean, train))
    }

    /// Poses from features `[S, WIDTH]`.
    pub(super) fn forward(&self, features: &Tensor) -> Result<NormalisedPoses, TchError> {
        let through = |[first, second, third]: &[Dense; 3]| {
            let hidden = first.forward(features)?.f_relu()?;
            third.forward(&second.forward(&hidden)?.f_relu()?)
        };
        Ok(NormalisedPoses {
            position: through(&self.position)?,
            heading: through(&self.heading)?,
        })
    }
}
