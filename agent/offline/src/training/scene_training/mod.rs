//! Second stage: the head of one scene, on features of the frozen encoder that are computed once.

mod cell_order;
mod classifier;
mod coarse_pose;
mod config;
mod continued;
mod features;
mod key_grid;
mod losses;
mod statistics;

use std::sync::Arc;
use std::time::{Duration, Instant};

use tch::nn::VarStore;
use tch::{Kind, Tensor, no_grad};

pub use self::config::{SceneReport, SceneSummary, SceneTrainConfig};

use self::cell_order::CellOrder;
use self::coarse_pose::CoarsePoses;
use self::continued::StoredHead;
use self::features::Features;
pub(crate) use self::features::SceneSweeps;
use self::losses::{centre_loss, weighted_loss};
use super::feature_cache::FeatureCache;
use super::kmeans::kmeans;
use super::redundancy::Redundancy;
use super::scene_validation::{SceneAccuracy, validate};
use super::sweep_store::SweepList;
use crate::Error;
use localization::pgc::{SceneHead, SceneHeadConfig};
use perception::train::{Curve, DataListing, Length, RunConfig, Trainer};

/// Weight of a unit of cross entropy over the centres, metres.
const CENTRE_WEIGHT_M: f64 = 5.0;
/// Steps between two draws of the classifier's dropout.
const LOGITS_EVERY: u64 = 50;
/// Largest share of a training by the clock that its classifier takes.
const CLASSIFIER_SHARE: f64 = 0.12;
/// Steps between two reports.
const REPORT_EVERY: u64 = 20;
/// Largest number of cells of a sweep that a head regresses.
const MAX_CELLS: usize = 1024;

/// Trains a head; writes checkpoint, curve and weights into `config.run.out`.
///
/// # Errors
/// [`Error`]; the last checkpoint stays.
pub fn train_scene(
    config: &SceneTrainConfig,
    observe: &mut dyn FnMut(&SceneReport),
) -> Result<SceneSummary, Error> {
    let training = Arc::new(SweepList::open(&config.scenes)?);
    let validation = match config.validation.as_slice() {
        [] => None,
        folders => {
            let mut list = SweepList::open(folders)?;
            list.thin_out(config.validation_sweeps);
            Some(Arc::new(list))
        }
    };
    train_scene_on(
        config,
        &SceneSweeps {
            training,
            validation,
        },
        observe,
    )
}

/// The same on lists of sweeps in place of the folders of `config`.
pub(crate) fn train_scene_on(
    config: &SceneTrainConfig,
    sweeps: &SceneSweeps,
    observe: &mut dyn FnMut(&SceneReport),
) -> Result<SceneSummary, Error> {
    let mut training = Training::prepare(config, sweeps, observe)?;
    let mut last_validation = Instant::now();
    while training.share_done() < 1.0 {
        training.step()?;
        training.trainer.check_interruption(&training.variables)?;
        if training.trainer.is_report_due(REPORT_EVERY) {
            observe(&training.report());
        }
        if last_validation.elapsed() >= config.validate_every {
            training.validate_and_save(observe)?;
            last_validation = Instant::now();
        }
    }
    training.validate_and_save(observe)?;
    training.finish()
}

struct Training<'a> {
    config: &'a SceneTrainConfig,
    head_config: SceneHeadConfig,
    cache: FeatureCache,
    validation: Option<FeatureCache>,
    variables: VarStore,
    head: SceneHead,
    trainer: Trainer,
    order: CellOrder,
    coarse_poses: CoarsePoses,
    /// Current logits of the classifier for each sweep.
    logits: Option<Tensor>,
    cells_shown: u64,
    window: Window,
    /// The window of the last report.
    reported: Window,
    accuracy: Option<SceneAccuracy>,
    curve: Curve,
    data: DataListing,
    preparing_seconds: f64,
}

impl<'a> Training<'a> {
    fn prepare(
        config: &'a SceneTrainConfig,
        sweeps: &SceneSweeps,
        observe: &mut dyn FnMut(&SceneReport),
    ) -> Result<Self, Error> {
        let started = Instant::now();
        let run = &config.run;
        run.start()?;
        let features = Features::compute(config, sweeps, observe)?;
        let stored = config
            .init
            .as_ref()
            .map(|init| StoredHead::load(init, &config.encoder, &features.encoder_sha256));
        let stored = stored.transpose()?;
        let head_config = match &stored {
            Some(stored) => {
                let counted = stored
                    .config
                    .sweep_points
                    .or_else(|| median_points(&features.training.points));
                SceneHeadConfig {
                    sweep_points: counted,
                    ..stored.config.clone()
                }
            }
            None => head_config(config, &features)?,
        };
        let Features {
            training: mut cache,
            validation,
            data,
            ..
        } = features;
        cache.move_origin(head_config.origin_m)?;
        let variables = VarStore::new(run.device);
        let mut head = SceneHead::new(&variables.root(), &head_config)?;
        let class_of_sweep = match &stored {
            Some(stored) => {
                stored.copy_into(&variables)?;
                continued::classes_of_sweeps(&head, &cache)?
            }
            None => {
                statistics::set_statistics(&mut head, &cache, run.seed)?;
                let positions: Vec<[f64; 3]> = cache
                    .world_from_sensor
                    .iter()
                    .map(|pose| pose.translation.vector.into())
                    .collect();
                kmeans(&positions, config.classes as usize, run.seed).1
            }
        };
        if !run.resume {
            let share = classifier::train_classifier(
                &head,
                &variables,
                &cache,
                &class_of_sweep,
                run.seed,
                classifier_time(run),
            )?;
            observe(&SceneReport::Classified(share));
        }
        let trainer = Trainer::begin(run, &variables, None, started)?;
        let redundancy = config
            .redundancy
            .map(|redundancy| Redundancy::new(redundancy, class_of_sweep));
        let header = "step,seconds,error_m,epsilon_m,cell_p50_m,pose_p50_m,pose_p50_deg,success_3m,success_1m";
        Ok(Self {
            config,
            head_config,
            variables,
            head,
            order: CellOrder::new(&cache, redundancy, run.batch, run.seed, trainer.steps())?,
            coarse_poses: CoarsePoses::new(&cache.world_from_sensor, run.device)?,
            cache,
            validation,
            logits: None,
            cells_shown: 0,
            window: Window::default(),
            reported: Window::default(),
            accuracy: None,
            curve: trainer.curve(header)?,
            trainer,
            data,
            preparing_seconds: started.elapsed().as_secs_f64(),
        })
    }

    fn share_done(&self) -> f64 {
        match self.config.run.length {
            Length::Time(limit) => {
                // The schedule of the head begins when the features are computed.
                let limit = (limit.as_secs_f64() - self.preparing_seconds).max(1.0);
                self.trainer.seconds_of_steps() / limit
            }
            _ => self.trainer.share_done(self.order.passes()),
        }
    }

    /// Eq. 4 and 5.
    fn step(&mut self) -> Result<(), Error> {
        let share_done = self.share_done();
        let rows = self.order.next_batch(share_done)?;
        let sweeps = self.cache.sweep_of_cell.f_index_select(0, &rows)?;
        let cells = self
            .head
            .normalise(&self.cache.cells.f_index_select(0, &rows)?)?;
        let logits = match self.logits.take() {
            Some(logits) if !self.trainer.steps().is_multiple_of(LOGITS_EVERY) => logits,
            // Dropout here too: in places without training data the classifier is less certain than on its training
            // sweeps.
            _ => no_grad(|| self.head.classify(&self.cache.sweeps, true))?,
        };
        let kind = self.config.run.precision.kind();
        let (regression, log_shares) =
            self.head
                .regress_among_centres(&cells, &logits.f_index_select(0, &sweeps)?, kind)?;
        self.logits = Some(logits);
        let targets = self.cache.targets_m.f_index_select(0, &rows)?;
        let weights = self.order.weights(&sweeps)?;
        let (mut loss, error) = weighted_loss(&regression, &targets, &weights)?;
        loss +=
            centre_loss(&log_shares, &targets, self.head.centres_m(), &weights)? * CENTRE_WEIGHT_M;
        if let Some(refiner) = self.head.refiner() {
            let (assumed, heading) = self.coarse_poses.draw(&targets, &sweeps)?;
            let answer = refiner.look(&cells, &assumed, &heading, kind)?;
            let (refiner_loss, refined) = weighted_loss(&answer, &targets, &weights)?;
            loss += refiner_loss;
            self.window.refined_m += mean(&refined)?;
        }
        self.trainer.step(&loss, self.share_done())?;
        self.window.error_m += mean(&error)?;
        self.window.epsilon_m += mean(&regression.epsilon_m)?;
        self.window.steps += 1;
        self.cells_shown += self.config.run.batch as u64;
        let share_done = self.share_done();
        Ok(self.order.watch(share_done, &sweeps, &error)?)
    }

    fn report(&mut self) -> SceneReport {
        // A validation right after a report has no newer steps to report.
        if self.window.steps > 0 {
            self.reported = std::mem::take(&mut self.window);
        }
        let mean = |sum: f64| sum / f64::from(self.reported.steps.max(1));
        SceneReport::Stepped {
            step: self.trainer.steps(),
            epoch: self.order.passes(),
            share_done: self.share_done().min(1.0),
            seconds: self.trainer.seconds(),
            error_m: mean(self.reported.error_m),
            epsilon_m: mean(self.reported.epsilon_m),
            refined_m: mean(self.reported.refined_m),
        }
    }

    /// Validates and writes a checkpoint.
    fn validate_and_save(&mut self, observe: &mut dyn FnMut(&SceneReport)) -> Result<(), Error> {
        let report = self.report();
        let SceneReport::Stepped {
            error_m, epsilon_m, ..
        } = report
        else {
            unreachable!("a report of steps")
        };
        let seconds = self.trainer.seconds();
        let mut row = vec![self.trainer.steps() as f64, seconds, error_m, epsilon_m];
        if let Some(validation) = &self.validation {
            let accuracy = validate(&self.head, validation, self.config.run.precision.kind())?;
            row.extend([
                accuracy.cell_p50_m,
                accuracy.pose_p50_m,
                accuracy.pose_p50_deg,
                accuracy.success_3m,
                accuracy.success_1m,
            ]);
            observe(&SceneReport::Validated(seconds, accuracy));
            self.accuracy = Some(accuracy);
        }
        self.curve.numbers(&row)?;
        Ok(self.trainer.checkpoint(&self.variables)?)
    }

    fn finish(mut self) -> Result<SceneSummary, Error> {
        let variables = match self.config.init {
            // Cropped already, to the sweeps of its first training, which may have been elsewhere in the scene.
            Some(_) => self.variables,
            None => key_grid::crop(&mut self.head_config, self.variables, &self.cache.targets_m)?,
        };
        Ok(SceneSummary {
            trained: self.trainer.save_network(
                &variables,
                SceneHead::KIND,
                &self.head_config,
                self.data,
            )?,
            preparing_seconds: self.preparing_seconds,
            scene_name: self.head_config.scene_name,
            sweeps: self.cache.sweep_count(),
            cells_shown: self.cells_shown,
            error_m: (self.reported.steps > 0)
                .then(|| self.reported.error_m / f64::from(self.reported.steps)),
            accuracy: self.accuracy,
        })
    }
}

/// Longest time of the classifier's training: a part of a training by the clock.
fn classifier_time(run: &RunConfig) -> Option<Duration> {
    match run.length {
        Length::Time(limit) => Some(limit.mul_f64(CLASSIFIER_SHARE)),
        Length::Steps(_) | Length::Epochs(_) => None,
    }
}

/// The configuration of the head for these features.
fn head_config(config: &SceneTrainConfig, features: &Features) -> Result<SceneHeadConfig, Error> {
    let Features {
        training,
        format,
        encoder_sha256,
        ..
    } = features;
    let refiner = || key_grid::covering(&training.targets_m, format.local_channels());
    Ok(SceneHeadConfig {
        scene_name: config.scene_name.clone(),
        encoder_sha256: encoder_sha256.clone(),
        cell_channels: format.cell_channels(),
        sweep_channels: format.sweep_channels(),
        classes: config.classes,
        centres: config.centres,
        width: config.width,
        blocks: config.blocks,
        origin_m: training.origin_m,
        max_cells: MAX_CELLS,
        refiner: config.refiner.then(refiner).transpose()?,
        sweep_points: median_points(&training.points),
    })
}

/// Sums since the last report.
#[derive(Default)]
struct Window {
    steps: u32,
    error_m: f64,
    epsilon_m: f64,
    refined_m: f64,
}

/// Median of the sweeps' numbers of points.
fn median_points(points: &[usize]) -> Option<usize> {
    let mut sorted = points.to_vec();
    sorted.sort_unstable();
    sorted.get(sorted.len() / 2).copied()
}

fn mean(values: &Tensor) -> Result<f64, tch::TchError> {
    values.f_mean(Kind::Float)?.f_double_value(&[])
}
