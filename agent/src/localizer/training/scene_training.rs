//! Second stage: the head of one town, on features of the frozen encoder that are computed once.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rand::seq::SliceRandom;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use tch::nn::VarStore;
use tch::{Device, Kind, Tensor, no_grad};

use super::curve::Curve;
use super::error::LocalizerTrainError;
use super::feature_cache::{CacheOptions, FeatureCache, SweepAugmentation};
use super::kmeans::kmeans;
use super::redundancy::{Redundancy, RedundancyConfig};
use super::scene_validation::{SceneAccuracy, validate};
use super::sweep_store::SweepList;
use crate::localizer::SceneEncoder;
use crate::localizer::head_config::{RefinerConfig, SceneHeadConfig};
use crate::localizer::scene_head::{Regression, SceneHead};
use crate::training::{AdamW, AdamWConfig, ComputePrecision, Length, OneCycle, Step, checkpoint};
use crate::weights::{self, CONFIG_KEY};

/// Steps and sweeps per step that the classifier is trained with.
const CLASSIFIER_STEPS: usize = 1500;
const CLASSIFIER_BATCH: usize = 256;
/// LightLoc's.
const LABEL_SMOOTHING: f64 = 0.1;
/// Cells that centres and statistics are computed from.
const SAMPLE: usize = 20_000;
/// What a unit of cross entropy over the centres weighs, metres.
const CENTRE_WEIGHT_M: f64 = 5.0;
/// Centres share a cell by their distance over this, metres.
const CENTRE_BLUR_M: f64 = 4.0;
/// Steps between two draws of what drops out of the classifier.
const LOGITS_EVERY: u64 = 50;
/// Steps between two reports.
const REPORT_EVERY: u64 = 20;
/// Deviation of the largest errors that the refiner starts from, metres.
const MAX_ASSUMED_ERROR_M: f64 = 2.5;
/// Deviation of the heading that it starts from, radians.
const ASSUMED_TURN_RAD: f64 = 0.015;
/// Distance between the corners of its lattice, metres, and how many corners that may be: larger towns have a wider lattice.
const SPACING_M: f64 = 1.5;
const CORNERS: f64 = 110_000.0;
/// How far it looks to each side, metres.
const REACH_M: f64 = 3.0;
/// Channels of a key.
const KEYS: i64 = 16;
/// Share of the cells that may lie beyond each edge of the lattice that is kept in the end.
const EDGE_SHARE: f64 = 0.003;
/// What lies this far beyond the outermost cell is still town, metres.
const MARGIN_M: f64 = 8.0;
/// Gradients that are not finite in a row before the training gives up.
const MAX_SKIPPED: u32 = 20;

/// What to train, on what, for how long.
#[derive(Debug, Clone)]
pub struct SceneTrainConfig {
    /// Folders of scenes, all of one town.
    pub scenes: Vec<PathBuf>,
    /// Folders of scenes of the same town to validate on; none: no validation.
    pub validation: Vec<PathBuf>,
    /// Sweeps of a validation.
    pub validation_sweeps: usize,
    /// Weights of the encoder.
    pub encoder: PathBuf,
    /// Name of the town.
    pub town: String,
    /// Clusters of sensor positions.
    pub classes: i64,
    /// Clusters of world coordinates.
    pub centres: i64,
    /// Channels of the head.
    pub width: i64,
    /// Residual blocks of the head.
    pub blocks: usize,
    /// Whether there is a second look.
    pub refiner: bool,
    /// How sweeps are changed before they are encoded.
    pub augmentation: SweepAugmentation,
    /// Which sweeps may be left out; nothing: none.
    pub redundancy: Option<RedundancyConfig>,
    /// How long; a time counts from the start, reading and encoding included.
    pub length: Length,
    /// Cells of a step.
    pub batch: usize,
    /// Highest learning rate.
    pub learning_rate: f64,
    /// Seed of parameters and order.
    pub seed: u64,
    /// Where the network computes.
    pub device: Device,
    /// In which numbers.
    pub precision: ComputePrecision,
    /// Threads that read and sort sweeps.
    pub loader_threads: usize,
    /// Time between two validations and checkpoints.
    pub validate_every: Duration,
    /// Folder of checkpoint, curve and weights.
    pub out: PathBuf,
    /// Whether to go on from the checkpoint in `out`.
    pub resume: bool,
}

/// Where a training of a head is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum SceneReport {
    /// Sweeps are being encoded: how many of how many are done.
    Encoding(usize, usize),
    /// The classifier is done: share of training sweeps that it puts into their class.
    Classified(f64),
    /// Some steps are done.
    Stepped {
        /// Steps done.
        step: u64,
        /// Passes over the data.
        epoch: f64,
        /// Share that is done, 0..1.
        share_done: f64,
        /// Seconds since the start.
        seconds: f64,
        /// Mean L1 error of a cell since the last report, metres.
        error_m: f64,
        /// Mean predicted error, metres.
        epsilon_m: f64,
        /// Mean L1 error of the refiner's answers, metres.
        refined_m: f64,
    },
    /// A validation is done, after so many seconds.
    Validated(f64, SceneAccuracy),
}

/// How a training of a head ended.
#[derive(Debug, Clone)]
pub struct SceneSummary {
    /// Steps done.
    pub steps: u64,
    /// Seconds spent, reading and encoding included.
    pub seconds: f64,
    /// Of these, before the head's first step.
    pub preparing_seconds: f64,
    /// Sweeps it learnt from.
    pub sweeps: usize,
    /// Cells it was shown.
    pub cells_shown: u64,
    /// The last validation.
    pub accuracy: Option<SceneAccuracy>,
    /// SHA-256 of the listing of the data.
    pub data_sha256: String,
    /// The weights, in half precision.
    pub weights: PathBuf,
    /// Their SHA-256.
    pub sha256: String,
    /// Number of parameters.
    pub parameters: usize,
}

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
        let Some(batch) = training.next_batch()? else { continue };
        skipped = if training.step(&batch)? { 0 } else { skipped + 1 };
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
    redundancy: Option<Redundancy>,
    /// Weight of each sweep.
    sweep_weights: Tensor,
    /// Heading of each sweep's sensor, radians.
    headings: Tensor,
    /// What the classifier says of each sweep at the moment.
    logits: Option<Tensor>,
    order: Vec<i64>,
    place: usize,
    /// Cells of all sweeps, of which a pass shows those that are used.
    passes: f64,
    watched: Vec<(usize, f32)>,
    progress: Progress,
    cells_shown: u64,
    window: [f64; 4],
    accuracy: Option<SceneAccuracy>,
    curve: Curve,
    data_sha256: String,
    rng: ChaCha8Rng,
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
        let (encoder, encoder_sha256) = SceneEncoder::load(&config.encoder, config.device)?;
        let list = Arc::new(SweepList::open(&config.scenes)?);
        let data_sha256 = list.listing_sha256.clone();
        let mut encode = |list: &Arc<SweepList>, augmentation| {
            let mut progress = |done, total| observe(&SceneReport::Encoding(done, total));
            let options = CacheOptions {
                augmentation,
                seed: config.seed,
                threads: config.loader_threads,
                precision: config.precision,
                device: config.device,
            };
            FeatureCache::build(list, &encoder, options, &mut progress)
        };
        let cache = encode(&list, config.augmentation)?;
        let validation = match config.validation.as_slice() {
            [] => None,
            folders => {
                let mut list = SweepList::open(folders)?;
                list.thin_out(config.validation_sweeps);
                let unchanged = SweepAugmentation { copies: 1, ..config.augmentation };
                Some(encode(&Arc::new(list), unchanged)?)
            }
        };
        let head_config = SceneHeadConfig {
            town: config.town.clone(),
            encoder_sha256,
            cell_channels: encoder.config().cell_channels(),
            sweep_channels: encoder.config().sweep_channels(),
            classes: config.classes,
            centres: config.centres,
            width: config.width,
            blocks: config.blocks,
            origin_m: cache.origin_m,
            max_cells: 1024,
            refiner: config.refiner.then(|| refiner_config(&cache, encoder.config().local_channels())).transpose()?,
        };
        let variables = VarStore::new(config.device);
        let mut head = SceneHead::new(&variables.root(), &head_config)?;
        let positions: Vec<[f64; 3]> =
            cache.world_from_sensor.iter().map(|pose| pose.translation.vector.into()).collect();
        let (_, class_of_sweep) = kmeans(&positions, config.classes as usize, config.seed);
        set_statistics(&mut head, &cache, config)?;
        let mut progress = Progress { step: 0, seconds: 0.0, seed: config.seed, batch: config.batch };
        let mut optimizer = AdamW::new(&variables, AdamWConfig::default());
        if config.resume {
            let stored: Progress = checkpoint::restore(&checkpoint_path(config), &variables, &mut optimizer)?;
            progress = same_training(&progress, stored)?;
        } else {
            let share = train_classifier(&head, &variables, &cache, &class_of_sweep, config)?;
            observe(&SceneReport::Classified(share));
            // Moments of the classifier's training are of no use to the regressor's.
            optimizer = AdamW::new(&variables, AdamWConfig::default());
        }
        let redundancy = config.redundancy.map(|redundancy| Redundancy::new(redundancy, class_of_sweep));
        let header = "step,seconds,error_m,epsilon_m,cell_p50_m,pose_p50_m,pose_p50_deg,success_3m,success_1m";
        let curve = Curve::open(&config.out.join("curve.csv"), header, config.resume)?;
        let heading = |pose: &nalgebra::Isometry3<f64>| {
            let ahead = pose.rotation * nalgebra::Vector3::x();
            ahead.y.atan2(ahead.x) as f32
        };
        let headings: Vec<f32> = cache.world_from_sensor.iter().map(heading).collect();
        let headings = Tensor::f_from_slice(&headings)?.f_to_device(config.device)?;
        let sweep_weights = Tensor::ones([cache.sweep_count() as i64], (Kind::Float, config.device));
        Ok(Self {
            config,
            head_config,
            validation,
            variables,
            head,
            optimizer,
            redundancy,
            sweep_weights,
            headings,
            logits: None,
            order: Vec::new(),
            place: 0,
            passes: progress.step as f64 * config.batch as f64 / cache.cell_count() as f64,
            cache,
            watched: Vec::new(),
            cells_shown: 0,
            window: [0.0; 4],
            accuracy: None,
            curve,
            data_sha256,
            rng: ChaCha8Rng::seed_from_u64(config.seed ^ progress.step),
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
            length => length.share_done(self.progress.step, self.passes, self.seconds()),
        }
    }

    /// Rows of the next step; nothing where a pass has just ended.
    fn next_batch(&mut self) -> Result<Option<Tensor>, LocalizerTrainError> {
        let end = self.place + self.config.batch;
        if end > self.order.len() {
            self.next_pass()?;
            return Ok(None);
        }
        let rows = Tensor::f_from_slice(&self.order[self.place..end])?.f_to_device(self.config.device)?;
        self.place = end;
        self.passes += self.config.batch as f64 / self.order.len() as f64;
        Ok(Some(rows))
    }

    fn next_pass(&mut self) -> Result<(), LocalizerTrainError> {
        let share_done = self.share_done();
        let mut changed = self.order.is_empty();
        if let Some(redundancy) = &mut self.redundancy {
            if !self.watched.is_empty() {
                redundancy.record(&self.watched);
                self.watched.clear();
            }
            changed |= redundancy.advance(share_done);
            if changed {
                self.sweep_weights = Tensor::f_from_slice(redundancy.weights())?.f_to_device(self.config.device)?;
            }
        }
        if changed {
            let used = self.sweep_weights.f_index_select(0, &self.cache.sweep_of_cell)?.f_gt(0.0)?;
            self.order = Vec::try_from(&used.f_nonzero()?.f_squeeze_dim(1)?)?;
        }
        if self.order.len() < self.config.batch {
            let cells = self.order.clone();
            self.order = cells.iter().cycle().take(self.config.batch).copied().collect();
        }
        self.order.shuffle(&mut self.rng);
        self.place = 0;
        Ok(())
    }

    /// Eq. 4 and 5. Whether the step was taken.
    fn step(&mut self, rows: &Tensor) -> Result<bool, LocalizerTrainError> {
        let sweeps = self.cache.sweep_of_cell.f_index_select(0, rows)?;
        let cells = self.head.normalise(&self.cache.cells.f_index_select(0, rows)?)?;
        if self.progress.step.is_multiple_of(LOGITS_EVERY) || self.logits.is_none() {
            // Channels drop out here too: where nobody has driven the classifier is less sure than on what it has seen.
            self.logits = Some(no_grad(|| self.head.classify(&self.cache.sweeps, true))?);
        }
        let Some(logits) = &self.logits else { unreachable!("set above") };
        let logits = logits.f_index_select(0, &sweeps)?;
        let kind = self.config.precision.kind();
        let (regression, log_shares) = self.head.regress_among_centres(&cells, &logits, kind)?;
        let targets = self.cache.targets_m.f_index_select(0, rows)?;
        let weights = self.sweep_weights.f_index_select(0, &sweeps)?;
        let (mut loss, error) = weighted_loss(&regression, &targets, &weights)?;
        loss += centre_loss(&log_shares, &targets, self.head.centres_m(), &weights)? * CENTRE_WEIGHT_M;
        let mut refined_m = 0.0;
        if let Some(refiner) = self.head.refiner() {
            let (assumed, heading) = self.assume(&targets, &sweeps)?;
            let answer = refiner.look(&cells, &assumed, &heading, kind)?;
            let (refiner_loss, refined) = weighted_loss(&answer, &targets, &weights)?;
            loss += refiner_loss;
            refined_m = refined.f_mean(Kind::Float)?.f_double_value(&[])?;
        }
        self.optimizer.zero_grad();
        loss.f_backward()?;
        let learning_rate = OneCycle { peak: self.config.learning_rate }.at(self.share_done());
        let taken = matches!(self.optimizer.step(learning_rate)?, Step::Taken(_));
        self.window[0] += error.f_mean(Kind::Float)?.f_double_value(&[])?;
        self.window[1] += regression.epsilon_m.f_mean(Kind::Float)?.f_double_value(&[])?;
        self.window[2] += refined_m;
        self.window[3] += 1.0;
        self.progress.step += 1;
        self.cells_shown += self.config.batch as u64;
        let share_done = self.share_done();
        if self.redundancy.as_ref().is_some_and(|redundancy| redundancy.watches(share_done)) {
            let errors: Vec<f32> = Vec::try_from(&error.f_detach()?)?;
            let sweeps: Vec<i64> = Vec::try_from(&sweeps)?;
            self.watched.extend(sweeps.iter().zip(errors).map(|(&sweep, error)| (sweep as usize, error)));
        }
        Ok(taken)
    }

    /// Where a rough pose would put cells: their places moved, the heading turned.
    fn assume(&self, targets_m: &Tensor, sweeps: &Tensor) -> Result<(Tensor, Tensor), tch::TchError> {
        let like = (Kind::Float, targets_m.device());
        let count = targets_m.size()[0];
        // Small and large errors both occur: the second round starts from a better pose than the first.
        let scale = Tensor::f_rand([count, 1], like)?.f_square()? * MAX_ASSUMED_ERROR_M;
        let shift = Tensor::f_randn([count, 3], like)?
            * scale
            * Tensor::f_from_slice(&[1.0f32, 1.0, 0.3])?.f_to_device(like.1)?;
        let turn = Tensor::f_randn([count], like)? * ASSUMED_TURN_RAD;
        let yaw = self.headings.f_index_select(0, sweeps)? + turn;
        Ok((targets_m + shift, Tensor::f_stack(&[yaw.f_cos()?, yaw.f_sin()?], 1)?))
    }

    /// Cuts the edges of the refiner's lattice off that hardly any cell comes near, so that they need not be shipped.
    fn crop_lattice(&mut self) -> Result<(), LocalizerTrainError> {
        let Some(full) = self.head_config.refiner.clone() else { return Ok(()) };
        let bound = |share: f64, axis: i64| -> Result<f64, tch::TchError> {
            let values = self.cache.targets_m.f_select(1, axis)?;
            let rank = ((values.size()[0] - 1) as f64 * share).round() as i64 + 1;
            values.f_kthvalue(rank, 0, false)?.0.f_double_value(&[])
        };
        let low = [bound(EDGE_SHARE, 0)?, bound(EDGE_SHARE, 1)?];
        let high = [bound(1.0 - EDGE_SHARE, 0)?, bound(1.0 - EDGE_SHARE, 1)?];
        let (cropped, rows) = full.cropped(low, high);
        let rows = Tensor::f_from_slice(&rows)?.f_to_device(self.config.device)?;
        self.head_config.refiner = Some(cropped);
        let variables = VarStore::new(self.config.device);
        SceneHead::new(&variables.root(), &self.head_config)?;
        let trained = self.variables.variables();
        for (name, mut variable) in variables.variables() {
            let source = &trained[&name];
            let is_lattice = matches!(name.as_str(), "refiner.keys" | "refiner.heights");
            let source = if is_lattice { source.f_index_select(0, &rows)? } else { source.shallow_clone() };
            no_grad(|| variable.f_copy_(&source))?;
        }
        self.variables = variables;
        Ok(())
    }

    fn report(&mut self) -> SceneReport {
        let [error, epsilon, refined, steps] = std::mem::take(&mut self.window);
        SceneReport::Stepped {
            step: self.progress.step,
            epoch: self.passes,
            share_done: self.share_done().min(1.0),
            seconds: self.seconds(),
            error_m: error / steps.max(1.0),
            epsilon_m: epsilon / steps.max(1.0),
            refined_m: refined / steps.max(1.0),
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
        self.crop_lattice()?;
        let about = BTreeMap::from([
            (CONFIG_KEY.to_owned(), serde_json::to_string(&self.head_config).expect("a configuration is JSON")),
            ("kind".to_owned(), "scene head".to_owned()),
            ("seed".to_owned(), self.config.seed.to_string()),
            ("steps".to_owned(), self.progress.step.to_string()),
            ("data_sha256".to_owned(), self.data_sha256.clone()),
        ]);
        let path = self.config.out.join("weights.safetensors");
        let sha256 = weights::save(&path, &self.variables, &about, weights::Precision::Half)?;
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
            parameters: self.variables.variables().values().map(|tensor| tensor.numel()).sum(),
        })
    }
}

/// Eq. 4 and 5, each cell by its weight; also the L1 errors `[N]`.
fn weighted_loss(answer: &Regression, targets_m: &Tensor, weights: &Tensor) -> Result<(Tensor, Tensor), tch::TchError> {
    let error = (&answer.coordinates_m - targets_m).f_abs()?.f_sum_dim_intlist(1_i64, false, Kind::Float)?;
    // The error is learnt from, not bent towards its prediction: the second term moves epsilon alone.
    let surprise = (error.f_detach()? - &answer.epsilon_m).f_abs()?;
    Ok((((&error + surprise) * weights).f_mean(Kind::Float)?, error))
}

/// Cross entropy between the shares of the centres and how near they really are.
///
/// Coordinates alone teach which centre is right only through their mean, which several wrong ones can make up together.
fn centre_loss(
    log_shares: &Tensor,
    targets_m: &Tensor,
    centres_m: &Tensor,
    weights: &Tensor,
) -> Result<Tensor, tch::TchError> {
    let distance = Tensor::f_cdist(targets_m, centres_m, 2.0, 1_i64)? / CENTRE_BLUR_M;
    let wanted = (distance.f_square()? * -0.5).f_softmax(1, Kind::Float)?;
    let each = (wanted * log_shares).f_sum_dim_intlist(1_i64, false, Kind::Float)?.f_neg()?;
    (each * weights).f_mean(Kind::Float)
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

/// A lattice that covers all cells.
fn refiner_config(cache: &FeatureCache, local_channels: i64) -> Result<RefinerConfig, tch::TchError> {
    let bound = |extreme: Tensor, margin_m: f64| -> Result<[f64; 2], tch::TchError> {
        let values: Vec<f32> = Vec::try_from(&extreme)?;
        Ok([f64::from(values[0]) + margin_m, f64::from(values[1]) + margin_m])
    };
    let low_m = bound(cache.targets_m.f_amin([0_i64], false)?, -MARGIN_M)?;
    let high_m = bound(cache.targets_m.f_amax([0_i64], false)?, MARGIN_M)?;
    let area_m2 = (high_m[0] - low_m[0]) * (high_m[1] - low_m[1]);
    let spacing_m = (area_m2 / CORNERS).sqrt().max(SPACING_M);
    let reach = (REACH_M / spacing_m).ceil() as i64;
    Ok(RefinerConfig { local_channels, low_m, high_m, spacing_m, reach, keys: KEYS, width: 256 })
}

/// Statistics of the features, and centres among the world coordinates of cells.
fn set_statistics(
    head: &mut SceneHead,
    cache: &FeatureCache,
    config: &SceneTrainConfig,
) -> Result<(), LocalizerTrainError> {
    let mut rng = ChaCha8Rng::seed_from_u64(config.seed);
    let sample: Vec<i64> = (0..SAMPLE).map(|_| rng.random_range(0..cache.cell_count())).collect();
    let sample = Tensor::f_from_slice(&sample)?.f_to_device(config.device)?;
    let statistics = |features: &Tensor| -> Result<[Tensor; 2], tch::TchError> {
        let features = features.f_to_kind(Kind::Float)?;
        Ok([features.f_mean_dim(0_i64, false, Kind::Float)?, features.f_std_dim(0_i64, false, false)?])
    };
    let cells = statistics(&cache.cells.f_index_select(0, &sample)?)?;
    let sweeps = statistics(&cache.sweeps)?;
    let places: Vec<f32> = Vec::try_from(&cache.targets_m.f_index_select(0, &sample)?.f_view([-1])?)?;
    let places: Vec<[f64; 3]> = places.as_chunks::<3>().0.iter().map(|place| place.map(f64::from)).collect();
    let (mut centres, _) = kmeans(&places, config.centres as usize, config.seed);
    centres.resize(config.centres as usize, [0.0; 3]);
    let centres: Vec<f32> = centres.as_flattened().iter().map(|&axis| axis as f32).collect();
    head.set_statistics(cells, sweeps, &Tensor::f_from_slice(&centres)?.f_view([-1, 3])?)?;
    Ok(())
}

/// Cross entropy with label smoothing; the share of training sweeps that end up in their class.
fn train_classifier(
    head: &SceneHead,
    variables: &VarStore,
    cache: &FeatureCache,
    class_of_sweep: &[usize],
    config: &SceneTrainConfig,
) -> Result<f64, LocalizerTrainError> {
    let classes: Vec<i64> = class_of_sweep.iter().map(|&class| class as i64).collect();
    let classes = Tensor::f_from_slice(&classes)?.f_to_device(config.device)?;
    let mut rng = ChaCha8Rng::seed_from_u64(config.seed);
    let mut optimizer = AdamW::new(variables, AdamWConfig::default());
    for step in 0..CLASSIFIER_STEPS {
        let rows: Vec<i64> = (0..CLASSIFIER_BATCH).map(|_| rng.random_range(0..cache.sweep_count()) as i64).collect();
        let rows = Tensor::f_from_slice(&rows)?.f_to_device(config.device)?;
        let logits = head.classify(&cache.sweeps.f_index_select(0, &rows)?, true)?;
        let log_shares = logits.f_log_softmax(1, Kind::Float)?;
        let wanted = classes.f_index_select(0, &rows)?;
        let hit = log_shares.f_gather(1, &wanted.f_unsqueeze(1)?, false)?.f_mean(Kind::Float)?;
        let even = log_shares.f_mean(Kind::Float)?;
        let loss = -(hit * (1.0 - LABEL_SMOOTHING) + even * LABEL_SMOOTHING);
        optimizer.zero_grad();
        loss.f_backward()?;
        optimizer.step(OneCycle { peak: 2e-3 }.at(step as f64 / CLASSIFIER_STEPS as f64))?;
    }
    let found = no_grad(|| head.classify(&cache.sweeps, false)?.f_argmax(1, false)?.f_eq_tensor(&classes))?;
    Ok(found.f_to_kind(Kind::Float)?.f_mean(Kind::Float)?.f_double_value(&[])?)
}
