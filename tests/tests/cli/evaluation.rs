//! `v2vloc eval`: a fusion from a TorchScript file beside the built-in one, offline, and the files of the frames.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use dataset::average_precision::{Ordering, Scorer};
use dataset::ground_truth::GroundTruth;
use protocol::Detection;
use serde_json::Value;
use simulator::generate::{Subset, SynthOptions, generate};
use tests::fleet::{deploy_file, programs, v2vloc, write_scenario};

const FRAMES: usize = 3;

fn script() -> String {
    format!("script:{}", deploy_file("examples/attention.pt"))
}

fn lines(file: PathBuf) -> Vec<Value> {
    fs::read_to_string(file)
        .unwrap()
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect()
}

#[test]
fn a_script_gives_the_precision_of_the_built_in_method_and_the_files_hold_the_frames() {
    let folder = tempfile::tempdir().unwrap();
    let scene = folder.path().join("scene");
    let options = SynthOptions {
        frames: FRAMES,
        ..SynthOptions::new(Subset::V2vdet, 905, scene.clone())
    };
    generate(&options, &|_| {}).unwrap();
    let out = folder.path().join("out");
    let [script, weights, out_text, scene] = [
        script(),
        deploy_file("weights"),
        out.display().to_string(),
        scene.display().to_string(),
    ];
    let arguments = [
        "eval",
        "--dataset",
        &scene,
        "--weights",
        &weights,
        "--json",
        "--out",
        &out_text,
    ];
    let output = v2vloc(&[&arguments[..], &["--method", &script, "attention"]].concat());
    assert_eq!(
        output.status.code(),
        Some(0),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let all: Vec<Value> = serde_json::from_slice(&output.stdout).unwrap();
    let precision = |metrics: &Value, iou: &str| metrics["ap_global"][iou].as_f64().unwrap();
    for iou in ["0.3", "0.5", "0.7"] {
        let [of_script, built_in] = [0, 1].map(|index| precision(&all[index], iou));
        assert!(
            (of_script - built_in).abs() < 1e-4 && built_in > 0.1,
            "{iou}: {of_script} and {built_in}"
        );
    }

    let frames = out.join("attention");
    let (detections, truth) = (
        lines(frames.join("detections.jsonl")),
        lines(frames.join("truth.jsonl")),
    );
    assert_eq!((detections.len(), truth.len()), (FRAMES, FRAMES));
    let mut scorer = Scorer::default();
    for (found, wanted) in detections.iter().zip(&truth) {
        assert_eq!(
            (&found["tick"], &found["scenario"]),
            (&wanted["tick"], &wanted["scenario"])
        );
        let found: Vec<Detection> = serde_json::from_value(found["detections"].clone()).unwrap();
        let wanted: GroundTruth = serde_json::from_value(wanted.clone()).unwrap();
        scorer.add(&found, &wanted);
    }
    for (computed, iou) in scorer
        .average_precisions(Ordering::Global)
        .iter()
        .zip(["0.3", "0.5", "0.7"])
    {
        let computed = computed.unwrap();
        assert!(
            (computed - precision(&all[1], iou)).abs() < 1e-9,
            "{iou}: {computed}"
        );
    }
    let rows = fs::read_to_string(frames.join("frames.csv")).unwrap();
    assert!(
        rows.starts_with("scenario,tick,") && rows.lines().count() == 1 + FRAMES,
        "{rows}"
    );
    let scenario = detections[0]["scenario"].as_str();
    let names = rows.lines().skip(1).map(|row| row.split(',').next());
    assert_eq!(names.collect::<Vec<_>>(), [scenario; FRAMES]);
    let curve = fs::read_to_string(frames.join("precision_recall.csv")).unwrap();
    let boxes: usize = detections
        .iter()
        .map(|line| line["detections"].as_array().unwrap().len())
        .sum();
    assert_eq!(
        curve.lines().count(),
        1 + 3 * boxes,
        "a point per detection and threshold"
    );

    let again = v2vloc(&[&arguments[..], &["--method", "attention"]].concat());
    let text = String::from_utf8_lossy(&again.stderr).into_owned();
    assert!(
        again.status.code() == Some(2) && text.contains("attention"),
        "files are not overwritten: {text}"
    );
    let slow = [
        "--method",
        "attention",
        "--bandwidth-mbps",
        "27",
        "--latency-ms",
        "100",
        "--deadline-ms",
        "200",
    ];
    let slow = v2vloc(&[&arguments[..6], &slow[..]].concat());
    let metrics: Value = serde_json::from_slice(&slow.stdout).unwrap();
    assert_eq!(metrics["clock"], "stepped");
    // 1.5 MB take 466 ms at 27 Mbit/s: nothing is in time.
    assert_eq!(
        metrics["contribution"]["fused_per_frame"].as_f64(),
        Some(0.0),
        "{metrics}"
    );
}

/// Evaluates `late` on a scene; exit code, metrics and notes.
fn evaluated(scene: &Path) -> (Option<i32>, Value, String) {
    let (scene, weights) = (scene.to_str().unwrap(), deploy_file("weights"));
    let arguments = [
        "--dataset",
        scene,
        "--weights",
        &weights,
        "--method",
        "late",
    ];
    let output = v2vloc(&[&["eval", "--json"][..], &arguments].concat());
    let metrics = serde_json::from_slice(&output.stdout).unwrap_or_default();
    let notes = String::from_utf8_lossy(&output.stderr).into_owned();
    (output.status.code(), metrics, notes)
}

#[test]
fn a_tick_without_the_true_pose_of_the_ego_is_left_out_as_if_it_were_not_there() {
    let folder = tempfile::tempdir().unwrap();
    let scene = folder.path().join("scene");
    let options = SynthOptions {
        frames: FRAMES,
        ..SynthOptions::new(Subset::V2vdet, 905, scene.clone())
    };
    generate(&options, &|_| {}).unwrap();
    let ego = dataset::open(&scene).unwrap().scenarios[0].points_path(0, 0, None);
    let sweep = ego.unwrap();
    let yaml = sweep.with_extension("yaml");
    let text = fs::read_to_string(&yaml).unwrap();
    // The first tick, so that the scenario is not judged by it.
    fs::write(&yaml, text.replace("lidar_pose:", "no_pose:")).unwrap();
    let (code, unposed, notes) = evaluated(&scene);
    assert_eq!(code, Some(3), "{notes}");
    let finding = format!("{}: lidar_pose: no true pose of the ego", sweep.display());
    assert!(notes.contains(&finding), "{notes}");
    assert_eq!(
        (&unposed["frames"], &unposed["left_out"]["ticks"]),
        (&(FRAMES - 1).into(), &1.into())
    );
    check_other_commands(folder.path(), &finding, &unposed["left_out"]["findings"]);
    fs::remove_file(sweep).unwrap();
    fs::remove_file(yaml).unwrap();
    let (_, without, _) = evaluated(&scene);
    assert_eq!(unposed["ap_global"], without["ap_global"]);
}

/// `ego-fuser eval` and `v2vloc up` in simulation time leave the same tick out, with the same words.
fn check_other_commands(folder: &Path, finding: &str, findings: &Value) {
    let weights = deploy_file("weights/lean-max.safetensors");
    let mut eval = Command::new(programs().join("ego-fuser"));
    eval.args(["eval", "--method", "late", "--json", "--weights", &weights]);
    let output = eval.arg("--dataset").arg(folder.join("scene")).output();
    let output = output.unwrap();
    let notes = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(3), "{notes}");
    assert!(notes.contains(finding), "{notes}");
    let rows: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(rows[0]["frames"], FRAMES - 1);

    let (scenario, runs) = (folder.join("scenario.yaml"), folder.join("runs"));
    let text = format!(
        "run: test\nscene: {{dir: scene}}\nmodels: {{weights: {weights}}}\nmethod: late\nclock: stepped\n\
         stepped: {{compute: {{pose_ms: 5, map_ms: 30, fuse_ms: 10}}}}\n"
    );
    fs::write(&scenario, text).unwrap();
    let [scenario, in_runs] = [&scenario, &runs].map(|path| path.display().to_string());
    let output = v2vloc(&["up", &scenario, "--runs", &in_runs]);
    let notes = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(3), "{notes}");
    assert!(notes.contains(finding), "{notes}");
    let metrics = fs::read_to_string(runs.join("test/metrics.json")).unwrap();
    let metrics: Value = serde_json::from_str(&metrics).unwrap();
    assert_eq!(
        (&metrics["ticks"], &metrics["answered"]),
        (&(FRAMES - 1).into(), &(FRAMES - 1).into())
    );
    assert_eq!(&metrics["left_out"]["findings"], findings);
    let lines = ["detections.jsonl", "truth.jsonl", "frames.csv"].map(|name| {
        let text = fs::read_to_string(runs.join("test").join(name)).unwrap();
        text.lines().count()
    });
    assert_eq!(lines, [FRAMES, FRAMES - 1, 1 + FRAMES]);
}

#[test]
fn kept_feature_maps_change_no_result_and_wrong_weights_are_found_before_the_first_frame() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).display().to_string();
    let options = SynthOptions {
        frames: 1,
        ..SynthOptions::new(Subset::V2vdet, 905, at("scene").into())
    };
    generate(&options, &|_| {}).unwrap();
    let eval = |out: &str, weights: &str, more: &[&str]| {
        let (scene, out) = (at("scene"), at(out));
        let files = ["--dataset", &scene, "--weights", weights, "--out", &out];
        v2vloc(&[&["eval"][..], &files, more].concat())
    };
    let (weights, maps) = (deploy_file("weights"), at("maps"));
    // The boxes of `late` are those of single vehicles, whose maps are not sent.
    let sent = ["--method", "late,max", "--dtype", "i8"];
    let computed = eval("computed", &weights, &sent);
    let kept = eval(
        "kept",
        &weights,
        &[&sent[..], &["--feature-maps", &maps]].concat(),
    );
    assert!(
        computed.status.success() && kept.status.success(),
        "{kept:?}"
    );
    for method in ["late", "max"] {
        let [computed, kept] = ["computed", "kept"].map(|out| {
            let file = folder
                .path()
                .join(out)
                .join(method)
                .join("detections.jsonl");
            lines(file).remove(0)["detections"].take()
        });
        assert!(!computed.as_array().unwrap().is_empty());
        assert_eq!(computed, kept, "{method}");
    }

    let of_max = deploy_file("weights/lean-max.safetensors");
    let refused = eval("refused", &of_max, &["--method", "max,pastat"]);
    assert_eq!(refused.status.code(), Some(2), "{refused:?}");
    assert!(
        !folder.path().join("refused").exists(),
        "nothing is evaluated"
    );
}

#[test]
fn the_bench_states_every_stage_in_milliseconds_and_in_units() {
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), 6, "", "");
    let scenario = scenario.to_str().unwrap();
    let printed = v2vloc(&["bench", scenario, "--seconds", "0", "--json"]);
    assert!(printed.status.success(), "{printed:?}");
    let all: Value = serde_json::from_slice(&printed.stdout).unwrap();
    let of = |field: &str| all[0][field].as_f64().unwrap();
    assert!(
        of("unit_ms") > 0.1 && of("agent_ms") > 0.0 && of("fuse_ms") > 0.0,
        "{all}"
    );
    let needed_ms = 2.0 * of("agent_ms") + of("fuse_ms") + of("messages_ms");
    assert!((of("needed_ms") - needed_ms).abs() < 1e-9, "{all}");
    let units = of("frame_units") * of("unit_ms");
    assert!((units - needed_ms).abs() < 1e-9 && of("agent_units") > 0.0 && of("ego_units") > 0.0);
    let stages = |process: usize| -> Vec<&str> {
        let stages = all[0]["stages"][process].as_array().unwrap();
        stages
            .iter()
            .map(|stage| stage[0].as_str().unwrap())
            .collect()
    };
    assert!(
        stages(0).contains(&"backbone") && stages(1).contains(&"fuse"),
        "{all}"
    );
    let text = v2vloc(&[
        "bench",
        scenario,
        "--seconds",
        "0",
        "--set",
        "scene.lockstep=true",
    ]);
    assert_eq!(text.status.code(), Some(2), "{text:?}");
}
