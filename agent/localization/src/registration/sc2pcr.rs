//! SC2-PCR: registration by second-order spatial compatibility (Chen et al., CVPR 2022).
//!
//! Two correspondences are compatible when they keep their distance; their score is the number of others that both are
//! compatible with. The steps and their order follow the published implementation: leading eigenvector, seeds,
//! consensus sets in two stages, one weighted fit per seed, the fit with most inliers, refinement. Equal scores keep
//! the order of their correspondences; the published one leaves that order to an unstable sort.

use std::cmp::Ordering;

use nalgebra::{Isometry3, Vector3};

use super::compatibility::{Bits, distances, leading_eigenvectors};
use super::kabsch::PairMoments;
use super::{Correspondence, NoRegistration, Registration, check_enough};

/// Added to sums of weights before dividing by them, as in the published implementation.
const WEIGHT_EPSILON: f64 = 1e-6;
/// Size of both consensus sets when there are fewer correspondences than the first one should hold.
const SMALL_SET: usize = 4;
/// Largest number of fits of the refinement; it ends as soon as the number of inliers stays the same.
const REFINEMENT_ROUNDS: usize = 20;

/// Settings; the names in brackets are those of the published implementation.
#[derive(Debug, Clone, PartialEq)]
pub struct Sc2PcrConfig {
    /// Largest residual of an inlier, metres (`inlier_threshold`).
    pub inlier_threshold_m: f64,
    /// Largest change of a distance between compatible correspondences, metres (`d_thre`).
    pub distance_threshold_m: f64,
    /// Largest number of power iterations (`num_iterations`).
    pub power_iterations: usize,
    /// Share of the correspondences that become seeds (`ratio`).
    pub seed_ratio: f64,
    /// Distance within which only the strongest becomes a seed, metres (`nms_radius`).
    pub seed_radius_m: f64,
    /// Largest number that is used, those of the highest weights (`max_points`): time and memory grow with the square.
    pub max_correspondences: usize,
    /// Size of a seed's first consensus set (`k1`).
    pub first_set: usize,
    /// Size of its second one (`k2`).
    pub second_set: usize,
    /// Largest residual of an inlier of the refinement, repeated weighted fits to the inliers; metres.
    pub refinement_threshold_m: f64,
    /// Fewest inliers of a result.
    pub min_inliers: usize,
}

impl Sc2PcrConfig {
    /// The same for correspondences with `factor` times the error.
    pub fn wider(&self, factor: f64) -> Self {
        Self {
            inlier_threshold_m: factor * self.inlier_threshold_m,
            distance_threshold_m: factor * self.distance_threshold_m,
            refinement_threshold_m: factor * self.refinement_threshold_m,
            ..self.clone()
        }
    }
}

impl Default for Sc2PcrConfig {
    /// For scene coordinates with errors of a metre or two.
    fn default() -> Self {
        Self {
            inlier_threshold_m: 1.5,
            distance_threshold_m: 1.5,
            power_iterations: 10,
            seed_ratio: 0.1,
            seed_radius_m: 0.1,
            max_correspondences: 1000,
            first_set: 40,
            second_set: 20,
            refinement_threshold_m: 1.5,
            min_inliers: 12,
        }
    }
}

/// Results of the steps before any refinement.
#[derive(Debug, Clone, PartialEq)]
pub struct Consensus {
    /// Leading eigenvector of the first-order compatibility, one entry per correspondence.
    pub confidence: Vec<f32>,
    /// The seeds, strongest first.
    pub seeds: Vec<usize>,
    /// The best seed's fit.
    pub target_from_source: Isometry3<f64>,
    /// Correspondences within the threshold of it.
    pub inlier_count: usize,
}

/// Finds the motion among outliers; deterministic. Only the correspondences of the highest weights enter the search,
/// all of them the count of inliers.
///
/// # Errors
/// [`NoRegistration`] when there are too few correspondences or too few inliers.
pub fn solve(
    correspondences: &[Correspondence],
    config: &Sc2PcrConfig,
) -> Result<Registration, NoRegistration> {
    let required = config.min_inliers.max(SMALL_SET);
    check_enough(correspondences, required)?;
    let usable = correspondences.iter().copied();
    let mut trusted: Vec<_> = usable.filter(Correspondence::usable).collect();
    trusted.sort_by(|a, b| b.weight.total_cmp(&a.weight));
    trusted.truncate(config.max_correspondences.max(required));
    let found = consensus(&trusted, config)?;
    let start = &found.target_from_source;
    let motion = refine(&trusted, start, config.refinement_threshold_m);
    Registration::judge(correspondences, motion, config.inlier_threshold_m)
        .with_at_least(required, correspondences.len())
}

/// The steps up to the best seed, on the first [`Sc2PcrConfig::max_correspondences`] correspondences in their order;
/// their weights are ignored.
///
/// # Errors
/// [`NoRegistration`] when there are fewer than four correspondences or no seed constrains a motion.
pub fn consensus(
    correspondences: &[Correspondence],
    config: &Sc2PcrConfig,
) -> Result<Consensus, NoRegistration> {
    check_enough(correspondences, SMALL_SET)?;
    let first = correspondences.iter().take(config.max_correspondences);
    let (source, target) = first
        .filter(|pair| pair.usable())
        .map(|pair| (pair.source_m, pair.target_m))
        .unzip();
    let points = PairPoints { source, target };
    let count = points.source.len();
    let threshold = config.distance_threshold_m as f32;
    let source_distances = distances(&points.source);
    let changes = changes(&source_distances, &distances(&points.target));

    // Step: first-order compatibility, its leading eigenvector as confidence, and the seeds.
    let first_order: Vec<f32> = (changes.iter().map(|&change| soft(change, threshold))).collect();
    let confidence = leading_eigenvectors(&first_order, count, config.power_iterations);
    let seeds = pick_seeds(&source_distances, &confidence, config);

    // Step: second order. Common neighbours count at half the threshold, the pair itself at the full one.
    let tight = Bits::where_true(&changes, count, |change| change < threshold / 2.0);
    let sets: Vec<Vec<usize>> = (seeds.iter())
        .map(|&seed| {
            let row = &changes[seed * count..(seed + 1) * count];
            let scores = (0..count).map(|other| match row[other] < threshold {
                true => tight.common(seed, other),
                false => 0,
            });
            points.consensus_set(&scores.collect::<Vec<u32>>(), config)
        })
        .collect();
    // Step: one fit per seed. Without a seed, in tiny sets, there is none.
    let Some((target_from_source, inlier_count)) = points.best_fit(&sets, config) else {
        let given = correspondences.len();
        return Err(NoRegistration::TooFewInliers(0, given, SMALL_SET));
    };
    Ok(Consensus {
        confidence,
        seeds,
        target_from_source,
        inlier_count,
    })
}

/// Re-fits to the inliers, weighted by `1 / (1 + (r/threshold)^2)`, until their number stays the same.
pub fn refine(
    pairs: &[Correspondence],
    start: &Isometry3<f64>,
    threshold_m: f64,
) -> Isometry3<f64> {
    let (mut motion, mut previous) = (*start, 0);
    for _ in 0..REFINEMENT_ROUNDS {
        let mut moments = PairMoments::default();
        let mut inliers = 0;
        for pair in pairs.iter().filter(|pair| pair.usable()) {
            let residual_m = pair.residual_m(&motion);
            if residual_m < threshold_m {
                inliers += 1;
                let weight = 1.0 / (1.0 + (residual_m / threshold_m).powi(2));
                moments.add(&vector(&pair.source_m), &vector(&pair.target_m), weight);
            }
        }
        if inliers == previous {
            break;
        }
        previous = inliers;
        match moments.fit_biased(WEIGHT_EPSILON) {
            Ok(fit) => motion = fit,
            Err(_) => break,
        }
    }
    motion
}

/// Absolute differences of two sets of distances.
fn changes(source: &[f32], target: &[f32]) -> Vec<f32> {
    let pairs = source.iter().zip(target);
    pairs.map(|(a, b)| (a - b).abs()).collect()
}

/// Compatibility between 0 and 1 of two correspondences whose distance changes by this much.
fn soft(change: f32, threshold: f32) -> f32 {
    (1.0 - change * change / (threshold * threshold)).max(0.0)
}

/// Local maxima of the confidence, strongest first; equal ones, and all that are no maxima, in their order.
fn pick_seeds(source_distances: &[f32], confidence: &[f32], config: &Sc2PcrConfig) -> Vec<usize> {
    let count = confidence.len();
    let radius = config.seed_radius_m as f32;
    let strengths = (0..count).map(|index| {
        let row = &source_distances[index * count..(index + 1) * count];
        let is_maximum = (row.iter().zip(confidence))
            .all(|(&far, &other)| far >= radius || confidence[index] >= other);
        if is_maximum { confidence[index] } else { 0.0 }
    });
    let strengths: Vec<f32> = strengths.collect();
    let mut order = descending(&strengths);
    // Rounded down: fewer than 1 / ratio correspondences have no seed.
    order.truncate((count as f64 * config.seed_ratio) as usize);
    order
}

/// Indices in descending order of value; equal values keep their order.
fn descending<T: PartialOrd>(values: &[T]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|&a, &b| values[b].partial_cmp(&values[a]).unwrap_or(Ordering::Equal));
    order
}

fn vector(point: &[f32; 3]) -> Vector3<f64> {
    Vector3::from(point.map(f64::from))
}

/// The correspondences that are used.
struct PairPoints {
    source: Vec<[f32; 3]>,
    target: Vec<[f32; 3]>,
}

impl PairPoints {
    /// The correspondences that support a seed, the seed's strongest first: the best of the second-order compatibility
    /// `scores`, and of these the most compatible with the first.
    fn consensus_set(&self, scores: &[u32], config: &Sc2PcrConfig) -> Vec<usize> {
        let (first, second) = match config.first_set > scores.len() {
            true => (SMALL_SET, SMALL_SET),
            false => (config.first_set, config.second_set.min(config.first_set)),
        };
        let mut set = descending(scores);
        set.truncate(first);
        let threshold = config.distance_threshold_m as f32;
        let changes = self.changes_within(&set);
        let size = set.len();
        let compatible = Bits::where_true(&changes, size, |change| change < threshold);
        let local: Vec<u32> = (0..size).map(|other| compatible.common(0, other)).collect();
        let strongest = descending(&local).into_iter().take(second);
        strongest.map(|place| set[place]).collect()
    }

    /// The fit with most inliers, and their number; the first of equal ones.
    fn best_fit(
        &self,
        sets: &[Vec<usize>],
        config: &Sc2PcrConfig,
    ) -> Option<(Isometry3<f64>, usize)> {
        let size = sets.first()?.len();
        let matrices = sets
            .iter()
            .flat_map(|set| self.soft_compatibility(set, config));
        let matrices: Vec<f32> = matrices.collect();
        let weights = leading_eigenvectors(&matrices, size, config.power_iterations);
        let mut best: Option<(Isometry3<f64>, usize)> = None;
        for (set, weights) in sets.iter().zip(weights.chunks(size)) {
            let total = weights.iter().sum::<f32>() + WEIGHT_EPSILON as f32;
            let mut moments = PairMoments::default();
            for (&index, weight) in set.iter().zip(weights) {
                let (source, target) = (vector(&self.source[index]), vector(&self.target[index]));
                moments.add(&source, &target, f64::from(weight / total));
            }
            let Ok(fit) = moments.fit_biased(WEIGHT_EPSILON) else {
                continue;
            };
            let inliers = self.inliers(&fit, config.inlier_threshold_m);
            if best.is_none_or(|(_, most)| inliers > most) {
                best = Some((fit, inliers));
            }
        }
        best
    }

    /// The soft first-order compatibility of a consensus set, without a correspondence's own.
    ///
    /// The paper weights by the second order here; the published implementation computes that and then leaves it out.
    fn soft_compatibility(&self, set: &[usize], config: &Sc2PcrConfig) -> Vec<f32> {
        let threshold = config.distance_threshold_m as f32;
        let changes = self.changes_within(set).into_iter();
        let mut compatibility: Vec<f32> = changes.map(|change| soft(change, threshold)).collect();
        for own in compatibility.iter_mut().step_by(set.len() + 1) {
            *own = 0.0;
        }
        compatibility
    }

    fn changes_within(&self, set: &[usize]) -> Vec<f32> {
        let [source, target] = [&self.source, &self.target]
            .map(|points| distances(&set.iter().map(|&index| points[index]).collect::<Vec<_>>()));
        changes(&source, &target)
    }

    fn inliers(&self, motion: &Isometry3<f64>, threshold_m: f64) -> usize {
        let rotation = motion.rotation.to_rotation_matrix();
        let near = self
            .source
            .iter()
            .zip(&self.target)
            .filter(|(source, target)| {
                let moved = rotation * vector(source) + motion.translation.vector;
                (moved - vector(target)).norm() < threshold_m
            });
        near.count()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::registration::test_problem::TestProblem;

    #[test]
    fn motions_are_found_among_outliers() {
        for seed in 0..8 {
            let problem = TestProblem {
                count: 500,
                outliers: 0.7,
                noise_m: 0.1,
                ..TestProblem::default()
            }
            .drawn(seed);
            let found = solve(&problem.pairs, &Sc2PcrConfig::default()).unwrap();
            let (metres, degrees) = problem.error(&found.target_from_source);
            assert!(
                metres < 0.15 && degrees < 0.15,
                "seed {seed}: {metres} m {degrees} degrees"
            );
        }
    }

    #[test]
    fn few_correspondences_use_small_sets() {
        let problem = TestProblem {
            count: 20,
            outliers: 0.2,
            noise_m: 0.02,
            ..TestProblem::default()
        }
        .drawn(3);
        let config = Sc2PcrConfig {
            seed_ratio: 0.3,
            min_inliers: 6,
            ..Sc2PcrConfig::default()
        };
        let (metres, _) =
            problem.error(&solve(&problem.pairs, &config).unwrap().target_from_source);
        assert!(metres < 0.2, "{metres} m");
    }

    #[test]
    fn thin_evidence_is_no_pose() {
        let config = Sc2PcrConfig::default();
        assert!(matches!(
            solve(&[], &config),
            Err(NoRegistration::TooFewCorrespondences(_, 0, _))
        ));
        let nonsense = TestProblem {
            count: 60,
            outliers: 1.0,
            ..TestProblem::default()
        }
        .drawn(6);
        assert!(matches!(
            solve(&nonsense.pairs, &config),
            Err(NoRegistration::TooFewInliers(..))
        ));
        let mut unusable = nonsense.pairs;
        unusable.iter_mut().for_each(|pair| pair.weight = f32::NAN);
        assert!(matches!(
            solve(&unusable, &config),
            Err(NoRegistration::TooFewCorrespondences(0, ..))
        ));
        let pair = Correspondence {
            source_m: [1.0; 3],
            target_m: [2.0; 3],
            weight: 1.0,
        };
        assert!(solve(&[pair; 30], &config).is_err());
    }

    #[test]
    fn equal_values_keep_their_order() {
        assert_eq!(descending(&[1, 3, 2, 3, 1]), [1, 3, 2, 0, 4]);
    }
}
