//! Flood by one peer: the others' messages arrive, and the queue stays within its bound.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use bus::bounded_queue::Pop;
use bus::{Barrier, Bus, Event, Inbox, InboxLimits, PublisherOptions, Route};
use protocol::{Account, DropReason, Lidar, Limits, PointCloud, Topic};
use tests::bus::{TIMEOUT, TestRouter, wait_for};

const HONEST: u64 = 20;

fn topic(text: &str) -> Topic {
    text.parse().unwrap()
}

fn sweep(points: usize) -> Lidar {
    Lidar {
        points: PointCloud {
            xyzi: vec![[1.0, 2.0, 3.0, 0.5]; points],
        },
    }
}

fn connect(sender: &Bus, ego: &Bus, topic: &Topic) {
    let route = Route {
        topic: topic.clone(),
        receiver: ego.identity().process.clone(),
    };
    Barrier::new([route])
        .await_routes(sender)
        .unwrap()
        .wait(TIMEOUT)
        .unwrap();
}

/// Receives until every message of the honest sender has arrived; the number of both senders' messages.
fn receive(inbox: &Inbox, bus: &Bus) -> [u64; 2] {
    let (mut received, deadline) = ([0; 2], Instant::now() + TIMEOUT);
    while received[0] < HONEST {
        match inbox.take(Some(deadline)) {
            Pop::Item(topic, Event::Message(arrival)) => {
                arrival.decode::<Lidar>(&Limits::DEFAULT).unwrap();
                bus.stats().received(&topic);
                received[usize::from(topic.to_string() != "1/lidar")] += 1;
            }
            Pop::Item(..) => {}
            Pop::TimedOut | Pop::Closed => panic!("{received:?} of {HONEST} came through"),
        }
    }
    received
}

#[test]
fn a_flood_from_one_peer_costs_the_others_nothing() {
    let router = TestRouter::open();
    let [honest, flooding, ego] =
        [("agent-1", "1"), ("agent-2", "2"), ("ego-9", "9")].map(|(p, c)| router.join(p, c));
    let limits = InboxLimits {
        messages_per_s: 20.0,
        ..InboxLimits::PEERS
    };
    let inbox = ego.limited_inbox(64, 4, limits);
    let [good, bad] = ["1/lidar", "2/lidar"].map(topic);
    let _subscriptions = [&good, &bad].map(|topic| ego.subscribe(topic.clone(), &inbox).unwrap());
    let [calm, flood] = [(&honest, &good), (&flooding, &bad)].map(|(bus, topic)| {
        let publisher = bus
            .publisher(topic.clone(), PublisherOptions::FEATURES.lossless(4))
            .unwrap();
        connect(bus, &ego, topic);
        publisher
    });

    let (is_over, sent) = (
        Arc::new(AtomicBool::new(false)),
        Arc::new(AtomicU64::new(0)),
    );
    let pouring = std::thread::spawn({
        let (is_over, sent) = (Arc::clone(&is_over), Arc::clone(&sent));
        move || {
            while !is_over.load(Ordering::Relaxed) {
                flood.submit(0, sweep(4096));
                sent.fetch_add(1, Ordering::Relaxed);
            }
            flood.finish();
        }
    });
    // So many that most of them are over the limit, however slow this machine is.
    wait_for("a flood", || sent.load(Ordering::Relaxed) > 200);
    let began = Instant::now();
    let calm_sender = std::thread::spawn(move || {
        for tick in 0..HONEST {
            calm.submit(tick, sweep(100));
            std::thread::sleep(Duration::from_millis(50));
        }
        calm.finish();
    });
    let [calm, stormy] = receive(&inbox, &ego);
    let seconds = began.elapsed().as_secs_f64();
    is_over.store(true, Ordering::Relaxed);
    calm_sender.join().unwrap();
    pouring.join().unwrap();

    assert_eq!(calm, HONEST, "every message of the honest peer");
    let allowed = 20.0 * (seconds + 2.0 + 1.0);
    assert!(
        (stormy as f64) < allowed,
        "{stormy} of {} were decoded in {seconds} s",
        sent.load(Ordering::Relaxed)
    );
    let ledger = ego.stats().ledger();
    let counts = |topic| {
        ledger
            .get(&Account::towards(topic, &ego.identity().process))
            .unwrap()
    };
    assert_eq!(counts(good).dropped_total(), 0);
    assert!(
        counts(bad).dropped[&DropReason::RateLimit] > 100,
        "counted by its name"
    );
}

#[test]
fn what_waits_is_bounded_in_bytes() {
    let router = TestRouter::open();
    let (sender, ego) = (router.join("agent-1", "1"), router.join("ego-9", "9"));
    // Room for 64 messages, and bytes for two and a half.
    let limits = InboxLimits {
        waiting_bytes: 160_000,
        ..InboxLimits::NONE
    };
    let inbox = ego.limited_inbox(64, 4, limits);
    let topic = topic("1/lidar");
    let _subscription = ego.subscribe(topic.clone(), &inbox).unwrap();
    let publisher = sender
        .publisher(topic.clone(), PublisherOptions::FEATURES.lossless(4))
        .unwrap();
    connect(&sender, &ego, &topic);
    (0..10).for_each(|tick| publisher.submit(tick, sweep(4096)));
    publisher.finish();
    let here = Account::towards(topic, &ego.identity().process);
    let dropped = || {
        ego.stats()
            .ledger()
            .get(&here)
            .map_or(0, |counts| counts.dropped_total())
    };
    wait_for("refusals", || dropped() == 8);
    assert!(
        inbox.waiting_bytes() <= 160_000,
        "{}",
        inbox.waiting_bytes()
    );
    let taken = std::iter::from_fn(|| match inbox.take(Some(Instant::now())) {
        Pop::Item(_, event) => Some(matches!(event, Event::Message(_))),
        _ => None,
    });
    assert_eq!(taken.filter(|is_message| *is_message).count(), 2);
    assert_eq!(inbox.waiting_bytes(), 0, "there is room again");
}
