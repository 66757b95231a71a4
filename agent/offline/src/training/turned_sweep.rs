//! A sweep as a network for one town learns from it.

use nalgebra::Isometry3;
use rand::Rng;

use super::pairs::choose;
use super::sweep_store::StoredSweep;
use localization::pgc::{SceneEncoderConfig, SweepVoxels};

/// Cells of a sweep that are learnt from.
pub(super) const CELLS: usize = 400;

/// A sweep, turned and decimate out.
pub(super) struct TurnedSweep {
    pub(super) voxels: SweepVoxels,
    /// Which of its cells are learnt from.
    pub(super) rows: Vec<usize>,
    /// Pose of the turned sensor.
    pub(super) world_from_sensor: Isometry3<f64>,
}

impl TurnedSweep {
    /// The sweep of a sensor that stands `turned_from_sensor`, each point kept with a probability.
    pub(super) fn new(
        stored: &StoredSweep,
        turned_from_sensor: &Isometry3<f64>,
        keep: f64,
        rng: &mut impl Rng,
        config: &SceneEncoderConfig,
    ) -> Self {
        let voxels = stored.turned_voxels(turned_from_sensor, keep, rng, config);
        let rows = choose(voxels.cells(), CELLS, rng);
        Self { voxels, rows, world_from_sensor: stored.world_from_sensor * turned_from_sensor.inverse() }
    }
}
