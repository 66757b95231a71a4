//! Learnt compressor between vehicles: its code is transmitted, and the ego detects what it would from the compressor's
//! output.

use std::path::{Path, PathBuf};
use std::time::Instant;

use agent::agent::{Agent, AgentInput};
use agent::node as agent_node;
use bus::bounded_queue::Pop;
use bus::shutdown::Stop;
use bus::{Event, Route};
use dataset::{self, LoadOptions};
use ego_fuser::ego::{Content, Ego, View};
use ego_fuser::node as ego_node;
use fusion::Method;
use localization::pose_source::RecordedPose;
use perception::detector::Detector;
use protocol::codec::encode_features;
use protocol::message::Bev;
use protocol::{
    CavId, CodecConfig, DecodedFeatures, Detection, Detections, DropReason, HEADER_LEN, Ledger,
    Limits, Stream, Topic,
};
use sim_replay::stream::{Replay, StreamOptions};
use tch::Device;
use tests::bus::{TIMEOUT, TestRouter, ego_options, stream_options};
use tests::{networks, scene};

const AGENTS: [&str; 2] = ["10", "20"];
const TICKS: usize = 4;
/// `[64, 32, 64]` as `f32`.
const WHOLE_BYTES: u64 = 4 * 64 * 32 * 64;

fn cav(name: &str) -> CavId {
    CavId::new(name).unwrap()
}

fn topic(name: &str, stream: Stream) -> Topic {
    Topic::Stream {
        cav: cav(name),
        stream,
    }
}

fn weights_file(folder: &Path, compress_ratio: Option<i64>) -> PathBuf {
    networks::write(folder, Method::MAX, compress_ratio)
}

fn agent(name: &str, weights: &Path) -> Agent {
    Agent::new(
        cav(name),
        Box::new(RecordedPose),
        Detector::load(weights, Device::Cpu).unwrap(),
    )
}

fn ego(weights: &Path) -> Ego {
    Ego::load(weights, None, Device::Cpu).unwrap()
}

/// Without any network: boxes of every tick, and the bytes of a neighbour's feature map.
fn offline(folder: &Path, weights: &Path) -> (Vec<Vec<Detection>>, u64) {
    let scenario = dataset::open(folder).unwrap().scenarios.remove(0);
    let mut agents = AGENTS.map(|name| agent(name, weights));
    let mut ego = ego(weights);
    let (mut results, mut bytes) = (Vec::new(), 0);
    for tick in 0..scenario.ticks.len() {
        let views: Vec<View> = (agents.iter_mut().enumerate())
            .map(|(index, agent)| {
                let frame = scenario.load(index, tick, &LoadOptions::default()).unwrap();
                let measured_pose = frame.world_from_lidar.as_ref();
                let input = AgentInput {
                    capture_nanos: frame.capture_nanos,
                    cloud: &frame.points,
                    measured_pose,
                    motion: frame.motion(),
                };
                let output = agent.process(&input).unwrap();
                let features = output.perception.features;
                bytes = 4 * features.values.len() as u64;
                let content = Content::Features(DecodedFeatures {
                    features,
                    sent: None,
                });
                View {
                    cav: agent.cav().clone(),
                    pose: output.pose,
                    capture_nanos: frame.capture_nanos,
                    content,
                }
            })
            .collect();
        let output = ego.detect(&views[0], &views[1..]).unwrap();
        assert_eq!(output.fused, [0]);
        results.push(output.detections);
    }
    (results, bytes)
}

/// Over real sessions, in step with the ego, the neighbour with weights of its own; and the sum of all ledgers.
fn live(folder: &Path, weights: &Path, of_neighbour: &Path) -> (Vec<Detections>, Ledger) {
    let scenario = dataset::open(folder).unwrap().scenarios.remove(0);
    let (router, stop) = (TestRouter::open(), Stop::new());
    std::thread::scope(|scope| {
        let scorer = router.join("scorer", "scorer");
        let inbox = scorer.inbox(100, 1);
        let _listening = scorer
            .subscribe(topic("10", Stream::Detections), &inbox)
            .unwrap();
        for (name, weights) in AGENTS.into_iter().zip([weights, of_neighbour]) {
            let (router, stop, agent) = (&router, stop.clone(), agent(name, weights));
            scope.spawn(move || {
                let bus = router.join(&format!("agent-{name}"), name);
                agent_node::run(&bus, agent, &agent_node::NodeOptions::default(), &stop).unwrap();
                bus.leave(TIMEOUT).unwrap();
            });
        }
        let (own_stop, ego) = (stop.clone(), ego(weights));
        let router = &router;
        let ego = scope.spawn(move || {
            let bus = router.join("ego-10", "10");
            let options = ego_node::NodeOptions {
                ..ego_options(TIMEOUT)
            };
            ego_node::run(&bus, &cav("10"), ego, &options, &own_stop).unwrap();
            let stats = bus.stats().clone();
            bus.leave(TIMEOUT).unwrap();
            stats.ledger()
        });
        let replay = router.join("replay", "replay");
        let to_ego = AGENTS.map(|name| (topic(name, Stream::Bev), "ego-10"));
        let routes = to_ego
            .into_iter()
            .chain([(topic("10", Stream::Detections), "scorer")]);
        let options = StreamOptions {
            expect: routes
                .map(|(topic, receiver)| Route {
                    topic,
                    receiver: receiver.parse().unwrap(),
                })
                .collect(),
            lockstep: vec![cav("10")],
            agents: AGENTS.map(cav).into(),
            ..stream_options()
        };
        let playing = Replay::prepare(&replay, &scenario, options, &Stop::new()).unwrap();
        playing.wait_until_ready().unwrap();
        assert!(playing.play().is_complete());
        replay.leave(TIMEOUT).unwrap();
        let mut results = Vec::new();
        while results.len() < TICKS
            && let Pop::Item(_, Event::Message(arrival)) =
                inbox.take(Some(Instant::now() + TIMEOUT))
        {
            results.push(inbox.decode(&arrival, &Limits::DEFAULT).unwrap());
        }
        scorer.leave(TIMEOUT).unwrap();
        (results, ego.join().unwrap())
    })
}

#[test]
fn the_code_is_transmitted_and_offline_and_live_detect_the_same_boxes() {
    tch::set_num_threads(1);
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, TICKS);
    for (compress_ratio, expected_bytes) in [(None, WHOLE_BYTES), (Some(16), WHOLE_BYTES / 16)] {
        let weights = weights_file(folder.path(), compress_ratio);
        let (offline, bytes) = offline(folder.path(), &weights);
        assert_eq!(bytes, expected_bytes);
        let (live, ledger) = live(folder.path(), &weights, &weights);
        assert_eq!((live.len(), ledger.total().dropped_total()), (TICKS, 0));
        for (live, offline) in live.iter().zip(&offline) {
            assert!(!live.detections.is_empty());
            assert_eq!(
                &live.detections, offline,
                "ratio {compress_ratio:?}, frame {}",
                live.agent_frame
            );
            let metadata = live.fused[0].payload_bytes - expected_bytes;
            assert!(
                (60..200).contains(&metadata),
                "{metadata} bytes beside the map"
            );
        }
    }
}

#[test]
fn a_map_of_another_compressor_is_left_out_by_its_shape() {
    tch::set_num_threads(1);
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, TICKS);
    let [own, of_neighbour] = [Some(16), None].map(|ratio| weights_file(folder.path(), ratio));
    let (results, ledger) = live(folder.path(), &own, &of_neighbour);
    assert!(results.iter().all(|result| result.fused.is_empty()));
    let dropped = ledger.total().dropped;
    assert_eq!(
        dropped.get(&DropReason::Shape).copied(),
        Some(TICKS as u64),
        "{dropped:?}"
    );
}

#[test]
fn the_message_of_a_code_names_its_channels() {
    tch::set_num_threads(1);
    let folder = tempfile::tempdir().unwrap();
    let mut agent = agent("10", &weights_file(folder.path(), Some(16)));
    let seen = agent
        .perceive(&protocol::PointCloud {
            xyzi: vec![[5.0, 1.0, -1.0, 0.5]],
        })
        .unwrap();
    let codec = CodecConfig::default();
    let features = encode_features(seen.features, &codec, Some(&seen.confidence)).unwrap();
    let (grid, pose) = (
        features.grid,
        protocol::PoseEstimate::new(protocol::Pose::IDENTITY, 1.0),
    );
    let stamp = protocol::Stamp {
        cav: cav("10"),
        epoch: 0,
        sequence: 0,
        capture_nanos: 0,
        publish_nanos: 0,
    };
    let bytes = protocol::wire::encode(&stamp, Bev { pose, features })
        .unwrap()
        .to_vec();
    assert!(bytes.len() as u64 - WHOLE_BYTES / 16 < 200 + HEADER_LEN as u64);
    let (_, message): (_, Bev) =
        protocol::wire::decode([bytes.as_slice()], &Limits::DEFAULT).unwrap();
    assert_eq!(message.features.check_shape(&grid, 4, Some(64)), Ok(()));
    for (channels, code_of) in [(4, None), (4, Some(128)), (64, None)] {
        let error = message
            .features
            .check_shape(&grid, channels, code_of)
            .unwrap_err();
        assert_eq!(error.drop_reason(), DropReason::Shape, "{error}");
    }
}
