//! Transformer layer: self-attention and a perceptron, each behind a normalisation and beside a shortcut.

use tch::{Kind, Tensor, nn};

use crate::baselines::layers::TokenNorm;
use crate::pgc::dense::Dense;

/// Added to variances.
pub(super) const NORM_EPS: f64 = 1e-6;

/// Attention heads.
const HEADS: i64 = 4;
/// Gain of layers at whose end no rectifier follows, relative to He's.
const LINEAR_GAIN: f64 = 0.7;
/// Gain of the last layer of each branch: the layer is near the identity at the start.
const BRANCH_GAIN: f64 = 0.2;

/// One layer of `width` channels.
#[derive(Debug)]
pub(super) struct TransformerLayer {
    before_attention: TokenNorm,
    qkv: Dense,
    outward: Dense,
    before_perceptron: TokenNorm,
    up: Dense,
    down: Dense,
    drop_path: f64,
}

impl TransformerLayer {
    /// Layer with a perceptron of `expansion * width` channels; `drop_path` is the share of samples without each branch
    /// in training.
    pub(super) fn new(path: &nn::Path<'_>, width: i64, expansion: i64, drop_path: f64) -> Self {
        let hidden = expansion * width;
        Self {
            before_attention: TokenNorm::new(&(path / "norm1"), width, NORM_EPS),
            qkv: Dense::new(&(path / "qkv"), width, 3 * width, LINEAR_GAIN),
            outward: Dense::new(&(path / "outward"), width, width, BRANCH_GAIN),
            before_perceptron: TokenNorm::new(&(path / "norm2"), width, NORM_EPS),
            up: Dense::new(&(path / "up"), width, hidden, LINEAR_GAIN),
            down: Dense::new(&(path / "down"), hidden, width, BRANCH_GAIN),
            drop_path,
        }
    }

    /// `[B, T, width]` to the same; `mask` is added to the logits of the attention,
    /// `[B or 1, 1, T, T]`; products are in the precision of `x`, which has to be single with a mask.
    pub(super) fn forward(
        &self,
        x: &Tensor,
        mask: Option<&Tensor>,
        train: bool,
    ) -> tch::Result<Tensor> {
        let attended = self.attend(&self.before_attention.forward(x)?, mask)?;
        let x = x.f_add(&self.keep_some(attended, train)?)?;
        let hidden = self.up.forward(&self.before_perceptron.forward(&x)?)?;
        let answer = self.down.forward(&hidden.f_gelu("none")?)?;
        x.f_add(&self.keep_some(answer, train)?)
    }

    fn attend(&self, x: &Tensor, mask: Option<&Tensor>) -> tch::Result<Tensor> {
        let (batch, tokens, width) = x.size3()?;
        let parts = (self.qkv.forward(x)?)
            .f_view([batch, tokens, 3, HEADS, width / HEADS])?
            .f_permute([2, 0, 3, 1, 4])?;
        let [query, key, value] = [0, 1, 2].map(|part| parts.f_select(0, part));
        let (query, key, value) = (query?, key?, value?);
        let found = match mask {
            None => {
                let none = None::<Tensor>;
                Tensor::f_scaled_dot_product_attention(
                    &query, &key, &value, none, 0.0, false, None, false,
                )?
            }
            Some(mask) => {
                let scale = 1.0 / ((width / HEADS) as f64).sqrt();
                let logits = (query.f_matmul(&key.f_transpose(2, 3)?)?).f_mul_scalar(scale)?;
                let shares = logits.f_add(mask)?.f_softmax(3, Kind::Float)?;
                shares.f_matmul(&value)?
            }
        };
        let found = found.f_transpose(1, 2)?.f_reshape([batch, tokens, width])?;
        self.outward.forward(&found)
    }

    /// Stochastic depth: zeroes the branch of some samples and scales the others.
    fn keep_some(&self, branch: Tensor, train: bool) -> tch::Result<Tensor> {
        if !train || self.drop_path <= 0.0 {
            return Ok(branch);
        }
        let keep = 1.0 - self.drop_path;
        let kept = Tensor::f_rand([branch.size()[0], 1, 1], (Kind::Float, branch.device()))?
            .f_lt(keep)?
            .f_to_kind(branch.kind())?
            .f_div_scalar(keep)?;
        branch.f_mul(&kept)
    }
}
