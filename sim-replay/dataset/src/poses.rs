//! Poses in the numbers of files, and the check that a scenario has poses, for operations that need them.

use std::f64::consts::TAU;

use nalgebra::{Isometry3, Matrix4, Quaternion};
use protocol::{InvalidPose, Pose};

use super::{LoadOptions, Scenario};

/// Largest deviation of a quaternion's length from 1: tf2's own.
const UNIT_TOLERANCE: f64 = 0.01;
/// Frames that are tried, since the first of them may be damaged.
const FRAMES_TO_TRY: usize = 10;

/// An angle of a box in radians, or a sentence for more than a whole turn.
pub(super) fn box_angle_rad(angle: f64) -> Result<f64, String> {
    let is_angle = angle.abs() <= TAU + 0.01;
    let reason = || format!("{angle} rad, expected -2 pi to 2 pi: degrees?");
    is_angle.then_some(angle).ok_or_else(reason)
}

/// The pose of a 3x4 or 4x4 matrix, row by row.
pub(super) fn of_rows(rows: &[f64]) -> Result<Pose, InvalidPose> {
    let rows = rows.iter().copied().chain([0.0, 0.0, 0.0, 1.0]);
    Pose::from_matrix(&Matrix4::from_row_iterator(rows))
}

/// The pose, if its numbers are in range.
pub(super) fn valid(pose: impl Into<Pose>) -> Result<Pose, InvalidPose> {
    let pose: Pose = pose.into();
    pose.validate().map(|()| pose)
}

/// The rigid transform of a pose whose quaternion may be rounded.
pub(super) fn of_rounded(pose: &Pose) -> Result<Isometry3<f64>, String> {
    let [w, x, y, z] = pose.rotation_wxyz;
    let length = Quaternion::new(w, x, y, z).norm();
    let is_unit = (length - 1.0).abs() < UNIT_TOLERANCE;
    if !is_unit {
        return Err(format!("quaternion of length {length:.3}, expected 1"));
    }
    let isometry = pose.isometry();
    let checked = valid(isometry).map_err(|error| error.to_string());
    checked.map(|_| isometry)
}

impl Scenario {
    /// True if the recording gives the pose of an agent's LiDAR, according to the first readable frame from `tick` on.
    pub fn has_poses(&self, agent: usize, tick: usize) -> bool {
        let blind = LoadOptions::without_points();
        let ticks = (tick..self.ticks.len()).take(FRAMES_TO_TRY);
        let mut frames = ticks.filter_map(|tick| self.load(agent, tick, &blind).ok());
        // If nothing can be read, that is reported instead.
        frames
            .next()
            .is_none_or(|frame| frame.world_from_lidar.is_some())
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use protocol::PointCloud;

    use crate::LoadOptions;
    use crate::pcd::{Encoding, IntensityField, encode};

    /// A scenario of one frame, whose agent 1 has a YAML file of this text, if any.
    fn scenario(yaml: Option<&str>) -> (tempfile::TempDir, crate::Scenario) {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("1");
        fs::create_dir(&folder).unwrap();
        let cloud = PointCloud {
            xyzi: vec![[1.0, 2.0, 3.0, 0.5]],
        };
        fs::write(
            folder.join("000070.pcd"),
            encode(&cloud, Encoding::Binary, IntensityField::Intensity),
        )
        .unwrap();
        if let Some(yaml) = yaml {
            fs::write(folder.join("000070.yaml"), yaml).unwrap();
        }
        let mut dataset = crate::open(dir.path()).unwrap();
        assert!(dataset.problems.is_empty(), "{:?}", dataset.problems);
        (dir, dataset.scenarios.swap_remove(0))
    }

    #[test]
    fn sweeps_without_poses_are_frames() {
        for yaml in [
            None,
            Some("ego_speed: 36\n"),
            Some("lidar_pose: null\nvehicles: null\nego_speed: 36\n"),
        ] {
            let (_dir, scenario) = scenario(yaml);
            assert!(!scenario.has_poses(0, 0), "{yaml:?}");
            let frame = scenario.load(0, 0, &LoadOptions::default()).unwrap();
            assert_eq!(
                frame.points.xyzi,
                [[1.0, -2.0, 3.0, 0.5]],
                "the files of the family are left-handed"
            );
            assert!(frame.objects.is_empty() && frame.world_from_lidar.is_none());
            assert_eq!(frame.speed_mps, yaml.map(|_| 10.0));
        }
        let (_dir, scenario) = scenario(Some("lidar_pose: [1, 2, 3, 0, 0, 0]\n"));
        assert!(scenario.has_poses(0, 0));
    }
}
