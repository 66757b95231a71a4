//! The search for a map that lies far from where its pose puts it.

use tch::nn::{self, Init, Module};
use tch::{TchError, Tensor};

use super::alignment::{Area, TRUST};
use super::config::SearchConfig;
use super::correlation::{correlate, shifts};

/// How sharply the best place stands out before it is trained: correlations lie between -1 and 1.
const SHARPNESS: f64 = 40.0;
/// How much more than any other place the one that the pose tells is believed before it is trained, a logarithm: another
/// has to fit better by a tenth.
const BELIEF: f64 = 4.0;

/// Finds maps whose senders are lost: what FSA compares is compared once more with large cells and far around, and what
/// fits much better somewhere else belongs there. How much better depends on how far the sender's pose is trusted.
#[derive(Debug)]
pub(super) struct Search {
    config: SearchConfig,
    /// How sharply the best place stands out, its logarithm.
    sharpness: Tensor,
    /// How much the pose is believed, by the trust in it.
    belief: nn::Linear,
}

impl Search {
    pub(super) fn new(path: &nn::Path<'_>, config: SearchConfig) -> Self {
        let known = nn::LinearConfig { ws_init: Init::Const(0.0), bs_init: Some(Init::Const(BELIEF)), bias: true };
        Self {
            config,
            sharpness: path.var("sharpness", &[], Init::Const(SHARPNESS.ln())),
            belief: nn::linear(path / "belief", TRUST, 1, known),
        }
    }

    /// How far each map lies from where its pose puts it, to the large cell, `[K, 2]` along x and y, metres.
    ///
    /// The place that fits best is taken. Gradients flow as if it were the mean of all places by how well they fit, and
    /// into how much poses are believed alone: what is compared is learnt from near.
    ///
    /// # Shapes
    /// - `ego`, `others`: `[1, M, H, W]`, `[K, M, H, W]`: what is compared, on the lattice of `area`
    /// - `trust`: `[K, 3]`
    pub(super) fn offsets(&self, [ego, others]: [&Tensor; 2], trust: &Tensor, area: &Area) -> Result<Tensor, TchError> {
        let cells = self.config.cells / area.cells();
        let none: [i64; 2] = [0, 0];
        let large = |maps: &Tensor| {
            maps.f_detach()?.f_avg_pool2d([cells, cells], [cells, cells], none, false, true, None::<i64>)
        };
        let radius = self.config.radius;
        let fit = correlate(&large(ego)?, &large(others)?, radius)?.whole;
        let shifts = (shifts(radius)? * (area.cell_m() * cells as f64)).f_to_device(fit.device())?;
        let here = shifts.size()[0] / 2;
        let belief = self.belief.forward(trust).f_constant_pad_nd([here, here])?;
        let likely = fit * self.sharpness.f_exp()? + belief;
        let mean = likely.f_softmax(-1, None)?.f_matmul(&shifts)?;
        let best = shifts.f_index_select(0, &likely.f_argmax(-1, false)?)?;
        Ok(best + (&mean - mean.f_detach()?))
    }
}

#[cfg(test)]
mod tests {
    use protocol::BevGrid;
    use tch::nn::VarStore;
    use tch::{Device, Kind};

    use super::*;

    const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);
    const CONFIG: SearchConfig = SearchConfig { cells: 4, radius: 5 };
    const GRID: BevGrid = BevGrid { x_min_m: -24.0, y_min_m: -16.0, cell_m: 0.5, width: 96, height: 64 };

    fn area() -> Area {
        Area::new(&GRID, [64, 96], 4)
    }

    /// Vehicles here and there, zero in the mean.
    fn map() -> Tensor {
        let cells = Tensor::rand([1, 2, 64, 96], FLOAT).gt(0.99).to_kind(Kind::Float);
        &cells - cells.mean(Kind::Float)
    }

    fn found(search: &Search, maps: [&Tensor; 2], area: &Area) -> Vec<f32> {
        let trust = Tensor::ones([maps[1].size()[0], TRUST], FLOAT);
        Vec::try_from(search.offsets(maps, &trust, area).unwrap().view(-1)).unwrap()
    }

    #[test]
    fn a_lost_map_is_found_and_others_stay() {
        tch::manual_seed(2);
        let variables = VarStore::new(Device::Cpu);
        let search = Search::new(&variables.root(), CONFIG);
        let ego = map();
        // Where its pose puts it; twelve cells too far along x and sixteen back along y; somebody else's.
        let others = Tensor::cat(&[&ego, &ego.roll([-16, 12], [2, 3]), &map()], 0);
        assert_eq!(found(&search, [&ego, &others], &area()), [0.0, 0.0, -6.0, 8.0, 0.0, 0.0]);
        // The same in cells of two by two, of which two by two are a large cell.
        let [ego, others] = [&ego, &others].map(|maps| maps.avg_pool2d([2, 2], [2, 2], [0, 0], false, true, None));
        assert_eq!(found(&search, [&ego, &others], &area().with_cells_of(2)), [0.0, 0.0, -6.0, 8.0, 0.0, 0.0]);
    }

    #[test]
    fn who_is_believed_is_left_where_it_is() {
        let variables = VarStore::new(Device::Cpu);
        let search = Search::new(&variables.root(), CONFIG);
        let _ = tch::no_grad(|| variables.variables()["belief.weight"].shallow_clone().fill_(20.0));
        let ego = map();
        assert_eq!(found(&search, [&ego, &ego.roll([12], [3])], &area()), [0.0, 0.0]);
    }

    #[test]
    fn gradients_tell_how_far_to_believe_and_nothing_else() {
        let variables = VarStore::new(Device::Cpu);
        let search = Search::new(&variables.root(), CONFIG);
        let ego = map().set_requires_grad(true);
        let others = ego.detach().roll([12], [3]).set_requires_grad(true);
        search.offsets([&ego, &others], &Tensor::ones([1, TRUST], FLOAT), &area()).unwrap().sum(Kind::Float).backward();
        for (name, variable) in variables.variables() {
            assert!(variable.grad().abs().max().double_value(&[]) > 0.0, "{name}");
        }
        assert!(!ego.grad().defined() && !others.grad().defined());
    }
}
