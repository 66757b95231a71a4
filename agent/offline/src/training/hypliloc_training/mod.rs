//! Training of HypLiLoc on the sweeps of one scene, all of whose inputs lie on the device of the network.

mod augmentation;
mod criterion;
mod examples;

use std::path::PathBuf;
use std::time::Instant;

use tch::nn::VarStore;
use tch::{Cuda, Kind, Tensor};

use super::place_classes::PlaceClasses;
use crate::Error;
use localization::baselines::HypLiLocLocalizer;
use localization::baselines::hypliloc::{HypLiLoc, HypLiLocConfig, WIDTH};
use perception::train::{RunConfig, Trained, Trainer};

use augmentation::augment;
use criterion::{Criteria, mean_errors};
use examples::Examples;

/// Weight of the classification of places by each branch.
const PLACE_WEIGHT: f64 = 0.5;
/// Steps between two reports.
const REPORT_EVERY: u64 = 20;
/// Steps between two checkpoints.
const CHECKPOINT_EVERY: u64 = 2000;

/// Configuration of a training of HypLiLoc.
#[derive(Debug, Clone)]
pub struct HypLiLocTrainConfig {
    /// Folders of sweeps, all of one scene.
    pub scenes: Vec<PathBuf>,
    /// Name of the scene.
    pub scene_name: String,
    /// Largest turn of the sensor, radians.
    pub turn_rad: f64,
    /// Training run; a batch are sweeps. Its time begins when all inputs are computed.
    pub run: RunConfig,
}

/// Progress of a training of HypLiLoc.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum HypLiLocReport {
    /// Inputs are being computed: number of sweeps done and of all.
    Sampling(usize, usize),
    /// Some steps are done.
    Stepped {
        /// Number of steps done.
        step: u64,
        /// Share of the training that is done, 0..1.
        share_done: f64,
        /// Seconds spent.
        seconds: f64,
        /// Mean position error of the fusion since the last report, metres.
        error_m: f64,
        /// Mean heading error of the fusion since the last report, degrees.
        error_deg: f64,
        /// Mean cross entropy of places by points, image and fusion since the last report.
        place_losses: [f64; 3],
    },
}

/// Trains a network; writes checkpoint and weights into `config.run.out`.
///
/// # Errors
/// [`Error`].
pub fn train_hypliloc(
    config: &HypLiLocTrainConfig,
    observe: &mut dyn FnMut(&HypLiLocReport),
) -> Result<Trained, Error> {
    let run = &config.run;
    run.start()?;
    let examples = Examples::read(&config.scenes, run, &mut |done, all| {
        observe(&HypLiLocReport::Sampling(done, all))
    })?;
    let variables = VarStore::new(run.device);
    let network = HypLiLoc::new(&variables.root());
    let criteria = Criteria::new(&(variables.root() / "criteria"));
    let places = ["points", "image", "fusion"].map(|branch| variables.root() / "places" / branch);
    let places = PlaceClasses::new(
        places,
        WIDTH,
        &examples.poses()?,
        examples.deviation_m,
        run.seed,
    )?;
    let mut trainer = Trainer::begin(run, &variables, None, Instant::now())?;
    // The tensor library draws all random numbers of a step, on the device.
    tch::manual_seed(run.seed.wrapping_add(trainer.steps()) as i64);
    Cuda::cudnn_set_benchmark(run.device.is_cuda());
    let share_done = |trainer: &Trainer| {
        trainer.share_done((trainer.steps() * run.batch as u64) as f64 / examples.len() as f64)
    };
    let mut reported = trainer.steps();
    let mut sums = Tensor::f_zeros([5], (Kind::Float, run.device))?;
    while share_done(&trainer) < 1.0 {
        let (batch, truth) = augment(examples.draw(run.batch as i64)?, config.turn_rad)?;
        let poses = network.forward(&batch, run.precision.kind(), true)?;
        let place_losses = places.losses(poses.features.each_ref(), &truth.poses()?)?;
        let loss = criteria.loss(&poses, &truth)? + place_losses.f_sum(Kind::Float)? * PLACE_WEIGHT;
        trainer.step(&loss, share_done(&trainer))?;
        trainer.check_interruption(&variables)?;
        let errors = mean_errors(&poses.fusion, &truth, &examples.scale_m)?;
        sums += Tensor::f_cat(&[errors, place_losses.f_detach()?], 0)?;
        let step = trainer.steps();
        if trainer.is_report_due(REPORT_EVERY) {
            let steps = (step - reported) as f64;
            reported = step;
            let mean: Vec<f64> = Vec::try_from(&(&sums / steps).f_to_kind(Kind::Double)?)?;
            let _ = sums.f_zero_()?;
            observe(&HypLiLocReport::Stepped {
                step,
                share_done: share_done(&trainer).min(1.0),
                seconds: trainer.seconds(),
                error_m: mean[0],
                error_deg: mean[1].to_degrees(),
                place_losses: [mean[2], mean[3], mean[4]],
            });
        }
        if step.is_multiple_of(CHECKPOINT_EVERY) {
            trainer.checkpoint(&variables)?;
        }
    }
    trainer.checkpoint(&variables)?;
    let network_config = HypLiLocConfig {
        scene_name: config.scene_name.clone(),
        origin_m: examples.origin_m,
        scale_m: examples.deviation_m,
    };
    Ok(trainer.save_network(
        &variables,
        HypLiLocLocalizer::KIND,
        &network_config,
        examples.data,
    )?)
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;
    use std::path::Path;

    use localization::baselines::load_baseline;
    use localization::pgc::LocalizerInput;
    use localization::pgc::pose_solver::PoseSolver;
    use perception::train::Length;
    use protocol::PointCloud;
    use simulator::generate::{Subset, SynthOptions, generate};
    use tch::Device;

    use super::*;

    fn config(scene: &Path, out: &Path, steps: u64) -> HypLiLocTrainConfig {
        let run = RunConfig {
            batch: 2,
            ..RunConfig::new(Length::Steps(steps), out)
        };
        HypLiLocTrainConfig {
            scenes: vec![scene.to_owned()],
            scene_name: "small".into(),
            turn_rad: PI,
            run,
        }
    }

    #[test]
    fn a_training_is_resumed_and_its_weights_are_opened_by_their_kind() {
        tch::set_num_threads(1);
        let folder = tempfile::tempdir().unwrap();
        let (scene, out) = (folder.path().join("scene"), folder.path().join("out"));
        let drive = SynthOptions {
            frames: 2,
            ..SynthOptions::new(Subset::Town1loc, 400, scene.clone())
        };
        generate(&drive, &|_| ()).unwrap();
        let mut sampled = 0;
        let mut observe = |report: &HypLiLocReport| {
            if let HypLiLocReport::Sampling(done, _) = report {
                sampled = *done;
            }
        };
        assert_eq!(
            train_hypliloc(&config(&scene, &out, 2), &mut observe)
                .unwrap()
                .steps,
            2
        );
        assert!(sampled >= 2, "{sampled}");
        let mut resumed = config(&scene, &out, 3);
        resumed.run.resume = true;
        let trained = train_hypliloc(&resumed, &mut |_| ()).unwrap();
        assert_eq!(trained.steps, 3);
        assert!(trained.weights.metadata().unwrap().len() < 10_000_000);
        let mut localizer =
            load_baseline(&trained.weights, Device::Cpu, PoseSolver::default()).unwrap();
        let wall = (0..4000).map(|k| [(k % 60) as f32 - 30.0, 9.0, (k / 60) as f32 * 0.1, 0.2]);
        let answer = localizer
            .localize(LocalizerInput::of(&PointCloud {
                xyzi: wall.collect(),
            }))
            .unwrap();
        assert!(answer.estimate.world_from_cav().is_some(), "{answer:?}");
    }
}
