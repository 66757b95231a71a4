//! Validation of a head on cached features of sweeps that it was not trained on.

use std::fmt;

use serde::Serialize;
use support::statistics;
use tch::{Kind, no_grad};

use super::feature_cache::FeatureCache;
use crate::Error;
use localization::pgc::extensions::wider_search;
use localization::pgc::pose_refinement::SweepCells;
use localization::pgc::pose_search::PoseSearch;
use localization::pgc::pose_solver::PoseSolver;
use localization::pgc::{SceneCoordinates, SceneHead, stopwatch};
use perception::tensor_values::values;
use protocol::PoseError;

/// Errors on sweeps that were not trained on.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SceneAccuracy {
    /// Median L1 error of a cell, metres.
    pub cell_p50_m: f64,
    /// Median translation error, metres.
    pub pose_p50_m: f64,
    /// Median rotation error, degrees.
    pub pose_p50_deg: f64,
    /// Share of sweeps with a translation error under 3 m; those without a pose are failures.
    pub success_3m: f64,
    /// Share of sweeps with a translation error under 1 m.
    pub success_1m: f64,
}

impl fmt::Display for SceneAccuracy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (cell_m, pose_m, pose_deg) = (self.cell_p50_m, self.pose_p50_m, self.pose_p50_deg);
        let [under_3m, under_1m] = [self.success_3m, self.success_1m].map(|share| 100.0 * share);
        write!(
            f,
            "cells {cell_m:.2} m, poses {pose_m:.3} m {pose_deg:.3} degrees, under 3 m {under_3m:.1} %, under 1 m {under_1m:.1} %"
        )
    }
}

/// Regresses and solves every sweep of `cache`, whose targets are relative to the origin of the head.
pub(super) fn validate(
    head: &SceneHead,
    cache: &FeatureCache,
    kind: Kind,
) -> Result<SceneAccuracy, Error> {
    let regression = no_grad(|| {
        let logits = head.classify(&cache.sweeps, false)?;
        let of_cells = logits.f_index_select(0, &cache.sweep_of_cell)?;
        head.regress(&head.normalise(&cache.cells)?, &of_cells, kind)
    })?;
    let error = (&regression.coordinates_m - &cache.targets_m).f_abs()?;
    let error = error.f_sum_dim_intlist(1_i64, false, Kind::Float)?;
    let cell_errors: Vec<f64> = Vec::try_from(&error.f_to_kind(Kind::Double)?)?;
    let world = values(&regression.coordinates_m)?;
    let sensor = values(&cache.sensor_m)?;
    let epsilon = values(&regression.epsilon_m)?;
    let sweeps: Vec<i64> = Vec::try_from(&cache.sweep_of_cell)?;
    let solver = PoseSolver::default();
    let (mut translations, mut rotations, mut first) = (Vec::new(), Vec::new(), 0);
    for (sweep, truth) in cache.world_from_sensor.iter().enumerate() {
        let own = sweeps[first..].iter().take_while(|&&of| of == sweep as i64);
        let rows = first..first + own.count();
        let features = cache.cells.f_narrow(0, first as i64, rows.len() as i64)?;
        first = rows.end;
        let coordinates = SceneCoordinates {
            sensor_m: sensor.as_chunks().0[rows.clone()].to_vec(),
            world_m: world.as_chunks().0[rows.clone()].to_vec(),
            epsilon_m: epsilon[rows].to_vec(),
            origin_m: cache.origin_m,
        };
        let refinement_cells = SweepCells {
            features,
            sensor_m: coordinates.sensor_m.clone(),
        };
        let search = PoseSearch {
            head,
            solver: &solver,
            refinement_cells: &refinement_cells,
            kind,
        };
        let found = wider_search::search(&search, &coordinates, &mut stopwatch())?;
        // A missing pose is infinitely far off: it counts in the medians and is no success.
        let (metres, degrees) = found.solved.map_or((f64::INFINITY, 180.0), |found| {
            let error = PoseError::between(&found.world_from_sensor.into(), &(*truth).into());
            (error.distance_m, error.angle_deg)
        });
        translations.push(metres);
        rotations.push(degrees);
    }
    let [success_3m, success_1m] = [statistics::SUCCESS_M, 1.0]
        .map(|limit_m| statistics::share_below(&translations, limit_m, translations.len()));
    Ok(SceneAccuracy {
        cell_p50_m: median(&cell_errors),
        pose_p50_m: median(&translations),
        pose_p50_deg: median(&rotations),
        success_3m,
        success_1m,
    })
}

fn median(values: &[f64]) -> f64 {
    statistics::median(values).unwrap_or(f64::NAN)
}
