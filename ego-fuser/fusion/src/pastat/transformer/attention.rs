//! Attention among the tokens of one cell, over agents and time, and among the tokens of one map, within windows.

use tch::nn::{self, Init, Module};
use tch::{Kind, Result, Tensor};

use super::window_loops::{TokenWindows, attend};
use crate::f64_tensor::{are_numbers, numbers};
use crate::layers::BARE;
use crate::pastat::extensions::ego_queries::Others;

/// Score of masked tokens: low enough for zero weight, and finite, so that rows without valid tokens stay finite.
const MASKED: f64 = -1e9;

/// Multi-head self-attention over agents and time at each cell (the MSA of Eq. 8).
#[derive(Debug)]
pub(super) struct AgentTimeAttention {
    query: nn::Linear,
    key: nn::Linear,
    value: nn::Linear,
    out: nn::Linear,
    /// `[D, heads]`, 1 where a channel belongs to a head: sums over a head's channels are products with it, and so are
    /// copies of a head's weight to its channels; both cost less than sums and products of many small rows.
    members: Tensor,
    heads: i64,
}

impl AgentTimeAttention {
    pub(super) fn new(path: &nn::Path<'_>, dim: i64, heads: i64) -> Self {
        let identity = Tensor::eye(heads, (Kind::Float, path.device()));
        Self {
            query: nn::linear(path / "query", dim, dim, BARE),
            key: nn::linear(path / "key", dim, dim, BARE),
            value: nn::linear(path / "value", dim, dim, BARE),
            out: nn::linear(path / "out", dim, dim, nn::LinearConfig::default()),
            members: identity.repeat_interleave_self_int(dim / heads, 0, None),
            heads,
        }
    }

    /// Attention of the ego's newest to all, at each cell: sums over few entries are cheaper than products of small
    /// matrices.
    ///
    /// # Shapes
    /// - `tokens`: `[N, h, w, D]`, the ego's newest first
    /// - `valid`: `[N, h, w]`, 1 for valid tokens
    /// - returns: `[1, h, w, D]`
    pub(super) fn forward(&self, tokens: &Tensor, valid: &Tensor) -> Result<Tensor> {
        let (entries, height, width, dim) = tokens.size4()?;
        let (cells, each) = (height * width, dim / self.heads);
        let query = self.query.forward(&tokens.f_narrow(0, 0, 1)?) / (each as f64).sqrt();
        let [query, key, value] = [query, self.key.forward(tokens), self.value.forward(tokens)]
            .map(|tensor| tensor.f_view([-1, cells, dim]));
        // Masked tokens get no weight, whatever they contain.
        let hidden = valid.f_eq(0.0)?.f_view([entries, cells, 1])?;
        let scores = (query? * key?).f_matmul(&self.members)?;
        let weights = scores.f_masked_fill(&hidden, MASKED)?.f_softmax(0, None)?;
        let mixed = (weights.f_matmul(&self.members.f_transpose(0, 1)?)? * value?)
            .f_sum_dim_intlist([0_i64].as_slice(), true, None)?;
        Ok(self.out.forward(&mixed.f_reshape([1, height, width, dim])?))
    }

    /// Attention of the ego to all, from tokens that are not normalised yet: the result of `forward`.
    ///
    /// A head's score of a token is the product of its query, led back through the weights of keys and norm, with the
    /// token; the constant term of the norm changes no weight. So neither keys nor values are computed.
    ///
    /// # Shapes
    /// - `ego`, returns: `[1, h, w, D]`
    pub(super) fn gather(
        &self,
        norm: &nn::LayerNorm,
        ego: &Tensor,
        others: &Others,
    ) -> Result<Tensor> {
        let (_, height, width, dim) = ego.size4()?;
        let (cells, each) = (height * width, dim / self.heads);
        let query = self.query.forward(&norm.forward(ego)) / (each as f64).sqrt();
        let [query, ego] =
            [&query, ego].map(|tokens| tokens.f_view([cells, dim])?.f_transpose(0, 1));
        let query = query?.f_reshape([self.heads, each, cells])?;
        let [key, value] =
            [&self.key, &self.value].map(|linear| linear.ws.f_view([self.heads, each, dim]));
        let (one, none) = (Tensor::from(1f32), Tensor::from(0f32));
        let gain = norm.ws.as_ref().unwrap_or(&one);
        let shift = norm.bs.as_ref().unwrap_or(&none);
        // Query of each head led back through the weights of the key and the gain of the norm.
        let asked = (key? * gain).f_transpose(1, 2)?.f_matmul(&query)?;
        let gathered = others.gather(&numbers(&asked)?, &numbers(&ego?)?);
        let gathered = Tensor::f_from_slice(&gathered)?.f_view([self.heads, dim, cells])?;
        let values = value?;
        // The weights of a head add up to 1, so the shift of the norm passes through the values once.
        let mixed = (&values * gain).f_matmul(&gathered)?
            + values.f_matmul(&shift.f_expand([dim], false)?.f_unsqueeze(1)?)?;
        let mixed = mixed.f_view([dim, cells])?.f_transpose(0, 1)?;
        Ok(self.out.forward(&mixed.f_reshape([1, height, width, dim])?))
    }
}

/// Attention among the tokens of a window, with windows of several sizes, each with its share of the heads.
#[derive(Debug)]
pub(super) struct MultiWindowAttention {
    query_key_value: nn::Linear,
    out: nn::Linear,
    sizes: Vec<WindowSize>,
    /// Heads of each size.
    heads: i64,
}

#[derive(Debug)]
struct WindowSize {
    edge: i64,
    /// `[(2 edge - 1)^2, heads]`: a learnt bias for each relative position.
    bias: Tensor,
    /// `[edge^4]`: the relative position of each pair.
    places: Vec<i64>,
}

impl MultiWindowAttention {
    pub(super) fn new(path: &nn::Path<'_>, dim: i64, heads: i64, edges: &[i64]) -> Self {
        let heads = heads / edges.len() as i64;
        let sizes = edges.iter().enumerate().map(|(index, &edge)| WindowSize {
            edge,
            bias: path.var(
                &format!("bias{index}"),
                &[(2 * edge - 1).pow(2), heads],
                Init::Const(0.0),
            ),
            places: relative_places(edge),
        });
        Self {
            query_key_value: nn::linear(path / "query_key_value", dim, 3 * dim, BARE),
            out: nn::linear(path / "out", dim, dim, nn::LinearConfig::default()),
            sizes: sizes.collect(),
            heads,
        }
    }

    /// Attention of each token within its windows.
    ///
    /// # Shapes
    /// - `tokens`: `[N, h, w, D]`, `h` and `w` multiples of every window
    /// - `valid`: `[N, h, w]`, 1 for valid tokens
    /// - returns: `[N, h, w, D]`
    pub(super) fn forward(&self, tokens: &Tensor, valid: &Tensor) -> Result<Tensor> {
        let (entries, height, width, dim) = tokens.size4()?;
        let share = dim / self.sizes.len() as i64;
        let projected = self.query_key_value.forward(tokens);
        // The loops over plain floats know no mask.
        let hides = valid.f_eq(0.0)?.f_any()?.f_int64_value(&[])? != 0;
        if entries == 1 && are_numbers(&projected) && !hides {
            let (projected, mut seen) = (numbers(&projected)?, vec![0.0; tokens.numel()]);
            let all = [height, width, dim, share, share / self.heads].map(|size| size as usize);
            for (index, size) in self.sizes.iter().enumerate() {
                let windows = TokenWindows {
                    size: [all[0], all[1]],
                    edge: size.edge as usize,
                    channels: [all[2], index * all[3], all[4]],
                    preference: numbers(&self.preference(size)?)?,
                };
                attend(&windows, &projected, &mut seen);
            }
            let seen = Tensor::f_from_slice(&seen)?.f_view([1, height, width, dim])?;
            return Ok(self.out.forward(&seen));
        }
        let mut parts = Vec::with_capacity(self.sizes.len());
        for (index, size) in self.sizes.iter().enumerate() {
            // Channels are queries, keys, values: in each, every size of window has its share.
            let [query, key, value] = [0, 1, 2]
                .map(|which| projected.f_narrow(3, which * dim + index as i64 * share, share));
            parts.push(self.within(size, [query?, key?, value?], valid)?);
        }
        Ok(self.out.forward(&Tensor::f_cat(&parts, 3)?))
    }

    fn within(&self, size: &WindowSize, parts: [Tensor; 3], valid: &Tensor) -> Result<Tensor> {
        let (entries, height, width, share) = parts[0].size4()?;
        let (edge, each) = (size.edge, share / self.heads);
        let (down, across) = (height / edge, width / edge);
        // One row for each window and head: one batched product computes them all.
        let [query, key, value] = parts.map(|tensor| {
            tensor
                .f_reshape([entries, down, edge, across, edge, self.heads, each])?
                .f_permute([0, 1, 3, 5, 2, 4, 6])?
                .f_reshape([entries * down * across, self.heads, edge * edge, each])
        });
        let (query, key, value) = (query?, key?, value?);
        let mut scores = (query / (each as f64).sqrt()).f_matmul(&key.f_transpose(2, 3)?)?;
        scores = scores.f_add_(&self.preference(size)?)?;
        let hidden = valid.f_eq(0.0)?;
        // Few maps have masked tokens; without any, a pass over all scores is saved.
        if hidden.f_any()?.f_int64_value(&[])? != 0 {
            let hidden = hidden
                .f_view([entries, down, edge, across, edge])?
                .f_permute([0, 1, 3, 2, 4])?;
            let hidden = hidden.f_reshape([entries * down * across, 1, 1, edge * edge])?;
            scores = scores.f_masked_fill(&hidden, MASKED)?;
        }
        let weights = scores.f_softmax(3, None)?;
        weights
            .f_matmul(&value)?
            .f_view([entries, down, across, self.heads, edge, edge, each].as_slice())?
            .f_permute([0, 1, 4, 2, 5, 3, 6])?
            .f_reshape([entries, height, width, share])
    }

    /// `[heads, edge^2, edge^2]`.
    fn preference(&self, size: &WindowSize) -> Result<Tensor> {
        let tokens = size.edge * size.edge;
        let places = Tensor::f_from_slice(&size.places)?.f_to_device(size.bias.device())?;
        size.bias
            .f_index_select(0, &places)?
            .f_view([tokens, tokens, self.heads])?
            .f_permute([2, 0, 1])?
            .f_contiguous()
    }
}

/// Row of the bias table for each pair of tokens of a window.
fn relative_places(edge: i64) -> Vec<i64> {
    let tokens = edge * edge;
    let places = (0..tokens * tokens).map(|pair| {
        let (a, b) = (pair / tokens, pair % tokens);
        let (rows, columns) = (a / edge - b / edge, a % edge - b % edge);
        (rows + edge - 1) * (2 * edge - 1) + columns + edge - 1
    });
    places.collect()
}

#[cfg(test)]
mod tests {
    use tch::Device;
    use tch::nn::VarStore;

    use super::*;
    use crate::test_data::{redraw, uniform};

    const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);

    #[test]
    fn what_the_ego_gathers_is_what_one_row_learns() {
        let variables = VarStore::new(Device::Cpu);
        let attention = AgentTimeAttention::new(&variables.root(), 12, 2);
        let norm = nn::layer_norm(
            variables.root() / "norm",
            vec![12],
            nn::LayerNormConfig::default(),
        );
        redraw(&variables, &["weight", "bias"], 0.8);
        // More cells than a strip, and a rest.
        let tokens = uniform(1, &[4, 9, 10, 12]) * 3.0;
        let valid = uniform(2, &[4, 9, 10]).gt(0.4).to_kind(Kind::Float);
        // No valid tokens here.
        let _ = valid.select(1, 0).select(1, 0).fill_(0.0);
        let forward = attention.forward(&norm.forward(&tokens), &valid).unwrap();
        let others = Others::of(&tokens.permute([0, 3, 1, 2]), &valid).unwrap();
        let gathered = attention
            .gather(&norm, &tokens.narrow(0, 0, 1), &others)
            .unwrap();
        assert!(
            gathered.allclose(&forward, 1e-4, 1e-5, false),
            "{}",
            (gathered - forward).abs().max()
        );
    }

    #[test]
    fn hidden_tokens_are_not_attended_to() {
        let variables = VarStore::new(Device::Cpu);
        let agents = AgentTimeAttention::new(&(variables.root() / "a"), 8, 2);
        let windows = MultiWindowAttention::new(&(variables.root() / "w"), 8, 2, &[2, 4]);
        let tokens = Tensor::randn([2, 4, 8, 8], FLOAT);
        let valid = Tensor::ones([2, 4, 8], FLOAT);
        let _ = valid.get(1).fill_(0.0);
        let changed = tokens.copy();
        let _ = changed.get(1).fill_(7.0);
        let [first, second] =
            [&tokens, &changed].map(|tokens| agents.forward(tokens, &valid).unwrap());
        assert!(first.allclose(&second, 1e-5, 1e-6, false));
        let _ = valid.get(0).get(1).get(3).fill_(0.0);
        let _ = changed.get(0).get(1).get(3).fill_(9.0);
        let [first, second] =
            [&tokens, &changed].map(|tokens| windows.forward(tokens, &valid).unwrap());
        let difference =
            (first - second)
                .abs()
                .sum_dim_intlist([3_i64].as_slice(), false, Kind::Float);
        let _ = difference.get(0).get(1).get(3).fill_(0.0);
        assert!(
            difference.get(0).max().double_value(&[]) < 1e-5,
            "only the hidden token itself may change"
        );
        assert!(
            difference.isfinite().all().int64_value(&[]) == 1,
            "a window with nothing valid is a number too"
        );
    }

    #[test]
    fn numbers_and_tensors_attend_alike() {
        let variables = VarStore::new(Device::Cpu);
        // Windows of 9 tokens are no whole number of vectors.
        let windows = MultiWindowAttention::new(&variables.root(), 12, 2, &[3, 6]);
        redraw(&variables, &["weight", "bias"], 0.8);
        let tokens = uniform(1, &[1, 12, 18, 12]) * 3.0;
        let valid = Tensor::ones([1, 12, 18], FLOAT);
        let tensors = windows.forward(&tokens, &valid).unwrap();
        let numbers = tch::no_grad(|| windows.forward(&tokens, &valid)).unwrap();
        assert!(tensors.requires_grad() && numbers.allclose(&tensors, 1e-4, 1e-5, false));
    }

    #[test]
    fn tokens_of_other_windows_do_not_matter() {
        let variables = VarStore::new(Device::Cpu);
        let windows = MultiWindowAttention::new(&variables.root(), 8, 2, &[2, 4]);
        let tokens = Tensor::randn([1, 4, 8, 8], FLOAT);
        let changed = tokens.copy();
        let _ = changed.narrow(2, 4, 4).fill_(3.0);
        let valid = Tensor::ones([1, 4, 8], FLOAT);
        let [left, left_again] = [&tokens, &changed]
            .map(|tokens| windows.forward(tokens, &valid).unwrap().narrow(2, 0, 4));
        assert!(left.allclose(&left_again, 1e-5, 1e-6, false));
    }

    #[test]
    fn pairs_in_the_same_relation_share_a_place() {
        let places = relative_places(3);
        let of_token: Vec<&[i64]> = places.chunks_exact(9).collect();
        assert_eq!(of_token[0][1], of_token[4][5]);
        assert_ne!(of_token[0][1], of_token[1][0]);
        assert!(places.iter().all(|place| (0..25).contains(place)));
    }
}
