//! ROS 2 types: names, definitions as recordings store them, and type hashes.

use super::definitions::{Definition, contained, definition};
use super::type_hash::{Distribution, type_hash};

/// Rows `Variant = "package/Name"`.
macro_rules! ros_types {
    ($($variant:ident = $name:literal,)+) => {
        /// A ROS 2 type that this program writes or reads.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum RosType {
            $(#[doc = concat!("`", $name, "`.")] $variant,)+
        }

        impl RosType {
            /// Every type.
            pub const ALL: [Self; [$($name),+].len()] = [$(Self::$variant),+];

            fn definition(self) -> Definition {
                let name = match self {
                    $(Self::$variant => $name,)+
                };
                definition(name).unwrap_or_default()
            }
        }
    };
}

ros_types! {
    CameraInfo = "sensor_msgs/CameraInfo",
    Clock = "rosgraph_msgs/Clock",
    CompressedImage = "sensor_msgs/CompressedImage",
    Detection3dArray = "vision_msgs/Detection3DArray",
    DiagnosticArray = "diagnostic_msgs/DiagnosticArray",
    Imu = "sensor_msgs/Imu",
    MarkerArray = "visualization_msgs/MarkerArray",
    Odometry = "nav_msgs/Odometry",
    PointCloud2 = "sensor_msgs/PointCloud2",
    PoseWithCovarianceStamped = "geometry_msgs/PoseWithCovarianceStamped",
    TfMessage = "tf2_msgs/TFMessage",
    TwistStamped = "geometry_msgs/TwistStamped",
}

impl RosType {
    /// Name in ROS 2: `sensor_msgs/msg/PointCloud2`.
    pub fn name(self) -> String {
        let (package, name) = self.parts();
        format!("{package}/msg/{name}")
    }

    /// Name on the wire: `sensor_msgs::msg::dds_::PointCloud2_`.
    pub fn dds_name(self) -> String {
        let (package, name) = self.parts();
        format!("{package}::msg::dds_::{name}_")
    }

    /// Type hash as distributions write it in keys: `RIHS01_...`.
    pub fn hash(self, distribution: Distribution) -> String {
        match distribution {
            Distribution::Humble => "TypeHashNotSupported".into(),
            Distribution::Jazzy => {
                let own = self.definition();
                type_hash(own, contained(own))
            }
        }
    }

    /// Definition with those of all contained types, for schemas of encoding `ros2msg`: the fields of the type, then
    /// those of the others, each after a line of 80 `=` and a line `MSG: package/Type`.
    pub fn schema(self) -> String {
        let (_, own) = self.definition();
        let separator = "=".repeat(80);
        let contained = contained(self.definition()).into_iter();
        contained.fold(own.to_owned(), |text, (name, fields)| {
            text + &format!("{separator}\nMSG: {name}\n{fields}")
        })
    }

    /// Package and name.
    fn parts(self) -> (&'static str, &'static str) {
        let (name, _) = self.definition();
        name.split_once('/').unwrap_or(("", name))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_schema_brings_all_types_it_names() {
        for ros_type in RosType::ALL {
            let text = ros_type.schema();
            for word in text
                .lines()
                .filter(|line| !line.starts_with("MSG:"))
                .filter_map(|line| line.split(' ').next())
            {
                let word = word.split('[').next().unwrap();
                if word.contains('/') {
                    assert!(
                        text.contains(&format!("MSG: {word}\n")),
                        "{} lacks {word}",
                        ros_type.name()
                    );
                }
            }
        }
    }

    #[test]
    fn names_are_those_of_ros_and_of_the_wire() {
        assert_eq!(RosType::PointCloud2.name(), "sensor_msgs/msg/PointCloud2");
        assert_eq!(
            RosType::PointCloud2.dds_name(),
            "sensor_msgs::msg::dds_::PointCloud2_"
        );
        assert_eq!(
            RosType::TfMessage.dds_name(),
            "tf2_msgs::msg::dds_::TFMessage_"
        );
    }

    /// Hashes of the Jazzy packages, as the packages and public tools print them.
    #[test]
    fn hashes_are_those_of_the_distributions() {
        let known = [
            (
                RosType::CameraInfo,
                "b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275",
            ),
            (
                RosType::Clock,
                "692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564",
            ),
            (
                RosType::CompressedImage,
                "15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
            ),
            (
                RosType::Detection3dArray,
                "793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018",
            ),
            (
                RosType::DiagnosticArray,
                "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
            ),
            (
                RosType::Imu,
                "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
            ),
            (
                RosType::MarkerArray,
                "86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf",
            ),
            (
                RosType::Odometry,
                "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
            ),
            (
                RosType::PointCloud2,
                "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
            ),
            (
                RosType::PoseWithCovarianceStamped,
                "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
            ),
            (
                RosType::TfMessage,
                "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
            ),
            (
                RosType::TwistStamped,
                "5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
            ),
        ];
        assert_eq!(known.map(|(ros_type, _)| ros_type), RosType::ALL);
        for (ros_type, hash) in known {
            assert_eq!(
                ros_type.hash(Distribution::Jazzy),
                format!("RIHS01_{hash}"),
                "{}",
                ros_type.name()
            );
            assert_eq!(ros_type.hash(Distribution::Humble), "TypeHashNotSupported");
        }
    }
}
