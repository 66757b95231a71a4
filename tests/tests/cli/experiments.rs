//! Shipped experiments: every file of `deploy/experiments` runs to its end, shortened to one frame.

use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::SystemTime;

use serde_json::{Value, json};
use simulator::generate::{Subset, SynthOptions, generate};
use tests::fleet::programs;

/// Files of experiments and tables.
const EXPERIMENTS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/experiments");
/// Released weights.
const WEIGHTS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/weights");

/// All experiments and tables, in order.
fn files() -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = fs::read_dir(EXPERIMENTS)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|kind| kind == "yaml"))
        .collect();
    files.sort();
    files
}

/// The experiment on one frame of `scene`: of each axis its first and last value. Tables run every method.
fn shorten_experiment(experiment: &mut Value, scene: &Path) {
    let fields = experiment.as_object_mut().unwrap();
    fields.remove("generate");
    fields.insert("dataset".into(), json!(scene));
    fields.insert("weights".into(), json!(WEIGHTS));
    fields.insert("frames".into(), json!(1));
    if let Some(link) = fields.get_mut("link") {
        *link = json!(Path::new(EXPERIMENTS).join(link.as_str().unwrap()));
    }
    for values in fields["grid"].as_object_mut().unwrap().values_mut() {
        let values = values.as_array_mut().unwrap();
        if values.len() > 2 {
            values.drain(1..values.len() - 1);
        }
    }
}

/// The tables on one frame of `scene`, with all their rows and columns.
fn shorten_tables(tables: &mut Value, scene: &Path, maps: &Path) {
    let fields = tables.as_object_mut().unwrap();
    fields.insert("dataset".into(), json!(scene));
    fields.insert("weights".into(), json!(WEIGHTS));
    fields.insert("feature_maps".into(), json!(maps));
    fields.insert("frames".into(), json!(1));
}

#[test]
fn every_shipped_experiment_runs_to_its_end() {
    let folder = tempfile::tempdir().unwrap();
    let scene = folder.path().join("scene");
    let options = SynthOptions {
        frames: 1,
        agents: 4..=4,
        ..SynthOptions::new(Subset::V2vdet, 1200, scene.clone())
    };
    generate(&options, &|_| {}).unwrap();
    for file in files() {
        let name = file.file_stem().unwrap().to_str().unwrap();
        // JSON has no infinity: a rate that limits nothing.
        let text = fs::read_to_string(&file).unwrap().replace(".inf", "1e6");
        let text = text.replace("deploy/weights/", &format!("{WEIGHTS}/"));
        let mut content: Value = serde_saphyr::from_str(&text).unwrap();
        let is_table = content.get("tables").is_some();
        if is_table {
            shorten_tables(&mut content, &scene, &folder.path().join("maps"));
        } else {
            shorten_experiment(&mut content, &scene);
        }
        let short = folder.path().join(format!("{name}.yaml"));
        // JSON is YAML.
        fs::write(&short, content.to_string()).unwrap();
        let mut command = Command::new(programs().join("v2vloc"));
        if is_table {
            command.args(["eval", "--table"]).arg(&short);
        } else {
            command.arg("sweep").arg(&short).args(["--jobs", "2"]);
        }
        let out = folder.path().join(name);
        let output = command.arg("--out").arg(&out).output().unwrap();
        let messages = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(0), "{name}: {messages}");
        assert!(out.join(format!("{name}.csv")).is_file(), "{name}");
        assert!(!out.join("maps").exists(), "{name}: maps are removed");
    }
}

/// A sweep of the smoke test over one frame of `scene`, with these options; the caller waits for its end.
fn start_smoke(experiment: &Path, out: &Path, options: &[&str]) -> Child {
    let mut command = Command::new(programs().join("v2vloc"));
    command.arg("sweep").arg(experiment).arg("--out").arg(out);
    command.args(options).stdout(Stdio::null()).spawn().unwrap()
}

fn is_done(mut sweep: Child) -> bool {
    sweep.wait().unwrap().success()
}

/// Paths of the cells of a sweep, with their times of writing.
fn cells_of(out: &Path) -> BTreeMap<PathBuf, SystemTime> {
    let entries = fs::read_dir(out.join("cells")).unwrap();
    let paths = entries.map(|entry| entry.unwrap().path());
    paths
        .map(|path| {
            let written = fs::metadata(&path).unwrap().modified().unwrap();
            (path, written)
        })
        .collect()
}

/// Answer of a worker of the sweep to the request of a run.
fn answer_of_worker(experiment: &Path, out: &Path, request: &Value) -> String {
    let mut command = Command::new(programs().join("v2vloc"));
    command.arg("sweep").arg(experiment).arg("--out").arg(out);
    let mut worker = command
        .arg("--worker")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    // The end of the requests ends the worker.
    writeln!(worker.stdin.take().unwrap(), "{request}").unwrap();
    let output = worker.wait_with_output().unwrap();
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn a_worker_refuses_a_run_of_an_experiment_that_was_changed_meanwhile() {
    let folder = tempfile::tempdir().unwrap();
    let scene = folder.path().join("scene");
    let options = SynthOptions {
        frames: 1,
        ..SynthOptions::new(Subset::V2vdet, 1202, scene.clone())
    };
    generate(&options, &|_| {}).unwrap();
    let grid = json!({"method": ["late"]});
    let mut experiment =
        json!({"name": "changed", "dataset": scene, "weights": WEIGHTS, "grid": grid});
    let file = folder.path().join("changed.yaml");
    fs::write(&file, experiment.to_string()).unwrap();
    let out = folder.path().join("out");
    assert!(is_done(start_smoke(&file, &out, &[])));
    let cell = cells_of(&out).into_keys().next().unwrap();
    let text = fs::read_to_string(&cell).unwrap();
    let key = serde_json::from_str::<Value>(&text).unwrap()["key"].take();
    fs::remove_file(&cell).unwrap();

    experiment["ego"] = json!({"max_age_ms": 100});
    fs::write(&file, experiment.to_string()).unwrap();
    let answer = answer_of_worker(&file, &out, &json!([0, key]));
    let file = file.display();
    let expected = format!("refused {file} or a file that it names was changed");
    assert!(answer.starts_with(&expected), "{answer}");
    assert!(
        !cell.exists(),
        "no result under the key of another experiment"
    );
}

#[test]
fn figures_of_an_axis_that_left_the_experiment_are_removed() {
    let folder = tempfile::tempdir().unwrap();
    let scene = folder.path().join("scene");
    let options = SynthOptions {
        frames: 1,
        ..SynthOptions::new(Subset::V2vdet, 1202, scene.clone())
    };
    generate(&options, &|_| {}).unwrap();
    let (file, out) = (folder.path().join("e.yaml"), folder.path().join("out"));
    let sweep = |grid: Value| {
        let experiment = json!({"name": "e", "dataset": scene, "weights": WEIGHTS, "grid": grid});
        fs::write(&file, experiment.to_string()).unwrap();
        assert!(is_done(start_smoke(&file, &out, &[])));
        ["ap_loss.svg", "ap_loss.png", "own.svg"].map(|name| out.join(name).exists())
    };
    let both = sweep(json!({"method": ["late"], "loss": [0, 1]}));
    assert_eq!(both, [true, true, false]);
    fs::write(out.join("own.svg"), "").unwrap();
    let one = sweep(json!({"method": ["late"], "loss": [0]}));
    assert_eq!(one, [false, false, true], "files of others stay");
}

#[test]
fn a_table_is_checked_against_the_scenarios_that_it_evaluates() {
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("data");
    fs::create_dir(&data).unwrap();
    for (scenario, agents) in [("a", &["1", "2", "3"][..]), ("b", &["1", "2"])] {
        tests::scene::write(folder.path(), agents, 1);
        fs::rename(folder.path().join("scene"), data.join(scenario)).unwrap();
    }
    let weights = folder.path().join("weights.safetensors");
    tests::fleet::write_weights(&weights);
    let file = folder.path().join("tables.yaml");
    let tables = |of_table: usize| {
        let rows = json!([{"method": "none", "vehicles": 3}]);
        let table =
            json!({"name": "t", "scenarios": of_table, "rows": rows, "columns": [{"name": "c"}]});
        let experiment =
            json!({"dataset": data, "weights": weights, "scenarios": 1, "tables": [table]});
        fs::write(&file, experiment.to_string()).unwrap();
        let mut command = Command::new(programs().join("v2vloc"));
        command.args(["eval", "--table"]).arg(&file).arg("--out");
        let output = command.arg(folder.path().join("out")).output().unwrap();
        (
            output.status.code(),
            String::from_utf8(output.stderr).unwrap(),
        )
    };
    let (code, messages) = tables(2);
    let problem = "table \"t\": vehicles is 3, but scenario ";
    let expected = format!("{}: {problem}", file.display());
    assert!(
        code == Some(2) && messages.contains(&expected),
        "{messages}"
    );
    let (code, messages) = tables(1);
    assert_eq!(code, Some(0), "{messages}");
}

#[test]
fn slices_give_the_bytes_of_one_process_and_a_lost_cell_is_the_only_one_computed_again() {
    let folder = tempfile::tempdir().unwrap();
    let file = Path::new(EXPERIMENTS).join("smoke.yaml");
    let text = fs::read_to_string(file).unwrap().replace(".inf", "1e6");
    let mut experiment: Value = serde_saphyr::from_str(&text).unwrap();
    let scene = folder.path().join("scene");
    shorten_experiment(&mut experiment, &scene);
    // The first of two slices that start together generates the scene.
    let generator = json!({"seed": 1201, "scenes": 1, "frames": 1, "vehicles": [3, 3]});
    experiment["generate"] = generator;
    let short = folder.path().join("smoke.yaml");
    fs::write(&short, experiment.to_string()).unwrap();
    let (whole, sliced) = (folder.path().join("whole"), folder.path().join("sliced"));

    let slices = ["1/2", "2/2"].map(|slice| start_smoke(&short, &sliced, &["--slice", slice]));
    assert!(slices.into_iter().all(is_done));
    let computed = cells_of(&sliced);
    assert!(is_done(start_smoke(&short, &sliced, &[])));
    assert_eq!(cells_of(&sliced), computed, "nothing is missing");
    assert!(is_done(start_smoke(&short, &whole, &[])));
    let csv = |out: &Path| fs::read(out.join("smoke.csv")).unwrap();
    assert_eq!(csv(&sliced), csv(&whole));

    let lost = computed.keys().next().unwrap();
    fs::remove_file(lost).unwrap();
    for slice in ["1/2", "2/2"] {
        assert!(is_done(start_smoke(&short, &sliced, &["--slice", slice])));
    }
    let again = cells_of(&sliced);
    assert!(again[lost] > computed[lost]);
    let differs = |path: &&PathBuf| again[*path] != computed[*path];
    assert_eq!(computed.keys().filter(differs).count(), 1);
}
