//! Fleet through real zenoh sessions: replay, agents and ego in one process, each with a session of its own.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::thread::{Scope, ScopedJoinHandle};
use std::time::{Duration, Instant};

use agent::agent::{Agent, AgentInput};
use agent::agent_loop::LoopOptions;
use agent::node as agent_node;
use agent::rate::RateConfig;
use bus::bounded_queue::Pop;
use bus::shutdown::Stop;
use bus::{Bus, Event, Inbox, PublisherOptions, Route, Subscription, process_id};
use dataset::{self, LoadOptions, Scenario};
use ego_fuser::ego::{Content, Ego, View};
use ego_fuser::node as ego_node;
use fusion::Exchange;
use fusion::Method;
use localization::pose_source::RecordedPose;
use perception::detector::Detector;
use protocol::message::{Descriptor, ModelHash, SweepArrival};
use protocol::{
    Account, CavId, DecodedFeatures, Detection, Detections, DropReason, Ledger, Limits, RateReason,
    Stream, Topic,
};
use recording::Recording;
use sim_replay::recorder::{self, RecordReport};
use sim_replay::stream::{Replay, StreamOptions};
use tch::Device;
use tests::bus::{
    TIMEOUT, TestRouter, ego_options, next_event, recorder_config, stream_options, wait_for,
};
use tests::{networks, scene};
use zenoh::Wait;

const AGENTS: [&str; 3] = ["10", "20", "30"];
const TICKS: usize = 6;

pub(super) fn cav(text: &str) -> CavId {
    CavId::new(text).unwrap()
}

pub(super) fn topic(cav_id: &str, stream: Stream) -> Topic {
    Topic::Stream {
        cav: cav(cav_id),
        stream,
    }
}

/// Weights of a method, the same every time.
fn weights(method: Method) -> PathBuf {
    static WRITING: Mutex<()> = Mutex::new(());
    let _writing = WRITING.lock();
    networks::write(Path::new(env!("CARGO_TARGET_TMPDIR")), method, None)
}

fn detector(method: Method) -> Detector {
    tch::set_num_threads(1);
    Detector::load(&weights(method), Device::Cpu).unwrap()
}

pub(super) fn ego(method: Method) -> Ego {
    tch::set_num_threads(1);
    Ego::load(&weights(method), None, Device::Cpu).unwrap()
}

pub(super) fn agent(cav_id: &str, method: Method) -> Agent {
    Agent::new(cav(cav_id), Box::new(RecordedPose), detector(method))
}

fn published(method: Method) -> Stream {
    method.own_content().stream()
}

/// Runs an agent on a session of its own until `stop`; returns its ledger.
fn run_agent<'scope>(
    scope: &'scope Scope<'scope, '_>,
    router: &'scope TestRouter,
    cav_id: &'static str,
    method: Method,
    rate: RateConfig,
    stop: &Stop,
) -> ScopedJoinHandle<'scope, Ledger> {
    let stop = stop.clone();
    scope.spawn(move || {
        let bus = router.join(&format!("agent-{cav_id}"), cav_id);
        let options = agent_node::NodeOptions {
            of_loop: LoopOptions {
                publish: vec![published(method)],
                rate,
                ..LoopOptions::default()
            },
            ..agent_node::NodeOptions::default()
        };
        let report = agent_node::run(&bus, agent(cav_id, method), &options, &stop).unwrap();
        assert_eq!(report.failed, 0);
        leave(bus)
    })
}

fn leave(bus: Bus) -> Ledger {
    let stats = bus.stats().clone();
    bus.leave(TIMEOUT).unwrap();
    stats.ledger()
}

/// Receives an ego's detections until it ends.
fn collect<'scope>(
    scope: &'scope Scope<'scope, '_>,
    router: &'scope TestRouter,
    ego: &'static str,
) -> ScopedJoinHandle<'scope, (Vec<(u64, Detections)>, Ledger)> {
    let bus = router.join("scorer", "scorer");
    let inbox = bus.inbox(1000, 2);
    let subscription = bus
        .subscribe(topic(ego, Stream::Detections), &inbox)
        .unwrap();
    scope.spawn(move || {
        let mut results = Vec::new();
        loop {
            match inbox.take(Some(Instant::now() + TIMEOUT)) {
                Pop::Item(_, Event::Message(arrival)) => {
                    let result: Detections = inbox.decode(&arrival, &Limits::DEFAULT).unwrap();
                    bus.stats().received(&arrival.topic);
                    results.push((arrival.header.stamp.capture_nanos, result));
                }
                Pop::Item(_, Event::End { .. }) => break,
                other => panic!("{other:?}"),
            }
        }
        drop(subscription);
        (results, leave(bus))
    })
}

/// Vehicles with a part in a method: ego-only methods need no other.
fn taking_part(method: Method) -> &'static [&'static str] {
    if method == Method::NONE {
        &AGENTS[..1]
    } else {
        &AGENTS
    }
}

/// Plays the scene in step with the ego, whose neighbours keep within `rate`; returns the ego's results and the sum of
/// all ledgers.
fn play_in_lockstep(
    dir: &Path,
    method: Method,
    rate: RateConfig,
) -> (Vec<(u64, Detections)>, Ledger) {
    play_and_record(dir, method, rate, None)
}

/// Records a run until `stop`.
fn record<'scope>(
    scope: &'scope Scope<'scope, '_>,
    router: &'scope TestRouter,
    file: &Path,
    stop: &Stop,
) -> ScopedJoinHandle<'scope, RecordReport> {
    let (out, stop) = (file.to_path_buf(), stop.clone());
    scope.spawn(move || {
        let bus = router.join("recorder", "recorder");
        let config = recorder_config(&bus, out);
        let report = recorder::record(&bus, &config, &stop, &mut |_| {}).unwrap();
        bus.leave(TIMEOUT).unwrap();
        report
    })
}

/// [`play_in_lockstep`], with every message recorded in a file.
fn play_and_record(
    dir: &Path,
    method: Method,
    rate: RateConfig,
    file: Option<&Path>,
) -> (Vec<(u64, Detections)>, Ledger) {
    let scenario = dataset::open(dir).unwrap().scenarios.remove(0);
    let (router, stop) = (TestRouter::open(), Stop::new());
    let stream = published(method);
    std::thread::scope(|scope| {
        let listening = collect(scope, &router, "10");
        let (recorded, ending) = (Stop::new(), Stop::new());
        let recorder = file.map(|file| record(scope, &router, file, &recorded));
        let start = |cav_id: &&'static str| {
            let rate = if *cav_id == "10" {
                RateConfig::default()
            } else {
                rate
            };
            run_agent(scope, &router, cav_id, method, rate, &stop)
        };
        let agents: Vec<_> = taking_part(method).iter().map(start).collect();
        let ego = scope.spawn(|| {
            let bus = router.join("ego-10", "10");
            let options = ego_node::NodeOptions {
                ..ego_options(TIMEOUT)
            };
            let report = ego_node::run(&bus, &cav("10"), ego(method), &options, &stop).unwrap();
            assert_eq!(
                (report.frames, report.at_deadline, report.failed),
                (TICKS as u64, 0, 0)
            );
            leave(bus)
        });
        let replay = router.join("replay", "replay");
        let route = |cav_id: &&str| Route {
            topic: topic(cav_id, stream),
            receiver: "ego-10".parse().unwrap(),
        };
        let expect = taking_part(method).iter().map(route);
        let scorer = Route {
            topic: topic("10", Stream::Detections),
            receiver: "scorer".parse().unwrap(),
        };
        let options = StreamOptions {
            expect: expect
                .chain([scorer])
                .chain(file.iter().flat_map(|_| to_recorder(method, stream)))
                .collect(),
            lockstep: vec![cav("10")],
            agents: taking_part(method)
                .iter()
                .map(|cav_id| cav(cav_id))
                .collect(),
            ..stream_options()
        };
        let playing = Replay::prepare(&replay, &scenario, options, &ending).unwrap();
        playing.wait_until_ready().unwrap();
        let report = playing.play();
        assert!(
            report.is_complete() && report.ticks == TICKS as u64,
            "{report:?}"
        );
        let mut ledger = leave(replay);
        agents
            .into_iter()
            .for_each(|agent| ledger.merge(&agent.join().unwrap()));
        ledger.merge(&ego.join().unwrap());
        let (results, ledger_of_scorer) = listening.join().unwrap();
        ledger.merge(&ledger_of_scorer);
        recorded.request();
        if let Some(report) = recorder.map(|recorder| recorder.join().unwrap()) {
            assert!(report.is_complete() && report.messages > 0, "{report:?}");
        }
        (results, ledger)
    })
}

/// The routes to a recorder that must receive everything from the beginning.
fn to_recorder(method: Method, stream: Stream) -> Vec<Route> {
    let streams = [Stream::Lidar, Stream::Gnss, Stream::Pose, stream];
    let vehicles = taking_part(method)
        .iter()
        .flat_map(|cav_id| streams.map(|stream| topic(cav_id, stream)));
    let topics = vehicles.chain([Topic::Truth, topic("10", Stream::Detections)]);
    topics
        .map(|topic| Route {
            topic,
            receiver: "recorder".parse().unwrap(),
        })
        .collect()
}

#[test]
fn a_recorded_run_replayed_gives_the_same_detections() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, TICKS);
    for method in [Method::MAX, Method::LATE] {
        let file = folder.path().join(format!("{method}.mcap"));
        let (live, ledger) =
            play_and_record(folder.path(), method, RateConfig::default(), Some(&file));
        assert!(
            ledger.balance().is_exact(),
            "{method}: a recorder is outside the accounting"
        );
        let recording = Recording::open(&file).unwrap();
        assert_eq!(recording.damage(), []);
        let recorded = |stream| {
            recording
                .entries()
                .iter()
                .filter(|entry| entry.key.topic == topic("10", stream))
                .count()
        };
        assert_eq!(
            [Stream::Lidar, Stream::Pose, Stream::Detections].map(recorded),
            [TICKS; 3],
            "{method}"
        );
        let (again, _) = play_in_lockstep(&file, method, RateConfig::default());
        assert_eq!(live.len(), again.len(), "{method}");
        assert!(
            live.iter().any(|(_, result)| !result.detections.is_empty()),
            "{method}: nothing to compare"
        );
        for ((capture, live), (again_capture, again)) in live.iter().zip(&again) {
            assert_eq!(
                (capture, live.pose),
                (again_capture, again.pose),
                "{method}"
            );
            assert_eq!(live.fused, again.fused, "{method} at {capture}");
            assert_eq!(live.detections, again.detections, "{method} at {capture}");
        }
    }
}

/// The same pipelines without any network.
fn play_offline(scenario: &Scenario, method: Method) -> Vec<(u64, Vec<Detection>)> {
    let mut agents: Vec<Agent> = AGENTS.iter().map(|cav_id| agent(cav_id, method)).collect();
    let mut ego = ego(method);
    let mut results = Vec::new();
    for (tick_index, tick) in scenario.ticks.iter().enumerate() {
        let views: Vec<View> = (agents.iter_mut().enumerate())
            .map(|(index, agent)| {
                let frame = scenario
                    .load(index, tick_index, &LoadOptions::default())
                    .unwrap();
                let input = AgentInput {
                    capture_nanos: tick.capture_nanos,
                    cloud: &frame.points,
                    measured_pose: frame.world_from_lidar.as_ref(),
                    motion: frame.motion(),
                };
                let output = agent.process(&input).unwrap();
                let content = match method.own_content() {
                    Exchange::Boxes => {
                        let detections = output.perception.detections;
                        let boxes = agent.boxes(input.capture_nanos, output.pose, detections);
                        Content::Boxes(boxes.into_objects())
                    }
                    Exchange::Points => Content::Points(agent.share_points(&frame.points)),
                    Exchange::Features | Exchange::Nothing => Content::Features(DecodedFeatures {
                        features: output.perception.features,
                        sent: None,
                    }),
                };
                View {
                    cav: agent.cav().clone(),
                    pose: output.pose,
                    capture_nanos: tick.capture_nanos,
                    content,
                }
            })
            .collect();
        let detected = ego.detect(&views[0], &views[1..]).unwrap();
        results.push((tick.capture_nanos, detected.detections));
    }
    results
}

#[test]
fn live_in_lockstep_equals_offline_bit_by_bit_and_the_ledgers_balance() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, TICKS);
    let scenario = dataset::open(folder.path()).unwrap().scenarios.remove(0);
    for method in Method::ALL {
        let (live, ledger) = play_in_lockstep(folder.path(), method, RateConfig::default());
        let offline = play_offline(&scenario, method);
        assert!(
            offline.iter().any(|(_, detections)| !detections.is_empty()),
            "{method}: nothing to compare"
        );
        assert_eq!(live.len(), offline.len(), "{method}");
        for (tick, ((live_capture, live), (capture, offline))) in
            live.iter().zip(&offline).enumerate()
        {
            assert_eq!(live.agent_frame, tick as u64, "{method}");
            assert_eq!(
                (live_capture, live.detections.len()),
                (capture, offline.len()),
                "{method}"
            );
            for (live, offline) in live.detections.iter().zip(offline) {
                assert_eq!(live, offline, "{method} at {capture}");
            }
        }
        let expected = taking_part(method).len() - 1;
        assert!(
            live.iter()
                .all(|(_, result)| result.fused.len() == expected && result.skipped.is_empty()),
            "{method}"
        );
        assert!(
            live.iter()
                .all(|(_, result)| result.fused.iter().all(|fused| fused.age_nanos == 0)),
            "{method}"
        );

        let balance = ledger.balance();
        assert!(balance.is_exact(), "{method}: {balance:?}");
        let total = ledger.total();
        assert_eq!(total.in_flight, 0, "{method}: {ledger:?}");
        assert_eq!(total.dropped_total(), 0, "{method}: {ledger:?}");
    }
}

#[test]
fn maps_within_a_limit_are_fused_and_counted_with_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, TICKS);
    let values: i64 = detector(Method::MAX).map_shape().iter().product();
    // Half of the bytes of the feature map at a byte per value.
    let limit = values as u64 / 2;
    let rate = RateConfig {
        message_bytes: Some(limit),
        ..RateConfig::default()
    };
    let (live, ledger) = play_in_lockstep(folder.path(), Method::MAX, rate);
    assert!(
        live.iter()
            .all(|(_, result)| result.fused.len() == AGENTS.len() - 1 && result.skipped.is_empty())
    );
    for fused in live.iter().flat_map(|(_, result)| &result.fused) {
        let bytes = fused.payload_bytes + protocol::HEADER_LEN as u64;
        assert!(bytes <= limit && bytes > limit / 2, "{bytes} of {limit}");
    }
    assert!(ledger.balance().is_exact());
    let adapted = |cav_id: &str| {
        let account = Account::published(topic(cav_id, Stream::Bev));
        ledger.get(&account).unwrap().adapted.clone()
    };
    assert!(
        adapted("10").is_empty(),
        "the messages of the ego's own agent are not transmitted over the link"
    );
    let fewer = BTreeMap::from([(RateReason::SizeFewerCells, TICKS as u64)]);
    assert!(
        AGENTS
            .iter()
            .filter(|cav_id| **cav_id != "10")
            .all(|cav_id| adapted(cav_id) == fewer),
        "{ledger:?}"
    );
}

/// An agent whose messages the test sends, so that the test decides which are late, wrong or missing.
struct ScriptedAgent {
    bus: Bus,
    publisher: bus::Publisher,
    agent: Agent,
    index: usize,
    /// Offset of its capture times, nanoseconds.
    ahead_nanos: u64,
    /// Until it leaves.
    _presence: Option<bus::LivelinessToken>,
}

impl ScriptedAgent {
    fn new(router: &TestRouter, index: usize) -> Self {
        let bus = router.join(&format!("agent-{}", AGENTS[index]), AGENTS[index]);
        let publisher = bus
            .publisher(
                topic(AGENTS[index], Stream::Bev),
                PublisherOptions::FEATURES.lossless(8),
            )
            .unwrap();
        let presence = bus.announce(protocol::Role::Agent).unwrap();
        Self {
            bus,
            publisher,
            agent: agent(AGENTS[index], Method::MAX),
            index,
            ahead_nanos: 0,
            _presence: Some(presence),
        }
    }

    fn send(&mut self, scenario: &Scenario, tick_index: usize) {
        let tick = &scenario.ticks[tick_index];
        let frame = scenario
            .load(self.index, tick_index, &LoadOptions::default())
            .unwrap();
        let input = AgentInput {
            capture_nanos: tick.capture_nanos,
            cloud: &frame.points,
            measured_pose: frame.world_from_lidar.as_ref(),
            motion: frame.motion(),
        };
        let output = self.agent.process(&input).unwrap();
        let pose = output.pose;
        self.publisher
            .submit_encoded(tick.capture_nanos + self.ahead_nanos, move |stamp| {
                let features = protocol::encode_features(
                    output.perception.features,
                    &protocol::CodecConfig::default(),
                    None,
                )?;
                protocol::wire::encode(stamp, protocol::message::Bev { pose, features })
            });
    }

    /// Reports sweeps of the first three ticks of a scene that is played in real time.
    fn describe_sweeps(&self, scenario: &Scenario, began_nanos: u64) {
        let times = [0, 1, 2].map(|tick| scenario.ticks[tick].capture_nanos);
        let sweeps = times.map(|capture_nanos| SweepArrival {
            before_nanos: times[2] - capture_nanos,
            arrived_nanos: began_nanos + capture_nanos - times[0],
        });
        self.describe(
            times[2] + self.ahead_nanos,
            Descriptor {
                sweeps: sweeps.into(),
                ..own_descriptor()
            },
        );
    }

    fn describe(&self, capture_nanos: u64, descriptor: Descriptor) {
        let publisher = self
            .bus
            .publisher(
                topic(AGENTS[self.index], Stream::Descriptor),
                PublisherOptions::POSE,
            )
            .unwrap();
        publisher.submit(capture_nanos, descriptor);
        // It is transmitted before the next map is.
        publisher.finish();
    }

    fn wait_for_route(&self, receiver: &str) {
        let route = Route {
            topic: self.publisher.topic().clone(),
            receiver: receiver.parse().unwrap(),
        };
        bus::Barrier::new([route])
            .await_routes(&self.bus)
            .unwrap()
            .wait(TIMEOUT)
            .unwrap();
    }
}

/// Descriptor of an agent that runs the ego's network.
fn own_descriptor() -> Descriptor {
    Descriptor {
        model_hash: detector(Method::MAX).model_hash(),
        grid: detector(Method::MAX).grid(),
        channels: u32::try_from(detector(Method::MAX).map_shape()[0]).unwrap(),
        dtype: protocol::Dtype::F32,
        streams: vec![Stream::Bev],
        sweeps: vec![],
    }
}

/// Detections of vehicle 10, as received by a scorer.
struct Results {
    inbox: Arc<Inbox>,
    _subscription: Subscription,
    _bus: Bus,
}

impl Results {
    fn of_10(router: &TestRouter) -> Self {
        let bus = router.join("scorer", "scorer");
        let inbox = bus.inbox(100, 1);
        let subscription = bus
            .subscribe(topic("10", Stream::Detections), &inbox)
            .unwrap();
        Self {
            inbox,
            _subscription: subscription,
            _bus: bus,
        }
    }

    fn next(&self) -> Detections {
        let (_, Event::Message(arrival)) = next_event(&self.inbox) else {
            panic!("an end")
        };
        self.inbox.decode(&arrival, &Limits::DEFAULT).unwrap()
    }
}

/// Neighbours that a result was fused from.
fn fused(result: &Detections) -> Vec<&str> {
    result
        .fused
        .iter()
        .map(|fused| fused.cav.as_str())
        .collect()
}

#[test]
fn late_killed_and_faulty_neighbours_are_named_and_the_ego_continues() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, TICKS);
    let scenario = dataset::open(folder.path()).unwrap().scenarios.remove(0);
    let router = TestRouter::open();
    let stop = Stop::new();
    let mut fleet: Vec<ScriptedAgent> = (0..3)
        .map(|index| ScriptedAgent::new(&router, index))
        .collect();
    let results = Results::of_10(&router);

    let ledger = std::thread::scope(|scope| {
        let ego = scope.spawn(|| {
            let bus = router.join("ego-10", "10");
            let options = ego_node::NodeOptions {
                keeps_running: true,
                ..ego_options(Duration::from_millis(400))
            };
            ego_node::run(&bus, &cav("10"), ego(Method::MAX), &options, &stop).unwrap();
            leave(bus)
        });
        fleet
            .iter()
            .for_each(|agent| agent.wait_for_route("ego-10"));

        // All present.
        for index in [1, 2, 0] {
            fleet[index].send(&scenario, 0);
        }
        assert_eq!(fused(&results.next()), ["20", "30"]);

        // 30 is late: its message of the tick before is recent enough, and is used with its age.
        fleet[1].send(&scenario, 1);
        fleet[0].send(&scenario, 1);
        let result = results.next();
        assert_eq!(fused(&result), ["20", "30"]);
        assert_eq!(result.fused[1].age_nanos, 100_000_000);

        // Still silent: too old now, masked and named.
        fleet[1].send(&scenario, 2);
        fleet[0].send(&scenario, 2);
        let result = results.next();
        assert_eq!(fused(&result), ["20"]);
        assert_eq!(
            (result.skipped[0].cav.as_str(), result.skipped[0].reason),
            ("30", None)
        );

        // 20 sends garbage under its own name: counted, and the ego goes on without it.
        let key = fleet[1].bus.key(topic("20", Stream::Bev)).to_string();
        fleet[1]
            .bus
            .session()
            .put(&key, vec![0xAB; 4096])
            .wait()
            .unwrap();
        fleet[2].send(&scenario, 3);
        fleet[0].send(&scenario, 3);
        let result = results.next();
        assert!(fused(&result).contains(&"30"), "{result:?}");

        // 20 crashes.
        let crashed = fleet.remove(1);
        crashed.bus.session().close().wait().unwrap();
        for tick in 4..6 {
            fleet[1].send(&scenario, tick);
            fleet[0].send(&scenario, tick);
            assert!(fused(&results.next()).contains(&"30"));
        }
        stop.request();
        ego.join().unwrap()
    });
    let from_20 = ledger.get(&Account::towards(
        topic("20", Stream::Bev),
        &process_id(protocol::Role::Ego, &cav("10")),
    ));
    let from_20 = from_20.unwrap();
    assert_eq!(
        from_20.dropped.get(&DropReason::Decode),
        Some(&1),
        "{from_20:?}"
    );
    assert_eq!(from_20.received, 3);
    let own = ledger.get(&Account::towards(
        topic("10", Stream::Bev),
        &process_id(protocol::Role::Ego, &cav("10")),
    ));
    assert_eq!(own.unwrap().received, 6);
}

#[test]
fn a_map_that_the_link_delivers_after_its_sender_has_left_is_counted() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, TICKS);
    let scenario = dataset::open(folder.path()).unwrap().scenarios.remove(0);
    let (router, stop) = (TestRouter::open(), Stop::new());
    let [mut own, mut neighbour] = [0, 1].map(|index| ScriptedAgent::new(&router, index));
    // The link publishes under the stamp of the sender.
    let link = router.join("link-10", "20");
    let received = Topic::Received {
        ego: cav("10"),
        cav: cav("20"),
        stream: Stream::Bev,
    };
    let options = PublisherOptions::FEATURES.lossless(8);
    neighbour.publisher = link.publisher(received.clone(), options).unwrap();
    let results = Results::of_10(&router);
    let bus = router.join("ego-10", "10");
    std::thread::scope(|scope| {
        let ego = scope.spawn(|| {
            let options = ego_node::NodeOptions {
                over_link: true,
                keeps_running: true,
                ..ego_options(TIMEOUT)
            };
            ego_node::run(&bus, &cav("10"), ego(Method::MAX), &options, &stop).unwrap();
        });
        own.wait_for_route("ego-10");
        neighbour.wait_for_route("ego-10");
        neighbour.send(&scenario, 0);
        own.send(&scenario, 0);
        assert_eq!(fused(&results.next()), ["20"]);

        // Decided when the ego knows that 20 has left.
        neighbour._presence = None;
        own.send(&scenario, 1);
        assert!(results.next().fused.is_empty());

        neighbour.send(&scenario, 1);
        let account = Account::towards(received, &process_id(protocol::Role::Ego, &cav("10")));
        wait_for("the late map is counted", || {
            let ledger = bus.stats().ledger();
            let counts = ledger.get(&account);
            counts.is_some_and(|counts| counts.dropped.get(&DropReason::Stale) == Some(&1))
        });
        stop.request();
        ego.join().unwrap();
    });
}

#[test]
fn a_neighbour_whose_capture_clock_is_ahead_is_fused_with_the_frames_of_its_sweeps() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, TICKS);
    let scenario = dataset::open(folder.path()).unwrap().scenarios.remove(0);
    let (router, stop) = (TestRouter::open(), Stop::new());
    let mut fleet = [0, 1].map(|index| ScriptedAgent::new(&router, index));
    fleet[1].ahead_nanos = 3_000_000_000;
    let results = Results::of_10(&router);
    std::thread::scope(|scope| {
        let ego = scope.spawn(|| {
            let bus = router.join("ego-10", "10");
            let options = ego_node::NodeOptions {
                keeps_running: true,
                ..ego_options(TIMEOUT)
            };
            ego_node::run(&bus, &cav("10"), ego(Method::MAX), &options, &stop).unwrap();
        });
        fleet
            .iter()
            .for_each(|agent| agent.wait_for_route("ego-10"));
        let began_nanos = bus::unix_nanos();
        for agent in &fleet {
            agent.describe_sweeps(&scenario, began_nanos);
        }
        for tick in 0..3 {
            fleet
                .iter_mut()
                .rev()
                .for_each(|agent| agent.send(&scenario, tick));
            let result = results.next();
            assert_eq!(fused(&result), ["20"], "{result:?}");
            assert_eq!(result.fused[0].age_nanos, 0);
            let offset_s = result.neighbours[0].capture_offset_s.unwrap();
            assert!((offset_s - 3.0).abs() < 0.02, "{offset_s}");
        }
        stop.request();
        ego.join().unwrap();
    });
}

#[test]
fn maps_of_a_network_that_a_neighbour_names_as_another_are_left_out() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, TICKS);
    let scenario = dataset::open(folder.path()).unwrap().scenarios.remove(0);
    let (router, stop) = (TestRouter::open(), Stop::new());
    let mut fleet: Vec<ScriptedAgent> = (0..3)
        .map(|index| ScriptedAgent::new(&router, index))
        .collect();
    let results = Results::of_10(&router);
    let own = own_descriptor();
    let ledger = std::thread::scope(|scope| {
        let ego = scope.spawn(|| {
            let bus = router.join("ego-10", "10");
            // A frame that waited for an excluded neighbour would take for ever.
            let options = ego_node::NodeOptions {
                keeps_running: true,
                ..ego_options(TIMEOUT)
            };
            let report =
                ego_node::run(&bus, &cav("10"), ego(Method::MAX), &options, &stop).unwrap();
            assert_eq!((report.frames, report.at_deadline), (4, 0));
            leave(bus)
        });
        fleet
            .iter()
            .for_each(|agent| agent.wait_for_route("ego-10"));
        let send_all = |fleet: &mut [ScriptedAgent], tick| {
            [1, 2, 0].map(|index| fleet[index].send(&scenario, tick))
        };

        send_all(&mut fleet, 0);
        assert_eq!(
            fused(&results.next()),
            ["20", "30"],
            "no descriptor has arrived"
        );

        fleet[1].describe(
            0,
            Descriptor {
                model_hash: ModelHash([9; 32]),
                ..own.clone()
            },
        );
        for tick in 1..3 {
            send_all(&mut fleet, tick);
            let result = results.next();
            assert_eq!(fused(&result), ["30"]);
            assert_eq!(
                (result.skipped[0].cav.as_str(), result.skipped[0].reason),
                ("20", Some(DropReason::Shape))
            );
        }

        // It was restarted, with the right weights.
        let restarted = fleet.remove(1);
        restarted.bus.session().close().wait().unwrap();
        fleet.insert(1, ScriptedAgent::new(&router, 1));
        fleet[1].wait_for_route("ego-10");
        fleet[1].describe(0, own);
        send_all(&mut fleet, 3);
        assert_eq!(fused(&results.next()), ["20", "30"]);
        stop.request();
        ego.join().unwrap()
    });
    let from_20 = ledger.get(&Account::towards(
        topic("20", Stream::Bev),
        &process_id(protocol::Role::Ego, &cav("10")),
    ));
    let from_20 = from_20.unwrap();
    assert_eq!(
        (from_20.received, from_20.dropped.get(&DropReason::Shape)),
        (2, Some(&2)),
        "{from_20:?}"
    );
    assert!(
        ledger
            .iter()
            .all(|(account, _)| account.topic != topic("20", Stream::Descriptor)),
        "not counted"
    );
}

#[test]
fn an_agent_receives_its_own_sensors_only_and_reports_a_missing_pose() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, 3);
    let scenario = dataset::open(folder.path()).unwrap().scenarios.remove(0);
    let (router, stop) = (TestRouter::open(), Stop::new());
    let ledger = std::thread::scope(|scope| {
        let running = run_agent(
            scope,
            &router,
            "20",
            Method::MAX,
            RateConfig::default(),
            &stop,
        );
        let replay = router.join("replay", "replay");
        let lidar = |cav_id| {
            replay
                .publisher(
                    topic(cav_id, Stream::Lidar),
                    PublisherOptions::SENSOR.lossless(8),
                )
                .unwrap()
        };
        let (own, other) = (lidar("20"), lidar("10"));
        let route = Route {
            topic: topic("20", Stream::Lidar),
            receiver: "agent-20".parse().unwrap(),
        };
        bus::Barrier::new([route])
            .await_routes(&replay)
            .unwrap()
            .wait(TIMEOUT)
            .unwrap();
        let frame = scenario.load(1, 0, &LoadOptions::default()).unwrap();
        // A sweep without a pose.
        other.submit(
            1,
            protocol::Lidar {
                points: frame.points.clone(),
            },
        );
        own.submit(
            1,
            protocol::Lidar {
                points: frame.points,
            },
        );
        other.finish();
        own.finish();
        running.join().unwrap()
    });
    let received: BTreeMap<String, u64> = (ledger.iter())
        .filter(|(account, _)| account.to.is_some())
        .map(|(account, counts)| (account.topic.to_string(), counts.received))
        .collect();
    assert_eq!(
        received,
        BTreeMap::from(
            ["20/gnss", "20/imu", "20/lidar"]
                .map(|topic| (topic.to_owned(), u64::from(topic == "20/lidar")))
        )
    );
    let sent = |stream| {
        ledger
            .get(&Account::published(topic("20", stream)))
            .unwrap()
            .sent
    };
    assert_eq!(
        (sent(Stream::Pose), sent(Stream::Bev)),
        (1, 1),
        "it reports that it has none"
    );
}
