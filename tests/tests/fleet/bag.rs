//! A robot's own bag: a drive in the layout of a public driver, written by other people's program, mapped and located.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use dataset::{Layout, LoadOptions, Scenario};
use serde_json::Value;
use simulator::generate::{Subset, SynthOptions, generate};
use tests::fleet::programs;

/// A drive of two sweeps a second, as clouds with poses.
fn drive(folder: &Path, frames: usize) -> PathBuf {
    let scene = folder.join("scene");
    let options = SynthOptions {
        traversals: 1,
        frames,
        period_s: 0.5,
        ..SynthOptions::new(Subset::Town1loc, 903, scene.clone())
    };
    generate(&options, &|_| {}).unwrap();
    let scenario = dataset::open(&scene).unwrap().scenarios.swap_remove(0);
    let out = folder.join("drive");
    fs::create_dir_all(out.join("clouds")).unwrap();
    let mut poses = String::new();
    for tick in 0..scenario.ticks.len() {
        let frame = scenario.load(0, tick, &LoadOptions::default()).unwrap();
        let nanos = 1_700_000_000_000_000_000 + frame.capture_nanos;
        let seconds = format!("{}.{:09}", nanos / 1_000_000_000, nanos % 1_000_000_000);
        let pose = frame.world_from_lidar.unwrap();
        let ([x, y, z], [qw, qx, qy, qz]) = (pose.translation_m, pose.rotation_wxyz);
        writeln!(poses, "{seconds} {x} {y} {z} {qx} {qy} {qz} {qw}").unwrap();
        let numbers = frame.points.xyzi.iter().flatten();
        let bytes: Vec<u8> = numbers.flat_map(|number| number.to_le_bytes()).collect();
        fs::write(out.join(format!("clouds/{seconds}.bin")), bytes).unwrap();
    }
    fs::write(out.join("poses.txt"), poses).unwrap();
    out
}

/// The drive as a bag, by the package `rosbags`.
fn write_bag(drive: &Path, storage: &str, compression: &str) -> PathBuf {
    let bag = drive.with_file_name(format!("{storage}-{compression}"));
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/tools/write_bag.py");
    let python = std::env::var("V2V_PYTHON").unwrap_or_else(|_| "python3".into());
    let written = Command::new(&python)
        .args([Path::new(script), drive, &bag])
        .args([storage, compression])
        .output()
        .expect("a Python interpreter");
    assert!(written.status.success(), "{}", errors(&written));
    bag
}

fn errors(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn agent(arguments: &[&str]) -> Output {
    let mut command = Command::new(programs().join("agent"));
    command.args(arguments).output().unwrap()
}

/// Position and heading (radians) of every sweep.
fn poses(scenario: &Scenario) -> Vec<([f64; 3], f64)> {
    let blind = LoadOptions {
        points: false,
        ..LoadOptions::default()
    };
    (0..scenario.ticks.len())
        .map(|tick| {
            scenario
                .load(0, tick, &blind)
                .unwrap()
                .world_from_lidar
                .unwrap()
        })
        .map(|pose| (pose.translation_m, pose.yaw_rad()))
        .collect()
}

fn distance_m(one: [f64; 3], other: [f64; 3]) -> f64 {
    let squares = one
        .iter()
        .zip(other)
        .map(|(one, other)| (one - other).powi(2));
    squares.sum::<f64>().sqrt()
}

#[test]
#[ignore = "needs rosbags and numpy from PyPI in the Python that V2V_PYTHON names"]
fn a_bag_of_a_robot_is_read_mapped_and_located() {
    let folder = tempfile::tempdir().unwrap();
    let drive = drive(folder.path(), 40);
    let truth = dataset::open(&drive).unwrap().scenarios.swap_remove(0);
    let bags = [
        ("mcap", "none"),
        ("sqlite3", "none"),
        ("mcap", "message"),
        ("sqlite3", "file"),
    ]
    .map(|(storage, compression)| write_bag(&drive, storage, compression));
    for bag in &bags {
        let opened = dataset::open(bag).unwrap();
        assert!(opened.problems.is_empty(), "{:?}", opened.problems);
        let scenario = &opened.scenarios[0];
        assert_eq!(
            (scenario.layout, scenario.ticks.len()),
            (Layout::ROSBAG, 40)
        );
        assert!(
            scenario.joins[0].contains("transforms (os_sensor in map)"),
            "{:?}",
            scenario.joins
        );
        for ((found, yaw), (expected, expected_yaw)) in
            poses(scenario).into_iter().zip(poses(&truth))
        {
            assert!(distance_m(found, expected) < 0.05 && (yaw - expected_yaw).sin().abs() < 0.01);
        }
        let load = |scenario: &Scenario| scenario.load_points(0, 7, None).unwrap().points.xyzi;
        let (read, written) = (load(scenario), load(&truth));
        assert!(
            read.len() == written.len()
                && read
                    .iter()
                    .zip(&written)
                    .all(|(one, other)| one[..3] == other[..3])
        );
    }
    let map = folder.path().join("place");
    let weights = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/weights");
    let encoder = weights.join("pgc-encoder.safetensors");
    let [of_map, of_search] = [&bags[0], &bags[1]].map(|bag| bag.to_str().unwrap());
    let (map, encoder) = (map.to_str().unwrap(), encoder.to_str().unwrap());
    let made = agent(&[
        "map",
        of_map,
        "--out",
        map,
        "--encoder",
        encoder,
        "--minutes",
        "2",
        "--json",
    ]);
    assert_eq!(made.status.code(), Some(0), "{}", errors(&made));
    let located = agent(&["locate", of_search, "--head", map, "--json"]);
    let found: Vec<Value> = String::from_utf8_lossy(&located.stdout)
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    assert_eq!(found.len(), 40, "{}", errors(&located));
    let mut distances: Vec<f64> = found
        .iter()
        .zip(poses(&truth))
        .filter_map(|(found, (expected, _))| {
            let position = serde_json::from_value(found["pose"]["position_m"].clone()).ok()?;
            Some(distance_m(position, expected))
        })
        .collect();
    distances.sort_by(f64::total_cmp);
    let close = distances.iter().filter(|distance| **distance < 3.0).count();
    let median = distances.get(distances.len() / 2);
    println!(
        "{} of 40 sweeps with a pose, {close} under 3 m, median {median:?} m",
        distances.len()
    );
    assert!(close >= 20, "{distances:?}");
}
