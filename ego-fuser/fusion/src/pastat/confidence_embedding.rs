//! CE, Confidence Embedding (Eq. 7): appends the share of each pose in the total confidence to the features of its map.

use std::collections::BTreeMap;

use perception::tensor_values::tensor;
use tch::{Device, TchError, Tensor, nn};

use super::coarse_alignment::Origins;
use super::config::PastatConfig;
use crate::layers::uniform;

/// Values of each entry that FSA gets: its share, its confidence and the ego's. Shares alone do not distinguish all
/// poses good from all poses bad.
pub(super) const CONFIDENCES: i64 = 3;

/// Appends the channel of Eq. 7 to maps.
///
/// The channel is constant over a map, so its part of a token is the channel's weight times that value for every cell;
/// the channel itself is not built.
#[derive(Debug)]
pub(super) struct ConfidenceEmbedding {
    /// `[D]`: the weight of the channel in the patch embedding; absent: no such channel, for the ablation.
    weight: Option<Tensor>,
    device: Device,
}

/// The channel of Eq. 7.
#[derive(Debug)]
pub(super) struct Confidences {
    /// `[N, D]`: its part of the tokens of each entry.
    pub(super) of_tokens: Option<Tensor>,
    /// `[N, CONFIDENCES]`: input of FSA; zeros without the embedding.
    pub(super) of_maps: Tensor,
}

impl ConfidenceEmbedding {
    /// Its variable is `ce.weight` below `path`.
    pub(super) fn new(path: &nn::Path<'_>, config: &PastatConfig) -> Self {
        // One over the root of the fan-in of the patch embedding, of which this is one more input channel.
        let inputs = (config.channels * config.patch * config.patch) as f64;
        let bound = inputs.sqrt().recip();
        let weight = config
            .ce
            .then(|| (path / "ce").var("weight", &[config.dim], uniform(bound)));
        Self {
            weight,
            device: path.device(),
        }
    }

    /// Eq. 7 for every entry.
    pub(super) fn embed(&self, origins: &Origins) -> Result<Confidences, TchError> {
        let confidence = &origins.confidence;
        let shares = shares(confidence, &origins.steps_back);
        let of_maps = (shares.iter().zip(confidence))
            .flat_map(|(share, &own)| [*share, own as f32, confidence[0] as f32]);
        let of_maps = of_maps.collect::<Vec<f32>>();
        let of_maps = tensor(&of_maps, &[-1, CONFIDENCES], self.device)?;
        Ok(match &self.weight {
            Some(weight) => Confidences {
                of_tokens: Some(tensor(&shares, &[-1, 1], self.device)? * weight),
                of_maps,
            },
            None => Confidences {
                of_tokens: None,
                of_maps: of_maps.f_zeros_like()?,
            },
        })
    }
}

/// `sigma_i / sum_j sigma_j` of every entry, the sum over the agents that have an entry of the same time step.
///
/// An ego without neighbours has 1. If all confidences are zero, the shares are equal.
pub(super) fn shares(confidence: &[f64], steps_back: &[usize]) -> Vec<f32> {
    let mut sums: BTreeMap<usize, (f64, usize)> = BTreeMap::new();
    for (&sigma, &step) in confidence.iter().zip(steps_back) {
        let (sum, count) = sums.entry(step).or_default();
        // `max` also turns NaN into 0.
        *sum += sigma.max(0.0);
        *count += 1;
    }
    let shares = confidence.iter().zip(steps_back).map(|(&sigma, step)| {
        let (sum, count) = sums[step];
        let share = if sum > 0.0 {
            sigma.max(0.0) / sum
        } else {
            1.0 / count as f64
        };
        share as f32
    });
    shares.collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::pastat::coarse_alignment::steps_back;

    #[test]
    fn ego_only_the_share_is_one_and_two_divide_it_by_their_confidence() {
        assert_eq!(shares(&[0.2], &[0]), [1.0]);
        assert_eq!(shares(&[0.0], &[0]), [1.0]);
        assert_eq!(shares(&[0.9, 0.3], &[0, 0]), [0.75, 0.25]);
        assert_eq!(shares(&[0.0, 0.0], &[0, 0]), [0.5, 0.5]);
    }

    #[test]
    fn every_time_step_is_divided_for_itself() {
        let steps = steps_back(&[0, 1, 0, 1, 1], &[0.0, 0.2, 0.1, 0.3, 0.25]);
        assert_eq!(steps, [0, 0, 1, 2, 1]);
        assert_eq!(
            shares(&[0.5, 0.5, 0.3, 0.4, 0.1], &steps),
            [0.5, 0.5, 0.75, 1.0, 0.25]
        );
    }

    proptest! {
        #[test]
        fn the_shares_of_a_time_step_add_up_to_one(
            entries in prop::collection::vec((0.0f64..1.0, 0usize..4, 0.0f64..0.5), 1..20)
        ) {
            let confidence: Vec<f64> = entries.iter().map(|entry| entry.0).collect();
            let agent: Vec<usize> = entries.iter().map(|entry| entry.1).collect();
            let age: Vec<f64> = entries.iter().map(|entry| entry.2).collect();
            let steps = steps_back(&agent, &age);
            let shares = shares(&confidence, &steps);
            for step in 0..=*steps.iter().max().unwrap() {
                let of_step = shares.iter().zip(&steps).filter(|(_, at)| **at == step);
                let sum: f32 = of_step.clone().map(|(share, _)| share).sum();
                prop_assert!(of_step.count() == 0 || (sum - 1.0).abs() < 1e-5);
            }
        }
    }
}
