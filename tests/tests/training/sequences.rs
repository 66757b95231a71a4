//! Localization benchmarks: drives in the layouts of NCLT and Oxford train and evaluate through the common commands.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use agent_offline::training::{
    EncoderTrainConfig, SceneTrainConfig, SweepAugmentation, train_encoder, train_scene,
};
use dataset::{self, Layout, LoadOptions, Scenario};
use perception::train::{Length, RunConfig};
use serde_json::Value;
use simulator::generate::{Subset, SynthOptions, generate};
use tests::fleet::programs;
use tests::localizer::small_encoder;
use tests::locks::random_generator_lock;
use tests::sequences::{Benchmark, LEFT_OUT, write};

/// Two drives through one town.
fn drives(folder: &Path) -> Vec<Scenario> {
    let options = SynthOptions {
        scenes: 2,
        frames: 30,
        period_s: 0.5,
        ..SynthOptions::new(Subset::Town1loc, 12, folder.join("drives"))
    };
    generate(&options, &|_| {}).unwrap();
    dataset::open(&folder.join("drives")).unwrap().scenarios
}

/// Trains an encoder on sequences.
fn train_on(sequences: &Path, out: &Path) -> PathBuf {
    let encoder = EncoderTrainConfig {
        scenes: vec![sequences.to_owned()],
        validation: vec![sequences.to_owned()],
        encoder: small_encoder(),
        run: RunConfig {
            batch: 2,
            learning_rate: 3e-3,
            seed: 5,
            ..RunConfig::new(Length::Steps(20), out)
        },
        validate_every: 20,
    };
    train_encoder(&encoder, &mut |_| ())
        .unwrap()
        .trained
        .weights
}

/// Trains a head on sequences, on the features of an encoder.
fn train_head_on(sequences: &Path, encoder: &Path, out: &Path) -> PathBuf {
    let head = SceneTrainConfig {
        init: None,
        scenes: vec![sequences.to_owned()],
        validation: vec![sequences.to_owned()],
        validation_sweeps: 10,
        encoder: encoder.to_owned(),
        scene_name: "sequences".into(),
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
        redundancy: None,
        run: RunConfig {
            batch: 512,
            learning_rate: 4e-3,
            seed: 5,
            ..RunConfig::new(Length::Steps(250), out)
        },
        validate_every: Duration::from_secs(3600),
    };
    let summary = train_scene(&head, &mut |_| ()).unwrap();
    assert_eq!(summary.sweeps, 2 * (30 - 2 * LEFT_OUT));
    summary.trained.weights
}

fn eval(sequences: &Path, encoder: &Path, head: &Path) -> Value {
    let mut command = Command::new(programs().join("agent"));
    command
        .args(["eval", "--json", "--dataset"])
        .arg(sequences)
        .arg("--encoder")
        .arg(encoder)
        .arg("--head")
        .arg(head);
    let output = command.output().unwrap();
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn sequences_of_both_benchmarks_train_and_evaluate_like_any_drive() {
    let _generator = random_generator_lock();
    let folder = tempfile::tempdir().unwrap();
    let drives = drives(folder.path());
    // An encoder serves any town: the second benchmark uses the first one's.
    let mut encoder: Option<PathBuf> = None;
    for (benchmark, layout) in [
        (Benchmark::Nclt, Layout::NCLT),
        (Benchmark::Oxford, Layout::OXFORD),
    ] {
        let sequences = write(folder.path(), benchmark, &drives);
        let read = dataset::open(&sequences).unwrap();
        assert_eq!(
            (read.layout, read.problems.len(), read.scenarios.len()),
            (layout, 0, 2)
        );
        for (read, drive) in read.scenarios.iter().zip(&drives) {
            assert_eq!(read.ticks.len(), drive.ticks.len() - 2 * LEFT_OUT);
            let [found, wanted] = [(read, 0), (drive, LEFT_OUT)]
                .map(|(scenario, tick)| scenario.load(0, tick, &LoadOptions::default()).unwrap());
            let off = found
                .world_from_lidar
                .unwrap()
                .isometry()
                .inv_mul(&wanted.world_from_lidar.unwrap().isometry());
            assert!(
                off.translation.vector.norm() < 1e-6 && off.rotation.angle() < 1e-6,
                "{off}"
            );
            let apart =
                |(a, b): (&[f32; 4], &[f32; 4])| a.iter().zip(b).any(|(a, b)| (a - b).abs() > 1e-5);
            assert_eq!(found.points.len(), wanted.points.len());
            assert!(!found.points.xyzi.iter().zip(&wanted.points.xyzi).any(apart));
        }

        let encoder = encoder
            .get_or_insert_with(|| train_on(&sequences, &folder.path().join("encoder")))
            .as_path();
        let head = train_head_on(
            &sequences,
            encoder,
            &folder.path().join(format!("head-{layout:?}")),
        );
        let summary = eval(&sequences, encoder, &head);
        assert_eq!(summary["sweeps"], 2 * (30 - 2 * LEFT_OUT));
        // Points and poses that do not belong together would leave nothing to learn.
        assert!(
            summary["success_3m"].as_f64().unwrap() > 0.4,
            "{layout:?}: {summary}"
        );
        assert!(
            summary["p50_m"].as_f64().unwrap() < 3.0 && summary["p50_deg"].as_f64().unwrap() < 3.0,
            "{summary}"
        );
        assert!(summary["ms"]["encode"].as_f64().unwrap() > 0.0, "{summary}");
    }
}
