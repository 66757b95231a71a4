//! Training of the competitors on the sweeps of one scene: the whole network from random weights, or its last layers on
//! the features of a frozen encoder.

mod features;
mod loss;
mod sweeps;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use tch::nn::VarStore;
use tch::{Tensor, no_grad};

use super::error::LocalizerTrainError;
use super::sweep_store::SweepList;
use localization::competitors::EndToEndLocalizer;
use localization::competitors::{EndToEnd, EndToEndConfig, EndToEndKind};
use localization::pgc::{LocalizerError, SceneEncoder, SceneEncoderConfig};
use perception::train::{RunConfig, Trained, Trainer};
use perception::weights::{CONFIG_KEY, KIND_KEY, Weights};

use features::Features;
use sweeps::Sweeps;

/// Steps between two reports.
const REPORT_EVERY: u64 = 10;
/// Steps between two checkpoints.
const CHECKPOINT_EVERY: u64 = 500;

/// Configuration of a training of a competitor.
#[derive(Debug, Clone)]
pub struct EndToEndTrainConfig {
    /// Folders of sweeps, all of one scene.
    pub scenes: Vec<PathBuf>,
    /// Target of the regression.
    pub regresses: EndToEndKind,
    /// Name of the scene.
    pub scene_name: String,
    /// Origin of the encoder's weights.
    pub encoder: EncoderStart,
    /// Training run; a batch are sweeps.
    pub run: RunConfig,
}

/// Origin of the encoder's weights.
#[derive(Debug, Clone)]
pub enum EncoderStart {
    /// Random weights, trained with the rest.
    Untrained(SceneEncoderConfig),
    /// Weights from this file, frozen.
    Frozen(PathBuf),
}

/// Progress of a training of a competitor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum EndToEndReport {
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
        /// Mean L1 error of a cell or a position since the last report, metres.
        error_m: f64,
    },
}

/// Source of the examples of the steps.
trait Examples {
    /// Centre of the positions, metres in the world.
    fn origin_m(&self) -> [f64; 3];

    /// Sample of the features, `[N, channels]`, if it is known before the first step.
    fn features(&self, regresses: EndToEndKind) -> Result<Option<Tensor>, LocalizerTrainError>;

    /// Starts with the batch of a step.
    fn begin(&mut self, step: u64);

    /// Loss of the next batch, and its mean L1 error in metres.
    fn next_loss(&mut self, network: &EndToEnd) -> Result<(Tensor, f64), LocalizerTrainError>;
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
    let (mut examples, encoder): (Box<dyn Examples>, _) = match &config.encoder {
        EncoderStart::Untrained(encoder) => (Box::new(Sweeps::new(&list, encoder, run)?), encoder.clone()),
        EncoderStart::Frozen(path) => {
            let (encoder, _) = SceneEncoder::load(path, run.device)?;
            (Box::new(Features::compute(&list, &encoder, run, observe)?), encoder.config().clone())
        }
    };
    let network_config = EndToEndConfig {
        regresses: config.regresses,
        scene_name: config.scene_name.clone(),
        origin_m: examples.origin_m(),
        encoder,
    };
    let variables = VarStore::new(run.device);
    let mut network = EndToEnd::new(&variables.root(), &network_config)?;
    if let Some(features) = examples.features(config.regresses)? {
        network.set_statistics(&features)?;
    }
    if let EncoderStart::Frozen(path) = &config.encoder {
        adopt_encoder(&variables, path, &network_config.encoder)?;
    }
    let mut trainer = Trainer::begin(run, &variables, None, started)?;
    examples.begin(trainer.steps());
    let mut window = Vec::new();
    let share_done = |trainer: &Trainer| {
        let sweeps = trainer.steps() * run.batch as u64;
        trainer.share_done(sweeps as f64 / list.len() as f64)
    };
    while share_done(&trainer) < 1.0 {
        let (loss, error_m) = examples.next_loss(&network)?;
        trainer.step(&loss, share_done(&trainer))?;
        trainer.check_interruption(&variables)?;
        window.push(error_m);
        let step = trainer.steps();
        if step.is_multiple_of(REPORT_EVERY) {
            let error_m = window.iter().sum::<f64>() / window.len() as f64;
            window.clear();
            let share_done = share_done(&trainer).min(1.0);
            observe(&EndToEndReport::Stepped { step, share_done, seconds: trainer.seconds(), error_m });
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

/// Gives the encoder below `variables` the weights of a file and freezes it.
fn adopt_encoder(variables: &VarStore, path: &Path, config: &SceneEncoderConfig) -> Result<(), LocalizerTrainError> {
    let stored = VarStore::new(variables.device());
    SceneEncoder::new(&stored.root(), config)?;
    Weights::load(path).and_then(|weights| weights.copy_into(&stored)).map_err(LocalizerError::from)?;
    let stored = stored.variables();
    for (name, mut variable) in variables.variables() {
        if let Some(source) = name.strip_prefix("encoder.").and_then(|name| stored.get(name)) {
            no_grad(|| variable.f_copy_(source))?;
            let _ = variable.f_set_requires_grad(false)?;
        }
    }
    Ok(())
}
