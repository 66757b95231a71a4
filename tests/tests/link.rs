//! The emulated air in a live run: an agent, the link and an ego over real zenoh sessions.

use std::path::Path;
use std::time::Duration;

use protocol::message::Points;
use protocol::{CavId, DropReason, Ledger, Limits, PointCloud, Pose, PoseEstimate, Role, Stream, Topic};
use sim_replay::bus::shutdown::Stop;
use sim_replay::bus::{Barrier, Bus, Event, PublisherOptions, Route};
use sim_replay::link::node::{self, LinkReport, NodeOptions};
use sim_replay::link::{Air, CapacityConfig, DelayLaw, LinkConfig, LossLaw};
use tests::bus::{PATIENCE, TestRouter, next_event};

/// Sweeps that are sent, and their points: 16 kB each.
const COUNT: u64 = 6;
const POINTS: u16 = 1000;

fn cav(text: &str) -> CavId {
    CavId::new(text).unwrap()
}

fn points(tick: u64) -> Points {
    let xyzi = (0..POINTS).map(|point| [f32::from(point), tick as f32, 0.0, 0.5]).collect();
    Points { pose: PoseEstimate::new(Pose::IDENTITY, 1.0), points: PointCloud { xyzi } }
}

/// When each message came, after the first was offered, by capture time; what the link says; all books.
struct Crossing {
    arrivals: Vec<(u64, Duration)>,
    report: LinkReport,
    ledger: Ledger,
}

/// Sends all sweeps at once through a link.
fn cross(config: LinkConfig) -> Crossing {
    let router = TestRouter::open();
    let [agent, link, ego] =
        [("agent-7", "7"), ("link-9", "9"), ("ego-9", "9")].map(|(name, id)| router.join(name, id));
    let air = Air::new(config, Path::new("."), 1).unwrap();
    let options = NodeOptions { ego: cav("9"), streams: vec![Stream::Points], keeps_running: false };
    let (sent, received) = (
        Topic::Stream { cav: cav("7"), stream: Stream::Points },
        Topic::Received { ego: cav("9"), cav: cav("7"), stream: Stream::Points },
    );
    let inbox = ego.inbox(64, 1);
    let _subscription = ego.subscribe(received.clone(), &inbox).unwrap();
    let stop = Stop::new();
    let (arrivals, report) = std::thread::scope(|scope| {
        let carrying = scope.spawn(|| node::run(&link, air, &options, &stop).unwrap());
        let presence = agent.announce(Role::Agent).unwrap();
        let publisher = agent.publisher(sent.clone(), PublisherOptions::FEATURES.lossless(16)).unwrap();
        let wait = |bus: &Bus, topic: &Topic, receiver: &str| {
            let route = Route { topic: topic.clone(), receiver: receiver.parse().unwrap() };
            Barrier::new([route]).attend(bus).unwrap().wait(PATIENCE).unwrap();
        };
        wait(&agent, &sent, "link-9");
        wait(&agent, &received, "ego-9");
        let began = std::time::Instant::now();
        (0..COUNT).for_each(|tick| publisher.offer(tick, points(tick)));
        publisher.finish();
        let mut arrivals = Vec::new();
        // What ends on one side of the link ends on the other.
        while let (_, Event::Message(arrival)) = next_event(&inbox) {
            let tick = arrival.header.stamp.capture_nanos;
            assert_eq!((&arrival.header.stamp.cav, arrival.header.stamp.sequence), (&cav("7"), tick));
            assert_eq!(inbox.decode::<Points>(&arrival, &Limits::DEFAULT).unwrap(), points(tick));
            ego.books().received(&received);
            arrivals.push((tick, arrival.at - began));
        }
        let report = carrying.join().unwrap();
        presence.withdraw().unwrap();
        (arrivals, report)
    });
    let mut ledger = Ledger::default();
    [&agent, &link, &ego].iter().for_each(|bus| ledger.merge(&bus.books().ledger()));
    assert!(ledger.balance().is_exact(), "{:?}", ledger.balance());
    Crossing { arrivals, report, ledger }
}

#[test]
fn messages_come_late_in_order_and_unchanged() {
    let capacity = CapacityConfig::TokenBucket { rate_mbps: 8.0, burst_bytes: 0 };
    let config = LinkConfig { capacity, delay: DelayLaw::ConstantMs(30.0), ..LinkConfig::default() };
    let Crossing { arrivals, report, ledger } = cross(config);
    assert_eq!(arrivals.iter().map(|(tick, _)| *tick).collect::<Vec<_>>(), (0..COUNT).collect::<Vec<_>>());
    for (tick, late) in &arrivals {
        // 16 kB at 1,000 bytes a millisecond, one after the other, then 30 ms.
        let earliest = Duration::from_millis(16 * (tick + 1) + 30);
        assert!(*late >= earliest, "{tick} came after {late:?}, its bits take {earliest:?}");
    }
    assert_eq!((report.offered, report.arrived, report.under_way), (COUNT, COUNT, 0));
    assert_eq!((ledger.total().sent, ledger.total().received), (2 * COUNT, 2 * COUNT));
}

#[test]
fn what_the_air_loses_is_booked_and_never_arrives() {
    let Crossing { arrivals, report, ledger } =
        cross(LinkConfig { loss: LossLaw::Bernoulli(1.0), ..LinkConfig::default() });
    assert_eq!((arrivals.len(), report.arrived), (0, 0));
    assert_eq!(report.dropped, [(DropReason::LinkLoss, COUNT)].into());
    assert_eq!(ledger.total().dropped[&DropReason::LinkLoss], COUNT);
}
