//! One encoder for detection and localization: a head on the levels of the vehicle's detector.

use std::path::{Path, PathBuf};
use std::process::Command;

use agent::agent::{Agent, AgentInput};
use dataset::LoadOptions;
use localization::pose_source::{PgcConfig, PoseInput, PoseSourceConfig};
use perception::detector::Detector;
use perception::inference::Inference;
use perception::int8::InferencePrecision;
use perception::weights::Weights;
use protocol::{EgoMotion, PoseEstimate};
use tch::Device;
use tests::fleet::programs;

fn released(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../deploy/weights")
        .join(format!("{name}.safetensors"))
}

/// The released head on the encoder inside `detector`.
fn pgc(detector: &str) -> PoseSourceConfig {
    PoseSourceConfig::Pgc(PgcConfig {
        encoder: released(detector),
        head: released("pgc-town1-bev"),
        ..PgcConfig::default()
    })
}

fn distance_m(one: &PoseEstimate, other: &PoseEstimate) -> f64 {
    let [one, other] =
        [one, other].map(|estimate| estimate.world_from_cav().expect("a pose").isometry());
    (one.translation.vector - other.translation.vector).norm()
}

#[test]
fn a_vehicle_localizes_with_the_levels_that_its_detector_has_computed() {
    tch::set_num_threads(1);
    let folder = tempfile::tempdir().unwrap();
    let synth = Command::new(programs().join("sim-replay"))
        .args([
            "synth", "--subset", "town1loc", "--seed", "1601", "--scenes", "1",
        ])
        .args([
            "--frames",
            "3",
            "--period-s",
            "1",
            "--threads",
            "1",
            "--out",
        ])
        .arg(folder.path())
        .output()
        .unwrap();
    assert!(
        synth.status.success(),
        "{}",
        String::from_utf8_lossy(&synth.stderr)
    );
    let scenario = &dataset::open(folder.path()).unwrap().scenarios[0];
    let cav = scenario.agents[0].clone();
    // PASTAT's detector has the encoder of the head, with other scales of 8-bit activations.
    let [mut alone, with_others_scales] =
        ["lean-pastat", "lean-max"].map(|name| pgc(name).build(Inference::default()));
    let alone = alone.as_mut().unwrap();
    let detector = || Detector::load(&released("lean-pastat"), Device::Cpu).unwrap();
    let mut shares = Agent::new(
        cav.clone(),
        pgc("lean-pastat").build(Inference::default()).unwrap(),
        detector(),
    );
    let mut of_max = Agent::new(cav.clone(), with_others_scales.unwrap(), detector());
    let weights = Weights::load(&released("lean-pastat"))
        .unwrap()
        .with_precision(InferencePrecision::Float);
    let float =
        Detector::from_weights(&weights, &weights.detector_config().unwrap(), Device::Cpu).unwrap();
    let mut in_float = Agent::new(
        cav.clone(),
        pgc("lean-pastat").build(Inference::FLOAT).unwrap(),
        float,
    );
    for tick in 0..scenario.ticks.len() {
        let frame = scenario.load(0, tick, &LoadOptions::default()).unwrap();
        let (capture_nanos, cloud, motion) =
            (frame.capture_nanos, &frame.points, EgoMotion::default());
        let expected = alone.estimate(&PoseInput {
            cav: &cav,
            capture_nanos,
            cloud,
            levels: None,
            measured: None,
            motion,
        });
        let input = AgentInput {
            capture_nanos,
            cloud,
            measured_pose: None,
            motion,
        };
        assert_eq!(
            shares.process(&input).unwrap().pose,
            expected,
            "the same bits"
        );
        // The head was trained on 8-bit levels: those of a detector in floating point are not used.
        assert!(distance_m(&in_float.process(&input).unwrap().pose, &expected) < 0.1);
        assert!(distance_m(&of_max.process(&input).unwrap().pose, &expected) < 0.5);
        let truth = PoseEstimate::new(frame.world_from_lidar.unwrap(), 1.0);
        assert!(distance_m(&expected, &truth) < 1.0, "{expected:?}");
    }
}
