//! ROS 2 message definitions, with fields and constants but without comments and default values.

/// A type: `package/Name` and its own fields.
pub(crate) type Definition = (&'static str, &'static str);

pub(crate) const TIME: Definition = ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n");
pub(crate) const DURATION: Definition =
    ("builtin_interfaces/Duration", "int32 sec\nuint32 nanosec\n");
pub(crate) const HEADER: Definition = (
    "std_msgs/Header",
    "builtin_interfaces/Time stamp\nstring frame_id\n",
);
pub(crate) const COLOR: Definition = (
    "std_msgs/ColorRGBA",
    "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n",
);

pub(crate) const POINT: Definition = ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z\n");
pub(crate) const VECTOR: Definition =
    ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n");
pub(crate) const QUATERNION: Definition = (
    "geometry_msgs/Quaternion",
    "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
);
pub(crate) const POSE: Definition = (
    "geometry_msgs/Pose",
    "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
);
pub(crate) const POSE_WITH_COVARIANCE: Definition = (
    "geometry_msgs/PoseWithCovariance",
    "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
);
pub(crate) const POSE_WITH_COVARIANCE_STAMPED: Definition = (
    "geometry_msgs/PoseWithCovarianceStamped",
    "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n",
);
pub(crate) const TWIST: Definition = (
    "geometry_msgs/Twist",
    "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
);
pub(crate) const TWIST_STAMPED: Definition = (
    "geometry_msgs/TwistStamped",
    "std_msgs/Header header\ngeometry_msgs/Twist twist\n",
);
pub(crate) const TWIST_WITH_COVARIANCE: Definition = (
    "geometry_msgs/TwistWithCovariance",
    "geometry_msgs/Twist twist\nfloat64[36] covariance\n",
);
pub(crate) const TRANSFORM: Definition = (
    "geometry_msgs/Transform",
    "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
);
pub(crate) const TRANSFORM_STAMPED: Definition = (
    "geometry_msgs/TransformStamped",
    "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n",
);
pub(crate) const TF_MESSAGE: Definition = (
    "tf2_msgs/TFMessage",
    "geometry_msgs/TransformStamped[] transforms\n",
);
pub(crate) const ODOMETRY: Definition = (
    "nav_msgs/Odometry",
    "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n\
     geometry_msgs/TwistWithCovariance twist\n",
);
pub(crate) const IMU: Definition = (
    "sensor_msgs/Imu",
    "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n\
     geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n\
     geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n",
);
pub(crate) const CLOCK: Definition = ("rosgraph_msgs/Clock", "builtin_interfaces/Time clock\n");

pub(crate) const POINT_FIELD: Definition = (
    "sensor_msgs/PointField",
    "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8 UINT32=6\nuint8 FLOAT32=7\n\
     uint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n",
);
pub(crate) const POINT_CLOUD_2: Definition = (
    "sensor_msgs/PointCloud2",
    "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\nbool is_bigendian\n\
     uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n",
);
pub(crate) const COMPRESSED_IMAGE: Definition = (
    "sensor_msgs/CompressedImage",
    "std_msgs/Header header\nstring format\nuint8[] data\n",
);

pub(crate) const REGION_OF_INTEREST: Definition = (
    "sensor_msgs/RegionOfInterest",
    "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n",
);
pub(crate) const CAMERA_INFO: Definition = (
    "sensor_msgs/CameraInfo",
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n\
     float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n",
);

pub(crate) const UV_COORDINATE: Definition =
    ("visualization_msgs/UVCoordinate", "float32 u\nfloat32 v\n");
pub(crate) const MESH_FILE: Definition = (
    "visualization_msgs/MeshFile",
    "string filename\nuint8[] data\n",
);
pub(crate) const MARKER: Definition = (
    "visualization_msgs/Marker",
    "int32 ARROW=0\nint32 CUBE=1\nint32 ADD=0\nint32 MODIFY=0\nint32 DELETE=2\nint32 DELETEALL=3\n\
     std_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\ngeometry_msgs/Pose pose\n\
     geometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\nbuiltin_interfaces/Duration lifetime\nbool frame_locked\n\
     geometry_msgs/Point[] points\nstd_msgs/ColorRGBA[] colors\nstring texture_resource\n\
     sensor_msgs/CompressedImage texture\nvisualization_msgs/UVCoordinate[] uv_coordinates\nstring text\n\
     string mesh_resource\nvisualization_msgs/MeshFile mesh_file\nbool mesh_use_embedded_materials\n",
);
pub(crate) const MARKER_ARRAY: Definition = (
    "visualization_msgs/MarkerArray",
    "visualization_msgs/Marker[] markers\n",
);

pub(crate) const HYPOTHESIS: Definition = (
    "vision_msgs/ObjectHypothesis",
    "string class_id\nfloat64 score\n",
);
pub(crate) const HYPOTHESIS_WITH_POSE: Definition = (
    "vision_msgs/ObjectHypothesisWithPose",
    "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
);
pub(crate) const BOUNDING_BOX_3D: Definition = (
    "vision_msgs/BoundingBox3D",
    "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
);
pub(crate) const DETECTION_3D: Definition = (
    "vision_msgs/Detection3D",
    "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox3D bbox\n\
     string id\n",
);
pub(crate) const DETECTION_3D_ARRAY: Definition = (
    "vision_msgs/Detection3DArray",
    "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
);

pub(crate) const KEY_VALUE: Definition = ("diagnostic_msgs/KeyValue", "string key\nstring value\n");
pub(crate) const DIAGNOSTIC_STATUS: Definition = (
    "diagnostic_msgs/DiagnosticStatus",
    "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\nbyte level\nstring name\nstring message\n\
     string hardware_id\ndiagnostic_msgs/KeyValue[] values\n",
);
pub(crate) const DIAGNOSTIC_ARRAY: Definition = (
    "diagnostic_msgs/DiagnosticArray",
    "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n",
);
