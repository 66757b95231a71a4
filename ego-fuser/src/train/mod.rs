//! Training of a method on recorded or generated scenes.
//!
//! [`run`] does no output of its own but files: whoever calls it hears of every step through [`Observer`].

mod card;
mod config;
mod curve;
mod error;
mod observer;
mod progress;
mod validation;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use agent::training::{AdamW, OneCycle, Step, checkpoint};
use agent::weights;

pub use config::{Length, TrainConfig};
pub use error::TrainError;
pub use observer::{Observer, StepReport, Summary};
pub use progress::Progress;
pub use validation::{Accuracy, Validator};

use self::curve::Curve;
use crate::loss::{LabelTensors, detection_loss};
use crate::method::Method;
use crate::model::{ComputePrecision, CooperativeModel};
use crate::samples::{Batch, Loader, LoaderConfig, SampleBuilder, SampleConfig, SampleError, SampleKind, SceneSet};

/// Steps between two readings of the loss: reading waits for the device.
const READ_EVERY: u64 = 10;
/// Losses that are not finite in a row before the training gives up.
const MAX_SKIPPED: u32 = 20;

/// Trains a method and writes checkpoint, curve (CSV and PNG), weights and model card into `config.out`.
///
/// # Errors
/// [`TrainError`]; the last checkpoint stays.
pub fn run(config: &TrainConfig, observer: &mut dyn Observer) -> Result<Summary, TrainError> {
    Training::prepare(config)?.run(observer)
}

/// The views that a method learns from.
fn sample_kind(method: Method) -> Result<SampleKind, TrainError> {
    match method {
        Method::None => Ok(SampleKind::Single),
        Method::Early => Ok(SampleKind::Merged),
        Method::Max | Method::Attention => Ok(SampleKind::Cooperative),
        Method::Late => Err(TrainError::NotTrained(method)),
    }
}

struct Training<'a> {
    config: &'a TrainConfig,
    model: CooperativeModel,
    optimizer: AdamW,
    schedule: OneCycle,
    scenes: Arc<SceneSet>,
    builder: SampleBuilder,
    validator: Option<Validator>,
    curve: Curve,
    progress: Progress,
    accuracy: Option<Accuracy>,
    started: Instant,
    seconds_before: f64,
}

impl<'a> Training<'a> {
    fn prepare(config: &'a TrainConfig) -> Result<Self, TrainError> {
        let samples = SampleConfig { kind: sample_kind(config.method)?, ..config.samples.clone() };
        std::fs::create_dir_all(&config.out).map_err(|source| TrainError::Io { path: config.out.clone(), source })?;
        tch::manual_seed(config.seed as i64);
        let mut model = match &config.init {
            Some(path) => CooperativeModel::load(path, Some(config.method), config.device)?,
            None => CooperativeModel::new(&config.detector, config.method, config.device)?,
        };
        model.set_precision(config.precision);
        let mut optimizer = AdamW::new(&model.variables, config.optimizer);
        let mut progress = Progress {
            step: 0,
            seconds: 0.0,
            seed: config.seed,
            batch: config.batch,
            method: config.method.name().to_owned(),
        };
        if config.resume {
            let stored = checkpoint::restore(&checkpoint_path(config), &model.variables, &mut optimizer)?;
            progress = same_training(progress, stored)?;
        }
        let scenes = Arc::new(SceneSet::open(&config.data)?);
        let assigner = Arc::new(model.assigner().map_err(SampleError::from)?);
        let builder = SampleBuilder::new(Arc::clone(&scenes), samples.clone(), model.config().clone(), assigner);
        let validator = match config.validation.as_slice() {
            [] => None,
            folders => Some(Validator::open(folders, &samples, &model, config.validation_frames)?),
        };
        let curve = Curve::open(&config.out.join("curve.csv"), config.resume)?;
        let schedule = OneCycle { peak: config.learning_rate };
        let seconds_before = progress.seconds;
        let started = Instant::now();
        let accuracy = None;
        Ok(Self {
            config,
            model,
            optimizer,
            schedule,
            scenes,
            builder,
            validator,
            curve,
            progress,
            accuracy,
            started,
            seconds_before,
        })
    }

    fn run(mut self, observer: &mut dyn Observer) -> Result<Summary, TrainError> {
        let loader = LoaderConfig {
            seed: self.config.seed,
            batch: self.config.batch,
            first_batch: self.progress.step,
            threads: self.config.loader_threads,
        };
        let mut loader = Loader::start(&self.builder, *self.model.network().lattice(), &loader);
        let mut window = Window::new();
        let mut skipped = 0;
        while self.share_done() < 1.0 {
            let asked = Instant::now();
            let batch = loader.next_batch()?;
            window.waited += asked.elapsed();
            let losses = self.step(&batch)?;
            skipped = if losses.is_some() { 0 } else { skipped + 1 };
            if skipped >= MAX_SKIPPED {
                return Err(TrainError::Diverged(skipped));
            }
            window.add(losses);
            self.progress.step += 1;
            if self.progress.step.is_multiple_of(READ_EVERY) {
                let report = self.report(&mut window);
                self.curve.step(&report)?;
                observer.stepped(&report);
            }
            if self.progress.step.is_multiple_of(self.config.validate_every) {
                self.validate(observer)?;
                self.checkpoint()?;
            }
        }
        if !self.progress.step.is_multiple_of(self.config.validate_every) {
            self.validate(observer)?;
            self.checkpoint()?;
        }
        self.finish()
    }

    /// One step; its losses, or nothing when the gradient was not finite.
    fn step(&mut self, batch: &Batch) -> Result<Option<[f64; 2]>, TrainError> {
        let pillars = batch.pillars.to_device(self.config.device);
        let labels = LabelTensors::gather(&batch.labels, self.config.loss.unassigned, self.config.device);
        let output = self.model.forward(&pillars, &batch.ego_from_cav, true)?;
        let loss = detection_loss(&output.scores, &output.offsets, &labels, &self.config.loss)?;
        self.optimizer.zero_grad();
        loss.total().f_backward()?;
        let learning_rate = self.schedule.at(self.share_done());
        match self.optimizer.step(learning_rate)? {
            Step::Taken(_) => Ok(Some([loss.score.f_double_value(&[])?, loss.boxes.f_double_value(&[])?])),
            Step::Skipped => Ok(None),
        }
    }

    fn seconds(&self) -> f64 {
        self.seconds_before + self.started.elapsed().as_secs_f64()
    }

    fn epoch(&self) -> f64 {
        (self.progress.step * self.config.batch as u64) as f64 / self.scenes.ticks().len() as f64
    }

    fn share_done(&self) -> f64 {
        match self.config.length {
            Length::Steps(steps) => self.progress.step as f64 / steps.max(1) as f64,
            Length::Epochs(epochs) => self.epoch() / epochs.max(f64::MIN_POSITIVE),
            Length::Time(limit) => self.seconds() / limit.as_secs_f64().max(f64::MIN_POSITIVE),
        }
    }

    fn report(&self, window: &mut Window) -> StepReport {
        let [score_loss, box_loss] = window.mean_losses();
        let seconds = window.since.elapsed().as_secs_f64().max(1e-9);
        let report = StepReport {
            step: self.progress.step,
            epoch: self.epoch(),
            progress: self.share_done().min(1.0),
            seconds: self.seconds(),
            learning_rate: self.schedule.at(self.share_done()),
            score_loss,
            box_loss,
            samples_per_second: (window.steps * self.config.batch) as f64 / seconds,
            waiting: window.waited.as_secs_f64() / seconds,
        };
        *window = Window::new();
        report
    }

    fn validate(&mut self, observer: &mut dyn Observer) -> Result<(), TrainError> {
        if let Some(validator) = &mut self.validator {
            self.model.set_precision(ComputePrecision::F32);
            let accuracy = validator.measure(&self.model);
            self.model.set_precision(self.config.precision);
            let accuracy = accuracy?;
            let seconds = self.seconds_before + self.started.elapsed().as_secs_f64();
            self.curve.validation(self.progress.step, seconds, &accuracy)?;
            self.draw_curve()?;
            observer.validated(self.progress.step, &accuracy);
            self.accuracy = Some(accuracy);
        }
        Ok(())
    }

    fn draw_curve(&self) -> Result<(), TrainError> {
        let Progress { method, seed, .. } = &self.progress;
        self.curve.draw(&format!("{method}, {} samples a step, seed {seed}", self.progress.batch))
    }

    fn checkpoint(&mut self) -> Result<(), TrainError> {
        self.progress.seconds = self.seconds();
        Ok(checkpoint::save(&checkpoint_path(self.config), &self.model.variables, &self.optimizer, &self.progress)?)
    }

    fn finish(self) -> Result<Summary, TrainError> {
        self.draw_curve()?;
        let weights = self.config.out.join("weights.safetensors");
        let data_sha256 = self.scenes.listing_sha256();
        let about = BTreeMap::from([
            ("seed".to_owned(), self.config.seed.to_string()),
            ("steps".to_owned(), self.progress.step.to_string()),
            ("data_sha256".to_owned(), data_sha256.clone()),
        ]);
        let sha256 = self.model.save(&weights, &about, weights::Precision::Half)?;
        let seconds = self.progress.seconds;
        let summary = Summary { steps: self.progress.step, seconds, accuracy: self.accuracy, weights, sha256 };
        let path = self.config.out.join("model-card.md");
        let card = card::text(self.config, &self.model, &self.scenes, &data_sha256, &summary);
        std::fs::write(&path, card).map_err(|source| TrainError::Io { path, source })?;
        Ok(summary)
    }
}

fn checkpoint_path(config: &TrainConfig) -> PathBuf {
    config.out.join("checkpoint.safetensors")
}

/// The stored progress, if it is of a training with the same seed, batch and method.
fn same_training(asked: Progress, stored: Progress) -> Result<Progress, TrainError> {
    let fields = [
        ("seed", stored.seed.to_string(), asked.seed.to_string()),
        ("batch", stored.batch.to_string(), asked.batch.to_string()),
        ("method", stored.method.clone(), asked.method.clone()),
    ];
    match fields.into_iter().find(|(_, found, asked)| found != asked) {
        Some((field, found, asked)) => Err(TrainError::OtherTraining { field, found, asked }),
        None => Ok(stored),
    }
}

/// What has happened since the last report.
struct Window {
    since: Instant,
    waited: Duration,
    steps: usize,
    losses: [f64; 2],
    finite: usize,
}

impl Window {
    fn new() -> Self {
        Self { since: Instant::now(), waited: Duration::ZERO, steps: 0, losses: [0.0; 2], finite: 0 }
    }

    fn add(&mut self, losses: Option<[f64; 2]>) {
        self.steps += 1;
        if let Some(losses) = losses {
            self.finite += 1;
            self.losses.iter_mut().zip(losses).for_each(|(sum, loss)| *sum += loss);
        }
    }

    fn mean_losses(&self) -> [f64; 2] {
        self.losses.map(|sum| sum / self.finite as f64)
    }
}
