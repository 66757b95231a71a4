//! Fleet with an attacker: the ego detects it, reports the reason everywhere, and its detections are those without the
//! attacker's messages.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use deploy::operate::status::RunStatus;
use deploy::score::metrics::Metrics;
use protocol::{DetectionsReport, DropReason};
use simulator::generate::{Subset, SynthOptions, generate};
use tests::fleet::Up;
use tests::locks::exclusive_lock;

const FRAMES: usize = 6;

/// Results of the ego by capture time.
type Results = BTreeMap<u64, DetectionsReport>;

/// Plays the scene with the released detector; `rest` is added to the settings that all fleets here share.
fn play(folder: &Path, scene: &str, rest: &str) -> (Results, Metrics, RunStatus) {
    let weights = Path::new(env!("CARGO_MANIFEST_DIR"))
        .with_file_name("deploy")
        .join("weights/lean-max.safetensors");
    let path = folder.join("scenario.yaml");
    let text = format!(
        "run: test\nscene: {{dir: scene, lockstep: true, {scene}}}\nmodels: {{weights: {}}}\nmethod: max\n\
         agents: {{codec: {{dtype: f16}}}}\nego: {{deadline_ms: 60000, trust: true}}\n{rest}\n",
        weights.display()
    );
    fs::write(&path, text).unwrap();
    let mut up = Up::start(folder, &path);
    assert_eq!(
        up.wait().code(),
        Some(0),
        "an excluded neighbour's messages are not lost"
    );
    let lines = fs::read_to_string(up.folder.join("detections.jsonl")).unwrap();
    let results = lines
        .lines()
        .map(|line| serde_json::from_str::<DetectionsReport>(line).unwrap());
    let results: Results = results
        .map(|report| (report.capture_nanos, report))
        .collect();
    assert_eq!(results.len(), FRAMES, "in lockstep nothing is late");
    let metrics =
        serde_json::from_str(&fs::read_to_string(up.folder.join("metrics.json")).unwrap()).unwrap();
    (results, metrics, RunStatus::read(&up.folder).unwrap())
}

#[test]
fn an_attacker_in_a_live_fleet_is_detected_named_and_without_effect() {
    let _exclusive = exclusive_lock();
    let (with, without) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    for folder in [&with, &without] {
        let options = SynthOptions {
            frames: FRAMES,
            agents: 3..=3,
            ..SynthOptions::new(Subset::V2vdet, 7, folder.path().join("scene"))
        };
        generate(&options, &|_| {}).unwrap();
    }
    let agents = dataset::open(&with.path().join("scene"))
        .unwrap()
        .scenarios
        .remove(0)
        .agents;
    let [ego, honest, attacker] = &agents[..] else {
        panic!("{agents:?}")
    };

    let (attacked, metrics, status) = play(
        with.path(),
        "",
        &format!("vehicles: {{'{attacker}': {{falsification: noise}}}}"),
    );
    let (expected, ..) = play(
        without.path(),
        &format!("agents: ['{ego}', '{honest}']"),
        "",
    );

    // One message of noise may be anything; two that follow each other cannot be of one vehicle.
    let is_out = |report: &DetectionsReport| {
        let left_out = report
            .result
            .skipped
            .iter()
            .find(|skipped| skipped.cav == *attacker);
        left_out.is_some_and(|skipped| skipped.reason == Some(DropReason::Misbehaviour))
    };
    let out: Vec<_> = attacked
        .iter()
        .filter(|(_, report)| is_out(report))
        .collect();
    assert!(out.len() >= FRAMES - 1, "left out of {} frames", out.len());
    assert!(
        expected
            .values()
            .any(|report| !report.result.detections.is_empty()),
        "something is there to be seen"
    );
    for (at, report) in out {
        assert_eq!(
            report.result.detections, expected[at].result.detections,
            "at {at}"
        );
        assert!(
            report.result.fused.iter().all(|fused| fused.cav == *honest)
                && report.result.fused.len() == 1
        );
    }

    let [trusted, named] = [honest, attacker].map(|cav| &metrics.neighbours[cav]);
    assert_eq!(
        (
            trusted.fused,
            trusted.misbehaviour_counts.len(),
            trusted.misbehaviour
        ),
        (FRAMES as u64, 0, None),
        "{trusted:?}"
    );
    assert!(
        named.misbehaviour.is_some()
            && named.fused <= 1
            && named.trust.is_some_and(|trust| trust < 0.3),
        "{named:?}"
    );
    assert!(named.left_out[&DropReason::Misbehaviour] >= FRAMES as u64 - 1);
    // One machine has one clock.
    assert!(
        trusted
            .clock_offset_s
            .is_some_and(|offset_s| (-60.0..=0.001).contains(&offset_s)),
        "{trusted:?}"
    );
    let shown = status
        .neighbours
        .iter()
        .find(|neighbour| neighbour.cav == *attacker)
        .unwrap();
    assert_eq!(
        (shown.misbehaviour, shown.trust),
        (named.misbehaviour, named.trust)
    );
    assert!(
        status.table().contains("left out because"),
        "{}",
        status.table()
    );
}
