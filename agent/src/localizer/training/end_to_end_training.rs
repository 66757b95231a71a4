//! Training of the competitors, from nothing, on the sweeps of one town.

use std::collections::BTreeMap;
use std::f64::consts::PI;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use nalgebra::{Isometry3, Point3, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tch::nn::VarStore;
use tch::{Kind, Tensor};

use super::error::LocalizerTrainError;
use super::pairs::choose;
use super::sweep_store::{SweepList, yaw};
use crate::localizer::end_to_end::{EndToEnd, EndToEndConfig, EndToEndKind};
use crate::localizer::{EndToEndLocalizer, SceneEncoderConfig, SweepVoxels, VoxelBatch};
use crate::training::{Prefetch, RunConfig, Trained, Trainer};
use crate::weights::{CONFIG_KEY, KIND_KEY};

/// Cells of each sweep that the loss looks at.
const CELLS: usize = 400;
/// Metres that a unit of heading (about 57 degrees) weighs as much as.
const HEADING_WEIGHT_M: f64 = 30.0;
/// Largest turn of a sweep in training, radians.
const TURN_RAD: f64 = 10.0 * PI / 180.0;
/// Steps between two reports.
const REPORT_EVERY: u64 = 10;
/// Steps between two checkpoints.
const CHECKPOINT_EVERY: u64 = 500;

/// What to train, on what, for how long.
#[derive(Debug, Clone)]
pub struct EndToEndTrainConfig {
    /// Folders of scenes, all of one town.
    pub scenes: Vec<PathBuf>,
    /// What is regressed.
    pub regresses: EndToEndKind,
    /// Name of the town.
    pub town: String,
    /// The encoder.
    pub encoder: SceneEncoderConfig,
    /// How; a batch are sweeps.
    pub run: RunConfig,
}

/// Where a training of a competitor is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EndToEndReport {
    /// Steps done.
    pub step: u64,
    /// Share that is done, 0..1.
    pub share_done: f64,
    /// Seconds spent.
    pub seconds: f64,
    /// Mean L1 error of a cell or a position since the last report, metres.
    pub error_m: f64,
}

struct Example {
    voxels: SweepVoxels,
    rows: Vec<usize>,
    world_from_sensor: Isometry3<f64>,
}

/// Trains a competitor; writes checkpoint and weights into `config.run.out`.
///
/// # Errors
/// [`LocalizerTrainError`].
pub fn train_end_to_end(
    config: &EndToEndTrainConfig,
    observe: &mut dyn FnMut(&EndToEndReport),
) -> Result<Trained, LocalizerTrainError> {
    let started = Instant::now();
    let run = &config.run;
    run.start()?;
    let list = Arc::new(SweepList::open(&config.scenes)?);
    let network_config = EndToEndConfig {
        regresses: config.regresses,
        town: config.town.clone(),
        origin_m: middle(&list)?,
        encoder: config.encoder.clone(),
    };
    let variables = VarStore::new(run.device);
    let network = EndToEnd::new(&variables.root(), &network_config)?;
    let mut trainer = Trainer::begin(run, &variables, None, started)?;
    let mut loader = examples(&list, config, trainer.steps());
    let mut window = Vec::new();
    let share_done = |trainer: &Trainer| {
        let sweeps = trainer.steps() * run.batch as u64;
        trainer.share_done(sweeps as f64 / list.len() as f64)
    };
    while share_done(&trainer) < 1.0 {
        let (loss, error_m) = loss(&network, &loader.next_batch()??, run)?;
        trainer.step(&loss, share_done(&trainer))?;
        window.push(error_m);
        let step = trainer.steps();
        if step.is_multiple_of(REPORT_EVERY) {
            let error_m = window.iter().sum::<f64>() / window.len() as f64;
            window.clear();
            let share_done = share_done(&trainer).min(1.0);
            observe(&EndToEndReport { step, share_done, seconds: trainer.seconds(), error_m });
        }
        if step.is_multiple_of(CHECKPOINT_EVERY) {
            trainer.checkpoint(&variables)?;
        }
    }
    trainer.checkpoint(&variables)?;
    let about = BTreeMap::from([
        (CONFIG_KEY.to_owned(), serde_json::to_string(&network_config).expect("a configuration is JSON")),
        (KIND_KEY.to_owned(), EndToEndLocalizer::KIND.to_owned()),
    ]);
    Ok(trainer.save_weights(&variables, about, list.data())?)
}

/// Middle of the positions; reads a tenth of them.
fn middle(list: &SweepList) -> Result<[f64; 3], LocalizerTrainError> {
    let mut sum = [0.0; 4];
    for index in (0..list.len()).step_by((list.len() / 200).max(1)) {
        if let Some(sweep) = list.read(index, 1.0)? {
            (0..3).for_each(|axis| sum[axis] += sweep.world_from_sensor.translation.vector[axis]);
            sum[3] += 1.0;
        }
    }
    if sum[3] == 0.0 {
        return Err(LocalizerTrainError::NoSweeps(Vec::new()));
    }
    Ok(std::array::from_fn(|axis| sum[axis] / sum[3]))
}

type Examples = Prefetch<Result<Vec<Example>, LocalizerTrainError>>;

/// Batches from `first` on. Every sweep is drawn anew, again where its pose is not known; [`middle`] has found one whose is.
fn examples(list: &Arc<SweepList>, config: &EndToEndTrainConfig, first: u64) -> Examples {
    let RunConfig { seed, batch, loader_threads, .. } = config.run;
    let (list, encoder, batch) = (Arc::clone(list), config.encoder.clone(), batch as u64);
    Prefetch::start(loader_threads, first, move |number| {
        let example = |index: u64| {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            rng.set_stream(index);
            let stored = loop {
                if let Some(stored) = list.read(rng.random_range(0..list.len()), encoder.range_m)? {
                    break stored;
                }
            };
            let turn = yaw(rng.random_range(-TURN_RAD..TURN_RAD));
            let keep = rng.random_range(0.7..1.0);
            let voxels = stored.turned_voxels(&turn, keep, &mut rng, &encoder);
            let rows = choose(voxels.cells(), CELLS, &mut rng);
            Ok(Example { voxels, rows, world_from_sensor: stored.world_from_sensor * turn.inverse() })
        };
        (number * batch..(number + 1) * batch).map(example).collect()
    })
}

/// The loss and the mean L1 error in metres.
fn loss(network: &EndToEnd, batch: &[Example], run: &RunConfig) -> Result<(Tensor, f64), LocalizerTrainError> {
    let kind = run.precision.kind();
    let sweeps: Vec<&SweepVoxels> = batch.iter().map(|example| &example.voxels).collect();
    let voxels = VoxelBatch::new(&sweeps, network.encoder().config(), run.device)?;
    let local = network.encoder().local(&voxels, kind)?;
    let features = network.encoder().complete(&local, &voxels)?;
    let origin = Vector3::from(network.config().origin_m);
    let tensor =
        |values: &[f32], columns: i64| Tensor::f_from_slice(values)?.f_view([-1, columns])?.f_to_device(run.device);
    let l1 = |found: &Tensor, wanted: &Tensor| {
        (found - wanted).f_abs()?.f_sum_dim_intlist(1_i64, false, Kind::Float)?.f_mean(Kind::Float)
    };
    match network.config().regresses {
        EndToEndKind::SceneCoordinates => {
            let (mut rows, mut targets) = (Vec::new(), Vec::new());
            for (number, example) in batch.iter().enumerate() {
                let first = voxels.cell_rows(number).start;
                for &row in &example.rows {
                    let place = example.voxels.cells()[row].centroid_m.map(f64::from);
                    let place = example.world_from_sensor * Point3::from(place) - origin;
                    rows.push(first + row as i64);
                    targets.extend(place.coords.iter().map(|&axis| axis as f32));
                }
            }
            let rows = Tensor::f_from_slice(&rows)?.f_to_device(run.device)?;
            let found = network.coordinates(&features.cells.f_index_select(0, &rows)?)?;
            let error = l1(&found, &tensor(&targets, 3)?)?;
            let metres = error.f_double_value(&[])?;
            Ok((error, metres))
        }
        EndToEndKind::Pose => {
            let positions: Vec<f32> = batch
                .iter()
                .flat_map(|example| {
                    (example.world_from_sensor.translation.vector - origin).map(|axis| axis as f32).data.0[0]
                })
                .collect();
            let headings: Vec<f32> = batch
                .iter()
                .flat_map(|example| {
                    let ahead = (example.world_from_sensor.rotation * Vector3::x()).xy().normalize();
                    [ahead.x as f32, ahead.y as f32]
                })
                .collect();
            let (position, heading) = network.poses(&features, kind)?;
            let error = l1(&position, &tensor(&positions, 3)?)?;
            let turn = l1(&heading, &tensor(&headings, 2)?)?;
            let metres = error.f_double_value(&[])?;
            Ok((error + turn * HEADING_WEIGHT_M, metres))
        }
    }
}
