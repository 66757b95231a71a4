//! MSwin: attention within windows of several sizes, for every agent separately.

use tch::{Kind, TchError, Tensor, nn};

use super::config::{Merge, WindowConfig};
use crate::block_order::BlockOrder;
use crate::f64_tensor::{one_after_another, sum_over_first};
use crate::layers::{LayerNorm, Linear, SMALL, attend, dropout};

/// Tokens that are computed at once outside training: intermediate results then stay in the cache.
const CHUNK: i64 = 1024;

/// Attention within windows of one size, with a bias by relative position.
#[derive(Debug)]
pub struct WindowBranch {
    tokens: i64,
    heads: i64,
    to_qkv: Linear,
    /// `[2 * edge - 1, 2 * edge - 1]`, one for all heads.
    pos_embedding: Tensor,
    /// `[tokens^2]`: index of each pair's offset in the flat `pos_embedding`.
    offsets: Tensor,
    out: Linear,
}

impl WindowBranch {
    fn new(path: &nn::Path<'_>, channels: i64, config: &WindowConfig, order: &BlockOrder) -> Self {
        let (edge, inner) = (config.edge, config.heads * config.head_channels);
        // The tokens of a window are in block order, not row by row.
        let places = order.places(edge);
        let span = 2 * edge - 1;
        let mut offsets = Vec::with_capacity(places.len() * places.len());
        for [row, column] in &places {
            for to in &places {
                offsets.push((to[0] - row + edge - 1) * span + to[1] - column + edge - 1);
            }
        }
        Self {
            tokens: edge * edge,
            heads: config.heads,
            to_qkv: Linear::new(&(path / "to_qkv"), channels, 3 * inner, false),
            pos_embedding: path.var("pos_embedding", &[span, span], SMALL),
            offsets: Tensor::from_slice(&offsets).to_device(path.device()),
            out: Linear::residual(&(path / "to_out" / 0), inner, channels, true),
        }
    }

    /// `[tokens, tokens]` added to the scores.
    fn bias(&self) -> Result<Tensor, TchError> {
        self.pos_embedding
            .f_view([-1])?
            .f_index_select(0, &self.offsets)?
            .f_view([self.tokens, self.tokens])
    }

    /// Tokens of whole windows `[t, C]` to `[t, inner]`, before the last projection.
    fn attend(&self, x: &Tensor, bias: &Tensor) -> Result<Tensor, TchError> {
        let qkv = self.to_qkv.forward(x)?;
        let head_channels = qkv.size()[1] / (3 * self.heads);
        let qkv = qkv.f_view([-1, self.tokens, 3, self.heads, head_channels])?;
        let parts = qkv.f_unbind(2)?;
        attend(&parts[0], &parts[1], &parts[2], Some(bias))?
            .f_view([-1, self.heads * head_channels])
    }

    /// Output of this branch: the tokens of one agent, `[T, C]` to the same.
    ///
    /// # Errors
    /// [`TchError`] when the tokens do not fill complete windows.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor, TchError> {
        self.out.forward(&self.attend(x, &self.bias()?)?)
    }
}

/// The gate of a split-attention merge: weight of each branch in each channel.
#[derive(Debug)]
struct Gate {
    fc1: Linear,
    bn1: LayerNorm,
    fc2: Linear,
}

impl Gate {
    /// From the branches' summed mean over the map `[C]` to shares `[branches, C]`.
    fn shares(&self, mean: &Tensor) -> Result<Tensor, TchError> {
        let hidden = self.bn1.forward(&self.fc1.forward(mean)?)?.f_relu()?;
        self.fc2
            .forward(&hidden)?
            .f_view([-1, mean.size()[0]])?
            .f_softmax(0, None::<Kind>)
    }
}

/// Window attention of several sizes side by side, merged.
#[derive(Debug)]
pub struct WindowAttention {
    /// The branches, in the order of the configuration.
    pub branches: Vec<WindowBranch>,
    gate: Option<Gate>,
    largest: i64,
    dropout: f64,
}

impl WindowAttention {
    /// Variables `pwmsa` and, for a merge by attention, `split_attn` below `path`.
    pub fn new(
        path: &nn::Path<'_>,
        channels: i64,
        windows: &[WindowConfig],
        merge: Merge,
        order: &BlockOrder,
        dropout: f64,
    ) -> Self {
        let branches = windows.iter().enumerate().map(|(index, config)| {
            WindowBranch::new(&(path / "pwmsa" / index), channels, config, order)
        });
        let (gate, wide) = (path / "split_attn", windows.len() as i64 * channels);
        let gate = (merge == Merge::SplitAttention).then(|| Gate {
            fc1: Linear::new(&(&gate / "fc1"), channels, channels, false),
            bn1: LayerNorm::new(&(&gate / "bn1"), channels),
            fc2: Linear::new(&(&gate / "fc2"), channels, wide, false),
        });
        let largest = order.largest() * order.largest();
        Self {
            branches: branches.collect(),
            gate,
            largest,
            dropout,
        }
    }

    /// The tokens of one agent, `[T, C]` in block order, to the same.
    ///
    /// # Errors
    /// [`TchError`] when the tokens do not fill complete windows.
    pub fn forward(&self, x: &Tensor, train: bool) -> Result<Tensor, TchError> {
        let tokens = x.size2()?.0;
        let chunk = match train {
            true => tokens,
            // Complete windows of the largest size are complete windows of every size.
            false => (CHUNK / self.largest).max(1) * self.largest,
        };
        let biases = self.branches.iter().map(WindowBranch::bias);
        let biases = biases.collect::<Result<Vec<_>, _>>()?;
        let chunks = x.f_split(chunk.max(1), 0)?;
        let seen = chunks.iter().map(|x| {
            let branches = self.branches.iter().zip(&biases);
            let seen = branches.map(|(branch, bias)| branch.attend(x, bias));
            seen.collect::<Result<Vec<Tensor>, TchError>>()
        });
        let seen: Vec<Vec<Tensor>> = seen.collect::<Result<_, _>>()?;
        let (weights, bias) = self.merged(&seen, tokens)?;
        let outputs = seen.iter().map(|seen| project(seen, &weights, &bias));
        let output = one_after_another(&outputs.collect::<Result<Vec<_>, _>>()?)?;
        dropout(output, self.dropout, train)
    }

    /// The last projections with the merge multiplied into them: `[inner, C]` for each branch, and one bias `[C]`.
    ///
    /// Both merges weight the branches' outputs channel by channel. Those outputs are linear in the attention outputs,
    /// so the weights go into the projection, and so does the mean over the map that the gate needs.
    fn merged(&self, seen: &[Vec<Tensor>], tokens: i64) -> Result<(Vec<Tensor>, Tensor), TchError> {
        let biases = (self.branches.iter())
            .map(|branch| branch.out.bias.as_ref().expect("the projection has a bias"));
        let biases = Tensor::f_stack(&biases.collect::<Vec<_>>(), 0)?;
        let shares = match &self.gate {
            None => biases.f_ones_like()? / self.branches.len() as f64,
            Some(gate) => {
                let mut parts = vec![sum_over_first(&biases)?];
                for (index, branch) in self.branches.iter().enumerate() {
                    let sums = seen.iter().map(|seen| sum_over_first(&seen[index]));
                    let sums = Tensor::f_stack(&sums.collect::<Result<Vec<_>, _>>()?, 0)?;
                    let sum = sum_over_first(&sums)? / tokens as f64;
                    parts.push(branch.out.weight.f_mv(&sum)?);
                }
                let mean = sum_over_first(&Tensor::f_stack(&parts, 0)?)?;
                gate.shares(&mean)?
            }
        };
        let weights = (0..).zip(&self.branches).map(|(index, branch)| {
            let weight = branch.out.weight.f_transpose(0, 1)?;
            weight.f_mul(&shares.f_get(index)?)
        });
        let weights = weights.collect::<Result<Vec<_>, TchError>>()?;
        Ok((weights, sum_over_first(&(&biases * &shares))?))
    }
}

/// The sum over the branches of `seen W`, and `bias`.
fn project(seen: &[Tensor], weights: &[Tensor], bias: &Tensor) -> Result<Tensor, TchError> {
    let mut sum = bias.f_addmm(&seen[0], &weights[0])?;
    for (seen, weight) in seen.iter().zip(weights).skip(1) {
        // The intermediate sum is not needed again, so it is accumulated in place.
        sum = sum.f_addmm_(seen, weight)?;
    }
    Ok(sum)
}
