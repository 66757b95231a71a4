//! Random sample consensus with local optimisation (Fischler and Bolles 1981; Chum, Matas and Kittler 2003).
//!
//! Minimal samples are drawn mostly from correspondences of high weight and tested for consistent edges before anything
//! is solved; motions are scored by a truncated quadratic (MSAC) with early termination, and every new best is
//! optimised locally. Drawing ends as soon as a better motion would have been drawn with the required confidence. Same
//! input and seed, same result.

use nalgebra::{Isometry3, Rotation3, UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::pairs::{Gain, PairColumns};
use super::{Correspondence, NoRegistration, Registration, check_enough, refine};

/// Scales of the local optimisation, in thresholds: wide enough for a motion from few noisy points.
const LOCAL_SCALES: [f64; 3] = [2.0, 1.2, 0.8];
/// Largest number of steps of the final refinement.
const FINAL_STEPS: usize = 20;
/// Share of all-inlier samples that are assumed to give the motion: half of the draws ignore the weights, and samples
/// may be too close together or too noisy.
const SAMPLE_YIELD: f64 = 0.25;

/// Shares of the pairs of highest weight that successive draws are taken from. Half of the draws follow the weights,
/// half do not, so that uninformative weights cost a factor of two and no more.
const POOLS: [f64; 4] = [0.1, 1.0, 0.3, 1.0];
/// Fewest pairs in a pool.
const MIN_POOL: usize = 12;

/// Settings of the search. A sample of two points gives heading and position of an upright vehicle; its tilt is
/// estimated afterwards.
#[derive(Debug, Clone, PartialEq)]
pub struct RansacConfig {
    /// Largest residual of an inlier, metres.
    pub inlier_threshold_m: f64,
    /// Largest angle between both frames' upright axes, degrees; 180 allows everything.
    pub max_tilt_deg: f64,
    /// Shortest edge of a sample, metres.
    pub min_edge_m: f64,
    /// Fewest inliers of a result.
    pub min_inliers: usize,
    /// Probability with which the best motion is found before drawing stops, 0..1.
    pub confidence: f64,
    /// Smallest number of draws.
    pub min_draws: u32,
    /// Largest number of draws.
    pub max_draws: u32,
    /// Scale of the final refinement, metres: about the residual of good inliers.
    pub refine_scale_m: f64,
    /// Seed of the draws.
    pub seed: u64,
}

impl Default for RansacConfig {
    /// For the sweeps of vehicles and scene coordinates with errors of a metre or two.
    fn default() -> Self {
        Self {
            inlier_threshold_m: 1.5,
            max_tilt_deg: 12.0,
            min_edge_m: 6.0,
            min_inliers: 12,
            confidence: 0.999,
            min_draws: 64,
            max_draws: 20_000,
            refine_scale_m: 1.0,
            seed: 0,
        }
    }
}

impl RansacConfig {
    /// The same for correspondences with `factor` times the error.
    pub fn wider(&self, factor: f64) -> Self {
        Self {
            inlier_threshold_m: factor * self.inlier_threshold_m,
            min_edge_m: factor * self.min_edge_m,
            refine_scale_m: factor * self.refine_scale_m,
            ..self.clone()
        }
    }

    fn allows_tilt_of(&self, motion: &Isometry3<f64>) -> bool {
        let up = motion.rotation * Vector3::z();
        up.z >= self.max_tilt_deg.to_radians().cos()
    }

    /// Number of draws after which a motion with `inliers` of `count` would have been found.
    fn draws_needed(&self, inliers: usize, count: usize) -> u32 {
        let ratio = inliers as f64 / count.max(1) as f64;
        // n = ln(1 - confidence) / ln(1 - hit). The clamps keep both logarithms finite and other than 0.
        let hit = (SAMPLE_YIELD * ratio.powi(2)).clamp(1e-12, 1.0 - 1e-12);
        let draws = (1.0 - self.confidence).max(1e-12).ln() / (1.0 - hit).ln();
        (draws.ceil().min(f64::from(self.max_draws)) as u32).max(self.min_draws)
    }
}

/// Finds the motion with the most inliers.
///
/// # Errors
/// [`NoRegistration`] when there are too few correspondences or too few inliers.
pub fn solve(
    correspondences: &[Correspondence],
    config: &RansacConfig,
) -> Result<Registration, NoRegistration> {
    let required = config.min_inliers.max(3);
    check_enough(correspondences, required)?;
    let mut random = ChaCha8Rng::seed_from_u64(config.seed);
    let pairs = PairColumns::new(correspondences, &mut random);
    let search = RansacSearch {
        pairs: &pairs,
        config,
        best: None,
    };
    let best = search.run(&mut random);
    let scale_m = config.refine_scale_m;
    let near = best.map(|best| pairs.near(&best, refine::CUTOFF_SCALES * scale_m));
    let near = near.unwrap_or_default();
    let Some(best) = best.filter(|_| near.len() >= required) else {
        let given = correspondences.len();
        return Err(NoRegistration::TooFewInliers(near.len(), given, required));
    };
    let refined = refine::converge(&near, &best, scale_m, FINAL_STEPS);
    let refined = refined.map_err(|reason| NoRegistration::Degenerate(near.len(), reason))?;
    // The fit has six degrees of freedom and may tilt beyond the limit.
    let motion = match config.allows_tilt_of(&refined) {
        true => refined,
        false => best,
    };
    let motion = pairs.to_target_frame(&motion);
    // Inliers are counted on the given pairs: their indices are those of the caller, not of the sorted ones.
    Registration::judge(correspondences, motion, config.inlier_threshold_m)
        .with_at_least(required, correspondences.len())
}

/// The draws and the best motion so far.
struct RansacSearch<'a> {
    pairs: &'a PairColumns,
    config: &'a RansacConfig,
    best: Option<(Gain, Isometry3<f64>)>,
}

impl RansacSearch<'_> {
    fn run(mut self, random: &mut ChaCha8Rng) -> Option<Isometry3<f64>> {
        // The best score of a motion as drawn, before any optimisation: the next draw has to exceed it.
        let mut best_drawn = Gain::default();
        let mut enough = self.config.max_draws;
        let mut draw = 0;
        while draw < enough {
            let drawn = two_points(self.pairs, draw, self.config, random);
            // Inconsistent samples count as draws too: a hopeless sweep would be searched forever otherwise.
            draw += 1;
            let Some(motion) = drawn else { continue };
            let Some(gain) = self.gain(&motion, &best_drawn) else {
                continue;
            };
            if gain.total > best_drawn.total {
                best_drawn = gain;
                if self.optimise(&motion, gain) {
                    enough = self.config.draws_needed(self.inliers(), self.pairs.count);
                }
            }
        }
        self.best.map(|(_, motion)| motion)
    }

    fn gain(&self, motion: &Isometry3<f64>, best: &Gain) -> Option<Gain> {
        let threshold_m = self.config.inlier_threshold_m;
        self.pairs.gain(motion, threshold_m, best)
    }

    /// Optimises a motion on the pairs near it; true if it became the new best.
    fn optimise(&mut self, motion: &Isometry3<f64>, gain: Gain) -> bool {
        let scales = LOCAL_SCALES.map(|scale| scale * self.config.inlier_threshold_m);
        let near = self.pairs.near(motion, refine::CUTOFF_SCALES * scales[0]);
        let optimised = (refine::reweighted(&near, motion, scales).ok())
            .filter(|optimised| self.config.allows_tilt_of(optimised))
            .and_then(|optimised| Some((self.gain(&optimised, &gain)?, optimised)))
            .filter(|(optimised, _)| optimised.total > gain.total);
        let candidate = optimised.unwrap_or((gain, *motion));
        let better = self
            .best
            .as_ref()
            .is_none_or(|(best, _)| candidate.0.total > best.total);
        if better {
            self.best = Some(candidate);
        }
        better
    }

    fn inliers(&self) -> usize {
        let threshold_m = self.config.inlier_threshold_m;
        let near = self
            .best
            .map(|(_, motion)| self.pairs.near(&motion, threshold_m));
        near.unwrap_or_default().len()
    }
}

/// Draws a motion about the vertical from two pairs, or `None` if they are inconsistent.
fn two_points(
    pairs: &PairColumns,
    draw: u32,
    config: &RansacConfig,
    random: &mut ChaCha8Rng,
) -> Option<Isometry3<f64>> {
    let [a, b] = draw_distinct(pairs.count, draw, random);
    let source = [a, b].map(|index| pairs.source(index));
    let target = [a, b].map(|index| pairs.target(index));
    let [from, to] = [source[1] - source[0], target[1] - target[0]];
    // In the plane: a rotation about the vertical keeps horizontal lengths. Heights are compared below.
    let lengths = [from.xy().norm(), to.xy().norm()];
    // Both ends of an edge may have an error of a threshold.
    let edge_tolerance_m = 2.0 * config.inlier_threshold_m;
    if lengths[0] < config.min_edge_m || (lengths[0] - lengths[1]).abs() > edge_tolerance_m {
        return None;
    }
    // A small tilt lifts the far end.
    let lift_m = config.max_tilt_deg.to_radians().sin() * lengths[0];
    if (from.z - to.z).abs() > edge_tolerance_m + lift_m {
        return None;
    }
    let yaw_rad = to.y.atan2(to.x) - from.y.atan2(from.x);
    let rotation = Rotation3::from_axis_angle(&Vector3::z_axis(), yaw_rad);
    // It maps the centre of the source points to that of the target points.
    let [from, to] = [source, target].map(|points| points.iter().sum::<Vector3<f64>>() / 2.0);
    let turn = UnitQuaternion::from_rotation_matrix(&rotation);
    Some(Isometry3::from_parts((to - rotation * from).into(), turn))
}

/// Two distinct indices below `count`; the caller ensures that there are as many.
fn draw_distinct(count: usize, draw: u32, random: &mut ChaCha8Rng) -> [usize; 2] {
    let share = POOLS[draw as usize % POOLS.len()];
    let pool = ((count as f64 * share) as usize).clamp(MIN_POOL.min(count), count);
    let first = random.random_range(0..pool);
    loop {
        let second = random.random_range(0..pool);
        if second != first {
            return [first, second];
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Translation3;
    use proptest::prelude::*;

    use super::*;
    use crate::registration::test_problem::TestProblem;

    proptest! {
        #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]
        #[test]
        fn motions_are_found_among_outliers(seed in 0_u64..1000, outliers in 0.0..0.85) {
            let problem = TestProblem { count: 600, outliers, noise_m: 0.1, ..TestProblem::default() }.drawn(seed);
            let found = solve(&problem.pairs, &RansacConfig::default()).unwrap();
            let (metres, degrees) = problem.error(&found.target_from_source);
            prop_assert!(metres < 0.15 && degrees < 0.15, "{metres} m {degrees} degrees");
            prop_assert!(found.inlier_ratio > 0.95 * (1.0 - outliers) - 0.08);
        }

        #[test]
        fn any_numbers_give_a_motion_or_a_reason(
            numbers in prop::collection::vec(prop::array::uniform7(prop::num::f32::ANY), 0..40), seed in any::<u64>(),
        ) {
            let pairs: Vec<_> = numbers.iter()
                .map(|n| Correspondence { source_m: [n[0], n[1], n[2]], target_m: [n[3], n[4], n[5]], weight: n[6] })
                .collect();
            let config = RansacConfig { seed, max_draws: 200, min_inliers: 3, ..RansacConfig::default() };
            if let Ok(found) = solve(&pairs, &config) {
                prop_assert!(found.target_from_source.translation.vector.iter().all(|x| x.is_finite()));
            }
        }
    }

    #[test]
    fn a_tilt_beyond_the_limit_is_not_found() {
        let problem = TestProblem {
            count: 500,
            outliers: 0.5,
            noise_m: 0.05,
            tilt_rad: 1.5,
            ..TestProblem::default()
        }
        .drawn(11);
        let tilted =
            solve(&problem.pairs, &RansacConfig::default()).map(|found| found.inlier_ratio);
        assert!(
            tilted.as_ref().map_or(true, |&ratio| ratio < 0.1),
            "{tilted:?}"
        );
    }

    #[test]
    fn eight_in_a_hundred_suffice() {
        for seed in 0..20 {
            let problem = TestProblem {
                count: 1500,
                outliers: 0.92,
                noise_m: 0.5,
                ..TestProblem::default()
            }
            .drawn(seed);
            let found = solve(&problem.pairs, &RansacConfig::default()).unwrap();
            let (metres, degrees) = problem.error(&found.target_from_source);
            assert!(
                metres < 0.6 && degrees < 0.6,
                "seed {seed}: {metres} m {degrees} degrees"
            );
        }
    }

    #[test]
    fn the_same_seed_gives_the_same_bits() {
        let problem = TestProblem {
            count: 900,
            outliers: 0.7,
            noise_m: 0.5,
            ..TestProblem::default()
        }
        .drawn(4);
        let config = RansacConfig {
            seed: 9,
            ..RansacConfig::default()
        };
        assert_eq!(
            solve(&problem.pairs, &config),
            solve(&problem.pairs, &config)
        );
    }

    #[test]
    fn positions_far_from_the_origin_keep_precision() {
        let mut problem = TestProblem {
            count: 400,
            noise_m: 0.02,
            ..TestProblem::default()
        }
        .drawn(5);
        let far = nalgebra::Vector3::new(16384.0, -8192.0, 128.0);
        problem.truth.translation.vector += far;
        for pair in &mut problem.pairs {
            (0..3).for_each(|axis| pair.target_m[axis] += far[axis] as f32);
        }
        let found = solve(&problem.pairs, &RansacConfig::default()).unwrap();
        assert!(problem.error(&found.target_from_source).0 < 0.01);
    }

    #[test]
    fn thin_evidence_is_no_pose() {
        let config = RansacConfig::default();
        let none = solve(&[], &config).unwrap_err();
        assert_eq!(none, NoRegistration::TooFewCorrespondences(0, 0, 12));
        let nonsense = TestProblem {
            count: 200,
            outliers: 1.0,
            ..TestProblem::default()
        }
        .drawn(6);
        let few = solve(&nonsense.pairs, &config).unwrap_err();
        assert!(
            matches!(few, NoRegistration::TooFewInliers(0..12, 200, 12)),
            "{few}"
        );
        // All at one position: any motion is unconstrained.
        let pair = Correspondence {
            source_m: [1.0; 3],
            target_m: [2.0; 3],
            weight: 1.0,
        };
        assert!(solve(&[pair; 40], &config).is_err());
        // On a line: the rotation about it is unconstrained.
        let line: Vec<_> = (0..40)
            .map(|k| Correspondence {
                source_m: [k as f32 * 2.0, 0.0, 0.0],
                ..pair
            })
            .collect();
        let line: Vec<_> = line
            .iter()
            .map(|p| Correspondence {
                target_m: p.source_m,
                ..*p
            })
            .collect();
        assert!(matches!(
            solve(&line, &config),
            Err(NoRegistration::Degenerate(..))
        ));
    }

    #[test]
    fn a_mirrored_sweep_is_not_registered_as_a_whole() {
        let mut problem = TestProblem {
            count: 400,
            ..TestProblem::default()
        }
        .drawn(8);
        problem
            .pairs
            .iter_mut()
            .for_each(|pair| pair.source_m[1] = -pair.source_m[1]);
        let found = solve(&problem.pairs, &RansacConfig::default());
        assert!(
            found
                .as_ref()
                .map_or(true, |found| found.inlier_ratio < 0.2),
            "{found:?}"
        );
    }

    #[test]
    fn upside_down_is_no_vehicle() {
        let flip = UnitQuaternion::from_euler_angles(std::f64::consts::PI, 0.0, 0.0);
        let motion = Isometry3::from_parts(Translation3::new(5.0, 6.0, 7.0), flip);
        let problem = TestProblem {
            count: 200,
            ..TestProblem::default()
        }
        .drawn(9);
        let pairs: Vec<_> = (problem.pairs.iter())
            .map(|pair| {
                let target = motion * nalgebra::Point3::from(pair.source_m.map(f64::from));
                Correspondence {
                    target_m: target.coords.map(|x| x as f32).into(),
                    ..*pair
                }
            })
            .collect();
        let config = RansacConfig::default();
        assert!(solve(&pairs, &config).map_or(true, |found| found.inlier_ratio < 0.2));
    }

    #[test]
    fn clean_samples_fix_the_motion() {
        let problem = TestProblem {
            tilt_rad: 0.0,
            ..TestProblem::default()
        }
        .drawn(7);
        let mut random = ChaCha8Rng::seed_from_u64(2);
        let pairs = PairColumns::new(&problem.pairs, &mut random);
        let config = RansacConfig {
            inlier_threshold_m: 0.05,
            ..RansacConfig::default()
        };
        let found: Vec<_> = (0..40)
            .filter_map(|draw| two_points(&pairs, draw, &config, &mut random))
            .collect();
        assert!(found.len() > 10);
        for motion in found {
            let (metres, degrees) = problem.error(&pairs.to_target_frame(&motion));
            assert!(
                metres < 0.05 && degrees < 0.05,
                "{metres} m {degrees} degrees"
            );
        }
    }

    #[test]
    fn indices_differ_even_in_the_smallest_set() {
        let mut random = ChaCha8Rng::seed_from_u64(2);
        for draw in 0..100 {
            let [a, b] = draw_distinct(2, draw, &mut random);
            assert!(a < 2 && b < 2 && a != b);
        }
    }
}
