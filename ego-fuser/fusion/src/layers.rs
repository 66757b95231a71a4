//! Layers of the transformers among the fusions. Parameter names are those of the reference codes.
//!
//! Tokens lie along all dimensions but the last, which holds the channels.

use tch::nn::{self, Init};
use tch::{Kind, TchError, Tensor};

/// Offset under the root in layer norms, as everywhere in the reference codes.
const EPSILON: f64 = 1e-5;

/// Standard deviation of the weights that lead back to the residual path: small, so that an untrained transformer
/// passes on the features of a trained encoder, and yet not zero, so that all layers after them get gradients from the
/// first step.
pub(crate) const SMALL: Init = Init::Randn {
    mean: 0.0,
    stdev: 0.02,
};
/// A layer that gives zero at the start.
pub(crate) const ZERO: nn::LinearConfig = nn::LinearConfig {
    ws_init: Init::Const(0.0),
    bs_init: Some(Init::Const(0.0)),
    bias: true,
};
/// A layer without offset.
pub(crate) const BARE: nn::LinearConfig = nn::LinearConfig {
    ws_init: nn::init::DEFAULT_KAIMING_UNIFORM,
    bs_init: None,
    bias: false,
};

/// Values between -`bound` and `bound`.
pub(crate) fn uniform(bound: f64) -> Init {
    Init::Uniform {
        lo: -bound,
        up: bound,
    }
}

/// Settings of a convolution that keeps the size of its map with a kernel of 3 cells.
pub(crate) fn around() -> nn::ConvConfig {
    nn::ConvConfig {
        padding: 1,
        ..Default::default()
    }
}

/// `x W^T + b` over the last dimension.
#[derive(Debug)]
pub struct Linear {
    /// `[to, from]`, `weight`.
    pub weight: Tensor,
    /// `[to]`, `bias`; absent where the reference has none.
    pub bias: Option<Tensor>,
}

impl Linear {
    /// Random at the start.
    pub fn new(path: &nn::Path<'_>, from: i64, to: i64, has_bias: bool) -> Self {
        Self::with_init(path, from, to, has_bias, nn::init::DEFAULT_KAIMING_UNIFORM)
    }

    /// The last layer of a branch that is added to the residual path: nearly zero at the start.
    pub fn residual(path: &nn::Path<'_>, from: i64, to: i64, has_bias: bool) -> Self {
        Self::with_init(path, from, to, has_bias, SMALL)
    }

    /// Identity at the start; as many channels leave as enter.
    pub fn identity(path: &nn::Path<'_>, channels: i64) -> Self {
        let linear = Self::with_init(path, channels, channels, true, Init::Const(0.0));
        let _ = tch::no_grad(|| linear.weight.shallow_clone().fill_diagonal_(1.0, false));
        linear
    }

    fn with_init(path: &nn::Path<'_>, from: i64, to: i64, has_bias: bool, init: Init) -> Self {
        Self {
            weight: path.var("weight", &[to, from], init),
            bias: has_bias.then(|| path.var("bias", &[to], Init::Const(0.0))),
        }
    }

    /// `[..., from]` to `[..., to]`.
    ///
    /// # Errors
    /// [`TchError`] when the number of channels differs.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor, TchError> {
        x.f_linear(&self.weight, self.bias.as_ref())
    }
}

/// Normalisation over the channels of each token.
#[derive(Debug)]
pub(crate) struct LayerNorm {
    weight: Tensor,
    bias: Tensor,
}

impl LayerNorm {
    /// `weight` and `bias`, `[channels]`, below `path`.
    pub(crate) fn new(path: &nn::Path<'_>, channels: i64) -> Self {
        Self {
            weight: path.var("weight", &[channels], Init::Const(1.0)),
            bias: path.var("bias", &[channels], Init::Const(0.0)),
        }
    }

    /// `[..., channels]` to the same.
    ///
    /// # Errors
    /// [`TchError`] when the number of channels differs.
    pub(crate) fn forward(&self, x: &Tensor) -> Result<Tensor, TchError> {
        x.f_layer_norm(
            self.weight.size(),
            Some(&self.weight),
            Some(&self.bias),
            EPSILON,
            false,
        )
    }
}

/// Two linear layers with GELU between them, with pre-norm and a residual: `norm`, `fn.net.0` and `fn.net.3`.
#[derive(Debug)]
pub(crate) struct FeedForwardBlock {
    norm: LayerNorm,
    wide: Linear,
    back: Linear,
    dropout: f64,
}

impl FeedForwardBlock {
    /// From `channels` to `hidden` and back.
    pub(crate) fn new(path: &nn::Path<'_>, channels: i64, hidden: i64, dropout: f64) -> Self {
        let net = path / "fn" / "net";
        Self {
            norm: LayerNorm::new(&(path / "norm"), channels),
            wide: Linear::new(&(&net / 0), channels, hidden, true),
            back: Linear::residual(&(&net / 3), hidden, channels, true),
            dropout,
        }
    }

    /// `[..., channels]` to the same.
    ///
    /// # Errors
    /// [`TchError`] when the number of channels differs.
    pub(crate) fn forward(&self, x: &Tensor, train: bool) -> Result<Tensor, TchError> {
        let hidden = self.wide.forward(&self.norm.forward(x)?)?.f_gelu("none")?;
        let hidden = dropout(hidden, self.dropout, train)?;
        Ok(x + dropout(self.back.forward(&hidden)?, self.dropout, train)?)
    }
}

/// Leaves out values at random in training.
///
/// # Errors
/// [`TchError`] when `share` is no probability.
pub fn dropout(x: Tensor, share: f64, train: bool) -> Result<Tensor, TchError> {
    if train && share > 0.0 {
        x.f_dropout(share, true)
    } else {
        Ok(x)
    }
}

/// Scaled dot-product attention, `softmax(q k^T / sqrt(D) + bias) v`, of `B` groups of tokens with `M` heads at once.
///
/// # Shapes
/// - `query`: `[B, Q, M, D]`; `key`, `value`: `[B, K, M, D]`; the last dimension without gaps
/// - `bias`: broadcastable to `[B, M, Q, K]`
/// - returns: `[B, Q, M * D]`
pub(crate) fn attend(
    query: &Tensor,
    key: &Tensor,
    value: &Tensor,
    bias: Option<&Tensor>,
) -> Result<Tensor, TchError> {
    let (groups, tokens, heads, channels) = query.size4()?;
    let [query, key, value] = [query, key, value].map(|tokens| tokens.f_transpose(1, 2));
    let (query, key, value) = (query?, key?, value?);
    let seen = match bias {
        Some(bias) if bias.requires_grad() => attend_and_learn_bias(&query, &key, &value, bias)?,
        _ => Tensor::f_scaled_dot_product_attention(
            &query, &key, &value, bias, 0.0, false, None, false,
        )?,
    };
    seen.f_transpose(1, 2)?
        .f_reshape([groups, tokens, heads * channels])
}

/// The same step by step, on `[B, M, tokens, D]`: the fused kernels have no gradient for the bias, and the library's
/// fallback scales queries and keys in separate passes.
fn attend_and_learn_bias(
    query: &Tensor,
    key: &Tensor,
    value: &Tensor,
    bias: &Tensor,
) -> Result<Tensor, TchError> {
    let (groups, heads, asking, channels) = query.size4()?;
    let asked = key.size()[2];
    let query = query.f_flatten(0, 1)?;
    let key = key.f_flatten(0, 1)?.f_transpose(1, 2)?;
    let scale = (channels as f64).powf(-0.5);
    let scores = if bias.dim() == 2 {
        bias.f_baddbmm(&query, &key, 1.0, scale)?
    } else {
        let scores = (query * scale)
            .f_bmm(&key)?
            .f_view([groups, heads, asking, asked])?;
        (scores + bias).f_view([groups * heads, asking, asked])?
    };
    let weights = scores.f_softmax(-1, None::<Kind>)?;
    weights
        .f_bmm(&value.f_flatten(0, 1)?)?
        .f_view([groups, heads, asking, channels])
}

/// Additive mask of the scores, so that cells with a mask of zero are not attended to: 0 or minus infinity.
///
/// # Errors
/// [`TchError`] of the tensor library.
pub fn unseen(mask: &Tensor) -> Result<Tensor, TchError> {
    mask.f_zeros_like()?
        .f_masked_fill(&mask.f_eq(0.0)?, f64::NEG_INFINITY)
}

#[cfg(test)]
mod tests {
    use tch::Device;
    use tch::nn::VarStore;

    use super::*;

    #[test]
    fn attention_with_a_bias_of_its_own_picks_one_token() {
        let float = (Kind::Float, Device::Cpu);
        let [query, key, value] = [(); 3].map(|()| Tensor::randn([3, 4, 2, 8], float));
        let mask = Tensor::from_slice(&[0f32, 1.0, 0.0, 0.0]);
        let out = attend(
            &query,
            &key,
            &value,
            Some(&unseen(&mask).unwrap().view([1, 1, 1, 4])),
        )
        .unwrap();
        let expected = value
            .narrow(1, 1, 1)
            .expand([3, 4, 2, 8], false)
            .reshape([3, 4, 16]);
        assert!((out - expected).abs().max().double_value(&[]) < 1e-6);
    }

    #[test]
    fn a_bias_that_learns_changes_the_way_and_not_the_result() {
        let float = (Kind::Float, Device::Cpu);
        let [query, key, value] = [6, 4, 4].map(|tokens| Tensor::randn([3, tokens, 2, 8], float));
        for shape in [vec![6, 4], vec![1, 2, 6, 4], vec![3, 2, 6, 4]] {
            let bias = Tensor::randn(shape.as_slice(), float);
            let fused = attend(&query, &key, &value, Some(&bias)).unwrap();
            let bias = bias.set_requires_grad(true);
            let learnt = attend(&query, &key, &value, Some(&bias)).unwrap();
            assert!(
                (fused - &learnt).abs().max().double_value(&[]) < 1e-5,
                "{shape:?}"
            );
            learnt.square().sum(Kind::Float).backward();
            assert_eq!(bias.grad().size(), shape);
        }
    }

    #[test]
    fn other_channels_are_an_error() {
        let variables = VarStore::new(Device::Cpu);
        let layer = FeedForwardBlock::new(&variables.root(), 4, 8, 0.1);
        assert!(
            layer
                .forward(&Tensor::zeros([2, 5], (Kind::Float, Device::Cpu)), false)
                .is_err()
        );
        let names: Vec<_> = variables.variables().into_keys().collect();
        assert!(
            names
                .iter()
                .all(|name| name.starts_with("norm.") || name.starts_with("fn.net.")),
            "{names:?}"
        );
    }
}
