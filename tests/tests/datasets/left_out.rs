//! Evaluation of a damaged data set: the rest is evaluated, omissions are counted and named, exit code 3.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use deploy::score::metrics::Metrics;
use simulator::generate::{Subset, SynthOptions, generate};
use tests::fleet::programs;

const FRAMES: usize = 5;
/// Released weights, trained with other scenes.
const WEIGHTS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/weights");

/// A generated scene of three vehicles, and the folders of these, the ego first.
fn scene(root: &Path) -> Vec<PathBuf> {
    let options = SynthOptions::new(Subset::V2vdet, 1011, root.to_owned());
    generate(
        &SynthOptions {
            frames: FRAMES,
            agents: 3..=3,
            ..options
        },
        &|_| {},
    )
    .unwrap();
    let folders = |dir: &Path| {
        let entries = fs::read_dir(dir)
            .unwrap()
            .map(|entry| entry.unwrap().path());
        let mut folders: Vec<PathBuf> = entries.filter(|path| path.is_dir()).collect();
        folders.sort();
        folders
    };
    let agents = folders(&folders(root)[0]);
    assert_eq!(agents.len(), 3);
    agents
}

/// The files of an agent with that suffix, in the order of their ticks.
fn files(agent: &Path, suffix: &str) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = fs::read_dir(agent)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    files.retain(|file| {
        let name = file.file_name().unwrap().to_string_lossy();
        name.strip_suffix(suffix)
            .is_some_and(|stem| stem.bytes().all(|byte| byte.is_ascii_digit()))
    });
    files.sort();
    assert_eq!(files.len(), FRAMES);
    files
}

/// Exit code, metrics and standard error of `v2vloc eval`.
fn eval(dataset: &Path, method: &str) -> (Option<i32>, Metrics, String) {
    let mut command = Command::new(programs().join("v2vloc"));
    command.arg("eval").arg("--dataset").arg(dataset).args([
        "--weights",
        WEIGHTS,
        "--method",
        method,
        "--json",
    ]);
    let output = command.output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    let metrics =
        serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{error}: {stderr}"));
    (output.status.code(), metrics, stderr)
}

/// The file of the same tick with another extension.
fn beside(sweep: &Path, ending: &str) -> PathBuf {
    let stem = sweep.file_stem().unwrap().to_string_lossy();
    sweep.with_file_name(format!("{stem}{ending}"))
}

fn truncate(file: &Path) {
    let bytes = fs::read(file).unwrap();
    fs::write(file, &bytes[..bytes.len() / 2]).unwrap();
}

#[test]
fn a_truncated_cloud_an_absurd_box_and_a_vehicle_that_leaves_cost_only_themselves() {
    let folder = tempfile::tempdir().unwrap();
    let agents = scene(folder.path());
    let (code, whole, stderr) = eval(folder.path(), "max");
    assert_eq!((code, whole.frames), (Some(0), FRAMES as u64), "{stderr}");

    truncate(&files(&agents[1], ".pcd")[1]);
    let yaml = &files(&agents[0], ".yaml")[2];
    let text = fs::read_to_string(yaml).unwrap();
    let (before, after) = text.split_once("extent:").unwrap();
    let (_, rest) = after.trim_start().split_once('\n').unwrap();
    // The first of three numbers, in a list of lines.
    assert!(after.trim_start().starts_with("- "), "{after}");
    fs::write(yaml, format!("{before}extent:\n    - 500.0\n{rest}")).unwrap();
    for suffix in [".pcd", ".yaml"] {
        files(&agents[2], suffix)[3..]
            .iter()
            .for_each(|file| fs::remove_file(file).unwrap());
    }

    let (code, metrics, stderr) = eval(folder.path(), "max");
    let left_out = &metrics.left_out;
    assert_eq!((code, metrics.frames), (Some(3), FRAMES as u64), "{stderr}");
    assert_eq!(
        (
            left_out.ticks,
            left_out.frames,
            left_out.parts,
            left_out.absent_frames
        ),
        (0, 1, 1, 2),
        "{stderr}"
    );
    let named = |name: &Path| stderr.contains(&*name.to_string_lossy());
    assert!(
        named(&files(&agents[0], ".yaml")[2]) && named(&files(&agents[1], ".pcd")[1]),
        "{stderr}"
    );
    assert!(stderr.contains("absent agents: 2 frames"), "{stderr}");
    assert!(
        metrics.ap_global.at_30.unwrap() > 0.3,
        "{:?}",
        metrics.ap_global
    );
}

#[test]
fn a_tick_whose_ego_cannot_be_read_is_not_judged() {
    let folder = tempfile::tempdir().unwrap();
    let agents = scene(folder.path());
    truncate(&files(&agents[0], ".pcd")[0]);
    let (code, metrics, stderr) = eval(folder.path(), "late");
    assert_eq!(
        (code, metrics.frames, metrics.left_out.ticks),
        (Some(3), FRAMES as u64 - 1, 1),
        "{stderr}"
    );
}

#[test]
fn a_vehicle_that_leaves_is_no_fault() {
    let folder = tempfile::tempdir().unwrap();
    let agents = scene(folder.path());
    for sweep in &files(&agents[1], ".pcd")[2..] {
        // The radar's points too.
        for file in [
            sweep.clone(),
            sweep.with_extension("yaml"),
            beside(sweep, "_radar.pcd"),
        ] {
            fs::remove_file(file).unwrap();
        }
    }
    let (code, metrics, stderr) = eval(folder.path(), "max");
    assert_eq!(
        (code, metrics.frames, metrics.left_out.absent_frames),
        (Some(0), FRAMES as u64, 3),
        "{stderr}"
    );
}
