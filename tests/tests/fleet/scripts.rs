//! Fusion methods in TorchScript in a fleet of processes: the precision of the built-in method, and faults before the start.

use std::fs;

use serde_json::Value;
use simulator::generate::{Subset, SynthOptions, generate};
use tests::fleet::{Up, deploy_file, results, v2vloc, write_scenario};
use tests::locks::exclusive_lock;

fn script() -> String {
    format!("script:{}", deploy_file("examples/attention.pt"))
}

#[test]
fn a_script_gives_the_precision_of_the_built_in_method_live() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let [scene, runs] = ["scene", "runs"].map(|name| folder.path().join(name));
    let options = SynthOptions {
        frames: 3,
        ..SynthOptions::new(Subset::V2vdet, 905, scene.clone())
    };
    generate(&options, &|_| {}).unwrap();
    let [scenario, scene, runs] = [
        deploy_file("scenarios/demo.yaml"),
        scene.display().to_string(),
        runs.display().to_string(),
    ];
    let precision = |name: &str, method: &str| {
        let arguments = [
            "up",
            &scenario,
            "--dataset",
            &scene,
            "--runs",
            &runs,
            "--name",
            name,
            "--method",
            method,
        ];
        let set = [
            "--set",
            "scene.lockstep=true",
            "--set",
            "agents.pose=recorded",
            "--json",
        ];
        let output = v2vloc(&[&arguments[..], &set[..]].concat());
        assert_eq!(
            output.status.code(),
            Some(0),
            "{}",
            String::from_utf8_lossy(&output.stderr)
        );
        let metrics: Value = serde_json::from_slice(&output.stdout).unwrap();
        ["0.3", "0.5", "0.7"].map(|iou| metrics["ap_global"][iou].as_f64().unwrap())
    };
    let [of_script, built_in] = [
        precision("script", &script()),
        precision("built-in", "attention"),
    ];
    for (of_script, built_in) in of_script.into_iter().zip(built_in) {
        assert!(
            (of_script - built_in).abs() < 1e-4 && built_in > 0.1,
            "{of_script} and {built_in}"
        );
    }
}

#[test]
fn a_script_runs_live_and_its_faults_are_reported_before_the_start() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), 4, "lockstep: true", "");
    let text = fs::read_to_string(&scenario).unwrap();
    let with = |method: &str| {
        fs::write(
            &scenario,
            text.replace("method: max", &format!("method: \"{method}\"")),
        )
        .unwrap()
    };
    with(&script());
    let mut up = Up::start(folder.path(), &scenario);
    assert_eq!(up.wait().code(), Some(0));
    let fused = results(&up.folder);
    assert_eq!(fused.len(), 4);
    assert!(
        fused
            .iter()
            .all(|result| result["method"] == script().as_str()),
        "{}",
        fused[0]
    );

    let broken = folder.path().join("broken.pt");
    fs::write(&broken, b"no module").unwrap();
    with(&format!("script:{}", broken.display()));
    let output = v2vloc(&[
        "up",
        scenario.to_str().unwrap(),
        "--runs",
        folder.path().join("other").to_str().unwrap(),
    ]);
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(message.contains("broken.pt"), "{message}");
    assert_ne!(output.status.code(), Some(0));
}
