//! Training of DiffLoc on the sweeps of one scene: range images are computed once, the steps run on the device alone.

mod accuracy;
mod augmentation;
mod images;
mod loss;

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use tch::nn::VarStore;
use tch::{Cuda, Device, Kind, Tensor};

use super::place_classes::PlaceClasses;
use super::sweep_store::SweepList;
use crate::Error;
use localization::baselines::diffloc::{DiffLoc, DiffLocConfig, DiffLocLocalizer};
use perception::train::{RunConfig, Trained, Trainer};

pub use accuracy::DiffLocAccuracy;
use accuracy::{accuracy, validate};
use augmentation::Augmentation;
use images::{Normalisation, SweepImages};
use loss::losses;

/// Steps between two reports; between them nothing waits for the device but the optimizer.
const REPORT_EVERY: u64 = 50;
/// Steps between two checkpoints and validations.
const CHECKPOINT_EVERY: u64 = 1000;
/// Columns of the training curve.
const CURVE: &str =
    "step,seconds,pose_l1,place_loss,p50_m,success_3m,validation_p50_m,validation_success_3m";

/// Configuration of a training of DiffLoc.
#[derive(Debug, Clone)]
pub struct DiffLocTrainConfig {
    /// Folders of sweeps, all of one scene.
    pub scenes: Vec<PathBuf>,
    /// Folders of sweeps of the same scene that are measured from time to time; may be empty.
    pub validation: Vec<PathBuf>,
    /// Sizes and name of the scene; origin and scale are set by the sweeps.
    pub network: DiffLocConfig,
    /// Largest turn of the sensor, radians.
    pub turn_rad: f64,
    /// Largest shift of the sensor along each horizontal axis, metres.
    pub shift_m: f64,
    /// Training run; a batch are sweeps.
    pub run: RunConfig,
}

/// Progress of a training of DiffLoc.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum DiffLocReport {
    /// Range images are being computed: number done and number of all.
    Imaging(usize, usize),
    /// Some steps are done.
    Stepped {
        /// Number of steps done.
        step: u64,
        /// Share of the training that is done, 0..1.
        share_done: f64,
        /// Seconds spent.
        seconds: f64,
        /// Mean L1 of the normalised poses, at all steps of the diffusion, since the last report.
        pose_l1: f64,
        /// Mean cross entropy of places since the last report.
        place_loss: f64,
        /// Accuracy on the last batch.
        accuracy: DiffLocAccuracy,
    },
    /// Sweeps that are not trained on were localized, after so many seconds.
    Validated(f64, DiffLocAccuracy),
}

/// Result of a training of DiffLoc.
#[derive(Debug, Clone)]
pub struct DiffLocSummary {
    /// Weights, steps and time.
    pub trained: Trained,
    /// Number of sweeps.
    pub sweeps: usize,
    /// Configuration as in the weights.
    pub network: DiffLocConfig,
    /// The last validation.
    pub validation: Option<DiffLocAccuracy>,
}

/// Trains DiffLoc; writes checkpoint, curve and weights into `config.run.out`.
///
/// # Errors
/// [`Error`].
pub fn train_diffloc(
    config: &DiffLocTrainConfig,
    observe: &mut dyn FnMut(&DiffLocReport),
) -> Result<DiffLocSummary, Error> {
    let started = Instant::now();
    let run = &config.run;
    run.start()?;
    if run.device != Device::Cpu {
        Cuda::cudnn_set_benchmark(true);
    }
    let list = Arc::new(SweepList::open(&config.scenes)?);
    let mut imaging = |done, total| observe(&DiffLocReport::Imaging(done, total));
    let images = SweepImages::read(&list, config.network.image, None, run, &mut imaging)?;
    let Normalisation { origin_m, scale_m } = images.normalisation;
    let validation = match config.validation.as_slice() {
        [] => None,
        folders => {
            let list = Arc::new(SweepList::open(folders)?);
            let normalisation = Some(images.normalisation);
            Some(SweepImages::read(
                &list,
                config.network.image,
                normalisation,
                run,
                &mut imaging,
            )?)
        }
    };
    let network_config = DiffLocConfig {
        origin_m,
        scale_m,
        ..config.network.clone()
    };
    let variables = VarStore::new(run.device);
    let network = DiffLoc::new(&variables.root(), &network_config)?;
    let places = [variables.root() / "places"];
    let places = PlaceClasses::new(
        places,
        network_config.width,
        &images.poses,
        scale_m,
        run.seed,
    )?;
    let trainer = Trainer::begin(run, &variables, None, started)?;
    let mut training = Training {
        config,
        network,
        places,
        variables,
        images,
        validation,
        trainer,
        last: None,
    };
    training.run(observe)?;
    Ok(DiffLocSummary {
        trained: training.trainer.save_network(
            &training.variables,
            DiffLocLocalizer::KIND,
            &network_config,
            list.data(),
        )?,
        sweeps: training.images.len() as usize,
        network: network_config,
        validation: training.last,
    })
}

/// A training in progress.
struct Training<'a> {
    config: &'a DiffLocTrainConfig,
    network: DiffLoc,
    places: PlaceClasses<1>,
    variables: VarStore,
    images: SweepImages,
    validation: Option<SweepImages>,
    trainer: Trainer,
    /// The last validation.
    last: Option<DiffLocAccuracy>,
}

impl Training<'_> {
    fn run(&mut self, observe: &mut dyn FnMut(&DiffLocReport)) -> Result<(), Error> {
        let mut curve = self.trainer.curve(CURVE)?;
        let mut means = Vec::new();
        while self.share_done() < 1.0 {
            let losses = self.step()?;
            self.trainer.check_interruption(&self.variables)?;
            means.push(losses.means);
            let step = self.trainer.steps();
            if self.trainer.is_report_due(REPORT_EVERY) || self.share_done() >= 1.0 {
                let mean = Tensor::f_stack(&means, 0)?.f_mean_dim(0_i64, false, Kind::Double)?;
                let (pose_l1, place_loss) =
                    (mean.f_double_value(&[0])?, mean.f_double_value(&[1])?);
                means.clear();
                let seconds = self.trainer.seconds();
                let accuracy = accuracy(
                    &self.network,
                    &losses.features,
                    &losses.poses,
                    &self.images.normalisation,
                )?;
                let share_done = self.share_done().min(1.0);
                observe(&DiffLocReport::Stepped {
                    step,
                    share_done,
                    seconds,
                    pose_l1,
                    place_loss,
                    accuracy,
                });
                if step.is_multiple_of(CHECKPOINT_EVERY) || share_done >= 1.0 {
                    self.trainer.checkpoint(&self.variables)?;
                    self.validate(observe)?;
                }
                let of = |accuracy: DiffLocAccuracy| [accuracy.p50_m, accuracy.success_3m];
                let validated = self.last.map_or([f64::NAN; 2], of);
                curve.numbers(
                    &[
                        &[step as f64, seconds, pose_l1, place_loss],
                        &of(accuracy)[..],
                        &validated,
                    ]
                    .concat(),
                )?;
            }
        }
        Ok(())
    }

    fn share_done(&self) -> f64 {
        let sweeps = self.trainer.steps() * self.config.run.batch as u64;
        self.trainer
            .share_done(sweeps as f64 / self.images.len() as f64)
    }

    /// Order, augmentation and noise follow from seed and step, so a resumed training is the uninterrupted one.
    fn step(&mut self) -> Result<StepLosses, Error> {
        let Self {
            config,
            network,
            places,
            images,
            ..
        } = self;
        let run = &config.run;
        tch::manual_seed(run.seed.wrapping_shl(32).wrapping_add(self.trainer.steps()) as i64);
        let frames = config.network.frames;
        let windows = images.draw((run.batch as i64 / frames).max(1), frames)?;
        let augmentation = Augmentation {
            image: config.network.image,
            turn_columns: images::columns_of(config.turn_rad as f32, config.network.image),
            shift_m: config.shift_m,
        };
        let batch = augmentation.apply(&windows, frames, &images.normalisation)?;
        let losses = losses(network, places, &batch, frames, run.precision.kind())?;
        let share_done = self.share_done();
        self.trainer.step(&losses.total, share_done)?;
        let means = Tensor::f_stack(&[losses.pose, losses.place], 0)?;
        Ok(StepLosses {
            means,
            features: losses.features.f_flatten(0, 1)?,
            poses: batch.poses,
        })
    }

    fn validate(&mut self, observe: &mut dyn FnMut(&DiffLocReport)) -> Result<(), Error> {
        if let Some(images) = &self.validation {
            let accuracy = validate(&self.network, images, self.config.run.precision.kind())?;
            observe(&DiffLocReport::Validated(self.trainer.seconds(), accuracy));
            self.last = Some(accuracy);
        }
        Ok(())
    }
}

/// A step's loss and sweeps, on the device.
struct StepLosses {
    /// `[2]`: L1 of the poses, cross entropy of places.
    means: Tensor,
    /// `[N, width]`.
    features: Tensor,
    /// `[N, 5]`.
    poses: Tensor,
}
