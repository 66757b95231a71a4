//! Link emulation in a live run: an agent, the link and an ego over real zenoh sessions.

use std::path::Path;
use std::time::Duration;

use bus::shutdown::Stop;
use bus::{Barrier, Bus, Event, InboxLimits, PublisherOptions, Route};
use link::{
    CapacityConfig, DeviceClock, LatencyModel, LinkConfig, LinkEmulator, LossModel, TraceConfig,
};
use protocol::message::Points;
use protocol::{
    CavId, DropReason, Ledger, Limits, PointCloud, Pose, PoseEstimate, Role, Stream, Topic,
};
use sim_replay::link_node::{self, LinkReport, NodeOptions};
use tests::bus::{TIMEOUT, TestRouter, link_options, next_event, wait_for};

/// Number of sweeps that are sent, and of their points: 16 kB each.
const COUNT: u64 = 6;
const POINTS: u16 = 1000;

fn cav(text: &str) -> CavId {
    CavId::new(text).unwrap()
}

fn points(tick: u64) -> Points {
    let xyzi = (0..POINTS)
        .map(|point| [f32::from(point), tick as f32, 0.0, 0.5])
        .collect();
    Points {
        pose: PoseEstimate::new(Pose::IDENTITY, 1.0),
        points: PointCloud { xyzi },
    }
}

/// Arrival time of each message after the first was submitted, by capture time; the link's report; the sum of all
/// ledgers.
struct Crossing {
    arrivals: Vec<(u64, Duration)>,
    report: LinkReport,
    ledger: Ledger,
}

/// The link between agent 7 and the ego 9.
fn options() -> NodeOptions {
    link_options(cav("9"), Stream::Points)
}

/// Waits until a topic of the bus's process reaches a receiver.
fn wait_for_route(bus: &Bus, topic: &Topic, receiver: &str) {
    let route = Route {
        topic: topic.clone(),
        receiver: receiver.parse().unwrap(),
    };
    Barrier::new([route])
        .await_routes(bus)
        .unwrap()
        .wait(TIMEOUT)
        .unwrap();
}

/// Sends all sweeps at once through a link.
fn cross(config: LinkConfig, options: &NodeOptions) -> Crossing {
    let router = TestRouter::open();
    let [agent, link, ego] =
        [("agent-7", "7"), ("link-9", "9"), ("ego-9", "9")].map(|(name, id)| router.join(name, id));
    let emulator = LinkEmulator::new(config, Path::new("."), 1).unwrap();
    let (sent, received) = (
        Topic::Stream {
            cav: cav("7"),
            stream: Stream::Points,
        },
        Topic::Received {
            ego: cav("9"),
            cav: cav("7"),
            stream: Stream::Points,
        },
    );
    let inbox = ego.inbox(64, 1);
    let _subscription = ego.subscribe(received.clone(), &inbox).unwrap();
    let stop = Stop::new();
    let (arrivals, report) = std::thread::scope(|scope| {
        let carrying = scope.spawn(|| link_node::run(&link, emulator, options, &stop).unwrap());
        let presence = agent.announce(Role::Agent).unwrap();
        let publisher = agent
            .publisher(sent.clone(), PublisherOptions::FEATURES.lossless(16))
            .unwrap();
        wait_for_route(&agent, &sent, "link-9");
        wait_for_route(&agent, &received, "ego-9");
        let began = std::time::Instant::now();
        (0..COUNT).for_each(|tick| publisher.submit(tick, points(tick)));
        publisher.finish();
        let mut arrivals = Vec::new();
        // The end of the agent's topic is forwarded to the ego.
        while let (_, Event::Message(arrival)) = next_event(&inbox) {
            let stamp = &arrival.header.stamp;
            assert_eq!(
                (&stamp.cav, stamp.sequence),
                (&cav("7"), arrivals.len() as u64)
            );
            assert_eq!(
                inbox.decode::<Points>(&arrival, &Limits::DEFAULT).unwrap(),
                points(stamp.sequence)
            );
            ego.stats().received(&received);
            arrivals.push((stamp.capture_nanos, arrival.at - began));
        }
        let report = carrying.join().unwrap();
        presence.withdraw().unwrap();
        (arrivals, report)
    });
    let mut ledger = Ledger::default();
    [&agent, &link, &ego]
        .iter()
        .for_each(|bus| ledger.merge(&bus.stats().ledger()));
    assert!(ledger.balance().is_exact(), "{:?}", ledger.balance());
    Crossing {
        arrivals,
        report,
        ledger,
    }
}

#[test]
fn messages_come_late_in_order_and_unchanged() {
    let capacity = CapacityConfig::TokenBucket {
        bandwidth_mbps: 8.0,
        burst_bytes: 0,
    };
    let config = LinkConfig {
        capacity,
        latency: LatencyModel::ConstantMs(30.0),
        ..LinkConfig::default()
    };
    let Crossing {
        arrivals,
        report,
        ledger,
    } = cross(config, &options());
    assert_eq!(
        arrivals.iter().map(|(tick, _)| *tick).collect::<Vec<_>>(),
        (0..COUNT).collect::<Vec<_>>()
    );
    for (tick, late) in &arrivals {
        // 16 kB at 1,000 bytes a millisecond, one after the other, then 30 ms.
        let earliest = Duration::from_millis(16 * (tick + 1) + 30);
        assert!(
            *late >= earliest,
            "{tick} came after {late:?}, its bits take {earliest:?}"
        );
    }
    assert_eq!(
        (report.submitted, report.arrived, report.under_way),
        (COUNT, COUNT, 0)
    );
    assert_eq!(
        (ledger.total().sent, ledger.total().received),
        (2 * COUNT, 2 * COUNT)
    );
}

#[test]
fn a_lost_message_is_counted_and_never_arrives() {
    let Crossing {
        arrivals,
        report,
        ledger,
    } = cross(
        LinkConfig {
            loss: LossModel::Bernoulli(1.0),
            ..LinkConfig::default()
        },
        &options(),
    );
    assert_eq!((arrivals.len(), report.arrived), (0, 0));
    assert_eq!(report.dropped, [(DropReason::LinkLoss, COUNT)].into());
    assert_eq!(ledger.total().dropped[&DropReason::LinkLoss], COUNT);
}

#[test]
fn a_clock_that_is_off_shows_in_the_capture_times() {
    let clock = DeviceClock {
        offset_ms: 1.0,
        ..DeviceClock::default()
    };
    let Crossing {
        arrivals, ledger, ..
    } = cross(
        LinkConfig {
            clock,
            ..LinkConfig::default()
        },
        &options(),
    );
    // A message without a capture time has 0.
    let shown: Vec<u64> = (0..COUNT)
        .map(|tick| if tick == 0 { 0 } else { tick + 1_000_000 })
        .collect();
    assert_eq!(
        arrivals.iter().map(|(tick, _)| *tick).collect::<Vec<_>>(),
        shown
    );
    assert!(ledger.balance().is_exact(), "{:?}", ledger.balance());
}

#[test]
fn a_long_delay_keeps_no_more_than_it_may() {
    // Without a rate there is no queue that could be full. All are sent long before the first arrives.
    let config = LinkConfig {
        latency: LatencyModel::ConstantMs(4000.0),
        ..LinkConfig::default()
    };
    let room_for_two = NodeOptions {
        max_kept_bytes: 40_000,
        ..options()
    };
    let Crossing {
        arrivals,
        report,
        ledger,
    } = cross(config, &room_for_two);
    assert_eq!(
        arrivals.iter().map(|(tick, _)| *tick).collect::<Vec<_>>(),
        [0, 1]
    );
    assert_eq!((report.submitted, report.arrived), (COUNT, 2));
    assert_eq!(report.dropped, [(DropReason::LinkQueue, COUNT - 2)].into());
    assert_eq!(ledger.total().dropped[&DropReason::LinkQueue], COUNT - 2);
}

#[test]
fn a_link_that_carries_nothing_reports_it() {
    let router = TestRouter::open();
    let [agent, link] = [("agent-7", "7"), ("link-9", "9")].map(|(name, id)| router.join(name, id));
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(
        folder.path().join("rates.csv"),
        "time_s,bandwidth_mbps,latency_ms,loss\n0,27,0,0\n60,0,0,0\n",
    )
    .unwrap();
    let trace = TraceConfig {
        offset_s: 60.0,
        ..TraceConfig::new(Path::new("rates.csv"))
    };
    let config = LinkConfig {
        capacity: CapacityConfig::Trace(trace),
        ..LinkConfig::default()
    };
    let emulator = LinkEmulator::new(config, folder.path(), 1).unwrap();
    let (sent, stop, options) = (
        Topic::Stream {
            cav: cav("7"),
            stream: Stream::Points,
        },
        Stop::new(),
        options(),
    );
    let report = std::thread::scope(|scope| {
        let carrying = scope.spawn(|| link_node::run(&link, emulator, &options, &stop).unwrap());
        let _presence = agent.announce(Role::Agent).unwrap();
        let publisher = agent
            .publisher(sent.clone(), PublisherOptions::FEATURES.lossless(16))
            .unwrap();
        wait_for_route(&agent, &sent, "link-9");
        (0..COUNT).for_each(|tick| publisher.submit(tick, points(tick)));
        publisher.finish();
        // Longer than any useful message is in flight.
        std::thread::sleep(Duration::from_millis(5_500));
        stop.request();
        carrying.join().unwrap()
    });
    assert_eq!(
        (report.submitted, report.arrived, report.under_way),
        (COUNT, 0, COUNT),
        "{report:?}"
    );
    assert!(
        report.longest_ms > 5_000 && !report.is_complete(),
        "{report:?}"
    );
}

#[test]
fn messages_in_flight_at_the_end_are_not_lost() {
    let router = TestRouter::open();
    let [agent, link] = [("agent-7", "7"), ("link-9", "9")].map(|(name, id)| router.join(name, id));
    let config = LinkConfig {
        latency: LatencyModel::ConstantMs(60_000.0),
        ..LinkConfig::default()
    };
    let emulator = LinkEmulator::new(config, Path::new("."), 1).unwrap();
    let (sent, stop, options) = (
        Topic::Stream {
            cav: cav("7"),
            stream: Stream::Points,
        },
        Stop::new(),
        options(),
    );
    std::thread::scope(|scope| {
        let carrying = scope.spawn(|| link_node::run(&link, emulator, &options, &stop).unwrap());
        let _presence = agent.announce(Role::Agent).unwrap();
        let publisher = agent
            .publisher(sent.clone(), PublisherOptions::FEATURES.lossless(16))
            .unwrap();
        wait_for_route(&agent, &sent, "link-9");
        (0..COUNT).for_each(|tick| publisher.submit(tick, points(tick)));
        publisher.finish();
        let is_held = || link.stats().ledger().total().in_flight >= COUNT;
        wait_for("all messages at the link", is_held);
        stop.request();
        carrying.join().unwrap()
    });
    let total = link.stats().ledger().total();
    assert!(!total.dropped.contains_key(&DropReason::Stale), "{total:?}");
}

#[test]
fn a_flood_is_limited_before_the_link() {
    let router = TestRouter::open();
    let [agent, link] = [("agent-7", "7"), ("link-9", "9")].map(|(name, id)| router.join(name, id));
    let emulator = LinkEmulator::new(LinkConfig::default(), Path::new("."), 1).unwrap();
    let (sent, stop) = (
        Topic::Stream {
            cav: cav("7"),
            stream: Stream::Points,
        },
        Stop::new(),
    );
    // Little more than the probe of the route.
    let narrow = NodeOptions {
        inbox: InboxLimits {
            messages_per_s: 0.6,
            ..InboxLimits::PEERS
        },
        ..options()
    };
    let report = std::thread::scope(|scope| {
        let carrying = scope.spawn(|| link_node::run(&link, emulator, &narrow, &stop).unwrap());
        let _presence = agent.announce(Role::Agent).unwrap();
        let publisher = agent
            .publisher(sent.clone(), PublisherOptions::FEATURES.lossless(16))
            .unwrap();
        wait_for_route(&agent, &sent, "link-9");
        (0..COUNT).for_each(|tick| publisher.submit(tick, points(tick)));
        publisher.finish();
        let refused = || {
            link.stats()
                .ledger()
                .total()
                .dropped
                .get(&DropReason::RateLimit)
                .is_some_and(|count| *count > 0)
        };
        wait_for("a refusal", refused);
        stop.request();
        carrying.join().unwrap()
    });
    assert!(report.submitted < COUNT, "{report:?}");
}

#[test]
fn an_agent_that_comes_back_is_carried_again() {
    let router = TestRouter::open();
    let [link, ego, other] =
        [("link-9", "9"), ("ego-9", "9"), ("agent-8", "8")].map(|(name, id)| router.join(name, id));
    let received = Topic::Received {
        ego: cav("9"),
        cav: cav("7"),
        stream: Stream::Points,
    };
    let sent = Topic::Stream {
        cav: cav("7"),
        stream: Stream::Points,
    };
    let inbox = ego.inbox(64, 1);
    let _subscription = ego.subscribe(received.clone(), &inbox).unwrap();
    let (stop, options) = (Stop::new(), options());
    let mut ledger = Ledger::default();
    std::thread::scope(|scope| {
        // The link does not end while another agent is alive.
        let presence = other.announce(Role::Agent).unwrap();
        let emulator = LinkEmulator::new(LinkConfig::default(), Path::new("."), 1).unwrap();
        let carrying = scope.spawn(|| link_node::run(&link, emulator, &options, &stop).unwrap());
        for ticks in [0..3, 3..6] {
            let agent = router.join("agent-7", "7");
            let presence = agent.announce(Role::Agent).unwrap();
            let publisher = agent
                .publisher(sent.clone(), PublisherOptions::FEATURES.lossless(16))
                .unwrap();
            wait_for_route(&agent, &sent, "link-9");
            wait_for_route(&agent, &received, "ego-9");
            ticks
                .clone()
                .for_each(|tick| publisher.submit(tick, points(tick)));
            publisher.finish();
            for tick in ticks {
                let (_, Event::Message(arrival)) = next_event(&inbox) else {
                    panic!("{tick} does not come")
                };
                assert_eq!(
                    inbox.decode::<Points>(&arrival, &Limits::DEFAULT).unwrap(),
                    points(tick)
                );
                ego.stats().received(&received);
            }
            presence.withdraw().unwrap();
            ledger.merge(&agent.stats().ledger());
            agent.leave(TIMEOUT).unwrap();
        }
        presence.withdraw().unwrap();
        let report = carrying.join().unwrap();
        assert_eq!(
            (report.submitted, report.arrived, report.under_way),
            (6, 6, 0)
        );
        assert!(matches!(next_event(&inbox).1, Event::End { sent: 6, .. }));
    });
    [&link, &ego]
        .iter()
        .for_each(|bus| ledger.merge(&bus.stats().ledger()));
    assert!(ledger.balance().is_exact(), "{:?}", ledger.balance());
}
