//! ROS 2 message definitions stored in recordings, so that a reader needs no ROS.
//!
//! A definition is the fields of the type, then those of every type it contains, as the MCAP format requires for
//! encoding `ros2msg`: separated by a line of 80 `=` and a line `MSG: package/Type`.

/// A type: its name and its own fields.
type Definition = (&'static str, &'static str);

const TIME: Definition = ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n");
const DURATION: Definition = ("builtin_interfaces/Duration", "int32 sec\nuint32 nanosec\n");
const HEADER: Definition = ("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id\n");
const COLOR: Definition = ("std_msgs/ColorRGBA", "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n");
const POINT: Definition = ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z\n");
const VECTOR: Definition = ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n");
const QUATERNION: Definition = ("geometry_msgs/Quaternion", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n");
const POSE: Definition = ("geometry_msgs/Pose", "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n");
const TRANSFORM: Definition =
    ("geometry_msgs/Transform", "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n");
const TRANSFORM_STAMPED: Definition = (
    "geometry_msgs/TransformStamped",
    "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n",
);
const POINT_FIELD: Definition = (
    "sensor_msgs/PointField",
    "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8 UINT32=6\nuint8 FLOAT32=7\n\
     uint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n",
);
const COMPRESSED_IMAGE: Definition =
    ("sensor_msgs/CompressedImage", "std_msgs/Header header\nstring format\nuint8[] data\n");
const UV_COORDINATE: Definition = ("visualization_msgs/UVCoordinate", "float32 u\nfloat32 v\n");
const MESH_FILE: Definition = ("visualization_msgs/MeshFile", "string filename\nuint8[] data\n");
const MARKER: Definition = (
    "visualization_msgs/Marker",
    "int32 ARROW=0\nint32 CUBE=1\nint32 ADD=0\nint32 MODIFY=0\nint32 DELETE=2\nint32 DELETEALL=3\n\
     std_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\ngeometry_msgs/Pose pose\n\
     geometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\nbuiltin_interfaces/Duration lifetime\nbool frame_locked\n\
     geometry_msgs/Point[] points\nstd_msgs/ColorRGBA[] colors\nstring texture_resource\n\
     sensor_msgs/CompressedImage texture\nvisualization_msgs/UVCoordinate[] uv_coordinates\nstring text\n\
     string mesh_resource\nvisualization_msgs/MeshFile mesh_file\nbool mesh_use_embedded_materials\n",
);

/// A ROS 2 type that recordings use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum RosType {
    /// `sensor_msgs/msg/PointCloud2`.
    PointCloud2,
    /// `geometry_msgs/msg/PoseStamped`.
    PoseStamped,
    /// `visualization_msgs/msg/MarkerArray`.
    MarkerArray,
    /// `tf2_msgs/msg/TFMessage`.
    TfMessage,
}

impl RosType {
    /// Its name in ROS 2.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::PointCloud2 => "sensor_msgs/msg/PointCloud2",
            Self::PoseStamped => "geometry_msgs/msg/PoseStamped",
            Self::MarkerArray => "visualization_msgs/msg/MarkerArray",
            Self::TfMessage => "tf2_msgs/msg/TFMessage",
        }
    }

    /// Its definition with those of all types it contains.
    pub(super) fn definition(self) -> String {
        let (own, parts): (&str, &[Definition]) = match self {
            Self::PointCloud2 => (
                "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n\
                 bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n",
                &[HEADER, TIME, POINT_FIELD],
            ),
            Self::PoseStamped => {
                ("std_msgs/Header header\ngeometry_msgs/Pose pose\n", &[HEADER, TIME, POSE, POINT, QUATERNION])
            }
            Self::MarkerArray => (
                "visualization_msgs/Marker[] markers\n",
                &[
                    MARKER,
                    HEADER,
                    TIME,
                    POSE,
                    POINT,
                    QUATERNION,
                    VECTOR,
                    COLOR,
                    DURATION,
                    COMPRESSED_IMAGE,
                    UV_COORDINATE,
                    MESH_FILE,
                ],
            ),
            Self::TfMessage => (
                "geometry_msgs/TransformStamped[] transforms\n",
                &[TRANSFORM_STAMPED, HEADER, TIME, TRANSFORM, VECTOR, QUATERNION],
            ),
        };
        let separator = "=".repeat(80);
        parts.iter().fold(own.to_owned(), |text, (name, fields)| text + &format!("{separator}\nMSG: {name}\n{fields}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_definition_brings_all_types_it_names() {
        for ros_type in [RosType::PointCloud2, RosType::PoseStamped, RosType::MarkerArray, RosType::TfMessage] {
            let text = ros_type.definition();
            for word in text.lines().filter(|line| !line.starts_with("MSG:")).filter_map(|line| line.split(' ').next())
            {
                let word = word.trim_end_matches("[]");
                if word.contains('/') {
                    assert!(text.contains(&format!("MSG: {word}\n")), "{} lacks {word}", ros_type.name());
                }
            }
        }
    }
}
