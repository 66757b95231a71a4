//! Point branch: two set abstractions, then layers of each centre, to 64 tokens.

use tch::nn;
use tch::{Kind, TchError, Tensor};

use super::dense_norm::BatchNormed;
use super::groups::{COARSE, FINE, Groups};
use super::network::WIDTH;
use super::set_abstraction::SetAbstraction;

/// Unit of the positions of centres, metres.
const SCALE_M: f64 = 40.0;

/// Points to tokens.
#[derive(Debug)]
pub(super) struct PointBranch {
    fine: SetAbstraction,
    coarse: SetAbstraction,
    layers: Vec<BatchNormed>,
}

impl PointBranch {
    /// Builds the layers below `path`.
    pub(super) fn new(path: &nn::Path<'_>) -> Self {
        Self {
            fine: SetAbstraction::new(&(path / "fine"), FINE, 0, [32, 32, 64]),
            coarse: SetAbstraction::new(&(path / "coarse"), COARSE, 64, [64, 64, 128]),
            layers: BatchNormed::chain(
                &(path / "tokens"),
                &[3 + 128, 128, 256, 512, 256, 128, WIDTH],
            ),
        }
    }

    /// `[S, 64, WIDTH]` tokens of points `[S, N, 3]`, metres. Layers of neighbours compute in `kind`, the result is
    /// single.
    pub(super) fn forward(
        &self,
        points_m: &Tensor,
        groups: &Groups,
        kind: Kind,
        train: bool,
    ) -> Result<Tensor, TchError> {
        let features = self
            .fine
            .forward(points_m, None, &groups.fine, kind, train)?;
        let centres_m = points_m.f_narrow(1, 0, FINE.centres)?;
        let features =
            self.coarse
                .forward(&centres_m, Some(&features), &groups.coarse, kind, train)?;
        let centres = points_m.f_narrow(1, 0, COARSE.centres)? / SCALE_M;
        let mut x = Tensor::f_cat(&[centres, features], 2)?.f_view([-1, 3 + 128])?;
        for layer in &self.layers {
            x = layer.forward(&x, train)?;
        }
        x.f_view([-1, COARSE.centres, WIDTH])
    }
}
