//! Second stage: the head of one town, on features of the frozen encoder that are computed once.

mod cell_order;
mod classifier;
mod config;
mod features;
mod lattice;
mod losses;
mod rough_pose;
mod statistics;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Instant;

use serde::{Deserialize, Serialize};
use tch::nn::VarStore;
use tch::{Kind, Tensor, no_grad};

pub use self::config::{SceneReport, SceneSummary, SceneTrainConfig};

use self::cell_order::CellOrder;
use self::features::Features;
use self::losses::{centre_loss, weighted_loss};
use self::rough_pose::RoughPoses;
use super::curve::Curve;
use super::error::LocalizerTrainError;
use super::feature_cache::FeatureCache;
use super::kmeans::kmeans;
use super::redundancy::Redundancy;
use super::scene_validation::{SceneAccuracy, validate};
use crate::localizer::head_config::SceneHeadConfig;
use crate::localizer::scene_head::SceneHead;
use crate::training::{AdamW, AdamWConfig, Length, OneCycle, Step, checkpoint};
use crate::weights::{self, CONFIG_KEY, KIND_KEY};

/// What a unit of cross entropy over the centres weighs, metres.
const CENTRE_WEIGHT_M: f64 = 5.0;
/// Steps between two draws of what drops out of the classifier.
const LOGITS_EVERY: u64 = 50;
/// Steps between two reports.
const REPORT_EVERY: u64 = 20;
/// Gradients that are not finite in a row before the training gives up.
const MAX_SKIPPED: u32 = 20;
/// Cells of a sweep that a head regresses at most.
const MAX_CELLS: usize = 1024;

/// What a checkpoint remembers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Progress {
    step: u64,
    seconds: f64,
    seed: u64,
    batch: usize,
}

/// Trains a head; writes checkpoint, curve and weights into `config.out`.
///
/// # Errors
/// [`LocalizerTrainError`]; the last checkpoint stays.
pub fn train_scene(
    config: &SceneTrainConfig,
    observe: &mut dyn FnMut(&SceneReport),
) -> Result<SceneSummary, LocalizerTrainError> {
    let mut training = Training::prepare(config, observe)?;
    let mut skipped = 0;
    let mut last_validation = Instant::now();
    while training.share_done() < 1.0 {
        skipped = if training.step()? { 0 } else { skipped + 1 };
        if skipped >= MAX_SKIPPED {
            return Err(LocalizerTrainError::Diverged(skipped));
        }
        if training.progress.step.is_multiple_of(REPORT_EVERY) {
            observe(&training.report());
        }
        if last_validation.elapsed() >= config.validate_every {
            training.look_back(observe)?;
            last_validation = Instant::now();
        }
    }
    training.look_back(observe)?;
    training.finish()
}

struct Training<'a> {
    config: &'a SceneTrainConfig,
    head_config: SceneHeadConfig,
    cache: FeatureCache,
    validation: Option<FeatureCache>,
    variables: VarStore,
    head: SceneHead,
    optimizer: AdamW,
    order: CellOrder,
    rough_poses: RoughPoses,
    /// What the classifier says of each sweep at the moment.
    logits: Option<Tensor>,
    progress: Progress,
    cells_shown: u64,
    window: Window,
    accuracy: Option<SceneAccuracy>,
    curve: Curve,
    data_sha256: String,
    started: Instant,
    preparing_seconds: f64,
    seconds_before: f64,
}

impl<'a> Training<'a> {
    fn prepare(
        config: &'a SceneTrainConfig,
        observe: &mut dyn FnMut(&SceneReport),
    ) -> Result<Self, LocalizerTrainError> {
        let started = Instant::now();
        std::fs::create_dir_all(&config.out)
            .map_err(|source| LocalizerTrainError::Io { path: config.out.clone(), source })?;
        tch::manual_seed(config.seed as i64);
        let features = Features::compute(config, observe)?;
        let head_config = head_config(config, &features)?;
        let Features { training: cache, validation, data_sha256, .. } = features;
        let variables = VarStore::new(config.device);
        let mut head = SceneHead::new(&variables.root(), &head_config)?;
        let positions: Vec<[f64; 3]> =
            cache.world_from_sensor.iter().map(|pose| pose.translation.vector.into()).collect();
        let (_, class_of_sweep) = kmeans(&positions, config.classes as usize, config.seed);
        statistics::set_statistics(&mut head, &cache, config.seed)?;
        let mut progress = Progress { step: 0, seconds: 0.0, seed: config.seed, batch: config.batch };
        let mut optimizer = AdamW::new(&variables, AdamWConfig::default());
        if config.resume {
            let stored: Progress = checkpoint::restore(&checkpoint_path(config), &variables, &mut optimizer)?;
            progress = same_training(&progress, stored)?;
        } else {
            let share = classifier::train_classifier(&head, &variables, &cache, &class_of_sweep, config.seed)?;
            observe(&SceneReport::Classified(share));
            // Moments of the classifier's training are of no use to the regressor's.
            optimizer = AdamW::new(&variables, AdamWConfig::default());
        }
        let redundancy = config.redundancy.map(|redundancy| Redundancy::new(redundancy, class_of_sweep));
        let header = "step,seconds,error_m,epsilon_m,cell_p50_m,pose_p50_m,pose_p50_deg,success_3m,success_1m";
        Ok(Self {
            config,
            head_config,
            variables,
            head,
            optimizer,
            order: CellOrder::new(&cache, redundancy, config.batch, config.seed, progress.step)?,
            rough_poses: RoughPoses::new(&cache.world_from_sensor, config.device)?,
            cache,
            validation,
            logits: None,
            cells_shown: 0,
            window: Window::default(),
            accuracy: None,
            curve: Curve::open(&config.out.join("curve.csv"), header, config.resume)?,
            data_sha256,
            started,
            preparing_seconds: started.elapsed().as_secs_f64(),
            seconds_before: progress.seconds,
            progress,
        })
    }

    fn seconds(&self) -> f64 {
        self.seconds_before + self.started.elapsed().as_secs_f64()
    }

    fn share_done(&self) -> f64 {
        match self.config.length {
            Length::Time(limit) => {
                // The schedule of the head begins when the features are there.
                let limit = (limit.as_secs_f64() - self.preparing_seconds).max(1.0);
                (self.seconds() - self.preparing_seconds) / limit
            }
            length => length.share_done(self.progress.step, self.order.passes(), self.seconds()),
        }
    }

    /// Eq. 4 and 5. Whether the step was taken.
    fn step(&mut self) -> Result<bool, LocalizerTrainError> {
        let share_done = self.share_done();
        let rows = self.order.next_batch(share_done)?;
        let sweeps = self.cache.sweep_of_cell.f_index_select(0, &rows)?;
        let cells = self.head.normalise(&self.cache.cells.f_index_select(0, &rows)?)?;
        let logits = match self.logits.take() {
            Some(logits) if !self.progress.step.is_multiple_of(LOGITS_EVERY) => logits,
            // Channels drop out here too: where nobody has driven the classifier is less sure than on what it has seen.
            _ => no_grad(|| self.head.classify(&self.cache.sweeps, true))?,
        };
        let kind = self.config.precision.kind();
        let (regression, log_shares) =
            self.head.regress_among_centres(&cells, &logits.f_index_select(0, &sweeps)?, kind)?;
        self.logits = Some(logits);
        let targets = self.cache.targets_m.f_index_select(0, &rows)?;
        let weights = self.order.weights(&sweeps)?;
        let (mut loss, error) = weighted_loss(&regression, &targets, &weights)?;
        loss += centre_loss(&log_shares, &targets, self.head.centres_m(), &weights)? * CENTRE_WEIGHT_M;
        if let Some(refiner) = self.head.refiner() {
            let (assumed, heading) = self.rough_poses.draw(&targets, &sweeps)?;
            let answer = refiner.look(&cells, &assumed, &heading, kind)?;
            let (refiner_loss, refined) = weighted_loss(&answer, &targets, &weights)?;
            loss += refiner_loss;
            self.window.refined_m += mean(&refined)?;
        }
        self.optimizer.zero_grad();
        loss.f_backward()?;
        let learning_rate = OneCycle { peak: self.config.learning_rate }.at(self.share_done());
        let taken = matches!(self.optimizer.step(learning_rate)?, Step::Taken(_));
        self.window.error_m += mean(&error)?;
        self.window.epsilon_m += mean(&regression.epsilon_m)?;
        self.window.steps += 1;
        self.progress.step += 1;
        self.cells_shown += self.config.batch as u64;
        let share_done = self.share_done();
        self.order.watch(share_done, &sweeps, &error)?;
        Ok(taken)
    }

    fn report(&mut self) -> SceneReport {
        let window = std::mem::take(&mut self.window);
        let mean = |sum: f64| sum / f64::from(window.steps.max(1));
        SceneReport::Stepped {
            step: self.progress.step,
            epoch: self.order.passes(),
            share_done: self.share_done().min(1.0),
            seconds: self.seconds(),
            error_m: mean(window.error_m),
            epsilon_m: mean(window.epsilon_m),
            refined_m: mean(window.refined_m),
        }
    }

    /// Validation and checkpoint.
    fn look_back(&mut self, observe: &mut dyn FnMut(&SceneReport)) -> Result<(), LocalizerTrainError> {
        let report = self.report();
        let SceneReport::Stepped { error_m, epsilon_m, .. } = report else { unreachable!("a report of steps") };
        let seconds = self.seconds();
        let mut row = vec![self.progress.step as f64, seconds, error_m, epsilon_m];
        if let Some(validation) = &self.validation {
            let accuracy = validate(&self.head, validation, self.config.precision.kind())?;
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
        self.curve.row(&row)?;
        self.progress.seconds = seconds;
        checkpoint::save(&checkpoint_path(self.config), &self.variables, &self.optimizer, &self.progress)?;
        Ok(())
    }

    fn finish(mut self) -> Result<SceneSummary, LocalizerTrainError> {
        let variables = lattice::crop(&mut self.head_config, self.variables, &self.cache.targets_m)?;
        let about = BTreeMap::from([
            (CONFIG_KEY.to_owned(), serde_json::to_string(&self.head_config).expect("a configuration is JSON")),
            (KIND_KEY.to_owned(), SceneHead::KIND.to_owned()),
            ("seed".to_owned(), self.config.seed.to_string()),
            ("steps".to_owned(), self.progress.step.to_string()),
            ("data_sha256".to_owned(), self.data_sha256.clone()),
        ]);
        let path = self.config.out.join("weights.safetensors");
        let sha256 = weights::save(&path, &variables, &about, weights::Precision::Half)?;
        Ok(SceneSummary {
            steps: self.progress.step,
            seconds: self.progress.seconds,
            preparing_seconds: self.preparing_seconds,
            sweeps: self.cache.sweep_count(),
            cells_shown: self.cells_shown,
            accuracy: self.accuracy,
            data_sha256: self.data_sha256,
            weights: path,
            sha256,
            parameters: variables.variables().values().map(|tensor| tensor.numel()).sum(),
        })
    }
}

/// The head that `config` asks for, for these features.
fn head_config(config: &SceneTrainConfig, features: &Features) -> Result<SceneHeadConfig, LocalizerTrainError> {
    let Features { training, encoder, encoder_sha256, .. } = features;
    let refiner = || lattice::covering(&training.targets_m, encoder.local_channels());
    Ok(SceneHeadConfig {
        town: config.town.clone(),
        encoder_sha256: encoder_sha256.clone(),
        cell_channels: encoder.cell_channels(),
        sweep_channels: encoder.sweep_channels(),
        classes: config.classes,
        centres: config.centres,
        width: config.width,
        blocks: config.blocks,
        origin_m: training.origin_m,
        max_cells: MAX_CELLS,
        refiner: config.refiner.then(refiner).transpose()?,
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

fn mean(values: &Tensor) -> Result<f64, tch::TchError> {
    values.f_mean(Kind::Float)?.f_double_value(&[])
}

fn checkpoint_path(config: &SceneTrainConfig) -> PathBuf {
    config.out.join("checkpoint.safetensors")
}

fn same_training(asked: &Progress, stored: Progress) -> Result<Progress, LocalizerTrainError> {
    let fields = [
        ("seed", stored.seed.to_string(), asked.seed.to_string()),
        ("batch", stored.batch.to_string(), asked.batch.to_string()),
    ];
    match fields.into_iter().find(|(_, found, asked)| found != asked) {
        Some((field, found, asked)) => Err(LocalizerTrainError::OtherTraining { field, found, asked }),
        None => Ok(stored),
    }
}
