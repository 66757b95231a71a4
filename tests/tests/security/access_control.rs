//! Access control by key, header and certificate: permitted and refused operations, through real sessions over QUIC.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bus::{
    self, Barrier, Bus, BusError, BusOptions, Credentials, Event, Inbox, PublisherOptions, Route,
    unix_nanos,
};
use deploy::operate::keys::{KeyPlan, make};
use protocol::message::Points;
use protocol::{
    Gnss, GnssSource, Lidar, Limits, PointCloud, Pose, PoseEstimate, Stamp, Stream, Topic, wire,
};
use tests::bus::{TIMEOUT, next_event, wait_for};
use tests::keys::{GuardedRouter, TRIED_FOR, keys_for, unauthorised_peer};
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait};

fn topic(text: &str) -> Topic {
    text.parse().unwrap()
}

fn estimate() -> PoseEstimate {
    PoseEstimate::new(Pose::IDENTITY, 1.0)
}

/// A valid message of vehicle `cav`, as its own agent would send it.
fn forged_pose(cav: &str) -> Vec<u8> {
    let stamp = Stamp {
        cav: cav.parse().unwrap(),
        epoch: 1,
        sequence: 0,
        capture_nanos: 1,
        publish_nanos: unix_nanos(),
    };
    let encoded = wire::encode(&stamp, estimate()).unwrap();
    [encoded.head.to_vec(), encoded.body.as_bytes().to_vec()].concat()
}

/// Keys of all messages that pass a router, as its own session receives them.
fn captured_keys(
    router: &Session,
) -> (Arc<Mutex<BTreeSet<String>>>, zenoh::pubsub::Subscriber<()>) {
    let keys = Arc::<Mutex<BTreeSet<String>>>::default();
    let captured = Arc::clone(&keys);
    let subscriber = router.declare_subscriber("v2v/**").callback(move |sample| {
        captured
            .lock()
            .unwrap()
            .insert(sample.key_expr().to_string());
    });
    (keys, subscriber.wait().unwrap())
}

/// Sends poses until one has arrived: the route is up.
fn reaches(sender: &Bus, topic_text: &str, receiver: &Arc<Inbox>) {
    let publisher = sender
        .publisher(topic(topic_text), PublisherOptions::POSE)
        .unwrap();
    let deadline = Instant::now() + TIMEOUT;
    loop {
        assert!(Instant::now() < deadline, "nothing comes on {topic_text}");
        publisher.submit(7, estimate());
        if let bus::bounded_queue::Pop::Item(came, Event::Message(arrival)) =
            receiver.take(Some(Instant::now() + Duration::from_millis(100)))
            && came == topic(topic_text)
        {
            assert_eq!(
                arrival.decode::<PoseEstimate>(&Limits::DEFAULT).unwrap(),
                estimate()
            );
            return publisher.finish();
        }
    }
}

#[test]
fn a_fleet_with_keys_performs_all_its_operations() {
    let folder = tempfile::tempdir().unwrap();
    let keys = keys_for(
        folder.path(),
        &[
            "agent-1", "ego-1", "link-1", "replay", "scorer", "recorder", "viewer", "ros2",
        ],
    );
    let router = GuardedRouter::open(&keys);
    let [agent, ego, link, replay, scorer, recorder, viewer, ros2] = [
        "agent-1", "ego-1", "link-1", "replay", "scorer", "recorder", "viewer", "ros2",
    ]
    .map(|principal| router.join(principal));
    let subscribe = |bus: &Bus, text: &str| {
        let inbox = bus.inbox(64, 4);
        let subscription = bus.subscribe(topic(text), &inbox).unwrap();
        (inbox, subscription)
    };
    // Each process receives its topics.
    for (sender, text, receivers) in [
        (
            &agent,
            "1/pose",
            [&ego, &link, &scorer, &viewer, &ros2].as_slice(),
        ),
        (&link, "rx/1/2/pose", &[&ego, &viewer]),
    ] {
        for receiver in receivers {
            let (inbox, _subscription) = subscribe(receiver, text);
            reaches(sender, text, &inbox);
        }
    }
    let tap = recorder
        .tap(&[protocol::KeyExpr::run(&recorder.identity().run)], 64)
        .unwrap();
    let (inbox, _subscription) = subscribe(&agent, "1/gnss");
    let publisher = replay
        .publisher(topic("1/gnss"), PublisherOptions::SENSOR)
        .unwrap();
    let route = Route {
        topic: topic("1/gnss"),
        receiver: agent.identity().process.clone(),
    };
    Barrier::new([route])
        .await_routes(&replay)
        .unwrap()
        .wait(TIMEOUT)
        .unwrap();
    let measured = Gnss {
        world_from_lidar: Pose::IDENTITY,
        position_std_m: 0.0,
        heading_std_rad: 0.0,
        source: GnssSource::Recorded,
    };
    publisher.submit(3, measured);
    let (_, Event::Message(_)) = next_event(&inbox) else {
        panic!("an end before the message")
    };
    // The flush barrier does not cover passive subscribers: their route may come up later.
    let is_gnss = |taken| matches!(taken, bus::bounded_queue::Pop::Item(found, _) if found == topic("1/gnss"));
    wait_for("the recorder", || {
        publisher.submit(3, measured);
        is_gnss(tap.take(Some(Instant::now())))
    });
    publisher.finish();

    // The replay detects the subscriber to previews.
    let viewing = viewer
        .tap(
            &[protocol::KeyExpr::stream(
                &viewer.identity().run,
                Stream::Preview,
            )],
            4,
        )
        .unwrap();
    let preview = replay
        .publisher(topic("1/@preview"), PublisherOptions::PREVIEW)
        .unwrap();
    wait_for("an onlooker", || preview.is_wanted());
    wait_for("a preview", || {
        preview.submit(3, Lidar::default());
        matches!(
            viewing.take(Some(Instant::now())),
            bus::bounded_queue::Pop::Item(..)
        )
    });
    preview.finish();
    drop(viewing);

    // A LiDAR of a ROS 2 network is that of an agent.
    let (inbox, _subscription) = subscribe(&agent, "1/lidar");
    let lidar = ros2
        .publisher(topic("1/lidar"), PublisherOptions::SENSOR)
        .unwrap();
    wait_for("a sweep", || {
        lidar.submit(3, Lidar::default());
        let taken = inbox.take(Some(Instant::now() + Duration::from_millis(10)));
        matches!(taken, bus::bounded_queue::Pop::Item(_, Event::Message(_)))
    });
    lidar.finish();

    // Membership is visible to its subscribers.
    let seen = Arc::<Mutex<Vec<bool>>>::default();
    let _watch = ego.watch(protocol::Role::Agent, {
        let seen = Arc::clone(&seen);
        move |_, is_there| seen.lock().unwrap().push(is_there)
    });
    let presence = agent.announce(protocol::Role::Agent).unwrap();
    wait_for("a liveliness event", || {
        seen.lock().unwrap().contains(&true)
    });
    presence.withdraw().unwrap();
    wait_for("a farewell", || seen.lock().unwrap().contains(&false));

    // And no process published anything that was refused.
    for principal in [
        "agent-1", "ego-1", "link-1", "replay", "scorer", "recorder", "viewer", "ros2",
    ] {
        let refused = ["put", "query", "declare", "interest"]
            .map(|message| router.refused(principal, message));
        assert_eq!(refused, [0; 4], "{principal}");
    }
    for bus in [agent, ego, link, replay, scorer, recorder, viewer, ros2] {
        // Bounded: a query that the router does not answer would take all of it.
        let began = Instant::now();
        bus.leave(TIMEOUT).unwrap();
        assert!(began.elapsed() < TIMEOUT / 2);
    }
}

#[test]
fn a_certificate_is_valid_for_its_own_vehicle_only() {
    let folder = tempfile::tempdir().unwrap();
    let keys = keys_for(folder.path(), &["agent-1", "agent-2", "ego-1", "viewer"]);
    let router = GuardedRouter::open(&keys);
    let (captured, _everything) = captured_keys(&router.session);
    let (honest, ego) = (router.join("agent-2"), router.join("ego-1"));
    let inbox = ego.inbox(64, 4);
    let _subscription = ego.subscribe(topic("2/pose"), &inbox).unwrap();

    // It has a certificate of the fleet, and claims to be vehicle 2.
    let attacker = router.join_as("agent-1", "agent-2", "2").unwrap();
    let session = attacker.session();
    let forged = [
        "2/pose",       // another's id
        "*/pose",       // of every vehicle
        "**",           // everything
        "1/detections", // of its own vehicle, but not a topic of its role
        "1/lidar",
        "rx/1/2/pose", // behind another's link
        "truth",
        "control/start",
        "ready/agent-2",
        "stats/agent-2",
        "nobody",
    ];
    for (index, text) in forged.iter().enumerate() {
        session
            .put(format!("v2v/test/{text}"), forged_pose("2"))
            .congestion_control(CongestionControl::Block)
            .wait()
            .unwrap();
        wait_for(text, || router.refused("agent-1", "put") > index as u64);
    }
    session.delete("v2v/test/2/pose").wait().unwrap();
    wait_for("a delete", || router.refused("agent-1", "delete") > 0);
    // Another run is another fleet.
    session
        .put("v2v/other/1/pose", forged_pose("1"))
        .wait()
        .unwrap();
    // A queryable where no query is allowed, a subscriber to the truth, a liveliness token of another process.
    let _queryable = session
        .declare_queryable("v2v/test/undeclared")
        .callback(|_| panic!("queried"))
        .wait()
        .unwrap();
    let _truth = session
        .declare_subscriber("v2v/test/truth")
        .callback(|_| panic!("received"))
        .wait()
        .unwrap();
    let _presence = session
        .liveliness()
        .declare_token("v2v/test/alive/agent/2")
        .wait()
        .unwrap();
    wait_for("declarations", || router.refused("agent-1", "declare") >= 3);
    let tokens = router
        .session
        .liveliness()
        .get("v2v/test/alive/**")
        .wait()
        .unwrap();
    assert!(tokens.recv().is_err(), "no process has declared itself");
    let answers = session
        .get(format!("@/{}/**", router.session.zid()))
        .timeout(TRIED_FOR)
        .wait()
        .unwrap();
    let answered: Vec<_> = answers
        .iter()
        .filter_map(|answer| answer.into_result().ok())
        .collect();
    assert!(
        answered.is_empty(),
        "the router discloses its configuration: {answered:?}"
    );

    reaches(&honest, "2/pose", &inbox);
    reaches(&attacker, "1/pose", &{
        let inbox = ego.inbox(64, 4);
        std::mem::forget(ego.subscribe(topic("1/pose"), &inbox).unwrap());
        inbox
    });
    let captured = captured.lock().unwrap().clone();
    let own = |key: &String| {
        [
            "v2v/test/1/",
            "v2v/test/2/",
            "v2v/test/stats/",
            "v2v/test/ready/",
        ]
        .iter()
        .any(|own| key.starts_with(own))
    };
    assert!(captured.iter().all(own), "{captured:?}");
    assert!(
        !captured.contains("v2v/test/1/detections") && !captured.contains("v2v/test/1/lidar"),
        "{captured:?}"
    );
    assert!(
        !captured.contains("v2v/test/stats/agent-1"),
        "it claimed to be agent-2: {captured:?}"
    );
    assert_eq!(
        router.refused("agent-2", "put") + router.refused("ego-1", "put"),
        0
    );
}

#[test]
fn a_header_under_another_name_is_counted_as_such() {
    let folder = tempfile::tempdir().unwrap();
    let router = GuardedRouter::open(&keys_for(folder.path(), &["agent-1", "ego-1"]));
    let (agent, ego) = (router.join("agent-1"), router.join("ego-1"));
    let inbox = ego.inbox(64, 4);
    let _subscription = ego.subscribe(topic("1/pose"), &inbox).unwrap();
    reaches(&agent, "1/pose", &inbox);
    agent
        .session()
        .put("v2v/test/1/pose", forged_pose("2"))
        .wait()
        .unwrap();
    let here = protocol::Account::towards(topic("1/pose"), &ego.identity().process);
    let reason = protocol::DropReason::Identity;
    wait_for("a refusal", || {
        ego.stats()
            .ledger()
            .get(&here)
            .is_some_and(|counts| counts.dropped.get(&reason) == Some(&1))
    });
}

#[test]
fn unknown_clients_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let keys = keys_for(&folder.path().join("ours"), &["agent-1", "ego-1"]);
    let theirs = keys_for(&folder.path().join("theirs"), &["agent-1"]);
    // Of the same authority, and for a few seconds only.
    let plan = KeyPlan::new(&keys, vec!["agent-3".parse().unwrap()], 1);
    make(&KeyPlan {
        lifetime: Duration::from_secs(1),
        ..plan
    })
    .unwrap();
    let router = GuardedRouter::open(&keys);
    let (agent, ego) = (router.join("agent-1"), router.join("ego-1"));
    let inbox = ego.inbox(64, 4);
    let _subscription = ego.subscribe(topic("1/pose"), &inbox).unwrap();
    std::thread::sleep(Duration::from_millis(2100));

    let expired = Credentials::read(&keys.join("agent-3"))
        .unwrap_err()
        .to_string();
    assert!(expired.contains("agent-3 expired"), "{expired}");
    let plain = || {
        // Without the bus's own check of endpoints: the same port, of TCP.
        let text = router.endpoint.as_str().replace("quic/", "tcp/");
        let mut options = BusOptions::client(text.parse().unwrap());
        options.connect_timeout = TRIED_FOR;
        bus::open(&options)
    };
    std::thread::scope(|scope| {
        let other_authority = scope.spawn(|| {
            unauthorised_peer(
                &router.endpoint,
                &keys.join("agent-1"),
                Some(&theirs.join("agent-1")),
            )
        });
        let expired = scope.spawn(|| {
            unauthorised_peer(
                &router.endpoint,
                &keys.join("agent-1"),
                Some(&keys.join("agent-3")),
            )
        });
        let no_certificate =
            scope.spawn(|| unauthorised_peer(&router.endpoint, &keys.join("agent-1"), None));
        let plain = scope.spawn(plain);
        // Nor does a client connect to a router of another authority.
        let our_side = scope.spawn(|| {
            unauthorised_peer(
                &router.endpoint,
                &theirs.join("agent-1"),
                Some(&theirs.join("agent-1")),
            )
        });
        for (what, tried) in [
            ("other", other_authority),
            ("expired", expired),
            ("none", no_certificate),
            ("our side", our_side),
        ] {
            assert!(tried.join().unwrap().is_err(), "{what}");
        }
        assert!(matches!(
            plain.join().unwrap(),
            Err(BusError::Unreachable { .. })
        ));
        // Meanwhile the fleet goes on.
        reaches(&agent, "1/pose", &inbox);
    });
}

#[test]
fn a_certificate_that_runs_out_ends_its_connection() {
    let folder = tempfile::tempdir().unwrap();
    let keys = keys_for(folder.path(), &["ego-1"]);
    let plan = KeyPlan::new(&keys, vec!["agent-3".parse().unwrap()], 1);
    make(&KeyPlan {
        lifetime: Duration::from_secs(15),
        ..plan
    })
    .unwrap();
    let router = GuardedRouter::open(&keys);
    let ego = router.join("ego-1");
    let inbox = ego.inbox(64, 4);
    let _subscription = ego.subscribe(topic("3/pose"), &inbox).unwrap();
    let agent = router
        .join_as("agent-3", "agent-3", "3")
        .expect("a connection while the certificate holds");
    let watched = Arc::<Mutex<Vec<bool>>>::default();
    let _watch = ego.watch(protocol::Role::Agent, {
        let watched = Arc::clone(&watched);
        move |_, is_there| watched.lock().unwrap().push(is_there)
    });
    let _presence = agent.announce(protocol::Role::Agent).unwrap();
    wait_for("the end of a certificate", || {
        watched.lock().unwrap().contains(&false)
    });
}

#[test]
fn large_messages_come_whole_and_in_order() {
    const COUNT: u64 = 8;
    let folder = tempfile::tempdir().unwrap();
    let router = GuardedRouter::open(&keys_for(folder.path(), &["agent-1", "ego-1"]));
    let [agent, ego] = ["agent-1", "ego-1"].map(|principal| router.join(principal));
    let inbox = ego.inbox(64, 8);
    // 8 MiB each. A peer that has received the second subscription has received the first.
    let cloud = |tick: u64| PointCloud {
        xyzi: vec![[tick as f32, 2.0, 3.0, 0.5]; 1 << 19],
    };
    let _subscriptions =
        ["1/points", "1/pose"].map(|text| ego.subscribe(topic(text), &inbox).unwrap());
    reaches(&agent, "1/pose", &inbox);
    let publisher = agent
        .publisher(
            topic("1/points"),
            PublisherOptions::FEATURES.lossless(COUNT as usize),
        )
        .unwrap();
    (0..COUNT).for_each(|tick| {
        publisher.submit(
            tick,
            Points {
                pose: estimate(),
                points: cloud(tick),
            },
        )
    });
    for tick in 0..COUNT {
        let arrival = loop {
            match next_event(&inbox) {
                (found, Event::Message(arrival)) if found == topic("1/points") => break arrival,
                _ => {}
            }
        };
        assert!(
            arrival.decode::<Points>(&Limits::DEFAULT).unwrap().points == cloud(tick),
            "{tick}"
        );
    }
    publisher.finish();
}

#[test]
fn a_message_over_the_size_limit_is_refused_and_others_are_not_affected() {
    let folder = tempfile::tempdir().unwrap();
    let router = GuardedRouter::open(&keys_for(folder.path(), &["agent-1", "agent-2", "ego-1"]));
    let [agent, honest, ego] =
        ["agent-1", "agent-2", "ego-1"].map(|principal| router.join(principal));
    let inbox = ego.inbox(64, 8);
    let topics = ["1/pose", "2/pose", "1/bev"];
    let _subscriptions = topics.map(|text| ego.subscribe(topic(text), &inbox).unwrap());
    reaches(&agent, "1/pose", &inbox);
    // More than a router accepts from any peer, and more than a pose ever has.
    for (text, bytes) in [("1/bev", 40 << 20), ("1/pose", 1 << 20)] {
        let _ = agent
            .session()
            .put(format!("v2v/test/{text}"), vec![0_u8; bytes])
            .congestion_control(CongestionControl::Block)
            .wait();
    }
    reaches(&honest, "2/pose", &inbox);
    reaches(&agent, "1/pose", &inbox);
    assert_eq!(
        router.refused("agent-1", "put"),
        1,
        "the pose; the map was never complete"
    );
    let unsound = |text| {
        let here = protocol::Account::towards(topic(text), &ego.identity().process);
        ego.stats().ledger().get(&here).map_or(0, |counts| {
            counts
                .dropped
                .get(&protocol::DropReason::Decode)
                .copied()
                .unwrap_or(0)
        })
    };
    assert_eq!(
        (unsound("1/bev"), unsound("1/pose")),
        (0, 0),
        "not even the ego's own limits had to see it"
    );
}

#[test]
fn a_router_with_keys_receives_its_own_probes() {
    let folder = tempfile::tempdir().unwrap();
    let keys = keys_for(folder.path(), &["agent-1"]);
    let router = GuardedRouter::open(&keys);
    let client = BusOptions::client(router.endpoint.clone())
        .with_credentials(Credentials::read(&keys.join(bus::ROUTER)).unwrap());
    let mut probe = bus::RouterProbe::of_router(&router.session, &client).unwrap();
    let began = Instant::now();
    while began.elapsed() < Duration::from_secs(3) {
        let silence = probe.silence(Instant::now());
        assert!(silence < Duration::from_secs(2), "{silence:?}");
        std::thread::sleep(Duration::from_millis(100));
    }
    probe.end(false);
}
