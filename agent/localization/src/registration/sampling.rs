//! Minimal samples: draws of pairs and the motion that they determine.

use nalgebra::{Isometry3, Matrix3, Rotation3, UnitQuaternion, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::pairs::PairColumns;

/// Shares of the pairs of highest weight that successive draws are taken from. Half of the draws follow the weights,
/// half do not, so that uninformative weights cost a factor of two and no more.
const POOLS: [f64; 4] = [0.1, 1.0, 0.3, 1.0];
/// Fewest pairs in a pool.
const MIN_POOL: usize = 12;

/// Conditions on a sample before a motion is computed from it.
#[derive(Debug, Clone, Copy)]
pub(super) struct SampleTest {
    /// Shortest distance between two points of a sample, metres.
    pub min_edge_m: f64,
    /// Largest difference between an edge's lengths in both frames, metres.
    pub edge_tolerance_m: f64,
    /// Largest slope of the source frame's upright axis, radians.
    pub max_tilt_rad: f64,
}

/// Draws a motion from three pairs, or `None` if they are inconsistent.
pub(super) fn three_points(
    pairs: &PairColumns,
    draw: u32,
    test: &SampleTest,
    random: &mut ChaCha8Rng,
) -> Option<Isometry3<f64>> {
    let [a, b, c] = draw_distinct(pairs.count, draw, random);
    let source = [a, b, c].map(|index| pairs.source(index));
    let target = [a, b, c].map(|index| pairs.target(index));
    // A rigid motion keeps lengths: samples with an outlier are rejected before anything is solved.
    for (from, to) in [(0, 1), (0, 2), (1, 2)] {
        let lengths = [&source, &target].map(|points| (points[to] - points[from]).norm());
        if lengths[0] < test.min_edge_m || (lengths[0] - lengths[1]).abs() > test.edge_tolerance_m {
            return None;
        }
    }
    // Both bases are right-handed and orthonormal: the product is a rotation.
    let rotation = Rotation3::from_matrix_unchecked(axes(&target)? * axes(&source)?.transpose());
    // The entry is the cosine of the angle between both z axes.
    if rotation[(2, 2)] < test.max_tilt_rad.cos() {
        return None;
    }
    Some(motion(rotation, &source, &target))
}

/// Draws a motion about the vertical from two pairs, or `None` if they are inconsistent.
pub(super) fn two_points(
    pairs: &PairColumns,
    draw: u32,
    test: &SampleTest,
    random: &mut ChaCha8Rng,
) -> Option<Isometry3<f64>> {
    let [a, b] = draw_distinct(pairs.count, draw, random);
    let source = [a, b].map(|index| pairs.source(index));
    let target = [a, b].map(|index| pairs.target(index));
    let [from, to] = [source[1] - source[0], target[1] - target[0]];
    // In the plane: a rotation about the vertical keeps horizontal lengths. Heights are compared below.
    let lengths = [from.xy().norm(), to.xy().norm()];
    if lengths[0] < test.min_edge_m || (lengths[0] - lengths[1]).abs() > test.edge_tolerance_m {
        return None;
    }
    // A small tilt lifts the far end.
    if (from.z - to.z).abs() > test.edge_tolerance_m + test.max_tilt_rad.sin() * lengths[0] {
        return None;
    }
    let yaw_rad = to.y.atan2(to.x) - from.y.atan2(from.x);
    let rotation = Rotation3::from_axis_angle(&Vector3::z_axis(), yaw_rad);
    Some(motion(rotation, &source, &target))
}

/// The motion with this rotation that maps one centre to the other.
fn motion<const N: usize>(
    rotation: Rotation3<f64>,
    source: &[Vector3<f64>; N],
    target: &[Vector3<f64>; N],
) -> Isometry3<f64> {
    let [from, to] = [source, target].map(|points| points.iter().sum::<Vector3<f64>>() / N as f64);
    let turn = UnitQuaternion::from_rotation_matrix(&rotation);
    Isometry3::from_parts((to - rotation * from).into(), turn)
}

/// Right-handed axes of a triangle, as columns; `None` for a degenerate one.
fn axes(points: &[Vector3<f64>; 3]) -> Option<Matrix3<f64>> {
    let first = (points[1] - points[0]).try_normalize(1e-9)?;
    let second = points[2] - points[0];
    let normal = first.cross(&second);
    // Below a sine of 0.1 the direction of the normal is mostly noise.
    if normal.norm_squared() < 0.01 * second.norm_squared() {
        return None;
    }
    let normal = normal.try_normalize(1e-9)?;
    let second = normal.cross(&first);
    Some(Matrix3::from_columns(&[first, second, normal]))
}

/// `N` distinct indices below `count`; the caller ensures that there are at least `N`.
fn draw_distinct<const N: usize>(count: usize, draw: u32, random: &mut ChaCha8Rng) -> [usize; N] {
    let share = POOLS[draw as usize % POOLS.len()];
    let pool = ((count as f64 * share) as usize).clamp(MIN_POOL.min(count), count);
    let mut chosen = [usize::MAX; N];
    for place in 0..N {
        chosen[place] = loop {
            let index = random.random_range(0..pool);
            if !chosen[..place].contains(&index) {
                break index;
            }
        };
    }
    chosen
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;
    use crate::registration::test_problem::TestProblem;

    #[test]
    fn clean_samples_fix_the_motion() {
        let problem = TestProblem {
            tilt_rad: 0.0,
            ..TestProblem::default()
        }
        .drawn(7);
        let mut random = ChaCha8Rng::seed_from_u64(2);
        let pairs = PairColumns::new(&problem.pairs, &mut random);
        let test = SampleTest {
            min_edge_m: 6.0,
            edge_tolerance_m: 0.1,
            max_tilt_rad: 0.2,
        };
        for solver in [two_points, three_points] {
            let found: Vec<_> = (0..40)
                .filter_map(|draw| solver(&pairs, draw, &test, &mut random))
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
    }

    #[test]
    fn indices_differ_even_in_the_smallest_set() {
        let mut random = ChaCha8Rng::seed_from_u64(2);
        for draw in 0..100 {
            let [a, b, c] = draw_distinct(3, draw, &mut random);
            assert!(a < 3 && b < 3 && c < 3 && a != b && b != c && a != c);
        }
    }
}
