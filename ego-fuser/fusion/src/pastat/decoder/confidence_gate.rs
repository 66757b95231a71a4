//! Confidence gate: weight of a neighbour's feature map, token by token.

use tch::nn::{self, Module};
use tch::{TchError, Tensor};

use crate::layers::ZERO;
use crate::pastat::config::PastatConfig;

/// Predicts the weight of a neighbour's newest map, token by token: 1 before training, 0 to 2 after.
#[derive(Debug)]
pub(super) struct TokenGate {
    hidden: nn::Linear,
    out: nn::Linear,
    patch: i64,
}

impl TokenGate {
    pub(super) fn new(path: &nn::Path<'_>, config: &PastatConfig) -> Self {
        let dim = config.dim;
        Self {
            hidden: nn::linear(path / "hidden", 2 * dim, dim, nn::LinearConfig::default()),
            out: nn::linear(path / "out", dim, 1, ZERO),
            patch: config.patch,
        }
    }

    /// `[M, 1, H, W]` from the neighbours' tokens `[M, h, w, D]` and the ego's after the transformer `[1, h, w, D]`.
    pub(super) fn forward(&self, others: &Tensor, ego: &Tensor) -> Result<Tensor, TchError> {
        // A layer of both, side by side; the ego's part is the same for all others.
        let dim = ego.size4()?.3;
        let (ws, bs) = (&self.hidden.ws, self.hidden.bs.as_ref());
        let hidden = others.f_linear(&ws.f_narrow(1, 0, dim)?, None::<&Tensor>)?
            + ego.f_linear(&ws.f_narrow(1, dim, dim)?, bs)?;
        // The last layer is zero at first, of which the sigmoid is a half: the factor makes it 1.
        let weight = self.out.forward(&hidden.f_relu()?).f_sigmoid()? * 2.0;
        let (maps, rows, columns, _) = weight.size4()?;
        let weight = weight.f_view([maps, 1, rows, columns])?;
        weight.f_upsample_nearest2d([rows * self.patch, columns * self.patch], None, None)
    }
}
