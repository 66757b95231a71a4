//! Training of SGLoc's head on the sweeps of one scene: cells drawn at random from the cached features of a frozen encoder.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tch::nn::VarStore;
use tch::{Device, Kind, TchError, Tensor, no_grad};

use super::{CELLS, FeatureCache, SweepAugmentation, SweepList};
use crate::Error;
use localization::baselines::sgloc::{SgLoc, SgLocConfig, SgLocLocalizer};
use localization::pgc::{CellEncoder, LocalizerError, SceneEncoder, SceneEncoderConfig};
use perception::train::{RunConfig, Trained, Trainer};
use perception::weights::Weights;

/// Steps between two reports.
const REPORT_EVERY: u64 = 10;
/// Steps between two checkpoints.
const CHECKPOINT_EVERY: u64 = 500;
/// Number of cells that statistics are computed from.
const STATISTICS_CELLS: usize = 20_000;

/// Configuration of a training of SGLoc's head.
#[derive(Debug, Clone)]
pub struct SgLocTrainConfig {
    /// Folders of sweeps, all of one scene.
    pub scenes: Vec<PathBuf>,
    /// Name of the scene.
    pub scene_name: String,
    /// Weights of the frozen encoder.
    pub encoder: PathBuf,
    /// Training run; a batch are sweeps, of 400 cells each.
    pub run: RunConfig,
}

/// Progress of a training of SGLoc's head.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum SgLocReport {
    /// Sweeps are being encoded: number done and number of all.
    Encoding(usize, usize),
    /// Some steps are done.
    Stepped {
        /// Number of steps done.
        step: u64,
        /// Share of the training that is done, 0..1.
        share_done: f64,
        /// Seconds spent.
        seconds: f64,
        /// Mean L1 error of a cell since the last report, metres.
        error_m: f64,
    },
}

/// Trains a head; writes checkpoint and weights into `config.run.out`.
///
/// # Errors
/// [`Error`].
pub fn train_sgloc(
    config: &SgLocTrainConfig,
    observe: &mut dyn FnMut(&SgLocReport),
) -> Result<Trained, Error> {
    let started = Instant::now();
    let run = &config.run;
    run.start()?;
    let list = Arc::new(SweepList::open(&config.scenes)?);
    let (encoder, _) = SceneEncoder::load(&config.encoder, run.device)?;
    let encoder_config = encoder.config().clone();
    let encoder = CellEncoder::sparse(encoder, run.device);
    let mut encoded = |done, total| observe(&SgLocReport::Encoding(done, total));
    let cache = FeatureCache::build(&list, &encoder, SweepAugmentation::NONE, run, &mut encoded)?;
    let network_config = SgLocConfig {
        scene_name: config.scene_name.clone(),
        origin_m: cache.origin_m,
        encoder: encoder_config,
    };
    let variables = VarStore::new(run.device);
    let mut network = SgLoc::new(&variables.root(), &network_config)?;
    let draw = Draw {
        seed: run.seed,
        cells: cache.cell_count(),
        device: run.device,
    };
    let sample = draw.rows(0, STATISTICS_CELLS)?;
    network.set_statistics(&cache.cells.f_index_select(0, &sample)?)?;
    adopt_encoder(&variables, &config.encoder, &network_config.encoder)?;
    let mut trainer = Trainer::begin(run, &variables, None, started)?;
    let mut window = Vec::new();
    let share_done = |trainer: &Trainer| {
        trainer.share_done((trainer.steps() * run.batch as u64) as f64 / list.len() as f64)
    };
    while share_done(&trainer) < 1.0 {
        let rows = draw.rows(trainer.steps(), run.batch * CELLS)?;
        let loss = coordinate_loss(&network, &cache, &rows, run.precision.kind())?;
        window.push(loss.f_double_value(&[])?);
        trainer.step(&loss, share_done(&trainer))?;
        trainer.check_interruption(&variables)?;
        let step = trainer.steps();
        if trainer.is_report_due(REPORT_EVERY) {
            let error_m = window.iter().sum::<f64>() / window.len() as f64;
            window.clear();
            let share_done = share_done(&trainer).min(1.0);
            observe(&SgLocReport::Stepped {
                step,
                share_done,
                seconds: trainer.seconds(),
                error_m,
            });
        }
        if step.is_multiple_of(CHECKPOINT_EVERY) {
            trainer.checkpoint(&variables)?;
        }
    }
    trainer.checkpoint(&variables)?;
    Ok(trainer.save_network(
        &variables,
        SgLocLocalizer::KIND,
        &network_config,
        list.data(),
    )?)
}

/// Random rows of a cache.
struct Draw {
    seed: u64,
    cells: i64,
    device: Device,
}

impl Draw {
    /// `[wanted]` rows, the same for the same step.
    fn rows(&self, step: u64, wanted: usize) -> Result<Tensor, TchError> {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(step);
        let rows: Vec<i64> = (0..wanted)
            .map(|_| rng.random_range(0..self.cells))
            .collect();
        Tensor::f_from_slice(&rows)?.f_to_device(self.device)
    }
}

/// Mean L1 error of the scene coordinates of some cells, metres, the sum of its axes as in SGLoc.
fn coordinate_loss(
    network: &SgLoc,
    cache: &FeatureCache,
    rows: &Tensor,
    kind: Kind,
) -> Result<Tensor, TchError> {
    let cells = cache.cells.f_index_select(0, rows)?;
    let sensor_m = cache.sensor_m.f_index_select(0, rows)?;
    let found_m = network.coordinates(&cells, &sensor_m, kind, true)?;
    let error_m = (found_m - cache.targets_m.f_index_select(0, rows)?).f_abs()?;
    error_m
        .f_sum_dim_intlist(1_i64, false, Kind::Float)?
        .f_mean(Kind::Float)
}

/// Gives the encoder below `variables` the weights of a file and freezes it.
fn adopt_encoder(
    variables: &VarStore,
    path: &Path,
    config: &SceneEncoderConfig,
) -> Result<(), Error> {
    let stored = VarStore::new(variables.device());
    SceneEncoder::new(&stored.root(), config)?;
    Weights::load(path)
        .and_then(|weights| weights.copy_into(&stored))
        .map_err(LocalizerError::from)?;
    let stored = stored.variables();
    for (name, mut variable) in variables.variables() {
        let of_encoder = name.strip_prefix("encoder.");
        if let Some(source) = of_encoder.and_then(|name| stored.get(name)) {
            no_grad(|| variable.f_copy_(source))?;
            let _ = variable.f_set_requires_grad(false)?;
        }
    }
    Ok(())
}
