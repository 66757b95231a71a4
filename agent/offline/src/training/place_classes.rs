//! Place classes: an auxiliary classification loss for networks that regress poses from random weights.
//!
//! The published networks are pretrained on large image collections. Not in their papers; the classifier is not used
//! for localization.

use perception::tensor_values::tensor;
use tch::nn::{self, LinearConfig, Module};
use tch::{Device, Kind, Reduction, TchError, Tensor};

use super::kmeans::kmeans;

/// Number of classes.
const CLASSES: usize = 256;
/// Distance of two headings 60 degrees apart, metres: opposite lanes are different classes.
const HEADING_M: f64 = 15.0;
/// Label smoothing, as in LightLoc's classifier.
const LABEL_SMOOTHING: f64 = 0.1;

/// Classifiers of features by the nearest of some training poses, one for each branch of a network.
pub(super) struct PlaceClasses<const BRANCHES: usize> {
    layers: [nn::Linear; BRANCHES],
    /// `[5]`: metres of each number of a pose.
    units_m: Tensor,
    /// `[classes, 5]`, metres.
    centres_m: Tensor,
}

impl<const BRANCHES: usize> PlaceClasses<BRANCHES> {
    /// Clusters training poses `[S, 5]` (position in units of `scale_m`, cosine and sine of the heading), and builds
    /// a layer for features of `width` channels below each of `paths`.
    pub(super) fn new(
        paths: [nn::Path<'_>; BRANCHES],
        width: i64,
        poses: &Tensor,
        scale_m: [f64; 3],
        seed: u64,
    ) -> Result<Self, TchError> {
        let [x, y, z] = scale_m.map(|unit| unit as f32);
        let heading_m = HEADING_M as f32;
        let device = poses.device();
        let units_m = tensor(&[x, y, z, heading_m, heading_m], &[5], device)?;
        let metres = poses.f_mul(&units_m)?.f_to_kind(Kind::Double)?;
        let rows: Vec<f64> = Vec::try_from(&metres.f_reshape([-1])?)?;
        let (rows, _) = rows.as_chunks::<5>();
        let (centres, _) = kmeans(rows, CLASSES, seed);
        let centres_m = tensor(centres.as_flattened(), &[-1, 5], Device::Cpu)?;
        let centres_m = centres_m.f_to_kind(Kind::Float)?.f_to_device(device)?;
        let layers = paths
            .map(|path| nn::linear(path, width, centres.len() as i64, LinearConfig::default()));
        Ok(Self {
            layers,
            units_m,
            centres_m,
        })
    }

    /// `[BRANCHES]`: cross entropy of each branch's features `[N, width]` of sweeps with `poses` `[N, 5]`.
    pub(super) fn losses(
        &self,
        features: [&Tensor; BRANCHES],
        poses: &Tensor,
    ) -> Result<Tensor, TchError> {
        let classes = self.classes(poses)?;
        let losses = self.layers.iter().zip(features).map(|(layer, features)| {
            let (logits, mean) = (layer.forward(features), Reduction::Mean);
            logits.f_cross_entropy_loss(&classes, None::<Tensor>, mean, -100, LABEL_SMOOTHING)
        });
        Tensor::f_stack(&losses.collect::<Result<Vec<_>, _>>()?, 0)
    }

    /// `[N]`: the nearest centre of each of `poses` `[N, 5]`.
    fn classes(&self, poses: &Tensor) -> Result<Tensor, TchError> {
        Tensor::f_cdist(&poses.f_mul(&self.units_m)?, &self.centres_m, 2.0, None)?
            .f_argmin(1, false)
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;
    use tch::nn::VarStore;

    use super::*;

    /// Four poses: two places, in both directions of each.
    fn poses() -> Tensor {
        let rows: [[f32; 5]; 4] = [
            [0.0, 0.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, 0.0, -1.0, 0.0],
            [1.0, 0.5, 0.0, 0.0, 1.0],
            [1.0, 0.5, 0.0, 0.0, -1.0],
        ];
        Tensor::from_slice(rows.as_flattened()).view([4, 5])
    }

    #[test]
    fn places_and_directions_are_classes_of_their_own() {
        let variables = VarStore::new(Device::Cpu);
        let classes =
            PlaceClasses::new([variables.root()], 8, &poses(), [100.0, 100.0, 1.0], 0).unwrap();
        let found: Vec<i64> = Vec::try_from(classes.classes(&poses()).unwrap()).unwrap();
        let mut sorted = found.clone();
        sorted.sort_unstable();
        assert_eq!(sorted, [0, 1, 2, 3]);
        // 3 m and 10 degrees away.
        let (sine, cosine) = 10f32.to_radians().sin_cos();
        let near = Tensor::from_slice(&[0.03f32, 0.0, 0.0, cosine, sine]).view([1, 5]);
        assert_eq!(
            Vec::<i64>::try_from(classes.classes(&near).unwrap()).unwrap(),
            found[..1]
        );
    }

    #[test]
    fn features_that_separate_the_classes_have_a_small_loss() {
        let variables = VarStore::new(Device::Cpu);
        let classes =
            PlaceClasses::new([variables.root()], 4, &poses(), [100.0, 100.0, 1.0], 0).unwrap();
        let own = classes
            .classes(&poses())
            .unwrap()
            .one_hot(4)
            .to_kind(Kind::Float);
        tch::no_grad(|| {
            let named = variables.variables();
            named["weight"]
                .shallow_clone()
                .copy_(&(Tensor::eye(4, (Kind::Float, Device::Cpu)) * 20.0));
            let _ = named["bias"].shallow_clone().zero_();
        });
        let loss = |features: &Tensor| {
            classes
                .losses([features], &poses())
                .unwrap()
                .double_value(&[0])
        };
        assert!(
            loss(&own) + 3.0 < loss(&own.roll([1], [0])),
            "{} {}",
            loss(&own),
            loss(&own.roll([1], [0]))
        );
    }
}
