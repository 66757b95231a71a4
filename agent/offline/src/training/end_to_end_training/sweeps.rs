//! Sweeps, rotated and subsampled at random, the examples of a training of a whole network.

use std::f64::consts::PI;
use std::sync::Arc;

use nalgebra::{Point3, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tch::Tensor;

use super::Examples;
use super::loss::{Truth, coordinate_loss, pose_loss};
use crate::training::LocalizerTrainError;
use crate::training::sweep_store::{SweepList, yaw};
use crate::training::turned_sweep::TurnedSweep;
use localization::competitors::{EndToEnd, EndToEndKind};
use localization::pgc::{SceneEncoderConfig, SweepVoxels, VoxelBatch};
use perception::train::{Prefetch, RunConfig};

/// Largest rotation of a sweep, radians.
const TURN_RAD: f64 = 10.0 * PI / 180.0;

type Batches = Prefetch<Vec<TurnedSweep>>;

/// Batches of sweeps.
pub(super) struct Sweeps {
    list: Arc<SweepList>,
    encoder: SceneEncoderConfig,
    run: RunConfig,
    origin_m: [f64; 3],
    batches: Batches,
}

impl Sweeps {
    /// Batches of `list`; computes the centre of its positions.
    pub(super) fn new(
        list: &Arc<SweepList>,
        encoder: &SceneEncoderConfig,
        run: &RunConfig,
    ) -> Result<Self, LocalizerTrainError> {
        let origin_m = middle(list)?;
        let batches = batches(list, encoder, run, 0);
        Ok(Self { list: Arc::clone(list), encoder: encoder.clone(), run: run.clone(), origin_m, batches })
    }
}

impl Examples for Sweeps {
    fn origin_m(&self) -> [f64; 3] {
        self.origin_m
    }

    fn features(&self, _: EndToEndKind) -> Result<Option<Tensor>, LocalizerTrainError> {
        Ok(None)
    }

    fn begin(&mut self, step: u64) {
        self.batches = batches(&self.list, &self.encoder, &self.run, step);
    }

    fn next_loss(&mut self, network: &EndToEnd) -> Result<(Tensor, f64), LocalizerTrainError> {
        let batch = self.batches.next_batch()?;
        let (kind, device) = (self.run.precision.kind(), self.run.device);
        let sweeps: Vec<&SweepVoxels> = batch.iter().map(|example| &example.voxels).collect();
        let voxels = VoxelBatch::new(&sweeps, network.encoder().config(), device)?;
        let local = network.encoder().local(&voxels, kind)?;
        let features = network.encoder().complete(&local, &voxels)?;
        if network.config().regresses == EndToEndKind::Pose {
            let truth = Truth::new(batch.iter().map(|example| &example.world_from_sensor), self.origin_m, device)?;
            return Ok(pose_loss(network, &features.sweeps, &truth)?);
        }
        let (mut rows, mut places, mut targets) = (Vec::new(), Vec::new(), Vec::new());
        for (number, example) in batch.iter().enumerate() {
            let first = voxels.cell_rows(number).start;
            for &row in &example.rows {
                let centroid_m = example.voxels.cells()[row].centroid_m;
                places.extend(centroid_m);
                let place = Point3::from(centroid_m.map(f64::from));
                let place = example.world_from_sensor * place - Vector3::from(self.origin_m);
                rows.push(first + row as i64);
                targets.extend(place.coords.iter().map(|&axis| axis as f32));
            }
        }
        let rows = Tensor::f_from_slice(&rows)?.f_to_device(device)?;
        let points = |values: &[f32]| Tensor::f_from_slice(values)?.f_view([-1, 3])?.f_to_device(device);
        let cells = features.cells.f_index_select(0, &rows)?;
        Ok(coordinate_loss(network, &cells, &points(&places)?, &points(&targets)?)?)
    }
}

/// Centre of the positions; reads a tenth of them.
fn middle(list: &SweepList) -> Result<[f64; 3], LocalizerTrainError> {
    let mut sum = [0.0; 4];
    for index in (0..list.len()).step_by((list.len() / 200).max(1)) {
        if let Some(sweep) = list.read(index, 1.0) {
            (0..3).for_each(|axis| sum[axis] += sweep.world_from_sensor.translation.vector[axis]);
            sum[3] += 1.0;
        }
    }
    if sum[3] == 0.0 {
        return Err(LocalizerTrainError::NoSweeps(Vec::new()));
    }
    Ok(std::array::from_fn(|axis| sum[axis] / sum[3]))
}

/// Batches from `first` on. Every sweep is drawn at random, again if its pose is unknown; [`middle`] has found at least
/// one with a pose.
fn batches(list: &Arc<SweepList>, encoder: &SceneEncoderConfig, run: &RunConfig, first: u64) -> Batches {
    let RunConfig { seed, batch, loader_threads, .. } = *run;
    let (list, encoder, batch) = (Arc::clone(list), encoder.clone(), batch as u64);
    Prefetch::start(loader_threads, first, move |number| {
        let example = |index: u64| {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            rng.set_stream(index);
            let stored = loop {
                if let Some(stored) = list.read(rng.random_range(0..list.len()), encoder.range_m) {
                    break stored;
                }
            };
            let turn = yaw(rng.random_range(-TURN_RAD..TURN_RAD));
            let keep = rng.random_range(0.7..1.0);
            TurnedSweep::new(&stored, &turn, keep, &mut rng, &encoder)
        };
        (number * batch..(number + 1) * batch).map(example).collect()
    })
}
