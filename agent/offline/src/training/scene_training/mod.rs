//! Second stage: the head of one scene, on features of the frozen encoder that are computed once.

mod cell_order;
mod classifier;
mod coarse_pose;
mod config;
mod continued;
mod key_grid;
mod losses;
mod statistics;

use std::sync::Arc;
use std::time::Instant;

use tch::nn::VarStore;
use tch::{Kind, Tensor, no_grad};

pub use self::config::{SceneSummary, SceneTrainConfig};

use self::cell_order::CellOrder;
use self::classifier::train_classifier;
use self::losses::{centre_loss, weighted_loss};
use super::feature_cache::{FeatureCache, SweepAugmentation};
use super::kmeans::kmeans;
use super::redundancy::Redundancy;
use super::scene_validation::{SceneAccuracy, validate};
use super::sweep_store::SweepList;
use crate::{Error, Result};
use localization::pgc::driven_area::DrivenArea;
use localization::pgc::head_files;
use localization::pgc::{CellEncoder, LocalizerError, SceneHead, SceneHeadConfig, SweepFormat};
use perception::train::{
    Curve, DataListing, Length, Means, Observe, SaveEvery, Task, Trainer, TrainingEvent,
};

/// Weight of a unit of cross entropy over the centres, metres.
const CENTRE_WEIGHT_M: f64 = 5.0;
/// Steps between two draws of the classifier's dropout.
const LOGITS_EVERY: u64 = 50;
/// Largest number of cells of a sweep that a head regresses.
const MAX_CELLS: usize = 1024;
/// Columns of the training curve.
const CURVE: &str =
    "step,seconds,error_m,epsilon_m,cell_p50_m,pose_p50_m,pose_p50_deg,success_3m,success_1m";

/// Trains a head; writes checkpoint, curve and weights into `config.run.out`. Reported are the L1 error of a cell, its
/// predicted error, and that of the refiner's predictions, metres.
///
/// # Errors
/// [`Error`]; the last checkpoint stays.
pub fn train_scene(config: &SceneTrainConfig, observe: &mut Observe<'_>) -> Result<SceneSummary> {
    let training = Arc::new(SweepList::open(&config.scenes)?);
    let validation = match config.validation.as_slice() {
        [] => None,
        folders => {
            let mut list = SweepList::open(folders)?;
            list.thin_out(config.validation_sweeps);
            Some(Arc::new(list))
        }
    };
    train_scene_on(config, &training, validation.as_ref(), observe)
}

/// The same on lists of sweeps in place of the folders of `config`.
pub(crate) fn train_scene_on(
    config: &SceneTrainConfig,
    training: &Arc<SweepList>,
    validation: Option<&Arc<SweepList>>,
    observe: &mut Observe<'_>,
) -> Result<SceneSummary> {
    let (mut training, mut trainer) =
        SceneTraining::prepare(config, training, validation, observe)?;
    trainer.run(&mut training, SaveEvery::Time(config.validate_every))?;
    training.finish(&trainer)
}

struct SceneTraining<'a> {
    config: &'a SceneTrainConfig,
    observe: &'a mut Observe<'a>,
    head_config: SceneHeadConfig,
    cache: FeatureCache,
    validation: Option<FeatureCache>,
    variables: VarStore,
    head: SceneHead,
    order: CellOrder,
    /// `[S]`: true heading of each sweep's sensor, radians.
    headings: Tensor,
    /// Current logits of the classifier for each sweep.
    logits: Option<Tensor>,
    /// Sweeps of the last step's cells, and their errors.
    latest: Option<[Tensor; 2]>,
    cells_shown: u64,
    means: Means<3>,
    /// Means of the last report.
    reported: Option<[f64; 3]>,
    accuracy: Option<SceneAccuracy>,
    curve: Curve,
    data: DataListing,
    /// Driven area of the head that the training started from; empty without one.
    earlier_drives: DrivenArea,
    preparing_seconds: f64,
}

impl<'a> SceneTraining<'a> {
    /// Computes the features, makes the head, trains its classifier and opens the run: all that comes before the steps.
    fn prepare(
        config: &'a SceneTrainConfig,
        training: &Arc<SweepList>,
        validation: Option<&Arc<SweepList>>,
        observe: &'a mut Observe<'_>,
    ) -> Result<(Self, Trainer)> {
        let started = Instant::now();
        let run = &config.run;
        // Seeds the tensor library: before the first variable is made.
        run.start()?;
        let (encoder, sha256) = CellEncoder::load(&config.encoder, run.device)?;
        let mut cache = FeatureCache::build(training, &encoder, config.augmentation, run, observe)?;
        let unchanged = SweepAugmentation::NONE;
        let mut validation = validation
            .map(|list| FeatureCache::build(list, &encoder, unchanged, run, observe))
            .transpose()?;
        let format = encoder.format().clone();
        // The encoder is frozen: only its features are needed from here on, and its memory is freed.
        drop(encoder);
        let stored = config.init.as_deref().map(head_files::head_config);
        let stored = stored.transpose()?;
        if let (Some(init), Some((_, stored))) = (&config.init, &stored) {
            stored.check_encoder(init, &config.encoder, &sha256)?;
        }
        let stored_config = stored.as_ref().map(|(_, config)| config);
        let head_config = head_config(config, stored_config, &cache, &format, sha256)?;
        // Coordinates are relative to the origin of the head: f32 is exact enough near it only.
        for cache in validation.iter_mut().chain([&mut cache]) {
            cache.move_origin(head_config.origin_m)?;
        }
        let variables = VarStore::new(run.device);
        let mut head = SceneHead::new(&variables.root(), &head_config)?;
        let class_of_sweep = match &stored {
            Some((weights, _)) => {
                let copied = weights.copy_into(&variables);
                copied.map_err(LocalizerError::from)?;
                continued::classes_of_sweeps(&head, &cache)?
            }
            None => {
                statistics::set_statistics(&mut head, &cache, run.seed)?;
                kmeans(&cache.positions_m(), config.classes as usize, run.seed).1
            }
        };
        // A resumed training has its classifier in the checkpoint.
        if !run.resume {
            train_classifier(&head, &variables, &cache, &class_of_sweep, run, observe)?;
        }
        // After the classifier: where a checkpoint is resumed, it replaces all variables.
        let earlier_drives = stored.and_then(|(weights, _)| DrivenArea::of_head(&weights));
        let data = training.data();
        let trainer = Trainer::begin(run, &variables, None, started)?.on_data(&data.sha256)?;
        let redundancy = config
            .redundancy
            .map(|leave_out| Redundancy::new(leave_out, run.seed, class_of_sweep));
        let training = Self {
            config,
            observe,
            head_config,
            variables,
            head,
            order: CellOrder::new(&cache, redundancy, run.batch, run.seed, trainer.steps())?,
            headings: coarse_pose::headings(&cache.world_from_sensor, run.device)?,
            cache,
            validation,
            logits: None,
            latest: None,
            cells_shown: 0,
            means: Means::default(),
            reported: None,
            accuracy: None,
            curve: trainer.curve(CURVE)?,
            data,
            earlier_drives: earlier_drives.unwrap_or_else(|| DrivenArea::of(&[])),
            preparing_seconds: started.elapsed().as_secs_f64(),
        };
        Ok((training, trainer))
    }

    /// Saves the head.
    fn finish(mut self, trainer: &Trainer) -> Result<SceneSummary> {
        let variables = match self.config.init {
            // Cropped already, to the sweeps of its first training, which may have been elsewhere in the scene.
            Some(_) => self.variables,
            None => key_grid::crop(&mut self.head_config, self.variables, &self.cache.targets_m)?,
        };
        let (kind, head_config) = (SceneHead::KIND, &self.head_config);
        let mut trained = trainer.save_network(&variables, kind, head_config, self.data)?;
        let positions_m = self.cache.positions_m();
        let area = DrivenArea::of(&Vec::from_iter(positions_m.iter().map(|&[x, y, _]| [x, y])));
        let area = area.merged(&self.earlier_drives);
        trained.sha256 = area.state_in(&trained.weights)?;
        Ok(SceneSummary {
            trained,
            preparing_seconds: self.preparing_seconds,
            scene_name: self.head_config.scene_name,
            sweeps: self.cache.sweep_count(),
            cells_shown: self.cells_shown,
            error_m: self.reported.map(|[error_m, ..]| error_m),
            accuracy: self.accuracy,
        })
    }
}

impl Task for SceneTraining<'_> {
    type Error = Error;
    const REPORT_EVERY: u64 = 20;

    fn epoch(&self, _: u64) -> f64 {
        self.order.passes
    }

    fn share_done(&self, trainer: &Trainer) -> f64 {
        match self.config.run.length {
            Length::Time(limit) => {
                // The schedule of the head begins when the features are computed.
                let limit = (limit.as_secs_f64() - self.preparing_seconds).max(1.0);
                trainer.seconds_of_steps() / limit
            }
            _ => trainer.share_done(self.order.passes),
        }
    }

    /// Eq. 4 and 5.
    fn loss(&mut self, trainer: &Trainer) -> Result<Tensor> {
        let (head, cache) = (&self.head, &self.cache);
        let share_done = self.share_done(trainer);
        let rows = self.order.next_batch(share_done)?;
        // Cells of a batch come from many sweeps; each needs the class of its own sweep.
        let sweeps = cache.sweep_of_cell.f_index_select(0, &rows)?;
        let cells = head.normalise(&cache.cells.f_index_select(0, &rows)?)?;
        // The classifier is not trained here: its logits of all sweeps serve for several steps.
        let logits = match self.logits.take() {
            Some(logits) if !trainer.steps().is_multiple_of(LOGITS_EVERY) => logits,
            // Dropout here too: in places without training data the classifier is less certain than on its training
            // sweeps.
            _ => no_grad(|| head.classify(&cache.sweeps, true))?,
        };
        let kind = self.config.run.precision.kind();
        let of_cells = logits.f_index_select(0, &sweeps)?;
        let (regression, log_shares) = head.regress_among_centres(&cells, &of_cells, kind)?;
        self.logits = Some(logits);
        let targets = cache.targets_m.f_index_select(0, &rows)?;
        let weights = self.order.weights(&sweeps)?;
        let (mut loss, error) = weighted_loss(&regression, &targets, &weights)?;
        loss += centre_loss(&log_shares, &targets, head.centres_m(), &weights)? * CENTRE_WEIGHT_M;
        let mut refined_m = 0.0;
        // The refiner learns on coarse poses as wrong as those it will be given.
        if let Some(refiner) = head.refiner() {
            let (assumed, heading) = coarse_pose::draw(&self.headings, &targets, &sweeps)?;
            let answer = refiner.look(&cells, &assumed, &heading, kind)?;
            let (refiner_loss, refined) = weighted_loss(&answer, &targets, &weights)?;
            loss += refiner_loss;
            refined_m = mean(&refined)?;
        }
        self.means
            .add([mean(&error)?, mean(&regression.epsilon_m)?, refined_m]);
        self.cells_shown += self.config.run.batch as u64;
        self.latest = Some([sweeps, error]);
        Ok(loss)
    }

    fn stepped(&mut self, trainer: &Trainer, _is_taken: bool) -> Result<()> {
        let share_done = self.share_done(trainer);
        if let Some([sweeps, error]) = self.latest.take() {
            self.order.watch(share_done, &sweeps, &error)?;
        }
        Ok(())
    }

    fn report(&mut self, trainer: &Trainer) -> Result<()> {
        let means @ [error_m, epsilon_m, refined_m] = self.means.take();
        self.reported = Some(means);
        let text = format!(
            "epoch {:.2} error {error_m:.2} m, predicted {epsilon_m:.2} m, refined {refined_m:.2} m",
            self.order.passes
        );
        let report = trainer.step_report(self.share_done(trainer), means.into(), &text);
        (self.observe)(&report);
        Ok(())
    }

    fn validate(&mut self, trainer: &Trainer) -> Result<()> {
        // A validation right after a report has no newer steps to report.
        if !self.means.is_empty() {
            self.reported = Some(self.means.take());
        }
        let [error_m, epsilon_m, _] = self.reported.unwrap_or_default();
        let seconds = trainer.seconds();
        let mut row = vec![trainer.steps() as f64, seconds, error_m, epsilon_m];
        if let Some(validation) = &self.validation {
            let found = validate(&self.head, validation, self.config.run.precision.kind())?;
            row.push(found.cell_p50_m);
            row.extend([found.pose_p50_m, found.pose_p50_deg]);
            row.extend([found.success_3m, found.success_1m]);
            let text = format!("{seconds:.0} s: {found}");
            (self.observe)(&TrainingEvent::Validated(text));
            self.accuracy = Some(found);
        }
        Ok(self.curve.numbers(&row)?)
    }
}

/// The configuration of the head that is `stored` to start from, or else of one for these features.
fn head_config(
    config: &SceneTrainConfig,
    stored: Option<&SceneHeadConfig>,
    cache: &FeatureCache,
    format: &SweepFormat,
    encoder_sha256: String,
) -> Result<SceneHeadConfig> {
    // Median of the sweeps' numbers of points.
    let mut sorted = cache.points.to_vec();
    sorted.sort_unstable();
    let sweep_points = sorted.get(sorted.len() / 2).copied();
    if let Some(stored) = stored {
        return Ok(SceneHeadConfig {
            sweep_points: stored.sweep_points.or(sweep_points),
            ..stored.clone()
        });
    }
    let refiner = config
        .refiner
        .then(|| key_grid::covering(&cache.targets_m, format.local_channels()));
    Ok(SceneHeadConfig {
        scene_name: config.scene_name.clone(),
        encoder_sha256,
        cell_channels: format.cell_channels(),
        sweep_channels: format.sweep_channels(),
        classes: config.classes,
        centres: config.centres,
        width: config.width,
        blocks: config.blocks,
        origin_m: cache.origin_m,
        max_cells: MAX_CELLS,
        refiner: refiner.transpose()?,
        sweep_points,
    })
}

fn mean(values: &Tensor) -> Result<f64, tch::TchError> {
    values.f_mean(Kind::Float)?.f_double_value(&[])
}
