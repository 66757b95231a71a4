//! KITTI odometry: `sequences/<number>/{velodyne,calib.txt,times.txt}` and `poses/<number>.txt`.
//!
//! Poses are of the left camera, in the frame of the first scan's camera: the position of the sequence in the world is
//! lost.

use std::path::Path;

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion};

use super::boxes::float_bytes;
use super::disk::{make_folder, write_file};
use super::sequences::{SequenceStyle, WrittenSequence};
use crate::generate::error::SynthError;

/// The camera's axes (x right, y down, z forward) in those of the LiDAR, at the same place.
const CALIBRATION: &str = "\
P0: 7.188560e+02 0 6.071928e+02 0 0 7.188560e+02 1.852157e+02 0 0 0 1 0
P1: 7.188560e+02 0 6.071928e+02 0 0 7.188560e+02 1.852157e+02 0 0 0 1 0
P2: 7.188560e+02 0 6.071928e+02 0 0 7.188560e+02 1.852157e+02 0 0 0 1 0
P3: 7.188560e+02 0 6.071928e+02 0 0 7.188560e+02 1.852157e+02 0 0 0 1 0
Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0
";

/// `camera_from_lidar` of [`CALIBRATION`].
pub(super) fn camera_from_lidar() -> Isometry3<f64> {
    let axes = Matrix3::new(0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    Isometry3::from_parts(Translation3::identity(), rotation)
}

/// The style.
pub(super) static STYLE: SequenceStyle = SequenceStyle {
    epoch_micros: 0,
    folder: |sequence| format!("sequences/{sequence:02}"),
    sweeps_folder: "velodyne",
    file_name: |moment, _| format!("{moment:06}.bin"),
    points: |points, _| float_bytes(points.iter().copied()),
    write_poses,
};

fn write_poses(root: &Path, sequence: &WrittenSequence<'_>) -> Result<(), SynthError> {
    let folder = root.join(&sequence.folder);
    write_file(&folder.join("calib.txt"), CALIBRATION)?;
    // Seconds from the first moment, one a line.
    let first = sequence.capture_nanos.first().copied().unwrap_or(0);
    let nanos = sequence.capture_nanos.iter();
    let seconds = nanos.map(|nanos| (nanos - first) as f64 / 1e9);
    let times: String = seconds.map(|seconds| format!("{seconds:e}\n")).collect();
    write_file(&folder.join("times.txt"), times)?;
    let poses = root.join("poses");
    make_folder(&poses)?;
    let file = poses.join(format!("{:02}.txt", sequence.number));
    write_file(&file, pose_lines(sequence))
}

/// One line per capture time, since the line number is the scan number; where there is no pose, the previous one is
/// repeated.
fn pose_lines(sequence: &WrittenSequence<'_>) -> String {
    let camera_from_lidar = camera_from_lidar();
    let Some(first) = sequence.sweeps.first() else {
        return String::new();
    };
    let first_from_world = first.world_from_lidar.isometry().inverse();
    let mut text = String::with_capacity(280 * sequence.capture_nanos.len());
    for moment in 0..sequence.capture_nanos.len() {
        let next = sequence
            .sweeps
            .partition_point(|sweep| sweep.moment <= moment);
        let sweep = &sequence.sweeps[next.saturating_sub(1)];
        let first_from_lidar = first_from_world * sweep.world_from_lidar.isometry();
        // The same motion in the camera's axes: C T C^-1 with C = camera_from_lidar.
        let pose =
            (camera_from_lidar * first_from_lidar * camera_from_lidar.inverse()).to_homogeneous();
        let row: [String; 12] =
            std::array::from_fn(|place| format!("{:e}", pose[(place / 4, place % 4)]));
        text += &(row.join(" ") + "\n");
    }
    text
}
