//! Bus through real zenoh sessions: a router and clients on loopback.

use std::collections::BTreeMap;
use std::sync::mpsc;
use std::time::{Duration, Instant};

use bus::shutdown::Stop;
use bus::{
    self, Barrier, Bus, BusConfig, BusError, BusOptions, Endpoint, Event, Publisher,
    PublisherOptions, Route, SharedMemory, SharedMemoryUse, bounded_queue::Pop,
};
use protocol::{
    Account, CavId, Control, DropReason, Gnss, GnssSource, Ledger, Lidar, Limits, PointCloud, Pose,
    Role, RunId, Stamp, Stream, Topic,
};
use tests::bus::{TIMEOUT, TestRouter, free_port, next_event, wait_for};
use zenoh::Wait;
use zenoh::qos::CongestionControl;

fn cav(text: &str) -> CavId {
    CavId::new(text).unwrap()
}

fn topic(text: &str) -> Topic {
    text.parse().unwrap()
}

pub(super) fn gnss(x_m: f64) -> Gnss {
    Gnss {
        world_from_lidar: Pose::from_xyz_yaw([x_m, 0.0, 0.0], 0.0),
        position_std_m: 0.0,
        heading_std_rad: 0.0,
        source: GnssSource::Recorded,
    }
}

/// A sweep of `count` points with distinct values.
fn sweep(count: u16) -> Lidar {
    Lidar {
        points: PointCloud {
            xyzi: (0..count).map(|i| [f32::from(i), 1.0, 2.0, 0.5]).collect(),
        },
    }
}

#[test]
fn a_second_process_of_a_name_is_refused_until_the_first_has_left() {
    let (router, stop) = (TestRouter::open(), Stop::new());
    let config = BusConfig {
        connect: router.endpoint.clone(),
        ..BusConfig::default()
    };
    let (run, agent) = (RunId::new("test").unwrap(), cav("7"));
    let first = config.join(&stop, &run, Role::Agent, &agent).unwrap();
    let token = first.announce(Role::Agent).unwrap();
    // Another vehicle, and another role of the vehicle, have names of their own.
    config.join(&stop, &run, Role::Agent, &cav("8")).unwrap();
    config.join(&stop, &run, Role::Ego, &agent).unwrap();
    let error = config.join(&stop, &run, Role::Agent, &agent).err().unwrap();
    assert!(matches!(error, BusError::NameTaken { .. }), "{error}");
    assert!(error.is_bad_input() && error.to_string().starts_with("agent-7 is live in run test"));
    token.withdraw().unwrap();
    config.join(&stop, &run, Role::Agent, &agent).unwrap();
}

/// Waits on `receiver`'s behalf until a probe of `topic` has reached it.
fn connect(publisher: &Bus, receiver: &Bus, topic: &Topic) {
    let route = Route {
        topic: topic.clone(),
        receiver: receiver.identity().process.clone(),
    };
    let barrier = Barrier::new([route]);
    barrier
        .await_routes(publisher)
        .unwrap()
        .wait(TIMEOUT)
        .unwrap();
}

fn balanced(buses: &[&Bus]) -> Ledger {
    let mut ledger = Ledger::default();
    buses
        .iter()
        .for_each(|bus| ledger.merge(&bus.stats().ledger()));
    assert!(ledger.balance().is_exact(), "{:?}", ledger.balance());
    ledger
}

#[test]
fn one_publisher_reaches_every_subscriber() {
    let router = TestRouter::open();
    let replay = router.join("replay", "replay");
    let receivers: Vec<Bus> = (0..3)
        .map(|i| router.join(&format!("agent-{i}"), &i.to_string()))
        .collect();
    let topic = topic("7/lidar");
    let publisher = replay
        .publisher(topic.clone(), PublisherOptions::SENSOR.lossless(8))
        .unwrap();
    let inboxes: Vec<_> = receivers.iter().map(|bus| bus.inbox(64, 1)).collect();
    let _subscriptions: Vec<_> = receivers
        .iter()
        .zip(&inboxes)
        .map(|(bus, inbox)| bus.subscribe(topic.clone(), inbox).unwrap())
        .collect();
    receivers
        .iter()
        .for_each(|bus| connect(&replay, bus, &topic));

    (0..20).for_each(|tick| publisher.submit(tick, sweep(40_000 + tick as u16)));
    publisher.finish();

    for (bus, inbox) in receivers.iter().zip(&inboxes) {
        for tick in 0..20 {
            let (_, Event::Message(arrival)) = next_event(inbox) else {
                panic!("an end before the last message")
            };
            let lidar: Lidar = inbox.decode(&arrival, &Limits::DEFAULT).unwrap();
            assert_eq!(
                (
                    arrival.header.stamp.sequence,
                    arrival.header.stamp.capture_nanos
                ),
                (tick, tick)
            );
            assert_eq!(lidar, sweep(40_000 + tick as u16));
            bus.stats().received(&topic);
        }
        assert!(matches!(
            next_event(inbox),
            (_, Event::End { sent: 20, .. })
        ));
    }
    let ledger = balanced(&[&replay, &receivers[0], &receivers[1], &receivers[2]]);
    assert_eq!((ledger.total().sent, ledger.total().received), (20, 60));
}

#[test]
fn no_first_frame_is_lost_in_twenty_cold_starts() {
    for _ in 0..20 {
        let router = TestRouter::open();
        let topic = topic("7/gnss");
        // Both ends start at once, in no order.
        let (replay, agent) = std::thread::scope(|scope| {
            let replay = scope.spawn(|| router.join("replay", "replay"));
            let agent = scope.spawn(|| router.join("agent-7", "7"));
            (replay.join().unwrap(), agent.join().unwrap())
        });
        let inbox = agent.inbox(64, 1);
        let starting = std::thread::spawn({
            let topic = topic.clone();
            move || {
                let publisher = replay
                    .publisher(topic.clone(), PublisherOptions::SENSOR.lossless(8))
                    .unwrap();
                let route = Route {
                    topic,
                    receiver: "agent-7".parse().unwrap(),
                };
                Barrier::new([route])
                    .await_routes(&replay)
                    .unwrap()
                    .wait(TIMEOUT)
                    .unwrap();
                (0..5).for_each(|tick| publisher.submit(tick, gnss(tick as f64)));
                publisher.finish();
                replay
            }
        });
        let _subscription = agent.subscribe(topic, &inbox).unwrap();
        for tick in 0..5 {
            let (_, Event::Message(arrival)) = next_event(&inbox) else {
                panic!("an end before the last message")
            };
            assert_eq!(arrival.header.stamp.capture_nanos, tick);
        }
        starting.join().unwrap().leave(TIMEOUT).unwrap();
        agent.leave(TIMEOUT).unwrap();
    }
}

#[test]
fn a_process_with_a_stalled_worker_stops_its_heartbeat() {
    let router = TestRouter::open();
    let (agent, watcher) = (
        router.join("agent-7", "7"),
        router.join("watcher", "watcher"),
    );
    let heartbeats = watcher.inbox(64, 4);
    let _subscription = watcher
        .subscribe(topic("stats/agent-7"), &heartbeats)
        .unwrap();
    let reports = |timeout: Duration| {
        matches!(
            heartbeats.take(Some(Instant::now() + timeout)),
            Pop::Item(..)
        )
    };
    assert!(reports(TIMEOUT), "a heartbeat");

    let inbox = agent.inbox(1, 1);
    let working = agent.works_from(&inbox);
    // It waits for work, for longer than the interval between two reports.
    assert!(matches!(
        inbox.take(Some(Instant::now() + Duration::from_millis(1200))),
        Pop::TimedOut
    ));
    while reports(Duration::from_millis(1)) {}
    // Its worker was active since the last report, which is reported once; then it stalls.
    reports(Duration::from_millis(700));
    assert!(
        !reports(Duration::from_millis(1500)),
        "a heartbeat although its worker is stalled"
    );
    working.beat();
    assert!(reports(TIMEOUT), "its worker was active");
    drop(working);
    assert!(
        (0..3).all(|_| reports(TIMEOUT)),
        "its work is done: heartbeats as before"
    );
    agent.leave(TIMEOUT).unwrap();
    watcher.leave(TIMEOUT).unwrap();
}

#[test]
fn a_missing_pair_is_named() {
    let router = TestRouter::open();
    let replay = router.join("replay", "replay");
    let _publisher = replay
        .publisher(topic("7/lidar"), PublisherOptions::SENSOR)
        .unwrap();
    let routes = ["7/lidar>agent-7", "7/gnss>agent-7"].map(|route| route.parse::<Route>().unwrap());
    let barrier = Barrier::new(routes).await_routes(&replay).unwrap();
    let error = barrier
        .wait(Duration::from_millis(200))
        .unwrap_err()
        .to_string();
    assert!(error.contains("7/lidar>agent-7, 7/gnss>agent-7"), "{error}");
}

#[test]
fn a_process_reports_only_its_own_routes() {
    let router = TestRouter::open();
    let (replay, agent) = (router.join("replay", "replay"), router.join("agent-8", "8"));
    let routes =
        ["7/lidar>agent-7", "7/lidar>agent-8"].map(|route| route.parse::<Route>().unwrap());
    let barrier = Barrier::new(routes.clone()).await_routes(&replay).unwrap();
    let key = agent
        .key(Topic::Ready(agent.identity().process.clone()))
        .to_string();
    let mut sequence = 0;
    let mut report_ready = |process: &str| {
        let stamp = Stamp {
            cav: cav("8"),
            epoch: u64::MAX,
            sequence,
            capture_nanos: 0,
            publish_nanos: 0,
        };
        sequence += 1;
        let ready = Control::Ready {
            process: process.parse().unwrap(),
            subscribed: vec![topic("7/lidar")],
        };
        let bytes = protocol::wire::encode(&stamp, ready).unwrap().to_vec();
        agent
            .session()
            .put(&key, bytes)
            .congestion_control(CongestionControl::Block)
            .wait()
            .unwrap();
    };
    // In this order: when the second is received, the first has been.
    wait_for("its own report", || {
        report_ready("agent-7");
        report_ready("agent-8");
        !barrier.missing().contains(&routes[1])
    });
    assert_eq!(barrier.missing(), routes[..1]);
}

#[test]
fn a_slow_consumer_gets_the_newest_and_every_loss_is_counted() {
    let router = TestRouter::open();
    let (replay, agent) = (router.join("replay", "replay"), router.join("agent-7", "7"));
    let topic = topic("7/lidar");
    let publisher = replay
        .publisher(topic.clone(), PublisherOptions::SENSOR.lossless(8))
        .unwrap();
    let inbox = agent.inbox(1, 1);
    let _subscription = agent.subscribe(topic.clone(), &inbox).unwrap();
    connect(&replay, &agent, &topic);
    (0..10).for_each(|tick| publisher.submit(tick, sweep(1000)));
    publisher.finish();
    // The consumer reads only now, when all have arrived.
    let account = Account::towards(topic.clone(), &agent.identity().process);
    wait_for("nine superseded", || {
        let ledger = agent.stats().ledger();
        ledger
            .get(&account)
            .is_some_and(|counts| counts.dropped.get(&DropReason::Superseded) == Some(&9))
    });
    let (_, Event::Message(arrival)) = next_event(&inbox) else {
        panic!("an end before the message")
    };
    assert_eq!(arrival.header.stamp.capture_nanos, 9);
    agent.stats().received(&topic);
    assert!(
        matches!(next_event(&inbox), (_, Event::End { sent: 10, .. })),
        "a notice never takes the place of data"
    );
    balanced(&[&replay, &agent]);
}

#[test]
fn an_overloaded_publisher_returns_at_once_and_counts() {
    let router = TestRouter::open();
    let (replay, agent) = (router.join("replay", "replay"), router.join("agent-7", "7"));
    let topic = topic("7/lidar");
    let publisher = replay
        .publisher(topic.clone(), PublisherOptions::SENSOR)
        .unwrap();
    let inbox = agent.inbox(1000, 1);
    let _subscription = agent.subscribe(topic.clone(), &inbox).unwrap();
    connect(&replay, &agent, &topic);
    let clouds: Vec<Lidar> = (0..50).map(|_| sweep(60_000)).collect();
    let longest = clouds
        .into_iter()
        .enumerate()
        .map(|(tick, cloud)| {
            let began = Instant::now();
            publisher.submit(tick as u64, cloud);
            began.elapsed()
        })
        .max()
        .unwrap();
    assert!(
        longest < Duration::from_millis(50),
        "an submit took {longest:?}"
    );
    publisher.finish();
    let mut last = None;
    while let Event::Message(arrival) = next_event(&inbox).1 {
        agent.stats().received(&topic);
        last = Some(arrival.header.stamp.capture_nanos);
    }
    assert_eq!(
        last,
        Some(49),
        "the newest is never the one that is dropped"
    );
    let ledger = balanced(&[&replay, &agent]);
    let published = ledger.get(&Account::published(topic)).unwrap();
    assert_eq!(published.sent, 50);
    assert!(
        published.dropped[&DropReason::Superseded] > 0,
        "50 clouds of 1 MB in a moment cannot all have been sent"
    );
}

#[test]
fn a_late_joiner_is_detected_receives_and_its_end_is_detected() {
    let router = TestRouter::open();
    let ego = router.join("ego-1", "1");
    let (report, events) = mpsc::channel();
    let early = router.join("agent-1", "1");
    let _presence = early.announce(Role::Agent).unwrap();
    let _watch = ego
        .watch(Role::Agent, move |cav, is_there| {
            let _ = report.send((cav, is_there));
        })
        .unwrap();
    let seen = |event: (CavId, bool)| assert_eq!(events.recv_timeout(TIMEOUT).unwrap(), event);
    seen((cav("1"), true));

    let late = router.join("agent-2", "2");
    let presence = late.announce(Role::Agent).unwrap();
    seen((cav("2"), true));
    let topic = topic("2/gnss");
    let inbox = ego.inbox(4, 4);
    let _subscription = ego.subscribe(topic.clone(), &inbox).unwrap();
    let publisher = late
        .publisher(topic.clone(), PublisherOptions::POSE)
        .unwrap();
    connect(&late, &ego, &topic);
    publisher.submit(3, gnss(1.0));
    assert!(matches!(next_event(&inbox), (found, Event::Message(_)) if found == topic));

    presence.withdraw().unwrap();
    seen((cav("2"), false));
    // A crashed one is detected as well.
    early.session().close().wait().unwrap();
    seen((cav("1"), false));
}

#[test]
fn wrong_bytes_are_counted_and_survived() {
    let router = TestRouter::open();
    let (good, ego) = (router.join("agent-7", "7"), router.join("ego-1", "1"));
    let topic = topic("7/gnss");
    let publisher = good
        .publisher(topic.clone(), PublisherOptions::POSE.lossless(8))
        .unwrap();
    let inbox = ego.inbox(64, 1);
    let _subscription = ego.subscribe(topic.clone(), &inbox).unwrap();
    connect(&good, &ego, &topic);

    // Everything a broken or hostile peer may put under this key.
    let enemy = router.join("enemy", "8");
    let key = enemy.key(topic.clone()).to_string();
    let stamp = Stamp {
        cav: cav("7"),
        epoch: 1,
        sequence: 0,
        capture_nanos: 0,
        publish_nanos: 0,
    };
    let sound = protocol::wire::encode(&stamp, gnss(0.0)).unwrap().to_vec();
    let changed = |at: usize, to: u8| {
        let mut bytes = sound.clone();
        bytes[at] = to;
        bytes
    };
    let next = Stamp {
        sequence: 1,
        ..stamp.clone()
    };
    let mut flipped = protocol::wire::encode(&next, gnss(0.0)).unwrap().to_vec();
    *flipped.last_mut().unwrap() ^= 1;
    let impostor = protocol::wire::encode(
        &Stamp {
            cav: cav("8"),
            ..stamp.clone()
        },
        gnss(0.0),
    )
    .unwrap();
    let other_kind = protocol::wire::encode(&stamp, sweep(3)).unwrap();
    let hostile = [
        vec![],
        b"no such message".to_vec(),
        sound[..sound.len() - 1].to_vec(),
        changed(4, 99),
        changed(60, !sound[60]),
        flipped,
        sound[..sound.len() - 2].to_vec(),
        impostor.to_vec(),
        other_kind.to_vec(),
    ];
    let count = hostile.len() as u64;
    for bytes in hostile {
        enemy
            .session()
            .put(&key, bytes)
            .congestion_control(CongestionControl::Block)
            .wait()
            .unwrap();
    }
    enemy.leave(TIMEOUT).unwrap();

    publisher.submit(5, gnss(5.0));
    let account = Account::towards(topic.clone(), &ego.identity().process);
    let mut sound_messages = 0;
    while sound_messages == 0 || ego.stats().ledger().get(&account).unwrap().dropped_total() < count
    {
        match inbox.take(Some(Instant::now() + TIMEOUT)) {
            Pop::Item(_, Event::Message(arrival)) => {
                if let Some(gnss) = inbox.decode::<Gnss>(&arrival, &Limits::DEFAULT) {
                    assert_eq!(gnss.world_from_lidar.translation_m[0], 5.0);
                    ego.stats().received(&topic);
                    sound_messages += 1;
                }
            }
            other => panic!("{other:?}"),
        }
    }
    let counts = ego.stats().ledger().get(&account).unwrap().clone();
    assert_eq!((counts.received, counts.in_flight), (1, 0));
    let dropped = |reason| counts.dropped.get(&reason).copied().unwrap_or(0);
    assert_eq!(dropped(DropReason::Version), 1);
    assert_eq!(dropped(DropReason::Identity), 1);
    assert_eq!(dropped(DropReason::Checksum), 2);
    assert_eq!(dropped(DropReason::Decode), 4);
    assert_eq!(dropped(DropReason::Duplicate), 1, "two with one number");
}

#[test]
fn a_port_in_use_and_a_missing_router_are_named() {
    let router = TestRouter::open();
    let error = bus::open(&BusOptions::router(router.endpoint.clone())).unwrap_err();
    assert!(
        matches!(&error, BusError::PortInUse(endpoint) if *endpoint == router.endpoint),
        "{error}"
    );
    assert!(error.to_string().contains("the port is in use"), "{error}");

    let nowhere = Endpoint::loopback(free_port());
    let mut options = BusOptions::client(nowhere.clone());
    options.connect_timeout = Duration::from_millis(300);
    let error = bus::open(&options).unwrap_err();
    assert!(
        matches!(&error, BusError::Unreachable { endpoint, .. } if *endpoint == nowhere),
        "{error}"
    );
    assert!(
        error.to_string().contains(nowhere.as_str())
            && error.to_string().contains("start it first"),
        "{error}"
    );
}

#[test]
fn a_client_may_come_before_its_router() {
    let endpoint = Endpoint::loopback(free_port());
    let client = std::thread::spawn({
        let options = BusOptions::client(endpoint.clone());
        move || bus::open(&options)
    });
    std::thread::sleep(Duration::from_millis(100));
    let _router = bus::open(&BusOptions::router(endpoint)).unwrap();
    client.join().unwrap().unwrap();
}

#[test]
fn what_was_sent_before_leaving_arrives() {
    let router = TestRouter::open();
    let ego = router.join("ego-1", "1");
    for round in 0..20 {
        let agent = router.join("agent-7", "7");
        let topic = topic("7/lidar");
        let inbox = ego.inbox(64, 1);
        let subscription = ego.subscribe(topic.clone(), &inbox).unwrap();
        let publisher = agent
            .publisher(topic.clone(), PublisherOptions::SENSOR.lossless(8))
            .unwrap();
        connect(&agent, &ego, &topic);
        (0..5).for_each(|tick| publisher.submit(tick, sweep(50_000)));
        publisher.finish();
        agent.leave(TIMEOUT).unwrap();
        for _ in 0..5 {
            assert!(
                matches!(next_event(&inbox).1, Event::Message(_)),
                "round {round}"
            );
        }
        assert!(
            matches!(next_event(&inbox).1, Event::End { sent: 5, .. }),
            "round {round}"
        );
        drop(subscription);
    }
}

#[test]
fn shared_memory_carries_the_same_messages() {
    let router = TestRouter::with(|options| BusOptions {
        shared_memory: SharedMemory::Attached,
        ..options
    });
    let join = |process: &str, cav_id: &str| {
        let mut options = BusOptions::client(router.endpoint.clone());
        options.shared_memory = SharedMemory::Pool(64 << 20);
        let identity = bus::Identity {
            run: "test".parse().unwrap(),
            process: process.parse().unwrap(),
            cav: cav(cav_id),
        };
        Bus::join(&options, identity).unwrap()
    };
    let (replay, agent) = (join("replay", "replay"), join("agent-7", "7"));
    let topic = Topic::Stream {
        cav: cav("7"),
        stream: Stream::Lidar,
    };
    let publisher: Publisher = replay
        .publisher(
            topic.clone(),
            PublisherOptions {
                waiting_places: Some(4),
                ..PublisherOptions::SENSOR
            },
        )
        .unwrap();
    let inbox = agent.inbox(64, 1);
    let _subscription = agent.subscribe(topic.clone(), &inbox).unwrap();
    connect(&replay, &agent, &topic);
    (0..20).for_each(|tick| publisher.submit(tick, sweep(60_000)));
    publisher.finish();
    for tick in 0..20 {
        let (_, Event::Message(arrival)) = next_event(&inbox) else {
            panic!("an end before the last message")
        };
        assert_eq!(arrival.header.stamp.capture_nanos, tick);
        assert_eq!(
            inbox.decode::<Lidar>(&arrival, &Limits::DEFAULT),
            Some(sweep(60_000))
        );
        agent.stats().received(&topic);
    }
    balanced(&[&replay, &agent]);
    assert_eq!(
        replay.stats().shared_memory(),
        [(SharedMemoryUse::Carried, 20)].into()
    );
}

/// Sends five sweeps of 960 kB from a process with a pool of `pool_mib`; how they went.
fn shared_memory_use(router: SharedMemory, pool_mib: usize) -> BTreeMap<SharedMemoryUse, u64> {
    let router = TestRouter::with(|options| BusOptions {
        shared_memory: router,
        ..options
    });
    let options = BusOptions {
        shared_memory: SharedMemory::Pool(pool_mib << 20),
        ..BusOptions::client(router.endpoint.clone())
    };
    let identity = bus::Identity {
        run: "test".parse().unwrap(),
        process: "replay".parse().unwrap(),
        cav: cav("replay"),
    };
    let (replay, agent) = (
        Bus::join(&options, identity).unwrap(),
        router.join("agent-7", "7"),
    );
    let topic = Topic::Stream {
        cav: cav("7"),
        stream: Stream::Lidar,
    };
    let publisher = replay
        .publisher(topic.clone(), PublisherOptions::SENSOR.lossless(8))
        .unwrap();
    let inbox = agent.inbox(64, 1);
    let _subscription = agent.subscribe(topic.clone(), &inbox).unwrap();
    connect(&replay, &agent, &topic);
    (0..5).for_each(|tick| publisher.submit(tick, sweep(60_000)));
    publisher.finish();
    for _ in 0..5 {
        let (_, Event::Message(arrival)) = next_event(&inbox) else {
            panic!("an end before the last message")
        };
        assert_eq!(
            inbox.decode::<Lidar>(&arrival, &Limits::DEFAULT),
            Some(sweep(60_000))
        );
    }
    replay.stats().shared_memory()
}

#[test]
fn messages_beside_shared_memory_arrive_and_are_counted() {
    // One message has 960 kB: a pool of 1 MiB holds one, beside zenoh's own data none. On a busy machine zenoh takes memory
    // back that its receiver has not confirmed in time.
    let mut tries = (0..3).map(|_| shared_memory_use(SharedMemory::Attached, 1));
    let small = tries.find(|small| small.contains_key(&SharedMemoryUse::PoolFull));
    assert_eq!(small.map(|small| small.values().sum::<u64>()), Some(5));
    // A receiver without shared memory: the sender has put its messages there all the same.
    assert_eq!(
        shared_memory_use(SharedMemory::Attached, 64),
        [(SharedMemoryUse::Carried, 5)].into()
    );
    assert_eq!(
        shared_memory_use(SharedMemory::Attached, 0),
        BTreeMap::new()
    );
    assert_eq!(
        shared_memory_use(SharedMemory::Off, 64),
        [(SharedMemoryUse::RouterNotAttached, 5)].into()
    );
}
