//! Alignment search, an extension of FSA: finds maps whose offset exceeds the range of the alignment network.
//!
//! Measured gain: one neighbour 14 m off with full confidence costs 0.9 instead of 2.9 percentage points of AP@0.5
//! (ablation, FSA with search). A fine comparison at both places and a repeated comparison give 0.7
//! percentage points of AP@0.7 with all poses 1 m off; rotations give 1.5 with poses 4 m and 4 degrees off.
//!
//! Only newest maps are searched for. An earlier map is tried where the newest of its agent was found: both have poses
//! of one source.

use protocol::Pose;
use tch::{Kind, Result, Tensor};

use crate::f64_tensor::picked;
use crate::pastat::config::SearchConfig;
use crate::pastat::spatial_alignment::area::{Area, sampling_grid};
use crate::pastat::spatial_alignment::correlation::{Shifted, shifts};
use crate::pastat::spatial_alignment::network::AlignmentNetwork;
use crate::pastat::spatial_alignment::pairs::{Displacements, Pairs, rows_where};
use crate::warp::{BILINEAR, PADDING_ZEROS};

/// A map is moved to the position of the search when its correlation with the ego's, in the fine comparison, is
/// higher there by more than this.
const MARGIN: f64 = 0.05;
/// A map that was moved further than this, about half a cell of `lean`'s grid, is compared again at its new position.
const AGAIN_M: f64 = 0.45;

/// A map that correlates with the ego's by this fits where its pose puts it, and is not searched for: in practice the
/// ego's own earlier maps, which reach 0.8, where neighbours' reach 0.2 to 0.5.
const FITS: f64 = 0.6;

/// Rotations that are tried besides none, radians: FSA corrects rotations between two of them.
const TURNS_RAD: [f64; 8] = [-0.08, 0.08, -0.16, 0.16, -0.24, 0.24, -0.32, 0.32];
/// Largest offset of a rotated map, pooled cells: a small search is cheap, and few poses err far in both.
const TURNED_RADIUS: i64 = 4;
/// A rotated map has to correlate better by this, since one of many trials correlates better by chance.
const TURN_MARGIN: f64 = 0.03;

/// Displacements by the network. Outside training it compares up to three times: at the poses, at better positions of
/// the search, and once more after large moves. Training uses the first comparison, and searches shifts only.
///
/// `known` `[K, 3]` replaces the search outside training: displacements found before, metres and radians; small ones are
/// found at the poses.
pub(crate) fn displacements(
    network: &AlignmentNetwork,
    pairs: &Pairs,
    area: &Area,
    known: Option<&Tensor>,
    is_training: bool,
) -> Result<Displacements> {
    let count = pairs.ego_from_cav.len() as i64;
    let nowhere = Tensor::f_zeros([count, 3], (Kind::Float, pairs.shown.device()))?;
    let config = network.config.alignment_search;
    if is_training {
        let searched = config.map(|config| offsets(pairs, area, config, true));
        return network.displacements(pairs, &searched.unwrap_or(Ok(nowhere))?, area);
    }
    let near = network.displacements(pairs, &nowhere, area)?;
    let rows = rows_where(&near.similarity.f_lt(FITS)?)?;
    let found = match config.filter(|_| !rows.is_empty()) {
        Some(config) => {
            let far = match known {
                Some(known) => picked(&large_only(known)?, &rows)?,
                None => offsets(&pairs.only(&rows)?, area, config, false)?,
            };
            compare_there(network, pairs, near, (&rows, &far), area)?
        }
        None => near,
    };
    // Compared again at the new position for maps that were moved by more than `AGAIN_M`.
    let rows = rows_where(&is_large(&found.deltas)?.f_squeeze_dim(1)?)?;
    if rows.is_empty() {
        return Ok(found);
    }
    let again = network.displacements(&pairs.only(&rows)?, &picked(&found.deltas, &rows)?, area)?;
    found.with(&rows, &again)
}

/// Displacements of the comparison at the poses, `near`, or for some rows at `far` `[rows, 3]`, metres and radians in the
/// ego's frame, where the correlation is higher there.
fn compare_there(
    network: &AlignmentNetwork,
    pairs: &Pairs,
    near: Displacements,
    (searched, far): (&[i64], &Tensor),
    area: &Area,
) -> Result<Displacements> {
    // Where the search ends at the pose, `near` already is the comparison there.
    let moved = rows_where(&far.f_count_nonzero_dim_intlist([1_i64].as_slice())?)?;
    if moved.is_empty() {
        return Ok(near);
    }
    let rows: Vec<i64> = moved.iter().map(|&row| searched[row as usize]).collect();
    let there = network.displacements(&pairs.only(&rows)?, &picked(far, &moved)?, area)?;
    let least = picked(&near.similarity, &rows)?.f_add_scalar(MARGIN)?;
    let better = rows_where(&there.similarity.f_gt_tensor(&least)?)?;
    let rows: Vec<i64> = better.iter().map(|&row| rows[row as usize]).collect();
    near.with(&rows, &there.only(&better)?)
}

/// `[K, 1]`: true for displacements `[K, 3]` by more than [`AGAIN_M`].
fn is_large(deltas: &Tensor) -> Result<Tensor> {
    deltas
        .f_narrow(1, 0, 2)?
        .f_square()?
        .f_sum_dim_intlist([1_i64].as_slice(), true, None)?
        .f_gt(AGAIN_M * AGAIN_M)
}

/// Displacements `[K, 3]`, zeros in place of small ones, which the comparison at the poses finds.
fn large_only(deltas: &Tensor) -> Result<Tensor> {
    deltas.f_mul(&is_large(deltas)?)
}

/// Coarse offset of each map from its pose, to the pooled cell, `[K, 3]` along x and y, metres, and about its sender,
/// radians: the reduced maps are correlated once more with pooled cells over a large range, and the best position is
/// taken.
///
/// Training adds a margin and tries shifts only. No gradient flows: the reduced maps are learnt from the fine
/// comparison.
///
/// The maps are on the grid of `area`.
fn offsets(pairs: &Pairs, area: &Area, config: SearchConfig, train: bool) -> Result<Tensor> {
    // The settings count cells of the ego's grid, those of `area` may be pooled already.
    let (cells, radius) = (config.cells / area.cells, config.radius);
    let (edges, none): ([i64; 2], [i64; 2]) = ([cells; 2], [0; 2]);
    let [ego, shown] = [&pairs.ego, &pairs.shown].map(|maps| {
        let maps = maps.f_detach()?;
        maps.f_avg_pool2d(edges, edges, none, false, true, None::<i64>)
    });
    let maps = [&ego?, &shown?];
    let cell_m = area.cell_m * cells as f64;
    let fit = Shifted::new(maps[0], radius, 1)?.correlate(maps[1])?.whole;
    if train {
        // The middle column is no shift: a map stays unless it fits better elsewhere by the margin.
        let mut stays = fit.f_select(1, fit.size2()?.1 / 2)?;
        let _ = stays.f_add_scalar_(config.margin)?;
    }
    let mut tries = vec![(fit, (shifts(radius)? * cell_m).f_constant_pad_nd([0, 1])?)];
    if !train {
        let radius = radius.min(TURNED_RADIUS);
        let turned = turned(maps[1], &TURNS_RAD, &pairs.ego_from_cav, area)?;
        // All at once, as the ego's map at each shift is the same for all.
        let fit = Shifted::new(maps[0], radius, 1)?.correlate(&turned)?.whole;
        let fits = fit
            .f_sub_scalar(TURN_MARGIN)?
            .f_split(maps[1].size4()?.0, 0)?;
        let shifts_m = shifts(radius)? * cell_m;
        for (fit, turn_rad) in fits.into_iter().zip(TURNS_RAD) {
            tries.push((fit, shifts_m.f_pad([0, 1], "constant", turn_rad)?));
        }
    }
    let (fits, offsets): (Vec<_>, Vec<_>) = tries.into_iter().unzip();
    let best = Tensor::f_cat(&fits, 1)?.f_argmax(-1, false)?;
    Tensor::f_cat(&offsets, 0)?
        .f_to_device(best.device())?
        .f_index_select(0, &best)
}

/// All maps rotated about their senders by the first of some angles, then by the second, and so on.
fn turned(maps: &Tensor, turns_rad: &[f64], ego_from_cav: &[Pose], area: &Area) -> Result<Tensor> {
    let (count, _, rows, columns) = maps.size4()?;
    let deltas = turns_rad
        .iter()
        .flat_map(|&turn_rad| [0.0, 0.0, turn_rad as f32].repeat(count as usize));
    let deltas = Tensor::f_from_slice(&deltas.collect::<Vec<f32>>())?.f_view([-1, 3])?;
    let poses = ego_from_cav.repeat(turns_rad.len());
    let places = sampling_grid(&deltas, &poses, area, [rows, columns])?;
    let maps = maps.f_repeat([turns_rad.len() as i64, 1, 1, 1])?;
    let places = places.f_to_device(maps.device())?;
    maps.f_grid_sampler(&places, BILINEAR, PADDING_ZEROS, false)
}

#[cfg(test)]
mod tests {
    use std::rc::Rc;

    use protocol::BevGrid;
    use tch::nn::VarStore;
    use tch::{Device, no_grad};

    use super::*;
    use crate::pastat::confidence_embedding::CONFIDENCES;
    use crate::pastat::config::FsaConfig;
    use crate::test_data::{redraw, uniform};
    use crate::warp::WarpedMaps;

    const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);

    const CONFIG: SearchConfig = SearchConfig {
        cells: 4,
        radius: 5,
        margin: 0.3,
    };
    const GRID: BevGrid = BevGrid {
        x_min_m: -24.0,
        y_min_m: -16.0,
        cell_m: 0.5,
        width: 96,
        height: 64,
    };

    fn area() -> Area {
        Area::new(&GRID, [64, 96], 4)
    }

    /// Synthetic vehicles at some places.
    fn vehicle_cells(seed: u64, channels: i64) -> Tensor {
        let cells = uniform(seed, &[1, channels, 64, 96]).gt(0.99);
        cells.to_kind(Kind::Float)
    }

    /// The same with zero mean.
    fn map(seed: u64) -> Tensor {
        let cells = vehicle_cells(seed, 2);
        &cells - cells.mean(Kind::Float)
    }

    fn with_full_mask(features: Tensor) -> WarpedMaps {
        let (maps, _, height, width) = features.size4().unwrap();
        WarpedMaps {
            features,
            mask: Tensor::ones([maps, 1, height, width], FLOAT),
        }
    }

    /// Offsets found for senders at the ego's position.
    fn found(maps: [&Tensor; 2], area: &Area, config: SearchConfig, train: bool) -> Vec<f32> {
        let [ego, shown] = maps.map(Tensor::shallow_clone);
        let count = shown.size()[0];
        let pairs = Pairs {
            own: Rc::new(Shifted::new(&ego, 1, 1).unwrap()),
            ego,
            shown,
            mask: Tensor::ones([count, 1, 1, 1], FLOAT),
            confidences: Tensor::ones([count, CONFIDENCES], FLOAT),
            ego_from_cav: vec![Pose::IDENTITY; count as usize],
        };
        Vec::try_from(offsets(&pairs, area, config, train).unwrap().view(-1)).unwrap()
    }

    #[test]
    fn a_lost_map_is_found_and_others_stay() {
        let ego = map(1);
        // At its pose; twelve cells too far along x and sixteen back along y; a map of another scene.
        let others = Tensor::cat(&[&ego, &ego.roll([-16, 12], [2, 3]), &map(2)], 0);
        let expected = [0.0, 0.0, 0.0, -6.0, 8.0, 0.0, 0.0, 0.0, 0.0];
        assert_eq!(found([&ego, &others], &area(), CONFIG, true), expected);
        // The same in cells of two by two, of which two by two are a pooled cell.
        let [ego, others] =
            [&ego, &others].map(|maps| maps.avg_pool2d([2, 2], [2, 2], [0, 0], false, true, None));
        assert_eq!(
            found([&ego, &others], &area().with_cells_of(2), CONFIG, true),
            expected
        );
    }

    #[test]
    fn once_trained_a_turned_map_is_found() {
        // Vehicles of several pooled cells, whose shape a rotation on pooled cells preserves.
        let ego = map(1).avg_pool2d([9, 9], [1, 1], [4, 4], false, true, None);
        for turn_rad in TURNS_RAD {
            let turned = turned(&ego, &[-turn_rad], &[Pose::IDENTITY], &area()).unwrap();
            let moved = turned.roll([8], [3]);
            let others = Tensor::cat(&[&ego, &turned, &moved], 0);
            let turn_rad = turn_rad as f32;
            let expected = [0.0, 0.0, 0.0, 0.0, 0.0, turn_rad];
            let found = found([&ego, &others], &area(), CONFIG, false);
            assert_eq!(found[..6], expected);
            // Rotated about the sender, which changes the remaining shift.
            assert_eq!(found[8], turn_rad);
        }
    }

    #[test]
    fn in_training_a_gain_below_the_margin_moves_nothing() {
        let ego = map(1);
        let other = ego.roll([12], [3]) * 0.6 + &ego * 0.5;
        for (margin, train, expected) in [
            (0.0, true, [-6.0, 0.0, 0.0]),
            (0.2, true, [0.0; 3]),
            (0.2, false, [-6.0, 0.0, 0.0]),
        ] {
            let config = SearchConfig { margin, ..CONFIG };
            assert_eq!(found([&ego, &other], &area(), config, train), expected);
        }
    }

    /// Corrections of FSA with a search for three maps: the ego's; the same twelve cells too far along x and sixteen
    /// back along y; and a map of another scene.
    fn far_off(search: SearchConfig, known: Option<&Tensor>, train: bool) -> Vec<f32> {
        let grid = BevGrid {
            x_min_m: -24.0,
            y_min_m: -16.0,
            cell_m: 0.5,
            width: 96,
            height: 64,
        };
        let (area, confidences) = (
            Area::new(&grid, [64, 96], 4),
            Tensor::ones([3, CONFIDENCES], FLOAT),
        );
        let variables = VarStore::new(Device::Cpu);
        let config = FsaConfig {
            alignment_search: Some(search),
            ..FsaConfig::default()
        };
        let fsa = AlignmentNetwork::new(&variables.root(), [4, 6], &config);
        redraw(&variables, &["matching"], 0.3);
        let [ego, foreign] = [5, 6].map(|seed| vehicle_cells(seed, 4));
        let others = Tensor::cat(&[&ego, &ego.roll([-16, 12], [2, 3]), &foreign], 0);
        let [ego, others] = [ego, others].map(with_full_mask);
        let poses = [
            Pose::IDENTITY,
            Pose::from_xyz_yaw([3.0, 1.0, 0.0], 0.3),
            Pose::IDENTITY,
        ];
        let deltas = no_grad(|| {
            let [ego, others] = [&ego, &others].map(|maps| fsa.reduced(maps).unwrap());
            let pairs = fsa
                .pairs([&ego, &others], &confidences, &poses, &area)
                .unwrap();
            displacements(&fsa, &pairs, &area, known, train)
                .unwrap()
                .deltas
        });
        Vec::try_from(deltas.view(-1)).unwrap()
    }

    #[test]
    fn a_map_that_is_far_off_comes_back_and_others_stay() {
        let search = SearchConfig {
            cells: 4,
            radius: 9,
            margin: 0.3,
        };
        let back = [0.0, 0.0, 0.0, -6.0, 8.0, 0.0, 0.0, 0.0, 0.0];
        assert_eq!(far_off(search, None, true), back);
        assert_eq!(far_off(search, None, false), back);
        // Beyond the search range it is not found.
        assert_eq!(
            far_off(
                SearchConfig {
                    radius: 1,
                    ..search
                },
                None,
                false
            ),
            [0.0; 9]
        );
    }

    #[test]
    fn a_known_large_displacement_replaces_the_search() {
        let search = SearchConfig {
            cells: 4,
            radius: 9,
            margin: 0.3,
        };
        let back: [f32; 9] = [0.0, 0.0, 0.0, -6.0, 8.0, 0.0, 0.0, 0.0, 0.0];
        let known = Tensor::from_slice(&back).view([3, 3]);
        assert_eq!(far_off(search, Some(&known), false), back);
        // Small ones are found at the poses, and nothing is searched.
        let small = &known * 0.04;
        assert_eq!(far_off(search, Some(&small), false), [0.0; 9]);
        assert_eq!(large_only(&small).unwrap(), known.zeros_like());
    }

    #[test]
    fn after_training_offsets_below_the_margin_are_compared_closely() {
        let search = SearchConfig {
            cells: 4,
            radius: 9,
            margin: 2.0,
        };
        assert_eq!(far_off(search, None, true), [0.0; 9]);
        assert_eq!(
            far_off(search, None, false),
            [0.0, 0.0, 0.0, -6.0, 8.0, 0.0, 0.0, 0.0, 0.0]
        );
    }

    #[test]
    fn a_second_comparison_reduces_the_remaining_offset() {
        let variables = VarStore::new(Device::Cpu);
        let fsa = AlignmentNetwork::new(
            &variables.root(),
            [4, 6],
            &FsaConfig {
                alignment_search: None,
                ..FsaConfig::default()
            },
        );
        let area = Area::new(
            &BevGrid {
                width: 32,
                height: 16,
                x_min_m: -8.0,
                y_min_m: -4.0,
                ..GRID
            },
            [16, 32],
            4,
        );
        redraw(&variables, &["matching"], 0.3);
        // Only a share of the observed motion is applied.
        let _ = no_grad(|| {
            variables.variables()["delta.bias"]
                .narrow(0, 3, 3)
                .fill_(0.6)
        });
        let map = uniform(5, &[1, 4, 16, 32]).gt(0.97).to_kind(Kind::Float);
        let maps = [map.shallow_clone(), map.roll([3], [3])]
            .map(|features| fsa.reduced(&with_full_mask(features)).unwrap());
        let [first, both] = [true, false].map(|train| {
            let confidences = Tensor::ones([1, CONFIDENCES], FLOAT);
            let pairs = fsa
                .pairs([&maps[0], &maps[1]], &confidences, &[Pose::IDENTITY], &area)
                .unwrap();
            let found = displacements(&fsa, &pairs, &area, None, train).unwrap();
            found.deltas.double_value(&[0, 0])
        });
        assert!(first < -AGAIN_M, "{first}");
        assert!(
            (both + 1.5).abs() < 0.7 * (first + 1.5).abs(),
            "{first} {both}"
        );
    }
}
