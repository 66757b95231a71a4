//! Stages of feature maps before a fusion: as received, warped onto the ego's grid ([`WarpedMaps`]), aligned with
//! metadata.

use perception::tensor_values::values;
use protocol::{BevGrid, Pose};
use tch::{TchError, Tensor};

use super::classes::Classes;
use super::full_resolution::FullResolutionMap;
use crate::warp::WarpedMaps;

/// Origin of one feature map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapMetadata {
    /// Index of its agent, 0 being the ego. With history an agent has several maps.
    pub agent: usize,
    /// Pose of its sender at capture, in the current frame of the ego.
    pub ego_from_cav: Pose,
    /// Confidence of its sender's pose, 0..1.
    pub confidence: f64,
    /// Its age relative to the ego's newest map, seconds.
    pub age_secs: f64,
}

impl MapMetadata {
    /// A map without delay whose pose has full confidence.
    pub fn fresh(agent: usize, ego_from_cav: Pose) -> Self {
        Self {
            agent,
            ego_from_cav,
            confidence: 1.0,
            age_secs: 0.0,
        }
    }
}

/// Feature maps in the frames of their senders.
#[derive(Debug)]
pub struct ReceivedMaps {
    /// `[N, C, H, W]`.
    pub maps: Tensor,
    /// `[N, 1, H, W]`, 1 where a cell was sent; absent: everywhere.
    pub sent: Option<Tensor>,
    /// The same maps at full resolution, where a fusion needs earlier maps at both; else none.
    pub(crate) full_resolution: Vec<FullResolutionMap>,
}

impl ReceivedMaps {
    /// Maps `[N, C, H, W]`, of which `sent` `[N, 1, H, W]` is 1 for cells that were sent; absent: all.
    pub fn new(maps: Tensor, sent: Option<Tensor>) -> Self {
        Self {
            maps,
            sent,
            full_resolution: Vec::new(),
        }
    }

    /// Other maps of which the same cells were sent.
    pub(crate) fn with_maps(&self, maps: Tensor) -> Self {
        Self::new(maps, self.sent.as_ref().map(Tensor::shallow_clone))
    }

    /// The entries from `first` up to `end`.
    ///
    /// # Errors
    /// [`TchError`] when there are fewer.
    pub fn only(&self, first: i64, end: i64) -> Result<Self, TchError> {
        let only = |maps: &Tensor| maps.f_narrow(0, first, end - first);
        let sent = self.sent.as_ref().map(only).transpose()?;
        let full_resolution = self.full_resolution.get(first as usize..end as usize);
        Ok(Self {
            full_resolution: FullResolutionMap::shallow_clones(full_resolution.unwrap_or_default()),
            ..Self::new(only(&self.maps)?, sent)
        })
    }

    /// Maps of one size, one after another.
    ///
    /// # Errors
    /// [`TchError`] when there are none, or of several sizes.
    pub fn together(all: &[&Self]) -> Result<Self, TchError> {
        let maps: Vec<&Tensor> = all.iter().map(|maps| &maps.maps).collect();
        // If one of them was sent completely, its mask has to be written out.
        let sent = all.iter().any(|maps| maps.sent.is_some()).then(|| {
            let cells = all.iter().map(|maps| match &maps.sent {
                Some(sent) => Ok(sent.shallow_clone()),
                None => maps.maps.f_narrow(1, 0, 1)?.f_ones_like(),
            });
            Tensor::f_cat(&cells.collect::<Result<Vec<_>, TchError>>()?, 0)
        });
        let full_resolution = all.iter().flat_map(|maps| &maps.full_resolution);
        Ok(Self {
            maps: Tensor::f_cat(&maps, 0)?,
            sent: sent.transpose()?,
            full_resolution: FullResolutionMap::shallow_clones(full_resolution),
        })
    }
}

/// The feature maps of one sample on the ego's grid: the input of a fusion. The first is the ego's newest.
///
/// Missing agents are either absent or have a mask of zeros: both are equivalent for every method.
#[derive(Debug)]
pub struct AlignedMaps {
    /// `N` maps on the ego's grid, one of each agent, or of any age where earlier ones are not separate; the mask is 1
    /// everywhere for the ego.
    pub warped: WarpedMaps,
    /// The same maps in the frames of their senders but in the axes of the ego, for methods that warp them themselves.
    pub received: ReceivedMaps,
    /// `N`: their origins.
    pub metadata: Vec<MapMetadata>,
    /// The grid of all maps, each in the frame of its vehicle.
    pub grid: BevGrid,
    /// Maps from before each agent's newest, for a method that needs them with larger cells, see
    /// [`HistorySpec`](super::HistorySpec).
    pub earlier: Option<EarlierMaps>,
    /// True during training: some values are then dropped at random.
    pub is_training: bool,
}

impl AlignedMaps {
    /// The newest maps of all agents, outside training: `features` `[N, C, H, W]` and `mask` `[N, 1, H, W]` on the
    /// ego's grid; the same tensors stand for the maps as received.
    pub fn newest(
        features: &Tensor,
        mask: &Tensor,
        metadata: &[MapMetadata],
        grid: &BevGrid,
    ) -> Self {
        Self {
            warped: WarpedMaps::new(features.shallow_clone(), mask.shallow_clone()),
            received: ReceivedMaps::new(features.shallow_clone(), None),
            metadata: metadata.to_vec(),
            grid: *grid,
            earlier: None,
            is_training: false,
        }
    }

    /// Earlier maps at full resolution, and the class head.
    pub(crate) fn earlier_full_resolution(&self) -> Option<&(Vec<FullResolutionMap>, Classes)> {
        self.earlier.as_ref()?.full_resolution.as_ref()
    }
}

/// Aligned maps from before the newest of their agents.
#[derive(Debug)]
pub struct EarlierMaps {
    /// `O` maps on a grid of the ego with larger cells.
    pub warped: WarpedMaps,
    /// `O`: their origins.
    pub metadata: Vec<MapMetadata>,
    /// The same at full resolution and not warped yet, and the class head that gives the likelihood of vehicles.
    pub(crate) full_resolution: Option<(Vec<FullResolutionMap>, Classes)>,
}

/// Maps `[N, C, H, W]` pooled to cells of `cells` by `cells`, each their mean; those at the edges of fewer.
pub(crate) fn larger_cells(maps: &Tensor, cells: i64) -> Result<Tensor, TchError> {
    let (.., height, width) = maps.size4()?;
    if cells == 1 {
        return Ok(maps.shallow_clone());
    }
    if height % cells != 0 || width % cells != 0 {
        let (edges, none) = ([cells; 2], [0_i64; 2]);
        return maps.f_avg_pool2d(edges, edges, none, true, false, None::<i64>);
    }
    // The tensor library's pooling takes three times as long.
    let rows = sum_of_every(maps, 2, cells)?;
    Ok(sum_of_every(&rows, 3, cells)? / (cells * cells) as f64)
}

/// The sums of each `count` neighbours along `dim`.
fn sum_of_every(maps: &Tensor, dim: i64, count: i64) -> Result<Tensor, TchError> {
    (1..count).try_fold(maps.f_slice(dim, 0_i64, None, count)?, |sum, first| {
        sum.f_add(&maps.f_slice(dim, first, None, count)?)
    })
}

/// Indices of the entries of `mask` `[N, 1, H, W]` that reach any cell; `with_ego`: the first is always one.
pub(crate) fn reaching(mask: &Tensor, with_ego: bool) -> Result<Vec<i64>, TchError> {
    let most = values(&mask.f_amax([1i64, 2, 3].as_slice(), false)?)?;
    Ok((0i64..)
        .zip(most)
        .filter(|(entry, most)| (with_ego && *entry == 0) || *most > 0.0)
        .map(|(entry, _)| entry)
        .collect())
}

#[cfg(test)]
mod tests {
    use tch::{Device, Kind};

    use super::*;

    const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);

    #[test]
    fn larger_cells_are_means_at_the_edges_too() {
        let maps = Tensor::arange(24, FLOAT).view([1, 1, 4, 6]);
        assert_eq!(larger_cells(&maps, 1).unwrap(), maps);
        let odd = maps.narrow(3, 0, 5);
        for maps in [&maps, &odd] {
            let pooled = maps.avg_pool2d([2, 2], [2, 2], [0, 0], true, false, None);
            assert_eq!(larger_cells(maps, 2).unwrap(), pooled);
        }
        assert_eq!(
            larger_cells(&odd, 2).unwrap().double_value(&[0, 0, 0, 2]),
            7.0
        );
    }
}
