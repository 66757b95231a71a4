//! Training of a method on recorded or generated scenes.
//!
//! [`run`] writes only files: the caller gets every step through [`Observer`].

mod accuracy;
mod card;
mod config;
mod curve;
mod frozen;
mod observer;
mod validation;

use std::sync::Arc;
use std::time::{Duration, Instant};

use perception::train::{ComputePrecision, Trainer};
use perception::weights::Weights;

pub use accuracy::Accuracy;
pub use config::TrainConfig;
pub use observer::{Observer, StepReport, Summary};
pub(crate) use validation::Validator;

use self::curve::DetectorCurve;
use crate::Error;
use crate::loss::{LabelTensors, alignment_loss, detection_loss};
use crate::samples::{Batch, SampleBuilder, SampleConfig, SampleKind, SceneSet, batches};
use fusion::method::{Exchange, Method};
use fusion::model::{CooperativeModel, ModelError};

/// Steps between two readings of the loss: reading waits for the device.
const READ_EVERY: u64 = 10;
/// Trains a method and writes checkpoint, curve (CSV and PNG), weights and model card into `config.run.out`.
///
/// # Errors
/// [`Error`]; the last checkpoint stays.
pub fn run(config: &TrainConfig, observer: &mut dyn Observer) -> Result<Summary, Error> {
    Training::prepare(config, observer)?.run(observer)
}

/// The views that a method is trained on; `is_frozen`: its encoder is frozen, `is_ego_only`: ego-only training.
fn sample_kind(method: Method, is_frozen: bool, is_ego_only: bool) -> Result<SampleKind, Error> {
    match method.exchange() {
        Exchange::Nothing => Ok(SampleKind::Single),
        Exchange::Points if is_frozen => Err(Error::NothingToKeep(method)),
        Exchange::Points | Exchange::Features if is_ego_only => Ok(SampleKind::Single),
        Exchange::Points => Ok(SampleKind::Merged),
        Exchange::Features => Ok(SampleKind::Cooperative),
        Exchange::Boxes => Err(Error::NotTrained(method)),
    }
}

/// The initial model of a training.
fn first_model(config: &TrainConfig) -> Result<CooperativeModel, Error> {
    let TrainConfig {
        method,
        run,
        fusion,
        ..
    } = config;
    Ok(match (&config.init, fusion) {
        (Some(path), fusion) => {
            let weights = Weights::load(path).map_err(ModelError::from)?;
            CooperativeModel::from_weights(&weights, Some(*method), fusion.as_ref(), run.device)?
        }
        (None, Some(fusion)) => {
            CooperativeModel::with_fusion(&config.detector, *method, fusion, run.device)?
        }
        (None, None) => CooperativeModel::new(&config.detector, *method, run.device)?,
    })
}

struct Training<'a> {
    config: &'a TrainConfig,
    model: CooperativeModel,
    trainer: Trainer,
    scenes: Arc<SceneSet>,
    builder: SampleBuilder,
    validator: Option<Validator>,
    curve: DetectorCurve,
    accuracy: Option<Accuracy>,
}

impl<'a> Training<'a> {
    fn prepare(config: &'a TrainConfig, observer: &mut dyn Observer) -> Result<Self, Error> {
        let kind = sample_kind(
            config.method,
            config.frozen_encoder.is_some(),
            config.samples.merged_truth,
        )?;
        let run = &config.run;
        run.start()?;
        let mut model = first_model(config)?;
        let frozen = frozen::FrozenEncoder::of(config, &model)?;
        let samples = SampleConfig {
            kind,
            ..frozen::sample_config(config, &model)
        };
        samples.poses.validate()?;
        model.set_precision(run.precision);
        let scenes = Arc::new(SceneSet::open(
            &config.data,
            &config.open,
            &config.protocol,
        )?);
        let assigner = Arc::new(model.assigner()?);
        let mut builder = SampleBuilder::new(
            Arc::clone(&scenes),
            samples.clone(),
            model.config().clone(),
            assigner,
        );
        let mut validator = match config.validation.as_slice() {
            [] => None,
            folders => {
                let scenes = SceneSet::open(folders, &config.open, &config.protocol)?;
                Some(Validator::open(
                    scenes,
                    &samples,
                    &model,
                    config.validation_frames,
                )?)
            }
        };
        if let Some(frozen) = &frozen {
            builder = builder.with_maps(frozen.maps(&scenes, observer)?);
            if let Some(validator) = &mut validator {
                validator.use_maps(frozen.maps(validator.scenes(), observer)?);
            }
        }
        let trainer = Trainer::begin(
            run,
            &model.variables,
            Some(config.method.name()),
            Instant::now(),
        )?;
        let curve = DetectorCurve::open(&trainer)?;
        Ok(Self {
            config,
            model,
            trainer,
            scenes,
            builder,
            validator,
            curve,
            accuracy: None,
        })
    }

    fn run(mut self, observer: &mut dyn Observer) -> Result<Summary, Error> {
        observer.opened(&self.scenes.data());
        let pillar_grid = *self.model.network().pillar_grid();
        let mut loader = batches(
            &self.builder,
            pillar_grid,
            &self.config.run,
            self.trainer.steps(),
        );
        let mut window = Window::new();
        while self.share_done() < 1.0 {
            let asked = Instant::now();
            let batch = loader.next_batch()??;
            window.waited += asked.elapsed();
            window.add(self.step(&batch)?);
            self.trainer.check_interruption(&self.model.variables)?;
            if self.trainer.steps().is_multiple_of(READ_EVERY) {
                let report = self.report(&mut window);
                self.curve.step(&report)?;
                observer.stepped(&report);
            }
            if self
                .trainer
                .steps()
                .is_multiple_of(self.config.validate_every)
            {
                self.look_back(observer)?;
            }
        }
        if !self
            .trainer
            .steps()
            .is_multiple_of(self.config.validate_every)
        {
            self.look_back(observer)?;
        }
        self.finish()
    }

    /// One step; its losses, or `None` when the gradient was not finite.
    fn step(&mut self, batch: &Batch) -> Result<Option<[f64; 2]>, Error> {
        let device = self.config.run.device;
        let labels = LabelTensors::gather(&batch.labels, self.config.loss.unassigned, device);
        let output = batch.output(&self.model, true)?;
        let loss = detection_loss(
            &output.head.scores,
            &output.head.offsets,
            &labels,
            &self.config.loss,
        )?;
        let share_done = self.share_done();
        let total = match self.config.loss.alignment_weight {
            weight if weight > 0.0 => {
                loss.total() + alignment_loss(&output.corrections, &batch.offsets)? * weight
            }
            _ => loss.total(),
        };
        Ok(match self.trainer.step(&total, share_done)? {
            true => Some([
                loss.score.f_double_value(&[])?,
                loss.boxes.f_double_value(&[])?,
            ]),
            false => None,
        })
    }

    fn epoch(&self) -> f64 {
        (self.trainer.steps() * self.config.run.batch as u64) as f64
            / self.scenes.ticks().len() as f64
    }

    fn share_done(&self) -> f64 {
        self.trainer.share_done(self.epoch())
    }

    fn report(&self, window: &mut Window) -> StepReport {
        let [score_loss, box_loss] = window.mean_losses();
        let seconds = window.since.elapsed().as_secs_f64().max(1e-9);
        let report = StepReport {
            step: self.trainer.steps(),
            epoch: self.epoch(),
            progress: self.share_done().min(1.0),
            seconds: self.trainer.seconds(),
            learning_rate: self.trainer.learning_rate(self.share_done()),
            score_loss,
            box_loss,
            samples_per_second: (window.steps * self.config.run.batch) as f64 / seconds,
            waiting: window.waited.as_secs_f64() / seconds,
        };
        *window = Window::new();
        report
    }

    /// Validation and checkpoint.
    fn look_back(&mut self, observer: &mut dyn Observer) -> Result<(), Error> {
        if let Some(validator) = &mut self.validator {
            self.model.set_precision(ComputePrecision::F32);
            let accuracy = validator.measure(&self.model);
            self.model.set_precision(self.config.run.precision);
            let (accuracy, step) = (accuracy?, self.trainer.steps());
            self.curve
                .validation(step, self.trainer.seconds(), &accuracy)?;
            self.draw_curve()?;
            observer.validated(step, &accuracy);
            self.accuracy = Some(accuracy);
        }
        Ok(self.trainer.checkpoint(&self.model.variables)?)
    }

    fn draw_curve(&self) -> Result<(), Error> {
        let TrainConfig { method, run, .. } = self.config;
        self.curve.draw(&format!(
            "{method}, {} samples a step, seed {}",
            run.batch, run.seed
        ))
    }

    fn finish(self) -> Result<Summary, Error> {
        self.draw_curve()?;
        let Self {
            config,
            model,
            scenes,
            accuracy,
            ..
        } = &self;
        let trained = self
            .trainer
            .save_weights(&model.variables, model.about(), scenes.data())?;
        let summary = Summary {
            trained,
            accuracy: *accuracy,
        };
        card::card(config, model, scenes, &summary).write(&config.run.out)?;
        Ok(summary)
    }
}

/// Progress since the last report.
struct Window {
    since: Instant,
    waited: Duration,
    steps: usize,
    losses: [f64; 2],
    finite: usize,
}

impl Window {
    fn new() -> Self {
        Self {
            since: Instant::now(),
            waited: Duration::ZERO,
            steps: 0,
            losses: [0.0; 2],
            finite: 0,
        }
    }

    fn add(&mut self, losses: Option<[f64; 2]>) {
        self.steps += 1;
        if let Some(losses) = losses {
            self.finite += 1;
            self.losses
                .iter_mut()
                .zip(losses)
                .for_each(|(sum, loss)| *sum += loss);
        }
    }

    fn mean_losses(&self) -> [f64; 2] {
        self.losses.map(|sum| sum / self.finite as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn merged_points_are_not_learnt_from_behind_a_frozen_encoder() {
        assert!(
            matches!(sample_kind(Method::EARLY, true, false), Err(Error::NothingToKeep(method)) if method == Method::EARLY)
        );
        assert_eq!(
            sample_kind(Method::EARLY, false, false).unwrap(),
            SampleKind::Merged
        );
        assert_eq!(
            sample_kind(Method::MAX, true, false).unwrap(),
            SampleKind::Cooperative
        );
    }

    #[test]
    fn ego_only_every_method_that_is_trained_learns_from_single_vehicles() {
        for method in [Method::NONE, Method::EARLY, Method::MAX, Method::PASTAT] {
            assert_eq!(
                sample_kind(method, false, true).unwrap(),
                SampleKind::Single,
                "{method}"
            );
        }
        assert!(
            matches!(sample_kind(Method::LATE, false, true), Err(Error::NotTrained(method)) if method == Method::LATE)
        );
    }
}
