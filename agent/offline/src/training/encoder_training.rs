//! First stage: the encoder, over many scenes, on correspondences between overlapping sweeps. Trained once, then
//! frozen.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use tch::nn::VarStore;
use tch::{Device, Tensor, no_grad};

use super::contrast::{Contrast, EncoderAccuracy};
use super::pairs::{Pair, PairMaker};
use super::sweep_store::SweepStore;
use crate::Error;
use localization::pgc::{SceneEncoder, SceneEncoderConfig};
use perception::train::{
    Curve, Means, Observe, Prefetch, RunConfig, SaveEvery, Task, Trained, Trainer, TrainingEvent,
};

/// Number of pairs of a validation.
const VALIDATION_PAIRS: u64 = 24;

/// Configuration of a training of an encoder.
#[derive(Debug, Clone)]
pub struct EncoderTrainConfig {
    /// Folders of sweeps, one world each.
    pub scenes: Vec<PathBuf>,
    /// Folders of sweeps to validate on, one world each; none: no validation.
    pub validation: Vec<PathBuf>,
    /// Network.
    pub encoder: SceneEncoderConfig,
    /// Training run; a batch are pairs of sweeps.
    pub run: RunConfig,
    /// Steps between two validations and checkpoints.
    pub validate_every: u64,
}

/// Result of a training of an encoder.
#[derive(Debug, Clone)]
pub struct EncoderSummary {
    /// Weights, steps and time.
    pub trained: Trained,
    /// Number of training sweeps.
    pub sweeps: usize,
    /// The last validation.
    pub accuracy: Option<EncoderAccuracy>,
}

/// Trains an encoder; writes checkpoint, curve and weights into `config.run.out`. Reported are loss, share of cells that
/// find their match, and offset error in metres.
///
/// # Errors
/// [`Error`]; the last checkpoint stays.
pub fn train_encoder(
    config: &EncoderTrainConfig,
    observe: &mut Observe<'_>,
) -> Result<EncoderSummary, Error> {
    let run = &config.run;
    run.start()?;
    let variables = VarStore::new(run.device);
    let encoder = SceneEncoder::new(&(variables.root() / "encoder"), &config.encoder)?;
    let local_channels = config.encoder.local_channels();
    let contrast = Contrast::new(&(variables.root() / "contrast"), local_channels);
    let (maker, store) = read(&config.scenes, run.seed, &config.encoder, observe)?;
    let validation = match config.validation.as_slice() {
        [] => None,
        // Other random numbers than those of the training pairs.
        folders => Some(read(folders, u64::MAX - run.seed, &config.encoder, observe)?.0),
    };
    let trainer = Trainer::begin(run, &variables, None, Instant::now())?;
    let mut trainer = trainer.on_data(&store.data.sha256)?;
    let (batch, anchors) = (run.batch as u64, maker.anchors.len());
    let mut training = Training {
        config,
        observe,
        // Batches are numbered by steps: a resumed training goes on with the next one.
        loader: Prefetch::start(run.loader_threads, trainer.steps(), move |number| {
            let pairs = number * batch..(number + 1) * batch;
            pairs.map(|pair| maker.pair(pair)).collect()
        }),
        anchors,
        validation,
        encoder,
        contrast,
        curve: trainer.curve("step,seconds,loss,top1,offset_m")?,
        latest: [0.0; 3],
        means: Means::default(),
        accuracy: None,
    };
    trainer.run(&mut training, SaveEvery::Steps(config.validate_every))?;
    // Only the encoder is saved, under the names it is loaded by.
    let encoder = VarStore::new(Device::Cpu);
    SceneEncoder::new(&encoder.root(), &config.encoder)?;
    let trained = variables.variables();
    for (name, mut variable) in encoder.variables() {
        no_grad(|| variable.f_copy_(&trained[&format!("encoder.{name}")]))?;
    }
    let (kind, data) = (SceneEncoder::KIND, store.data.clone());
    Ok(EncoderSummary {
        trained: trainer.save_network(&encoder, kind, &config.encoder, data)?,
        sweeps: store.sweeps.len(),
        accuracy: training.accuracy,
    })
}

/// The sweeps of some folders, and the generator of their pairs.
fn read(
    folders: &[PathBuf],
    seed: u64,
    config: &SceneEncoderConfig,
    observe: &mut Observe<'_>,
) -> Result<(PairMaker, Arc<SweepStore>), Error> {
    let store = Arc::new(SweepStore::read(folders, config.range_m)?);
    observe(&TrainingEvent::Read(store.data.clone()));
    let maker = PairMaker::new(Arc::clone(&store), config.clone(), seed)?;
    Ok((maker, store))
}

struct Training<'a> {
    config: &'a EncoderTrainConfig,
    observe: &'a mut Observe<'a>,
    loader: Prefetch<Result<Vec<Pair>, Error>>,
    /// Number of sweeps that have a partner.
    anchors: usize,
    validation: Option<PairMaker>,
    encoder: SceneEncoder,
    contrast: Contrast,
    curve: Curve,
    /// Of the last step, as reported.
    latest: [f64; 3],
    means: Means<3>,
    accuracy: Option<EncoderAccuracy>,
}

impl Training<'_> {
    /// Loss, and its value with those of the accuracy.
    fn loss_of(&self, pairs: &[Pair]) -> Result<(Tensor, [f64; 3]), Error> {
        let (kind, device) = (self.config.run.precision.kind(), self.config.run.device);
        let (loss, accuracy) = self.contrast.loss(&self.encoder, pairs, kind, device)?;
        let value = loss.f_double_value(&[])?;
        Ok((loss, [value, accuracy.top1, accuracy.offset_m]))
    }
}

impl Task for Training<'_> {
    type Error = Error;
    const REPORT_EVERY: u64 = 10;

    fn epoch(&self, steps: u64) -> f64 {
        (steps * self.config.run.batch as u64) as f64 / self.anchors as f64
    }

    fn loss(&mut self, _: &Trainer) -> Result<Tensor, Error> {
        let pairs = self.loader.next_batch()??;
        let (loss, latest) = self.loss_of(&pairs)?;
        self.latest = latest;
        Ok(loss)
    }

    fn stepped(&mut self, _: &Trainer, is_taken: bool) -> Result<(), Error> {
        if is_taken {
            self.means.add(self.latest);
        }
        Ok(())
    }

    fn report(&mut self, trainer: &Trainer) -> Result<(), Error> {
        let means @ [loss, top1, offset_m] = self.means.take();
        let (step, seconds) = (trainer.steps() as f64, trainer.seconds());
        self.curve.numbers(&[step, seconds, loss, top1, offset_m])?;
        let top1 = 100.0 * top1;
        let text = format!("loss {loss:.3} top-1 {top1:.1} % offset {offset_m:.2} m");
        let report = trainer.step_report(self.share_done(trainer), means.into(), &text);
        (self.observe)(&report);
        Ok(())
    }

    fn validate(&mut self, trainer: &Trainer) -> Result<(), Error> {
        let Some(maker) = &self.validation else {
            return Ok(());
        };
        let mut means = Means::default();
        for number in 0..VALIDATION_PAIRS {
            // Two pairs together, as cells of another pair are negatives too.
            let pairs = [maker.pair(2 * number)?, maker.pair(2 * number + 1)?];
            means.add(no_grad(|| self.loss_of(&pairs))?.1);
        }
        let [_, top1, offset_m] = means.get();
        self.accuracy = Some(EncoderAccuracy { top1, offset_m });
        let (step, top1) = (trainer.steps(), 100.0 * top1);
        (self.observe)(&TrainingEvent::Validated(format!(
            "step {step}: validation top-1 {top1:.1} % offset {offset_m:.2} m"
        )));
        Ok(())
    }
}
