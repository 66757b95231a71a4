//! Recordings read by the public MCAP reader and a ROS 2 decoder.

use std::path::Path;
use std::process::Command;

use protocol::{Camera, CameraMetadata, ImageFormat, Pinhole};
use sha2::{Digest, Sha256};

use super::{
    CavId, Contents, Disk, Key, Pose, RecordingOptions, RecordingWriter, RunId, Stream, pose,
    recorded, stamp, wire, write,
};

/// Findings of the public reader and a decoder of ROS 2 messages.
fn public_reader(path: &Path) -> serde_json::Value {
    let script = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../deploy/tools/check_recording.py"
    );
    let python = std::env::var("V2V_PYTHON").unwrap_or_else(|_| "python3".into());
    let output = Command::new(&python)
        .arg(script)
        .arg(path)
        .output()
        .expect("a Python interpreter");
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    serde_json::from_slice(&output.stdout).unwrap()
}

fn assert_near(found: &serde_json::Value, expected: &[f64]) {
    let found: Vec<f64> = found
        .as_array()
        .unwrap()
        .iter()
        .map(|number| number.as_f64().unwrap())
        .collect();
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(expected) {
        assert!(
            (found - expected).abs() < 1e-9 * expected.abs().max(1.0),
            "{found} is not {expected}"
        );
    }
}

#[test]
#[ignore = "needs mcap and mcap-ros2-support from PyPI in the Python that V2V_PYTHON names"]
fn the_public_reader_and_a_ros_decoder_find_the_same_numbers() {
    for zstd_level in [None, Some(3)] {
        let folder = tempfile::tempdir().unwrap();
        let path = write(
            folder.path(),
            &recorded(
                3,
                100,
                RecordingOptions {
                    zstd_level,
                    contents: Contents::All,
                },
            ),
        );
        let found = public_reader(&path);
        // Of each tick: two sweeps, two recorded poses, a ground truth; for ROS two clouds, boxes and transforms.
        assert_eq!(
            found["indexed"],
            serde_json::json!({"chunks": 3, "messages": 27})
        );
        assert_eq!(found["messages"]["v2v/test/4279/lidar"], 3);
        let points = &found["last"]["/cav_4288/points"];
        assert_eq!(
            (&points["frame"], &points["points"]),
            (&"cav_4288/lidar".into(), &100.into())
        );
        assert_near(&serde_json::json!([points["stamp_s"]]), &[0.3]);
        assert_near(&points["last"], &[99.0, 2.0, 0.5, 0.25]);
        assert_near(&points["sums"], &[4950.0, 200.0, 50.0, 25.0]);
        let object = &found["first"]["/truth"][0];
        assert_eq!(
            (&object["id"], &object["text"], &object["frame"]),
            (&7.into(), &"truck".into(), &"map".into())
        );
        assert_near(&object["position"], &[20.0, 3.0, 0.8]);
        assert_near(&object["size"], &[4.0, 1.8, 1.6]);
        assert_near(&object["wxyz"], &[0.05_f64.cos(), 0.0, 0.0, 0.05_f64.sin()]);
        let transform = &found["last"]["/tf"][1];
        assert_eq!(transform["child"], "cav_4288/truth");
        assert_near(&transform["position"], &pose(2).translation_m);
        assert_near(&transform["wxyz"], &pose(2).rotation_wxyz);
    }
}

#[test]
#[ignore = "needs mcap and mcap-ros2-support from PyPI in the Python that V2V_PYTHON names"]
fn the_public_reader_finds_images_bit_for_bit_and_their_calibration() {
    let pinhole = Pinhole {
        fx_px: 335.6,
        fy_px: 335.7,
        cx_px: 400.0,
        cy_px: 300.0,
    };
    let metadata = CameraMetadata {
        format: ImageFormat::Png,
        width_px: 800,
        height_px: 600,
        pinhole: Some(pinhole),
        lidar_from_camera: Some(Pose::from_xyz_yaw([0.5, 0.0, -0.2], 0.0)),
    };
    let image: Vec<u8> = (0..5_000_u32).map(|k| (k * 7 % 251) as u8).collect();
    let expected = Sha256::digest(&image)
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect::<String>();
    let key = Key::stream(
        &RunId::new("test").unwrap(),
        &CavId::new("4279").unwrap(),
        Stream::Camera(2),
    );
    let payload = wire::encode(&stamp("4279", 0), Camera { metadata, image })
        .unwrap()
        .to_vec();
    let disk = Disk::new(usize::MAX);
    let mut writer =
        RecordingWriter::over(disk.clone(), Path::new("t"), RecordingOptions::default()).unwrap();
    writer.write(&key, 1_000, &payload).unwrap();
    writer.finish().unwrap();
    let folder = tempfile::tempdir().unwrap();

    let found = public_reader(&write(folder.path(), &disk.bytes()));

    let read = &found["first"]["/cav_4279/camera_2/image/compressed"];
    assert_eq!(
        (&read["frame"], &read["format"]),
        (&"cav_4279/camera_2".into(), &"png".into())
    );
    assert_eq!(read["sha256"], expected);
    let info = &found["first"]["/cav_4279/camera_2/camera_info"];
    assert_eq!(
        (&info["width"], &info["height"]),
        (&800.into(), &600.into())
    );
    assert_near(
        &info["intrinsics"],
        &[335.6, 0.0, 400.0, 0.0, 335.7, 300.0, 0.0, 0.0, 1.0],
    );
}
