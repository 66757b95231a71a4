//! Redundant Sample Downsampling (LightLoc, Li et al. 2025): leaves out sweeps whose losses vary least.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Choice of the sweeps that are left out: a quarter after each of two windows; the last sixth of the training uses all.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum LeaveOut {
    /// Those whose losses vary least (RSD).
    EvenLoss,
    /// Random ones, as many: the control of RSD.
    Random,
}

/// Share of each cluster's sweeps that is dropped at the end of a window.
const DROP: f64 = 0.25;
/// The two windows in which losses are recorded, start and end as shares of the training.
const WINDOWS: [[f64; 2]; 2] = [[0.1, 0.25], [0.35, 0.5]];
/// Share of the training from which all sweeps are used again.
const ALL_FROM: f64 = 0.84;
/// Number of passes over a sweep in a window that its variance is computed from, at least.
const ENOUGH_PASSES: usize = 2;

/// Selection and weights of the sweeps.
///
/// It is not part of a checkpoint: a training that is resumed uses all sweeps again, and leaves none out before the end
/// of a window that it has observed long enough itself.
#[derive(Debug)]
pub(crate) struct Redundancy {
    leave_out: LeaveOut,
    /// [`WINDOWS`], but for tests.
    pub(crate) windows: [[f64; 2]; 2],
    class_of_sweep: Vec<usize>,
    /// Weight of each sweep; 0: not used.
    pub(crate) weights: Vec<f32>,
    /// Median losses of each sweep in the current window, one per pass.
    recorded: Vec<Vec<f32>>,
    windows_done: usize,
    rng: ChaCha8Rng,
}

impl Redundancy {
    /// Nothing dropped yet. The seed is that of a random choice.
    pub(crate) fn new(leave_out: LeaveOut, seed: u64, class_of_sweep: Vec<usize>) -> Self {
        let count = class_of_sweep.len();
        Self {
            rng: ChaCha8Rng::seed_from_u64(seed),
            leave_out,
            windows: WINDOWS,
            class_of_sweep,
            weights: vec![1.0; count],
            recorded: vec![Vec::new(); count],
            windows_done: 0,
        }
    }

    /// True if losses are recorded when this share of the training is done.
    pub(crate) fn watches(&self, share_done: f64) -> bool {
        let window = self.windows.get(self.windows_done);
        window.is_some_and(|[from, to]| (*from..*to).contains(&share_done))
    }

    /// Records the losses of the cells of one pass: pairs of sweep and loss.
    pub(crate) fn record(&mut self, losses: &[(usize, f32)]) {
        let mut by_sweep = vec![Vec::new(); self.weights.len()];
        for &(sweep, loss) in losses {
            by_sweep[sweep].push(loss);
        }
        for (recorded, mut losses) in self.recorded.iter_mut().zip(by_sweep) {
            if !losses.is_empty() {
                // The median: a few cells on moving objects must not decide about a sweep.
                let middle = losses.len() / 2;
                recorded.push(*losses.select_nth_unstable_by(middle, f32::total_cmp).1);
            }
        }
    }

    /// True if sweeps that were left out are to be used again now, without waiting for the end of a pass.
    pub(crate) fn is_time_for_all(&self, share_done: f64) -> bool {
        share_done >= ALL_FROM && self.weights.iter().any(|&weight| weight != 1.0)
    }

    /// Updates the selection at the end of a pass. True if it has changed.
    pub(crate) fn advance(&mut self, share_done: f64) -> bool {
        if share_done >= ALL_FROM {
            let changes = self.is_time_for_all(share_done);
            self.weights.fill(1.0);
            self.windows_done = self.windows.len();
            return changes;
        }
        let window = self.windows.get(self.windows_done);
        let is_over = window.is_some_and(|[_, to]| share_done >= *to);
        if is_over {
            let mut recorded = self.recorded.iter();
            if recorded.all(|losses| losses.len() < ENOUGH_PASSES) {
                tracing::warn!(
                    "a window of RSD held fewer than {ENOUGH_PASSES} passes over the data: no sweep is left out after it"
                );
            }
            self.drop_redundant();
            self.windows_done += 1;
            self.recorded.iter_mut().for_each(Vec::clear);
        }
        is_over
    }

    /// Leaves out the sweeps with the lowest variance of their losses in each cluster, or random ones; the weights of the
    /// others grow. A sweep of unknown variance stays, however many that leaves.
    fn drop_redundant(&mut self) {
        let mut order: Vec<f32> = self.recorded.iter().map(|of| variance(of)).collect();
        if self.leave_out == LeaveOut::Random {
            // A random choice has the same chances: among sweeps of known variance.
            let known = order.iter_mut().filter(|variance| **variance < f32::MAX);
            known.for_each(|place| *place = self.rng.random());
        }
        let last = self.class_of_sweep.iter().max();
        let classes = last.map_or(0, |class| class + 1);
        for class in 0..classes {
            let mut members: Vec<usize> = (0..self.weights.len())
                .filter(|&sweep| self.class_of_sweep[sweep] == class && self.weights[sweep] > 0.0)
                .collect();
            // Sweeps of equal variance stay in their order.
            members.sort_by(|&a, &b| order[a].total_cmp(&order[b]));
            let known = members.partition_point(|&sweep| order[sweep] < f32::MAX);
            let dropped = ((members.len() as f64 * DROP) as usize).min(known);
            // What stays weighs more, so that each class keeps its share of the loss.
            let kept = (members.len() - dropped) as f32 / members.len().max(1) as f32;
            for (place, &sweep) in members.iter().enumerate() {
                self.weights[sweep] = match place < dropped {
                    true => 0.0,
                    false => self.weights[sweep] / kept,
                };
            }
        }
    }
}

fn variance(values: &[f32]) -> f32 {
    if values.len() < ENOUGH_PASSES {
        // Its variance is unknown, so it stays.
        return f32::MAX;
    }
    let mean = values.iter().sum::<f32>() / values.len() as f32;
    let squares = values.iter().map(|value| (value - mean).powi(2));
    squares.sum::<f32>() / values.len() as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_most_even_quarter_is_left_out_and_the_others_gain_weight() {
        let mut redundancy = Redundancy::new(LeaveOut::EvenLoss, 0, vec![0; 8]);
        assert!(redundancy.watches(0.2) && !redundancy.watches(0.3));
        for pass in 0..3 {
            let losses: Vec<(usize, f32)> = (0..8)
                .flat_map(|sweep| {
                    [
                        (sweep, (sweep * pass) as f32),
                        (sweep, (sweep * pass) as f32 + 0.1),
                    ]
                })
                .collect();
            redundancy.record(&losses);
        }
        assert!(!redundancy.advance(0.2));
        assert!(redundancy.advance(0.25));
        assert_eq!(redundancy.weights[..2], [0.0, 0.0]);
        assert!(
            redundancy.weights[2..]
                .iter()
                .all(|weight| (weight - 8.0 / 6.0).abs() < 1e-6)
        );
        assert!(redundancy.watches(0.4) && !redundancy.watches(0.2));
        assert!(redundancy.advance(0.9));
        assert_eq!(redundancy.weights, [1.0; 8]);
    }

    /// The sweeps that a random choice leaves out.
    fn left_out(seed: u64) -> Vec<usize> {
        let mut redundancy = Redundancy::new(LeaveOut::Random, seed, vec![0; 8]);
        for _ in 0..2 {
            redundancy.record(&std::array::from_fn::<_, 8, _>(|sweep| {
                (sweep, sweep as f32)
            }));
        }
        assert!(redundancy.advance(0.25));
        (0..8)
            .filter(|&sweep: &usize| redundancy.weights[sweep] == 0.0)
            .collect()
    }

    #[test]
    fn a_random_choice_leaves_out_as_many() {
        let choices: Vec<_> = (0..8).map(left_out).collect();
        assert!(
            choices.iter().all(|choice| choice.len() == 2),
            "{choices:?}"
        );
        assert!(
            choices.iter().any(|choice| *choice != choices[0]),
            "{choices:?}"
        );
    }

    #[test]
    fn sweeps_that_were_never_observed_stay() {
        let mut redundancy = Redundancy::new(LeaveOut::EvenLoss, 0, vec![0, 0, 0, 0, 1]);
        redundancy.record(&[(0, 1.0), (1, 1.0)]);
        redundancy.record(&[(0, 1.0), (1, 2.0)]);
        redundancy.advance(0.25);
        assert_eq!(redundancy.weights[0], 0.0);
        assert!(redundancy.weights[1..].iter().all(|&weight| weight > 0.0));
    }

    #[test]
    fn one_pass_gives_no_variance() {
        let mut redundancy = Redundancy::new(LeaveOut::EvenLoss, 0, vec![0; 8]);
        redundancy.record(&std::array::from_fn::<_, 8, _>(|sweep| {
            (sweep, sweep as f32)
        }));
        redundancy.advance(0.25);
        assert_eq!(redundancy.weights, [1.0; 8]);
        redundancy.advance(0.5);
        assert_eq!(
            redundancy.weights, [1.0; 8],
            "nor does a window that a resumed training has not seen"
        );
    }
}
