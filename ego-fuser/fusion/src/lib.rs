//! Many feature maps on the ego lattice, one feature map out.

mod attention;
mod block_order;
pub(crate) mod channel_mixing;
mod classes;
pub mod coalign;
pub mod cobevt;
mod config;
mod conv_gru;
pub mod disconet;
pub mod ermvp;
pub mod f64_tensor;
mod full_resolution;
pub mod history;
pub mod layers;
mod max;
pub mod method;
pub mod model;
mod padding;
mod partition;
pub mod pastat;
pub mod planar_fit;
pub mod points;
pub mod pose_graph;
mod stage;
pub mod swap_fusion;
pub mod targets;
#[cfg(test)]
pub(crate) mod test_data;
pub mod traf_align;
pub mod v2vnet;
pub mod v2xvit;
pub mod warp;
pub mod where2comm;

use std::fmt::Debug;

use protocol::{BevGrid, Pose};
use tch::{TchError, Tensor};

pub use attention::AttentionFusion;
pub use block_order::BlockOrder;
pub use channel_mixing::Steering;
use classes::Classes;
pub use config::{FUSION_KEY, FusionConfig};
pub(crate) use full_resolution::{Seen, WholeMap};
pub use max::MaxFusion;
pub use method::{Exchange, Method};
pub use stage::{AlignedMaps, EarlierMaps, FusionStage, SentMaps, StageError};
pub(crate) use stage::{FUSION_PREFIX, stored_config};

/// What is known of one map besides its values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewFacts {
    /// Which agent it is of, 0 being the ego. With history an agent has several maps.
    pub agent: usize,
    /// Where its sender was when it was made, in the frame of the ego now.
    pub ego_from_cav: Pose,
    /// Confidence of its sender's pose, 0..1.
    pub confidence: f64,
    /// Its age relative to the ego's newest map, seconds.
    pub age_secs: f64,
}

impl ViewFacts {
    /// A fresh map with a pose beyond doubt.
    #[must_use]
    pub fn fresh(agent: usize, ego_from_cav: Pose) -> Self {
        Self { agent, ego_from_cav, confidence: 1.0, age_secs: 0.0 }
    }
}

/// The maps of one sample, aligned; the first is the ego's newest.
///
/// Missing agents are either not in it or have a mask of zeros: both mean the same to every method.
#[derive(Debug, Clone, Copy)]
pub struct AlignedViews<'a> {
    /// `[N, C, H, W]` features on the ego lattice.
    pub features: &'a Tensor,
    /// `[N, 1, H, W]` 1 where a map reaches and was sent, 0 elsewhere; 1 everywhere for the ego.
    pub mask: &'a Tensor,
    /// `[N, C, H, W]` the maps before they were moved, for methods that move them themselves.
    pub own_frame: &'a Tensor,
    /// `[N, 1, H, W]` which of their cells were sent; absent: all.
    pub sent: Option<&'a Tensor>,
    /// The lattice of all maps, each in the frame of its vehicle.
    pub grid: &'a BevGrid,
    /// `N`: what is known of each.
    pub facts: &'a [ViewFacts],
    /// Maps from before each agent's newest, where the method takes them apart, see [`Fusion::earlier_cells`].
    pub earlier: Option<EarlierViews<'a>>,
}

/// Aligned maps from before the newest of their agents.
#[derive(Debug, Clone, Copy)]
pub struct EarlierViews<'a> {
    /// `[O, C, h, w]` features on a lattice of the ego with larger cells.
    pub features: &'a Tensor,
    /// `[O, 1, h, w]` 1 where a map reaches and was sent, 0 elsewhere.
    pub mask: &'a Tensor,
    /// `O`: what is known of each.
    pub facts: &'a [ViewFacts],
    /// The same to the cell, for a method that [recalls](Fusion::recalls).
    pub(crate) whole: Option<WholeViews<'a>>,
}

/// Maps from before the newest of their agents, to the cell and not moved yet.
#[derive(Debug, Clone, Copy)]
pub(crate) struct WholeViews<'a> {
    /// `O` maps.
    pub(crate) maps: &'a [WholeMap],
    /// Where on a map vehicles may be.
    pub(crate) classes: &'a Classes,
}

/// A way to fuse aligned feature maps.
pub trait Fusion: Debug + Send {
    /// Fuses the maps of one sample into `[C, H, W]` in the frame of the ego.
    ///
    /// # Errors
    /// [`TchError`] when the shapes of features and mask do not fit.
    fn fuse(&self, views: &AlignedViews<'_>, train: bool) -> Result<Tensor, TchError>;

    /// The same, with how it has moved each entry but the first beyond its pose, `[N - 1, 3]`, those of
    /// [`AlignedViews::earlier`] last: along x and y of the ego, metres, and about the entry's sender, radians. Nothing for
    /// methods that take poses as they are, and where there is one entry.
    ///
    /// # Errors
    /// As [`Self::fuse`].
    fn fuse_and_correct(&self, views: &AlignedViews<'_>, train: bool) -> Result<(Tensor, Option<Tensor>), TchError> {
        Ok((self.fuse(views, train)?, None))
    }

    /// Time steps that it wants of every agent, the newest included.
    fn frames(&self) -> usize {
        1
    }

    /// Along each edge so many cells of a map from before its agent's newest become one before it is moved; `None`: such
    /// maps come among the newest, as they are.
    fn earlier_cells(&self) -> Option<i64> {
        None
    }

    /// Whether earlier maps are wanted to the cell too.
    fn recalls(&self) -> bool {
        false
    }
}

/// The ego's own map, whatever the others have.
#[derive(Debug, Clone, Copy, Default)]
pub struct NoFusion;

impl Fusion for NoFusion {
    fn fuse(&self, views: &AlignedViews<'_>, _train: bool) -> Result<Tensor, TchError> {
        views.features.f_get(0)
    }
}

/// The entries of `mask` `[N, 1, H, W]` that have something to say anywhere, the ego first.
pub(crate) fn present(mask: &Tensor) -> Result<Vec<i64>, TchError> {
    let most = mask.f_amax([1i64, 2, 3].as_slice(), false)?.f_to_kind(tch::Kind::Float)?;
    let most = Vec::<f32>::try_from(most.f_to_device(tch::Device::Cpu)?)?;
    Ok((0i64..).zip(most).filter(|(entry, most)| *entry == 0 || *most > 0.0).map(|(entry, _)| entry).collect())
}

/// Splits agents of all samples into padded samples: `[sum(agents), ...]` to `[B, longest, ...]` and a mask `[B, longest]`.
///
/// # Errors
/// [`TchError`] when the counts do not add up to the first size, or one is above `longest`.
pub fn regroup(features: &Tensor, agents: &[i64], longest: i64) -> Result<(Tensor, Tensor), TchError> {
    let mut samples = Vec::with_capacity(agents.len());
    let mut masks = Vec::with_capacity(agents.len());
    for (sample, &count) in features.f_split_with_sizes(agents, 0)?.into_iter().zip(agents) {
        let mut padding = sample.size();
        padding[0] = longest - count;
        let empty = Tensor::f_zeros(padding, (sample.kind(), sample.device()))?;
        samples.push(Tensor::f_cat(&[sample, empty], 0)?);
        masks.push(Tensor::f_arange(longest, (tch::Kind::Int64, features.device()))?.f_lt(count)?);
    }
    Ok((Tensor::f_stack(&samples, 0)?, Tensor::f_stack(&masks, 0)?))
}

#[cfg(test)]
mod tests {
    use perception::model_config::{DetectorConfig, ShrinkConfig};
    use tch::nn::VarStore;
    use tch::{Device, Kind, no_grad};

    use super::*;
    use crate::Method;

    const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);
    const SHAPE: [i64; 3] = [16, 16, 24];

    /// The fusion of every method, untrained.
    fn all() -> impl Iterator<Item = (Method, Box<dyn Fusion>)> {
        tch::set_num_threads(1);
        let shrink = Some(ShrinkConfig::Pointwise { channels: SHAPE[0] });
        let detector = DetectorConfig { shrink, ..DetectorConfig::lean() };
        Method::ALL.into_iter().map(move |method| {
            let variables = VarStore::new(Device::Cpu);
            (method, FusionConfig::for_detector(method, &detector).build(&variables.root()).unwrap())
        })
    }

    fn random(agents: i64) -> Tensor {
        Tensor::rand([agents, SHAPE[0], SHAPE[1], SHAPE[2]], FLOAT)
    }

    fn fuse(fusion: &dyn Fusion, features: &Tensor, reach: &[f32]) -> Tensor {
        let agents: Vec<usize> = (0..reach.len()).collect();
        fuse_of(fusion, features, reach, &agents)
    }

    /// The same for maps of these agents, each of which stands somewhere else.
    fn fuse_of(fusion: &dyn Fusion, features: &Tensor, reach: &[f32], agents: &[usize]) -> Tensor {
        let mask = Tensor::from_slice(reach).view([-1, 1, 1, 1]).expand([-1, 1, SHAPE[1], SHAPE[2]], false);
        let facts: Vec<_> = (agents.iter())
            .map(|&agent| ViewFacts::fresh(agent, Pose::from_xyz_yaw([2.0 * agent as f64, 0.0, 0.0], 0.0)))
            .collect();
        let (height, width) = (SHAPE[1] as u32, SHAPE[2] as u32);
        let grid = BevGrid { x_min_m: -12.0, y_min_m: -8.0, cell_m: 1.0, width, height };
        let views = AlignedViews {
            features,
            mask: &mask,
            own_frame: features,
            sent: None,
            grid: &grid,
            facts: &facts,
            earlier: None,
        };
        let fused = no_grad(|| fusion.fuse(&views, false)).unwrap();
        assert_eq!(fused.size(), SHAPE);
        fused
    }

    fn difference(one: &Tensor, other: &Tensor) -> f64 {
        (one - other).abs().max().double_value(&[])
    }

    #[test]
    fn masked_neighbours_change_nothing() {
        let features = random(3);
        for (method, fusion) in all() {
            let alone = fuse(&*fusion, &features.narrow(0, 0, 1), &[1.0]);
            assert!(alone.isfinite().all().double_value(&[]) == 1.0, "{method}");
            let masked = fuse(&*fusion, &features, &[1.0, 0.0, 0.0]);
            assert!(difference(&alone, &masked) < 1e-4, "{method}");
        }
    }

    #[test]
    fn neighbours_that_are_seen_change_something_unless_maps_are_not_exchanged() {
        let features = random(3);
        for (method, fusion) in all() {
            let alone = fuse(&*fusion, &features.narrow(0, 0, 1), &[1.0]);
            let together = fuse(&*fusion, &features, &[1.0, 1.0, 1.0]);
            let shares_maps = method.exchange() == crate::method::Exchange::Features;
            assert_eq!(difference(&alone, &together) > 1e-4, shares_maps, "{method}");
        }
    }

    #[test]
    fn the_order_of_neighbours_does_not_matter() {
        let features = random(3);
        let swapped = features.index_select(0, &Tensor::from_slice(&[0i64, 2, 1]));
        for (method, fusion) in all() {
            let one = fuse_of(&*fusion, &features, &[1.0; 3], &[0, 1, 2]);
            let other = fuse_of(&*fusion, &swapped, &[1.0; 3], &[0, 2, 1]);
            assert!(difference(&one, &other) < 1e-4, "{method}");
        }
    }

    #[test]
    fn every_parameter_learns() {
        let features = random(3);
        let shrink = Some(ShrinkConfig::Pointwise { channels: SHAPE[0] });
        let detector = DetectorConfig { shrink, ..DetectorConfig::lean() };
        for method in Method::ALL {
            let variables = VarStore::new(Device::Cpu);
            let fusion = FusionConfig::for_detector(method, &detector).build(&variables.root()).unwrap();
            let mask = Tensor::ones([3, 1, SHAPE[1], SHAPE[2]], FLOAT);
            let facts: Vec<_> = (0..3)
                .map(|agent| ViewFacts { age_secs: 0.07 * agent as f64, ..ViewFacts::fresh(agent, Pose::IDENTITY) })
                .collect();
            let (height, width) = (SHAPE[1] as u32, SHAPE[2] as u32);
            let grid = BevGrid { x_min_m: -12.0, y_min_m: -8.0, cell_m: 1.0, width, height };
            let (own_frame, facts) = (&features, &facts[..]);
            let views = AlignedViews {
                features: &features,
                mask: &mask,
                own_frame,
                sent: None,
                grid: &grid,
                facts,
                earlier: None,
            };
            let fused = fusion.fuse(&views, true).unwrap();
            if variables.is_empty() {
                continue;
            }
            (fused * random(1)).sum(Kind::Float).backward();
            for (name, variable) in variables.variables() {
                // What belongs to another type of agent has nothing to learn from vehicles, and what recalls earlier maps
                // nothing from the newest.
                let is_idle = name.contains("linears.1.") || name.starts_with("recall.") || !variable.requires_grad();
                let learns = variable.grad().defined() && variable.grad().isfinite().all().double_value(&[]) == 1.0;
                assert!(learns || is_idle, "{method}: {name}");
            }
        }
    }

    #[test]
    fn regroup_pads_with_nothing() {
        let features = Tensor::arange(3, FLOAT).view([3, 1]) + 1.0;
        let (groups, mask) = regroup(&features, &[2, 1], 3).unwrap();
        assert_eq!(Vec::<f32>::try_from(groups.view(-1)).unwrap(), [1.0, 2.0, 0.0, 3.0, 0.0, 0.0]);
        assert_eq!(Vec::<bool>::try_from(mask.view(-1)).unwrap(), [true, true, false, true, false, false]);
        assert!(regroup(&features, &[2, 2], 3).is_err());
    }
}
