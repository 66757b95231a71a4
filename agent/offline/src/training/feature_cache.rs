//! Feature cache of a scene's sweeps: computed once, since the encoder is frozen and only the head is trained on them.

use std::f64::consts::PI;
use std::sync::Arc;

use nalgebra::{Isometry3, Point3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tch::{Kind, TchError, Tensor, no_grad};

use super::sweep_store::{SweepList, mean_position_m, yaw};
use super::turned_sweep::{CELLS, TurnedSweep};
use crate::Error;
use localization::pgc::{CellEncoder, PreparedSweep, SweepCell};
use perception::tensor_values::tensor;
use perception::train::{Observe, Prefetch, RunConfig, TrainingEvent};

/// Number of sweeps of one forward pass.
const BATCH: u64 = 4;

/// Augmentation of sweeps before they are encoded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SweepAugmentation {
    /// Number of copies of every sweep; the first is unchanged.
    pub copies: usize,
    /// Largest rotation of the other copies, radians: a car is not always aligned with its lane.
    pub turn_rad: f64,
    /// Smallest share of points that is kept in the other copies, 0..=1.
    pub keep: f64,
}

impl SweepAugmentation {
    /// Each sweep once, as it is.
    pub(crate) const NONE: Self = Self {
        copies: 1,
        turn_rad: 0.0,
        keep: 1.0,
    };

    /// Rotation of a copy, and its share of points.
    fn draw(&self, copy: usize, rng: &mut ChaCha8Rng) -> (Isometry3<f64>, f64) {
        if copy == 0 {
            return (Isometry3::identity(), 1.0);
        }
        // Never 0: nothing can be drawn from an empty range.
        let angle = self.turn_rad.clamp(1e-6, PI);
        let turn = yaw(rng.random_range(-angle..angle));
        (turn, rng.random_range(self.keep..=1.0))
    }
}

/// Features of the cells of all sweeps of a scene, and where the cells are.
#[derive(Debug)]
pub(crate) struct FeatureCache {
    /// `[N, cell_channels]`, half precision.
    pub cells: Tensor,
    /// `[N]`: index of the sweep of each cell.
    pub sweep_of_cell: Tensor,
    /// `[N, 3]`: true world coordinates relative to the origin, metres.
    pub targets_m: Tensor,
    /// `[N, 3]`: position of the cell in the sensor frame, metres.
    pub sensor_m: Tensor,
    /// `[S, sweep_channels]`, single precision.
    pub sweeps: Tensor,
    /// `[S]`: number of points within the range of the encoder.
    pub points: Vec<usize>,
    /// `[S]`: true poses.
    pub world_from_sensor: Vec<Isometry3<f64>>,
    /// Origin of the targets, metres in the world: the centre of the sensor positions, if no other was set.
    pub origin_m: [f64; 3],
}

impl FeatureCache {
    /// Encodes every sweep of `list` once per copy, on the device and in the precision of `run`; `observe` gets the
    /// number of sweeps done and of all, and in the end the listing of the data.
    ///
    /// # Errors
    /// [`Error`] when a sweep cannot be read or encoded, or none has a pose.
    pub(crate) fn build(
        list: &Arc<SweepList>,
        encoder: &CellEncoder,
        augmentation: SweepAugmentation,
        run: &RunConfig,
        observe: &mut Observe<'_>,
    ) -> Result<Self, Error> {
        let (seed, device) = (run.seed, run.device);
        let total = list.len() * augmentation.copies.max(1);
        let format = encoder.format().clone();
        let source = Arc::clone(list);
        let mut loader = Prefetch::start(run.loader_threads, 0, move |batch| {
            let numbers = batch * BATCH..((batch + 1) * BATCH).min(total as u64);
            let sweeps = numbers.filter_map(|number| {
                let index = number as usize % source.len();
                let sweep = source.posed_sweep(index, format.range_m())?;
                // A stream for each number: augmentation does not depend on the number of threads.
                let mut rng = ChaCha8Rng::seed_from_u64(seed);
                rng.set_stream(number);
                let (turn, keep) = augmentation.draw(number as usize / source.len(), &mut rng);
                Some(TurnedSweep::new(sweep, &turn, keep, &mut rng, &format))
            });
            sweeps.collect::<Vec<_>>()
        });
        let size = [(total * CELLS) as i64, encoder.format().cell_channels()];
        let cells = Tensor::f_empty(size, (Kind::Half, device))?;
        let mut builder = CacheBuilder::default();
        for done in (0..total).step_by(BATCH as usize) {
            let batch = loader.next_batch()?;
            if !batch.is_empty() {
                builder.add(&cells, &batch, encoder, run.precision.kind())?;
            }
            let done = (done + BATCH as usize).min(total);
            observe(&TrainingEvent::Encoding(done, total));
        }
        let cache = builder.finish(cells)?;
        observe(&TrainingEvent::Read(list.data()));
        Ok(cache)
    }

    /// Number of sweeps.
    pub(crate) fn sweep_count(&self) -> usize {
        self.world_from_sensor.len()
    }

    /// `[S]`: true positions of the sensor, metres.
    pub(crate) fn positions_m(&self) -> Vec<[f64; 3]> {
        let poses = self.world_from_sensor.iter();
        poses.map(|pose| pose.translation.vector.into()).collect()
    }

    /// Lets the regression targets be relative to another origin, metres in the world.
    pub(crate) fn move_origin(&mut self, origin_m: [f64; 3]) -> Result<(), TchError> {
        // The difference is taken in f64; what remains is small enough for f32.
        let moved: [f32; 3] =
            std::array::from_fn(|axis| (self.origin_m[axis] - origin_m[axis]) as f32);
        let moved = tensor(&moved, &[3], self.targets_m.device())?;
        self.targets_m = self.targets_m.f_add(&moved)?;
        self.origin_m = origin_m;
        Ok(())
    }

    /// Number of cells.
    pub(crate) fn cell_count(&self) -> i64 {
        self.sweep_of_cell.size()[0]
    }

    /// `[wanted]` random rows of cells, the same for the same seed and `stream`.
    pub(crate) fn drawn_rows(&self, seed: u64, stream: u64, wanted: usize) -> tch::Result<Tensor> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(stream);
        let rows = (0..wanted).map(|_| rng.random_range(0..self.cell_count()));
        tensor(&rows.collect::<Vec<i64>>(), &[-1], self.cells.device())
    }
}

#[derive(Default)]
struct CacheBuilder {
    sweeps: Vec<Tensor>,
    sweep_of_cell: Vec<i64>,
    places: Vec<SweepCell>,
    points: Vec<usize>,
    poses: Vec<Isometry3<f64>>,
}

impl CacheBuilder {
    /// Adds sweeps; the features of their cells are written to the next rows of `cells`, one block from the start:
    /// thousands of pieces would stay in the allocator's lists for the whole training.
    fn add(
        &mut self,
        cells: &Tensor,
        batch: &[TurnedSweep],
        encoder: &CellEncoder,
        kind: Kind,
    ) -> Result<(), Error> {
        let sweeps: Vec<&PreparedSweep> = batch.iter().map(|turned| &turned.sweep).collect();
        let encoded = encoder.encode(&sweeps, kind)?;
        let mut rows = Vec::new();
        let filled = self.places.len() as i64;
        for (turned, of_sweep) in batch.iter().zip(&encoded.rows) {
            for &row in &turned.rows {
                rows.push(of_sweep.start + row as i64);
                self.sweep_of_cell.push(self.poses.len() as i64);
                self.places.push(turned.sweep.cells()[row]);
            }
            self.points.push(turned.points);
            self.poses.push(turned.world_from_sensor);
        }
        let rows = tensor(&rows, &[-1], cells.device())?;
        no_grad(|| {
            let features = encoded.features.cells.f_index_select(0, &rows)?;
            let mut place = cells.f_narrow(0, filled, rows.size()[0])?;
            place.f_copy_(&features)
        })?;
        self.sweeps.push(encoded.features.sweeps);
        Ok(())
    }

    fn finish(self, cells: Tensor) -> Result<FeatureCache, Error> {
        if self.poses.is_empty() || self.places.is_empty() {
            return Err(Error::NoSweeps(Vec::new(), String::new()));
        }
        let origin_m = mean_position_m(&self.poses);
        let mut targets = Vec::with_capacity(3 * self.places.len());
        for (cell, &sweep) in self.places.iter().zip(&self.sweep_of_cell) {
            let place = self.poses[sweep as usize] * Point3::from(cell.centroid_m.map(f64::from));
            // Subtracted in f64: world coordinates are too large for f32.
            targets.extend((0..3).map(|axis| (place[axis] - origin_m[axis]) as f32));
        }
        let sensor: Vec<[f32; 3]> = self.places.iter().map(|cell| cell.centroid_m).collect();
        let device = cells.device();
        Ok(FeatureCache {
            cells: cells.f_narrow(0, 0, self.places.len() as i64)?,
            sweep_of_cell: tensor(&self.sweep_of_cell, &[-1], device)?,
            targets_m: tensor(&targets, &[-1, 3], device)?,
            sensor_m: tensor(sensor.as_flattened(), &[-1, 3], device)?,
            sweeps: Tensor::f_cat(&self.sweeps, 0)?,
            points: self.points,
            world_from_sensor: self.poses,
            origin_m,
        })
    }
}
