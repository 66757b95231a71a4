#!/usr/bin/env python3
"""Writes a drive as a bag of ROS 2, as a robot with an Ouster LiDAR records it.

    pip install rosbags numpy
    write_bag.py DRIVE BAG [mcap|sqlite3] [none|file|message]

DRIVE has clouds/SECONDS.bin (float32 x y z intensity, in the frame of the LiDAR) and poses.txt (a line per cloud: SECONDS x
y z qx qy qz qw of the LiDAR in the map). BAG is written:

    /ouster/points   sensor_msgs/PointCloud2 in os_sensor: the driver's fields, 48 bytes to a point
    /odom            nav_msgs/Odometry of base_link in odom, which drifts, at 20 Hz
    /tf              map to odom and odom to base_link, at 20 Hz
    /tf_static       base_link to os_sensor, and from there to os_lidar and os_imu
    /imu             sensor_msgs/Imu, of no use here

Exit code 2: the packages are not there.
"""

import pathlib
import sys

try:
    import numpy
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore
except ImportError as error:
    print(f"skipped: {error}: pip install rosbags numpy", file=sys.stderr)
    sys.exit(2)

NANOS = 1_000_000_000
# Poses begin before the first sweep and end after the last, and no stamp of one is that of a sweep.
ODOMETRY_STEP = NANOS // 20
ODOMETRY_OFFSET = 13_000_000
# Position of the LiDAR on the body, and the driver's own frames on the LiDAR: x, y, z, yaw.
MOUNT = (1.2, 0.1, 1.9, 0.0)
LIDAR = (0.0, 0.0, 0.036, numpy.pi)
IMU = (0.006, -0.012, 0.008, 0.0)
# Fields of ouster-ros: name, type of numpy, offset, datatype of sensor_msgs/PointField.
FIELDS = [
    ("x", "<f4", 0, 7), ("y", "<f4", 4, 7), ("z", "<f4", 8, 7), ("intensity", "<f4", 16, 7), ("t", "<u4", 20, 6),
    ("reflectivity", "<u2", 24, 4), ("ring", "<u2", 26, 4), ("ambient", "<u2", 28, 4), ("range", "<u4", 32, 6),
]
POINT_STEP = 48

store = get_typestore(Stores.ROS2_HUMBLE)


def type_of(name):
    return store.types[name]


def time_of(nanos):
    return type_of("builtin_interfaces/msg/Time")(sec=int(nanos // NANOS), nanosec=int(nanos % NANOS))


def header(nanos, frame):
    return type_of("std_msgs/msg/Header")(stamp=time_of(nanos), frame_id=frame)


def rotation(quaternion):
    """Matrix of a quaternion x, y, z, w."""
    x, y, z, w = quaternion
    return numpy.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])


def product(one, other):
    """Product of two quaternions x, y, z, w."""
    (x, y, z, w), (a, b, c, d) = one, other
    return numpy.array([
        w * a + x * d + y * c - z * b, w * b - x * c + y * d + z * a, w * c + x * b - y * a + z * d,
        w * d - x * a - y * b - z * c,
    ])


class Pose:
    """target_from_source: position and quaternion x, y, z, w."""

    def __init__(self, position, quaternion):
        self.position = numpy.asarray(position, float)
        self.quaternion = numpy.asarray(quaternion, float)

    @classmethod
    def of_yaw(cls, x, y, z, yaw):
        return cls([x, y, z], [0, 0, numpy.sin(yaw / 2), numpy.cos(yaw / 2)])

    def __matmul__(self, other):
        position = self.position + rotation(self.quaternion) @ other.position
        return Pose(position, product(self.quaternion, other.quaternion))

    def inverse(self):
        quaternion = self.quaternion * [-1, -1, -1, 1]
        return Pose(-rotation(quaternion) @ self.position, quaternion)

    def between(self, other, share):
        """Linear in position; quaternions of neighbouring poses differ little, so their line is as good as the arc."""
        same = other.quaternion * (1 if self.quaternion @ other.quaternion >= 0 else -1)
        quaternion = (1 - share) * self.quaternion + share * same
        position = (1 - share) * self.position + share * other.position
        return Pose(position, quaternion / numpy.linalg.norm(quaternion))

    def message(self):
        x, y, z, w = map(float, self.quaternion)
        point = dict(zip("xyz", map(float, self.position)))
        quaternion = type_of("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w)
        return point, quaternion


def transform(nanos, parent, child, pose):
    point, quaternion = pose.message()
    value = type_of("geometry_msgs/msg/Transform")(
        translation=type_of("geometry_msgs/msg/Vector3")(**point), rotation=quaternion)
    return type_of("geometry_msgs/msg/TransformStamped")(
        header=header(nanos, parent), child_frame_id=child, transform=value)


def odometry(nanos, pose):
    point, quaternion = pose.message()
    zero = type_of("geometry_msgs/msg/Vector3")(x=0.0, y=0.0, z=0.0)
    value = type_of("geometry_msgs/msg/Pose")(
        position=type_of("geometry_msgs/msg/Point")(**point), orientation=quaternion)
    return type_of("nav_msgs/msg/Odometry")(
        header=header(nanos, "odom"), child_frame_id="base_link",
        pose=type_of("geometry_msgs/msg/PoseWithCovariance")(pose=value, covariance=numpy.zeros(36)),
        twist=type_of("geometry_msgs/msg/TwistWithCovariance")(
            twist=type_of("geometry_msgs/msg/Twist")(linear=zero, angular=zero), covariance=numpy.zeros(36)))


def imu(nanos):
    zero = type_of("geometry_msgs/msg/Vector3")(x=0.0, y=0.0, z=0.0)
    level = type_of("geometry_msgs/msg/Quaternion")(x=0.0, y=0.0, z=0.0, w=1.0)
    return type_of("sensor_msgs/msg/Imu")(
        header=header(nanos, "os_imu"), orientation=level, orientation_covariance=numpy.zeros(9),
        angular_velocity=zero, angular_velocity_covariance=numpy.zeros(9), linear_acceleration=zero,
        linear_acceleration_covariance=numpy.zeros(9))


def cloud(nanos, points):
    names, types, offsets, _ = zip(*FIELDS)
    layout = numpy.dtype({"names": names, "formats": types, "offsets": offsets, "itemsize": POINT_STEP})
    data = numpy.zeros(len(points), layout)
    for column, name in enumerate(("x", "y", "z")):
        data[name] = points[:, column]
    # The driver publishes the photons of the return.
    data["intensity"] = numpy.round(points[:, 3] * 1000)
    data["range"] = numpy.round(1000 * numpy.linalg.norm(points[:, :3], axis=1))
    fields = [type_of("sensor_msgs/msg/PointField")(name=name, offset=offset, datatype=datatype, count=1)
              for name, _, offset, datatype in FIELDS]
    return type_of("sensor_msgs/msg/PointCloud2")(
        header=header(nanos, "os_sensor"), height=1, width=len(points), fields=fields, is_bigendian=False,
        point_step=POINT_STEP, row_step=POINT_STEP * len(points), data=data.view(numpy.uint8).reshape(-1), is_dense=True)


def read_drive(folder):
    """Stamps, poses of the LiDAR and files, in order."""
    rows = []
    for line in (folder / "poses.txt").read_text().splitlines():
        seconds, *numbers = line.split()
        whole, _, fraction = seconds.partition(".")
        nanos = int(whole) * NANOS + int(fraction.ljust(9, "0"))
        values = list(map(float, numbers))
        rows.append((nanos, Pose(values[:3], values[3:]), folder / "clouds" / f"{seconds}.bin"))
    return sorted(rows, key=lambda row: row[0])


def pose_at(rows, nanos):
    """The pose at a time; beyond the ends as at constant velocity."""
    index = numpy.clip(numpy.searchsorted([row[0] for row in rows], nanos), 1, len(rows) - 1)
    (begin, one, _), (end, other, _) = rows[index - 1], rows[index]
    return one.between(other, (nanos - begin) / (end - begin))


def messages(rows):
    """Time of recording, topic, type and message, unordered."""
    mount = Pose.of_yaw(*MOUNT)
    first, last = rows[0][0], rows[-1][0]
    tf = type_of("tf2_msgs/msg/TFMessage")
    fixed = [("base_link", "os_sensor", mount), ("os_sensor", "os_lidar", Pose.of_yaw(*LIDAR)),
             ("os_sensor", "os_imu", Pose.of_yaw(*IMU))]
    yield first - NANOS, "/tf_static", "tf2_msgs/msg/TFMessage", tf(
        transforms=[transform(first - NANOS, *frames) for frames in fixed])
    for nanos in range(first - 3 * ODOMETRY_STEP + ODOMETRY_OFFSET, last + 3 * ODOMETRY_STEP, ODOMETRY_STEP):
        map_from_base = pose_at(rows, nanos) @ mount.inverse()
        seconds = (nanos - first) / NANOS
        map_from_odom = Pose.of_yaw(30 + 0.02 * seconds, -5 - 0.01 * seconds, 0, 0.5 + 0.001 * seconds)
        odom_from_base = map_from_odom.inverse() @ map_from_base
        yield nanos, "/odom", "nav_msgs/msg/Odometry", odometry(nanos, odom_from_base)
        yield nanos, "/tf", "tf2_msgs/msg/TFMessage", tf(transforms=[
            transform(nanos, "odom", "base_link", odom_from_base), transform(nanos, "map", "odom", map_from_odom)])
        yield nanos, "/imu", "sensor_msgs/msg/Imu", imu(nanos)
    for nanos, _, path in rows:
        points = numpy.fromfile(path, "<f4").reshape(-1, 4)
        # A driver publishes a sweep at its end.
        yield nanos + NANOS // 10, "/ouster/points", "sensor_msgs/msg/PointCloud2", cloud(nanos, points)


def main():
    drive, bag, *options = sys.argv[1:]
    storage, compression = (options + ["mcap", "none"][len(options):])[:2]
    plugin = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}[storage]
    writer = Writer(pathlib.Path(bag), version=9, storage_plugin=plugin)
    writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for recorded, topic, name, message in sorted(messages(read_drive(pathlib.Path(drive))), key=lambda row: row[0]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            writer.write(connections[topic], recorded, store.serialize_cdr(message, name))


if __name__ == "__main__":
    main()
