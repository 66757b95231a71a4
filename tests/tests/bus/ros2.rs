//! ROS 2 network: the node seen by a subscriber and a publisher that speak rmw_zenoh with a decoder of their own.

use std::collections::BTreeSet;
use std::sync::mpsc::{Receiver, channel};
use std::thread::ScopedJoinHandle;
use std::time::{Duration, Instant};

use bus::bounded_queue::Pop;
use bus::shutdown::Stop;
use bus::{Bus, BusOptions, Event, PublisherOptions};
use deploy::ros::{MotionSource, NodeOptions, NodeReport, RosSession, run};
use protocol::{
    Box3d, CavId, Detection, Detections, EgoMotion, Lidar, Limits, PlanarCovariance, PointCloud,
    Pose, PoseEstimate, Role, Stream, Topic,
};
use re_cdr::{CdrReader, CdrWriter, LittleEndian};
use ros2::endpoint::Attachment;
use ros2::{Distribution, MotionType, RosName, RosType};
use tests::bus::{TIMEOUT, TestRouter, wait_for};
use zenoh::liveliness::LivelinessToken;
use zenoh::{Session, Wait};
use zenoh_ext::{AdvancedSubscriberBuilderExt, HistoryConfig};

pub(super) const DOMAIN: u32 = 3;

pub(super) fn cav() -> CavId {
    CavId::new("1000").unwrap()
}

fn topic(stream: Stream) -> Topic {
    Topic::Stream { cav: cav(), stream }
}

/// A session of another node.
pub(super) fn other_node(router: &TestRouter) -> Session {
    bus::open(&BusOptions::client(router.endpoint.clone())).unwrap()
}

/// Runs the node on a router until `stop`.
pub(super) fn start<'scope>(
    scope: &'scope std::thread::Scope<'scope, '_>,
    router: &'scope TestRouter,
    (distribution, options): (Distribution, NodeOptions),
    stop: &Stop,
) -> ScopedJoinHandle<'scope, NodeReport> {
    start_within(scope, router, (None, distribution, options), stop)
}

/// The same in a namespace.
pub(super) fn start_within<'scope>(
    scope: &'scope std::thread::Scope<'scope, '_>,
    router: &'scope TestRouter,
    (namespace, distribution, options): (Option<RosName>, Distribution, NodeOptions),
    stop: &Stop,
) -> ScopedJoinHandle<'scope, NodeReport> {
    let stop = stop.clone();
    scope.spawn(move || {
        let bus = router.join("ros2", "ros2");
        let session = other_node(router);
        let session = RosSession::declare(session, DOMAIN, namespace, distribution).unwrap();
        let report = run(&bus, &session, &options, &stop).unwrap();
        drop(session);
        bus.leave(TIMEOUT).unwrap();
        report
    })
}

/// Key of a topic's messages, as written in documents of rmw_zenoh.
pub(super) fn key(topic: &str, ros_type: &str, hash: &str) -> String {
    format!("{DOMAIN}/{topic}/{ros_type}/{hash}")
}

const POSE: &str = "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_";
const POSE_HASH: &str = "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e";
const POINTS: &str = "sensor_msgs::msg::dds_::PointCloud2_";
const POINTS_HASH: &str = "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5";
pub(super) const TF: &str = "tf2_msgs::msg::dds_::TFMessage_";
pub(super) const TF_HASH: &str =
    "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087";
pub(super) const CLOCK: &str = "rosgraph_msgs::msg::dds_::Clock_";
pub(super) const CLOCK_HASH: &str =
    "RIHS01_692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564";
const DETECTIONS: &str = "vision_msgs::msg::dds_::Detection3DArray_";
const DETECTIONS_HASH: &str =
    "RIHS01_793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018";

/// Body and attachment of the messages on a key.
pub(super) struct Subscriber {
    pub(super) messages: Receiver<(Vec<u8>, Attachment)>,
    _subscriber: zenoh::pubsub::Subscriber<()>,
}

impl Subscriber {
    pub(super) fn open(session: &Session, key: &str) -> Self {
        let (sender, messages) = channel();
        let subscriber = session
            .declare_subscriber(key.to_owned())
            .callback(move |sample| {
                let attachment = sample.attachment().expect("rmw_zenoh needs one").to_bytes();
                let attachment = Attachment::from_bytes(&attachment).expect("33 bytes");
                let _ = sender.send((sample.payload().to_bytes().into_owned(), attachment));
            });
        Self {
            messages,
            _subscriber: subscriber.wait().unwrap(),
        }
    }

    pub(super) fn next(&self) -> (Vec<u8>, Attachment) {
        self.messages.recv_timeout(TIMEOUT).expect("a message")
    }
}

/// Fields of a message after its encapsulation header.
pub(super) struct Fields<'a>(CdrReader<'a, LittleEndian>);

impl<'a> Fields<'a> {
    pub(super) fn of(message: &'a [u8]) -> Self {
        assert_eq!(message[..4], [0, 1, 0, 0]);
        Self(CdrReader::new(&message[4..]))
    }

    pub(super) fn u32(&mut self) -> u32 {
        self.0.read_u32().unwrap()
    }

    pub(super) fn text(&mut self) -> String {
        self.0.read_string().unwrap()
    }

    pub(super) fn f64s<const N: usize>(&mut self) -> [f64; N] {
        std::array::from_fn(|_| self.0.read_f64().unwrap())
    }

    pub(super) fn nanos(&mut self) -> u64 {
        let (seconds, nanos) = (self.0.read_i32().unwrap(), self.u32());
        u64::try_from(seconds).unwrap() * 1_000_000_000 + u64::from(nanos)
    }
}

const AT: u64 = 2_300_000_000;

fn planar() -> PlanarCovariance {
    PlanarCovariance {
        xx_m2: 0.25,
        xy_m2: 0.0,
        yy_m2: 0.5,
        yaw_rad2: 0.125,
    }
}

/// What a vehicle publishes at one time.
fn publish(bus: &Bus) {
    let publisher = |stream, options| bus.publisher(topic(stream), options).unwrap();
    let imu = publisher(Stream::Imu, PublisherOptions::POSE);
    imu.submit(
        AT,
        EgoMotion {
            speed_mps: Some(8.0),
            yaw_rate_rad_s: Some(0.25),
        },
    );
    let pose = publisher(Stream::Pose, PublisherOptions::POSE);
    let world_from_cav = Pose::from_xyz_yaw([10.0, 20.0, 1.5], 0.0);
    pose.submit(
        AT,
        PoseEstimate::Pose {
            world_from_cav,
            confidence: 0.9,
            covariance: Some(planar()),
        },
    );
    let lidar = publisher(Stream::Lidar, PublisherOptions::SENSOR);
    lidar.submit(
        AT,
        Lidar {
            points: PointCloud {
                xyzi: vec![[1.0, 2.0, 3.0, 0.5]; 3],
            },
        },
    );
    let detections = publisher(Stream::Detections, PublisherOptions::DETECTIONS);
    let box3d = Box3d {
        center_m: [5.0, 6.0, 0.5],
        size_m: [4.0, 2.0, 1.5],
        heading_rad: 0.0,
    };
    detections.submit(
        AT,
        Detections {
            ego: cav(),
            agent_frame: 0,
            method: "late".into(),
            pose: PoseEstimate::new(world_from_cav, 0.9),
            detections: vec![Detection {
                box3d,
                score: 0.75,
                source: None,
            }],
            fused: Vec::new(),
            skipped: Vec::new(),
            neighbours: Vec::new(),
            stages: Vec::new(),
        },
    );
    [imu, pose, lidar, detections]
        .into_iter()
        .for_each(bus::Publisher::finish);
}

/// Tokens on the network that match `selector`.
pub(super) fn tokens(session: &Session, selector: &str) -> BTreeSet<String> {
    let replies = session
        .liveliness()
        .get(selector)
        .timeout(TIMEOUT)
        .wait()
        .unwrap();
    let replies = std::iter::from_fn(|| replies.recv().ok());
    replies
        .filter_map(|reply| {
            reply
                .result()
                .ok()
                .map(|sample| sample.key_expr().to_string())
        })
        .collect()
}

#[test]
fn ros_nodes_discover_and_receive_the_run() {
    let (router, stop) = (TestRouter::open(), Stop::new());
    let vehicle = router.join("agent-1000", "1000");
    std::thread::scope(|scope| {
        let mount = "1.5,0,2".parse().unwrap();
        let options = NodeOptions {
            mount: Some(mount),
            ..NodeOptions::default()
        };
        let node = start(scope, &router, (Distribution::Jazzy, options), &stop);
        let other = other_node(&router);
        let topics = [
            ("clock", CLOCK, CLOCK_HASH),
            ("tf", TF, TF_HASH),
            ("cav_1000/pose", POSE, POSE_HASH),
            ("cav_1000/points", POINTS, POINTS_HASH),
            ("cav_1000/detections", DETECTIONS, DETECTIONS_HASH),
        ];
        let [clock, tf, pose, points, detections] = topics
            .map(|(topic, ros_type, hash)| Subscriber::open(&other, &key(topic, ros_type, hash)));
        let _alive = [Role::Agent, Role::Ego].map(|role| vehicle.announce(role).unwrap());
        // Its topics appear with the vehicle, before any message.
        let has = |kind: &str, what: &str| {
            let found = tokens(&other, &format!("@ros2_lv/{DOMAIN}/**"));
            found
                .iter()
                .any(|token| token.contains(kind) && token.contains(what))
        };
        for (topic, ros_type, hash) in topics {
            let end = format!("/%{}/{ros_type}/{hash}/", topic.replace('/', "%"));
            wait_for(&end, || has("/MP/%/%/v2vloc/", &end));
        }
        assert!(has("/0/0/NN/%/%/v2vloc", ""));
        assert!(
            has("/MP/", "%cav_1000%points")
                && has("/MP/", "/2::,5:,:,:,,")
                && has("/MP/", "/:1:,1:,:,:,,")
        );

        // The node subscribes to sweeps when it knows of the subscriber: published until one has arrived.
        let deadline = Instant::now() + TIMEOUT;
        let (cloud, attachment) = loop {
            assert!(Instant::now() < deadline, "no sweep");
            publish(&vehicle);
            if let Ok(message) = points.messages.recv_timeout(Duration::from_millis(200)) {
                break message;
            }
        };
        assert_eq!(attachment.sequence, 1);
        assert!(
            tokens(&other, "@ros2_lv/**")
                .iter()
                .any(|token| ros2::endpoint::gid(token) == attachment.gid)
        );
        let mut fields = Fields::of(&cloud);
        assert_eq!(
            (fields.nanos(), fields.text().as_str()),
            (AT, "cav_1000/lidar")
        );
        assert_eq!([fields.u32(), fields.u32(), fields.u32()], [1, 3, 4]);

        let (message, first) = pose.next();
        let mut fields = Fields::of(&message);
        assert_eq!((fields.nanos(), fields.text().as_str()), (AT, "map"));
        assert_eq!(fields.f64s(), [10.0, 20.0, 1.5, 0.0, 0.0, 0.0, 1.0]);
        let covariance: [f64; 36] = fields.f64s();
        assert_eq!(
            [covariance[0], covariance[7], covariance[35]],
            [0.25, 0.5, 0.125]
        );
        assert_eq!(first.sequence, 1);

        let (message, _) = tf.next();
        let mut fields = Fields::of(&message);
        assert_eq!(
            (fields.u32(), fields.nanos(), fields.text().as_str()),
            (1, AT, "map")
        );
        assert_eq!(
            (fields.text().as_str(), fields.f64s()),
            ("cav_1000/lidar", [10.0, 20.0, 1.5])
        );

        let (message, _) = detections.next();
        let mut fields = Fields::of(&message);
        assert_eq!(
            (fields.nanos(), fields.text().as_str(), fields.u32()),
            (AT, "cav_1000/lidar", 1)
        );
        assert_eq!(
            (fields.nanos(), fields.text().as_str(), fields.u32()),
            (AT, "cav_1000/lidar", 1)
        );
        assert_eq!(
            (fields.text().as_str(), fields.f64s()),
            ("vehicle", [0.75, 5.0, 6.0, 0.5])
        );

        let (message, _) = clock.next();
        assert_eq!(Fields::of(&message).nanos(), AT, "one time base");

        // A late subscriber, as rmw_zenoh declares it, gets the fixed transforms.
        let (sender, latched) = channel();
        let late = other_node(&router);
        let _late = late
            .declare_subscriber(key("tf_static", TF, TF_HASH))
            .history(
                HistoryConfig::default()
                    .detect_late_publishers()
                    .max_samples(1),
            )
            .subscriber_detection()
            .callback(move |sample| {
                assert!(Attachment::from_bytes(&sample.attachment().unwrap().to_bytes()).is_some());
                let _ = sender.send(sample.payload().to_bytes().into_owned());
            })
            .wait()
            .unwrap();
        let message = latched.recv_timeout(TIMEOUT).unwrap();
        let mut fields = Fields::of(&message);
        assert_eq!(
            (fields.u32(), fields.nanos(), fields.text().as_str()),
            (1, 0, "cav_1000/lidar")
        );
        assert_eq!(
            (fields.text().as_str(), fields.f64s()),
            ("cav_1000/base_link", [-1.5, 0.0, -2.0])
        );

        // A vehicle that has left leaves no topics.
        drop(_alive);
        wait_for("a farewell", || !has("/MP/", "%cav_1000%pose"));
        stop.request();
        let report = node.join().unwrap();
        assert!(
            report.published["/cav_1000/pose"] >= 1 && report.left_out == 0,
            "{report:?}"
        );
    });
}

/// `sensor_msgs/PointCloud2` of two points with x, y, z in single precision and intensity in 8 bits.
pub(super) fn driver_cloud(nanos: u64, point_step: u32) -> Vec<u8> {
    let points = [1.0f32, -1.0].map(|x| {
        let mut point = [x, 2.0, 3.0].map(f32::to_le_bytes).concat();
        point.extend([51, 0, 0, 0]);
        point
    });
    point_cloud(nanos, UINT8, point_step, &points.concat())
}

/// `sensor_msgs/PointField::UINT8` and `FLOAT32`.
const UINT8: u8 = 2;
pub(super) const FLOAT32: u8 = 7;

/// `sensor_msgs/PointCloud2` of points of 16 bytes: x, y, z in single precision, and intensity in a type of its own; the
/// message states `point_step`.
pub(super) fn point_cloud(
    nanos: u64,
    intensity_type: u8,
    point_step: u32,
    points: &[u8],
) -> Vec<u8> {
    let count = u32::try_from(points.len() / 16).unwrap();
    let mut bytes = vec![0, 1, 0, 0];
    let mut cdr = CdrWriter::<LittleEndian>::new(&mut bytes);
    cdr.write_i32((nanos / 1_000_000_000) as i32);
    cdr.write_u32((nanos % 1_000_000_000) as u32);
    cdr.write_string("velodyne");
    [1, count]
        .into_iter()
        .for_each(|value| cdr.write_u32(value));
    let coordinates = [("x", 0, FLOAT32), ("y", 4, FLOAT32), ("z", 8, FLOAT32)];
    cdr.write_sequence_length(coordinates.len() + 1);
    for (name, offset, datatype) in
        coordinates
            .into_iter()
            .chain([("intensity", 12, intensity_type)])
    {
        cdr.write_string(name);
        cdr.write_u32(offset);
        cdr.write_u8(datatype);
        cdr.write_u32(1);
    }
    cdr.write_bool(false);
    cdr.write_u32(point_step);
    cdr.write_u32(count * point_step);
    cdr.write_bytes(points);
    cdr.write_bool(true);
    bytes
}

/// `nav_msgs/Odometry` of a robot that drives so.
pub(super) fn odometry(nanos: u64, speed_mps: f64, yaw_rate_rad_s: f64) -> Vec<u8> {
    with_header(nanos, &["odom", "base_link"], |values| {
        values.extend([0.0; 7 + 36]);
        values.extend([speed_mps, 0.0, 0.0, 0.0, 0.0, yaw_rate_rad_s]);
        values.extend([0.01; 36]);
    })
}

/// `sensor_msgs/Imu` of a robot that turns so.
fn imu(nanos: u64, yaw_rate_rad_s: f64) -> Vec<u8> {
    with_header(nanos, &["imu_link"], |values| {
        values.extend([0.0; 4 + 9]);
        values.extend([0.0, 0.0, yaw_rate_rad_s]);
        values.extend([0.01; 9]);
        values.extend([0.0; 3 + 9]);
    })
}

pub(super) fn with_header(nanos: u64, texts: &[&str], fill: impl FnOnce(&mut Vec<f64>)) -> Vec<u8> {
    let mut bytes = vec![0, 1, 0, 0];
    let mut cdr = CdrWriter::<LittleEndian>::new(&mut bytes);
    cdr.write_i32((nanos / 1_000_000_000) as i32);
    cdr.write_u32((nanos % 1_000_000_000) as u32);
    texts.iter().for_each(|text| cdr.write_string(text));
    let mut values = Vec::new();
    fill(&mut values);
    values.into_iter().for_each(|value| cdr.write_f64(value));
    bytes
}

/// Publishes a message as another node would.
pub(super) fn put(
    session: &Session,
    (topic, ros_type): (&str, RosType),
    distribution: Distribution,
    message: Vec<u8>,
) {
    let attachment = Attachment {
        sequence: 1,
        source_nanos: 1,
        gid: [7; 16],
    };
    let hash = ros_type.hash(distribution);
    session
        .put(key(topic, &ros_type.dds_name(), &hash), message)
        .attachment(attachment.to_bytes())
        .wait()
        .unwrap();
}

/// Waits until the node has subscribed to all of `topics`, written with `%` for `/`.
pub(super) fn wait_for_subscriptions(session: &Session, topics: &[&str]) {
    wait_for("the subscriptions", || {
        let tokens = tokens(session, &format!("@ros2_lv/{DOMAIN}/*/0/*/MS/**"));
        let has = |topic: &&str| {
            tokens
                .iter()
                .any(|token| token.contains(&format!("/{topic}/")))
        };
        topics.iter().all(has)
    });
}

pub(super) fn announce(session: &Session) -> LivelinessToken {
    let zid = session.zid();
    let token = format!("@ros2_lv/{DOMAIN}/{zid}/0/0/NN/%/%/driver");
    session.liveliness().declare_token(token).wait().unwrap()
}

#[test]
fn a_lidar_of_ros_is_that_of_an_agent_and_a_wrong_message_is_counted() {
    for distribution in [Distribution::Humble, Distribution::Jazzy] {
        let (router, stop) = (TestRouter::open(), Stop::new());
        let agent = router.join("agent-1000", "1000");
        let inbox = agent.inbox(4, 1);
        let _subscription = agent.subscribe(topic(Stream::Lidar), &inbox).unwrap();
        std::thread::scope(|scope| {
            let lidars = ["/velodyne/points=1000", "/broken=2000"]
                .map(|text| text.parse().unwrap())
                .into();
            let options = NodeOptions {
                lidars,
                intensity_scale: "255".parse().unwrap(),
                ..NodeOptions::default()
            };
            let node = start(scope, &router, (distribution, options), &stop);
            let driver = other_node(&router);
            let _node = announce(&driver);
            wait_for_subscriptions(&driver, &["%velodyne%points", "%broken"]);
            let put = |topic: &str, cloud: Vec<u8>| {
                put(&driver, (topic, RosType::PointCloud2), distribution, cloud);
            };
            put("broken", driver_cloud(AT, 12));
            put("velodyne/points", driver_cloud(0, 16));
            // The queue keeps the newest message only: the one without a stamp is read before the next is sent.
            std::thread::sleep(Duration::from_millis(500));
            let mut sent = 0;
            let arrival = loop {
                sent += 1;
                put("velodyne/points", driver_cloud(AT + sent, 16));
                match inbox.take(Some(Instant::now() + Duration::from_millis(100))) {
                    Pop::Item(_, Event::Message(arrival)) => break arrival,
                    Pop::Item(..) | Pop::TimedOut => assert!(sent < 600, "nothing arrives"),
                    Pop::Closed => panic!("the inbox is closed"),
                }
            };
            let capture = arrival.header.stamp.capture_nanos;
            assert!((AT + 1..=AT + sent).contains(&capture), "{capture}");
            let lidar: Lidar = inbox.decode(&arrival, &Limits::DEFAULT).unwrap();
            assert_eq!(
                lidar.points.xyzi,
                [[1.0, 2.0, 3.0, 0.2], [-1.0, 2.0, 3.0, 0.2]]
            );
            stop.request();
            let report = node.join().unwrap().lidar;
            assert_eq!(
                (
                    report.unreadable,
                    report.without_stamp,
                    report.is_complete()
                ),
                (1, 1, false),
                "{report:?}"
            );
            assert!(report.sweeps >= 1, "{report:?}");
        });
    }
}

#[test]
fn the_odometry_of_a_robot_is_the_motion_of_its_agent_at_every_sweep() {
    let (router, stop) = (TestRouter::open(), Stop::new());
    let agent = router.join("agent-1000", "1000");
    let inbox = agent.inbox(4, 1);
    let _subscription = agent.subscribe(topic(Stream::Imu), &inbox).unwrap();
    std::thread::scope(|scope| {
        let of = |motion_type, topic: &str| MotionSource {
            motion_type,
            source: topic.parse().unwrap(),
        };
        let motions = vec![
            of(MotionType::Odometry, "/odom=1000"),
            of(MotionType::Imu, "/imu=1000"),
        ];
        let lidars = vec!["/points=1000".parse().unwrap()];
        let options = NodeOptions {
            lidars,
            motions,
            ..NodeOptions::default()
        };
        let node = start(scope, &router, (Distribution::Jazzy, options), &stop);
        let robot = other_node(&router);
        let _node = announce(&robot);
        wait_for_subscriptions(&robot, &["%points", "%odom", "%imu"]);
        let put = |topic: &str, ros_type: RosType, message: Vec<u8>| {
            put(&robot, (topic, ros_type), Distribution::Jazzy, message);
        };
        let mut sent = 0;
        let arrival = loop {
            sent += 1;
            // Half-way between two measurements; the gyroscope's yaw rate replaces that of the wheels.
            let sweep = AT + sent * 1_000_000_000;
            for (nanos, speed_mps) in [(sweep - 50_000_000, 4.0), (sweep + 50_000_000, 6.0)] {
                put("odom", RosType::Odometry, odometry(nanos, speed_mps, 3.0));
                put("imu", RosType::Imu, imu(nanos, -0.5));
            }
            put(
                "odom",
                RosType::Odometry,
                odometry(sweep + 60_000_000, f64::NAN, 0.0),
            );
            put("points", RosType::PointCloud2, driver_cloud(sweep, 16));
            match inbox.take(Some(Instant::now() + Duration::from_millis(100))) {
                Pop::Item(_, Event::Message(arrival)) => break arrival,
                Pop::Item(..) | Pop::TimedOut => assert!(sent < 600, "nothing arrives"),
                Pop::Closed => panic!("the inbox is closed"),
            }
        };
        let capture = arrival.header.stamp.capture_nanos;
        assert!(
            capture > AT && (capture - AT).is_multiple_of(1_000_000_000),
            "the time of a sweep, {capture}"
        );
        let motion: EgoMotion = inbox.decode(&arrival, &Limits::DEFAULT).unwrap();
        let (speed_mps, yaw_rate_rad_s) =
            (motion.speed_mps.unwrap(), motion.yaw_rate_rad_s.unwrap());
        assert!(
            (speed_mps - 5.0).abs() < 1e-9 && (yaw_rate_rad_s + 0.5).abs() < 1e-9,
            "{motion:?}"
        );
        stop.request();
        let report = node.join().unwrap();
        let [odom, imu] = ["/odom", "/imu"].map(|topic| report.motion[topic]);
        assert!(
            odom.read >= 2 && odom.unreadable >= 1 && imu.read >= 2 && imu.unreadable == 0,
            "{report:?}"
        );
        assert!(
            !report.is_complete() && report.lidar.is_complete(),
            "{report:?}"
        );
    });
}
