//! LiDARs of an agent: the agent of a channel, and the orientation of its axes.

use std::f64::consts::FRAC_PI_2;

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use protocol::PointCloud;

use crate::Layout;

/// The agent of data sets with one vehicle.
const ONLY_AGENT: &str = "0";

/// The layout with this naming of channels, and the name of the agent; nothing for LiDARs that are not read.
pub(super) fn agent_of(channel: &str) -> Option<(Layout, &str)> {
    if let Some(agent) = channel.strip_prefix("LIDAR_TOP_id_") {
        return Some((Layout::V2XSIM, agent));
    }
    if let Some(vehicle) = channel.strip_prefix("LIDAR_FRONT_CENTER") {
        let agent = vehicle.strip_prefix('_').unwrap_or(ONLY_AGENT);
        return Some((Layout::MARS, agent));
    }
    // Data sets of T4 (Autoware) have one cloud of all LiDARs of the vehicle.
    let is_single = ["LIDAR_TOP", "LIDAR_CONCAT"].contains(&channel);
    is_single.then_some((Layout::NUSCENES, ONLY_AGENT))
}

/// True for roadside units: number 0 of V2X-Sim, and negative numbers as in other layouts.
pub(super) fn is_roadside_unit(layout: Layout, agent: &str) -> bool {
    (layout == Layout::V2XSIM && agent == "0") || agent.starts_with('-')
}

/// Quarter turns, counter-clockwise, that bring the axes of a LiDAR to x forward: nuScenes mounts its own with y
/// forward. The remaining rotation of the mount stays in the pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct QuarterTurns(u8);

impl QuarterTurns {
    /// The turns that bring x nearest to the vehicle's.
    #[expect(clippy::cast_possible_truncation, reason = "0 to 3 turns")]
    pub(super) fn to_forward(vehicle_from_lidar: &Isometry3<f64>) -> Self {
        let x = vehicle_from_lidar.rotation * Vector3::x();
        let turns = (x.y.atan2(x.x) / FRAC_PI_2).round() as i64;
        Self(turns.rem_euclid(4) as u8)
    }

    /// The transform from the turned frame to the LiDAR's own.
    pub(super) fn lidar_from_turned(self) -> Isometry3<f64> {
        // The inverse of the turns that `apply` gives the points.
        let angle = -f64::from(self.0) * FRAC_PI_2;
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle);
        Isometry3::from_parts(Default::default(), turn)
    }

    /// Transforms points from the LiDAR's own frame to the turned one, exactly.
    pub(super) fn apply(self, cloud: &mut PointCloud) {
        for [x, y, ..] in &mut cloud.xyzi {
            (*x, *y) = match self.0 {
                0 => (*x, *y),
                1 => (-*y, *x),
                2 => (-*x, -*y),
                _ => (*y, -*x),
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;
    use protocol::Pose;

    use super::*;

    #[test]
    fn channels_name_layout_and_agent() {
        assert_eq!(agent_of("LIDAR_TOP_id_3"), Some((Layout::V2XSIM, "3")));
        assert_eq!(
            agent_of("LIDAR_FRONT_CENTER_maisy"),
            Some((Layout::MARS, "maisy"))
        );
        assert_eq!(agent_of("LIDAR_FRONT_CENTER"), Some((Layout::MARS, "0")));
        assert_eq!(agent_of("LIDAR_TOP"), Some((Layout::NUSCENES, "0")));
        assert_eq!(agent_of("LIDAR_CONCAT"), Some((Layout::NUSCENES, "0")));
        assert_eq!(agent_of("LIDAR_FRONT_LEFT"), None);
    }

    #[test]
    fn turned_points_and_turned_pose_are_the_same_place_with_x_forward() {
        for degrees in [0.0, 3.0, 88.0, 92.0, 180.0, -179.0, -90.0, -47.0] {
            let vehicle_from_lidar =
                Pose::from_xyz_yaw([1.0, 0.0, 2.0], f64::to_radians(degrees)).isometry();
            let turns = QuarterTurns::to_forward(&vehicle_from_lidar);
            let vehicle_from_turned = vehicle_from_lidar * turns.lidar_from_turned();
            assert!(
                Pose::from(vehicle_from_turned).yaw_rad().abs() <= 45.0f64.to_radians(),
                "{degrees}"
            );
            let mut cloud = PointCloud {
                xyzi: vec![[10.0, 1.0, -1.0, 0.5]],
            };
            turns.apply(&mut cloud);
            let [x, y, z, _] = cloud.xyzi[0].map(f64::from);
            let before = vehicle_from_lidar * Point3::new(10.0, 1.0, -1.0);
            assert!(
                (vehicle_from_turned * Point3::new(x, y, z) - before).norm() < 1e-9,
                "{degrees}"
            );
        }
    }
}
