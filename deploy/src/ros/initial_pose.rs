//! Initial pose: the first fix of a vehicle on `/initialpose`, for a localizer that needs one.

use protocol::{CavId, Message, PlanarCovariance};
use ros2::Mount;

/// Variances where the pose has none of its own: those that RViz gives the poses that a person draws.
const DRAWN: PlanarCovariance = PlanarCovariance {
    xx_m2: 0.25,
    xy_m2: 0.0,
    yy_m2: 0.25,
    yaw_rad2: 0.068_538_92,
};

/// The initial pose of one vehicle, published once.
#[derive(Debug)]
pub(super) struct InitialPose {
    cav: CavId,
    mount: Mount,
    is_published: bool,
}

impl InitialPose {
    pub(super) fn of(cav: CavId, mount: Mount) -> Self {
        Self {
            cav,
            mount,
            is_published: false,
        }
    }

    /// The message to publish for a pose of `cav`, if it is the first that somebody is there to take. The pose is that of
    /// the vehicle's body.
    pub(super) fn of_message(
        &mut self,
        cav: &CavId,
        capture_nanos: u64,
        message: &Message,
        is_wanted: impl FnOnce() -> bool,
    ) -> Option<Vec<u8>> {
        let Message::Pose(estimate) = message else {
            return None;
        };
        let world_from_cav = estimate.world_from_cav()?;
        if self.is_published || *cav != self.cav || !is_wanted() {
            return None;
        }
        self.is_published = true;
        let lidar_from_base = self.mount.base_from_lidar.isometry().inverse();
        // The estimate is of the LiDAR: world_from_base = world_from_lidar * lidar_from_base.
        let world_from_base = (world_from_cav.isometry() * lidar_from_base).into();
        let covariance = Some(estimate.covariance().unwrap_or(&DRAWN));
        Some(ros2::pose(capture_nanos, &world_from_base, covariance))
    }
}

#[cfg(test)]
mod tests {
    use protocol::{NoPoseReason, Pose, PoseEstimate};

    use super::*;

    #[test]
    fn the_first_fix_that_somebody_takes_is_published_once() {
        let [own, other] = ["1", "2"].map(|id| CavId::new(id).unwrap());
        let mount = "0,0,2".parse().unwrap();
        let mut initial = InitialPose::of(own.clone(), mount);
        let none = Message::Pose(PoseEstimate::NoPose {
            reason: NoPoseReason::TooFewInliers,
            inlier_count: 0,
        });
        let pose = Message::Pose(PoseEstimate::new(
            Pose::from_xyz_yaw([1.0, 2.0, 5.0], 0.0),
            0.9,
        ));
        assert_eq!(initial.of_message(&own, 1, &none, || true), None);
        assert_eq!(initial.of_message(&other, 2, &pose, || true), None);
        assert_eq!(initial.of_message(&own, 3, &pose, || false), None);
        let body = Pose::from_xyz_yaw([1.0, 2.0, 3.0], 0.0);
        assert_eq!(
            initial.of_message(&own, 4, &pose, || true),
            Some(ros2::pose(4, &body, Some(&DRAWN)))
        );
        assert_eq!(initial.of_message(&own, 5, &pose, || true), None);
    }
}
