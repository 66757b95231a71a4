//! From the maps of several vehicles to one: turned, warped, fused. Training and the ego run the same lines.

use std::borrow::Cow;

use perception::model_config::{ConfigError, DetectorConfig, YAxis};
use perception::weights::{Weights, WeightsError};
use protocol::{BevGrid, Pose};
use tch::nn::{self, VarStore};
use tch::{Device, TchError, Tensor};

use super::channel_mixing::{self, Steering};
use super::classes::Classes;
use super::full_resolution::WholeMap;
use super::{AlignedViews, EarlierViews, FUSION_KEY, Fusion, FusionConfig, ViewFacts, WholeViews};
use crate::f64_tensor::are_numbers;
use crate::method::{Exchange, Method};
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
    /// For a fusion that recalls.
    classes: Option<Classes>,
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

/// What is kept of maps for later frames.
#[derive(Debug)]
pub struct EarlierMaps {
    /// With larger cells, see [`Fusion::earlier_cells`].
    shown: SentMaps,
    /// To the cell, for a fusion that [recalls](Fusion::recalls); else none.
    whole: Vec<WholeMap>,
}

impl EarlierMaps {
    /// Of a map of one cell.
    #[cfg(test)]
    pub(crate) fn of_nothing() -> Self {
        let maps = Tensor::zeros([1, 1, 1, 1], (tch::Kind::Float, Device::Cpu));
        Self { shown: SentMaps { maps, sent: None }, whole: Vec::new() }
    }

    /// What is kept of several maps, one after another.
    ///
    /// # Errors
    /// [`TchError`] when there are none, or of several sizes.
    pub fn together(all: &[&Self]) -> Result<Self, TchError> {
        let shown: Vec<&SentMaps> = all.iter().map(|kept| &kept.shown).collect();
        Ok(Self {
            shown: SentMaps::together(&shown)?,
            whole: all.iter().flat_map(|kept| &kept.whole).map(WholeMap::shallow_clone).collect(),
        })
    }
}

/// Maps on the ego lattice, with what they were made from.
#[derive(Debug)]
pub struct AlignedMaps {
    own_frame: SentMaps,
    warped: Warped,
    earlier: Option<Warped>,
    /// Earlier maps that are not moved yet.
    whole: Vec<WholeMap>,
}

impl AlignedMaps {
    /// One of the newest maps, `[1, C, H, W]`, where it was made but in the axes of the ego.
    pub fn turned(&self, map: i64) -> Result<Tensor, TchError> {
        self.own_frame.maps.f_narrow(0, map, 1)
    }
}

impl FusionStage {
    /// The fusion of `method` with random parameters below `path`: `fusion.*`, where maps are exchanged `steering.weight` and,
    /// for one that recalls, the detector's `cls_head.*` where that has not made them.
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
        let sizes = [detector.feature_channels(), detector.anchors.yaws_deg.len() as i64];
        let classes = fusion.recalls().then(|| Classes::under(path, sizes));
        let (grid, y_axis) = (detector.feature_grid(), detector.y_axis);
        Ok(Self { config: config.clone(), fusion, steering, classes, grid, y_axis })
    }

    /// The fusion of a weights file, or the one of `method` where it is another and has no parameters.
    ///
    /// # Errors
    /// [`StageError`] names the file and the first parameter that is missing or of another shape.
    pub fn from_weights(weights: &Weights, method: Method, detector: &DetectorConfig) -> Result<Self, StageError> {
        let variables = VarStore::new(Device::Cpu);
        let config = stored_config(weights, method, detector)?;
        let mut stage = Self::new(&variables.root(), &config, method, detector)?;
        weights.copy_some_into(&variables, |name| name != channel_mixing::WEIGHT || weights.contains(name))?;
        if !weights.contains(channel_mixing::WEIGHT) {
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
        let earlier = all.only(newest, count)?;
        let then = then_from_cav(&self.of_network(facts), newest as usize);
        let earlier = self.kept(&earlier, &self.turned(&earlier.maps, &then)?)?;
        self.align_kept(&all.only(0, newest.min(count))?, Some(earlier), facts)
    }

    /// What is kept of maps `[N, C, H, W]` for later frames, given the same maps in the axes of the ego, `turned`.
    ///
    /// # Errors
    /// [`TchError`] when the maps are none.
    pub fn kept(&self, SentMaps { maps, sent }: &SentMaps, turned: &Tensor) -> Result<EarlierMaps, TchError> {
        let shown = match self.fusion.earlier_cells() {
            Some(cells) => SentMaps {
                maps: cell_by_cell(&larger_cells(maps, cells)?)?,
                // A larger cell was sent where any of its cells was.
                sent: sent.as_ref().map(|sent| larger_cells(sent, cells)?.f_ceil()).transpose()?,
            },
            None => SentMaps { maps: maps.shallow_clone(), sent: sent.as_ref().map(Tensor::shallow_clone) },
        };
        let whole = |map: i64| {
            let of = |tensor: &Tensor| tensor.f_narrow(0, map, 1);
            WholeMap::of(&of(turned)?, sent.as_ref().map(of).transpose()?.as_ref())
        };
        let wanted = if self.fusion.recalls() { maps.size4()?.0 } else { 0 };
        Ok(EarlierMaps { shown, whole: (0..wanted).map(whole).collect::<Result<_, TchError>>()? })
    }

    /// Maps in the axes of the ego.
    fn turned(&self, maps: &Tensor, poses: &[Pose]) -> Result<Tensor, TchError> {
        match &self.steering {
            Some(steering) => steering.turn(maps, poses),
            None => Ok(maps.shallow_clone()),
        }
    }

    /// [`Self::align`] with the maps that are older as they were [`Self::kept`].
    ///
    /// # Errors
    /// [`WarpError`] when the maps do not lie on the lattice or facts are missing.
    pub fn align_kept(
        &self,
        newest: &SentMaps,
        earlier: Option<EarlierMaps>,
        facts: &[ViewFacts],
    ) -> Result<AlignedMaps, WarpError> {
        let poses: Vec<Pose> = self.of_network(facts).iter().map(|facts| facts.ego_from_cav).collect();
        let count = newest.maps.size4()?.0;
        let maps = count + earlier.as_ref().map_or(Ok(0), |earlier| earlier.shown.maps.size4().map(|size| size.0))?;
        if maps != poses.len() as i64 {
            return Err(WarpError::PoseCount { maps, poses: poses.len() });
        }
        let cells = self.fusion.earlier_cells();
        // What keeps earlier maps in another form takes the maximum over the newest, cell by cell.
        let order = if cells.is_some() { Order::Cells } else { Order::Planes };
        match (cells, earlier) {
            (Some(cells), Some(EarlierMaps { shown, whole })) => {
                let (of_newest, of_earlier) = poses.split_at(count as usize);
                let (own_frame, warped) = self.moved(newest, of_newest, &self.grid, order)?;
                let earlier = self.moved(&shown, of_earlier, &with_cells_of(&self.grid, cells), order)?.1;
                Ok(AlignedMaps { own_frame, warped, earlier: Some(earlier), whole })
            }
            (_, earlier) => {
                let all = earlier.map(|earlier| SentMaps::together(&[newest, &earlier.shown])).transpose()?;
                let (own_frame, warped) = self.moved(all.as_ref().unwrap_or(newest), &poses, &self.grid, order)?;
                Ok(AlignedMaps { own_frame, warped, earlier: None, whole: Vec::new() })
            }
        }
    }

    /// Maps turned, and moved onto the ego's `grid`.
    fn moved(
        &self,
        SentMaps { maps, sent }: &SentMaps,
        poses: &[Pose],
        grid: &BevGrid,
        order: Order,
    ) -> Result<(SentMaps, Warped), WarpError> {
        let maps = self.turned(maps, poses)?;
        let warped = warp_in_order(&maps, sent.as_ref(), poses, grid, order)?;
        Ok((SentMaps { maps, sent: sent.as_ref().map(Tensor::shallow_clone) }, warped))
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
        let AlignedMaps { own_frame, warped, earlier, whole } = maps;
        let facts = &*self.of_network(facts);
        let (facts, before) = facts.split_at(if earlier.is_some() { newest(facts) } else { facts.len() });
        let Warped { features, mask } = warped;
        let whole = self.classes.as_ref().map(|classes| WholeViews { maps: whole, classes });
        let earlier =
            earlier.as_ref().map(|Warped { features, mask }| EarlierViews { features, mask, facts: before, whole });
        let SentMaps { maps: own_frame, sent } = own_frame;
        let views = AlignedViews { features, mask, own_frame, sent: sent.as_ref(), grid: &self.grid, facts, earlier };
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

/// Poses of the entries from `newest` on in the frame that the ego had when they were the newest of their agents: its own
/// entry as many steps back tells of it, and where there is none it counts as standing still.
fn then_from_cav(facts: &[ViewFacts], newest: usize) -> Vec<Pose> {
    let step = |entry: usize| facts[..entry].iter().filter(|before| before.agent == facts[entry].agent).count();
    let ego_of = |wanted: usize| (0..facts.len()).find(|&entry| facts[entry].agent == 0 && step(entry) == wanted);
    let of_entry = |entry: usize| {
        if facts[entry].agent == 0 {
            return Pose::IDENTITY;
        }
        let ego = ego_of(step(entry)).map_or(Pose::IDENTITY, |ego| facts[ego].ego_from_cav);
        ego.from_world(&facts[entry].ego_from_cav)
    };
    (newest..facts.len()).map(of_entry).collect()
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
    fn earlier_maps_are_turned_as_when_they_were_the_newest() {
        let turned = |yaw_rad: f64| Pose::from_xyz_yaw([1.0, 2.0, 0.0], yaw_rad);
        let fact = |agent: usize, yaw_rad: f64| ViewFacts::fresh(agent, turned(yaw_rad));
        // The ego has turned by 0.1 since; of a third time step it has no map.
        let facts = [ViewFacts::fresh(0, Pose::IDENTITY), fact(1, 0.7), fact(0, -0.1), fact(1, 0.5), fact(1, 0.4)];
        let yaws: Vec<f64> = then_from_cav(&facts, 2).iter().map(Pose::yaw_rad).collect();
        assert!(yaws.iter().zip([0.0, 0.6, 0.4]).all(|(found, expected)| (found - expected).abs() < 1e-9), "{yaws:?}");
        assert_eq!(then_from_cav(&facts, 2)[0], Pose::IDENTITY);
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
