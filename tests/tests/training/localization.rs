//! Localizer from random weights: generated drives, an encoder, a head, and poses from sweeps only.

use std::path::{Path, PathBuf};
use std::time::Duration;

use agent_offline::Error;
use agent_offline::training::{
    EncoderTrainConfig, LeaveOut, PoseRegressionConfig, PoseRegressionSummary, SceneTrainConfig,
    SgLocTrainConfig, SweepAugmentation, train_diffloc, train_encoder, train_hypliloc, train_scene,
    train_sgloc,
};
use dataset::{self, LoadOptions};
use localization::baselines::load_baseline;
use localization::baselines::sgloc::SgLocConfig;
use localization::pgc::pose_solver::PoseSolver;
use localization::pgc::{Localize, Localizer, LocalizerInput, SceneEncoder};
use perception::inference::Inference;
use perception::train::{Length, Observe, RunConfig, TrainingError, TrainingEvent};
use perception::weights::Weights;
use protocol::{NoPoseReason, PointCloud, PoseError, PoseEstimate};
use simulator::generate::{Subset, SynthOptions, generate};
use tch::Device;
use tch::nn::VarStore;
use tests::localizer::small_encoder;
use tests::locks::random_generator_lock;

/// Two short drives through one town, at whose crossings they meet themselves and each other.
fn drives(out: &Path) -> PathBuf {
    let folder = out.join("drives");
    let options = SynthOptions {
        scenes: 2,
        frames: 24,
        period_s: 0.5,
        ..SynthOptions::new(Subset::Town1loc, 11, folder.clone())
    };
    generate(&options, &|_| {}).unwrap();
    folder
}

fn run(out: &Path, steps: u64) -> RunConfig {
    RunConfig {
        seed: 5,
        loader_threads: 2,
        ..RunConfig::new(Length::Steps(steps), out)
    }
}

fn encoder_config(scenes: &Path, out: &Path, steps: u64) -> EncoderTrainConfig {
    EncoderTrainConfig {
        scenes: vec![scenes.to_owned()],
        validation: vec![scenes.to_owned()],
        encoder: small_encoder(),
        run: RunConfig {
            batch: 2,
            learning_rate: 3e-3,
            ..run(out, steps)
        },
        validate_every: 10,
    }
}

fn scene_config(scenes: &Path, encoder: &Path, out: &Path, steps: u64) -> SceneTrainConfig {
    SceneTrainConfig {
        init: None,
        scenes: vec![scenes.to_owned()],
        validation: vec![scenes.to_owned()],
        validation_sweeps: 12,
        encoder: encoder.to_owned(),
        scene_name: "small".into(),
        classes: 4,
        centres: 12,
        width: 64,
        blocks: 1,
        refiner: true,
        augmentation: SweepAugmentation {
            copies: 1,
            turn_rad: 0.1,
            keep: 0.8,
        },
        redundancy: Some(LeaveOut::EvenLoss),
        run: RunConfig {
            batch: 512,
            learning_rate: 4e-3,
            ..run(out, steps)
        },
        validate_every: Duration::from_secs(3600),
    }
}

fn trained_encoder(scenes: &Path, out: &Path) -> PathBuf {
    let mut losses = Vec::new();
    let mut validations = 0;
    let config = encoder_config(scenes, out, 40);
    let mut observe = |progress: &TrainingEvent| match progress {
        TrainingEvent::Read(data) => assert_eq!(data.left_out(), None),
        TrainingEvent::Stepped(report) => losses.push(report.means[0]),
        TrainingEvent::Validated(_) => validations += 1,
        other => panic!("{other:?}"),
    };
    let summary = train_encoder(&config, &mut observe).unwrap();
    assert_eq!((summary.trained.steps, validations), (40, 4));
    assert!(losses.last().unwrap() < &(0.9 * losses[0]), "{losses:?}");
    assert!(
        summary.accuracy.unwrap().top1 > 0.005,
        "chance is below one in five hundred: {:?}",
        summary.accuracy
    );
    summary.trained.weights
}

#[test]
fn a_localizer_learns_two_drives_and_finds_itself_on_them() {
    let _generator = random_generator_lock();
    let dir = tempfile::tempdir().unwrap();
    let scenes = drives(dir.path());
    let encoder = trained_encoder(&scenes, &dir.path().join("encoder"));

    let mut errors = Vec::new();
    let config = scene_config(&scenes, &encoder, &dir.path().join("head"), 400);
    let summary = train_scene(&config, &mut |progress| {
        if let TrainingEvent::Stepped(report) = progress {
            errors.push(report.means[0]);
        }
    })
    .unwrap();
    assert!(errors.last().unwrap() < &(0.3 * errors[0]), "{errors:?}");
    assert!(
        summary.accuracy.unwrap().success_3m > 0.5,
        "{:?}",
        summary.accuracy
    );

    let mut localizer =
        Localizer::load(&encoder, &summary.trained.weights, Inference::default()).unwrap();
    let dataset = dataset::open(&scenes).unwrap();
    let mut found = 0;
    for tick in 0..12 {
        let frame = dataset.scenarios[0]
            .load(0, 2 * tick, &LoadOptions::default())
            .unwrap();
        let answer = localizer
            .localize(LocalizerInput::of(&frame.points))
            .unwrap();
        let Some(pose) = answer.estimate.world_from_cav() else {
            continue;
        };
        let off = pose.isometry().translation.vector
            - frame
                .world_from_lidar
                .unwrap()
                .isometry()
                .translation
                .vector;
        found += usize::from(off.norm() < 3.0);
        assert!((0.0..=1.0).contains(&answer.estimate.confidence()));
        assert_eq!(
            localizer
                .localize(LocalizerInput::of(&frame.points))
                .unwrap()
                .estimate,
            answer.estimate,
            "same sweep, same answer"
        );
    }
    assert!(found >= 7, "{found} of 12");

    // A sweep that cannot be localised has a reason and no pose.
    let nan = PointCloud {
        xyzi: vec![[f32::NAN; 4]; 5000],
    };
    let few = PointCloud {
        xyzi: (0..10).map(|k| [k as f32, 3.0, 0.5, 0.1]).collect(),
    };
    for cloud in [PointCloud::default(), nan, few] {
        let estimate = localizer
            .localize(LocalizerInput::of(&cloud))
            .unwrap()
            .estimate;
        assert_eq!(
            estimate,
            PoseEstimate::NoPose {
                reason: NoPoseReason::TooFewPoints,
                inlier_count: 0
            }
        );
    }

    // A head belongs to one encoder.
    let other = dir.path().join("other");
    let mut config = encoder_config(&scenes, &other, 1);
    config.run.seed = 6;
    train_encoder(&config, &mut |_| ()).unwrap();
    let error = Localizer::load(
        &other.join("weights.safetensors"),
        &summary.trained.weights,
        Inference::default(),
    )
    .unwrap_err();
    let message = error.to_string();
    assert!(message.contains("trained on encoder"), "{message}");
    // And an encoder is no head.
    let message = Localizer::load(&encoder, &encoder, Inference::default())
        .unwrap_err()
        .to_string();
    assert!(
        message.contains("weights.safetensors") && message.contains("\"scene encoder\""),
        "{message}"
    );
}

#[test]
fn sgloc_learns_on_the_features_of_an_encoder_that_stays_as_it_is() {
    let _generator = random_generator_lock();
    let dir = tempfile::tempdir().unwrap();
    let scenes = drives(dir.path());
    let encoder = train_encoder(
        &encoder_config(&scenes, &dir.path().join("encoder"), 1),
        &mut |_| (),
    )
    .unwrap();
    let encoder = encoder.trained.weights;
    let config = |steps| SgLocTrainConfig {
        scenes: vec![scenes.clone()],
        scene_name: "small".into(),
        encoder: encoder.clone(),
        run: RunConfig {
            batch: 2,
            learning_rate: 3e-3,
            ..run(&dir.path().join("sgloc"), steps)
        },
    };
    let (mut errors, mut encoded) = (Vec::new(), 0);
    let trained = train_sgloc(&config(150), &mut |progress| match progress {
        TrainingEvent::Encoding(done, _) => encoded = *done,
        TrainingEvent::Stepped(report) => errors.push(report.means[0]),
        _ => {}
    })
    .unwrap();
    assert!(
        encoded == 48 && errors.last().unwrap() < &(0.7 * errors[0]),
        "{errors:?}"
    );

    // The file holds the trained head, after the unchanged encoder.
    let written: SgLocConfig = Weights::load(&trained.weights).unwrap().config().unwrap();
    assert_eq!(written.encoder, small_encoder());
    let (before, after) = (VarStore::new(Device::Cpu), VarStore::new(Device::Cpu));
    SceneEncoder::new(&before.root(), &small_encoder()).unwrap();
    SceneEncoder::new(&(after.root() / "encoder"), &small_encoder()).unwrap();
    Weights::load(&encoder).unwrap().copy_into(&before).unwrap();
    Weights::load(&trained.weights)
        .unwrap()
        .copy_into(&after)
        .unwrap();
    let kept = after.variables();
    for (name, tensor) in before.variables() {
        assert!(tensor.equal(&kept[&format!("encoder.{name}")]), "{name}");
    }

    let mut resumed = config(160);
    resumed.run.resume = true;
    assert_eq!(train_sgloc(&resumed, &mut |_| ()).unwrap().steps, 160);
}

/// Trains a network that regresses poses, localizes a sweep of its drives, and goes on with it.
fn pose_regression_learns(
    train: fn(&PoseRegressionConfig, &mut Observe<'_>) -> Result<PoseRegressionSummary, Error>,
    steps: u64,
) {
    let _generator = random_generator_lock();
    let dir = tempfile::tempdir().unwrap();
    let scenes = drives(dir.path());
    let encoder = train_encoder(
        &encoder_config(&scenes, &dir.path().join("encoder"), 1),
        &mut |_| (),
    );
    let encoder = encoder.unwrap().trained.weights;
    let config = |steps| PoseRegressionConfig {
        scenes: vec![scenes.clone()],
        validation: vec![scenes.clone()],
        scene_name: "small".into(),
        encoder: encoder.clone(),
        turn_rad: 0.2,
        run: RunConfig {
            batch: 24,
            learning_rate: 2e-3,
            ..run(&dir.path().join("regression"), steps)
        },
    };
    let (mut poses_l1, mut places) = (Vec::new(), Vec::new());
    let summary = train(&config(steps), &mut |progress| {
        if let TrainingEvent::Stepped(report) = progress {
            poses_l1.push(report.means[0]);
            places.push(report.means[1]);
        }
    })
    .unwrap();
    assert_eq!((summary.sweeps, summary.network.classes), (48, 48));
    assert_eq!(summary.network.encoder, small_encoder());
    assert!(
        poses_l1.last().unwrap() < &(0.7 * poses_l1[0])
            && places.last().unwrap() < &(0.7 * places[0]),
        "{poses_l1:?} {places:?}"
    );
    let validation = summary.validation.unwrap();
    assert!(validation.p50_m < 20.0, "drives of 100 m: {validation}");

    let weights = &summary.trained.weights;
    let mut localizer = load_baseline(weights, Device::Cpu, PoseSolver::default()).unwrap();
    let dataset = dataset::open(&scenes).unwrap();
    let frame = dataset.scenarios[0].load(0, 3, &LoadOptions::default());
    let frame = frame.unwrap();
    let mut estimate = |cloud: &PointCloud| {
        localizer
            .localize(LocalizerInput::of(cloud))
            .unwrap()
            .estimate
    };
    let first = estimate(&frame.points);
    assert_eq!(estimate(&frame.points), first, "same sweep, same answer");
    let (found, truth) = (
        first.world_from_cav().unwrap(),
        frame.world_from_lidar.unwrap(),
    );
    let off = PoseError::between(found, &truth);
    assert!(off.distance_m < 40.0, "{off:?}");
    let nan = PointCloud {
        xyzi: vec![[f32::NAN; 4]; 5000],
    };
    let none = PoseEstimate::NoPose {
        reason: NoPoseReason::TooFewPoints,
        inlier_count: 0,
    };
    assert_eq!(estimate(&nan), none);

    let mut resumed = config(steps + 3);
    resumed.run.resume = true;
    let resumed = train(&resumed, &mut |_| ()).unwrap();
    assert_eq!(resumed.trained.steps, steps + 3);
}

#[test]
fn diffloc_learns_to_denoise_poses_and_answers_alike_for_the_same_sweep() {
    pose_regression_learns(train_diffloc, 150);
}

#[test]
fn hypliloc_learns_poses_and_answers_alike_for_the_same_sweep() {
    pose_regression_learns(train_hypliloc, 150);
}

#[test]
fn interrupted_trainings_resume_and_refuse_foreign_files() {
    let _generator = random_generator_lock();
    let dir = tempfile::tempdir().unwrap();
    let scenes = drives(dir.path());
    let whole = train_encoder(
        &encoder_config(&scenes, &dir.path().join("a"), 20),
        &mut |_| (),
    )
    .unwrap();
    let b = dir.path().join("b");
    // Stopped at the second validation, whose checkpoint is then not yet written.
    let mut validations = 0;
    let stopped = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
        let mut stop = |progress: &TrainingEvent| {
            validations += u32::from(matches!(progress, TrainingEvent::Validated(_)));
            assert!(validations < 2, "stopped by the test");
        };
        train_encoder(&encoder_config(&scenes, &b, 20), &mut stop)
    }));
    assert!(stopped.is_err());
    let going_on = |steps| {
        let mut config = encoder_config(&scenes, &b, steps);
        config.run.resume = true;
        config
    };
    let resumed = train_encoder(&going_on(20), &mut |_| ()).unwrap();
    assert_eq!(resumed.trained.sha256, whole.trained.sha256, "bit for bit");

    let mut other = going_on(30);
    other.run.seed = 9;
    let error = train_encoder(&other, &mut |_| ()).unwrap_err();
    assert!(
        matches!(
            error,
            Error::Training(TrainingError::OtherTraining("seed", ..))
        ),
        "{error}"
    );
    let checkpoint = b.join("checkpoint.safetensors");
    let bytes = std::fs::read(&checkpoint).unwrap();
    std::fs::write(&checkpoint, &bytes[..bytes.len() / 2]).unwrap();
    let message = train_encoder(&going_on(30), &mut |_| ())
        .unwrap_err()
        .to_string();
    assert!(
        message.contains("checkpoint.safetensors") && message.contains("not a complete"),
        "{message}"
    );
}
