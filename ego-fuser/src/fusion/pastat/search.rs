//! The search for a map that lies far from where its pose puts it.

use tch::{TchError, Tensor};

use super::area::Area;
use super::config::SearchConfig;
use super::correlation::{correlate, shifts};

/// How far each map lies from where its pose puts it, to the large cell, `[K, 2]` along x and y, metres: what FSA compares is
/// compared once more with large cells and far around, and what fits better somewhere else by a margin belongs there.
///
/// No gradient flows: what is compared is learnt from near.
///
/// # Shapes
/// - `ego`, `others`: `[1, M, H, W]`, `[K, M, H, W]`: what is compared, on the lattice of `area`
pub(super) fn offsets(
    [ego, others]: [&Tensor; 2],
    area: &Area,
    SearchConfig { cells, radius, margin }: SearchConfig,
) -> Result<Tensor, TchError> {
    let cells = cells / area.cells();
    let none: [i64; 2] = [0, 0];
    let large =
        |maps: &Tensor| maps.f_detach()?.f_avg_pool2d([cells, cells], [cells, cells], none, false, true, None::<i64>);
    let fit = correlate([&large(ego)?, &large(others)?], radius, 1)?.whole;
    let shifts = (shifts(radius)? * (area.cell_m() * cells as f64)).f_to_device(fit.device())?;
    let _ = fit.f_select(1, shifts.size()[0] / 2)?.f_add_scalar_(margin)?;
    shifts.f_index_select(0, &fit.f_argmax(-1, false)?)
}

#[cfg(test)]
mod tests {
    use protocol::BevGrid;
    use tch::Kind;

    use super::*;
    use crate::made_up::uniform;

    const CONFIG: SearchConfig = SearchConfig { cells: 4, radius: 5, margin: 0.3 };
    const GRID: BevGrid = BevGrid { x_min_m: -24.0, y_min_m: -16.0, cell_m: 0.5, width: 96, height: 64 };

    fn area() -> Area {
        Area::new(&GRID, [64, 96], 4)
    }

    /// Vehicles here and there, zero in the mean.
    fn map(seed: u64) -> Tensor {
        let cells = uniform(seed, &[1, 2, 64, 96]).gt(0.99).to_kind(Kind::Float);
        &cells - cells.mean(Kind::Float)
    }

    fn found(maps: [&Tensor; 2], area: &Area) -> Vec<f32> {
        Vec::try_from(offsets(maps, area, CONFIG).unwrap().view(-1)).unwrap()
    }

    #[test]
    fn a_lost_map_is_found_and_others_stay() {
        let ego = map(1);
        // Where its pose puts it; twelve cells too far along x and sixteen back along y; somebody else's.
        let others = Tensor::cat(&[&ego, &ego.roll([-16, 12], [2, 3]), &map(2)], 0);
        assert_eq!(found([&ego, &others], &area()), [0.0, 0.0, -6.0, 8.0, 0.0, 0.0]);
        // The same in cells of two by two, of which two by two are a large cell.
        let [ego, others] = [&ego, &others].map(|maps| maps.avg_pool2d([2, 2], [2, 2], [0, 0], false, true, None));
        assert_eq!(found([&ego, &others], &area().with_cells_of(2)), [0.0, 0.0, -6.0, 8.0, 0.0, 0.0]);
    }

    #[test]
    fn what_fits_better_by_less_than_the_margin_stays() {
        let ego = map(1);
        let other = ego.roll([12], [3]) * 0.6 + &ego * 0.5;
        let with = |margin| offsets([&ego, &other], &area(), SearchConfig { margin, ..CONFIG }).unwrap();
        assert_eq!(Vec::<f32>::try_from(with(0.0).view(-1)).unwrap(), [-6.0, 0.0]);
        assert_eq!(Vec::<f32>::try_from(with(0.2).view(-1)).unwrap(), [0.0, 0.0]);
    }
}
