//! Topics of ROS 2 on which this program publishes.

use std::borrow::Cow;

use protocol::CavId;

use super::names::{RosName, vehicle};
use super::qos::Qos;
use super::ros_type::RosType;

/// A topic of one vehicle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum VehicleTopic {
    /// Estimated pose.
    Pose,
    /// Estimated pose with measured speed and yaw rate.
    Odometry,
    /// LiDAR sweeps.
    Points,
    /// Encoded images of a camera.
    Image(u8),
    /// Projection of a camera.
    CameraInfo(u8),
    /// Detections of an ego.
    Detections,
    /// The same, for viewers.
    Markers,
}

impl VehicleTopic {
    /// Its name below the vehicle's.
    fn name(self) -> Cow<'static, str> {
        match self {
            Self::Pose => "pose".into(),
            Self::Odometry => "odometry".into(),
            Self::Points => "points".into(),
            Self::Image(number) => format!("camera_{number}/image/compressed").into(),
            Self::CameraInfo(number) => format!("camera_{number}/camera_info").into(),
            Self::Detections => "detections".into(),
            Self::Markers => "markers".into(),
        }
    }
}

/// A topic of ROS 2.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum RosTopic {
    /// `/cav_<id>/...`.
    Vehicle(CavId, VehicleTopic),
    /// `/tf`.
    Tf,
    /// `/tf_static`.
    TfStatic,
    /// `/clock`.
    Clock,
    /// `/diagnostics`.
    Diagnostics,
    /// `/initialpose`.
    InitialPose,
    /// `/truth`.
    Truth,
}

impl RosTopic {
    /// Its name below `namespace`; topics that a ROS network has once are never in a namespace.
    #[must_use]
    pub fn name(&self, namespace: Option<&RosName>) -> RosName {
        RosName::known(match self {
            Self::Vehicle(cav, topic) => {
                let namespace = namespace.map_or("", RosName::as_str);
                return RosName::known(&format!("{namespace}/{}/{}", vehicle(cav), topic.name()));
            }
            Self::Tf => "/tf",
            Self::TfStatic => "/tf_static",
            Self::Clock => "/clock",
            Self::Diagnostics => "/diagnostics",
            Self::InitialPose => "/initialpose",
            Self::Truth => "/truth",
        })
    }

    /// Type of its messages.
    #[must_use]
    pub fn ros_type(&self) -> RosType {
        match self {
            Self::Vehicle(_, VehicleTopic::Pose) | Self::InitialPose => {
                RosType::PoseWithCovarianceStamped
            }
            Self::Vehicle(_, VehicleTopic::Odometry) => RosType::Odometry,
            Self::Vehicle(_, VehicleTopic::Points) => RosType::PointCloud2,
            Self::Vehicle(_, VehicleTopic::Image(_)) => RosType::CompressedImage,
            Self::Vehicle(_, VehicleTopic::CameraInfo(_)) => RosType::CameraInfo,
            Self::Vehicle(_, VehicleTopic::Detections) => RosType::Detection3dArray,
            Self::Vehicle(_, VehicleTopic::Markers) | Self::Truth => RosType::MarkerArray,
            Self::Tf | Self::TfStatic => RosType::TfMessage,
            Self::Clock => RosType::Clock,
            Self::Diagnostics => RosType::DiagnosticArray,
        }
    }

    /// Quality of service that ROS users expect on it.
    #[must_use]
    pub fn qos(&self) -> Qos {
        match self {
            Self::Vehicle(
                _,
                VehicleTopic::Points | VehicleTopic::Image(_) | VehicleTopic::CameraInfo(_),
            ) => Qos::SENSOR_DATA,
            Self::Tf => Qos::TF,
            Self::TfStatic => Qos::TF_STATIC,
            Self::Clock => Qos::CLOCK,
            Self::Vehicle(..) | Self::Diagnostics | Self::InitialPose | Self::Truth => Qos::DEFAULT,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_in_the_namespace_but_for_those_of_the_network() {
        let (cav, fleet) = (CavId::new("1000").unwrap(), RosName::new("/fleet").unwrap());
        let points = RosTopic::Vehicle(cav, VehicleTopic::Points);
        assert_eq!(points.name(None).as_str(), "/cav_1000/points");
        assert_eq!(points.name(Some(&fleet)).as_str(), "/fleet/cav_1000/points");
        for topic in [
            RosTopic::Tf,
            RosTopic::TfStatic,
            RosTopic::Clock,
            RosTopic::Diagnostics,
            RosTopic::Truth,
        ] {
            let name = topic.name(Some(&fleet));
            assert_eq!(name, topic.name(None));
            assert_eq!(RosName::new(name.as_str()).unwrap(), name);
        }
    }
}
