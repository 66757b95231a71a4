//! First stage: the encoder, over many scenes, on correspondences between overlapping sweeps. Trained once, then
//! frozen.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use serde::Serialize;
use tch::nn::VarStore;
use tch::{Device, no_grad};

use super::contrast::{Contrast, ContrastLoss};
use super::pairs::{Pair, PairMaker};
use super::sweep_store::SweepStore;
use crate::Error;
use localization::pgc::{SceneEncoder, SceneEncoderConfig};
use perception::train::{Curve, DataListing, Prefetch, RunConfig, Trained, Trainer};

/// Number of pairs of a validation.
const VALIDATION_PAIRS: u64 = 24;
/// Steps between two reports.
const REPORT_EVERY: u64 = 10;

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

/// Accuracy of the matching of cells.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct EncoderAccuracy {
    /// Share of cells whose most similar candidate is their match.
    pub top1: f64,
    /// Mean L1 error of the offset between two views of one spot, metres.
    pub offset_m: f64,
}

/// Progress of a training of an encoder.
#[derive(Debug, Clone, PartialEq)]
pub enum EncoderReport {
    /// Sweeps to learn from or to validate on have been read.
    Read(DataListing),
    /// Some steps are done.
    Stepped {
        /// Steps done.
        step: u64,
        /// Share of the training that is done, 0..1.
        share_done: f64,
        /// Seconds spent so far.
        seconds: f64,
        /// Mean loss since the last report.
        loss: f64,
        /// Mean accuracy on the training pairs since the last report.
        accuracy: EncoderAccuracy,
    },
    /// A validation is done, after so many steps.
    Validated(u64, EncoderAccuracy),
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

/// Trains an encoder; writes checkpoint, curve and weights into `config.run.out`.
///
/// # Errors
/// [`Error`]; the last checkpoint stays.
pub fn train_encoder(
    config: &EncoderTrainConfig,
    observe: &mut dyn FnMut(&EncoderReport),
) -> Result<EncoderSummary, Error> {
    let mut training = Training::prepare(config, observe)?;
    let maker = training.maker.clone();
    let batch = config.run.batch as u64;
    let mut loader = Prefetch::start(
        config.run.loader_threads,
        training.trainer.steps(),
        move |number| {
            (number * batch..(number + 1) * batch)
                .map(|pair| maker.pair(pair))
                .collect::<Result<Vec<_>, _>>()
        },
    );
    let mut window = Window::default();
    while training.share_done() < 1.0 {
        training.step(&loader.next_batch()??, &mut window)?;
        training.trainer.check_interruption(&training.variables)?;
        let step = training.trainer.steps();
        if training.trainer.is_report_due(REPORT_EVERY) {
            observe(&training.report(std::mem::take(&mut window))?);
        }
        if step.is_multiple_of(config.validate_every) || training.share_done() >= 1.0 {
            if let Some(accuracy) = training.validate()? {
                observe(&EncoderReport::Validated(step, accuracy));
            }
            training.trainer.checkpoint(&training.variables)?;
        }
    }
    training.finish()
}

struct Training<'a> {
    config: &'a EncoderTrainConfig,
    store: Arc<SweepStore>,
    maker: PairMaker,
    validation: Option<PairMaker>,
    variables: VarStore,
    encoder: SceneEncoder,
    contrast: Contrast,
    trainer: Trainer,
    accuracy: Option<EncoderAccuracy>,
    curve: Curve,
}

impl<'a> Training<'a> {
    fn prepare(
        config: &'a EncoderTrainConfig,
        observe: &mut dyn FnMut(&EncoderReport),
    ) -> Result<Self, Error> {
        let run = &config.run;
        run.start()?;
        let variables = VarStore::new(run.device);
        let encoder = SceneEncoder::new(&(variables.root() / "encoder"), &config.encoder)?;
        let contrast = Contrast::new(
            &(variables.root() / "contrast"),
            config.encoder.local_channels(),
        );
        let mut maker = |folders: &[PathBuf], seed| {
            let store = Arc::new(SweepStore::read(folders, config.encoder.range_m)?);
            observe(&EncoderReport::Read(store.data.clone()));
            Ok::<_, Error>((
                PairMaker::new(Arc::clone(&store), config.encoder.clone(), seed)?,
                store,
            ))
        };
        let (training, store) = maker(&config.scenes, run.seed)?;
        let validation = match config.validation.as_slice() {
            [] => None,
            folders => Some(maker(folders, u64::MAX - run.seed)?.0),
        };
        let trainer = Trainer::begin(run, &variables, None, Instant::now())?;
        Ok(Self {
            config,
            store,
            maker: training,
            validation,
            variables,
            encoder,
            contrast,
            curve: trainer.curve("step,seconds,loss,top1,offset_m")?,
            trainer,
            accuracy: None,
        })
    }

    fn share_done(&self) -> f64 {
        let pairs = self.trainer.steps() * self.config.run.batch as u64;
        self.trainer
            .share_done(pairs as f64 / self.maker.anchors() as f64)
    }

    fn loss(&self, pairs: &[Pair]) -> Result<ContrastLoss, tch::TchError> {
        let RunConfig {
            precision, device, ..
        } = self.config.run;
        self.contrast
            .loss(&self.encoder, pairs, precision.kind(), device)
    }

    fn step(&mut self, pairs: &[Pair], window: &mut Window) -> Result<(), Error> {
        let loss = self.loss(pairs)?;
        if self.trainer.step(&loss.total, self.share_done())? {
            window.add(&loss)?;
        }
        Ok(())
    }

    /// Report of the steps of `window`, also appended to the curve.
    fn report(&mut self, window: Window) -> Result<EncoderReport, Error> {
        let (loss, accuracy) = window.means();
        let (step, seconds) = (self.trainer.steps(), self.trainer.seconds());
        self.curve
            .numbers(&[step as f64, seconds, loss, accuracy.top1, accuracy.offset_m])?;
        let share_done = self.share_done().min(1.0);
        Ok(EncoderReport::Stepped {
            step,
            share_done,
            seconds,
            loss,
            accuracy,
        })
    }

    fn validate(&mut self) -> Result<Option<EncoderAccuracy>, Error> {
        let Some(maker) = &self.validation else {
            return Ok(None);
        };
        let mut window = Window::default();
        for number in 0..VALIDATION_PAIRS {
            let pairs = [maker.pair(2 * number)?, maker.pair(2 * number + 1)?];
            let loss = no_grad(|| self.loss(&pairs))?;
            window.add(&loss)?;
        }
        self.accuracy = Some(window.means().1);
        Ok(self.accuracy)
    }

    fn finish(self) -> Result<EncoderSummary, Error> {
        // Only the encoder is saved, under the names it is loaded by.
        let encoder = VarStore::new(Device::Cpu);
        SceneEncoder::new(&encoder.root(), &self.config.encoder)?;
        let trained = self.variables.variables();
        for (name, mut variable) in encoder.variables() {
            no_grad(|| variable.f_copy_(&trained[&format!("encoder.{name}")]))?;
        }
        Ok(EncoderSummary {
            trained: self.trainer.save_network(
                &encoder,
                SceneEncoder::KIND,
                &self.config.encoder,
                self.store.data.clone(),
            )?,
            sweeps: self.store.sweeps.len(),
            accuracy: self.accuracy,
        })
    }
}

/// Sums since the last report.
#[derive(Default)]
struct Window {
    steps: usize,
    loss: f64,
    top1: f64,
    offset_m: f64,
}

impl Window {
    fn add(&mut self, loss: &ContrastLoss) -> Result<(), tch::TchError> {
        self.steps += 1;
        self.loss += loss.total.f_double_value(&[])?;
        self.top1 += loss.top1;
        self.offset_m += loss.offset_m;
        Ok(())
    }

    /// Mean loss and accuracy.
    fn means(&self) -> (f64, EncoderAccuracy) {
        let mean = |sum: f64| sum / self.steps.max(1) as f64;
        (
            mean(self.loss),
            EncoderAccuracy {
                top1: mean(self.top1),
                offset_m: mean(self.offset_m),
            },
        )
    }
}
