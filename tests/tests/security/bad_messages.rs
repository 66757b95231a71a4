//! Every kind of invalid message from a neighbour, through real sessions: refused, counted under its name, and the
//! ego's detections are bit for bit those without them.

use std::collections::BTreeMap;

use agent::agent::{Agent, AgentInput};
use bus::shutdown::Stop;
use bus::{Barrier, Bus, Event, LivelinessToken, PublisherOptions, Route, process_id, unix_nanos};
use dataset::{self, LoadOptions, Scenario};
use ego_fuser::ego::Ego;
use ego_fuser::node::{self, NodeOptions};
use fusion::Method;
use localization::pose_source::RecordedPose;
use perception::detector::Detector;
use perception::model_config::DetectorConfig;
use perception::pillars::point_pillars::PointPillars;
use protocol::message::Bev;
use protocol::{
    Account, BevFeatures, BevGrid, Body, CavId, Codec, CodecConfig, Compression, Counts, Detection,
    Detections, DropReason, Dtype, EncodedFeatures, HEADER_LEN, Ledger, Limits, PoseEstimate, Role,
    Selection, Stamp, Stream, Topic, encode_features, wire,
};
use tch::Device;
use tch::nn::VarStore;
use tests::bus::{TIMEOUT, TestRouter, ego_options, next_event, wait_for};
use tests::locks::random_generator_lock;
use tests::mutation::wire_target::reseal;
use tests::scene;
use zenoh::Wait;

const TICKS: usize = 4;
const HOUR_NANOS: u64 = 3_600_000_000_000;

fn cav(text: &str) -> CavId {
    CavId::new(text).unwrap()
}

fn bev_of(name: &str) -> Topic {
    Topic::Stream {
        cav: cav(name),
        stream: Stream::Bev,
    }
}

/// The same network every time.
fn network() -> Detector {
    let _generator = random_generator_lock();
    tch::manual_seed(5);
    let config = DetectorConfig {
        lidar_range_m: [-25.6, -12.8, -3.0, 25.6, 12.8, 1.0],
        ..DetectorConfig::lean()
    };
    let variables = VarStore::new(Device::Cpu);
    let pillars = PointPillars::new(&variables.root(), &config).unwrap();
    let _ = tch::no_grad(|| {
        variables.variables()["cls_head.bias"]
            .shallow_clone()
            .fill_(0.3)
    });
    Detector::from_network(pillars)
}

/// A vehicle whose messages the test writes itself.
struct Neighbour {
    bus: Bus,
    agent: Agent,
    place: usize,
    sequence: u64,
    sent: Vec<Vec<u8>>,
    _presence: LivelinessToken,
}

impl Neighbour {
    fn join(router: &TestRouter, name: &str, place: usize) -> Self {
        let bus = router.join(&format!("agent-{name}"), name);
        let presence = bus.announce(Role::Agent).unwrap();
        // It probes its route; its messages are put by the test.
        let publisher = bus
            .publisher(bev_of(name), PublisherOptions::FEATURES)
            .unwrap();
        let route = Route {
            topic: bev_of(name),
            receiver: "ego-10".parse().unwrap(),
        };
        Barrier::new([route])
            .await_routes(&bus)
            .unwrap()
            .wait(TIMEOUT)
            .unwrap();
        drop(publisher);
        let agent = Agent::new(cav(name), Box::new(RecordedPose), network());
        Self {
            bus,
            agent,
            place,
            sequence: 0,
            sent: Vec::new(),
            _presence: presence,
        }
    }

    fn stamp(&mut self, capture_nanos: u64) -> Stamp {
        self.sequence += 1;
        let cav = self.agent.cav().clone();
        Stamp {
            cav,
            epoch: 77,
            sequence: self.sequence,
            capture_nanos,
            publish_nanos: unix_nanos(),
        }
    }

    fn see(&mut self, scenario: &Scenario, tick: usize) -> (u64, PoseEstimate, BevFeatures) {
        let frame = scenario
            .load(self.place, tick, &LoadOptions::default())
            .unwrap();
        // Late enough for earlier times to exist.
        let capture_nanos = HOUR_NANOS + scenario.ticks[tick].capture_nanos;
        let measured_pose = frame.world_from_lidar.as_ref();
        let output = self
            .agent
            .process(&AgentInput {
                capture_nanos,
                cloud: &frame.points,
                measured_pose,
                motion: frame.motion(),
            })
            .unwrap();
        (capture_nanos, output.pose, output.perception.features)
    }

    fn put(&self, bytes: Vec<u8>) {
        let key = self.bus.key(bev_of(self.agent.cav().as_str())).to_string();
        let congestion = zenoh::qos::CongestionControl::Block;
        self.bus
            .session()
            .put(&key, bytes)
            .congestion_control(congestion)
            .wait()
            .unwrap();
    }

    fn send(&mut self, scenario: &Scenario, tick: usize) {
        let (capture_nanos, pose, features) = self.see(scenario, tick);
        let stamp = self.stamp(capture_nanos);
        let bytes = sealed(&stamp, pose, features);
        self.sent.push(bytes.clone());
        self.put(bytes);
    }

    /// Every kind of invalid message, with the expected drop reason. All of them after a message of `tick`.
    fn bad(
        &mut self,
        scenario: &Scenario,
        tick: usize,
    ) -> Vec<(&'static str, DropReason, Vec<u8>)> {
        let (seen, pose, features) = self.see(scenario, tick);
        // With a capture time of its own, as a second message of one time is a duplicate whatever its content.
        let now = seen + 10_000_000;
        let mut fresh = |capture: u64| sealed(&self.stamp(capture), pose, features.clone());
        let [_, y, z] = pose.world_from_cav().unwrap().translation_m;
        let [qw, qx, ..] = pose.world_from_cav().unwrap().rotation_wxyz;
        let mut bad = vec![
            (
                "a future stamp",
                DropReason::Future,
                fresh(now + HOUR_NANOS),
            ),
            (
                "a stamp of long ago",
                DropReason::Stale,
                fresh(now - 1_000_000_000),
            ),
            ("truncated", DropReason::Decode, fresh(now)[..5000].to_vec()),
            (
                "a flipped bit in the map",
                DropReason::Checksum,
                changed(fresh(now), 9000, |byte| byte ^ 4),
            ),
            (
                "a flipped bit in the header",
                DropReason::Checksum,
                changed(fresh(now), 50, |byte| byte ^ 4),
            ),
            (
                "wrong version",
                DropReason::Version,
                resealed(changed(fresh(now), 4, |byte| byte + 1)),
            ),
            (
                "a body of 2^42 bytes",
                DropReason::Shape,
                claiming(fresh(now), 1 << 42),
            ),
            (
                "15 bytes",
                DropReason::Decode,
                (1_u64 << 42).to_le_bytes().repeat(2)[..15].to_vec(),
            ),
        ];
        for (name, number) in [
            ("NaN in a pose", f64::NAN),
            ("infinity in a pose", f64::INFINITY),
            ("1e30 in a pose", 1e30),
        ] {
            bad.push((
                name,
                DropReason::NotFinite,
                with_number(fresh(now), [y, z], number),
            ));
        }
        bad.push((
            "a pose that is no rotation",
            DropReason::NotFinite,
            with_number(fresh(now), [qw, qx], 1.5 * qw),
        ));
        for (name, number) in [
            ("NaN", f32::NAN),
            ("infinity", f32::INFINITY),
            ("1e30", 1e30),
        ] {
            let mut features = features.clone();
            features.values[4321] = number;
            bad.push((
                name,
                DropReason::NotFinite,
                sealed(&self.stamp(now), pose, features),
            ));
        }
        let wrong_name = Stamp {
            cav: cav("30"),
            ..self.stamp(now)
        };
        bad.push((
            "another's name",
            DropReason::Identity,
            sealed(&wrong_name, pose, features.clone()),
        ));
        let fewer = BevFeatures {
            channels: 1,
            values: features.values[..features.grid.cells()].to_vec(),
            ..features
        };
        bad.push((
            "another shape",
            DropReason::Shape,
            sealed(&self.stamp(now), pose, fewer.clone()),
        ));
        let wider = BevGrid {
            cell_m: 2.0 * fewer.grid.cell_m,
            ..fewer.grid
        };
        bad.push((
            "another BEV grid",
            DropReason::Shape,
            sealed(
                &self.stamp(now),
                pose,
                BevFeatures {
                    grid: wider,
                    ..fewer
                },
            ),
        ));
        bad.push((
            "a compression bomb",
            DropReason::Decode,
            bomb(&self.stamp(now), pose, wider),
        ));
        let replayed = self.sent.last().cloned().unwrap_or_default();
        bad.push(("a replayed frame", DropReason::Duplicate, replayed));
        bad
    }
}

fn sealed(stamp: &Stamp, pose: PoseEstimate, features: BevFeatures) -> Vec<u8> {
    let features = encode_features(features, &CodecConfig::default(), None).unwrap();
    wire::encode(stamp, Bev { pose, features })
        .unwrap()
        .to_vec()
}

fn changed(mut bytes: Vec<u8>, at: usize, change: impl Fn(u8) -> u8) -> Vec<u8> {
    bytes[at] = change(bytes[at]);
    bytes
}

fn resealed(mut bytes: Vec<u8>) -> Vec<u8> {
    reseal(&mut bytes, false);
    bytes
}

fn claiming(mut bytes: Vec<u8>, body_len: u64) -> Vec<u8> {
    bytes[72..80].copy_from_slice(&body_len.to_le_bytes());
    resealed(bytes)
}

/// The message with another number in place of the first of two that follow each other in its metadata.
fn with_number(mut bytes: Vec<u8>, old: [f64; 2], new: f64) -> Vec<u8> {
    let old = old.map(f64::to_le_bytes).concat();
    let metadata = &bytes[HEADER_LEN..];
    let at = metadata
        .windows(16)
        .position(|window| window == old)
        .expect("the number is in there");
    bytes[HEADER_LEN + at..][..8].copy_from_slice(&new.to_le_bytes());
    resealed(bytes)
}

/// A few kilobytes that decompress to 64 MiB, where 8 KiB are announced.
fn bomb(stamp: &Stamp, pose: PoseEstimate, grid: BevGrid) -> Vec<u8> {
    let zeros = zstd::bulk::compress(&vec![0; 64 << 20], 1).unwrap();
    let codec = Codec {
        dtype: Dtype::F32,
        selection: Selection::Dense,
        compression: Compression::Zstd,
    };
    let features = EncodedFeatures {
        grid,
        channels: 1,
        code_of: None,
        codec,
        rate: None,
        body: Body::Bytes(zeros),
    };
    wire::encode(stamp, Bev { pose, features })
        .unwrap()
        .to_vec()
}

/// Plays the scene; the ego's detections, and its counters for the messages of 20.
fn play(
    scenario: &Scenario,
    is_hostile: bool,
) -> (Vec<Vec<Detection>>, Counts, BTreeMap<DropReason, u64>) {
    let (router, stop) = (TestRouter::open(), Stop::new());
    let scorer = router.join("scorer", "scorer");
    let inbox = scorer.inbox(100, 1);
    let detections = Topic::Stream {
        cav: cav("10"),
        stream: Stream::Detections,
    };
    let _subscription = scorer.subscribe(detections, &inbox).unwrap();
    std::thread::scope(|scope| {
        let bus = router.join("ego-10", "10");
        let stats = bus.stats().clone();
        let ego = scope.spawn(|| {
            let bus = bus;
            let options = NodeOptions {
                keeps_running: true,
                ..ego_options(TIMEOUT)
            };
            let ego = Ego::new(network(), Method::MAX).unwrap();
            node::run(&bus, &cav("10"), ego, &options, &stop).unwrap();
            let stats = bus.stats().clone();
            bus.leave(TIMEOUT).unwrap();
            stats.ledger()
        });
        let mut own = Neighbour::join(&router, "10", 0);
        let mut other = Neighbour::join(&router, "20", 1);
        let (mut results, mut expected) = (Vec::new(), BTreeMap::new());
        for tick in 0..scenario.ticks.len() {
            if is_hostile && tick > 0 {
                for (name, reason, bytes) in other.bad(scenario, tick - 1) {
                    *expected.entry(reason).or_default() += 1;
                    other.put(bytes);
                    // One at a time: if many wait, the newest replaces the oldest unread.
                    let all: u64 = expected.values().sum();
                    wait_for(name, || counts(&stats.ledger()).dropped_total() == all);
                    let counts = counts(&stats.ledger());
                    assert_eq!(
                        counts.dropped.get(&reason),
                        expected.get(&reason),
                        "{name}: {counts:?}"
                    );
                }
            }
            other.send(scenario, tick);
            own.send(scenario, tick);
            let (_, Event::Message(arrival)) = next_event(&inbox) else {
                panic!("an end")
            };
            let result: Detections = inbox.decode(&arrival, &Limits::DEFAULT).unwrap();
            assert_eq!(
                result.fused.len(),
                1,
                "the sound message is fused: {:?}",
                result.skipped
            );
            results.push(result.detections);
        }
        stop.request();
        (results, counts(&ego.join().unwrap()), expected)
    })
}

/// The ego's counters for the messages of 20.
fn counts(ledger: &Ledger) -> Counts {
    let account = Account::towards(bev_of("20"), &process_id(Role::Ego, &cav("10")));
    ledger.get(&account).cloned().unwrap_or_default()
}

#[test]
fn bad_messages_are_refused_counted_and_named_and_change_nothing() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &["10", "20"], TICKS);
    let scenario = dataset::open(folder.path()).unwrap().scenarios.remove(0);
    let (undisturbed, quiet, nothing) = play(&scenario, false);
    assert!(quiet.dropped.is_empty() && nothing.is_empty(), "{quiet:?}");
    let (attacked, counted, expected) = play(&scenario, true);
    assert!(
        undisturbed.iter().any(|detections| !detections.is_empty()),
        "nothing to compare"
    );
    assert_eq!(undisturbed, attacked, "the same boxes, so the same AP");
    assert_eq!(counted.dropped, expected);
    assert_eq!(counted.received, TICKS as u64);
    assert!(
        expected.len() >= 9,
        "every reason that a message's contents can give: {expected:?}"
    );
}
