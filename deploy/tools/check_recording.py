#!/usr/bin/env python3
"""Reads a recording with the public MCAP reader and a ROS 2 decoder, and prints what they find as JSON.

    pip install mcap mcap-ros2-support
    check_recording.py recording.mcap

Exit code 0: everything decodes. 1: something does not. 2: the packages are not installed.
"""

import hashlib
import json
import struct
import sys

try:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory
except ImportError as error:
    print(f"{error}: pip install mcap mcap-ros2-support", file=sys.stderr)
    sys.exit(2)


def seconds(stamp):
    return stamp.sec + stamp.nanosec * 1e-9


def xyz(vector):
    return [vector.x, vector.y, vector.z]


def quaternion(rotation):
    return [rotation.w, rotation.x, rotation.y, rotation.z]


def cloud(message):
    names = [field.name for field in message.fields]
    assert names == ["x", "y", "z", "intensity"] and message.point_step == 16, names
    assert len(message.data) == message.width * message.point_step == message.row_step
    values = [v[0] for v in struct.iter_unpack("<f", bytes(message.data))]
    columns = [sum(values[column::4]) for column in range(4)]
    return {"stamp_s": seconds(message.header.stamp), "frame": message.header.frame_id, "points": message.width,
            "sums": columns, "last": values[-4:]}


def pose(message):
    pose = message.pose.pose
    return {"stamp_s": seconds(message.header.stamp), "frame": message.header.frame_id, "position": xyz(pose.position),
            "wxyz": quaternion(pose.orientation), "covariance": list(message.pose.covariance)}


def odometry(message):
    return pose(message) | {"child": message.child_frame_id, "speed_mps": message.twist.twist.linear.x,
                            "yaw_rate_rad_s": message.twist.twist.angular.z}


def detections(message):
    return [{"frame": d.header.frame_id, "class": d.results[0].hypothesis.class_id, "score": d.results[0].hypothesis.score,
             "position": xyz(d.bbox.center.position), "wxyz": quaternion(d.bbox.center.orientation),
             "size": xyz(d.bbox.size)} for d in message.detections]


def diagnostics(message):
    return [{"name": s.name, "message": s.message, "values": {v.key: v.value for v in s.values}} for s in message.status]


def transforms(message):
    return [{"frame": t.header.frame_id, "child": t.child_frame_id, "position": xyz(t.transform.translation),
             "wxyz": quaternion(t.transform.rotation)} for t in message.transforms]


def markers(message):
    shown = [m for m in message.markers if m.action == 0]
    return [{"frame": m.header.frame_id, "id": m.id, "ns": m.ns, "position": xyz(m.pose.position),
             "wxyz": quaternion(m.pose.orientation), "size": xyz(m.scale), "text": m.text} for m in shown]


def camera_info(message):
    return {"stamp_s": seconds(message.header.stamp), "frame": message.header.frame_id, "width": message.width,
            "height": message.height, "intrinsics": list(message.k), "distortion": message.distortion_model}


def image(message):
    return {"stamp_s": seconds(message.header.stamp), "frame": message.header.frame_id, "format": message.format,
            "sha256": hashlib.sha256(bytes(message.data)).hexdigest()}


READERS = {"sensor_msgs/msg/PointCloud2": cloud, "geometry_msgs/msg/PoseWithCovarianceStamped": pose,
           "nav_msgs/msg/Odometry": odometry, "vision_msgs/msg/Detection3DArray": detections,
           "diagnostic_msgs/msg/DiagnosticArray": diagnostics, "tf2_msgs/msg/TFMessage": transforms,
           "visualization_msgs/msg/MarkerArray": markers, "sensor_msgs/msg/CameraInfo": camera_info,
           "sensor_msgs/msg/CompressedImage": image}


def main(path):
    found = {"messages": {}, "first": {}, "last": {}}
    with open(path, "rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None and summary.statistics is not None, "there is no index"
        found["indexed"] = {"chunks": len(summary.chunk_indexes), "messages": summary.statistics.message_count}
        for channel in summary.channels.values():
            found["messages"][channel.topic] = summary.statistics.channel_message_counts.get(channel.id, 0)
        counted = {}
        file.seek(0)
        reader = make_reader(file, validate_crcs=True)
        for _, channel, _ in reader.iter_messages(log_time_order=True):
            counted[channel.topic] = counted.get(channel.topic, 0) + 1
        assert counted == {topic: n for topic, n in found["messages"].items() if n}, (counted, found["messages"])
        ros = [channel.topic for channel in summary.channels.values() if channel.message_encoding == "cdr"]
        file.seek(0)
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, _, message in reader.iter_decoded_messages(topics=ros):
            read = READERS[schema.name](message)
            found["first"].setdefault(channel.topic, read)
            found["last"][channel.topic] = read
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main(sys.argv[1])
