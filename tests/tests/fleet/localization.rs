//! Localization from the sweep only, through the programs: a vehicle of a fleet, `agent eval`, and invalid files.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use runner::scenario::Scenario;
use serde_json::Value;
use tests::fleet::{Up, programs, results, write_scenario};
use tests::locks::exclusive_lock;
use tests::{localizer, scene};

/// Runs `agent eval` on the scene in `folder`; exit code, standard output and standard error.
fn eval(
    folder: &Path,
    encoder: &Path,
    head: &Path,
    more: &[&str],
) -> (Option<i32>, String, String) {
    let [encoder, head] = [("--encoder", encoder), ("--head", head)]
        .map(|(name, file)| [name.as_ref(), file.as_os_str()]);
    eval_with(folder, &[encoder, head].concat(), more)
}

/// The same for other networks than encoder and head.
fn eval_with(folder: &Path, networks: &[&OsStr], more: &[&str]) -> (Option<i32>, String, String) {
    let output = Command::new(programs().join("agent"))
        .args(["eval", "--dataset"])
        .arg(folder.join("scene"))
        .args(networks)
        .args(more)
        .output()
        .unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (
        output.status.code(),
        text(&output.stdout),
        text(&output.stderr),
    )
}

fn scene_and_networks(folder: &Path) -> (PathBuf, PathBuf) {
    scene::write(folder, &["4279", "4288"], 4);
    localizer::write(folder, 3)
}

/// Names of the files whose digests the run folder has, in order.
fn digested_files(up: &Up) -> Vec<String> {
    let scenario = Scenario::load(&up.folder.join("scenario.yaml")).unwrap();
    let files = scenario.provenance.unwrap().files_sha256;
    assert!(files.values().all(|sha256| sha256.len() == 64));
    let name = |path: &PathBuf| path.file_name().unwrap().to_string_lossy().into_owned();
    files.keys().map(name).collect()
}

#[test]
fn a_vehicle_without_a_pose_reports_it_and_the_fleet_continues() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    localizer::write(folder.path(), 3);
    let own =
        "vehicles: {4288: {pose: {pgc: {encoder: encoder.safetensors, head: head.safetensors}}}}";
    let scenario = write_scenario(folder.path(), 4, "lockstep: true", own);
    let mut up = Up::start(folder.path(), &scenario);
    // The feature maps of a vehicle without a pose cannot be used, which is reported.
    assert_eq!(up.wait().code(), Some(3));

    let json = |name: &str| -> Value {
        serde_json::from_str(&fs::read_to_string(up.folder.join(name)).unwrap()).unwrap()
    };
    let metrics = json("metrics.json");
    assert_eq!(metrics["pose_source"], "mixed");
    // An untrained network has no pose; the recorded one of the other vehicle is not changed.
    assert_eq!(metrics["pose"]["no_pose"], 4, "{}", metrics["pose"]);
    assert_eq!(metrics["pose"]["success_3m"], 0.5);
    assert_eq!(json("ledger.json")["balances"], true);
    let results = results(&up.folder);
    assert!(
        results.len() == 4
            && results
                .iter()
                .all(|result| result["skipped"][0]["cav"] == "4288"),
        "{results:?}"
    );
    assert_eq!(
        digested_files(&up),
        [
            "encoder.safetensors",
            "head.safetensors",
            "weights.safetensors"
        ]
    );
}

#[test]
fn a_vehicle_with_a_baseline_takes_part_with_the_pose_that_it_regresses() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    localizer::write_hypliloc(folder.path(), 3);
    let own = "vehicles: {4288: {pose: {baseline: {weights: hypliloc.safetensors}}}}";
    let scenario = write_scenario(folder.path(), 4, "lockstep: true", own);
    let mut up = Up::start(folder.path(), &scenario);
    assert_eq!(up.wait().code(), Some(0));
    let json = |name: &str| -> Value {
        serde_json::from_str(&fs::read_to_string(up.folder.join(name)).unwrap()).unwrap()
    };
    // It always has a pose with full confidence, which is the comparison with the localizer.
    let metrics = json("metrics.json");
    assert_eq!(
        (&metrics["pose_source"], &metrics["pose"]["no_pose"]),
        (&"mixed".into(), &0.into())
    );
    assert_eq!(
        metrics["pose"]["success_3m"], 0.5,
        "it has learnt nothing: {}",
        metrics["pose"]
    );
    assert_eq!(json("ledger.json")["balances"], true);
    assert_eq!(results(&up.folder).len(), 4);
    assert_eq!(
        digested_files(&up),
        ["hypliloc.safetensors", "weights.safetensors"]
    );
}

#[test]
fn eval_prints_the_summary_and_writes_the_requested_files() {
    let folder = tempfile::tempdir().unwrap();
    let (encoder, head) = scene_and_networks(folder.path());
    let file = |name: &str| folder.path().join(name);
    let [csv, plot, table] = ["sweeps.csv", "reliability.png", "errors.csv"]
        .map(|name| file(name).display().to_string());
    let more = [
        "--json",
        "--csv",
        &csv,
        "--plot",
        &plot,
        "--error-table",
        &table,
    ];
    let (code, output, stderr) = eval(folder.path(), &encoder, &head, &more);
    assert_eq!(code, Some(0), "{stderr}");
    let summary: Value = serde_json::from_str(&output).unwrap();
    assert_eq!(
        (
            &summary["sweeps"],
            &summary["no_pose"],
            &summary["success_3m"]
        ),
        (&8.into(), &8.into(), &0.0.into())
    );
    for name in [
        "success_1m",
        "mean_m",
        "p50_m",
        "p95_m",
        "mean_deg",
        "p50_deg",
        "sigma_spearman",
    ] {
        assert!(summary.get(name).is_some(), "{name}: {output}");
    }
    assert!(summary["ms"]["total"].as_f64().unwrap() > 0.0 && summary["ms"]["solve"].is_number());
    assert_eq!(fs::read_to_string(csv).unwrap().lines().count(), 9);
    assert_eq!(
        fs::read_to_string(table)
            .unwrap()
            .lines()
            .filter(|line| *line == "no_pose")
            .count(),
        8
    );
    assert!(fs::read(plot).unwrap().starts_with(b"\x89PNG"));
    // Every second sweep, three of them, as a table.
    let (code, output, _) = eval(
        folder.path(),
        &encoder,
        &head,
        &["--every", "2", "--sweeps", "3", "--solver", "sc2pcr"],
    );
    assert!(
        code == Some(0) && output.contains("3, 3 without a pose"),
        "{output}"
    );
}

#[test]
fn a_tracked_vehicle_has_an_accurate_pose_in_every_sweep_of_a_drive() {
    let folder = tempfile::tempdir().unwrap();
    let synth = Command::new(programs().join("sim-replay"))
        .args([
            "synth", "--subset", "town1loc", "--seed", "1600", "--scenes", "1",
        ])
        .args([
            "--frames",
            "20",
            "--period-s",
            "0.1",
            "--threads",
            "1",
            "--out",
        ])
        .arg(folder.path().join("scene"))
        .output()
        .unwrap();
    assert!(
        synth.status.success(),
        "{}",
        String::from_utf8_lossy(&synth.stderr)
    );
    let weights = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/weights");
    let networks =
        ["pgc-encoder.safetensors", "pgc-town1.safetensors"].map(|name| weights.join(name));
    let (code, output, stderr) = eval(
        folder.path(),
        &networks[0],
        &networks[1],
        &["--tracked", "--json"],
    );
    assert_eq!(code, Some(0), "{stderr}");
    let summaries: Value = serde_json::from_str(&output).unwrap();
    let tracked = &summaries["tracked"];
    assert_eq!(
        (
            &summaries["pgc"]["sweeps"],
            &tracked["sweeps"],
            &tracked["no_pose"]
        ),
        (&20.into(), &20.into(), &0.into())
    );
    assert!(
        tracked["p50_m"].as_f64().unwrap() < 0.2 && tracked["max_m"].as_f64().unwrap() < 1.0,
        "{output}"
    );
    let integrity = &tracked["integrity"];
    assert_eq!(integrity["poses"], 20);
    assert!(
        integrity["exceeded_share"].as_f64().unwrap() < 0.2,
        "{integrity}"
    );
    // Half of the sweeps are not measured, the others hardly searched.
    assert!(
        tracked["mean_ms"].as_f64().unwrap() < summaries["pgc"]["mean_ms"].as_f64().unwrap(),
        "{output}"
    );
}

#[test]
fn baselines_are_evaluated_on_the_same_sweeps_with_the_same_numbers() {
    let folder = tempfile::tempdir().unwrap();
    let (encoder, _) = scene_and_networks(folder.path());
    let scene = folder.path().join("scene");
    let eval = |option: &str, file: &Path, more: &[&str]| {
        eval_with(folder.path(), &[option.as_ref(), file.as_os_str()], more)
    };
    let json = |option: &str, file: &Path| -> Value {
        let (code, output, stderr) = eval(option, file, &["--json"]);
        assert_eq!(code, Some(0), "{stderr}");
        serde_json::from_str(&output).unwrap()
    };
    // These sweeps are mostly ground, of which few cells are used; a regressed pose is always reported, with full
    // confidence.
    let cells = localizer::write_sgloc(folder.path(), 3);
    let summary = json("--baseline", &cells);
    assert_eq!(
        (&summary["sweeps"], &summary["outcomes"]["too_few_points"]),
        (&8.into(), &8.into()),
        "{summary}"
    );
    assert!(summary["ms"]["solve"].as_f64().unwrap() > 0.0, "{summary}");
    let pose = localizer::write_hypliloc(folder.path(), 3);
    let summary = json("--baseline", &pose);
    assert_eq!(
        (&summary["outcomes"]["pose"], &summary["ms"]["solve"]),
        (&8.into(), &0.0.into()),
        "{summary}"
    );
    assert!(
        summary["mean_m"].as_f64().unwrap() > 0.0 && summary["calibration"][0]["sigma"] == 1.0,
        "{summary}"
    );
    // Registration against a map starts from a pose estimate, and these vehicles have none.
    assert_eq!(json("--icp-map", &scene)["outcomes"]["no_source"], 8);

    let (code, _, stderr) = eval("--baseline", &encoder, &[]);
    assert!(
        code == Some(2) && stderr.contains("encoder.safetensors: weights of kind"),
        "{stderr}"
    );
    let (code, _, stderr) = eval("--baseline", &pose, &["--fit-confidence"]);
    assert!(
        code == Some(2) && stderr.contains("cannot be used with"),
        "{stderr}"
    );
    let (code, _, stderr) = eval("--icp-map", &folder.path().join("nowhere"), &[]);
    assert!(code == Some(2) && stderr.contains("nowhere"), "{stderr}");
}

#[test]
fn a_confidence_needs_poses_to_be_fitted_on() {
    let folder = tempfile::tempdir().unwrap();
    let (encoder, head) = scene_and_networks(folder.path());
    let before = fs::read(&head).unwrap();
    let (code, _, stderr) = eval(folder.path(), &encoder, &head, &["--fit-confidence"]);
    assert!(
        code == Some(2) && stderr.contains("at least 40 sweeps with a pose, there are 0"),
        "{stderr}"
    );
    assert_eq!(fs::read(&head).unwrap(), before, "nothing is written then");
}

#[test]
fn files_that_are_wrong_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let (encoder, head) = scene_and_networks(folder.path());
    let others = tempfile::tempdir().unwrap();
    let (other_encoder, _) = localizer::write(others.path(), 4);
    let cut = folder.path().join("cut.safetensors");
    let whole = fs::read(&head).unwrap();
    fs::write(&cut, &whole[..whole.len() / 2]).unwrap();
    let missing = folder.path().join("missing.safetensors");
    for (encoder, head, parts) in [
        (
            &encoder,
            &cut,
            ["cut.safetensors", "not a complete safetensors file"],
        ),
        (&encoder, &missing, ["missing.safetensors", "no such file"]),
        (&head, &head, ["head.safetensors", "\"scene encoder\""]),
        (
            &encoder,
            &encoder,
            ["encoder.safetensors", "\"scene head\""],
        ),
        (
            &other_encoder,
            &head,
            ["head.safetensors", "trained on encoder"],
        ),
    ] {
        let (code, _, stderr) = eval(folder.path(), encoder, head, &[]);
        assert_eq!(code, Some(2), "{stderr}");
        assert!(
            parts.iter().all(|part| stderr.contains(part)),
            "{parts:?}: {stderr}"
        );
    }
    let (code, _, stderr) = eval(others.path(), &encoder, &head, &[]);
    assert!(code == Some(2) && stderr.contains("scene"), "{stderr}");
}

#[test]
fn an_agent_without_its_networks_does_not_start() {
    let folder = tempfile::tempdir().unwrap();
    let run = |more: &[&str]| {
        let output = Command::new(programs().join("agent"))
            .args([
                "run",
                "--cav",
                "7",
                "--run",
                "test",
                "--connect",
                "tcp/127.0.0.1:9",
            ])
            .arg("--weights")
            .arg(folder.path().join("weights.safetensors"))
            .args(more)
            .output()
            .unwrap();
        (
            output.status.code(),
            String::from_utf8_lossy(&output.stderr).into_owned(),
        )
    };
    tests::fleet::write_weights(&folder.path().join("weights.safetensors"));
    let (code, output) = run(&["--pose-source", "pgc"]);
    assert!(code == Some(2) && output.contains("--head"), "{output}");
    let (code, output) = run(&[
        "--pose-source",
        "pgc",
        "--encoder",
        "/nowhere/e",
        "--head",
        "/nowhere/h",
    ]);
    assert!(code == Some(2) && output.contains("/nowhere/h"), "{output}");
    let (code, output) = run(&["--pose-source", "baseline"]);
    assert!(code == Some(2) && output.contains("--baseline"), "{output}");
    let (code, output) = run(&["--pose-source", "baseline", "--baseline", "/nowhere/w"]);
    assert!(code == Some(2) && output.contains("/nowhere/w"), "{output}");
}

#[test]
fn a_fleet_whose_networks_do_not_fit_is_refused_before_it_starts() {
    let _exclusive = exclusive_lock();
    let folder = tempfile::tempdir().unwrap();
    localizer::write(folder.path(), 3);
    let pose = "agents: {pose: {pgc: {encoder: head.safetensors, head: head.safetensors}}}";
    let scenario = write_scenario(folder.path(), 1, "", pose);
    let runs = folder.path().join("runs");
    let output = Command::new(programs().join("v2vloc"))
        .arg("up")
        .arg(&scenario)
        .arg("--runs")
        .arg(&runs)
        .output();
    let output = output.unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(
        output.status.code() == Some(2)
            && stderr.contains("localizer: ")
            && stderr.contains("head.safetensors"),
        "{stderr}"
    );
}
