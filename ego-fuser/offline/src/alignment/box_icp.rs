//! ICP on box centres, in the plane: the row "ICP" of the paper's table.

use nalgebra::{Isometry3, Vector3};
use protocol::Box3d;

use super::free_align::NoAlignment;
use fusion::planar_fit;

/// Fewest boxes of each vehicle.
const MIN_BOXES: usize = 3;
/// Largest number of iterations.
const MAX_ROUNDS: usize = 100;
/// Iterations end when no centre moves farther, metres.
const CONVERGED_M: f64 = 1e-4;

/// Moves the neighbour's boxes onto the nearest of the ego's until convergence, beginning at `start`. Without outlier
/// rejection or quality check: the last iterate is the result.
///
/// # Errors
/// [`NoAlignment::TooFewBoxes`].
pub fn align(
    ego: &[Box3d],
    neighbour: &[Box3d],
    start: &Isometry3<f64>,
) -> Result<Isometry3<f64>, NoAlignment> {
    let [ego, neighbour] = [ego, neighbour].map(|boxes| -> Vec<Vector3<f64>> {
        let centres = boxes.iter().map(|node| Vector3::from(node.center_m));
        centres
            .filter(|centre| centre.iter().all(|c| c.abs() < 1e6))
            .collect()
    });
    if ego.len() < MIN_BOXES || neighbour.len() < MIN_BOXES {
        return Err(NoAlignment::TooFewBoxes {
            ego: ego.len(),
            neighbour: neighbour.len(),
            required: MIN_BOXES,
        });
    }
    let mut motion = *start;
    for _ in 0..MAX_ROUNDS {
        // Lazy: the fit walks the pairs several times, always with the motion of this round.
        let pairs = neighbour.iter().filter_map(|centre| {
            let moved = motion.rotation * centre + motion.translation.vector;
            let nearest = ego.iter().min_by(|a, b| {
                let [a, b] = [a, b].map(|other| (*other - moved).xy().norm_squared());
                a.total_cmp(&b)
            });
            Some((*centre, *nearest?))
        });
        let Some(next) = planar_fit::fit(&pairs) else {
            break;
        };
        let off = motion.inv_mul(&next);
        motion = next;
        // A radian counts as 100 m, the way of a centre that far from the vehicle.
        if off.translation.vector.norm() + 100.0 * off.rotation.angle() < CONVERGED_M {
            break;
        }
    }
    Ok(motion)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cars(from: &Isometry3<f64>) -> Vec<Box3d> {
        let places: [[f64; 2]; 6] = [
            [0.0, 8.0],
            [14.0, -6.0],
            [-22.0, 3.0],
            [35.0, 12.0],
            [-9.0, -17.0],
            [25.0, -20.0],
        ];
        let inverse = from.inverse();
        let cars = places.map(|[x, y]| {
            let center = inverse.rotation * Vector3::new(x, y, 0.0) + inverse.translation.vector;
            Box3d {
                center_m: center.into(),
                size_m: [4.5, 1.9, 1.6],
                heading_rad: 0.0,
            }
        });
        cars.into()
    }

    #[test]
    fn near_is_found_and_far_is_not() {
        let here = Isometry3::identity();
        let near = Isometry3::new(Vector3::new(1.5, -1.0, 0.1), Vector3::z() * 0.05);
        let found = align(&cars(&here), &cars(&near), &here).unwrap();
        assert!(near.inv_mul(&found).translation.vector.norm() < 1e-3);
        let far = Isometry3::new(Vector3::new(40.0, 10.0, 0.0), Vector3::z() * 2.0);
        let found = align(&cars(&here), &cars(&far), &here).unwrap();
        assert!(far.inv_mul(&found).translation.vector.norm() > 3.0);
        assert!(matches!(
            align(&[], &cars(&here), &here),
            Err(NoAlignment::TooFewBoxes { ego: 0, .. })
        ));
    }
}
