//! CE, Confidence Embedding (Eq. 7): how much of all trust in poses lies in each.

use std::collections::BTreeMap;

/// The place of every entry among those of its agent, 0 for the newest; of two of one age the first is the newer.
pub(super) fn steps_back(agent: &[usize], age_secs: &[f64]) -> Vec<usize> {
    let is_newer = |a: usize, b: usize| age_secs[a] < age_secs[b] || (age_secs[a] == age_secs[b] && a < b);
    (0..agent.len())
        .map(|entry| (0..agent.len()).filter(|&other| agent[other] == agent[entry] && is_newer(other, entry)).count())
        .collect()
}

/// `sigma_i / sum_j sigma_j` of every entry, the sum over the agents that have an entry of the same time step.
///
/// An ego alone has 1. Where nobody is trusted at all, all are trusted alike.
pub(super) fn shares(confidence: &[f64], steps_back: &[usize]) -> Vec<f32> {
    let mut sums: BTreeMap<usize, (f64, usize)> = BTreeMap::new();
    for (&sigma, &step) in confidence.iter().zip(steps_back) {
        let (sum, count) = sums.entry(step).or_default();
        *sum += sigma.max(0.0);
        *count += 1;
    }
    let share = |(&sigma, step): (&f64, &usize)| {
        let (sum, count) = sums[step];
        if sum > 0.0 { sigma.max(0.0) / sum } else { 1.0 / count as f64 }
    };
    confidence.iter().zip(steps_back).map(|pair| share(pair) as f32).collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn alone_the_share_is_one_and_two_divide_it_by_their_confidence() {
        assert_eq!(shares(&[0.2], &[0]), [1.0]);
        assert_eq!(shares(&[0.0], &[0]), [1.0]);
        assert_eq!(shares(&[0.9, 0.3], &[0, 0]), [0.75, 0.25]);
        assert_eq!(shares(&[0.0, 0.0], &[0, 0]), [0.5, 0.5]);
    }

    #[test]
    fn every_time_step_is_divided_for_itself() {
        let steps = steps_back(&[0, 1, 0, 1, 1], &[0.0, 0.2, 0.1, 0.3, 0.25]);
        assert_eq!(steps, [0, 0, 1, 2, 1]);
        assert_eq!(shares(&[0.5, 0.5, 0.3, 0.4, 0.1], &steps), [0.5, 0.5, 0.75, 1.0, 0.25]);
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
