//! Recordings read by the public MCAP reader and a ROS 2 decoder.

use std::path::Path;

use super::{Contents, RecordingOptions, pose, recorded, write};

/// The public reader and a decoder of ROS 2 messages, if Python has them.
fn public_reader(path: &Path) -> Option<serde_json::Value> {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../../deploy/tools/check_recording.py");
    let python = std::env::var("V2V_PYTHON").unwrap_or_else(|_| "python3".into());
    let output = match std::process::Command::new(&python).arg(script).arg(path).output() {
        Ok(output) => output,
        Err(error) => {
            eprintln!("skipped: {python}: {error} (V2V_PYTHON names another)");
            return None;
        }
    };
    let stderr = String::from_utf8_lossy(&output.stderr);
    if output.status.code() == Some(2) {
        eprintln!("skipped: {}", stderr.trim());
        return None;
    }
    assert!(output.status.success(), "{stderr}");
    Some(serde_json::from_slice(&output.stdout).unwrap())
}

fn assert_near(found: &serde_json::Value, expected: &[f64]) {
    let found: Vec<f64> = found.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect();
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(expected) {
        assert!((found - expected).abs() < 1e-9 * expected.abs().max(1.0), "{found} is not {expected}");
    }
}

#[test]
fn the_public_reader_and_a_ros_decoder_find_the_same_numbers() {
    for zstd_level in [None, Some(3)] {
        let folder = tempfile::tempdir().unwrap();
        let path = write(folder.path(), &recorded(3, 100, RecordingOptions { zstd_level, contents: Contents::All }));
        let Some(found) = public_reader(&path) else { return };
        // Of each tick: two sweeps, two recorded poses, a ground truth; for ROS two clouds, boxes and transforms.
        assert_eq!(found["indexed"], serde_json::json!({"chunks": 3, "messages": 27}));
        assert_eq!(found["messages"]["v2v/test/4279/lidar"], 3);
        let points = &found["last"]["/cav_4288/points"];
        assert_eq!((&points["frame"], &points["points"]), (&"cav_4288/lidar".into(), &100.into()));
        assert_near(&serde_json::json!([points["stamp_s"]]), &[0.3]);
        assert_near(&points["last"], &[99.0, 2.0, 0.5, 0.25]);
        assert_near(&points["sums"], &[4950.0, 200.0, 50.0, 25.0]);
        let object = &found["first"]["/truth"][0];
        assert_eq!((&object["id"], &object["text"], &object["frame"]), (&7.into(), &"truck".into(), &"map".into()));
        assert_near(&object["position"], &[20.0, 3.0, 0.8]);
        assert_near(&object["size"], &[4.0, 1.8, 1.6]);
        assert_near(&object["wxyz"], &[0.05_f64.cos(), 0.0, 0.0, 0.05_f64.sin()]);
        let transform = &found["last"]["/tf"][1];
        assert_eq!(transform["child"], "cav_4288/truth");
        assert_near(&transform["position"], &pose(2).translation_m);
        assert_near(&transform["wxyz"], &pose(2).rotation_wxyz);
    }
}
