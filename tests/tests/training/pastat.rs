//! PASTAT end to end on a generated scene: trained behind a frozen encoder, with history, late neighbours and estimated
//! poses, and evaluated in a table.

use std::fs;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ::training::feature_store::{FeatureStore, KeptMaps, MapSource, is_encoder};
use ::training::samples::{Moments, SamplePoses};
use ::training::train::{self, TrainConfig};
use dataset::{self, IntensityScale, LoadOptions, Scenario};
use ego_fuser_offline::evaluation::{EvaluatedFrame, Evaluator, Setup};
use fusion::Method;
use fusion::pastat::{Part, ablated};
use localization::pose_source::{
    CachedPoseConfig, NoiseMode, NoisyPoseConfig, PoseRow, PoseSourceConfig, PoseTable,
};
use perception::inference::Inference;
use perception::weights::Weights;
use protocol::{Dtype, NoPoseReason, PoseEstimate};
use runner::experiment::spec::Experiment;
use runner::experiment::table;
use support::file_digests::FileDigests;
use tests::locks::random_generator_lock;
use tests::scene;
use tests::training::{EventLog, config, small};

const AGENTS: [&str; 3] = ["4279", "4288", "4301"];
const TICKS: usize = 7;

/// A scene, and weights of `none` to begin with.
fn begin(folder: &Path) -> (PathBuf, PathBuf) {
    let data = folder.join("data");
    scene::write(&data, &AGENTS, TICKS);
    let summary = train::run(
        &config(&data, &folder.join("none"), Method::NONE, 5),
        &mut |_| {},
    )
    .unwrap();
    (data, summary.trained.weights)
}

/// Trains PASTAT behind the encoder of `init`, with every option of its samples.
fn pastat(folder: &Path, data: &Path, init: &Path, name: &str) -> TrainConfig {
    let noise = NoisyPoseConfig {
        mode: NoiseMode::Independent,
        position_std_m: 0.5,
        heading_std_deg: 0.5,
        ..Default::default()
    };
    let mut config = config(data, &folder.join(name), Method::PASTAT, 10);
    config.init = Some(init.to_owned());
    config.frozen_encoder = Some(KeptMaps {
        folder: folder.join("maps"),
        dtype: Dtype::I8,
        limit_bytes: 1 << 30,
        intensity_scale: IntensityScale::AUTO,
    });
    config.samples.moments = Moments {
        frames: 1,
        gap: 2,
        max_delay_nanos: 300_000_000,
    };
    config.samples.poses = SamplePoses {
        noise: Some(noise),
        noise_share: 0.5,
        ..SamplePoses::default()
    };
    config
}

fn evaluate(
    weights: &Path,
    data: &Path,
    poses: PoseSourceConfig,
    delay_ms: u64,
    maps: bool,
) -> Vec<EvaluatedFrame> {
    let mut setup = Setup {
        method: Some(Method::PASTAT),
        delay_ms,
        ..Setup::default()
    };
    setup.models.weights = weights.to_owned();
    setup.agents.pose = poses;
    setup.agents.codec.dtype = Dtype::F16;
    let mut evaluator = Evaluator::new(setup).unwrap();
    let scenarios = dataset::open(data).unwrap().scenarios;
    if maps {
        let weights = Arc::new(Weights::load(weights).unwrap());
        let folder = data.join("../evaluation-maps");
        let kept = KeptMaps {
            folder,
            dtype: Dtype::F16,
            limit_bytes: u64::MAX,
            intensity_scale: IntensityScale::AUTO,
        };
        let store = FeatureStore::open(
            &kept,
            &weights,
            &scenarios,
            &FileDigests::default(),
            2,
            &mut |_, _| {},
        )
        .unwrap();
        evaluator = evaluator.with_maps(MapSource::new(store.into(), weights));
    }
    let mut frames = Vec::new();
    for scenario in &scenarios {
        let mut keep = |frame| {
            frames.push(frame);
            ControlFlow::Continue(())
        };
        let _ = evaluator.run(scenario, &mut keep).unwrap();
    }
    frames
}

fn ages_ms(frame: &EvaluatedFrame) -> Vec<i64> {
    frame
        .result
        .fused
        .iter()
        .map(|fused| fused.age_nanos / 1_000_000)
        .collect()
}

#[test]
fn pastat_learns_behind_a_frozen_encoder_and_is_judged_with_late_messages() {
    let _generator = random_generator_lock();
    let folder = tempfile::tempdir().unwrap();
    let (data, init) = begin(folder.path());
    let first = pastat(folder.path(), &data, &init, "pastat");
    let mut events = EventLog::default();
    let summary = train::run(&first, &mut |event| events.add(event)).unwrap();
    assert_eq!(events.encoded, AGENTS.len() * TICKS, "every sweep once");
    assert!(
        events
            .losses
            .iter()
            .all(|loss| loss.is_finite() && *loss > 0.0)
    );
    let before = Weights::load(&init).unwrap();
    let after = Weights::load(&summary.trained.weights).unwrap();
    assert_eq!(
        before.sha256_of(is_encoder),
        after.sha256_of(is_encoder),
        "the encoder is as it was"
    );
    assert_ne!(
        before.sha256_of(|name| name.starts_with("cls_head")),
        after.sha256_of(|name| name.starts_with("cls_head"))
    );
    assert!(after.names().any(|name| name.starts_with("fusion.fsa.")));
    let card = fs::read_to_string(first.run.out.join("model-card.md")).unwrap();
    assert!(
        card.contains("frozen") && card.contains("3 frames") && card.contains("0.3 s late"),
        "{card}"
    );

    // The same again, with its maps cached: the same weights.
    let mut again = EventLog::default();
    let repeated = pastat(folder.path(), &data, &init, "again");
    let repeated = train::run(&repeated, &mut |event| again.add(event)).unwrap();
    assert_eq!(
        (again.encoded, repeated.trained.sha256),
        (0, summary.trained.sha256)
    );

    let weights = &summary.trained.weights;
    let frames = evaluate(weights, &data, PoseSourceConfig::Recorded, 0, false);
    assert_eq!(frames.len(), TICKS);
    assert!(frames.iter().all(|frame| ages_ms(frame) == [0, 0]));
    let twice = evaluate(weights, &data, PoseSourceConfig::Recorded, 0, false);
    let kept = evaluate(weights, &data, PoseSourceConfig::Recorded, 0, true);
    for ((frame, twice), kept) in frames.iter().zip(&twice).zip(&kept) {
        assert_eq!(frame.result.detections, twice.result.detections);
        // A cached map has half precision where the head of the own agent has not: boxes may differ in the last bits.
        assert_eq!(frame.result.fused, kept.result.fused);
        assert_eq!(frame.result.detections.len(), kept.result.detections.len());
    }
    let late = evaluate(weights, &data, PoseSourceConfig::Recorded, 200, false);
    let ages: Vec<Vec<i64>> = late.iter().map(ages_ms).collect();
    assert_eq!(ages[..3], [vec![], vec![], vec![200, 200]]);
}

#[test]
fn kept_maps_are_bounded_and_survive_a_cut() {
    let _generator = random_generator_lock();
    let folder = tempfile::tempdir().unwrap();
    let (data, init) = begin(folder.path());
    let weights = Arc::new(Weights::load(&init).unwrap());
    let scenarios = dataset::open(&data).unwrap().scenarios;
    let open = |limit_bytes: u64| {
        let kept = KeptMaps {
            folder: folder.path().join("maps"),
            dtype: Dtype::F16,
            limit_bytes,
            intensity_scale: IntensityScale::AUTO,
        };
        let mut encoded = 0;
        let store = FeatureStore::open(
            &kept,
            &weights,
            &scenarios,
            &FileDigests::default(),
            2,
            &mut |_, _| encoded += 1,
        )
        .unwrap();
        (store, encoded)
    };
    let (few, encoded) = open(1);
    assert_eq!(
        (few.sweeps(), encoded),
        ((1, AGENTS.len() * TICKS), 1),
        "no more once the limit is passed"
    );
    assert!(few.map(0, 0, 0).unwrap().is_some() && few.map(0, 2, 3).unwrap().is_none());
    // A map that is not cached is encoded when it is needed.
    let mut maps = MapSource::new(few.into(), Weights::load(&init).unwrap().into());
    let live = maps.map(0, &scenarios[0], 2, 3).unwrap();
    let (whole, encoded) = open(u64::MAX);
    assert_eq!(encoded, AGENTS.len() * TICKS - 1);
    let kept = whole.map(0, 2, 3).unwrap().unwrap();
    let first_map = whole.map(0, 0, 0).unwrap().unwrap();
    assert!(kept.allclose(&live, 1e-3, 1e-3, false));
    let file = fs::read_dir(folder.path().join("maps"))
        .unwrap()
        .next()
        .unwrap()
        .unwrap()
        .path();
    let length = fs::metadata(&file).unwrap().len();
    fs::OpenOptions::new()
        .write(true)
        .open(&file)
        .unwrap()
        .set_len(length - 5)
        .unwrap();
    let (mended, encoded) = open(u64::MAX);
    assert_eq!((encoded, mended.sweeps().0), (1, AGENTS.len() * TICKS));
    assert!(mended.map(0, 2, TICKS - 1).unwrap().is_some());
    // A power cut has left zeros: in the last message, or in place of several.
    for zeros in [100, length as usize / 2] {
        let mut bytes = fs::read(&file).unwrap();
        let begin = bytes.len() - zeros;
        bytes[begin..].fill(0);
        fs::write(&file, bytes).unwrap();
        let (mended, encoded) = open(u64::MAX);
        assert_eq!(mended.sweeps().0, AGENTS.len() * TICKS);
        assert!(encoded > 0 && mended.map(0, 2, TICKS - 1).unwrap().is_some());
    }
    let mut bytes = fs::read(&file).unwrap();
    // The last bytes of the first message, after its length.
    let first = 1 + u32::from_le_bytes(*bytes.first_chunk().unwrap()) as usize;
    bytes[first] ^= 0x55;
    fs::write(&file, bytes).unwrap();
    // What is damaged or in the place of another is computed again where it is needed.
    let (damaged, encoded) = open(u64::MAX);
    assert!(encoded == 0 && damaged.map(0, 0, 0).unwrap().is_none());
    assert!(damaged.map(0, 0, 1).unwrap().is_some());
    let mut maps = MapSource::new(damaged.into(), Arc::clone(&weights));
    let again = maps.map(0, &scenarios[0], 0, 0).unwrap();
    assert!(again.allclose(&first_map, 1e-3, 1e-3, false));
}

#[test]
fn kept_maps_that_changed_places_are_not_taken_for_each_other() {
    let _generator = random_generator_lock();
    let folder = tempfile::tempdir().unwrap();
    let (data, init) = begin(folder.path());
    let weights = Arc::new(Weights::load(&init).unwrap());
    let scenarios = dataset::open(&data).unwrap().scenarios;
    let open = || {
        let kept = KeptMaps {
            folder: folder.path().join("maps"),
            dtype: Dtype::F16,
            limit_bytes: u64::MAX,
            intensity_scale: IntensityScale::AUTO,
        };
        let digests = FileDigests::default();
        FeatureStore::open(&kept, &weights, &scenarios, &digests, 2, &mut |_, _| {}).unwrap()
    };
    assert!(open().map(0, 0, 0).unwrap().is_some());
    let maps = fs::read_dir(folder.path().join("maps"));
    let file = maps.unwrap().next().unwrap().unwrap().path();
    let bytes = fs::read(&file).unwrap();
    let length = |at: usize| 4 + u32::from_le_bytes(*bytes[at..].first_chunk().unwrap()) as usize;
    let second = length(0);
    let third = second + length(second);
    let exchanged = [&bytes[second..third], &bytes[..second], &bytes[third..]];
    fs::write(&file, exchanged.concat()).unwrap();
    let store = open();
    let is_kept = [0, 1, 2].map(|tick| store.map(0, 0, tick).unwrap().is_some());
    assert_eq!(is_kept, [false, false, true]);
}

#[test]
fn parts_are_left_out_by_the_configuration_and_stay_out() {
    let _generator = random_generator_lock();
    let folder = tempfile::tempdir().unwrap();
    let (data, init) = begin(folder.path());
    let usual = Method::PASTAT.default_fusion(&small());
    let mut config = pastat(folder.path(), &data, &init, "ablation");
    config.fusion = Some(ablated(&usual, &[Part::Ce, Part::Fsa, Part::Te], Some(1)).unwrap());
    let summary = train::run(&config, &mut |_| {}).unwrap();
    let weights = Weights::load(&summary.trained.weights).unwrap();
    assert!(
        !weights
            .names()
            .any(|name| name.contains(".fsa.") || name.contains(".ce."))
    );
    assert!(
        !evaluate(
            &summary.trained.weights,
            &data,
            PoseSourceConfig::Recorded,
            0,
            false
        )
        .is_empty()
    );
    let max = Method::MAX.default_fusion(&small());
    assert!(
        ablated(&max, &[Part::Ce], None)
            .unwrap_err()
            .to_string()
            .contains("pastat")
    );
}

/// A table of the true poses, except for one vehicle without a pose at tick 3.
fn poses(file: &Path, scenario: &Scenario) {
    let mut rows = Vec::new();
    for (agent, cav) in scenario.agents.iter().enumerate() {
        for tick in 0..scenario.ticks.len() {
            let frame = scenario.load(agent, tick, &LoadOptions::default()).unwrap();
            let lost = agent == 1 && tick == 3;
            let estimate = if lost {
                PoseEstimate::NoPose {
                    reason: NoPoseReason::LowConfidence,
                    inlier_count: 3,
                }
            } else {
                PoseEstimate::new(frame.world_from_lidar.unwrap(), 0.75)
            };
            rows.push(PoseRow {
                cav,
                capture_nanos: frame.capture_nanos,
                estimate,
            });
        }
    }
    PoseTable::append(file, &scenario.name, "", &rows).unwrap();
}

#[test]
fn poses_that_were_found_once_serve_training_and_evaluation() {
    let _generator = random_generator_lock();
    let folder = tempfile::tempdir().unwrap();
    let (data, init) = begin(folder.path());
    let file = folder.path().join("poses.csv");
    poses(&file, &dataset::open(&data).unwrap().scenarios[0]);
    let mut config = pastat(folder.path(), &data, &init, "found");
    config.samples.poses.tables = vec![PoseTable::read(&file).unwrap().into()];
    let summary = train::run(&config, &mut |_| {}).unwrap();
    let source = PoseSourceConfig::Cached(CachedPoseConfig {
        file: file.clone(),
        scenario: None,
    });
    let frames = evaluate(&summary.trained.weights, &data, source, 0, true);
    let fused: Vec<usize> = frames
        .iter()
        .map(|frame| frame.result.fused.len())
        .collect();
    assert_eq!(
        fused,
        [2, 2, 2, 1, 2, 2, 2],
        "a vehicle without a pose is left out"
    );
    assert!(
        frames[0]
            .result
            .fused
            .iter()
            .all(|fused| fused.confidence == 0.75)
    );

    fs::write(&file, "scenario,cav\n").unwrap();
    let source = PoseSourceConfig::Cached(CachedPoseConfig {
        file,
        scenario: None,
    });
    assert!(
        source
            .build(Inference::default())
            .unwrap_err()
            .to_string()
            .contains("poses.csv:1")
    );
}

#[test]
fn an_interrupted_table_resumes_at_the_next_cell() {
    let _generator = random_generator_lock();
    let folder = tempfile::tempdir().unwrap();
    let (data, init) = begin(folder.path());
    let spec = |rows: &str| {
        let file = folder.path().join("tables.yaml");
        let (data, init, maps) = (data.display(), init.display(), folder.path().join("maps"));
        let text = format!(
            "dataset: {data}\nframes: 3\nfeature_maps: {}\ntables:\n- name: noise\n  rows:\n  - {{method: none, weights: [{init}]}}\n{rows}\
             \x20 columns:\n  - name: true poses\n  - {{name: 1 m, poses: {{noisy: {{mode: independent, position_std_m: 1}}}}}}\n",
            maps.display()
        );
        fs::write(&file, text).unwrap();
        Experiment::read(&file).unwrap()
    };
    let out = folder.path().join("out");
    // Fills the tables, and counts the cells that were known and those that were computed.
    let run = |spec: &Experiment| {
        let (mut known_cells, mut computed) = (0, 0);
        let mut on_cell = |_: &str, known: bool| match known {
            true => known_cells += 1,
            false => computed += 1,
        };
        let filled = table::run(spec, &out, None, &mut on_cell, &mut || {})?;
        anyhow::Ok((filled, (known_cells, computed)))
    };
    assert_eq!(run(&spec("")).unwrap().1, (0, 2));
    // A copy is the same training, whatever its name.
    let copy = folder.path().join("copy.safetensors");
    fs::copy(&init, &copy).unwrap();
    let row = |files: &str| format!("  - {{name: best, method: late, weights: [{files}]}}\n");
    let (one, other) = (init.display(), copy.display());
    let twice = spec(&row(&format!("{one}, {other}")));
    let refused = run(&twice).unwrap_err();
    let expected =
        format!("table \"noise\", row best: weights {one} and {other} have the same contents");
    assert_eq!(refused.to_string(), expected);
    let (filled, second) = run(&spec(&row(&other.to_string()))).unwrap();
    assert_eq!(second, (2, 2));
    assert_eq!(filled[0].rows[1].1[0].len(), 1);
    let text = fs::read_to_string(out.join("noise.md")).unwrap();
    assert!(
        text.contains("| best |") && text.contains("1 m") && text.contains("Frames: 3."),
        "{text}"
    );
    assert_eq!(
        fs::read_to_string(out.join("noise.csv"))
            .unwrap()
            .lines()
            .count(),
        1 + 2 + 2
    );
}
