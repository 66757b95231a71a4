//! Memory layout of correspondences for fast scoring of many motions.

use nalgebra::{Isometry3, Matrix3, Translation3, Vector3};
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use super::Correspondence;
use super::refine::WeightedPair;

/// Number of pairs that are scored at once; a multiple of the width of vector units.
const LANES: usize = 16;
/// Number of pairs that are scored before a motion may be discarded, in blocks of [`LANES`].
const PREFIX_BLOCKS: usize = 24;

/// One coordinate or weight of all pairs, padded with zeros to whole blocks.
type PairColumn = Vec<[f32; LANES]>;

/// Score of a motion: a truncated quadratic (MSAC) with the sign reversed, so that more is better.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Gain {
    /// Score over the first pairs, those of the highest weights.
    pub prefix: f32,
    /// Score over all pairs.
    pub total: f32,
}

fn column(pairs: &[&Correspondence], value: impl Fn(&Correspondence) -> f32) -> PairColumn {
    // Padding has weight 0 and adds nothing to a score.
    let blocks = (pairs.chunks(LANES))
        .map(|block| std::array::from_fn(|lane| block.get(lane).map_or(0.0, |pair| value(pair))));
    blocks.collect()
}

/// Usable correspondences, highest weights first, column by column.
#[derive(Debug)]
pub(super) struct PairColumns {
    source: [PairColumn; 3],
    target: [PairColumn; 3],
    weight: PairColumn,
    /// Number of pairs, without the padding.
    pub(super) count: usize,
    /// Subtracted from all targets, so that `f32` is precise enough anywhere on earth, metres.
    origin: Vector3<f64>,
}

impl PairColumns {
    /// Stores the usable ones; pairs of equal weight in random order, so that a prefix of them is a fair sample.
    pub(super) fn new(pairs: &[Correspondence], random: &mut ChaCha8Rng) -> Self {
        let mut usable: Vec<&Correspondence> = pairs.iter().filter(|pair| pair.usable()).collect();
        usable.shuffle(random);
        // The sort is stable: the shuffled order stays among equal weights.
        usable.sort_by(|a, b| b.weight.total_cmp(&a.weight));
        let origin = Vector3::from_fn(|axis, _| {
            let values = usable.iter().map(|pair| f64::from(pair.target_m[axis]));
            values.sum::<f64>() / usable.len().max(1) as f64
        });
        Self {
            source: std::array::from_fn(|axis| column(&usable, |pair| pair.source_m[axis])),
            target: std::array::from_fn(|axis| {
                column(&usable, |pair| {
                    (f64::from(pair.target_m[axis]) - origin[axis]) as f32
                })
            }),
            weight: column(&usable, |pair| pair.weight),
            count: usable.len(),
            origin,
        }
    }

    /// Converts a motion of this layout to the frames of the caller.
    pub(super) fn to_target_frame(&self, motion: &Isometry3<f64>) -> Isometry3<f64> {
        Translation3::from(self.origin) * motion
    }

    pub(super) fn source(&self, index: usize) -> Vector3<f64> {
        at(&self.source, index)
    }

    pub(super) fn target(&self, index: usize) -> Vector3<f64> {
        at(&self.target, index)
    }

    /// Source, target and weight of the pairs within `radius_m` of their positions under `motion`.
    pub(super) fn near(&self, motion: &Isometry3<f64>, radius_m: f64) -> Vec<WeightedPair> {
        let model = model_of(motion);
        let limit = (radius_m * radius_m) as f32;
        let mut near = Vec::with_capacity(self.count);
        for block in 0..self.weight.len() {
            let squared = self.squared_residuals(&model, block);
            for (lane, squared) in squared.into_iter().enumerate() {
                let index = block * LANES + lane;
                // Padded pairs may lie near as well: their weight of 0 does not exclude them here.
                if squared < limit && index < self.count {
                    let weight = f64::from(self.weight[block][lane]);
                    near.push((self.source(index), self.target(index), weight));
                }
            }
        }
        near
    }

    /// Score of a motion, or `None` as soon as `best` is clearly better.
    pub(super) fn gain(
        &self,
        motion: &Isometry3<f64>,
        threshold_m: f64,
        best: &Gain,
    ) -> Option<Gain> {
        let model = model_of(motion);
        let scale = (1.0 / (threshold_m * threshold_m)) as f32;
        let blocks = self.weight.len();
        let prefix = self.block_gain(&model, scale, 0..PREFIX_BLOCKS.min(blocks));
        // Over a few hundred pairs, a motion as good as the best practically never scores less than half of it.
        if prefix < 0.5 * best.prefix {
            return None;
        }
        Some(Gain {
            prefix,
            total: prefix + self.block_gain(&model, scale, PREFIX_BLOCKS.min(blocks)..blocks),
        })
    }

    /// Sum of `w max(0, 1 - r^2 / threshold^2)` over some blocks.
    fn block_gain(&self, model: &Model, scale: f32, blocks: std::ops::Range<usize>) -> f32 {
        let mut sums = [0.0_f32; LANES];
        for block in blocks {
            let squared = self.squared_residuals(model, block);
            let weight = &self.weight[block];
            for lane in 0..LANES {
                let gain = 1.0 - squared[lane] * scale;
                // Not `max`, which would have to handle NaN: there is none here, and this is one instruction.
                sums[lane] += weight[lane] * if gain > 0.0 { gain } else { 0.0 };
            }
        }
        sums.iter().sum()
    }

    #[inline]
    fn squared_residuals(&self, (rotation, translation): &Model, block: usize) -> [f32; LANES] {
        let [x, y, z] = self.source.each_ref().map(|column| &column[block]);
        let mut squared = [0.0; LANES];
        for (axis, target) in self.target.iter().enumerate() {
            let [a, b, c] = [0, 1, 2].map(|column| rotation[(axis, column)]);
            let (shift, target) = (translation[axis], &target[block]);
            for lane in 0..LANES {
                let difference = a * x[lane] + b * y[lane] + c * z[lane] + shift - target[lane];
                squared[lane] += difference * difference;
            }
        }
        squared
    }
}

fn at(columns: &[PairColumn; 3], index: usize) -> Vector3<f64> {
    let (block, lane) = (index / LANES, index % LANES);
    Vector3::from_fn(|axis, _| f64::from(columns[axis][block][lane]))
}

/// Rotation and translation of a motion in single precision.
type Model = (Matrix3<f32>, Vector3<f32>);

fn model_of(motion: &Isometry3<f64>) -> Model {
    let rotation = motion.rotation.to_rotation_matrix().into_inner().cast();
    (rotation, motion.translation.vector.cast())
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;
    use crate::registration::test_problem::TestProblem;

    #[test]
    fn the_gain_is_that_of_the_definition() {
        let problem = TestProblem {
            count: 1001,
            outliers: 0.4,
            noise_m: 0.5,
            ..TestProblem::default()
        }
        .drawn(3);
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let pairs = PairColumns::new(&problem.pairs, &mut random);
        assert_eq!(pairs.count, 1001);
        let mut local = problem.truth;
        local.translation.vector -= pairs.origin;
        let gain = pairs.gain(&local, 1.5, &Gain::default()).unwrap();
        let expected: f64 = (problem.pairs.iter())
            .map(|pair| {
                f64::from(pair.weight)
                    * (1.0 - (pair.residual_m(&problem.truth) / 1.5).powi(2)).max(0.0)
            })
            .sum();
        assert!(
            (f64::from(gain.total) / expected - 1.0).abs() < 1e-3,
            "{gain:?} {expected}"
        );
        let inliers = problem
            .pairs
            .iter()
            .filter(|pair| pair.residual_m(&problem.truth) < 1.5)
            .count();
        assert!(pairs.near(&local, 1.5).len().abs_diff(inliers) <= 1);
        assert!(
            pairs
                .gain(&Isometry3::translation(0.0, 0.0, 900.0), 1.5, &gain)
                .is_none()
        );
    }

    #[test]
    fn unusable_pairs_are_ignored() {
        let good = Correspondence {
            source_m: [0.0; 3],
            target_m: [1.0; 3],
            weight: 0.5,
        };
        let bad = [f32::NAN, f32::INFINITY, 1e30].map(|x| Correspondence {
            source_m: [x, 0.0, 0.0],
            ..good
        });
        let heavy =
            [f32::NAN, f32::INFINITY, 0.0, -1.0].map(|weight| Correspondence { weight, ..good });
        let all = [&bad[..], &heavy[..], &[good]].concat();
        let mut random = ChaCha8Rng::seed_from_u64(1);
        assert_eq!(PairColumns::new(&all, &mut random).count, 1);
    }
}
