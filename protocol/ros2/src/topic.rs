//! Topics of ROS 2 on which this program publishes.

use std::borrow::Cow;

use protocol::CavId;

use super::names::{RosName, vehicle};
use super::qos::Qos;
use super::ros_type::RosType::{self, PoseWithCovarianceStamped};

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
    /// Tracks of an ego.
    Tracks,
    /// The same, for viewers.
    TrackMarkers,
}

impl VehicleTopic {
    /// Its name below the vehicle's, the type of its messages, and its quality of service.
    fn row(self) -> (Cow<'static, str>, RosType, Qos) {
        match self {
            Self::Pose => ("pose".into(), PoseWithCovarianceStamped, Qos::DEFAULT),
            Self::Odometry => ("odometry".into(), RosType::Odometry, Qos::DEFAULT),
            Self::Points => ("points".into(), RosType::PointCloud2, Qos::SENSOR_DATA),
            Self::Image(number) => {
                let name = format!("camera_{number}/image/compressed");
                (name.into(), RosType::CompressedImage, Qos::SENSOR_DATA)
            }
            Self::CameraInfo(number) => {
                let name = format!("camera_{number}/camera_info");
                (name.into(), RosType::CameraInfo, Qos::SENSOR_DATA)
            }
            Self::Detections => ("detections".into(), RosType::Detection3dArray, Qos::DEFAULT),
            Self::Markers => ("markers".into(), RosType::MarkerArray, Qos::DEFAULT),
            Self::Tracks => ("tracks".into(), RosType::Detection3dArray, Qos::DEFAULT),
            Self::TrackMarkers => ("track_markers".into(), RosType::MarkerArray, Qos::DEFAULT),
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
    /// Its name, for a vehicle's topic below the namespace, the type of its messages, and its quality of service.
    fn row(&self) -> (Cow<'static, str>, RosType, Qos) {
        let (name, ros_type, qos) = match self {
            Self::Vehicle(cav, topic) => {
                let (name, ros_type, qos) = topic.row();
                return (format!("/{}/{name}", vehicle(cav)).into(), ros_type, qos);
            }
            Self::Tf => ("/tf", RosType::TfMessage, Qos::TF),
            Self::TfStatic => ("/tf_static", RosType::TfMessage, Qos::TF_STATIC),
            Self::Clock => ("/clock", RosType::Clock, Qos::CLOCK),
            Self::Diagnostics => ("/diagnostics", RosType::DiagnosticArray, Qos::DEFAULT),
            Self::InitialPose => ("/initialpose", PoseWithCovarianceStamped, Qos::DEFAULT),
            Self::Truth => ("/truth", RosType::MarkerArray, Qos::DEFAULT),
        };
        (name.into(), ros_type, qos)
    }

    /// Its name below `namespace`; topics that a ROS network has once are never in a namespace.
    pub fn name(&self, namespace: Option<&RosName>) -> RosName {
        let namespace = match self {
            Self::Vehicle(..) => namespace.map_or("", RosName::as_str),
            _ => "",
        };
        RosName::known(&format!("{namespace}{}", self.row().0))
    }

    /// Type of its messages.
    pub fn ros_type(&self) -> RosType {
        self.row().1
    }

    /// Quality of service that ROS users expect on it.
    pub fn qos(&self) -> Qos {
        self.row().2
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_in_the_namespace_but_for_those_of_the_network() {
        let (cav, fleet) = (
            CavId::new("1000").unwrap(),
            "/fleet".parse::<RosName>().unwrap(),
        );
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
            assert_eq!(name.as_str().parse::<RosName>().unwrap(), name);
        }
    }
}
