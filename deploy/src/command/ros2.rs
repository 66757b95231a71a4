//! `v2vloc ros2`.

use std::path::PathBuf;

use crate::ros::{AgentTopic, ClockMode, MotionSource, NodeOptions, NodeReport, RosSession, run};
use anyhow::{Context, bail, ensure};
use bus::shutdown::Stop;
use bus::{Bus, BusOptions, Endpoint, open_unless};
use dataset::IntensityScale;
use protocol::{CavId, Principal, Role, RunId};
use ros2::{Distribution, MotionType, Mount, RosName};
use support::cli::{BadInput, Outcome};
use support::output;

use super::{client, robot};

#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Router of the run, tcp/HOST:PORT; `v2vloc up` prints it.
    #[arg(long, default_value = "tcp/127.0.0.1:7447")]
    connect: Endpoint,
    /// Name of the run.
    #[arg(long)]
    run: RunId,
    /// Robot of this node, in a run with a node per robot: the process is named ros2-AGENT, and passes sensors on to this
    /// agent only.
    #[arg(long, value_name = "AGENT", allow_hyphen_values = true, value_parser = robot)]
    robot: Option<CavId>,
    /// Folder with the node's keys, where the run has security (`v2vloc keys` writes DIR/ros2, or DIR/ros2-AGENT).
    #[arg(long, value_name = "DIR")]
    keys: Option<PathBuf>,
    /// Print a JSON summary.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    network: NetworkOptions,
    #[command(flatten)]
    content: ContentOptions,
    #[command(flatten)]
    sensors: Sensors,
}

/// The ROS 2 network.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "ROS 2 network")]
struct NetworkOptions {
    /// Router of the ROS 2 network (rmw_zenohd) [default: the router of the run].
    #[arg(long, value_name = "ENDPOINT")]
    ros_router: Option<Endpoint>,
    /// Domain [default: ROS_DOMAIN_ID, or 0].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=232))]
    domain_id: Option<u32>,
    /// Namespace of the node, of the topics and of the frames of vehicles, for example /fleet.
    #[arg(long, value_name = "/NAME")]
    namespace: Option<RosName>,
    /// Distribution of the other nodes: humble writes no type hashes into keys; jazzy stands for all later ones.
    #[arg(long, value_enum, default_value_t)]
    distro: Distribution,
}

/// Published messages.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Messages")]
struct ContentOptions {
    /// Do not offer the sweeps of the vehicles.
    #[arg(long)]
    no_points: bool,
    /// Publish /clock: the capture times, for nodes with use_sim_time [default: true without --lidar, unless another node
    /// publishes it].
    #[arg(long, value_name = "true|false")]
    clock: Option<bool>,
    /// Place of the LiDAR on its vehicle: metres, and optionally its yaw in degrees [default: 0,0,0; of a robot with
    /// --odometry that of its tf].
    #[arg(long, value_name = "X,Y,Z[,YAW]", allow_hyphen_values = true)]
    lidar_mount: Option<Mount>,
    /// Publish the first fix of this vehicle on /initialpose, as soon as somebody subscribes to it.
    #[arg(long, value_name = "AGENT", allow_hyphen_values = true)]
    initialpose: Option<CavId>,
}

/// Sensors of the ROS 2 network.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Sensors of the ROS 2 network")]
struct Sensors {
    /// Pass the sensor_msgs/PointCloud2 of a topic to an agent as its LiDAR, for example /velodyne_points=1000;
    /// repeatable.
    #[arg(long, value_name = "TOPIC=AGENT", allow_hyphen_values = true)]
    lidar: Vec<AgentTopic>,
    /// Largest intensity of these messages; agents get shares of it, 0 to 1. `auto` is 255 for bytes and red, for other
    /// numbers the range of each LiDAR's first sweeps, as for files.
    #[arg(long, value_name = "auto|VALUE", default_value_t, requires = "lidar")]
    intensity_scale: IntensityScale,
    /// Pass speed and yaw rate of a topic of nav_msgs/Odometry to an agent that has a --lidar, for example /odom=1000,
    /// and publish map -> odom, the robot's odometry frame, instead of map -> cav_1000/lidar; repeatable.
    #[arg(long, value_name = "TOPIC=AGENT", allow_hyphen_values = true)]
    odometry: Vec<AgentTopic>,
    /// The same of a topic of geometry_msgs/TwistStamped, in the frame of the body.
    #[arg(long, value_name = "TOPIC=AGENT", allow_hyphen_values = true)]
    twist: Vec<AgentTopic>,
    /// The yaw rate of a topic of sensor_msgs/Imu with its z axis up; that of --odometry and --twist is not used then.
    #[arg(long, value_name = "TOPIC=AGENT", allow_hyphen_values = true)]
    imu: Vec<AgentTopic>,
    /// Start an agent's tracker at the poses of a topic of geometry_msgs/PoseWithCovarianceStamped, for example
    /// /initialpose=1000, which RViz and Nav2 publish; the agent has a --lidar and pose source tracked.
    #[arg(long, value_name = "TOPIC=AGENT", allow_hyphen_values = true)]
    starting_pose: Vec<AgentTopic>,
}

impl Arguments {
    /// Connects the run with the ROS 2 network until Ctrl-C.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        self.check()?;
        let domain_id = self.network.domain_id()?;
        // Enforced: a network that does not answer must not keep the process after Ctrl-C.
        let stop = Stop::of_process(false)?;
        let keys = self.keys.as_deref();
        let process = self.robot.as_ref().map_or_else(
            || Principal::of_role(Role::Ros2),
            |robot| Principal::new(Role::Ros2, robot),
        );
        let (identity, options) = client(&self.run, &process, &self.connect, keys)?;
        let bus = Bus::join_unless(&stop, &options, identity)?;
        let router = self.network.ros_router.as_ref().unwrap_or(&self.connect);
        let network = BusOptions::client(router.clone());
        let session = open_unless(&stop, &network).context("the ROS 2 network")?;
        let session = RosSession::declare(
            session,
            domain_id,
            self.network.namespace.clone(),
            self.network.distro,
        )?;
        output::note(format_args!(
            "run {} on domain {domain_id} of the ROS 2 network at {router} (Ctrl-C ends it)",
            self.run
        ));
        let report = run(&bus, &session, &self.options(), &stop)?;
        // Withdraws the tokens, so that other nodes see this one leave.
        drop(session);
        bus.leave_at_end();
        print(&report, self.json)?;
        Ok(Outcome::of(!report.is_complete() || report.left_out > 0))
    }

    fn check(&self) -> anyhow::Result<()> {
        self.sensors.check(self.robot.as_ref())?;
        let published = self.content.initialpose.as_ref();
        let mut starting_poses = self.sensors.starting_pose.iter();
        if let Some(AgentTopic { topic, cav }) =
            starting_poses.find(|source| Some(&source.cav) == published)
        {
            bail!(BadInput::new(format!(
                "--starting-pose {topic}={cav}: its first fix goes out by --initialpose, and would come back"
            )));
        }
        let message = "--ros-router: nodes of ROS 2 have no certificates; name a router for them";
        let has_router = self.network.ros_router.is_some() || self.keys.is_none();
        ensure!(has_router, BadInput::new(message));
        Ok(())
    }

    fn options(&self) -> NodeOptions {
        let (content, sensors) = (&self.content, &self.sensors);
        NodeOptions {
            no_points: content.no_points,
            clock: match content.clock {
                Some(true) => ClockMode::On,
                Some(false) => ClockMode::Off,
                None if sensors.lidar.is_empty() => ClockMode::Unoccupied,
                // The sweeps of a robot have the time of its clock, not of a scene.
                None => ClockMode::Off,
            },
            mount: content.lidar_mount,
            lidars: sensors.lidar.clone(),
            motions: sensors.motions(),
            starting_poses: sensors.starting_pose.clone(),
            intensity_scale: sensors.intensity_scale,
            initial_pose_of: content.initialpose.clone(),
        }
    }
}

impl Sensors {
    /// Rejects two sensors of one kind for one vehicle, motions of vehicles without a LiDAR, and sensors of others than the
    /// node's `robot`.
    fn check(&self, robot: Option<&CavId>) -> anyhow::Result<()> {
        let motions = [&self.odometry, &self.twist, &self.imu];
        let mut all = [&self.lidar, &self.starting_pose]
            .into_iter()
            .chain(motions)
            .flatten();
        if let Some(robot) = robot
            && let Some(AgentTopic { topic, cav }) = all.find(|of| of.cav != *robot)
        {
            bail!(BadInput::new(format!(
                "{topic}={cav}: the node is that of --robot {robot}, and passes sensors on to it only"
            )));
        }
        let speeds: Vec<AgentTopic> = self.odometry.iter().chain(&self.twist).cloned().collect();
        for (option, what, sources) in [
            ("--lidar", "LiDAR", &self.lidar),
            ("--odometry, --twist", "speed", &speeds),
            ("--imu", "IMU", &self.imu),
            ("--starting-pose", "starting pose", &self.starting_pose),
        ] {
            for (index, AgentTopic { topic, cav }) in sources.iter().enumerate() {
                let mut others = sources.iter().take(index);
                if let Some(AgentTopic { topic: first, .. }) =
                    others.find(|other| other.cav == *cav)
                {
                    let message =
                        format!("{option}: {first} and {topic} are both the {what} of {cav}");
                    bail!(BadInput::new(message));
                }
            }
        }
        let others = speeds.iter().chain(&self.imu).chain(&self.starting_pose);
        let mut blind = others.filter(|of| self.lidar.iter().all(|lidar| lidar.cav != of.cav));
        if let Some(AgentTopic { topic, cav }) = blind.next() {
            bail!(BadInput::new(format!(
                "{topic}={cav}: an agent's motion and starting pose go with its sweeps; name its --lidar too"
            )));
        }
        Ok(())
    }

    fn motions(&self) -> Vec<MotionSource> {
        let odometry = self.odometry.iter().map(|of| (MotionType::Odometry, of));
        let twist = self.twist.iter().map(|of| (MotionType::TwistStamped, of));
        let imu = self.imu.iter().map(|of| (MotionType::Imu, of));
        let motions = odometry.chain(twist).chain(imu);
        let motions = motions.map(|(motion_type, source)| MotionSource {
            motion_type,
            source: source.clone(),
        });
        motions.collect()
    }
}

impl NetworkOptions {
    fn domain_id(&self) -> anyhow::Result<u32> {
        let Some(text) = std::env::var_os("ROS_DOMAIN_ID").filter(|_| self.domain_id.is_none())
        else {
            return Ok(self.domain_id.unwrap_or(0));
        };
        let number = text.to_str().and_then(|text| text.parse().ok());
        number.filter(|number| *number <= 232).ok_or_else(|| {
            let message = format!("ROS_DOMAIN_ID is {text:?}, not a number from 0 to 232");
            BadInput::new(message).into()
        })
    }
}

fn print(report: &NodeReport, as_json: bool) -> anyhow::Result<()> {
    if as_json {
        output::line(serde_json::to_string(report)?)?;
        return Ok(());
    }
    for (topic, messages) in &report.published {
        output::line(format_args!("{messages:>8} {topic}"))?;
    }
    let lidar = &report.lidar;
    if lidar.sweeps > 0 {
        output::line(format_args!(
            "{} sweeps passed to agents, {} superseded, {} repeated",
            lidar.sweeps, lidar.superseded, lidar.repeated
        ))?;
    }
    print_counts(&[(lidar.sweeps_without_motion, "of these without a motion")])?;
    for (topic, motion) in &report.motion {
        output::line(format_args!(
            "{} messages of {topic} read, {} could not be read, {} measurements out of order",
            motion.read, motion.unreadable, motion.out_of_order
        ))?;
    }
    print_counts(&[
        (
            lidar.without_points,
            "sweeps have no point in range and were left out",
        ),
        (lidar.without_stamp, "messages of LiDARs had no time"),
        (
            lidar.ahead_of_clock,
            "sweeps had a time ahead of this machine's clock",
        ),
        (
            lidar.back_in_time,
            "sweeps had a time before the one before",
        ),
        (
            report.unplaced_poses,
            "poses gave no place of an odometry frame in the map",
        ),
        (lidar.unreadable, "messages of LiDARs could not be read"),
        (report.left_out, "messages of the run were left out"),
    ])
}

/// Prints a line for each of the counts that is not 0.
fn print_counts(counts: &[(u64, &str)]) -> anyhow::Result<()> {
    for (count, what) in counts.iter().filter(|(count, _)| *count > 0) {
        output::line(format_args!("{count} {what}"))?;
    }
    Ok(())
}
