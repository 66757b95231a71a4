//! A sweep, augmented for the training of a network of one scene.

use nalgebra::Isometry3;
use rand::Rng;

use super::pairs::choose;
use super::sweep_store::StoredSweep;
use localization::pgc::{SceneEncoderConfig, SweepVoxels};

/// Number of cells of a sweep that are training examples.
pub(crate) const CELLS: usize = 400;

/// A sweep, rotated and subsampled.
pub(super) struct TurnedSweep {
    pub(super) voxels: SweepVoxels,
    /// Indices of the cells that are training examples.
    pub(super) rows: Vec<usize>,
    /// Number of points within the range of the encoder, before any is left out.
    pub(super) points: usize,
    /// Pose of the turned sensor.
    pub(super) world_from_sensor: Isometry3<f64>,
}

impl TurnedSweep {
    /// The sweep of a sensor in the orientation `turned_from_sensor`, each point kept with a probability.
    pub(super) fn new(
        stored: &StoredSweep,
        turned_from_sensor: &Isometry3<f64>,
        keep: f64,
        rng: &mut impl Rng,
        config: &SceneEncoderConfig,
    ) -> Self {
        let voxels = stored.turned_voxels(turned_from_sensor, keep, rng, config);
        let rows = choose(voxels.cells(), CELLS, rng);
        let world_from_sensor = stored.world_from_sensor * turned_from_sensor.inverse();
        Self { voxels, rows, points: stored.point_count(), world_from_sensor }
    }
}
