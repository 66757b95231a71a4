//! Training and evaluation of fusion methods on a small scene, end to end through the library.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::MutexGuard;

use ::training::Error;
use ::training::train::{self, TrainConfig, TrainSummary};
use ego_fuser_offline::evaluation::{EvaluatedFrame, Evaluator, Setup};
use fusion::Method;
use perception::train::{Length, RunConfig, TrainingEvent};
use protocol::Dtype;
use tempfile::TempDir;
use tests::locks::random_generator_lock;
use tests::scene;
use tests::training::{self, EventLog};

/// Holds the random number generator, and a folder with a scene of two vehicles and one tick; the path of the scene.
fn begin() -> (MutexGuard<'static, ()>, TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &["4279", "4288"], 1);
    let path = folder.path().to_path_buf();
    (random_generator_lock(), folder, path)
}

/// Five steps from one validation to the next.
fn config(scene: &Path, out: &Path, method: Method, steps: u64) -> TrainConfig {
    let config = training::config(scene, out, method, steps);
    let run = RunConfig {
        loader_threads: 2,
        ..config.run
    };
    TrainConfig {
        validation: vec![scene.to_owned()],
        validate_every: 5,
        run,
        ..config
    }
}

fn run(config: &TrainConfig) -> (TrainSummary, EventLog) {
    let mut events = EventLog::default();
    let summary = train::run(config, &mut |event| events.add(event)).unwrap();
    (summary, events)
}

fn evaluate(weights: PathBuf, scene: &Path, method: Method, dtype: Dtype) -> Vec<EvaluatedFrame> {
    let mut setup = Setup {
        method: Some(method),
        ..Setup::default()
    };
    setup.models.weights = weights;
    setup.agents.codec.dtype = dtype;
    let mut evaluator = Evaluator::new(setup).unwrap();
    let mut frames = Vec::new();
    for scenario in &dataset::open(scene).unwrap().scenarios {
        let _ = evaluator
            .run(scenario, &mut |frame| {
                frames.push(frame);
                ControlFlow::Continue(())
            })
            .unwrap();
    }
    frames
}

#[test]
fn a_training_that_was_interrupted_ends_like_one_that_was_not() {
    let (_generator, _scenes, scene) = begin();
    let (whole, parts) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    // The learning rate follows the completed fraction, so an early stop is a checkpoint of the whole length.
    let uninterrupted = config(&scene, whole.path(), Method::ATTENTION, 10);
    let (summary, events) = run(&uninterrupted);
    let validated = events.validations.iter().map(|text| text.split(':').next());
    let validated: Vec<Option<&str>> = validated.collect();
    assert_eq!(summary.trained.steps, 10);
    assert_eq!(validated, [Some("step 5"), Some("step 10")]);
    assert!(
        events
            .losses
            .iter()
            .all(|loss| loss.is_finite() && *loss > 0.0)
    );

    let first = TrainConfig {
        validation: vec![],
        ..config(&scene, parts.path(), Method::ATTENTION, 10)
    };
    let stopped = train_until_checkpoint(&first);
    let again = RunConfig {
        resume: true,
        loader_threads: 1,
        ..first.run.clone()
    };
    let (resumed, _) = run(&TrainConfig {
        run: again,
        ..first
    });
    assert_eq!((stopped, resumed.trained.steps), (5, 10));
    assert_eq!(
        resumed.trained.sha256, summary.trained.sha256,
        "the same weights, byte for byte"
    );
    let card = std::fs::read_to_string(whole.path().join("model-card.md")).unwrap();
    assert!(
        card.contains(&summary.trained.sha256)
            && card.contains("a test")
            && card.contains("attention"),
        "{card}"
    );
    let curve = std::fs::read_to_string(whole.path().join("curve.csv")).unwrap();
    let columns: Vec<usize> = curve.lines().map(|line| line.split(',').count()).collect();
    assert_eq!(
        columns, [12; 4],
        "a header, one report, two validations:\n{curve}"
    );
}

/// Trains and interrupts in the first report after the first checkpoint; the steps of that checkpoint.
fn train_until_checkpoint(config: &TrainConfig) -> u64 {
    let checkpoint = config.run.out.join("checkpoint.safetensors");
    let mut plug = |event: &TrainingEvent| {
        if let TrainingEvent::Stepped(_) = event {
            // The report of step 10 comes before the checkpoint of step 10: the existing one is of step 5.
            assert!(checkpoint.exists(), "a checkpoint at step 5");
            panic!("pulled");
        }
    };
    let outcome = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
        train::run(config, &mut plug).is_ok()
    }));
    assert!(outcome.is_err());
    5
}

#[test]
fn every_method_that_learns_trains_and_evaluates_the_same_twice() {
    let (_generator, _scenes, scene) = begin();
    let folder = tempfile::tempdir().unwrap();
    let none = config(&scene, &folder.path().join("none"), Method::NONE, 5);
    let (base, _) = run(&none);
    for method in [Method::EARLY, Method::MAX, Method::ATTENTION] {
        let out = folder.path().join(method.name());
        let (summary, _) = run(&TrainConfig {
            init: Some(base.trained.weights.clone()),
            ..config(&scene, &out, method, 5)
        });
        let frames = evaluate(summary.trained.weights.clone(), &scene, method, Dtype::F32);
        let again = evaluate(summary.trained.weights, &scene, method, Dtype::F32);
        assert_eq!(frames.len(), 1, "{method}");
        assert_eq!(
            frames[0].result.detections, again[0].result.detections,
            "{method}"
        );
        assert_eq!(
            frames[0].result.fused.len(),
            1,
            "{method}: the scene has one neighbour"
        );
        assert!(frames[0].result.fused[0].payload_bytes > 0, "{method}");
    }
    let late = TrainConfig {
        method: Method::LATE,
        ..none
    };
    assert!(
        matches!(train::run(&late, &mut |_| {}), Err(Error::NotTrained(method)) if method == Method::LATE)
    );
}

#[test]
fn half_precision_takes_half_the_bytes_of_a_message() {
    let (_generator, _scenes, scene) = begin();
    let folder = tempfile::tempdir().unwrap();
    let (summary, _) = run(&config(&scene, folder.path(), Method::MAX, 5));
    let bytes = |dtype| {
        evaluate(summary.trained.weights.clone(), &scene, Method::MAX, dtype)[0]
            .result
            .fused[0]
            .payload_bytes
    };
    let (single, half) = (bytes(Dtype::F32), bytes(Dtype::F16));
    let values = 16 * 64 * 44;
    assert!(
        single >= 4 * values && single < 4 * values + 256,
        "{single}"
    );
    assert!(half >= 2 * values && half < 2 * values + 256, "{half}");
}

#[test]
fn a_checkpoint_of_another_training_is_refused_with_both_values() {
    let (_generator, _scenes, scene) = begin();
    let folder = tempfile::tempdir().unwrap();
    let first = config(&scene, folder.path(), Method::NONE, 5);
    run(&first);
    let again = RunConfig {
        resume: true,
        seed: 4,
        length: Length::Steps(9),
        ..first.run.clone()
    };
    let other = TrainConfig {
        run: again,
        ..first
    };
    let message = train::run(&other, &mut |_| {}).unwrap_err().to_string();
    assert!(
        message.contains("seed 3") && message.contains('4'),
        "{message}"
    );
    let elsewhere = RunConfig {
        out: folder.path().join("elsewhere"),
        ..other.run.clone()
    };
    let missing = TrainConfig {
        run: elsewhere,
        ..other
    };
    let message = train::run(&missing, &mut |_| {}).unwrap_err().to_string();
    assert!(message.contains("checkpoint.safetensors"), "{message}");
}
