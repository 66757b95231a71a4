//! A sweep, augmented for the training of a network of one scene.

use nalgebra::{Isometry3, Point3};
use rand::Rng;

use super::pairs::choose;
use super::sweep_store::PosedSweep;
use localization::pgc::{PreparedSweep, SweepFormat};

/// Number of cells of a sweep that are training examples.
pub(crate) const CELLS: usize = 400;

/// A sweep, rotated and subsampled.
pub(super) struct TurnedSweep {
    pub(super) sweep: PreparedSweep,
    /// Indices of the cells that are training examples.
    pub(super) rows: Vec<usize>,
    /// Number of points within the range of the encoder, before any is left out.
    pub(super) points: usize,
    /// Pose of the turned sensor.
    pub(super) world_from_sensor: Isometry3<f64>,
}

impl TurnedSweep {
    /// A sweep within the range of the encoder, for a sensor in the orientation `turned_from_sensor`, each point kept with
    /// a probability.
    pub(super) fn new(
        (mut points, world_from_sensor): PosedSweep,
        turned_from_sensor: &Isometry3<f64>,
        keep: f64,
        rng: &mut impl Rng,
        format: &SweepFormat,
    ) -> Self {
        let in_range = points.len();
        thin_and_turn(&mut points, turned_from_sensor, keep, rng);
        let prepared = format.prepare(&points);
        Self {
            rows: choose(prepared.cells(), CELLS, rng),
            sweep: prepared,
            points: in_range,
            world_from_sensor: world_from_sensor * turned_from_sensor.inverse(),
        }
    }
}

/// Keeps each point with a probability, and rotates the others into the frame of the turned sensor.
pub(crate) fn thin_and_turn(
    points: &mut Vec<[f32; 4]>,
    turned_from_sensor: &Isometry3<f64>,
    keep: f64,
    rng: &mut impl Rng,
) {
    points.retain(|_| keep >= 1.0 || rng.random_bool(keep));
    let turn: Isometry3<f32> = turned_from_sensor.cast();
    if turn != Isometry3::identity() {
        points.iter_mut().for_each(|[x, y, z, _]| {
            let turned = turn * Point3::new(*x, *y, *z);
            (*x, *y, *z) = (turned.x, turned.y, turned.z);
        });
    }
}
