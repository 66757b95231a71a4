//! Temporal feature memory, an extension: earlier maps at full resolution are blended into the fused map (`recall`;
//! absent: off).
//!
//! Every sweep has errors of its own: points lie elsewhere on a vehicle, and so do cell borders. The mean of several
//! sweeps removes a part of these errors. This matters only where a vehicle is likely: other cells are left unchanged,
//! which saves most of the time without loss of precision.
//!
//! Measured gain: 1.3 percentage points of AP@0.7 and -0.1 of AP@0.5 (ablation, 1,000 steps, three trainings).

mod selection;

use perception::tensor_values::tensor;
use protocol::{BevGrid, Pose};
use tch::nn::{self, Init, Module};
use tch::{Device, Kind, Result, Tensor};

use self::selection::{AROUND, BlendedCells};
use super::LEAST_LIKELY;
use crate::f64_tensor::are_numbers;
use crate::full_resolution::{CellSamples, FullResolutionMap};
use crate::layers::{BARE, around};
use crate::maps::AlignedMaps;
use crate::pastat::coarse_alignment::{CoarseMaps, Origins};
use crate::pastat::config::{MemoryConfig, PastatConfig};
use crate::pastat::patches::channels_last;
use crate::pastat::spatial_alignment::FineMaps;
use crate::planar_pose::moved;
use crate::warp::SUM;

/// FSA compares earlier maps with larger cells than the newest, so the correction of a well-placed one errs by a few
/// tenths of a metre. A correction within this distance of that of its agent's newest map is replaced by the latter.
const SAME_PLACE_M: f64 = 0.6;

/// Blends earlier maps, by cell and channel, into the maximum of the newest, and likewise the ego's own newest, which
/// can undo additions of neighbours; neutral before training.
#[derive(Debug)]
pub(crate) struct TemporalMemory {
    now: nn::Conv2D,
    past: nn::Conv2D,
    token: nn::Linear,
    /// `[frames, hidden]`: of the ego's own newest and of earlier time steps.
    step: Tensor,
    gate: nn::Conv2D,
    patch: i64,
    share: f64,
}

impl TemporalMemory {
    /// Its variables are `recall.*` below `path`.
    pub(crate) fn new(path: &nn::Path<'_>, config: &PastatConfig, memory: &MemoryConfig) -> Self {
        let (path, channels, hidden) = (path / "recall", config.channels, memory.hidden);
        let bare = nn::ConvConfig {
            bias: false,
            ..around()
        };
        let neutral = nn::ConvConfig {
            ws_init: Init::Const(0.0),
            bs_init: Init::Const(0.0),
            ..Default::default()
        };
        Self {
            now: nn::conv2d(&path / "now", channels, hidden, 3, around()),
            past: nn::conv2d(&path / "past", channels, hidden, 3, bare),
            token: nn::linear(&path / "token", config.dim, hidden, BARE),
            step: path.var("step", &[config.frames as i64, hidden], Init::Const(0.0)),
            gate: nn::conv2d(&path / "gate", hidden, channels, 1, neutral),
            patch: config.patch,
            share: memory.share,
        }
    }

    /// `fused` `[1, C, H, W]`, the maximum of all agents' newest maps, with the ego's own and earlier maps blended in
    /// where their poses and FSA put them; `context` `[1, h, w, D]` are the ego's tokens after the transformer.
    pub(crate) fn blend(
        &self,
        fused: Tensor,
        aligned: &AlignedMaps,
        coarse: &CoarseMaps,
        fine: &FineMaps,
        context: &Tensor,
    ) -> Result<Tensor> {
        let Some((maps, classes)) = aligned.earlier_full_resolution() else {
            return Ok(fused);
        };
        let maps = self.placed(maps, coarse, fine.corrections.as_ref())?;
        if maps.is_empty() {
            return Ok(fused);
        }
        let likely = classes.likely(&fused)?;
        self.forward([&fused, &fine.own], &maps, &aligned.grid, context, &likely)
    }

    /// The earlier maps that take part, each with its time step and its sender's corrected pose.
    fn placed<'a>(
        &self,
        maps: &'a [FullResolutionMap],
        coarse: &CoarseMaps,
        corrections: Option<&Tensor>,
    ) -> Result<Vec<(usize, Pose, &'a FullResolutionMap)>> {
        let steps = self.step.size()[0] as usize - 1;
        let origins = &coarse.origins;
        let first = origins.count() - coarse.earlier_entries.len();
        let corrections = corrections
            .map(|corrections| settled(origins, corrections, first))
            .transpose()?;
        let entries = coarse.earlier_entries.iter().enumerate();
        let placed = entries.filter_map(|(index, &entry)| {
            // Step 0 is an earlier map whose agent has no newest map in reach. It takes no part.
            let step = origins.steps_back[first + index].checked_sub(1)?;
            let map = maps.get(entry as usize)?;
            let pose = &origins.ego_from_cav[first + index];
            let correction = corrections.as_ref().map(|all| all[index]);
            let pose = correction.map_or(*pose, |delta| moved(pose, delta));
            (step < steps).then_some((step, pose, map))
        });
        Ok(placed.collect())
    }

    /// `[1, C, H, W]` of `now`, the maximum of all agents' newest maps, of that shape, and the ego's `own`,
    /// `[C, H, W]`. Without a gradient `now` is overwritten if its channels are last in memory.
    ///
    /// `past` has of each map from before its agent's newest the time step, 0 for the one before the newest; its
    /// sender's pose at capture; its features. `grid` is that of all maps.
    ///
    /// # Shapes
    /// - `ego`: `[1, h, w, D]`, the ego's tokens after the transformer
    /// - `likely`: `[1, 1, H, W]`, larger where a vehicle is more likely
    fn forward(
        &self,
        [now, own]: [&Tensor; 2],
        past: &[(usize, Pose, &FullResolutionMap)],
        grid: &BevGrid,
        ego: &Tensor,
        likely: &Tensor,
    ) -> Result<Tensor> {
        let (_, channels, height, width) = now.size4()?;
        // Where a gradient flows, or on a GPU, only the share limits the number of cells.
        let least = match are_numbers(now) {
            true => LEAST_LIKELY,
            false => f32::NEG_INFINITY,
        };
        let selection = BlendedCells::most_likely(likely, self.patch, self.share, least)?;
        let at = Places::of(&selection, width, now.device())?;
        let mut cells = channels_last(now)?.f_flatten(0, 2)?;
        let own = channels_last(&own.f_unsqueeze(0)?)?
            .f_flatten(0, 2)?
            .f_index_select(0, &at.near)?;
        let shown = cells.f_index_select(0, &at.near)?;
        let known = beside(&self.now, &shown, &at)? + self.token_features(ego, &at.patches)?;
        let now = shown.f_index_select(0, &at.middle)?;
        let gate = self.gate(0, &own, &known, &at)?;
        let mut change = gate * (own.f_index_select(0, &at.middle)? - &now);
        let seen = FullResolutionMap::seen(past, &selection.near, grid)?;
        for (step, CellSamples { features, mask }) in seen {
            let gate = self.gate(1 + step, &features, &known, &at)?;
            let apart = features.f_index_select(0, &at.middle)? - &now;
            // Cells without valid data in any map get no blending.
            change = change.f_addcmul(&gate, &(apart * mask.f_index_select(0, &at.middle)?))?;
        }
        // Where no gradient flows, nothing reads the map as it was before.
        let blended = match are_numbers(&cells) {
            true => cells.f_index_add_(0, &at.cells, &change)?,
            false => cells.f_index_add(0, &at.cells, &change)?,
        };
        blended
            .f_view([1, height, width, channels])?
            .f_permute([0, 3, 1, 2])
    }

    /// `[P, C]`: weight of the `features` `[R, C]` of a time step, given the tokens' features `known` `[P, hidden]`.
    fn gate(&self, step: usize, features: &Tensor, known: &Tensor, at: &Places) -> Result<Tensor> {
        let step = self.step.f_get(step as i64)?;
        let hidden = (beside(&self.past, features, at)? + known + step).f_relu()?;
        hidden
            .f_linear(&self.gate.ws.f_flatten(1, 3)?, self.gate.bs.as_ref())?
            .f_tanh()
    }

    /// Features of the tokens, on the cells of some `patches`: `[P, hidden]`.
    fn token_features(&self, ego: &Tensor, patches: &Tensor) -> Result<Tensor> {
        let tokens = ego.f_flatten(0, 2)?.f_index_select(0, patches)?;
        let features = self.token.forward(&tokens);
        let (patches, hidden) = features.size2()?;
        let each = self.patch * self.patch;
        features
            .f_unsqueeze(1)?
            .f_expand([patches, each, hidden], false)?
            .f_reshape([-1, hidden])
    }
}

/// Shift along x and y, metres, and rotation, radians: corrections of the entries from `first` on, the earlier ones,
/// given those of all but the very first, `corrections` `[N - 1, 3]`. A correction close to that of its agent's newest
/// map is replaced by it.
fn settled(origins: &Origins, corrections: &Tensor, first: usize) -> Result<Vec<[f64; 3]>> {
    let corrections = corrections.f_detach()?.f_to_kind(Kind::Double)?;
    let corrections = Vec::<f64>::try_from(corrections.f_reshape(-1)?)?;
    let all = [&[[0.0; 3]][..], corrections.as_chunks::<3>().0].concat();
    Ok((first..all.len())
        .map(|entry| {
            // For earlier maps of the ego this is the first entry, whose correction is zero.
            (0..first)
                .find(|newest| origins.agent[*newest] == origins.agent[entry])
                .map(|newest| all[newest])
                .filter(|newest| {
                    (newest[0] - all[entry][0]).hypot(newest[1] - all[entry][1]) < SAME_PLACE_M
                })
                .unwrap_or(all[entry])
        })
        .collect())
}

/// [`BlendedCells`] cells as indices.
struct Places {
    /// `[K]`, of patches.
    patches: Tensor,
    /// `[P]`, of the cells of those.
    cells: Tensor,
    /// `[R]`, of these cells and their neighbours.
    near: Tensor,
    /// `[P * 9]`: the results of a convolution's nine weights that each cell needs of the 3x3 cells of `near` around it,
    /// as rows of all results, nine for each cell that is shown.
    results: Tensor,
    /// `[P]`: where those of each cell begin.
    first: Tensor,
    /// `[P]`: for each cell its own index in `near`.
    middle: Tensor,
}

impl Places {
    fn of(selection: &BlendedCells, width: i64, device: Device) -> Result<Self> {
        let near = selection.near.iter();
        let near: Vec<i64> = near
            .map(|&[row, column]| row as i64 * width + column as i64)
            .collect();
        // The index after the last of `near` is beyond the edge.
        let around = tensor(&selection.around, &[-1, AROUND], device)?;
        let options = (Kind::Int64, device);
        // The k-th cell around contributes its result of weight k: row 9 * cell + k.
        let results = (&around * AROUND + Tensor::f_arange(AROUND, options)?).f_flatten(0, 1)?;
        Ok(Self {
            patches: tensor(&selection.patches, &[-1], device)?,
            cells: tensor(&selection.cells, &[-1], device)?,
            near: tensor(&near, &[-1], device)?,
            results,
            first: Tensor::f_arange(around.size2()?.0, options)? * AROUND,
            middle: around.f_select(1, AROUND / 2)?,
        })
    }
}

/// A 3x3 convolution at some cells: `[P, hidden]` of the features `[R, C]` that are shown.
///
/// Each cell is multiplied with all nine weights first: the nine results that a cell needs are fewer numbers than the
/// features of nine cells.
fn beside(convolution: &nn::Conv2D, shown: &Tensor, at: &Places) -> Result<Tensor> {
    let hidden = convolution.ws.size4()?.0;
    // [hidden, C, 3, 3] to [9 * hidden, C], weights in the order of the cells around.
    let weight = convolution.ws.f_permute([2, 3, 0, 1])?.f_flatten(0, 2)?;
    // One row of zeros for cells beyond the edge, whose index is that after the last.
    let shown = shown.f_constant_pad_nd([0, 0, 0, 1])?;
    let results = shown
        .f_linear(&weight, None::<&Tensor>)?
        .f_view([-1, hidden])?;
    let (rows, first) = (&at.results, &at.first);
    let unweighted = None::<&Tensor>;
    let (sums, ..) =
        Tensor::f_embedding_bag(&results, rows, first, false, SUM, false, unweighted, false)?;
    match &convolution.bs {
        Some(bias) => sums.f_add(bias),
        None => Ok(sums),
    }
}

#[cfg(test)]
mod tests {
    use tch::nn::VarStore;
    use tch::no_grad;

    use super::*;
    use crate::maps::MapMetadata;
    use crate::test_data::{redraw, uniform};

    /// Cells at which two maps `[1, C, H, W]` differ.
    fn different_cells(a: &Tensor, b: &Tensor) -> Tensor {
        (a - b).abs().amax([1], false).gt(1e-5)
    }

    fn count(cells: &Tensor) -> i64 {
        cells.sum(Kind::Int64).int64_value(&[])
    }

    #[test]
    fn a_convolution_at_some_cells_is_that_of_all_of_them() {
        let variables = VarStore::new(Device::Cpu);
        let around = nn::ConvConfig {
            padding: 1,
            ..Default::default()
        };
        let convolution = nn::conv2d(variables.root(), 3, 5, 3, around);
        let map = uniform(4, &[1, 3, 4, 6]);
        let all = convolution
            .forward(&map)
            .flatten(2, 3)
            .squeeze_dim(0)
            .transpose(0, 1);
        let likely = uniform(5, &[1, 1, 4, 6]);
        let selection = BlendedCells::most_likely(&likely, 2, 0.5, 0.0).unwrap();
        let near: Vec<i64> = selection
            .near
            .iter()
            .map(|[row, column]| (row * 6 + column) as i64)
            .collect();
        let shown = map
            .flatten(2, 3)
            .squeeze_dim(0)
            .transpose(0, 1)
            .index_select(0, &Tensor::from_slice(&near));
        let at = Places::of(&selection, 6, Device::Cpu).unwrap();
        let some = beside(&convolution, &shown, &at).unwrap();
        let expected = all.index_select(0, &Tensor::from_slice(&selection.cells));
        assert!(some.allclose(&expected, 1e-5, 1e-5, false));
    }

    /// The blend equals that of all cells where a vehicle is likely; elsewhere the newest map is unchanged.
    #[test]
    fn blended_cells_do_not_depend_on_the_selection_of_others() {
        let grid = BevGrid {
            x_min_m: -8.0,
            y_min_m: -4.0,
            cell_m: 0.5,
            width: 32,
            height: 16,
        };
        let variables = VarStore::new(Device::Cpu);
        let config = PastatConfig {
            dim: 6,
            patch: 2,
            frames: 3,
            ..PastatConfig::lean(4)
        };
        let sizes = MemoryConfig {
            hidden: 5,
            share: 0.25,
        };
        let mut memory = TemporalMemory::new(&variables.root(), &config, &sizes);
        redraw(&variables, &["now", "past", "token", "step", "gate"], 0.3);
        let whole: Vec<FullResolutionMap> = (0..3)
            .map(|seed| FullResolutionMap::of(&uniform(seed, &[1, 4, 16, 32]), None).unwrap())
            .collect();
        let poses = [0.0, 2.0, -1.0].map(|x_m| Pose::from_xyz_yaw([x_m, 0.3, 0.0], 0.1 * x_m));
        let maps: Vec<(usize, Pose, &FullResolutionMap)> = [0, 1, 1]
            .into_iter()
            .zip(poses)
            .zip(&whole)
            .map(|((step, pose), map)| (step, pose, map))
            .collect();
        let (now, likely) = (uniform(7, &[1, 4, 16, 32]), uniform(8, &[1, 1, 16, 32]));
        let own = now.get(0) * 0.9;
        let ego = uniform(9, &[1, 8, 16, 6]);
        let blended = |memory: &TemporalMemory| {
            no_grad(|| memory.forward([&now, &own], &maps, &grid, &ego, &likely)).unwrap()
        };
        let few = blended(&memory);
        memory.share = 1.0;
        let everywhere = blended(&memory);
        let [changed, apart] = [&now, &everywhere].map(|other| different_cells(&few, other));
        assert_eq!(count(&different_cells(&everywhere, &now)), 16 * 32);
        assert_eq!(count(&changed), 16 * 32 / 4);
        assert_eq!(count(&changed.logical_and(&apart)), 0);
    }

    #[test]
    fn a_correction_near_that_of_the_agents_newest_is_the_same() {
        let newest_and_earlier =
            [0, 7, 0, 7, 7, 3].map(|agent| MapMetadata::fresh(agent, Pose::IDENTITY));
        let origins = Origins::of(&newest_and_earlier);
        let corrections = [
            0.5, 0.4, 0.01, 0.3, -0.3, 0.02, 0.9, 0.1, 0.0, 1.5, 0.4, 0.03, 0.1, 0.0, 0.0,
        ];
        let settled = settled(&origins, &Tensor::from_slice(&corrections).view([5, 3]), 2).unwrap();
        // The ego's newest is not moved; another of the same vehicle is too far off; of the last there is no newest.
        assert_eq!(
            settled,
            [
                [0.0; 3],
                [0.5, 0.4, 0.01],
                [1.5, 0.4, 0.03],
                [0.1, 0.0, 0.0]
            ]
        );
    }
}
