"""Localization of a robot by v2vloc: a router of its own, the agent, and the node of the ROS 2 network.

    ros2 launch deploy/ros2/robot.launch.py agent:=deploy/ros2/agent.yaml lidar:=/velodyne_points odometry:=/odom

The programs are those on PATH, or in the folder `bin`. rmw_zenohd runs already: nodes use RMW_IMPLEMENTATION=rmw_zenoh_cpp.
The three processes start again when they end; the agent keeps its pose while the node is away.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

ARGUMENTS = {
    "agent": ("deploy/ros2/agent.yaml", "Configuration of the agent: encoder and head of the place"),
    "bin": ("", "Folder of the programs with its last slash; empty: PATH"),
    "lidar": ("/velodyne_points", "Topic of sensor_msgs/PointCloud2"),
    "odometry": ("/odom", "Topic of nav_msgs/Odometry; its frames are those of the robot's tf"),
    "starting_pose": ("/initialpose", "Topic of geometry_msgs/PoseWithCovarianceStamped"),
    "ros_router": ("tcp/127.0.0.1:7447", "Router of the ROS 2 network: rmw_zenohd"),
    "router": ("tcp/127.0.0.1:7448", "Router of the run, which is started here; that of agent.yaml"),
}


def program(name, *arguments):
    """One of our programs, started again two seconds after it has ended."""
    return ExecuteProcess(cmd=[[LaunchConfiguration("bin"), name], *arguments], output="screen", respawn=True, respawn_delay=2.0)


def of_agent(argument):
    """TOPIC=AGENT: the agent of agent.yaml is vehicle 1."""
    return [LaunchConfiguration(argument), "=1"]


def generate_launch_description():
    router = LaunchConfiguration("router")
    return LaunchDescription([
        *[DeclareLaunchArgument(name, default_value=value, description=text) for name, (value, text) in ARGUMENTS.items()],
        program("v2vloc", "router", "--listen", router),
        program("agent", "run", "--config", LaunchConfiguration("agent")),
        program("v2vloc", "ros2", "--run", "robot", "--connect", router, "--ros-router", LaunchConfiguration("ros_router"),
                "--lidar", of_agent("lidar"), "--odometry", of_agent("odometry"), "--starting-pose", of_agent("starting_pose")),
    ])
