//! Key, header and certificate: who may say what, through real sessions over QUIC.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bus::{self, Barrier, Bus, BusError, BusOptions, Credentials, Event, Inbox, PublisherOptions, Route, unix_nanos};
use deploy::operate::keys::{KeyPlan, make};
use protocol::message::Points;
use protocol::{Gnss, GnssSource, Lidar, Limits, PointCloud, Pose, PoseEstimate, Stamp, Stream, Topic, wire};
use tests::bus::{PATIENCE, next_event, wait_for};
use tests::keys::{GuardedRouter, TRIED_FOR, keys_for, stranger};
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait};

fn topic(text: &str) -> Topic {
    text.parse().unwrap()
}

fn estimate() -> PoseEstimate {
    PoseEstimate::new(Pose::IDENTITY, 1.0)
}

/// A sound message of vehicle `cav`, as its own agent would send it.
fn forged_pose(cav: &str) -> Vec<u8> {
    let stamp =
        Stamp { cav: cav.parse().unwrap(), epoch: 1, sequence: 0, capture_nanos: 1, publish_nanos: unix_nanos() };
    let encoded = wire::encode(&stamp, estimate()).unwrap();
    [encoded.head.to_vec(), encoded.body.as_bytes().to_vec()].concat()
}

/// Everything that comes through a router, as its own session sees it.
fn overheard(router: &Session) -> (Arc<Mutex<BTreeSet<String>>>, zenoh::pubsub::Subscriber<()>) {
    let keys = Arc::<Mutex<BTreeSet<String>>>::default();
    let heard = Arc::clone(&keys);
    let subscriber = router.declare_subscriber("v2v/**").callback(move |sample| {
        heard.lock().unwrap().insert(sample.key_expr().to_string());
    });
    (keys, subscriber.wait().unwrap())
}

/// Sends poses until one has come: the route stands.
fn reaches(sender: &Bus, topic_text: &str, receiver: &Arc<Inbox>) {
    let publisher = sender.publisher(topic(topic_text), PublisherOptions::POSE).unwrap();
    let deadline = Instant::now() + PATIENCE;
    loop {
        assert!(Instant::now() < deadline, "nothing comes on {topic_text}");
        publisher.offer(7, estimate());
        if let bus::bounded_queue::Pop::Item(came, Event::Message(arrival)) =
            receiver.take(Some(Instant::now() + Duration::from_millis(100)))
            && came == topic(topic_text)
        {
            assert_eq!(arrival.decode::<PoseEstimate>(&Limits::DEFAULT).unwrap(), estimate());
            return publisher.finish();
        }
    }
}

#[test]
fn a_fleet_with_keys_says_what_it_has_to() {
    let folder = tempfile::tempdir().unwrap();
    let keys = keys_for(folder.path(), &["agent-1", "ego-1", "link-1", "replay", "scorer", "recorder", "viewer"]);
    let router = GuardedRouter::open(&keys);
    let [agent, ego, link, replay, scorer, recorder, viewer] =
        ["agent-1", "ego-1", "link-1", "replay", "scorer", "recorder", "viewer"].map(|party| router.join(party));
    let subscribe = |bus: &Bus, text: &str| {
        let inbox = bus.inbox(64, 4);
        let subscription = bus.subscribe(topic(text), &inbox).unwrap();
        (inbox, subscription)
    };
    // Each hears what is its to hear.
    for (sender, text, receivers) in
        [(&agent, "1/pose", [&ego, &link, &scorer, &viewer].as_slice()), (&link, "rx/1/2/pose", &[&ego, &viewer])]
    {
        for receiver in receivers {
            let (inbox, _subscription) = subscribe(receiver, text);
            reaches(sender, text, &inbox);
        }
    }
    let tap = recorder.tap(&[protocol::KeyExpr::run(&recorder.identity().run)], 64).unwrap();
    let (inbox, _subscription) = subscribe(&agent, "1/gnss");
    let publisher = replay.publisher(topic("1/gnss"), PublisherOptions::SENSOR).unwrap();
    let route = Route { topic: topic("1/gnss"), receiver: agent.identity().process.clone() };
    Barrier::new([route]).await_routes(&replay).unwrap().wait(PATIENCE).unwrap();
    let measured = Gnss {
        world_from_lidar: Pose::IDENTITY,
        position_std_m: 0.0,
        heading_std_rad: 0.0,
        source: GnssSource::Recorded,
    };
    publisher.offer(3, measured);
    let (_, Event::Message(_)) = next_event(&inbox) else { panic!("an end before the message") };
    // The barrier knows nothing of those who only listen: their route may come up later.
    let is_gnss = |taken| matches!(taken, bus::bounded_queue::Pop::Item(heard, _) if heard == topic("1/gnss"));
    wait_for("the recorder", || {
        publisher.offer(3, measured);
        is_gnss(tap.take(Some(Instant::now())))
    });
    publisher.finish();

    // The replay sees that somebody looks.
    let looking = viewer.tap(&[protocol::KeyExpr::stream(&viewer.identity().run, Stream::Preview)], 4).unwrap();
    let preview = replay.publisher(topic("1/@preview"), PublisherOptions::PREVIEW).unwrap();
    wait_for("an onlooker", || preview.is_wanted());
    wait_for("a preview", || {
        preview.offer(3, Lidar::default());
        matches!(looking.take(Some(Instant::now())), bus::bounded_queue::Pop::Item(..))
    });
    preview.finish();
    drop(looking);

    // Who is there is seen by those who follow it.
    let seen = Arc::<Mutex<Vec<String>>>::default();
    let _watch = ego.watch(protocol::Role::Agent, {
        let seen = Arc::clone(&seen);
        move |sighting| seen.lock().unwrap().push(format!("{sighting:?}"))
    });
    let presence = agent.announce(protocol::Role::Agent).unwrap();
    wait_for("a sighting", || seen.lock().unwrap().iter().any(|text| text.starts_with("Appeared")));
    presence.withdraw().unwrap();
    wait_for("a farewell", || seen.lock().unwrap().iter().any(|text| text.starts_with("Vanished")));

    // And nobody said anything that was not.
    for party in ["agent-1", "ego-1", "link-1", "replay", "scorer", "recorder", "viewer"] {
        let refused = ["put", "query", "declare", "interest"].map(|message| router.refused(party, message));
        assert_eq!(refused, [0; 4], "{party}");
    }
    for bus in [agent, ego, link, replay, scorer, recorder, viewer] {
        // Bounded: a question that the router does not answer would take all of it.
        let began = Instant::now();
        bus.leave(PATIENCE).unwrap();
        assert!(began.elapsed() < PATIENCE / 2);
    }
}

#[test]
fn a_certificate_speaks_for_its_own_vehicle_alone() {
    let folder = tempfile::tempdir().unwrap();
    let keys = keys_for(folder.path(), &["agent-1", "agent-2", "ego-1", "viewer"]);
    let router = GuardedRouter::open(&keys);
    let (heard, _everything) = overheard(&router.session);
    let (honest, ego) = (router.join("agent-2"), router.join("ego-1"));
    let inbox = ego.inbox(64, 4);
    let _subscription = ego.subscribe(topic("2/pose"), &inbox).unwrap();

    // It has a certificate of the fleet, and says that it is vehicle 2.
    let liar = router.join_as("agent-1", "agent-2", "2").unwrap();
    let session = liar.session();
    let forged = [
        "2/pose",       // another's id
        "*/pose",       // everybody's
        "**",           // everything
        "1/detections", // of its own vehicle, and not its to say
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
    session.put("v2v/other/1/pose", forged_pose("1")).wait().unwrap();
    // Who answers what nobody may be asked, who listens to the truth, who says that another is there.
    let _queryable = session.declare_queryable("v2v/test/nobody").callback(|_| panic!("asked")).wait().unwrap();
    let _truth = session.declare_subscriber("v2v/test/truth").callback(|_| panic!("told")).wait().unwrap();
    let _presence = session.liveliness().declare_token("v2v/test/alive/agent/2").wait().unwrap();
    wait_for("declarations", || router.refused("agent-1", "declare") >= 3);
    let tokens = router.session.liveliness().get("v2v/test/alive/**").wait().unwrap();
    assert!(tokens.recv().is_err(), "nobody has said that it is there");
    let answers = session.get(format!("@/{}/**", router.session.zid())).timeout(TRIED_FOR).wait().unwrap();
    let told: Vec<_> = answers.iter().filter_map(|answer| answer.into_result().ok()).collect();
    assert!(told.is_empty(), "the router tells its configuration to nobody: {told:?}");

    reaches(&honest, "2/pose", &inbox);
    reaches(&liar, "1/pose", &{
        let inbox = ego.inbox(64, 4);
        std::mem::forget(ego.subscribe(topic("1/pose"), &inbox).unwrap());
        inbox
    });
    let heard = heard.lock().unwrap().clone();
    let own = |key: &String| {
        ["v2v/test/1/", "v2v/test/2/", "v2v/test/stats/", "v2v/test/ready/"].iter().any(|own| key.starts_with(own))
    };
    assert!(heard.iter().all(own), "{heard:?}");
    assert!(!heard.contains("v2v/test/1/detections") && !heard.contains("v2v/test/1/lidar"), "{heard:?}");
    assert!(!heard.contains("v2v/test/stats/agent-1"), "it said it was agent-2: {heard:?}");
    assert_eq!(router.refused("agent-2", "put") + router.refused("ego-1", "put"), 0);
}

#[test]
fn a_header_under_another_name_is_counted_as_such() {
    let folder = tempfile::tempdir().unwrap();
    let router = GuardedRouter::open(&keys_for(folder.path(), &["agent-1", "ego-1"]));
    let (agent, ego) = (router.join("agent-1"), router.join("ego-1"));
    let inbox = ego.inbox(64, 4);
    let _subscription = ego.subscribe(topic("1/pose"), &inbox).unwrap();
    reaches(&agent, "1/pose", &inbox);
    agent.session().put("v2v/test/1/pose", forged_pose("2")).wait().unwrap();
    let here = protocol::Account::towards(topic("1/pose"), &ego.identity().process);
    let reason = protocol::DropReason::Identity;
    wait_for("a refusal", || {
        ego.books().ledger().get(&here).is_some_and(|counts| counts.dropped.get(&reason) == Some(&1))
    });
}

#[test]
fn strangers_are_not_let_in() {
    let folder = tempfile::tempdir().unwrap();
    let keys = keys_for(&folder.path().join("ours"), &["agent-1", "ego-1"]);
    let theirs = keys_for(&folder.path().join("theirs"), &["agent-1"]);
    // Of our authority, and for a few seconds only.
    let plan = KeyPlan::new(&keys, vec!["agent-3".parse().unwrap()], 1);
    make(&KeyPlan { lifetime: Duration::from_secs(1), ..plan }).unwrap();
    let router = GuardedRouter::open(&keys);
    let (agent, ego) = (router.join("agent-1"), router.join("ego-1"));
    let inbox = ego.inbox(64, 4);
    let _subscription = ego.subscribe(topic("1/pose"), &inbox).unwrap();
    std::thread::sleep(Duration::from_millis(2100));

    let expired = Credentials::read(&keys.join("agent-3")).unwrap_err().to_string();
    assert!(expired.contains("agent-3 expired"), "{expired}");
    let plain = || {
        // Past our own check of endpoints: the same port, of TCP.
        let text = router.endpoint.as_str().replace("quic/", "tcp/");
        let mut options = BusOptions::client(text.parse().unwrap());
        options.patience = TRIED_FOR;
        bus::open(&options)
    };
    std::thread::scope(|scope| {
        let other_authority =
            scope.spawn(|| stranger(&router.endpoint, &keys.join("agent-1"), Some(&theirs.join("agent-1"))));
        let expired = scope.spawn(|| stranger(&router.endpoint, &keys.join("agent-1"), Some(&keys.join("agent-3"))));
        let no_certificate = scope.spawn(|| stranger(&router.endpoint, &keys.join("agent-1"), None));
        let plain = scope.spawn(plain);
        // Nor do we speak to a router of another authority.
        let our_side =
            scope.spawn(|| stranger(&router.endpoint, &theirs.join("agent-1"), Some(&theirs.join("agent-1"))));
        for (what, tried) in
            [("other", other_authority), ("expired", expired), ("none", no_certificate), ("our side", our_side)]
        {
            assert!(tried.join().unwrap().is_err(), "{what}");
        }
        assert!(matches!(plain.join().unwrap(), Err(BusError::Unreachable { .. })));
        // Meanwhile the fleet goes on.
        reaches(&agent, "1/pose", &inbox);
    });
}

#[test]
fn a_certificate_that_runs_out_ends_its_connection() {
    let folder = tempfile::tempdir().unwrap();
    let keys = keys_for(folder.path(), &["ego-1"]);
    let plan = KeyPlan::new(&keys, vec!["agent-3".parse().unwrap()], 1);
    make(&KeyPlan { lifetime: Duration::from_secs(15), ..plan }).unwrap();
    let router = GuardedRouter::open(&keys);
    let ego = router.join("ego-1");
    let inbox = ego.inbox(64, 4);
    let _subscription = ego.subscribe(topic("3/pose"), &inbox).unwrap();
    let agent = router.join_as("agent-3", "agent-3", "3").expect("a connection while the certificate holds");
    let watched = Arc::<Mutex<Vec<String>>>::default();
    let _watch = ego.watch(protocol::Role::Agent, {
        let watched = Arc::clone(&watched);
        move |sighting| watched.lock().unwrap().push(format!("{sighting:?}"))
    });
    let _presence = agent.announce(protocol::Role::Agent).unwrap();
    wait_for("the end of a certificate", || watched.lock().unwrap().iter().any(|text| text.starts_with("Vanished")));
}

#[test]
fn large_messages_come_whole_and_in_order() {
    const COUNT: u64 = 8;
    let folder = tempfile::tempdir().unwrap();
    let router = GuardedRouter::open(&keys_for(folder.path(), &["agent-1", "ego-1"]));
    let [agent, ego] = ["agent-1", "ego-1"].map(|party| router.join(party));
    let inbox = ego.inbox(64, 8);
    // 8 MiB each. Whoever is told of the second subscription has been told of the first.
    let cloud = |tick: u64| PointCloud { xyzi: vec![[tick as f32, 2.0, 3.0, 0.5]; 1 << 19] };
    let _subscriptions = ["1/points", "1/pose"].map(|text| ego.subscribe(topic(text), &inbox).unwrap());
    reaches(&agent, "1/pose", &inbox);
    let publisher = agent.publisher(topic("1/points"), PublisherOptions::FEATURES.lossless(COUNT as usize)).unwrap();
    (0..COUNT).for_each(|tick| publisher.offer(tick, Points { pose: estimate(), points: cloud(tick) }));
    for tick in 0..COUNT {
        let arrival = loop {
            match next_event(&inbox) {
                (heard, Event::Message(arrival)) if heard == topic("1/points") => break arrival,
                _ => {}
            }
        };
        assert!(arrival.decode::<Points>(&Limits::DEFAULT).unwrap().points == cloud(tick), "{tick}");
    }
    publisher.finish();
}

#[test]
fn what_is_too_large_goes_nowhere_and_disturbs_nobody() {
    let folder = tempfile::tempdir().unwrap();
    let router = GuardedRouter::open(&keys_for(folder.path(), &["agent-1", "agent-2", "ego-1"]));
    let [agent, honest, ego] = ["agent-1", "agent-2", "ego-1"].map(|party| router.join(party));
    let inbox = ego.inbox(64, 8);
    let topics = ["1/pose", "2/pose", "1/bev"];
    let _subscriptions = topics.map(|text| ego.subscribe(topic(text), &inbox).unwrap());
    reaches(&agent, "1/pose", &inbox);
    // More than a router takes of anyone, and more than a pose ever has.
    for (text, bytes) in [("1/bev", 40 << 20), ("1/pose", 1 << 20)] {
        let _ = agent
            .session()
            .put(format!("v2v/test/{text}"), vec![0_u8; bytes])
            .congestion_control(CongestionControl::Block)
            .wait();
    }
    reaches(&honest, "2/pose", &inbox);
    reaches(&agent, "1/pose", &inbox);
    assert_eq!(router.refused("agent-1", "put"), 1, "the pose; of the map nothing was ever whole");
    let unsound = |text| {
        let here = protocol::Account::towards(topic(text), &ego.identity().process);
        ego.books()
            .ledger()
            .get(&here)
            .map_or(0, |counts| counts.dropped.get(&protocol::DropReason::Decode).copied().unwrap_or(0))
    };
    assert_eq!((unsound("1/bev"), unsound("1/pose")), (0, 0), "not even the ego's own limits had to see it");
}
