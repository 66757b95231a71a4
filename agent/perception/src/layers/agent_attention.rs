//! Attention across agents at every cell, without learnt projections (AttFuse).

use tch::{Kind, TchError, Tensor};

/// Fuses the feature maps of all agents at each cell by the attention of the first agent, the ego.
///
/// At a cell the ego's features are the query, the features of all agents are keys and values:
/// `softmax_j(x_0 . x_j / sqrt(C)) x_j`, summed over `j`.
///
/// # Shapes
/// - `maps`: `[N, C, H, W]` on the ego's BEV grid, ego first
/// - `valid`: `[N, H, W]` `bool`, cells that an agent covers; the ego's must be all true. `None`: all
/// - returns: `[C, H, W]`
///
/// # Errors
/// Those of the tensor library, when the shapes do not fit.
pub fn attend_ego(maps: &Tensor, valid: Option<&Tensor>) -> Result<Tensor, TchError> {
    let (_, channels, _, _) = maps.size4()?;
    let query = maps.f_narrow(0, 0, 1)?;
    let scores = (maps * query).f_sum_dim_intlist([1_i64].as_slice(), false, Kind::Float)?
        / (channels as f64).sqrt();
    let scores = match valid {
        Some(valid) => scores.f_masked_fill(&valid.f_logical_not()?, f64::NEG_INFINITY)?,
        None => scores,
    };
    // Over the agents. Cells that no agent covers would be NaN, but the ego covers all.
    let weights = scores.f_softmax(0, Kind::Float)?.f_unsqueeze(1)?;
    (maps * weights).f_sum_dim_intlist([0_i64].as_slice(), false, Kind::Float)
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;

    #[test]
    fn ego_only_is_the_identity_and_a_masked_agent_does_not_count() {
        let maps = Tensor::randn([2, 4, 3, 5], (Kind::Float, Device::Cpu));
        let ego = maps.get(0);
        assert!(
            attend_ego(&maps.narrow(0, 0, 1), None)
                .unwrap()
                .allclose(&ego, 1e-6, 1e-6, false)
        );
        let valid = Tensor::ones([2, 3, 5], (Kind::Bool, Device::Cpu));
        let _ = valid.get(1).fill_(0);
        assert!(
            attend_ego(&maps, Some(&valid))
                .unwrap()
                .allclose(&ego, 1e-6, 1e-6, false)
        );
        assert!(
            !attend_ego(&maps, None)
                .unwrap()
                .allclose(&ego, 1e-3, 1e-3, false)
        );
    }
}
