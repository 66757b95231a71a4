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
use tch::{Device, Kind, Tensor};

use super::error::LocalizerTrainError;
use super::pairs::choose;
use super::sweep_store::{SweepList, yaw};
use crate::localizer::end_to_end::{EndToEnd, EndToEndConfig, EndToEndKind};
use crate::localizer::{EndToEndLocalizer, SceneEncoderConfig, SweepVoxels, VoxelBatch};
use crate::training::{AdamW, AdamWConfig, ComputePrecision, Length, OneCycle, Prefetch, Step};
use crate::weights::{self, CONFIG_KEY, KIND_KEY};

/// Cells of each sweep that the loss looks at.
const CELLS: usize = 400;
/// Metres that a unit of heading (about 57 degrees) weighs as much as.
const HEADING_WEIGHT_M: f64 = 30.0;
/// Largest turn of a sweep in training, radians.
const TURN_RAD: f64 = 10.0 * PI / 180.0;
/// Steps between two reports.
const REPORT_EVERY: u64 = 10;
/// Gradients that are not finite in a row before the training gives up.
const MAX_SKIPPED: u32 = 20;

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
    /// How long.
    pub length: Length,
    /// Sweeps of a step.
    pub batch: usize,
    /// Highest learning rate.
    pub learning_rate: f64,
    /// Seed of parameters, order and augmentation.
    pub seed: u64,
    /// Where the network computes.
    pub device: Device,
    /// In which numbers.
    pub precision: ComputePrecision,
    /// Threads that read and sort sweeps.
    pub loader_threads: usize,
    /// Folder of the weights.
    pub out: PathBuf,
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

/// How a training of a competitor ended.
#[derive(Debug, Clone)]
pub struct EndToEndSummary {
    /// Steps done.
    pub steps: u64,
    /// Seconds spent.
    pub seconds: f64,
    /// The weights, in half precision.
    pub weights: PathBuf,
    /// Their SHA-256.
    pub sha256: String,
}

struct Example {
    voxels: SweepVoxels,
    rows: Vec<usize>,
    world_from_sensor: Isometry3<f64>,
}

/// Trains a competitor and writes its weights into `config.out`.
///
/// # Errors
/// [`LocalizerTrainError`].
pub fn train_end_to_end(
    config: &EndToEndTrainConfig,
    observe: &mut dyn FnMut(&EndToEndReport),
) -> Result<EndToEndSummary, LocalizerTrainError> {
    let started = Instant::now();
    std::fs::create_dir_all(&config.out)
        .map_err(|source| LocalizerTrainError::Io { path: config.out.clone(), source })?;
    tch::manual_seed(config.seed as i64);
    let list = Arc::new(SweepList::open(&config.scenes)?);
    let origin_m = middle(&list)?;
    let network_config = EndToEndConfig {
        regresses: config.regresses,
        town: config.town.clone(),
        origin_m,
        encoder: config.encoder.clone(),
    };
    let variables = VarStore::new(config.device);
    let network = EndToEnd::new(&variables.root(), &network_config)?;
    let mut optimizer = AdamW::new(&variables, AdamWConfig::default());
    let mut loader = examples(&list, config);
    let (mut step, mut skipped, mut window) = (0, 0, Vec::new());
    let share_done = |step: u64| {
        let epoch = (step * config.batch as u64) as f64 / list.len() as f64;
        config.length.share_done(step, epoch, started.elapsed().as_secs_f64())
    };
    while share_done(step) < 1.0 {
        let batch = loader.next_batch().ok_or(LocalizerTrainError::LoaderGone)??;
        step += 1;
        if batch.is_empty() {
            continue;
        }
        let (loss, error_m) = loss(&network, &batch, config)?;
        optimizer.zero_grad();
        loss.f_backward()?;
        let taken = optimizer.step(OneCycle { peak: config.learning_rate }.at(share_done(step)))?;
        skipped = if taken == Step::Skipped { skipped + 1 } else { 0 };
        if skipped >= MAX_SKIPPED {
            return Err(LocalizerTrainError::Diverged(skipped));
        }
        window.push(error_m);
        if step.is_multiple_of(REPORT_EVERY) {
            let error_m = window.iter().sum::<f64>() / window.len() as f64;
            window.clear();
            let seconds = started.elapsed().as_secs_f64();
            observe(&EndToEndReport { step, share_done: share_done(step).min(1.0), seconds, error_m });
        }
    }
    let about = BTreeMap::from([
        (CONFIG_KEY.to_owned(), serde_json::to_string(&network_config).expect("a configuration is JSON")),
        (KIND_KEY.to_owned(), EndToEndLocalizer::KIND.to_owned()),
        ("seed".to_owned(), config.seed.to_string()),
        ("steps".to_owned(), step.to_string()),
        ("data_sha256".to_owned(), list.listing_sha256.clone()),
    ]);
    let path = config.out.join("weights.safetensors");
    let sha256 = weights::save(&path, &variables, &about, weights::Precision::Half)?;
    Ok(EndToEndSummary { steps: step, seconds: started.elapsed().as_secs_f64(), weights: path, sha256 })
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

fn examples(list: &Arc<SweepList>, config: &EndToEndTrainConfig) -> Examples {
    let (list, encoder, seed, batch) = (Arc::clone(list), config.encoder.clone(), config.seed, config.batch as u64);
    Prefetch::start(config.loader_threads, 0, move |number| {
        let example = |index: u64| {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            rng.set_stream(index);
            let Some(stored) = list.read(rng.random_range(0..list.len()), encoder.range_m)? else { return Ok(None) };
            let turn = yaw(rng.random_range(-TURN_RAD..TURN_RAD));
            let keep = rng.random_range(0.7..1.0);
            let voxels = stored.turned_voxels(&turn, keep, &mut rng, &encoder);
            let rows = choose(voxels.cells(), CELLS, &mut rng);
            Ok(Some(Example { voxels, rows, world_from_sensor: stored.world_from_sensor * turn.inverse() }))
        };
        (number * batch..(number + 1) * batch).filter_map(|index| example(index).transpose()).collect()
    })
}

/// The loss and the mean L1 error in metres.
fn loss(
    network: &EndToEnd,
    batch: &[Example],
    config: &EndToEndTrainConfig,
) -> Result<(Tensor, f64), LocalizerTrainError> {
    let kind = config.precision.kind();
    let sweeps: Vec<&SweepVoxels> = batch.iter().map(|example| &example.voxels).collect();
    let voxels = VoxelBatch::new(&sweeps, network.encoder().config(), config.device)?;
    let local = network.encoder().local(&voxels, kind)?;
    let features = network.encoder().complete(&local, &voxels)?;
    let origin = Vector3::from(network.config().origin_m);
    let tensor =
        |values: &[f32], columns: i64| Tensor::f_from_slice(values)?.f_view([-1, columns])?.f_to_device(config.device);
    let l1 = |found: &Tensor, wanted: &Tensor| {
        (found - wanted).f_abs()?.f_sum_dim_intlist(1_i64, false, Kind::Float)?.f_mean(Kind::Float)
    };
    match config.regresses {
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
            let rows = Tensor::f_from_slice(&rows)?.f_to_device(config.device)?;
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
