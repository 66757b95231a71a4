//! Training of a method on recorded or generated scenes.
//!
//! [`run`] writes only files: the caller gets every step through [`Observe`].

mod card;
mod config;
mod curve;
mod frozen;
mod validation;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use perception::compute_precision::ComputePrecision;
use perception::int8::SCALES_KEY;
use perception::train::{Observe, Prefetch, SaveEvery, Task, Trained, Trainer, TrainingEvent};
use perception::weights::Weights;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use tch::Tensor;

pub use config::TrainConfig;
pub use validation::Accuracy;
pub(crate) use validation::Validator;

use self::curve::{DetectorCurve, TrainingReport};
use crate::loss::{LabelTensors, Loss, alignment_loss, detection_loss};
use crate::samples::{Batch, SampleBuilder, SampleConfig, SampleKind, SceneSet, batches};
use crate::{Error, Result};
use fusion::method::{Exchange, Method};
use fusion::model::{CooperativeModel, ModelError};

/// Result of a training.
#[derive(Debug, Clone)]
pub struct TrainSummary {
    /// The weights and the cost of the training.
    pub trained: Trained,
    /// The last validation.
    pub accuracy: Option<Accuracy>,
}

/// Trains a method and writes checkpoint, curve (CSV and PNG), weights and model card into `config.run.out`.
///
/// # Errors
/// [`Error`]; the last checkpoint stays.
pub fn run(config: &TrainConfig, observe: &mut Observe<'_>) -> Result<TrainSummary> {
    let (mut training, mut trainer) = FusionTraining::prepare(config, observe)?;
    trainer.run(&mut training, SaveEvery::Steps(config.validate_every))?;
    training.finish(&trainer)
}

/// The views that a method is trained on; `is_frozen`: its encoder is frozen, `is_ego_only`: ego-only training.
fn sample_kind(method: Method, is_frozen: bool, is_ego_only: bool) -> Result<SampleKind> {
    match method.exchange() {
        Exchange::Nothing => Ok(SampleKind::Single),
        Exchange::Points if is_frozen => Err(Error::NothingToKeep(method)),
        Exchange::Points | Exchange::Features if is_ego_only => Ok(SampleKind::Single),
        Exchange::Points => Ok(SampleKind::Merged),
        Exchange::Features => Ok(SampleKind::Cooperative),
        Exchange::Boxes => Err(Error::NotTrained(method)),
    }
}

struct FusionTraining<'a> {
    config: &'a TrainConfig,
    observe: &'a mut Observe<'a>,
    model: CooperativeModel,
    scenes: Arc<SceneSet>,
    loader: Prefetch<Result<Batch>>,
    validator: Option<Validator>,
    curve: DetectorCurve,
    /// Terms of the loss of the step in progress.
    terms: Option<Loss>,
    window: Window,
    accuracy: Option<Accuracy>,
}

impl<'a> FusionTraining<'a> {
    fn prepare(config: &'a TrainConfig, observe: &'a mut Observe<'_>) -> Result<(Self, Trainer)> {
        let (is_frozen, merged) = (config.frozen_encoder.is_some(), config.samples.merged_truth);
        let kind = sample_kind(config.method, is_frozen, merged)?;
        let run = &config.run;
        // Seeds the tensor library: before the first variable is made.
        run.start()?;
        let (detector, method, device) = (&config.detector, config.method, config.run.device);
        let mut model = match (&config.init, &config.fusion) {
            (Some(path), fusion) => {
                let weights = Weights::load(path).map_err(ModelError::from)?;
                CooperativeModel::from_weights(&weights, Some(method), fusion.as_ref(), device)?
            }
            (None, Some(fusion)) => {
                CooperativeModel::with_fusion(detector, method, fusion, device)?
            }
            (None, None) => CooperativeModel::new(detector, method, device)?,
        };
        let frozen = frozen::FrozenEncoder::of(config, &model)?;
        // Before the optimizer is made, which takes the variables that are trained by then.
        if config.box_input {
            model.train_box_input_only()?;
        }
        let samples = SampleConfig {
            kind,
            ..frozen::sample_config(config, &model)
        };
        samples.poses.validate()?;
        model.set_precision(run.precision);
        let (options, protocol) = (&config.open, &config.protocol);
        let scenes = Arc::new(SceneSet::open(&config.data, options, protocol)?);
        let mut builder = SampleBuilder::new(Arc::clone(&scenes), samples.clone(), &model);
        let mut validator = None;
        if !config.validation.is_empty() {
            let scenes = SceneSet::open(&config.validation, options, protocol)?;
            let frames = config.validation_frames;
            validator = Some(Validator::new(scenes, &samples, &model, frames));
        }
        if let Some(frozen) = &frozen {
            frozen.give_maps(&mut builder, observe)?;
            if let Some(validator) = &mut validator {
                frozen.give_maps(&mut validator.builder, observe)?;
            }
        }
        let method = Some(config.method.name());
        // The time of the training begins here: encoding maps does not count.
        let trainer = Trainer::begin(run, &model.variables, method, Instant::now())?
            .on_data(&scenes.data().sha256)?;
        let curve = DetectorCurve::open(&trainer)?;
        observe(&TrainingEvent::Read(scenes.data()));
        let pillar_grid = model.network.pillar_grid;
        let training = Self {
            config,
            observe,
            scenes,
            // A resumed training goes on with the next batch.
            loader: batches(&builder, pillar_grid, run, trainer.steps()),
            model,
            validator,
            curve,
            terms: None,
            window: Window::new(),
            accuracy: None,
        };
        Ok((training, trainer))
    }

    fn draw_curve(&self) -> Result<()> {
        let (method, run) = (self.config.method, &self.config.run);
        self.curve.draw(&format!(
            "{method}, {} samples a step, seed {}",
            run.batch, run.seed
        ))
    }

    /// Metadata of the weights. Where all but the box input is frozen, scales of activations stay what they were.
    fn about(&self) -> Result<BTreeMap<String, String>> {
        let mut about = self.model.about();
        if let Some(init) = self.config.init.as_ref().filter(|_| self.config.box_input) {
            let weights = Weights::load(init).map_err(ModelError::from)?;
            let scales = weights.metadata(SCALES_KEY);
            about.extend(scales.map(|scales| (SCALES_KEY.to_owned(), scales.to_owned())));
        }
        Ok(about)
    }

    fn finish(self, trainer: &Trainer) -> Result<TrainSummary> {
        self.draw_curve()?;
        let (config, model, scenes) = (self.config, &self.model, &self.scenes);
        let trained = trainer.save_weights(&model.variables, self.about()?, scenes.data())?;
        let accuracy = self.accuracy;
        let card = card::card(config, model, scenes, &trained, accuracy.as_ref());
        card.write(&config.run.out)?;
        Ok(TrainSummary { trained, accuracy })
    }
}

impl Task for FusionTraining<'_> {
    type Error = Error;
    /// Reading the loss waits for the device.
    const REPORT_EVERY: u64 = 10;

    fn epoch(&self, steps: u64) -> f64 {
        (steps * self.config.run.batch as u64) as f64 / self.scenes.ticks.len() as f64
    }

    fn loss(&mut self, trainer: &Trainer) -> Result<Tensor> {
        let asked = Instant::now();
        let batch = self.loader.next_batch()??;
        self.window.waited += asked.elapsed();
        let config = &self.config.loss;
        let device = self.config.run.device;
        let labels = LabelTensors::gather(&batch.labels, config.unassigned, device);
        if self.config.box_input {
            // Of the step, so that a resumed training repeats none.
            let mut rng = ChaCha8Rng::seed_from_u64(self.config.run.seed);
            rng.set_stream(trainer.steps());
            let (samples, refinement) = batch.with_boxes(&self.model, Some(&mut rng))?;
            let head = self.model.detect_with_boxes(&samples)?;
            let terms = detection_loss(&head.scores, &head.offsets, &labels)?;
            let vehicles = refinement.len().max(1) as f64;
            let refinement: Tensor = refinement.iter().sum();
            let total = terms.total() + refinement / vehicles;
            self.terms = Some(terms);
            return Ok(total);
        }
        let output = batch.output(&self.model, true)?;
        let head = &output.head;
        let terms = detection_loss(&head.scores, &head.offsets, &labels)?;
        let total = match config.alignment_weight {
            weight if weight > 0.0 => {
                terms.total() + alignment_loss(&output.corrections, &batch.offsets)? * weight
            }
            _ => terms.total(),
        };
        self.terms = Some(terms);
        Ok(total)
    }

    fn stepped(&mut self, _: &Trainer, is_taken: bool) -> Result<()> {
        self.window.steps += 1;
        if let (Some(terms), true) = (self.terms.take(), is_taken) {
            self.window.losses[0] += terms.score.f_double_value(&[])?;
            self.window.losses[1] += terms.boxes.f_double_value(&[])?;
            self.window.finite += 1;
        }
        Ok(())
    }

    fn is_report_due(&self, trainer: &Trainer) -> bool {
        trainer.steps().is_multiple_of(Self::REPORT_EVERY)
    }

    fn report(&mut self, trainer: &Trainer) -> Result<()> {
        let window = std::mem::replace(&mut self.window, Window::new());
        // A window without a finite step gives NaN, which the picture leaves out.
        let [score_loss, box_loss] = window.losses.map(|sum| sum / window.finite as f64);
        let seconds = window.since.elapsed().as_secs_f64().max(1e-9);
        let share_done = self.share_done(trainer);
        let report = TrainingReport {
            step: trainer.steps(),
            epoch: self.epoch(trainer.steps()),
            seconds: trainer.seconds(),
            learning_rate: trainer.learning_rate(share_done),
            score_loss,
            box_loss,
            samples_per_second: (window.steps * self.config.run.batch) as f64 / seconds,
            waiting: window.waited.as_secs_f64() / seconds,
        };
        self.curve.step(&report)?;
        let text = format!(
            "epoch {:.2} loss {:.3} = scores {score_loss:.3} + boxes {box_loss:.3} lr {:.1e} {:.1} samples/s, {:.0} % waiting",
            report.epoch,
            score_loss + box_loss,
            report.learning_rate,
            report.samples_per_second,
            100.0 * report.waiting
        );
        let means = vec![score_loss + box_loss, score_loss, box_loss];
        (self.observe)(&trainer.step_report(share_done, means, &text));
        Ok(())
    }

    fn validate(&mut self, trainer: &Trainer) -> Result<()> {
        let Some(validator) = &mut self.validator else {
            return Ok(());
        };
        self.model.set_precision(ComputePrecision::F32);
        let accuracy = validator.measure(&self.model, self.config.box_input);
        self.model.set_precision(self.config.run.precision);
        let (accuracy, step) = (accuracy?, trainer.steps());
        self.curve.validation(step, trainer.seconds(), &accuracy)?;
        self.draw_curve()?;
        let aps = accuracy.ap_global;
        let aps = aps.map(|ap| ap.map_or("-".into(), |ap| format!("{ap:.3}")));
        (self.observe)(&TrainingEvent::Validated(format!(
            "step {step}: AP@0.3/0.5/0.7 global {} on {} frames",
            aps.join(" "),
            accuracy.frames
        )));
        self.accuracy = Some(accuracy);
        Ok(())
    }
}

/// Progress since the last report.
struct Window {
    since: Instant,
    waited: Duration,
    steps: usize,
    losses: [f64; 2],
    /// Number of steps with finite gradients, whose losses count.
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
