//! The search for a map that lies far from where its pose puts it.

use protocol::Pose;
use tch::{TchError, Tensor};

use super::area::{Area, lattice};
use super::config::SearchConfig;
use super::correlation::{Shifted, shifts};
use crate::warp::{BILINEAR, PADDING_ZEROS};

/// Turns that are tried beside none, radians: FSA undoes what lies between two of them.
const TURNS_RAD: [f64; 8] = [-0.08, 0.08, -0.16, 0.16, -0.24, 0.24, -0.32, 0.32];
/// A turned map is looked for up to so many large cells away: a try is cheap then, and few err far in both.
const TURNED_RADIUS: i64 = 4;
/// A turned map has to fit better by this, as one of many tries fits better by chance.
const TURN_MARGIN: f64 = 0.03;

/// How far each map lies from where its pose puts it, to the large cell, `[K, 3]` along x and y, metres, and about its sender,
/// radians: what FSA compares is compared once more with large cells and far around, and what fits better somewhere else
/// belongs there.
///
/// Training has a margin for that and tries shifts alone. No gradient flows: what is compared is learnt from near.
///
/// # Shapes
/// - `ego`, `others`: `[1, M, H, W]`, `[K, M, H, W]`: what is compared, on the lattice of `area`
/// - `ego_from_cav`: `K` poses of the maps' senders
pub(super) fn offsets(
    [ego, others]: [&Tensor; 2],
    ego_from_cav: &[Pose],
    area: &Area,
    SearchConfig { cells, radius, margin }: SearchConfig,
    train: bool,
) -> Result<Tensor, TchError> {
    let cells = cells / area.cells();
    let none: [i64; 2] = [0, 0];
    let large =
        |maps: &Tensor| maps.f_detach()?.f_avg_pool2d([cells, cells], [cells, cells], none, false, true, None::<i64>);
    let maps = [&large(ego)?, &large(others)?];
    let cell_m = area.cell_m() * cells as f64;
    let fit = Shifted::new(maps[0], radius, 1)?.correlate(maps[1])?.whole;
    if train {
        let _ = fit.f_select(1, fit.size2()?.1 / 2)?.f_add_scalar_(margin)?;
    }
    let mut tries = vec![(fit, (shifts(radius)? * cell_m).f_constant_pad_nd([0, 1])?)];
    if !train {
        tries.extend(turned_tries(maps, ego_from_cav, area, cell_m, radius.min(TURNED_RADIUS))?);
    }
    let (fits, offsets): (Vec<_>, Vec<_>) = tries.into_iter().unzip();
    let best = Tensor::f_cat(&fits, 1)?.f_argmax(-1, false)?;
    Tensor::f_cat(&offsets, 0)?.f_to_device(best.device())?.f_index_select(0, &best)
}

/// Of each turn how well maps fit, `[K, P]`, less the margin, and the offsets `[P, 3]` of which that is.
fn turned_tries(
    [ego, others]: [&Tensor; 2],
    ego_from_cav: &[Pose],
    area: &Area,
    cell_m: f64,
    radius: i64,
) -> Result<Vec<(Tensor, Tensor)>, TchError> {
    let turned = TURNS_RAD.iter().map(|&turn_rad| turned(others, turn_rad, ego_from_cav, area));
    let turned = Tensor::f_cat(&turned.collect::<Result<Vec<_>, _>>()?, 0)?;
    // All at once, as the ego's map at each shift is the same for all.
    let fit = Shifted::new(ego, radius, 1)?.correlate(&turned)?.whole.f_sub_scalar(TURN_MARGIN)?;
    let shifts_m = shifts(radius)? * cell_m;
    let offsets = |turn_rad: f64| shifts_m.f_pad([0, 1], "constant", turn_rad);
    let of_turn = |(fit, turn_rad)| Ok((fit, offsets(turn_rad)?));
    fit.f_split(others.size4()?.0, 0)?.into_iter().zip(TURNS_RAD).map(of_turn).collect()
}

/// Maps turned about their senders.
fn turned(maps: &Tensor, turn_rad: f64, ego_from_cav: &[Pose], area: &Area) -> Result<Tensor, TchError> {
    let (count, _, rows, columns) = maps.size4()?;
    let turn = Tensor::f_from_slice(&[0.0, 0.0, turn_rad as f32])?.f_expand([count, 3], false)?;
    let places = lattice(&turn, ego_from_cav, area, [rows, columns])?.f_to_device(maps.device())?;
    maps.f_grid_sampler(&places, BILINEAR, PADDING_ZEROS, false)
}

#[cfg(test)]
mod tests {
    use protocol::BevGrid;
    use tch::Kind;

    use super::*;
    use crate::test_data::uniform;

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

    /// Seen by senders where the ego is.
    fn found(maps: [&Tensor; 2], area: &Area, config: SearchConfig, train: bool) -> Vec<f32> {
        let poses = vec![Pose::IDENTITY; maps[1].size()[0] as usize];
        Vec::try_from(offsets(maps, &poses, area, config, train).unwrap().view(-1)).unwrap()
    }

    #[test]
    fn a_lost_map_is_found_and_others_stay() {
        let ego = map(1);
        // Where its pose puts it; twelve cells too far along x and sixteen back along y; somebody else's.
        let others = Tensor::cat(&[&ego, &ego.roll([-16, 12], [2, 3]), &map(2)], 0);
        let expected = [0.0, 0.0, 0.0, -6.0, 8.0, 0.0, 0.0, 0.0, 0.0];
        assert_eq!(found([&ego, &others], &area(), CONFIG, true), expected);
        // The same in cells of two by two, of which two by two are a large cell.
        let [ego, others] = [&ego, &others].map(|maps| maps.avg_pool2d([2, 2], [2, 2], [0, 0], false, true, None));
        assert_eq!(found([&ego, &others], &area().with_cells_of(2), CONFIG, true), expected);
    }

    #[test]
    fn once_trained_a_turned_map_is_found() {
        // Vehicles of several large cells, which a turn on large cells leaves what they are.
        let ego = map(1).avg_pool2d([9, 9], [1, 1], [4, 4], false, true, None);
        for turn_rad in TURNS_RAD {
            let turned = turned(&ego, -turn_rad, &[Pose::IDENTITY], &area()).unwrap();
            let moved = turned.roll([8], [3]);
            let others = Tensor::cat(&[&ego, &turned, &moved], 0);
            let turn_rad = turn_rad as f32;
            let expected = [0.0, 0.0, 0.0, 0.0, 0.0, turn_rad];
            let found = found([&ego, &others], &area(), CONFIG, false);
            assert_eq!(found[..6], expected);
            // Turned about where its sender is, after which the shift is another.
            assert_eq!(found[8], turn_rad);
        }
    }

    #[test]
    fn in_training_what_fits_better_by_less_than_the_margin_stays() {
        let ego = map(1);
        let other = ego.roll([12], [3]) * 0.6 + &ego * 0.5;
        let with = |margin, train| found([&ego, &other], &area(), SearchConfig { margin, ..CONFIG }, train);
        assert_eq!(with(0.0, true), [-6.0, 0.0, 0.0]);
        assert_eq!(with(0.2, true), [0.0; 3]);
        assert_eq!(with(0.2, false), [-6.0, 0.0, 0.0]);
    }
}
