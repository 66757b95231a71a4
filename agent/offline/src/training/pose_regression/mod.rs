//! Training of the networks that regress poses, DiffLoc and HypLiLoc: tokens of all sweeps are computed once by PGC's
//! frozen encoder, the steps run on them alone.

mod accuracy;
mod losses;
mod token_cache;

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use localization::baselines::diffloc::DiffLoc;
use localization::baselines::hypliloc::HypLiLoc;
use localization::baselines::place_classes::PlaceClasses;
use localization::baselines::tokens::SECTORS;
use localization::baselines::{PoseRegressor, PoseRegressorConfig};
use localization::pgc::SceneEncoder;
use perception::train::{
    Curve, Observe, RunConfig, SaveEvery, Task, Trained, Trainer, TrainingEvent,
};
use tch::nn::VarStore;
use tch::{Kind, TchError, Tensor};

pub use accuracy::RegressionAccuracy;
use accuracy::accuracy;
use losses::PoseLoss;
use token_cache::{PooledSweeps, TokenCache, TokenSweeps};

use super::sgloc_training::adopt_encoder;
use super::sweep_store::mean_position_m;
use super::{SweepList, kmeans};
use crate::Error;

/// Largest number of place classes.
const CLASSES: usize = 256;
/// Steps between two checkpoints and validations.
const CHECKPOINT_EVERY: u64 = 1000;
/// Columns of the training curve.
const CURVE: &str =
    "step,seconds,pose_l1,place_loss,p50_m,success_3m,validation_p50_m,validation_success_3m";

/// Configuration of a training.
#[derive(Debug, Clone)]
pub struct PoseRegressionConfig {
    /// Folders of sweeps, all of one scene.
    pub scenes: Vec<PathBuf>,
    /// Folders of sweeps of the same scene that are measured from time to time; may be empty.
    pub validation: Vec<PathBuf>,
    /// Name of the scene.
    pub scene_name: String,
    /// Weights of the frozen encoder.
    pub encoder: PathBuf,
    /// Largest turn of the sensor, radians; turns are by whole sectors.
    pub turn_rad: f64,
    /// Training run; a batch are sweeps. Its time begins when all tokens are computed.
    pub run: RunConfig,
}

/// Result of a training.
#[derive(Debug, Clone)]
pub struct PoseRegressionSummary {
    /// Weights, steps and time.
    pub trained: Trained,
    /// Number of sweeps.
    pub sweeps: usize,
    /// Configuration as in the weights.
    pub network: PoseRegressorConfig,
    /// The last validation.
    pub validation: Option<RegressionAccuracy>,
}

/// Trains DiffLoc. See [`train_hypliloc`].
///
/// # Errors
/// [`Error`].
pub fn train_diffloc(
    config: &PoseRegressionConfig,
    observe: &mut Observe<'_>,
) -> Result<PoseRegressionSummary, Error> {
    train::<DiffLoc>(config, observe)
}

/// Trains HypLiLoc; writes checkpoint, curve and weights into `config.run.out`. Reported are the L1 error of the poses
/// relative to their classes, the cross entropy of places, and the accuracy on the last batch.
///
/// # Errors
/// [`Error`].
pub fn train_hypliloc(
    config: &PoseRegressionConfig,
    observe: &mut Observe<'_>,
) -> Result<PoseRegressionSummary, Error> {
    train::<HypLiLoc>(config, observe)
}

fn train<N: PoseLoss>(
    config: &PoseRegressionConfig,
    observe: &mut Observe<'_>,
) -> Result<PoseRegressionSummary, Error> {
    let run = &config.run;
    run.start()?;
    let encoder = SceneEncoder::load(&config.encoder, run.device)?;
    let mut read = |folders: &[PathBuf]| {
        let list = Arc::new(SweepList::open(folders)?);
        let sweeps = PooledSweeps::encode(&list, &encoder, run, observe)?;
        Ok::<_, Error>((sweeps, list.data()))
    };
    let (sweeps, data) = read(&config.scenes)?;
    let validation = match config.validation.as_slice() {
        [] => None,
        folders => Some(read(folders)?.0),
    };
    observe(&TrainingEvent::Read(data.clone()));
    let count = sweeps.world_from_sensor.len();
    let network_config = PoseRegressorConfig {
        scene_name: config.scene_name.clone(),
        origin_m: mean_position_m(&sweeps.world_from_sensor),
        classes: CLASSES.min(count) as i64,
        encoder: encoder.config().clone(),
    };
    let variables = VarStore::new(run.device);
    let mut network = PoseRegressor::<N>::new(&variables.root(), &network_config)?;
    adopt_encoder(&variables, &config.encoder, &network_config.encoder)?;
    sweeps.fit(&mut network.projection)?;
    let cache = sweeps.cache(&network.projection, network_config.origin_m)?;
    let centres = centres(&cache.sweeps.poses, run.seed)?;
    network.places.set(&centres)?;
    let validation = validation.map(|of| of.cache(&network.projection, network_config.origin_m));
    let validation = validation.transpose()?;
    // Only tokens are needed from here on: the memory of the pooled features is freed.
    drop(sweeps);
    // The time of the training begins here: reading and encoding do not count.
    let trainer = Trainer::begin(run, &variables, None, Instant::now())?;
    let mut trainer = trainer.on_data(&data.sha256)?;
    let mut training = PoseTraining {
        run,
        sectors: (config.turn_rad / std::f64::consts::TAU * SECTORS as f64).round() as i64,
        observe,
        network,
        curve: trainer.curve(CURVE)?,
        cache,
        validation,
        means: Vec::new(),
        latest: None,
        validated: None,
    };
    trainer.run(&mut training, SaveEvery::Steps(CHECKPOINT_EVERY))?;
    Ok(PoseRegressionSummary {
        trained: trainer.save_network(&variables, N::KIND, &network_config, data)?,
        sweeps: count,
        network: network_config,
        validation: training.validated,
    })
}

/// Centres of the classes of training poses `[S, 5]`.
fn centres(poses: &Tensor, seed: u64) -> Result<Vec<[f64; 5]>, TchError> {
    let metres = PlaceClasses::in_metres(poses)?.f_to_kind(Kind::Double)?;
    let rows: Vec<f64> = Vec::try_from(&metres.f_reshape([-1])?)?;
    let (centres, _) = kmeans(rows.as_chunks::<5>().0, CLASSES, seed);
    Ok(centres)
}

/// A training in progress.
struct PoseTraining<'a, N> {
    run: &'a RunConfig,
    /// Largest turn.
    sectors: i64,
    observe: &'a mut Observe<'a>,
    network: PoseRegressor<N>,
    cache: TokenCache,
    validation: Option<TokenCache>,
    curve: Curve,
    /// `[2]` of each step since the last report: L1 of the poses, cross entropy of places.
    means: Vec<Tensor>,
    /// The last step's sweeps.
    latest: Option<TokenSweeps>,
    /// The last validation.
    validated: Option<RegressionAccuracy>,
}

impl<N: PoseLoss> Task for PoseTraining<'_, N> {
    type Error = Error;
    /// Between reports nothing waits for the device but the optimizer.
    const REPORT_EVERY: u64 = 50;

    fn epoch(&self, steps: u64) -> f64 {
        (steps * self.run.batch as u64) as f64 / self.cache.len() as f64
    }

    /// Order, augmentation and noise follow from seed and step, so a resumed training is the uninterrupted one.
    fn loss(&mut self, trainer: &Trainer) -> Result<Tensor, Error> {
        let run = self.run;
        // Seed in the upper half, step in the lower one: no two steps draw the same.
        tch::manual_seed(run.seed.wrapping_shl(32).wrapping_add(trainer.steps()) as i64);
        let windows = (run.batch as i64 / N::FRAMES).max(1);
        let batch = self.cache.draw(windows, N::FRAMES)?;
        let batch = batch.augmented(N::FRAMES, self.sectors)?;
        let (network, places) = (&self.network.network, &self.network.places);
        let share_done = self.share_done(trainer);
        let kind = run.precision.kind();
        let (total, of_parts) = network.losses(&batch, places, kind, share_done)?;
        self.means.push(Tensor::f_stack(&of_parts, 0)?);
        self.latest = Some(batch);
        Ok(total)
    }

    fn is_report_due(&self, trainer: &Trainer) -> bool {
        trainer.is_report_due(Self::REPORT_EVERY) || self.share_done(trainer) >= 1.0
    }

    /// Also validates before a checkpoint, so that the row of the curve has the result.
    fn report(&mut self, trainer: &Trainer) -> Result<(), Error> {
        let Some(batch) = self.latest.take() else {
            return Ok(());
        };
        let mean = Tensor::f_stack(&self.means, 0)?.f_mean_dim(0_i64, false, Kind::Double)?;
        let (pose_l1, place_loss) = (mean.f_double_value(&[0])?, mean.f_double_value(&[1])?);
        self.means.clear();
        let (kind, seconds) = (self.run.precision.kind(), trainer.seconds());
        let found = accuracy(&self.network, &batch, kind)?;
        let share_done = self.share_done(trainer);
        let means = vec![pose_l1, place_loss, found.p50_m, found.success_3m];
        let text = format!("poses {pose_l1:.3} places {place_loss:.2}, batch {found}");
        let mut row = [vec![trainer.steps() as f64, seconds], means.clone()].concat();
        (self.observe)(&trainer.step_report(share_done, means, &text));
        // As the trainer decides: a checkpoint follows after this report.
        let is_saved_next = trainer.steps().is_multiple_of(CHECKPOINT_EVERY) || share_done >= 1.0;
        if let (true, Some(cache)) = (is_saved_next, &self.validation) {
            let found = accuracy(&self.network, &cache.sweeps, kind)?;
            let text = format!("{:.0} s: validation {found}", trainer.seconds());
            (self.observe)(&TrainingEvent::Validated(text));
            self.validated = Some(found);
        }
        let validated = self.validated;
        row.extend(validated.map_or([f64::NAN; 2], |found| [found.p50_m, found.success_3m]));
        Ok(self.curve.numbers(&row)?)
    }
}
