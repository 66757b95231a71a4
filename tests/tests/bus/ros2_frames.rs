//! Two nodes in one ROS 2 network: frames and clock of each fleet are its own.

use bus::PublisherOptions;
use bus::shutdown::Stop;
use deploy::ros::NodeOptions;
use protocol::{Pose, PoseEstimate, Role, Stream, Topic};
use ros2::Distribution;
use tests::bus::{TestRouter, wait_for};

use super::ros2::{
    CLOCK, CLOCK_HASH, DOMAIN, Fields, Subscriber, TF, TF_HASH, cav, key, other_node, start_within,
    tokens,
};

#[test]
fn nodes_of_two_namespaces_share_no_frame_and_one_of_them_has_the_clock() {
    let (router, stop) = (TestRouter::open(), Stop::new());
    let vehicle = router.join("agent-1000", "1000");
    std::thread::scope(|scope| {
        let other = other_node(&router);
        let clocks = || {
            tokens(
                &other,
                &format!("@ros2_lv/{DOMAIN}/*/*/*/MP/*/*/*/%clock/**"),
            )
        };
        let start = |namespace: &str| {
            let options = (
                Some(namespace.parse().unwrap()),
                Distribution::Jazzy,
                NodeOptions::default(),
            );
            let node = start_within(scope, &router, options, &stop);
            let token = format!("/MP/%/{}/v2vloc/%tf/", namespace.replace('/', "%"));
            wait_for("the node", || {
                let found = tokens(&other, &format!("@ros2_lv/{DOMAIN}/**"));
                found.iter().any(|found| found.contains(&token))
            });
            node
        };
        let tf = Subscriber::open(&other, &key("tf", TF, TF_HASH));
        let clock = Subscriber::open(&other, &key("clock", CLOCK, CLOCK_HASH));
        let nodes = [start("/a"), start("/b")];
        assert_eq!(clocks().len(), 1, "{:?}", clocks());
        let _alive = vehicle.announce(Role::Agent).unwrap();
        let pose = Topic::Stream {
            cav: cav(),
            stream: Stream::Pose,
        };
        let pose = vehicle.publisher(pose, PublisherOptions::POSE).unwrap();
        pose.submit(7, PoseEstimate::new(Pose::IDENTITY, 0.9));
        let mut frames = [tf.next(), tf.next()].map(|(message, _)| {
            let mut fields = Fields::of(&message);
            assert_eq!((fields.u32(), fields.nanos()), (1, 7));
            assert_eq!(fields.text(), "map");
            fields.text()
        });
        frames.sort();
        assert_eq!(frames, ["a/cav_1000/lidar", "b/cav_1000/lidar"]);
        assert_eq!(Fields::of(&clock.next().0).nanos(), 7);
        pose.finish();
        stop.request();
        let published: u64 = nodes
            .map(|node| node.join().unwrap().published.get("/clock").copied())
            .iter()
            .flatten()
            .sum();
        assert_eq!(published, 1);
    });
}
