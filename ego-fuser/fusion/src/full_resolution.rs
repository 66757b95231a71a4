//! Full-resolution maps: earlier feature maps kept cell by cell and read at a few cells only.

use std::collections::BTreeMap;
use std::sync::Arc;

use perception::tensor_values::tensor;
use protocol::{BevGrid, Pose};
use tch::{Kind, Result, Tensor};

use crate::f64_tensor::{are_numbers, numbers};
use crate::warp::{BILINEAR, NEAREST, PADDING_ZEROS, Samples, places_of};

/// A feature map on the BEV grid of its sender, in axes of the ego.
#[derive(Debug)]
pub(crate) struct FullResolutionMap {
    /// `[1, C, H, W]`; the channels of a cell are contiguous where no gradient flows.
    map: Tensor,
    /// `[1, 1, H, W]`, 1 where a cell was sent.
    sent: Tensor,
    /// The same in plain floats `[H * W]`, where no gradient flows.
    sent_cells: Option<Arc<[f32]>>,
}

/// Features of maps at some cells of the ego.
#[derive(Debug)]
pub(crate) struct CellSamples {
    /// `[R, C]`: zeros where the maps have no data.
    pub(crate) features: Tensor,
    /// `[R, 1]`, 1 where they have data.
    pub(crate) mask: Tensor,
}

impl FullResolutionMap {
    /// From a map `[1, C, H, W]` without negative values and the mask of cells that were sent, `[1, 1, H, W]`; absent:
    /// all.
    pub(crate) fn of(map: &Tensor, sent: Option<&Tensor>) -> Result<Self> {
        let sent = match sent {
            Some(sent) => sent.f_to_kind(Kind::Float)?,
            None => map.f_narrow(1, 0, 1)?.f_ones_like()?,
        };
        if !are_numbers(map) {
            return Ok(Self {
                map: map.shallow_clone(),
                sent,
                sent_cells: None,
            });
        }
        let by_cell = map.f_permute([0, 2, 3, 1])?.f_contiguous()?;
        Ok(Self {
            map: by_cell.f_permute([0, 3, 1, 2])?,
            sent_cells: Some(numbers(&sent)?.into()),
            sent,
        })
    }

    /// Sent cells in plain floats, where no gradient flows.
    pub(crate) fn sent(&self) -> Option<&[f32]> {
        self.sent_cells.as_deref()
    }

    fn shallow_clone(&self) -> Self {
        Self {
            map: self.map.shallow_clone(),
            sent: self.sent.shallow_clone(),
            sent_cells: self.sent_cells.clone(),
        }
    }

    /// The same maps; nothing is copied.
    pub(crate) fn shallow_clones<'a>(maps: impl IntoIterator<Item = &'a Self>) -> Vec<Self> {
        maps.into_iter().map(Self::shallow_clone).collect()
    }

    /// Features of `maps` on `grid`, each with its time step and its sender's pose, at some `cells` (row and column) of
    /// the ego's grid: by time step the maximum over the maps.
    pub(crate) fn seen(
        maps: &[(usize, Pose, &Self)],
        cells: &[[usize; 2]],
        grid: &BevGrid,
    ) -> Result<BTreeMap<usize, CellSamples>> {
        let mut by_step: BTreeMap<usize, CellSamples> = BTreeMap::new();
        for (step, pose, map) in maps {
            let mut seen = map.at(&places_of(cells, pose, grid), None)?;
            if let Some(before) = by_step.get(step) {
                seen.features = seen.features.f_maximum(&before.features)?;
                seen.mask = seen.mask.f_maximum(&before.mask)?;
            }
            by_step.insert(*step, seen);
        }
        Ok(by_step)
    }

    /// Features at positions in `grid_sampler`'s coordinates, two for each: `[R, C]`, and their validity, `[R, 1]`; those
    /// in plain floats times their `shares` `[R]`, if there are such.
    pub(crate) fn at(&self, places: &[f32], shares: Option<&[f32]>) -> Result<CellSamples> {
        let Self { map, sent, .. } = self;
        if let Some(sent) = &self.sent_cells {
            let (_, channels, height, width) = map.size4()?;
            let size = [height, width].map(|cells| cells as usize);
            let mut samples = Samples::default();
            samples.add((0, size), sent, places, shares);
            let cells = map.f_permute([0, 2, 3, 1])?.f_view([-1, channels])?;
            return Ok(CellSamples {
                features: samples.read(&cells)?,
                mask: Tensor::f_from_slice(&samples.valid)?.f_unsqueeze(1)?,
            });
        }
        let sampling_grid = tensor(places, &[1, 1, -1, 2], map.device())?;
        let [features, mask] = [(map, BILINEAR), (sent, NEAREST)].map(|(map, how)| {
            let read = map.f_grid_sampler(&sampling_grid, how, PADDING_ZEROS, false)?;
            read.f_squeeze_dim(2)?.f_squeeze_dim(0)?.f_transpose(0, 1)
        });
        let mask = mask?.f_ceil()?;
        Ok(CellSamples {
            features: features? * &mask,
            mask,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_data::uniform;
    use crate::warp::warp_to_ego;

    const GRID: BevGrid = BevGrid {
        x_min_m: -8.0,
        y_min_m: -4.0,
        cell_m: 0.5,
        width: 32,
        height: 16,
    };

    fn poses() -> [Pose; 3] {
        [0.0, 1.0, 3.0].map(|x_m| Pose::from_xyz_yaw([x_m, 0.5, 0.0], 0.3 * x_m))
    }

    fn maps() -> (Tensor, Tensor) {
        (
            uniform(3, &[3, 4, 16, 32]),
            uniform(5, &[3, 1, 16, 32]).gt(0.2).to_kind(Kind::Float),
        )
    }

    fn seen(
        with_gradient: [bool; 3],
        entries: &[(usize, usize)],
        cells: &[[usize; 2]],
    ) -> BTreeMap<usize, CellSamples> {
        let (maps, sent) = maps();
        let whole = (0..3).map(|entry| {
            let map = maps
                .narrow(0, entry, 1)
                .copy()
                .set_requires_grad(with_gradient[entry as usize]);
            FullResolutionMap::of(&map, Some(&sent.narrow(0, entry, 1))).unwrap()
        });
        let whole: Vec<FullResolutionMap> = whole.collect();
        let given = entries
            .iter()
            .map(|&(step, entry)| (step, poses()[entry], &whole[entry]));
        FullResolutionMap::seen(&given.collect::<Vec<_>>(), cells, &GRID).unwrap()
    }

    fn count_different(a: &Tensor, b: &Tensor) -> i64 {
        (a - b).abs().gt(1e-5).sum(Kind::Int64).int64_value(&[])
    }

    #[test]
    fn numbers_and_tensors_agree_with_a_warp_of_the_whole_map() {
        let some: Vec<i64> = (0..16 * 32).filter(|cell| cell % 3 == 0).collect();
        let index = Tensor::from_slice(&some);
        let cells: Vec<[usize; 2]> = some
            .iter()
            .map(|&cell| [cell as usize / 32, cell as usize % 32])
            .collect();
        let (maps, sent) = maps();
        let warped = warp_to_ego(&maps, Some(&sent), &poses(), &GRID).unwrap();
        let [features, mask] = [&warped.features, &warped.mask].map(|maps| {
            let picked = maps.flatten(2, 3).index_select(2, &index).transpose(1, 2);
            [picked.get(0).maximum(&picked.get(2)), picked.get(1)]
        });
        for with_gradient in [[false; 3], [true; 3], [false, true, true]] {
            let seen = seen(with_gradient, &[(0, 0), (1, 1), (0, 2)], &cells);
            assert!(seen.keys().eq(&[0, 1]));
            for ((seen, features), mask) in seen.values().zip(&features).zip(&mask) {
                // At a position between two cells either may be the nearest.
                assert!(count_different(&seen.features, features) <= 8);
                assert!(count_different(&seen.mask, mask) <= 2);
                assert!(seen.mask.sum(Kind::Float).double_value(&[]) > 50.0);
            }
        }
    }
}
