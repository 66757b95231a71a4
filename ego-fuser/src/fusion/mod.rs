//! Many feature maps on the ego lattice, one feature map out.

mod attention;
mod max;
pub(crate) mod steering;

use std::fmt::Debug;

use tch::{TchError, Tensor};

pub use attention::AttentionFusion;
pub use max::MaxFusion;
pub use steering::Steering;

use crate::Method;

/// The views of one sample, aligned; the ego is the first agent.
///
/// Missing agents are either not in it or have a mask of zeros: both mean the same to every method.
#[derive(Debug)]
pub struct AlignedViews<'a> {
    /// `[N, C, H, W]` features on the ego lattice.
    pub features: &'a Tensor,
    /// `[N, 1, H, W]` 1 where an agent's map reaches, 0 elsewhere; 1 everywhere for the ego.
    pub mask: &'a Tensor,
    /// Confidence of each agent's pose, 0..1.
    pub confidence: &'a [f64],
    /// Age of each map relative to the ego's, seconds.
    pub age_secs: &'a [f64],
}

/// A way to fuse aligned feature maps.
pub trait Fusion: Debug + Send {
    /// Fuses the views of one sample into `[C, H, W]` in the frame of the ego.
    ///
    /// # Errors
    /// [`TchError`] when the shapes of features and mask do not fit.
    fn fuse(&self, views: &AlignedViews<'_>) -> Result<Tensor, TchError>;
}

/// The ego's own map, whatever the others have.
#[derive(Debug, Clone, Copy, Default)]
pub struct NoFusion;

impl Fusion for NoFusion {
    fn fuse(&self, views: &AlignedViews<'_>) -> Result<Tensor, TchError> {
        views.features.f_get(0)
    }
}

/// The fusion of feature maps that belongs to `method`; methods that exchange something else fuse no maps.
#[must_use]
pub fn build(method: Method) -> Box<dyn Fusion> {
    match method {
        Method::None | Method::Late | Method::Early => Box::new(NoFusion),
        Method::Max => Box::new(MaxFusion),
        Method::Attention => Box::new(AttentionFusion),
    }
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
    use tch::{Device, Kind};

    use super::*;

    const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);

    fn fuse(method: Method, features: &Tensor, mask: &Tensor) -> Tensor {
        let agents = features.size()[0] as usize;
        let (confidence, age_secs) = (vec![1.0; agents], vec![0.0; agents]);
        build(method).fuse(&AlignedViews { features, mask, confidence: &confidence, age_secs: &age_secs }).unwrap()
    }

    #[test]
    fn alone_every_method_gives_the_ego_back() {
        let features = Tensor::randn([1, 4, 5, 6], FLOAT);
        let mask = Tensor::ones([1, 1, 5, 6], FLOAT);
        for method in Method::ALL {
            assert_eq!(fuse(method, &features, &mask), features.get(0), "{method}");
        }
    }

    #[test]
    fn masked_neighbours_change_nothing() {
        let features = Tensor::randn([3, 4, 5, 6], FLOAT);
        let mask = Tensor::zeros([3, 1, 5, 6], FLOAT);
        let _ = mask.get(0).fill_(1.0);
        for method in Method::ALL {
            let difference = fuse(method, &features, &mask) - features.get(0);
            assert!(difference.abs().max().double_value(&[]) < 1e-6, "{method}");
        }
    }

    #[test]
    fn the_order_of_neighbours_does_not_matter() {
        let features = Tensor::randn([3, 4, 5, 6], FLOAT);
        let mask = Tensor::ones([3, 1, 5, 6], FLOAT);
        let swapped = features.index_select(0, &Tensor::from_slice(&[0i64, 2, 1]));
        for method in Method::ALL {
            let difference = fuse(method, &features, &mask) - fuse(method, &swapped, &mask);
            assert!(difference.abs().max().double_value(&[]) < 1e-5, "{method}");
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
