//! Neighbours' newest maps after FSA, and the maximum over them and the ego's.

use tch::{TchError, Tensor};

use super::area::resample;
use crate::f64_tensor::{self, are_numbers, numbers};
use crate::full_resolution::{CellSamples, FullResolutionMap};
use crate::layers::unseen;
use crate::warp::WarpedMaps;

/// Maps on the ego's grid. Maps with corrected poses are resampled from the maps as received: a second resampling would
/// blur them, and cells that a wrong pose has put beyond the ego's edges would be lost. Where no gradient flows this is
/// done when the maximum over them is taken, once and cell by cell.
pub(crate) struct NeighbourMaps {
    maps: WarpedMaps,
    /// The same in plain floats; only with `places`.
    cells: Vec<FullResolutionMap>,
    /// `[M, H, W, 2]`: positions of the ego's cells on the maps, for `grid_sampler`; absent: maps are aligned already.
    places: Option<Tensor>,
}

impl NeighbourMaps {
    /// Of maps that are aligned already.
    pub(crate) fn still(maps: WarpedMaps) -> Self {
        Self {
            maps,
            cells: Vec::new(),
            places: None,
        }
    }

    /// Number of maps.
    pub(crate) fn count(&self) -> Result<i64, TchError> {
        self.maps.count()
    }

    /// Of maps as received, to be sampled at `places`; `cells` are the same in plain floats, where there are such.
    pub(crate) fn at(
        maps: WarpedMaps,
        cells: Vec<FullResolutionMap>,
        places: Tensor,
    ) -> Result<Self, TchError> {
        if cells.len() as i64 == maps.count()? && are_numbers(&places) {
            return Ok(Self {
                maps,
                cells,
                places: Some(places),
            });
        }
        let (features, mask) = resample(&maps.features, &maps.mask, &places)?;
        Ok(Self::still(WarpedMaps { features, mask }))
    }

    /// The maximum `[1, C, H, W]` of the ego's map `[C, H, W]` and these, times `weight` `[M, 1, H, W]`, where they are
    /// valid.
    pub(crate) fn maximum_with(&self, own: &Tensor, weight: &Tensor) -> Result<Tensor, TchError> {
        if let Some(places) = &self.places {
            let (channels, height, width) = own.size3()?;
            let cells = own.f_permute([1, 2, 0])?.f_reshape([-1, channels])?;
            let maximum = (0..)
                .zip(&self.cells)
                .try_fold(cells, |maximum, (map, cells)| {
                    let [places, shares] =
                        [places, weight].map(|tensor| numbers(&tensor.f_get(map)?));
                    let CellSamples { mut features, mask } = cells.at(&places?, Some(&shares?))?;
                    // Zeros could win the maximum: out of reach the value of the ego has to remain.
                    let out_of_reach = mask.f_squeeze_dim(1)?.f_eq(0.0)?.f_nonzero()?;
                    features
                        .f_index_fill_(0, &out_of_reach.f_squeeze_dim(1)?, f64::NEG_INFINITY)?
                        .f_maximum(&maximum)
                })?;
            return maximum
                .f_view([1, height, width, channels])?
                .f_permute([0, 3, 1, 2]);
        }
        let WarpedMaps { features, mask } = &self.maps;
        // A map contributes nothing out of its reach.
        let reach = unseen(mask)?;
        let mut maximum = own.shallow_clone();
        for index in 0..self.count()? {
            let [map, weight, reach] = [features, weight, &reach].map(|tensor| tensor.f_get(index));
            maximum = maximum.f_maximum(&reach?.f_addcmul(&map?, &weight?)?)?;
        }
        f64_tensor::by_cell(&maximum)
    }
}

#[cfg(test)]
mod tests {
    use protocol::{BevGrid, Pose};
    use tch::Kind;

    use super::super::area::{Area, own_sampling_grid};
    use super::*;
    use crate::test_data::uniform;

    impl NeighbourMaps {
        /// The maps after alignment.
        pub(crate) fn maps(&self) -> &WarpedMaps {
            assert!(self.places.is_none(), "they are not read yet");
            &self.maps
        }
    }

    #[test]
    fn numbers_and_tensors_find_the_same_maximum() {
        let grid = BevGrid {
            x_min_m: -8.0,
            y_min_m: -4.0,
            cell_m: 0.5,
            width: 32,
            height: 16,
        };
        let area = Area::new(&grid, [16, 32], 4);
        let poses = [Pose::from_xyz_yaw([3.0, 1.0, 0.0], 0.3), Pose::IDENTITY];
        let deltas = Tensor::from_slice(&[0.7f32, -0.4, 0.05, -1.3, 0.2, 0.0]).view([2, 3]);
        let places = own_sampling_grid(&deltas, &poses, [&area, &area]).unwrap();
        let mask = uniform(4, &[2, 1, 16, 32]).gt(0.2).to_kind(Kind::Float);
        let features = (uniform(5, &[2, 3, 16, 32]) - 0.3) * &mask;
        let (own, weight) = (
            uniform(6, &[3, 16, 32]) - 0.5,
            uniform(7, &[2, 1, 16, 32]) * 2.0,
        );
        let [numbers, tensors] = [false, true].map(|with_gradient| {
            let maps = WarpedMaps {
                features: features.shallow_clone(),
                mask: mask.shallow_clone(),
            };
            let cells = (0..2).map(|map| {
                FullResolutionMap::of(&features.narrow(0, map, 1), Some(&mask.narrow(0, map, 1)))
                    .unwrap()
            });
            let places = places.copy().set_requires_grad(with_gradient);
            let moved = NeighbourMaps::at(maps, cells.collect(), places).unwrap();
            assert_eq!(moved.places.is_none(), with_gradient);
            moved.maximum_with(&own, &weight).unwrap()
        });
        assert_ne!(numbers, own.unsqueeze(0));
        // At a position between two cells either may be the nearest.
        let apart = (numbers - tensors)
            .abs()
            .gt(1e-4)
            .sum(Kind::Int64)
            .int64_value(&[]);
        assert!(apart <= 3, "{apart}");
    }
}
