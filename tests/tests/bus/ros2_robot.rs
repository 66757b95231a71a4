//! A robot in a ROS 2 network: an agent that gives poses only, its odometry frame in the map, and a node that comes and
//! goes.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use agent::agent::Agent;
use agent::agent_loop::LoopOptions;
use agent::node;
use bus::shutdown::Stop;
use deploy::ros::{MotionSource, NodeOptions};
use localization::pose_source::{PoseInput, PoseSource};
use localization::tracker::PoseMeasurement;
use protocol::{Pose, PoseEstimate};
use ros2::{Distribution, MotionType, RosType};
use tests::bus::{TestRouter, wait_for};
use zenoh::Session;

use super::ros2::{
    Fields, Subscriber, TF, TF_HASH, announce, cav, driver_cloud, key, odometry, other_node, put,
    start, wait_for_subscriptions,
};

const JAZZY: Distribution = Distribution::Jazzy;
const S: u64 = 1_000_000_000;

/// Every sweep is at one place; poses that are stated are noted.
#[derive(Debug)]
struct OnePlace {
    stated: Arc<Mutex<Vec<PoseMeasurement>>>,
}

fn place() -> Pose {
    Pose::from_xyz_yaw([10.0, 20.0, 1.0], 0.0)
}

impl PoseSource for OnePlace {
    fn estimate(&mut self, _: &PoseInput<'_>) -> PoseEstimate {
        PoseEstimate::new(place(), 0.9)
    }

    fn start_at(&mut self, stated: &PoseMeasurement) -> bool {
        self.stated.lock().unwrap().push(*stated);
        true
    }
}

fn node_options() -> NodeOptions {
    NodeOptions {
        lidars: vec!["/points=1000".parse().unwrap()],
        motions: vec![MotionSource {
            motion_type: MotionType::Odometry,
            source: "/odom=1000".parse().unwrap(),
        }],
        starting_poses: vec!["/initialpose=1000".parse().unwrap()],
        ..NodeOptions::default()
    }
}

/// A robot that stands 3 m ahead of the origin of its odometry, with a LiDAR 1 m ahead of its body's origin.
struct Robot {
    session: Session,
    /// Time of the last sweep.
    nanos: u64,
}

impl Robot {
    fn put(&self, topic: &str, ros_type: RosType, message: Vec<u8>) {
        put(&self.session, (topic, ros_type), JAZZY, message);
    }

    /// One sweep with its odometry before and after, and all transforms.
    fn sense(&mut self) {
        self.nanos += S / 10;
        let frame = |parent: &str, child: &str, x: f64| {
            let pose = Pose::from_xyz_yaw([x, 0.0, 0.0], 0.0);
            [(parent.to_owned(), child.to_owned(), pose)]
        };
        let mount = ros2::transforms(0, &frame("base_link", "velodyne", 1.0));
        self.put("tf_static", RosType::TfMessage, mount);
        for nanos in [self.nanos - S / 20, self.nanos + S / 20] {
            let moved = ros2::transforms(nanos, &frame("odom", "base_link", 3.0));
            self.put("tf", RosType::TfMessage, moved);
            self.put("odom", RosType::Odometry, odometry(nanos, 1.0, 0.0));
        }
        let cloud = driver_cloud(self.nanos, 16);
        self.put("points", RosType::PointCloud2, cloud);
        std::thread::sleep(Duration::from_millis(100));
    }

    /// Senses until `is_done`.
    fn sense_until(&mut self, what: &str, mut is_done: impl FnMut() -> bool) {
        wait_for(what, || {
            self.sense();
            is_done()
        });
    }
}

/// Requests a stop when a test ends, also by a failed assertion: no thread of the test keeps it waiting.
struct StopAtEnd<'a>(&'a Stop);

impl Drop for StopAtEnd<'_> {
    fn drop(&mut self) {
        self.0.request();
    }
}

/// True if the last messages of tf have the odometry frame in the map, and nothing but it.
fn has_odometry_in_map(tf: &Subscriber) -> bool {
    let messages: Vec<_> = tf.messages.try_iter().collect();
    let ours = messages.iter().filter(|(message, _)| {
        let mut fields = Fields::of(message);
        let (count, _, parent, child) =
            (fields.u32(), fields.nanos(), fields.text(), fields.text());
        // The robot's own transforms are heard too.
        if parent != "map" {
            return false;
        }
        assert_eq!((count, child.as_str()), (1, "odom"));
        assert_eq!(fields.f64s(), [6.0, 20.0, 1.0]);
        true
    });
    ours.count() > 0
}

#[test]
fn a_robot_gets_map_to_odom_and_its_agent_survives_restarts_of_the_node() {
    let router = TestRouter::open();
    let stated = Arc::<Mutex<Vec<PoseMeasurement>>>::default();
    std::thread::scope(|scope| {
        let agent_stop = Stop::new();
        let _agent_ends = StopAtEnd(&agent_stop);
        let agent = scope.spawn({
            let (router, stop, stated) = (&router, agent_stop.clone(), Arc::clone(&stated));
            move || {
                let bus = router.join("agent-1000", "1000");
                let agent = Agent::without_detector(cav(), Box::new(OnePlace { stated }));
                let options = node::NodeOptions {
                    of_loop: LoopOptions {
                        publish: Vec::new(),
                        ..LoopOptions::default()
                    },
                    ..node::NodeOptions::default()
                };
                node::run(&bus, agent, &options, &stop).unwrap()
            }
        });
        let mut robot = Robot {
            session: other_node(&router),
            nanos: 100 * S,
        };
        let _node = announce(&robot.session);
        let tf = Subscriber::open(&robot.session, &key("tf", TF, TF_HASH));
        for round in 0..2 {
            let stop = Stop::new();
            let _node_ends = StopAtEnd(&stop);
            let node = start(scope, &router, (JAZZY, node_options()), &stop);
            wait_for_subscriptions(
                &robot.session,
                &["%points", "%odom", "%tf", "%tf_static", "%initialpose"],
            );
            // Of this node, not of the one before.
            let _ = has_odometry_in_map(&tf);
            robot.sense_until("map -> odom", || has_odometry_in_map(&tf));
            if round == 0 {
                let covariance = protocol::PlanarCovariance {
                    xx_m2: 0.25,
                    xy_m2: 0.0,
                    yy_m2: 0.25,
                    yaw_rad2: 0.04,
                };
                let drawn = Pose::from_xyz_yaw([7.0, 8.0, 0.0], 0.0);
                let drawn = ros2::pose(1, &drawn, Some(&covariance));
                let ros_type = RosType::PoseWithCovarianceStamped;
                robot.put("initialpose", ros_type, drawn);
                robot.sense_until("the stated pose", || !stated.lock().unwrap().is_empty());
            }
            stop.request();
            let report = node.join().unwrap();
            assert!(report.is_complete(), "{report:?}");
            let names: Vec<&str> = report.published.keys().map(String::as_str).collect();
            assert!(names.contains(&"/cav_1000/pose"), "{names:?}");
            assert!(!agent.is_finished(), "the agent stays");
        }
        agent_stop.request();
        let report = agent.join().unwrap();
        assert!(report.sweeps >= 2 && report.failed == 0, "{report:?}");
    });
    let stated = stated.lock().unwrap();
    let [pose] = stated.as_slice() else {
        panic!("{stated:?}")
    };
    // Of the LiDAR: 1 m ahead of the body that was drawn.
    assert_eq!(pose.world_from_lidar.translation.x, 8.0);
    assert!((pose.position_std_m - 0.5).abs() < 1e-6 && (pose.yaw_std_rad - 0.2).abs() < 1e-6);
    assert!(pose.capture_nanos > 100 * S, "at the time of a sweep");
}
