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
use super::pose_scale::PoseScale;
use super::sweep_store::SweepList;
use crate::Error;
use localization::baselines::diffloc::{DiffLoc, DiffLocConfig, DiffLocLocalizer};
use perception::train::{Curve, Observe, Progress, RunConfig, SaveEvery, Task, Trained, Trainer};

pub use accuracy::DiffLocAccuracy;
use accuracy::{accuracy, validate};
use augmentation::Augmentation;
use images::SweepImages;
use loss::losses;

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

/// Trains DiffLoc; writes checkpoint, curve and weights into `config.run.out`. Reported are the L1 error of the normalised
/// poses at all steps of the diffusion, the cross entropy of places, and the accuracy on the last batch.
///
/// # Errors
/// [`Error`].
pub fn train_diffloc(
    config: &DiffLocTrainConfig,
    observe: &mut Observe<'_>,
) -> Result<DiffLocSummary, Error> {
    let started = Instant::now();
    let run = &config.run;
    run.start()?;
    if run.device != Device::Cpu {
        Cuda::cudnn_set_benchmark(true);
    }
    let image = config.network.image;
    let mut read = |folders: &[PathBuf], scale| {
        let list = Arc::new(SweepList::open(folders)?);
        let images = SweepImages::read(&list, image, scale, run, &mut |done, total| {
            observe(&Progress::Encoding(done, total))
        })?;
        Ok::<_, Error>((images, list.data()))
    };
    let (images, data) = read(&config.scenes, None)?;
    let validation = match config.validation.as_slice() {
        [] => None,
        folders => Some(read(folders, Some(images.scale))?.0),
    };
    observe(&Progress::Read(data.clone()));
    let PoseScale { origin_m, scale_m } = images.scale;
    let network_config = DiffLocConfig {
        origin_m,
        scale_m,
        ..config.network.clone()
    };
    let variables = VarStore::new(run.device);
    let network = DiffLoc::new(&variables.root(), &network_config)?;
    let (places, width) = ([variables.root() / "places"], network_config.width);
    let places = PlaceClasses::new(places, width, &images.poses, scale_m, run.seed)?;
    let mut trainer = Trainer::begin(run, &variables, None, started)?;
    let mut training = Training {
        config,
        observe,
        network,
        places,
        curve: trainer.curve(CURVE)?,
        variables,
        images,
        validation,
        means: Vec::new(),
        latest: None,
        validated: None,
    };
    trainer.run(&mut training, SaveEvery::Steps(CHECKPOINT_EVERY))?;
    let (variables, kind) = (&training.variables, DiffLocLocalizer::KIND);
    Ok(DiffLocSummary {
        trained: trainer.save_network(variables, kind, &network_config, data)?,
        sweeps: training.images.len() as usize,
        network: network_config,
        validation: training.validated,
    })
}

/// A training in progress.
struct Training<'a> {
    config: &'a DiffLocTrainConfig,
    observe: &'a mut Observe<'a>,
    network: DiffLoc,
    places: PlaceClasses<1>,
    variables: VarStore,
    images: SweepImages,
    validation: Option<SweepImages>,
    curve: Curve,
    /// `[2]` of each step since the last report: L1 of the poses, cross entropy of places.
    means: Vec<Tensor>,
    /// Features `[N, width]` and poses `[N, 5]` of the last step's sweeps.
    latest: Option<[Tensor; 2]>,
    /// The last validation.
    validated: Option<DiffLocAccuracy>,
}

impl Task for Training<'_> {
    type Error = Error;
    /// Between reports nothing waits for the device but the optimizer.
    const REPORT_EVERY: u64 = 50;

    fn variables(&self) -> &VarStore {
        &self.variables
    }

    fn epoch(&self, steps: u64) -> f64 {
        (steps * self.config.run.batch as u64) as f64 / self.images.len() as f64
    }

    /// Order, augmentation and noise follow from seed and step, so a resumed training is the uninterrupted one.
    fn loss(&mut self, trainer: &Trainer) -> Result<Tensor, Error> {
        let (run, images) = (&self.config.run, &self.images);
        let network = &self.config.network;
        tch::manual_seed(run.seed.wrapping_shl(32).wrapping_add(trainer.steps()) as i64);
        let frames = network.frames;
        let windows = images.draw((run.batch as i64 / frames).max(1), frames)?;
        let augmentation = Augmentation {
            image: network.image,
            turn_columns: images::columns_of(self.config.turn_rad as f32, network.image),
            shift_m: self.config.shift_m,
        };
        let batch = augmentation.apply(&windows, frames, &images.scale)?;
        let (network, kind) = (&self.network, run.precision.kind());
        let losses = losses(network, &self.places, &batch, frames, kind)?;
        self.means
            .push(Tensor::f_stack(&[losses.pose, losses.place], 0)?);
        self.latest = Some([losses.features.f_flatten(0, 1)?, batch.poses]);
        Ok(losses.total)
    }

    fn is_report_due(&self, trainer: &Trainer) -> bool {
        trainer.is_report_due(Self::REPORT_EVERY) || self.share_done(trainer) >= 1.0
    }

    /// Also validates before a checkpoint, so that the row of the curve has the result.
    fn report(&mut self, trainer: &Trainer) -> Result<(), Error> {
        let Some([features, poses]) = self.latest.take() else {
            return Ok(());
        };
        let mean = Tensor::f_stack(&self.means, 0)?.f_mean_dim(0_i64, false, Kind::Double)?;
        let (pose_l1, place_loss) = (mean.f_double_value(&[0])?, mean.f_double_value(&[1])?);
        self.means.clear();
        let (network, seconds) = (&self.network, trainer.seconds());
        let found = accuracy(network, &features, &poses, &self.images.scale)?;
        let share_done = self.share_done(trainer);
        let means = vec![pose_l1, place_loss, found.p50_m, found.success_3m];
        let text = format!("poses {pose_l1:.3} places {place_loss:.2}, batch {found}");
        let mut row = [vec![trainer.steps() as f64, seconds], means.clone()].concat();
        (self.observe)(&trainer.step_report(share_done, means, &text));
        let is_saved_next = trainer.steps().is_multiple_of(CHECKPOINT_EVERY) || share_done >= 1.0;
        if let (true, Some(images)) = (is_saved_next, &self.validation) {
            let found = validate(network, images, self.config.run.precision.kind())?;
            let text = format!("{:.0} s: validation {found}", trainer.seconds());
            (self.observe)(&Progress::Validated(text));
            self.validated = Some(found);
        }
        let validated = self.validated;
        row.extend(validated.map_or([f64::NAN; 2], |found| [found.p50_m, found.success_3m]));
        Ok(self.curve.numbers(&row)?)
    }
}
