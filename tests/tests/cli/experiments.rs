//! Shipped experiments: every file of `deploy/experiments` runs to its end, shortened to one frame.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

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

/// The experiment on one frame of `scene`: of each axis but the method its first and last value.
fn shorten_experiment(experiment: &mut Value, scene: &Path) {
    let fields = experiment.as_object_mut().unwrap();
    fields.remove("generate");
    fields.insert("dataset".into(), json!(scene));
    fields.insert("weights".into(), json!(WEIGHTS));
    fields.insert("frames".into(), json!(1));
    if let Some(link) = fields.get_mut("link") {
        *link = json!(Path::new(EXPERIMENTS).join(link.as_str().unwrap()));
    }
    for (name, values) in fields["grid"].as_object_mut().unwrap() {
        let values = values.as_array_mut().unwrap();
        if name != "method" && values.len() > 2 {
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
