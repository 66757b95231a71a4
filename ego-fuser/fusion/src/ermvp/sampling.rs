//! Sampling: selects the cells of a neighbour that are worth sending.

use tch::{Kind, TchError, Tensor, nn};

use crate::layers::Linear;

/// A score per cell; of each neighbour the best cells are kept.
#[derive(Debug)]
pub(super) struct Sampler {
    hidden: Linear,
    score: Linear,
    share: f64,
}

impl Sampler {
    /// Variables `score_pred_net.0` and `.2` below `path`. `share` of a map's cells are kept.
    pub(super) fn new(path: &nn::Path<'_>, channels: i64, share: f64) -> Self {
        let path = path / "score_pred_net";
        let score = Linear::residual(&(&path / 2), channels, 1, true);
        // Near one at the start, so that selected cells are passed on almost unchanged.
        let bias = score.bias.as_ref();
        let _ = bias.map(|bias| tch::no_grad(|| bias.shallow_clone().fill_(2.0)));
        Self {
            hidden: Linear::new(&(&path / 0), channels, channels, true),
            score,
            share,
        }
    }

    /// Scores `[N, H, W]` of maps `[N, H, W, C]`, 0..1.
    pub(super) fn scores(&self, maps: &Tensor) -> Result<Tensor, TchError> {
        self.score
            .forward(&self.hidden.forward(maps)?.f_relu()?)?
            .f_squeeze_dim(3)?
            .f_sigmoid()
    }

    /// 1 at the cells that are kept: all of the ego, which sends nothing, and of each neighbour those with the best
    /// scores among the cells that it reaches.
    ///
    /// `scores`, `reach` and the result are `[N, H, W]`.
    pub(super) fn kept(&self, scores: &Tensor, reach: &Tensor) -> Result<Tensor, TchError> {
        let (agents, height, width) = scores.size3()?;
        if agents == 1 {
            return Ok(reach.shallow_clone());
        }
        let cells = height * width;
        let count = ((cells as f64 * self.share) as i64).clamp(1, cells);
        let reach_of_others = reach.f_narrow(0, 1, agents - 1)?;
        let ranked = scores.f_detach()?.f_narrow(0, 1, agents - 1)?;
        // Scores are above zero, so cells out of reach rank last.
        let ranked = (ranked * &reach_of_others).f_view([agents - 1, cells])?;
        let (_, best) = ranked.f_topk(count, 1, true, false)?;
        let kept = ranked.f_zeros_like()?.f_scatter_value(1, &best, 1.0)?;
        let kept = kept.f_view([agents - 1, height, width])?;
        // Where fewer cells are in reach than are kept, topk has filled up with others.
        let kept = kept.f_to_kind(Kind::Float)? * reach_of_others;
        Tensor::f_cat(&[reach.f_narrow(0, 0, 1)?, kept], 0)
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;
    use tch::nn::VarStore;

    use super::*;

    #[test]
    fn the_best_cells_within_reach_are_kept_and_all_of_the_ego() {
        let variables = VarStore::new(Device::Cpu);
        let sampler = Sampler::new(&variables.root(), 4, 0.25);
        let scores =
            Tensor::from_slice(&[0.1f32, 0.1, 0.1, 0.1, 0.9, 0.5, 0.2, 0.8]).view([2, 2, 2]);
        let reach = Tensor::from_slice(&[1f32, 1.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0]).view([2, 2, 2]);
        let kept = sampler.kept(&scores, &reach).unwrap();
        assert_eq!(
            Vec::<f32>::try_from(kept.view(-1)).unwrap(),
            [1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        );
        let scores = sampler
            .scores(&Tensor::rand([1, 2, 2, 4], (Kind::Float, Device::Cpu)))
            .unwrap();
        assert!(
            scores.min().double_value(&[]) > 0.7,
            "almost all passes at the start"
        );
    }
}
