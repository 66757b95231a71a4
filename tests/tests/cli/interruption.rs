//! Ctrl-C in a training: it stops after the current step with a checkpoint, and is resumed from it.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use simulator::generate::{Subset, SynthOptions, generate};
use tests::fleet::{programs, signal};

/// Steps that no training here reaches.
const ENDLESS: &str = "1000000";

fn drives(folder: &Path) -> String {
    let out = folder.join("drives");
    let options = SynthOptions {
        frames: 12,
        period_s: 1.0,
        ..SynthOptions::new(Subset::Town1loc, 904, out.clone())
    };
    generate(&options, &|_| {}).unwrap();
    out.display().to_string()
}

fn encoder() -> String {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../deploy/weights/pgc-encoder.safetensors")
        .display()
        .to_string()
}

fn command(words: &[&str]) -> Command {
    let mut command = Command::new(programs().join(words[0]));
    command.args(&words[1..]);
    command
}

/// Starts a command and sends it `name` after the first line of standard error that contains `text`.
fn interrupted(words: &[&str], text: &str, name: &str) -> Output {
    let mut child = command(words)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap())
        .lines()
        .map_while(Result::ok);
    let before: Vec<String> = lines
        .by_ref()
        .take_while(|line| !line.contains(text))
        .collect();
    signal(child.id(), name);
    let after: Vec<String> = lines.collect();
    let mut output = child.wait_with_output().unwrap();
    output.stderr = [before, after].concat().join("\n").into_bytes();
    output
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// The step at which a training has stopped.
fn stopped_at(output: &Output) -> u64 {
    let text = stderr(output);
    assert_eq!(output.status.code(), Some(130), "{text}");
    let last = text.lines().last().unwrap_or_default();
    let step = last
        .strip_prefix("stopped at step ")
        .and_then(|rest| rest.strip_suffix("; --resume goes on"));
    step.unwrap_or_else(|| panic!("{text}")).parse().unwrap()
}

/// Stops a training that is endless but for its signal, and resumes it for one step.
fn stop_and_resume(training: &[&str], out: &Path) {
    let (out, resumed_out) = (out.display().to_string(), out.join("weights.safetensors"));
    let first = interrupted(
        &[training, &["--out", &out, "--steps", ENDLESS]].concat(),
        "step ",
        "INT",
    );
    let steps = (stopped_at(&first) + 1).to_string();
    assert!(!resumed_out.exists());
    let resumed = command(&[training, &["--out", &out, "--steps", &steps, "--resume"]].concat())
        .output()
        .unwrap();
    assert_eq!(
        resumed.status.code(),
        Some(0),
        "{training:?}: {}",
        stderr(&resumed)
    );
    let report = String::from_utf8_lossy(&resumed.stdout).into_owned();
    assert!(
        report.starts_with(&format!("{steps} steps in ")) && resumed_out.exists(),
        "{report}"
    );
}

#[test]
fn every_training_stops_with_a_checkpoint_and_is_resumed() {
    let folder = tempfile::tempdir().unwrap();
    let (drives, encoder) = (drives(folder.path()), encoder());
    let trainings: [&[&str]; 6] = [
        &[
            "agent",
            "train",
            "scene",
            "--dataset",
            &drives,
            "--encoder",
            &encoder,
            "--batch",
            "64",
        ],
        &[
            "agent",
            "train",
            "encoder",
            "--dataset",
            &drives,
            "--batch",
            "1",
        ],
        &[
            "agent",
            "train",
            "sgloc",
            "--dataset",
            &drives,
            "--encoder",
            &encoder,
        ],
        &[
            "agent",
            "train",
            "diffloc",
            "--dataset",
            &drives,
            "--encoder",
            &encoder,
            "--batch",
            "3",
        ],
        &[
            "agent",
            "train",
            "hypliloc",
            "--dataset",
            &drives,
            "--encoder",
            &encoder,
            "--batch",
            "2",
        ],
        &["ego-fuser", "train", "--dataset", &drives, "--batch", "1"],
    ];
    for training in trainings {
        let name = training[..3].join("-").replace('/', "-");
        stop_and_resume(training, &folder.path().join(name));
    }
}

#[test]
fn a_map_stops_with_a_checkpoint_and_is_resumed() {
    let folder = tempfile::tempdir().unwrap();
    let drives = drives(folder.path());
    let out: PathBuf = folder.path().join("map");
    let path = out.display().to_string();
    // Time enough for a first step on a busy machine; what is left of it need not be waited for.
    let map = ["agent", "map", &drives, "--out", &path, "--minutes", "5"];
    let resume = [&map[..5], &["--minutes", "0.2", "--resume"]].concat();

    let early = interrupted(&map, "reading", "INT");
    assert_eq!(
        early.status.code(),
        Some(130),
        "nothing to keep: {}",
        stderr(&early)
    );
    let nothing = command(&resume).output().unwrap();
    assert_eq!(nothing.status.code(), Some(2));
    assert!(
        stderr(&nothing).contains("checkpoint.safetensors is missing"),
        "{}",
        stderr(&nothing)
    );

    let steps = stopped_at(&interrupted(&map, "training, step", "TERM"));
    assert!(
        out.join("checkpoint.safetensors").exists() && !out.join("weights.safetensors").exists()
    );
    let refused = command(&map).output().unwrap();
    assert!(
        refused.status.code() == Some(2) && stderr(&refused).contains("--resume"),
        "{}",
        stderr(&refused)
    );
    let resumed = command(&resume).output().unwrap();
    assert!(
        matches!(resumed.status.code(), Some(0 | 3)),
        "{}",
        stderr(&resumed)
    );
    let card = std::fs::read_to_string(out.join("model-card.md")).unwrap();
    let row = card
        .lines()
        .find_map(|line| line.strip_prefix("| steps | "))
        .unwrap();
    let of_all: u64 = row.split(' ').next().unwrap().parse().unwrap();
    assert!(of_all >= steps, "{card}");
}
