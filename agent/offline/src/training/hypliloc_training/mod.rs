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
use perception::train::{Observe, Progress, RunConfig, SaveEvery, Task, Trained, Trainer};

use augmentation::augment;
use criterion::{Criteria, mean_errors};
use examples::Examples;

/// Weight of the classification of places by each branch.
const PLACE_WEIGHT: f64 = 0.5;
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

/// Trains a network; writes checkpoint and weights into `config.run.out`. Reported are the errors of the fusion's position
/// (metres) and heading (degrees), and the cross entropies of places by points, image and fusion.
///
/// # Errors
/// [`Error`].
pub fn train_hypliloc(
    config: &HypLiLocTrainConfig,
    observe: &mut Observe<'_>,
) -> Result<Trained, Error> {
    let run = &config.run;
    run.start()?;
    let (examples, scale, data) = Examples::read(&config.scenes, run, &mut |done, all| {
        observe(&Progress::Encoding(done, all))
    })?;
    observe(&Progress::Read(data.clone()));
    let variables = VarStore::new(run.device);
    let network = HypLiLoc::new(&variables.root());
    let criteria = Criteria::new(&(variables.root() / "criteria"));
    let places = ["points", "image", "fusion"].map(|branch| variables.root() / "places" / branch);
    let places = PlaceClasses::new(places, WIDTH, &examples.poses, scale.scale_m, run.seed)?;
    let mut trainer = Trainer::begin(run, &variables, None, Instant::now())?;
    // The tensor library draws all random numbers of a step, on the device.
    tch::manual_seed(run.seed.wrapping_add(trainer.steps()) as i64);
    Cuda::cudnn_set_benchmark(run.device.is_cuda());
    let mut training = Training {
        config,
        observe,
        examples,
        unit_m: scale.unit_m(run.device)?,
        variables,
        network,
        criteria,
        places,
        reported: trainer.steps(),
        sums: Tensor::f_zeros([5], (Kind::Float, run.device))?,
    };
    trainer.run(&mut training, SaveEvery::Steps(CHECKPOINT_EVERY))?;
    let network_config = HypLiLocConfig {
        scene_name: config.scene_name.clone(),
        origin_m: scale.origin_m,
        scale_m: scale.scale_m,
    };
    let (variables, kind) = (&training.variables, HypLiLocLocalizer::KIND);
    Ok(trainer.save_network(variables, kind, &network_config, data)?)
}

struct Training<'a> {
    config: &'a HypLiLocTrainConfig,
    observe: &'a mut Observe<'a>,
    examples: Examples,
    /// `[3]`: unit of positions.
    unit_m: Tensor,
    variables: VarStore,
    network: HypLiLoc,
    criteria: Criteria,
    places: PlaceClasses<3>,
    /// Step of the last report.
    reported: u64,
    /// `[5]` on the device, since then: errors of position and heading, losses of places.
    sums: Tensor,
}

impl Task for Training<'_> {
    type Error = Error;
    const REPORT_EVERY: u64 = 20;

    fn variables(&self) -> &VarStore {
        &self.variables
    }

    fn epoch(&self, steps: u64) -> f64 {
        (steps * self.config.run.batch as u64) as f64 / self.examples.inputs.len() as f64
    }

    fn loss(&mut self, _: &Trainer) -> Result<Tensor, Error> {
        let run = &self.config.run;
        let drawn = self.examples.draw(run.batch as i64)?;
        let Examples { inputs, poses } = augment(&drawn, self.config.turn_rad)?;
        let found = self.network.forward(&inputs, run.precision.kind(), true)?;
        let place_losses = self.places.losses(found.features.each_ref(), &poses)?;
        let places = place_losses.f_sum(Kind::Float)? * PLACE_WEIGHT;
        let loss = self.criteria.loss(&found, &poses)? + places;
        let errors = mean_errors(&found.fusion, &poses, &self.unit_m)?;
        self.sums += Tensor::f_cat(&[errors, place_losses.f_detach()?], 0)?;
        Ok(loss)
    }

    fn report(&mut self, trainer: &Trainer) -> Result<(), Error> {
        let steps = (trainer.steps() - self.reported) as f64;
        self.reported = trainer.steps();
        let mean = (&self.sums / steps).f_to_kind(Kind::Double)?;
        let _ = self.sums.f_zero_()?;
        let mut means: Vec<f64> = Vec::try_from(&mean)?;
        means[1] = means[1].to_degrees();
        let [error_m, error_deg, points, image, fusion] = [0, 1, 2, 3, 4].map(|of| means[of]);
        let places = format!("places {points:.2} {image:.2} {fusion:.2}");
        let text = format!("error {error_m:.2} m {error_deg:.1} deg, {places}");
        let report = trainer.step_report(self.share_done(trainer), means, &text);
        (self.observe)(&report);
        Ok(())
    }
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
        let mut observe = |progress: &Progress| {
            if let Progress::Encoding(done, _) = progress {
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
