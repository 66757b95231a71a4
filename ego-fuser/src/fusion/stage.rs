//! From the maps of several vehicles to one: turned, warped, fused. Training and the ego run the same lines.

use std::borrow::Cow;

use agent::model_config::{ConfigError, DetectorConfig, YAxis};
use agent::weights::{Weights, WeightsError};
use protocol::{BevGrid, Pose};
use tch::nn::{self, VarStore};
use tch::{Device, TchError, Tensor};

use super::steering::{self, Steering};
use super::{AlignedViews, EarlierViews, FUSION_KEY, Fusion, FusionConfig, ViewFacts};
use crate::method::{Exchange, Method};
use crate::numbers::are_numbers;
use crate::warp::{Order, WarpError, Warped, warp_in_order};

/// Where the fusion's variables lie in a weights file.
pub(crate) const FUSION_PREFIX: &str = "fusion.";

/// Why a fusion cannot be read from a weights file.
#[derive(Debug, thiserror::Error)]
pub enum StageError {
    /// Its configuration is none.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The weights do not fit.
    #[error(transparent)]
    Weights(#[from] WeightsError),
}

/// Steering, warp and fusion of one network.
#[derive(Debug)]
pub struct FusionStage {
    config: FusionConfig,
    fusion: Box<dyn Fusion>,
    steering: Option<Steering>,
    grid: BevGrid,
    /// In which world the maps are.
    y_axis: YAxis,
}

/// Maps in the axes of their senders.
#[derive(Debug)]
pub struct SentMaps {
    /// `[N, C, H, W]`.
    pub maps: Tensor,
    /// `[N, 1, H, W]`, 1 where a cell was sent; absent: everywhere.
    pub sent: Option<Tensor>,
}

impl SentMaps {
    /// The entries from `first` up to `end`.
    fn only(&self, first: i64, end: i64) -> Result<Self, TchError> {
        let of = |tensor: &Tensor| tensor.f_narrow(0, first, end - first);
        Ok(Self { maps: of(&self.maps)?, sent: self.sent.as_ref().map(of).transpose()? })
    }

    /// Maps of one size, one after another.
    ///
    /// # Errors
    /// [`TchError`] when there are none, or of several sizes.
    pub fn together(all: &[&Self]) -> Result<Self, TchError> {
        let maps: Vec<&Tensor> = all.iter().map(|maps| &maps.maps).collect();
        // Where one of them was sent as a whole, that has to be said.
        let sent = all.iter().any(|maps| maps.sent.is_some()).then(|| {
            let cells = |maps: &&Self| match &maps.sent {
                Some(sent) => Ok(sent.shallow_clone()),
                None => maps.maps.f_narrow(1, 0, 1)?.f_ones_like(),
            };
            Tensor::f_cat(&all.iter().map(cells).collect::<Result<Vec<_>, _>>()?, 0)
        });
        Ok(Self { maps: Tensor::f_cat(&maps, 0)?, sent: sent.transpose()? })
    }
}

/// Maps on the ego lattice, with what they were made from.
#[derive(Debug)]
pub struct AlignedMaps {
    own_frame: Tensor,
    warped: Warped,
    earlier: Option<Warped>,
}

impl FusionStage {
    /// The fusion of `method` with random parameters below `path`: `fusion.*` and, where maps are exchanged,
    /// `steering.weight`.
    ///
    /// # Errors
    /// [`ConfigError`] names the field that no fusion can be built from.
    pub fn new(
        path: &nn::Path<'_>,
        config: &FusionConfig,
        method: Method,
        detector: &DetectorConfig,
    ) -> Result<Self, ConfigError> {
        let shares_maps = method.exchange() == Exchange::Features;
        let steering = shares_maps.then(|| Steering::new(path, detector.feature_channels()));
        let fusion = config.build(&(path / "fusion"))?;
        Ok(Self { config: config.clone(), fusion, steering, grid: detector.feature_grid(), y_axis: detector.y_axis })
    }

    /// The fusion of a weights file, or the one of `method` where it is another and has no parameters.
    ///
    /// # Errors
    /// [`StageError`] names the file and the first parameter that is missing or of another shape.
    pub fn from_weights(weights: &Weights, method: Method, detector: &DetectorConfig) -> Result<Self, StageError> {
        let variables = VarStore::new(Device::Cpu);
        let config = stored_config(weights, method, detector)?;
        let mut stage = Self::new(&variables.root(), &config, method, detector)?;
        weights.copy_some_into(&variables, |name| name != steering::WEIGHT || weights.contains(name))?;
        if !weights.contains(steering::WEIGHT) {
            stage.steering = None;
        }
        Ok(stage)
    }

    /// The fusion of `method` around a network without weights of its own: its parameters are random, channels stay as
    /// they come.
    ///
    /// # Errors
    /// [`ConfigError`] names the field that no fusion can be built from.
    pub fn untrained(method: Method, detector: &DetectorConfig) -> Result<Self, ConfigError> {
        let variables = VarStore::new(Device::Cpu);
        let config = FusionConfig::for_detector(method, detector);
        Ok(Self { steering: None, ..Self::new(&variables.root(), &config, method, detector)? })
    }

    /// What the fusion was built from.
    #[must_use]
    pub fn config(&self) -> &FusionConfig {
        &self.config
    }

    /// Time steps of every agent that the fusion wants.
    #[must_use]
    pub fn frames(&self) -> usize {
        self.fusion.frames()
    }

    /// Moves maps onto the ego lattice: `own_frame` is `[N, C, H, W]`, each map in the axes of its sender, `sent`
    /// `[N, 1, H, W]` is 1 where a cell was sent (absent: everywhere), `facts` are `N`: the ego's newest first, then the
    /// newest of all others, then what is older.
    ///
    /// # Errors
    /// [`WarpError`] when the maps do not lie on the lattice or facts are missing.
    pub fn align(
        &self,
        own_frame: &Tensor,
        sent: Option<&Tensor>,
        facts: &[ViewFacts],
    ) -> Result<AlignedMaps, WarpError> {
        let all = SentMaps { maps: own_frame.shallow_clone(), sent: sent.map(Tensor::shallow_clone) };
        let (count, newest) = (own_frame.size4()?.0, newest(facts) as i64);
        if count == newest {
            return self.align_kept(&all, None, facts);
        }
        let earlier = self.kept(&all.only(newest, count)?)?;
        self.align_kept(&all.only(0, newest.min(count))?, Some(&earlier), facts)
    }

    /// What is kept of maps for later frames, see [`Fusion::earlier_cells`].
    ///
    /// # Errors
    /// [`TchError`] when the maps are none.
    pub fn kept(&self, SentMaps { maps, sent }: &SentMaps) -> Result<SentMaps, TchError> {
        let Some(cells) = self.fusion.earlier_cells() else {
            return Ok(SentMaps { maps: maps.shallow_clone(), sent: sent.as_ref().map(Tensor::shallow_clone) });
        };
        // A larger cell was sent where any of its cells was.
        let sent = sent.as_ref().map(|sent| larger_cells(sent, cells)?.f_ceil()).transpose()?;
        Ok(SentMaps { maps: cell_by_cell(&larger_cells(maps, cells)?)?, sent })
    }

    /// [`Self::align`] with the maps that are older as they were [`Self::kept`].
    ///
    /// # Errors
    /// [`WarpError`] when the maps do not lie on the lattice or facts are missing.
    pub fn align_kept(
        &self,
        newest: &SentMaps,
        earlier: Option<&SentMaps>,
        facts: &[ViewFacts],
    ) -> Result<AlignedMaps, WarpError> {
        let poses: Vec<Pose> = self.of_network(facts).iter().map(|facts| facts.ego_from_cav).collect();
        let count = newest.maps.size4()?.0;
        let maps = count + earlier.map_or(Ok(0), |earlier| earlier.maps.size4().map(|size| size.0))?;
        if maps != poses.len() as i64 {
            return Err(WarpError::PoseCount { maps, poses: poses.len() });
        }
        let cells = self.fusion.earlier_cells();
        // What keeps earlier maps in another form takes the maximum over the newest, cell by cell.
        let order = if cells.is_some() { Order::Cells } else { Order::Planes };
        let (cells, Some(earlier)) = (cells, earlier) else {
            let (own_frame, warped) = self.moved(newest, &poses, &self.grid, order)?;
            return Ok(AlignedMaps { own_frame, warped, earlier: None });
        };
        let Some(cells) = cells else {
            let (own_frame, warped) =
                self.moved(&SentMaps::together(&[newest, earlier])?, &poses, &self.grid, order)?;
            return Ok(AlignedMaps { own_frame, warped, earlier: None });
        };
        let (of_newest, of_earlier) = poses.split_at(count as usize);
        let (own_frame, warped) = self.moved(newest, of_newest, &self.grid, order)?;
        let earlier = self.moved(earlier, of_earlier, &with_cells_of(&self.grid, cells), order)?.1;
        Ok(AlignedMaps { own_frame, warped, earlier: Some(earlier) })
    }

    /// Maps turned, and moved onto the ego's `grid`.
    fn moved(
        &self,
        SentMaps { maps, sent }: &SentMaps,
        poses: &[Pose],
        grid: &BevGrid,
        order: Order,
    ) -> Result<(Tensor, Warped), WarpError> {
        let own_frame = match &self.steering {
            Some(steering) => steering.turn(maps, poses)?,
            None => maps.shallow_clone(),
        };
        let warped = warp_in_order(&own_frame, sent.as_ref(), poses, grid, order)?;
        Ok((own_frame, warped))
    }

    /// Fuses aligned maps into `[C, H, W]` in the frame of the ego.
    ///
    /// # Errors
    /// [`WarpError::Torch`] when the tensor library refuses.
    pub fn fuse(&self, maps: &AlignedMaps, facts: &[ViewFacts], train: bool) -> Result<Tensor, WarpError> {
        Ok(self.fuse_and_correct(maps, facts, train)?.0)
    }

    /// The same, with how the method has moved the maps beyond their poses, see [`Fusion::fuse_and_correct`].
    ///
    /// # Errors
    /// As [`Self::fuse`].
    pub fn fuse_and_correct(
        &self,
        maps: &AlignedMaps,
        facts: &[ViewFacts],
        train: bool,
    ) -> Result<(Tensor, Option<Tensor>), WarpError> {
        let AlignedMaps { own_frame, warped, earlier } = maps;
        let facts = &*self.of_network(facts);
        let (facts, before) = facts.split_at(if earlier.is_some() { newest(facts) } else { facts.len() });
        let Warped { features, mask } = warped;
        let earlier = earlier.as_ref();
        let earlier =
            earlier.map(|warped| EarlierViews { features: &warped.features, mask: &warped.mask, facts: before });
        let views = AlignedViews { features, mask, own_frame, grid: &self.grid, facts, earlier };
        Ok(self.fusion.fuse_and_correct(&views, train)?)
    }
}

impl FusionStage {
    /// The facts in the world of the network: a mirrored one has mirrored poses.
    fn of_network<'a>(&self, facts: &'a [ViewFacts]) -> Cow<'a, [ViewFacts]> {
        if self.y_axis == YAxis::Left {
            return Cow::Borrowed(facts);
        }
        let mirrored = facts.iter().map(|facts| ViewFacts { ego_from_cav: facts.ego_from_cav.mirrored_y(), ..*facts });
        Cow::Owned(mirrored.collect())
    }
}

/// How many of the first entries are the newest of their agents.
fn newest(facts: &[ViewFacts]) -> usize {
    let is_first = |(entry, of): &(usize, &ViewFacts)| facts[..*entry].iter().all(|before| before.agent != of.agent);
    facts.iter().enumerate().take_while(is_first).count()
}

/// Maps `[N, C, H, W]` with cells of `cells` by `cells`, each their mean; those at the edges of fewer.
pub(super) fn larger_cells(maps: &Tensor, cells: i64) -> Result<Tensor, TchError> {
    let (.., height, width) = maps.size4()?;
    if cells == 1 {
        return Ok(maps.shallow_clone());
    }
    if height % cells != 0 || width % cells != 0 {
        return maps.f_avg_pool2d([cells, cells], [cells, cells], [0_i64, 0], true, false, None::<i64>);
    }
    // The tensor library's pooling takes three times as long.
    let rows = sum_of_every(maps, 2, cells)?;
    Ok(sum_of_every(&rows, 3, cells)? / (cells * cells) as f64)
}

/// The same maps, the channels of a cell side by side in memory, where no gradient flows.
fn cell_by_cell(maps: &Tensor) -> Result<Tensor, TchError> {
    match are_numbers(maps) {
        true => maps.f_permute([0, 2, 3, 1])?.f_contiguous()?.f_permute([0, 3, 1, 2]),
        false => Ok(maps.shallow_clone()),
    }
}

/// The sums of each `count` neighbours along `dim`.
fn sum_of_every(maps: &Tensor, dim: i64, count: i64) -> Result<Tensor, TchError> {
    let every = |first: i64| maps.f_slice(dim, first, None, count);
    (1..count).try_fold(every(0)?, |sum, first| sum.f_add(&every(first)?))
}

/// The lattice of such maps.
fn with_cells_of(grid: &BevGrid, cells: i64) -> BevGrid {
    let cells = cells as u32;
    let (width, height) = (grid.width.div_ceil(cells), grid.height.div_ceil(cells));
    BevGrid { cell_m: grid.cell_m * f64::from(cells), width, height, ..*grid }
}

/// The configuration that a weights file names, as long as it belongs to `method`.
pub(crate) fn stored_config(
    weights: &Weights,
    method: Method,
    detector: &DetectorConfig,
) -> Result<FusionConfig, WeightsError> {
    let usual = FusionConfig::for_detector(method, detector);
    if weights.metadata(FUSION_KEY).is_none() {
        return Ok(usual);
    }
    let stored: FusionConfig = weights.metadata_json(FUSION_KEY)?;
    let is_of_method = std::mem::discriminant(&stored) == std::mem::discriminant(&usual);
    Ok(if is_of_method { stored } else { usual })
}

#[cfg(test)]
mod tests {
    use tch::Kind;

    use super::*;

    /// A network of a mirrored world gets mirrored maps and answers with a mirrored one.
    #[test]
    fn a_mirrored_world_is_fused_like_this_one() {
        tch::set_num_threads(1);
        let plain = DetectorConfig::lean();
        let mirrored = DetectorConfig { y_axis: YAxis::Right, ..DetectorConfig::lean() };
        let grid = plain.feature_grid();
        let size = [3, plain.feature_channels(), i64::from(grid.height), i64::from(grid.width)];
        let maps = Tensor::rand(size, (Kind::Float, Device::Cpu));
        let poses =
            [Pose::IDENTITY, Pose::from_xyz_yaw([8.0, 3.0, 0.0], 0.4), Pose::from_xyz_yaw([-5.0, 9.0, 0.0], -2.0)];
        let facts: Vec<ViewFacts> = (0..3).map(|agent| ViewFacts::fresh(agent, poses[agent])).collect();
        let fused = |detector: &DetectorConfig, maps: &Tensor| {
            let stage = FusionStage::untrained(Method::Attention, detector).unwrap();
            stage.fuse(&stage.align(maps, None, &facts).unwrap(), &facts, false).unwrap()
        };
        let here = fused(&plain, &maps);
        let there = fused(&mirrored, &maps.flip([2])).flip([1]);
        assert!(here.allclose(&there, 1e-3, 1e-3, false));
    }

    #[test]
    fn larger_cells_are_means_at_the_edges_too() {
        let maps = Tensor::arange(24, (Kind::Float, Device::Cpu)).view([1, 1, 4, 6]);
        let pooled = |maps: &Tensor| maps.avg_pool2d([2, 2], [2, 2], [0, 0], true, false, None);
        assert_eq!(larger_cells(&maps, 1).unwrap(), maps);
        assert_eq!(larger_cells(&maps, 2).unwrap(), pooled(&maps));
        let odd = maps.narrow(3, 0, 5);
        assert_eq!(larger_cells(&odd, 2).unwrap(), pooled(&odd));
        assert_eq!(larger_cells(&odd, 2).unwrap().double_value(&[0, 0, 0, 2]), 7.0);
    }
}
