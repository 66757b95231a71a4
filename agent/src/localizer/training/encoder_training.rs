//! First stage: the encoder, over many towns, on correspondences between sweeps that overlap. Trained once, then frozen.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use serde::{Deserialize, Serialize};
use tch::nn::VarStore;
use tch::{Device, no_grad};

use super::contrast::{Contrast, ContrastLoss};
use super::curve::Curve;
use super::error::LocalizerTrainError;
use super::pairs::{Pair, PairMaker};
use super::sweep_store::SweepStore;
use crate::localizer::{SceneEncoder, SceneEncoderConfig};
use crate::training::{AdamW, AdamWConfig, ComputePrecision, Length, OneCycle, Prefetch, Step, checkpoint};
use crate::weights::{self, CONFIG_KEY, KIND_KEY};

/// Pairs that a validation looks at.
const VALIDATION_PAIRS: u64 = 24;
/// Gradients that are not finite in a row before the training gives up.
const MAX_SKIPPED: u32 = 20;
/// Steps between two reports.
const REPORT_EVERY: u64 = 10;

/// What to train, on what, for how long.
#[derive(Debug, Clone)]
pub struct EncoderTrainConfig {
    /// Folders of scenes, one world each.
    pub scenes: Vec<PathBuf>,
    /// Folders of scenes to validate on, one world each; none: no validation.
    pub validation: Vec<PathBuf>,
    /// The network.
    pub encoder: SceneEncoderConfig,
    /// How long.
    pub length: Length,
    /// Pairs of sweeps of a step.
    pub batch: usize,
    /// Highest learning rate.
    pub learning_rate: f64,
    /// Seed of parameters, pairs and augmentation.
    pub seed: u64,
    /// Where the network computes.
    pub device: Device,
    /// In which numbers.
    pub precision: ComputePrecision,
    /// Threads that prepare pairs.
    pub loader_threads: usize,
    /// Steps between two validations and checkpoints.
    pub validate_every: u64,
    /// Folder of checkpoint, curve and weights.
    pub out: PathBuf,
    /// Whether to go on from the checkpoint in `out`.
    pub resume: bool,
}

/// How well places are told apart.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct EncoderAccuracy {
    /// Share of cells whose most similar candidate is their match.
    pub top1: f64,
    /// Mean L1 error of the offset between two views of one spot, metres.
    pub offset_m: f64,
}

/// Where a training of an encoder is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EncoderReport {
    /// Steps done.
    pub step: u64,
    /// Share that is done, 0..1.
    pub share_done: f64,
    /// Seconds spent so far.
    pub seconds: f64,
    /// Mean loss since the last report.
    pub loss: f64,
    /// Mean accuracy on the training pairs since the last report.
    pub accuracy: EncoderAccuracy,
}

/// How a training of an encoder ended.
#[derive(Debug, Clone)]
pub struct EncoderSummary {
    /// Steps done.
    pub steps: u64,
    /// Seconds spent.
    pub seconds: f64,
    /// Sweeps it learnt from.
    pub sweeps: usize,
    /// The last validation.
    pub accuracy: Option<EncoderAccuracy>,
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

/// Trains an encoder; writes checkpoint, curve and weights into `config.out`. `report` hears of some steps, `validated`
/// of every validation.
///
/// # Errors
/// [`LocalizerTrainError`]; the last checkpoint stays.
pub fn train_encoder(
    config: &EncoderTrainConfig,
    report: &mut dyn FnMut(&EncoderReport),
    validated: &mut dyn FnMut(u64, &EncoderAccuracy),
) -> Result<EncoderSummary, LocalizerTrainError> {
    std::fs::create_dir_all(&config.out)
        .map_err(|source| LocalizerTrainError::Io { path: config.out.clone(), source })?;
    let mut training = Training::prepare(config)?;
    let maker = training.maker.clone();
    let batch = config.batch as u64;
    let mut loader = Prefetch::start(config.loader_threads, training.progress.step, move |number| {
        (number * batch..(number + 1) * batch).map(|pair| maker.pair(pair)).collect::<Result<Vec<_>, _>>()
    });
    let mut window = Window::default();
    let mut skipped = 0;
    while training.share_done() < 1.0 {
        let pairs = loader.next_batch().ok_or(LocalizerTrainError::LoaderGone)??;
        match training.step(&pairs)? {
            Some(loss) => {
                window.add(&loss)?;
                skipped = 0;
            }
            None => skipped += 1,
        }
        if skipped >= MAX_SKIPPED {
            return Err(LocalizerTrainError::Diverged(skipped));
        }
        training.progress.step += 1;
        if training.progress.step.is_multiple_of(REPORT_EVERY) {
            let told = training.report(std::mem::take(&mut window));
            training.curve.row(&[
                told.step as f64,
                told.seconds,
                told.loss,
                told.accuracy.top1,
                told.accuracy.offset_m,
            ])?;
            report(&told);
        }
        if training.progress.step.is_multiple_of(config.validate_every) || training.share_done() >= 1.0 {
            if let Some(accuracy) = training.validate()? {
                validated(training.progress.step, &accuracy);
            }
            training.checkpoint()?;
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
    optimizer: AdamW,
    progress: Progress,
    accuracy: Option<EncoderAccuracy>,
    curve: Curve,
    started: Instant,
    seconds_before: f64,
}

impl<'a> Training<'a> {
    fn prepare(config: &'a EncoderTrainConfig) -> Result<Self, LocalizerTrainError> {
        tch::manual_seed(config.seed as i64);
        let variables = VarStore::new(config.device);
        let encoder = SceneEncoder::new(&(variables.root() / "encoder"), &config.encoder)?;
        let contrast = Contrast::new(&(variables.root() / "contrast"), config.encoder.local_channels());
        let mut optimizer = AdamW::new(&variables, AdamWConfig::default());
        let mut progress = Progress { step: 0, seconds: 0.0, seed: config.seed, batch: config.batch };
        if config.resume {
            let stored: Progress = checkpoint::restore(&checkpoint_path(config), &variables, &mut optimizer)?;
            progress = same_training(&progress, stored)?;
        }
        let range_m = config.encoder.range_m;
        let store = Arc::new(SweepStore::read(&config.scenes, range_m)?);
        let maker = PairMaker::new(Arc::clone(&store), config.encoder.clone(), config.seed)?;
        let validation = match config.validation.as_slice() {
            [] => None,
            folders => {
                let store = Arc::new(SweepStore::read(folders, range_m)?);
                Some(PairMaker::new(store, config.encoder.clone(), u64::MAX - config.seed)?)
            }
        };
        let header = "step,seconds,loss,top1,offset_m";
        let curve = Curve::open(&config.out.join("curve.csv"), header, config.resume)?;
        Ok(Self {
            config,
            store,
            maker,
            validation,
            variables,
            encoder,
            contrast,
            optimizer,
            accuracy: None,
            curve,
            started: Instant::now(),
            seconds_before: progress.seconds,
            progress,
        })
    }

    fn seconds(&self) -> f64 {
        self.seconds_before + self.started.elapsed().as_secs_f64()
    }

    fn share_done(&self) -> f64 {
        let epoch = (self.progress.step * self.config.batch as u64) as f64 / self.maker.anchors() as f64;
        self.config.length.share_done(self.progress.step, epoch, self.seconds())
    }

    fn step(&mut self, pairs: &[Pair]) -> Result<Option<ContrastLoss>, LocalizerTrainError> {
        let loss = self.contrast.loss(&self.encoder, pairs, self.config.precision.kind(), self.config.device)?;
        self.optimizer.zero_grad();
        loss.total.f_backward()?;
        let learning_rate = OneCycle { peak: self.config.learning_rate }.at(self.share_done());
        Ok(match self.optimizer.step(learning_rate)? {
            Step::Taken(_) => Some(loss),
            Step::Skipped => None,
        })
    }

    fn report(&self, window: Window) -> EncoderReport {
        let mean = |sum: f64| sum / window.steps.max(1) as f64;
        EncoderReport {
            step: self.progress.step,
            share_done: self.share_done().min(1.0),
            seconds: self.seconds(),
            loss: mean(window.loss),
            accuracy: EncoderAccuracy { top1: mean(window.top1), offset_m: mean(window.offset_m) },
        }
    }

    fn validate(&mut self) -> Result<Option<EncoderAccuracy>, LocalizerTrainError> {
        let Some(maker) = &self.validation else { return Ok(None) };
        let mut window = Window::default();
        for number in 0..VALIDATION_PAIRS {
            let pairs = [maker.pair(2 * number)?, maker.pair(2 * number + 1)?];
            let loss = no_grad(|| {
                self.contrast.loss(&self.encoder, &pairs, self.config.precision.kind(), self.config.device)
            })?;
            window.add(&loss)?;
        }
        self.accuracy = Some(self.report(window).accuracy);
        Ok(self.accuracy)
    }

    fn checkpoint(&mut self) -> Result<(), LocalizerTrainError> {
        self.progress.seconds = self.seconds();
        checkpoint::save(&checkpoint_path(self.config), &self.variables, &self.optimizer, &self.progress)?;
        Ok(())
    }

    fn finish(self) -> Result<EncoderSummary, LocalizerTrainError> {
        // Only the encoder goes out, under the names it is loaded by.
        let encoder = VarStore::new(Device::Cpu);
        SceneEncoder::new(&encoder.root(), &self.config.encoder)?;
        let trained = self.variables.variables();
        for (name, mut variable) in encoder.variables() {
            no_grad(|| variable.f_copy_(&trained[&format!("encoder.{name}")]))?;
        }
        let config = serde_json::to_string(&self.config.encoder).expect("a configuration is JSON");
        let about = BTreeMap::from([
            (CONFIG_KEY.to_owned(), config),
            (KIND_KEY.to_owned(), SceneEncoder::KIND.to_owned()),
            ("seed".to_owned(), self.config.seed.to_string()),
            ("steps".to_owned(), self.progress.step.to_string()),
            ("data_sha256".to_owned(), self.store.listing_sha256.clone()),
        ]);
        let path = self.config.out.join("weights.safetensors");
        let sha256 = weights::save(&path, &encoder, &about, weights::Precision::Half)?;
        Ok(EncoderSummary {
            steps: self.progress.step,
            seconds: self.progress.seconds,
            sweeps: self.store.sweeps.len(),
            accuracy: self.accuracy,
            data_sha256: self.store.listing_sha256.clone(),
            weights: path,
            sha256,
            parameters: encoder.variables().values().map(|tensor| tensor.numel()).sum(),
        })
    }
}

fn checkpoint_path(config: &EncoderTrainConfig) -> PathBuf {
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
}
