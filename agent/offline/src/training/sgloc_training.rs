//! Training of SGLoc's head on the sweeps of one scene: cells drawn at random from the cached features of a frozen encoder.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use tch::nn::VarStore;
use tch::{Kind, Tensor, no_grad};

use super::{CELLS, FeatureCache, SweepAugmentation, SweepList};
use crate::Error;
use localization::baselines::sgloc::{SgLoc, SgLocConfig, SgLocLocalizer};
use localization::pgc::{CellEncoder, LocalizerError, SceneEncoder, SceneEncoderConfig};
use perception::train::{Means, Observe, RunConfig, SaveEvery, Task, Trained, Trainer};
use perception::weights::Weights;

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

/// Trains a head; writes checkpoint and weights into `config.run.out`. Reported is the L1 error of a cell, metres.
///
/// # Errors
/// [`Error`].
pub fn train_sgloc(config: &SgLocTrainConfig, observe: &mut Observe<'_>) -> Result<Trained, Error> {
    let started = Instant::now();
    let run = &config.run;
    run.start()?;
    let list = Arc::new(SweepList::open(&config.scenes)?);
    let encoder = SceneEncoder::load(&config.encoder, run.device)?;
    let encoder_config = encoder.config().clone();
    let encoder = CellEncoder::sparse(encoder, run.device);
    let cache = FeatureCache::build(&list, &encoder, SweepAugmentation::NONE, run, observe)?;
    let network_config = SgLocConfig {
        scene_name: config.scene_name.clone(),
        origin_m: cache.origin_m,
        encoder: encoder_config,
    };
    let variables = VarStore::new(run.device);
    let mut network = SgLoc::new(&variables.root(), &network_config)?;
    let sample = cache.drawn_rows(run.seed, 0, STATISTICS_CELLS)?;
    network.set_statistics(&cache.cells.f_index_select(0, &sample)?)?;
    adopt_encoder(&variables, &config.encoder, &network_config.encoder)?;
    let trainer = Trainer::begin(run, &variables, None, started)?;
    let mut trainer = trainer.on_data(&list.data().sha256)?;
    let mut training = SgLocTraining {
        run,
        observe,
        sweeps: list.len(),
        cache,
        network,
        means: Means::default(),
    };
    trainer.run(&mut training, SaveEvery::Steps(CHECKPOINT_EVERY))?;
    let kind = SgLocLocalizer::KIND;
    Ok(trainer.save_network(&variables, kind, &network_config, list.data())?)
}

struct SgLocTraining<'a> {
    run: &'a RunConfig,
    observe: &'a mut Observe<'a>,
    sweeps: usize,
    cache: FeatureCache,
    network: SgLoc,
    means: Means<1>,
}

impl Task for SgLocTraining<'_> {
    type Error = Error;
    const REPORT_EVERY: u64 = 10;

    fn epoch(&self, steps: u64) -> f64 {
        (steps * self.run.batch as u64) as f64 / self.sweeps as f64
    }

    /// Mean L1 error of the scene coordinates of some cells, metres, the sum of its axes as in SGLoc.
    fn loss(&mut self, trainer: &Trainer) -> Result<Tensor, Error> {
        let wanted = self.run.batch * CELLS;
        let cache = &self.cache;
        let rows = cache.drawn_rows(self.run.seed, trainer.steps(), wanted)?;
        let cells = cache.cells.f_index_select(0, &rows)?;
        let sensor_m = cache.sensor_m.f_index_select(0, &rows)?;
        let kind = self.run.precision.kind();
        let found_m = self.network.coordinates(&cells, &sensor_m, kind, true)?;
        let error_m = (found_m - cache.targets_m.f_index_select(0, &rows)?).f_abs()?;
        let error_m = error_m.f_sum_dim_intlist(1_i64, false, Kind::Float)?;
        let loss = error_m.f_mean(Kind::Float)?;
        self.means.add([loss.f_double_value(&[])?]);
        Ok(loss)
    }

    fn report(&mut self, trainer: &Trainer) -> Result<(), Error> {
        let [error_m] = self.means.take();
        let (share_done, text) = (self.share_done(trainer), format!("error {error_m:.2} m"));
        (self.observe)(&trainer.step_report(share_done, vec![error_m], &text));
        Ok(())
    }
}

/// Gives the encoder below `variables` the weights of a file and freezes it.
pub(super) fn adopt_encoder(
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
