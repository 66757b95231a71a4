#!/usr/bin/env python3
"""Runs a vehicle beside `v2vloc ros2`, and checks both directions with other people's ROS 2 clients; prints JSON.

    pip install zenoh-ros2-sdk pamoja-ros2 rosbags
    check_ros2.py FOLDER_OF_PROGRAMS

From the run to ROS 2: node, topics, types, hashes and quality of service are listed; pose, odometry, transforms, clock,
detections, diagnoses and a cloud are compared with the messages of the run. From ROS 2 to the run: the same sweeps are
published as another driver's sensor_msgs/PointCloud2 for a second vehicle, whose agent has to give the same poses.

Needs the released weights (deploy/weights). Exit code 0: everything agrees. 1: something does not. 2: the packages or
programs are not there.
"""

import json
import math
import os
import pathlib
import socket
import subprocess
import sys
import tempfile
import time
import traceback

try:
    import numpy
    import zenoh
    from pamoja import ros2 as pamoja
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber, get_topic_info, get_topic_names_and_types
    from zenoh_ros2_sdk.qos import QosDurability, QosProfile, QosReliability
    from zenoh_ros2_sdk.session import ZenohSession
    from zenoh_ros2_sdk.utils import compute_type_hash_from_msg
except ImportError as error:
    print(f"skipped: {error}: pip install zenoh-ros2-sdk pamoja-ros2 rosbags", file=sys.stderr)
    sys.exit(2)

WEIGHTS = pathlib.Path(__file__).resolve().parent.parent / "weights"
FRAMES = 25
TIMEOUT_S = 120
DOMAIN = 5

# vision_msgs 4 (Humble to Rolling); it is no core package, so rosbags has no definition of it.
VISION = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose":
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D":
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox3D bbox\nstring id\n",
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
}
SEPARATOR = "=" * 80 + "\nMSG: "


class Types:
    """Definitions and hashes of ROS 2 Jazzy, as rosbags has and computes them."""

    def __init__(self):
        self.store = get_typestore(Stores.ROS2_JAZZY)
        for name, text in VISION.items():
            self.store.register(get_types_from_msg(text, name))

    def definition(self, name):
        return self.store.generate_msgdef(name, ros_version=2)[0]

    def hash(self, name):
        """By rosbags; and by the other client, from the same definition: both have to agree."""
        found = self.store.hash_rihs01(name)
        own, *parts = self.definition(name).split(SEPARATOR)
        parts = [part.split("\n", 1) for part in parts]
        contained = {part[0].replace("/", "/msg/"): part[1] for part in parts}
        again = compute_type_hash_from_msg(name, own.replace("=" * 80, ""), contained)
        assert again == found, f"{name}: {again} is not {found}"
        assert bytes(pamoja.type_hash_digest(found)).hex() == found.removeprefix("RIHS01_")
        return found


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def wait_for(what, condition, timeout_s=TIMEOUT_S):
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        found = condition()
        if found:
            return found
        time.sleep(0.02)
    raise AssertionError(f"{what}: not within {timeout_s} s")


def near(found, expected, tolerance, what):
    assert len(found) == len(expected), (what, found, expected)
    for one, other in zip(found, expected):
        assert abs(one - other) <= tolerance * max(1.0, abs(other)), f"{what}: {found} is not {list(expected)}"


class Programs:
    """Processes of the check, ended with it."""

    def __init__(self, folder, logs):
        self.folder, self.logs, self.running = pathlib.Path(folder), pathlib.Path(logs), {}

    def start(self, name, program, *arguments, **options):
        log = open(self.logs / f"{name}.log", "w")
        command = [str(self.folder / program), *map(str, arguments)]
        self.running[name] = subprocess.Popen(command, stderr=log, stdin=subprocess.DEVNULL, text=True, **options)

    def run(self, program, *arguments):
        subprocess.run([str(self.folder / program), *map(str, arguments)], check=True, stdout=subprocess.DEVNULL)

    def end(self, name):
        """Ends a process and returns what it has printed."""
        process = self.running.pop(name)
        process.terminate()
        output, _ = process.communicate(timeout=30)
        return process.returncode, output

    def end_all(self):
        for name in list(self.running):
            self.running.pop(name).kill()

    def log(self, name):
        return (self.logs / f"{name}.log").read_text()


class Client:
    """A ROS 2 client of the SDK, and a plain zenoh session that reads the run itself."""

    def __init__(self, types, port):
        self.types, self.port, self.subscribers, self.taken = types, port, [], {}
        self.sdk = ZenohSession.get_instance("127.0.0.1", port)
        for name in self.known():
            self.sdk.store.register(get_types_from_msg(self.types.definition(name), name))
            self.sdk._registered_types[name] = name

    @staticmethod
    def known():
        return ["sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/Odometry",
                "tf2_msgs/msg/TFMessage", "rosgraph_msgs/msg/Clock", "diagnostic_msgs/msg/DiagnosticArray",
                "vision_msgs/msg/Detection3DArray"]

    def subscribe(self, topic, name, qos=None):
        taken = self.taken.setdefault(topic, [])
        self.subscribers.append(ROS2Subscriber(
            topic, name, taken.append, msg_definition=self.types.definition(name), type_hash=self.types.hash(name),
            domain_id=DOMAIN, router_ip="127.0.0.1", router_port=self.port, qos=qos))

    def watch(self, key):
        taken = self.taken.setdefault(key, [])
        self.subscribers.append(self.sdk.session.declare_subscriber(
            key, lambda sample: taken.append(sample.payload.to_bytes())))
        return taken


def stamp_nanos(stamp):
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def xyz(vector):
    return [vector.x, vector.y, vector.z]


def wxyz(rotation):
    return [rotation.w, rotation.x, rotation.y, rotation.z]


def by_stamp(messages):
    return {stamp_nanos(message.header.stamp): message for message in messages}


def check_graph(types, port, cav):
    """Node, topics, types, hashes and quality of service, as `ros2 topic list` and `ros2 topic info -v` ask for them."""
    expected = {
        f"/cav_{cav}/points": ("sensor_msgs/msg/PointCloud2", "2::,5:,:,:,,"),
        f"/cav_{cav}/pose": ("geometry_msgs/msg/PoseWithCovarianceStamped", "::,10:,:,:,,"),
        f"/cav_{cav}/odometry": ("nav_msgs/msg/Odometry", "::,10:,:,:,,"),
        f"/cav_{cav}/detections": ("vision_msgs/msg/Detection3DArray", "::,10:,:,:,,"),
        f"/cav_{cav}/markers": ("visualization_msgs/msg/MarkerArray", "::,10:,:,:,,"),
        f"/cav_{cav}/tracks": ("vision_msgs/msg/Detection3DArray", "::,10:,:,:,,"),
        f"/cav_{cav}/track_markers": ("visualization_msgs/msg/MarkerArray", "::,10:,:,:,,"),
        "/tf": ("tf2_msgs/msg/TFMessage", "::,100:,:,:,,"),
        "/tf_static": ("tf2_msgs/msg/TFMessage", ":1:,1:,:,:,,"),
        "/clock": ("rosgraph_msgs/msg/Clock", "2::,1:,:,:,,"),
        "/diagnostics": ("diagnostic_msgs/msg/DiagnosticArray", "::,10:,:,:,,"),
    }
    where = {"domain_id": DOMAIN, "router_ip": "127.0.0.1", "router_port": port}
    wait_for("all topics", lambda: set(expected) <= {name for name, _ in get_topic_names_and_types(**where)})
    for topic, (name, qos) in expected.items():
        info = get_topic_info(topic, verbose=True, **where)
        ours = [publisher for publisher in info.publishers if publisher.node_name == "v2vloc"]
        assert info.topic_types == [name] and len(ours) == 1, (topic, info)
        assert ours[0].type_hash == types.hash(name), (topic, ours[0].type_hash)
        assert ours[0].qos == qos, (topic, ours[0].qos)
        key = pamoja.entity_key(DOMAIN, topic, name, ours[0].type_hash)
        assert key == f"{DOMAIN}{topic}/{pamoja.dds_type_name(name)}/{ours[0].type_hash}", key
        assert pamoja.is_valid_name(topic) and pamoja.is_fully_qualified(topic)
    nodes = [str(reply.ok.key_expr) for reply in ZenohSession.get_instance().liveliness.get(f"@ros2_lv/{DOMAIN}/**")]
    assert any("/NN/" in token and token.endswith("/v2vloc") for token in nodes), nodes
    return sorted(expected)


def check_results(client, cav, results):
    """Poses, odometry, transforms, boxes and times against the ego's own results, which are JSON on the run's bus."""
    reports = {report["capture_nanos"]: report for report in map(json.loads, results)}
    poses, odometry = by_stamp(client.taken[f"/cav_{cav}/pose"]), by_stamp(client.taken[f"/cav_{cav}/odometry"])
    arrays = by_stamp(client.taken[f"/cav_{cav}/detections"])
    compared, boxes, speeds = 0, 0, []
    for nanos, report in reports.items():
        pose = report["pose"].get("pose")
        if nanos not in poses or nanos not in arrays or pose is None:
            continue
        compared += 1
        message, place = poses[nanos], pose["world_from_cav"]
        assert message.header.frame_id == "map"
        near(xyz(message.pose.pose.position), place["translation_m"], 1e-9, "position")
        near(wxyz(message.pose.pose.orientation), place["rotation_wxyz"], 1e-9, "orientation")
        if pose["covariance"]:
            names = [("xx_m2", 0), ("xy_m2", 1), ("yy_m2", 7), ("yaw_rad2", 35)]
            for name, index in names:
                near([message.pose.covariance[index]], [pose["covariance"][name]], 1e-6, name)
        near(xyz(odometry[nanos].pose.pose.position), place["translation_m"], 1e-9, "odometry")
        assert odometry[nanos].child_frame_id == f"cav_{cav}/lidar"
        speeds.append(odometry[nanos].twist.twist.linear.x)
        array = arrays[nanos]
        assert array.header.frame_id == f"cav_{cav}/lidar" and len(array.detections) == len(report["detections"])
        for found, expected in zip(array.detections, report["detections"]):
            boxes += 1
            near(xyz(found.bbox.center.position), expected["box"]["center_m"], 1e-9, "centre")
            near(xyz(found.bbox.size), expected["box"]["size_m"], 1e-9, "size")
            half = expected["box"]["heading_rad"] / 2
            near(wxyz(found.bbox.center.orientation), [math.cos(half), 0, 0, math.sin(half)], 1e-9, "heading")
            near([found.results[0].hypothesis.score], [expected["score"]], 1e-6, "score")
    assert compared >= 5 and boxes > 0, f"{compared} results and {boxes} boxes were compared"
    children = {transform.child_frame_id for message in client.taken["/tf"] for transform in message.transforms}
    assert children == {f"cav_{cav}/lidar"}, children
    clock = [stamp_nanos(message.clock) for message in client.taken["/clock"]]
    assert clock == sorted(clock) and set(poses) <= set(clock), "a stamp that the clock has not shown"
    latched = [transform for message in client.taken["/tf_static"] for transform in message.transforms]
    assert latched[-1].child_frame_id == f"cav_{cav}/base_link"
    near(xyz(latched[-1].transform.translation), [-1.5, 0, -2], 1e-9, "mount")
    names = {status.name for message in client.taken["/diagnostics"] for status in message.status}
    assert f"v2vloc: agent-{cav}" in names, names
    return {"results": compared, "boxes": boxes, "largest speed (m/s)": max(speeds), "clock": len(clock)}


def check_clouds(client, cav, sweeps):
    """Clouds against the body of the run's own messages, which end with the points."""
    clouds = client.taken[f"/cav_{cav}/points"]
    assert clouds, "no cloud"
    bodies = {}
    for cloud in clouds:
        data = bytes(cloud.data)
        assert [field.name for field in cloud.fields] == ["x", "y", "z", "intensity"] and cloud.point_step == 16
        assert len(data) == cloud.width * 16 == cloud.row_step and cloud.height == 1
        assert any(sweep.endswith(data) for sweep in sweeps), "points that the run does not have"
        bodies[stamp_nanos(cloud.header.stamp)] = numpy.frombuffer(data, "<f4").reshape(-1, 4)
    return bodies


def other_layout(types, nanos, points):
    """The points as a driver's organised cloud: two rows, a ray without a return, coordinates of 64 bits last, 8 bits of
    intensity first, big-endian."""
    none = numpy.full((2 - len(points) % 2, 4), numpy.nan)
    rows = numpy.concatenate([points.astype("f8"), none])
    layout = numpy.dtype([("intensity", ">f4"), ("ring", ">u2"), ("z", ">f8"), ("y", ">f8"), ("x", ">f8"), ("pad", "V3")])
    data = numpy.zeros(len(rows), layout)
    for column, name in enumerate(["x", "y", "z", "intensity"]):
        data[name] = rows[:, column]
    field = types["sensor_msgs/msg/PointField"]
    fields = [field(name=name, offset=layout.fields[name][1], datatype=datatype, count=1)
              for name, datatype in [("intensity", 7), ("ring", 4), ("z", 8), ("y", 8), ("x", 8)]]
    stamp = types["builtin_interfaces/msg/Time"](sec=nanos // 10**9, nanosec=nanos % 10**9)
    width = len(rows) // 2
    return {
        "header": types["std_msgs/msg/Header"](stamp=stamp, frame_id="velodyne"), "height": 2, "width": width,
        "fields": fields, "is_bigendian": True, "point_step": layout.itemsize, "row_step": width * layout.itemsize,
        "data": numpy.frombuffer(data.tobytes(), "u1"), "is_dense": False,
    }


def check_robot(programs, client, bodies, poses):
    """The same sweeps through a ROS 2 topic: a second vehicle gives the same poses, and maps."""
    router = f"tcp/127.0.0.1:{client.port}"
    programs.start("robot-ros2", "v2vloc", "ros2", "--connect", router, "--run", "robot", "--domain-id", DOMAIN,
                   "--lidar", "/velodyne_points=robot", "--json", stdout=subprocess.PIPE)
    programs.start("robot-agent", "agent", "run", "--connect", router, "--run", "robot", "--cav", "robot", *pose_source())
    maps = client.watch("v2v/robot/robot/bev")
    client.subscribe("/cav_robot/pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
    where = {"domain_id": DOMAIN, "router_ip": "127.0.0.1", "router_port": client.port}
    wait_for("the subscription", lambda: get_topic_info("/velodyne_points", **where))
    wait_for("the agent", lambda: (topic := get_topic_info("/cav_robot/pose", **where)) and topic.publisher_count)
    name = "sensor_msgs/msg/PointCloud2"
    publisher = ROS2Publisher(
        "/velodyne_points", name, msg_definition=client.types.definition(name), type_hash=client.types.hash(name),
        domain_id=DOMAIN, router_ip="127.0.0.1", router_port=client.port,
        qos=QosProfile(reliability=QosReliability.BEST_EFFORT, history_depth=5))
    found = client.taken["/cav_robot/pose"]
    wrong = other_layout(client.sdk.store.types, 1, next(iter(bodies.values()))) | {"point_step": 3}
    publisher.publish(**wrong)
    time.sleep(0.5)
    for nanos, points in bodies.items():
        answered = len(found)
        publisher.publish(**other_layout(client.sdk.store.types, nanos, points))
        wait_for(f"a pose for {nanos}", lambda: len(found) > answered, 20)
    wait_for("maps", lambda: len(maps) >= len(bodies))
    for nanos, message in by_stamp(found).items():
        near(xyz(message.pose.pose.position), xyz(poses[nanos].pose.pose.position), 1e-9, f"pose of {nanos}")
    publisher.close()
    code, output = programs.end("robot-ros2")
    report = json.loads(output)["lidar"]
    assert code == 3 and report["unreadable"] == 1 and report["sweeps"] == len(bodies), (code, report)
    assert "point_step is 3, not at least" in programs.log("robot-ros2"), programs.log("robot-ros2")
    return {"poses": len(found), "maps": len([one for one in maps if len(one) > 10_000]), "lidar": report}


def pose_source():
    return ["--weights", WEIGHTS / "lean-none.safetensors", "--pose-source", "pgc",
            "--encoder", WEIGHTS / "pgc-encoder.safetensors", "--head", WEIGHTS / "pgc-town1.safetensors"]


def check(programs, scene):
    types, port = Types(), free_port()
    router = f"tcp/127.0.0.1:{port}"
    programs.run("sim-replay", "synth", "--subset", "town1loc", "--seed", 1000, "--frames", FRAMES, "--out", scene)
    programs.start("router", "v2vloc", "router", "--listen", router)
    wait_for("the router", lambda: socket.socket().connect_ex(("127.0.0.1", port)) == 0)
    run = ["--connect", router, "--run", "check"]
    programs.start("ros2", "v2vloc", "ros2", *run, "--domain-id", DOMAIN, "--lidar-mount", "1.5,0,2", "--json",
                   stdout=subprocess.PIPE)
    cav = next(path.name for path in sorted(pathlib.Path(scene).rglob("*")) if path.is_dir() and path.name.isdigit())
    programs.start("agent", "agent", "run", *run, "--cav", cav, *pose_source())
    programs.start("ego", "ego-fuser", "run", *run, "--ego", cav, "--method", "none",
                   "--weights", WEIGHTS / "lean-none.safetensors")
    client = Client(types, port)
    topics = check_graph(types, port, cav)
    sensor = QosProfile(reliability=QosReliability.BEST_EFFORT, history_depth=5)
    for topic, name in [("pose", "geometry_msgs/msg/PoseWithCovarianceStamped"), ("odometry", "nav_msgs/msg/Odometry"),
                        ("detections", "vision_msgs/msg/Detection3DArray")]:
        client.subscribe(f"/cav_{cav}/{topic}", name)
    client.subscribe(f"/cav_{cav}/points", "sensor_msgs/msg/PointCloud2", sensor)
    client.subscribe("/tf", "tf2_msgs/msg/TFMessage")
    client.subscribe("/clock", "rosgraph_msgs/msg/Clock", sensor)
    client.subscribe("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    results = client.watch(f"v2v/check/{cav}/detections/json")
    sweeps = client.watch(f"v2v/check/{cav}/lidar")
    # Published before: only a cache can answer.
    client.subscribe("/tf_static", "tf2_msgs/msg/TFMessage",
                     QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1))
    wait_for("the latched transforms", lambda: client.taken["/tf_static"])
    time.sleep(1)
    programs.run("sim-replay", "stream", *run, "--rate", "0.5", scene)
    wait_for("diagnoses", lambda: client.taken["/diagnostics"])
    time.sleep(1)
    code, output = programs.end("ros2")
    assert code == 0, (code, programs.log("ros2"))
    found = check_results(client, cav, results)
    bodies = check_clouds(client, cav, sweeps)
    poses = by_stamp(client.taken[f"/cav_{cav}/pose"])
    bodies = {nanos: points for nanos, points in bodies.items() if nanos in poses}
    robot = check_robot(programs, client, bodies, poses)
    return {"topics": topics, **found, "clouds": len(bodies), "published": json.loads(output)["published"], "robot": robot}


def main(folder):
    missing = [name for name in ["v2vloc", "v2vloc-runner", "agent", "ego-fuser", "sim-replay"] if not (pathlib.Path(folder) / name).exists()]
    if missing:
        print(f"skipped: {folder} has no {', '.join(missing)}", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as work:
        logs = pathlib.Path(work) / "logs"
        logs.mkdir()
        programs = Programs(folder, logs)
        try:
            print(json.dumps(check(programs, pathlib.Path(work) / "scene"), indent=1))
        except BaseException:
            for log in sorted(logs.iterdir()):
                print(f"--- {log.name}\n{log.read_text()[-2000:]}", file=sys.stderr)
            raise
        finally:
            programs.end_all()
    return 0


if __name__ == "__main__":
    if len(sys.argv) != 2:
        print(__doc__, file=sys.stderr)
        sys.exit(2)
    try:
        code = main(sys.argv[1])
    except Exception:
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    # The client's session has threads that call back into Python; closing it may wait for ever.
    os._exit(code)
