//! HMSA: heterogeneous multi-agent self-attention, across the agents at every cell.

use tch::{TchError, Tensor, nn};

use crate::f64_tensor::picked;
use crate::layers::{Linear, SMALL, attend, dropout};

/// Types of agents with separate projections: vehicles and infrastructure.
const AGENT_TYPES: usize = 2;
/// Cells that are computed at once outside training, for all agents together.
const CHUNK: i64 = 512;

/// Attention whose projections depend on the type of an agent, and whose scores and messages depend on the two types.
///
/// `softmax_j(q_i W_att[i, j] k_j / sqrt(D)) v_j W_msg[i, j]`, head by head. The matrices of a relation are multiplied
/// into those of keys and values once, since they are constant and the cells are many.
#[derive(Debug)]
pub struct AgentAttention {
    heads: i64,
    query: [Linear; AGENT_TYPES],
    key: [Linear; AGENT_TYPES],
    value: [Linear; AGENT_TYPES],
    out: [Linear; AGENT_TYPES],
    /// `[AGENT_TYPES^2, M, D, D]`, the type of the query first.
    relation_att: Tensor,
    /// The same for messages.
    relation_msg: Tensor,
    dropout: f64,
}

impl AgentAttention {
    /// Variables `q_linears`, `k_linears`, `v_linears`, `a_linears`, `relation_att` and `relation_msg` below `path`.
    pub fn new(path: &nn::Path<'_>, channels: i64, heads: i64, each: i64, dropout: f64) -> Self {
        let inner = heads * each;
        let [query, key, value] = ["q_linears", "k_linears", "v_linears"].map(|name| {
            std::array::from_fn(|kind| Linear::new(&(path / name / kind), channels, inner, true))
        });
        Self {
            heads,
            query,
            key,
            value,
            out: std::array::from_fn(|kind| {
                Linear::residual(&(path / "a_linears" / kind), inner, channels, true)
            }),
            relation_att: relation(path, "relation_att", heads, each),
            relation_msg: relation(path, "relation_msg", heads, each),
            dropout,
        }
    }

    /// Attention of the first `queries` agents to all.
    ///
    /// # Shapes
    /// - `x`: `[N, T, C]`, `T` cells
    /// - `unseen`: `[N, T]`, 0 where a cell of an agent is valid and minus infinity where not; absent: all are valid
    /// - `types`: `N` below `AGENT_TYPES`
    /// - returns: `[queries, T, C]`
    ///
    /// # Errors
    /// [`TchError`] when shapes do not fit.
    pub fn forward(
        &self,
        x: &Tensor,
        unseen: Option<&Tensor>,
        types: &[usize],
        queries: usize,
        train: bool,
    ) -> Result<Tensor, TchError> {
        let (agents, cells, _) = x.size3()?;
        if types.len() as i64 != agents
            || queries > types.len()
            || types.iter().any(|&kind| kind >= AGENT_TYPES)
        {
            return Err(TchError::Shape(format!(
                "{queries} of {agents} agents of the types {types:?}"
            )));
        }
        let chunk = if train { cells } else { CHUNK };
        // Projections depend on the type only: one set serves all agents of a type.
        let mut kinds = types[..queries].to_vec();
        kinds.sort_unstable();
        kinds.dedup();
        let asked = kinds
            .into_iter()
            .map(|kind| Ok((kind, self.key_values(kind)?)));
        let asked = asked.collect::<Result<Vec<_>, TchError>>()?;
        let mut seen = Vec::new();
        for first in (0..cells).step_by(chunk.max(1) as usize) {
            let length = chunk.min(cells - first);
            let x = x.f_narrow(1, first, length)?;
            let unseen = unseen
                .map(|unseen| unseen.f_narrow(1, first, length))
                .transpose()?;
            seen.push(self.chunk(&x, unseen.as_ref(), types, queries, &asked)?);
        }
        dropout(Tensor::f_cat(&seen, 1)?, self.dropout, train)
    }

    fn chunk(
        &self,
        x: &Tensor,
        unseen: Option<&Tensor>,
        types: &[usize],
        queries: usize,
        asked: &[(usize, Vec<Linear>)],
    ) -> Result<Tensor, TchError> {
        // [N, t] to [t, 1, 1, N]: added to the scores of all heads and all queries.
        let bias = unseen.map(|unseen| {
            unseen
                .f_transpose(0, 1)?
                .f_contiguous()?
                .f_view([-1, 1, 1, types.len() as i64])
        });
        let bias = bias.transpose()?;
        let mut answers: Vec<Option<Tensor>> = (0..queries).map(|_| None).collect();
        for (kind, key_values) in asked {
            let askers: Vec<i64> = (0..queries as i64)
                .filter(|&agent| types[agent as usize] == *kind)
                .collect();
            // Usually all agents are of one type and all ask: then nothing is copied.
            let query = match askers.len() == types.len() {
                true => x.shallow_clone(),
                false => picked(x, &askers)?,
            };
            let asked = (*kind, &key_values[..]);
            let answer = self.answer(&query, x, types, asked, bias.as_ref())?;
            let answer = self.out[*kind].forward(&answer)?.f_transpose(0, 1)?;
            // One type asks for all: its answers already have the order of the agents.
            if askers.len() == queries {
                return Ok(answer);
            }
            for (index, &agent) in (0..).zip(&askers) {
                answers[agent as usize] = Some(answer.f_get(index)?);
            }
        }
        let answers: Vec<Tensor> = answers.into_iter().flatten().collect();
        Tensor::f_stack(&answers, 0)
    }

    /// `[Q, t, C]` as queries of `[N, t, C]`: `[t, Q, M * D]`.
    fn answer(
        &self,
        query: &Tensor,
        x: &Tensor,
        types: &[usize],
        (kind, key_values): (usize, &[Linear]),
        bias: Option<&Tensor>,
    ) -> Result<Tensor, TchError> {
        let inner = self.query[kind].weight.size()[0];
        let first = &key_values[types[0]];
        if types.len() == 1 {
            // With a single agent all weights are 1.
            let weight = first.weight.f_narrow(0, inner, inner)?;
            let offset = first.bias.as_ref();
            let offset = offset.map(|offset| offset.f_narrow(0, inner, inner));
            return x.f_linear(&weight, offset.transpose()?)?.f_transpose(0, 1);
        }
        let query = self.query[kind].forward(query)?;
        // One product over all agents is faster than one for each.
        let key_value = if types.iter().all(|kind| *kind == types[0]) {
            first.forward(x)?
        } else {
            let each = (0..).zip(types);
            let each = each.map(|(agent, &kind)| key_values[kind].forward(&x.f_get(agent)?));
            Tensor::f_stack(&each.collect::<Result<Vec<_>, TchError>>()?, 0)?
        };
        // Cells are the groups, agents the tokens.
        let parts = key_value.f_split(inner, 2)?;
        let [query, key, value] = [&query, &parts[0], &parts[1]].map(|x| {
            x.f_unflatten(2, [self.heads, inner / self.heads])?
                .f_transpose(0, 1)
        });
        attend(&query?, &key?, &value?, bias)
    }

    /// Keys and values, in this order, of senders of each type for queries of type `kind`, with the relations multiplied
    /// in.
    fn key_values(&self, kind: usize) -> Result<Vec<Linear>, TchError> {
        let senders = (0..AGENT_TYPES).map(|sender| {
            let relation = (kind * AGENT_TYPES + sender) as i64;
            let att = self.relation_att.f_get(relation)?;
            let msg = self.relation_msg.f_get(relation)?;
            // q W k = q (W k), and (v as a row) W = W^T v.
            let key = folded(&att, &self.key[sender])?;
            let value = folded(&msg.f_transpose(1, 2)?, &self.value[sender])?;
            Ok(Linear {
                weight: Tensor::f_cat(&[key.0, value.0], 0)?,
                bias: Some(Tensor::f_cat(&[key.1, value.1], 0)?),
            })
        });
        senders.collect()
    }
}

/// A matrix for each pair of types and each head. Near the identity: typed attention starts as ordinary attention.
fn relation(path: &nn::Path<'_>, name: &str, heads: i64, channels: i64) -> Tensor {
    let pairs = (AGENT_TYPES * AGENT_TYPES) as i64;
    let relation = path.var(name, &[pairs, heads, channels, channels], SMALL);
    let identity = Tensor::eye(channels, (relation.kind(), relation.device()));
    let _ = tch::no_grad(|| relation.shallow_clone().g_add_(&identity));
    relation
}

/// A projection with a matrix per head, `[M, D, D]`, multiplied into it from the left.
fn folded(matrix: &Tensor, linear: &Linear) -> Result<(Tensor, Tensor), TchError> {
    let (heads, channels, _) = matrix.size3()?;
    let weight = matrix
        .f_bmm(&linear.weight.f_view([heads, channels, -1])?)?
        .f_reshape_as(&linear.weight)?;
    let bias = linear.bias.as_ref().expect("all projections have a bias");
    let bias = matrix
        .f_bmm(&bias.f_view([heads, channels, 1])?)?
        .f_reshape([-1])?;
    Ok((weight, bias))
}
