//! Pose refinement: from a coarse pose to an accurate one, by two rounds of the refiner's predictions and a new fit.

use nalgebra::{Isometry3, Point3, Vector3};
use perception::tensor_values::{tensor, values};
use tch::{Kind, Tensor, no_grad};

use super::pose_std::PoseStd;
use super::scene_encoder::SceneFeatures;
use super::scene_regression::SceneHead;
use super::voxelise::SweepCell;
use crate::registration::refine::{forgiveness, reweighted};
use crate::registration::{Correspondence, Registration};

/// Scales of the fits of each round, metres: the first pose may be off by two metres, the second hardly is.
const ROUNDS_M: [&[f64]; 2] = [&[2.0, 1.2, 0.8], &[0.6, 0.4, 0.3, 0.3]];
/// Scales of an additional first round if the coarse pose may be off by more, metres.
const WIDE_ROUND_M: &[f64] = &[4.0, 3.0, 2.0];
/// Distance at which a cell is an inlier of the refined pose, metres.
const INLIER_M: f64 = 1.0;
/// Smallest error of a cell, metres.
const FLOOR_M: f32 = 0.1;

/// Cells of one sweep that enter the refiner.
#[derive(Debug)]
pub struct SweepCells {
    /// `[N, cell_channels]`.
    pub features: Tensor,
    /// `[N, 3]`: in the sensor frame, metres.
    pub sensor_m: Vec<[f32; 3]>,
}

impl SweepCells {
    /// The chosen ones of the cells of a sweep, which has these features.
    pub(crate) fn pick(
        cells: &[SweepCell],
        features: &SceneFeatures,
        chosen: &[usize],
    ) -> tch::Result<Self> {
        let rows: Vec<i64> = chosen.iter().map(|&cell| cell as i64).collect();
        let rows = tensor(&rows, &[-1], features.cells.device())?;
        Ok(Self {
            features: no_grad(|| features.cells.f_index_select(0, &rows))?,
            sensor_m: chosen.iter().map(|&cell| cells[cell].centroid_m).collect(),
        })
    }
}

/// A refined pose and the predictions that it was fitted to.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct RefinedPose {
    /// `origin_from_sensor` and its inliers.
    pub(super) registration: Registration,
    /// `[N]`: predicted L1 error of each cell's last prediction, metres.
    pub(super) epsilon_m: Vec<f32>,
    /// Lower quartile of the distances between all predicted cells and their positions under the pose, metres.
    pub(super) residual_quartile_m: f64,
    /// Standard deviations of the pose.
    pub(super) std: PoseStd,
    /// Sum of the weights of the last fit, 1 / square metres: per-cell predicted precision, weighted by the robust
    /// kernel.
    pub(super) information_per_m2: f64,
}

/// Refines the pose `start`: the refiner predicts the positions of cells near those that `start` gives. Poses are
/// relative to the head's origin.
///
/// With `is_wide` the error of `start` may be larger than usual. `None` if the head has no refiner or its predictions
/// do not constrain a pose.
pub(super) fn refine(
    head: &SceneHead,
    cells: &SweepCells,
    start: &Isometry3<f64>,
    is_wide: bool,
    kind: Kind,
) -> tch::Result<Option<RefinedPose>> {
    let Some(refiner) = head.refiner() else {
        return Ok(None);
    };
    let sensor_m = &cells.sensor_m;
    let cells = head.normalise(&cells.features)?;
    let device = cells.device();
    let mut pose = *start;
    let mut answer = None;
    let wide_rounds = if is_wide { 2 } else { 0 };
    for scales_m in std::iter::repeat_n(WIDE_ROUND_M, wide_rounds).chain(ROUNDS_M) {
        // Step: positions and heading that the pose of the round before gives the cells.
        let mut assumed = Vec::with_capacity(3 * sensor_m.len());
        for point in sensor_m {
            let point = pose * Point3::from(point.map(f64::from));
            assumed.extend([point.x, point.y, point.z].map(|axis| axis as f32));
        }
        let ahead = pose.rotation * Vector3::x();
        // Without the tilt: cosine and sine of the heading in the plane.
        let norm = ahead.xy().norm().max(1e-6);
        let heading = [(ahead.x / norm) as f32, (ahead.y / norm) as f32];
        let heading = tensor(&heading, &[1, 2], device)?;
        let heading = heading.f_expand([sensor_m.len() as i64, -1], false)?;
        let assumed = tensor(&assumed, &[-1, 3], device)?;
        let seen = no_grad(|| refiner.look(&cells, &assumed, &heading, kind))?;
        let world = values(&seen.coordinates_m)?;
        let epsilon_m = values(&seen.epsilon_m)?;
        // Step: robust fit to the predictions, each weighted by its predicted error.
        let pairs: Vec<Correspondence> = (sensor_m.iter().zip(world.as_chunks().0).zip(&epsilon_m))
            .map(|((&source_m, &target_m), &epsilon_m)| Correspondence {
                source_m,
                target_m,
                weight: precision(epsilon_m),
            })
            .collect();
        let usable = pairs.iter().filter(|pair| pair.usable());
        let fits = usable.clone().map(|pair| {
            let [source, target] =
                [pair.source_m, pair.target_m].map(|point| Vector3::from(point.map(f64::from)));
            (source, target, f64::from(pair.weight))
        });
        match reweighted(&fits.collect::<Vec<_>>(), &pose, scales_m.iter().copied()) {
            Ok(fitted) => pose = fitted,
            Err(_) => return Ok(None),
        }
        // Step: evidence, with the weights that the pairs have at the fitted pose.
        let scale_m = scales_m.last().copied().unwrap_or(INLIER_M);
        let weighted = usable.map(|pair| {
            let share = forgiveness(pair.residual_m(&pose), scale_m);
            (pair, f64::from(pair.weight) * share)
        });
        let weighted: Vec<_> = weighted.collect();
        let distances_m = pairs.iter().map(|pair| distance_m(pair, &pose));
        answer = Some(RefinedPose {
            registration: Registration::judge(&pairs, pose, INLIER_M),
            epsilon_m,
            residual_quartile_m: lower_quartile(distances_m.collect()),
            information_per_m2: weighted.iter().map(|(_, weight)| weight).sum(),
            std: PoseStd::of(&pose, weighted.into_iter()),
        });
    }
    Ok(answer)
}

/// Distance between a predicted position and the one of its cell under a pose, metres; infinite if it is not finite.
fn distance_m(pair: &Correspondence, pose: &Isometry3<f64>) -> f64 {
    match pair.usable() {
        true => pair.residual_m(pose),
        false => f64::INFINITY,
    }
}

/// Lower quartile of the values; infinite if there are none. The fitted confidence model depends on this rule.
fn lower_quartile(mut values: Vec<f64>) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    let quartile = values.get(values.len() / 4);
    quartile.copied().unwrap_or(f64::INFINITY)
}

/// Weight of a prediction: the inverse of its expected squared error.
fn precision(epsilon_m: f32) -> f32 {
    1.0 / (FLOOR_M * FLOOR_M + epsilon_m * epsilon_m)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_quarter_lies_below_the_lower_quartile() {
        let values: Vec<f64> = (0..100).map(|k| f64::from((k * 37) % 100)).collect();
        assert_eq!(lower_quartile(values), 25.0);
        assert_eq!(lower_quartile(vec![3.0]), 3.0);
        assert_eq!(lower_quartile(Vec::new()), f64::INFINITY);
        let nowhere = Correspondence {
            source_m: [1.0; 3],
            target_m: [f32::NAN; 3],
            weight: 1.0,
        };
        assert_eq!(distance_m(&nowhere, &Isometry3::identity()), f64::INFINITY);
    }
}
