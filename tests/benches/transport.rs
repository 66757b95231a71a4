//! `transport/1MiB` and `transport/8MiB`: a feature map from the agent's thread to the ego's, against the same bytes
//! put by bare zenoh and received by its callback. They take turns in one run, each over a router on loopback, without
//! shared memory.
//!
//! ```text
//! cargo bench -p tests --bench transport [-- 8MiB]
//! ```
//!
//! The bus's time ends when the feature map is decoded: header, checksum and every value checked, the tensor in aligned
//! memory. Fails when a received map differs from the one sent, or when the bus takes more than 1.2 times as long as
//! zenoh with its default settings. The cost of the messages on top of the bus's own, faster settings is printed beside
//! it.

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use bus::{Barrier, Bus, Event, Inbox, Publisher, PublisherOptions, Route, Subscription};
use protocol::message::Bev;
use protocol::{
    BevFeatures, BevGrid, Body, CodecConfig, Limits, Pose, PoseEstimate, Topic, encode_features,
};
use support::statistics;
use tests::bus::{TIMEOUT, TestRouter, free_port, next_event, wait_for};
use zenoh::bytes::ZBytes;
use zenoh::qos::CongestionControl;
use zenoh::{Config, Session, Wait};

const ROUNDS: usize = 200;
const WARM_UP: usize = 20;
const AT_MOST: f64 = 1.2;

/// A feature map of `mib` MiB: 64 channels on a square.
fn features(mib: u32) -> BevFeatures {
    let (channels, cells) = (64, mib << 12);
    let width = (f64::from(cells).sqrt() as u32).next_power_of_two();
    let grid = BevGrid {
        x_min_m: -51.2,
        y_min_m: -38.4,
        cell_m: 0.8,
        width,
        height: cells / width,
    };
    let values = (0..channels * cells)
        .map(|index| (index % 1009) as f32 * 0.01)
        .collect();
    BevFeatures {
        grid,
        channels,
        code_of: None,
        values,
    }
}

/// Through the bus.
struct Messages {
    publisher: Publisher,
    inbox: Arc<Inbox>,
    _subscription: Subscription,
}

impl Messages {
    fn between(agent: &Bus, ego: &Bus) -> Self {
        let topic: Topic = "1/bev".parse().expect("a topic");
        let publisher = agent
            .publisher(topic.clone(), PublisherOptions::FEATURES.lossless(2))
            .expect("a publisher");
        let inbox = ego.inbox(4, 1);
        let subscription = ego
            .subscribe(topic.clone(), &inbox)
            .expect("a subscription");
        let route = Route {
            topic,
            receiver: ego.identity().process.clone(),
        };
        Barrier::new([route])
            .await_routes(agent)
            .expect("a bus")
            .wait(TIMEOUT)
            .expect("a route");
        Self {
            publisher,
            inbox,
            _subscription: subscription,
        }
    }

    /// From before encoding to after decoding.
    fn time(&self, round: usize, map: &BevFeatures) -> Duration {
        let sent = map.clone();
        let pose = PoseEstimate::new(Pose::IDENTITY, 1.0);
        let began = Instant::now();
        self.publisher.submit_encoded(round as u64, move |stamp| {
            let features = encode_features(sent, &CodecConfig::default(), None)?;
            protocol::wire::encode(stamp, Bev { pose, features })
        });
        let (_, Event::Message(arrival)) = next_event(&self.inbox) else {
            panic!("an end")
        };
        let bev: Bev = arrival.decode(&Limits::DEFAULT).expect("a sound message");
        let decoded = bev
            .features
            .decode(&Limits::DEFAULT)
            .expect("sound features");
        let took = began.elapsed();
        assert_eq!(decoded.features, *map);
        took
    }
}

/// Through bare zenoh.
struct Bare {
    publisher: zenoh::pubsub::Publisher<'static>,
    arrivals: Receiver<(Instant, usize)>,
    _subscription: zenoh::pubsub::Subscriber<()>,
}

impl Bare {
    fn between(sender: &Session, receiver: &Session) -> Self {
        let key = "v2v/test/raw";
        let (arrived, arrivals) = channel();
        let subscriber = receiver.declare_subscriber(key).callback(move |sample| {
            let _ = arrived.send((Instant::now(), sample.payload().len()));
        });
        let subscription = subscriber.wait().expect("a subscription");
        let publisher = sender
            .declare_publisher(key)
            .congestion_control(CongestionControl::Block);
        let publisher = publisher.wait().expect("a publisher");
        wait_for("a route", || {
            publisher
                .matching_status()
                .wait()
                .expect("a session")
                .matching()
        });
        Self {
            publisher,
            arrivals,
            _subscription: subscription,
        }
    }

    /// From before the put to the callback, with bytes that were just allocated, as a feature map's are.
    fn time(&self, map: &BevFeatures) -> Duration {
        let bytes = ZBytes::from(Body::Floats(map.values.clone()).as_bytes().to_vec());
        let expected = bytes.len();
        let began = Instant::now();
        self.publisher.put(bytes).wait().expect("a session");
        let (seen, length) = self
            .arrivals
            .recv_timeout(TIMEOUT)
            .expect("the raw message");
        assert_eq!(length, expected);
        seen - began
    }
}

/// A router and two clients with zenoh's own settings, except for endpoints and the restriction to TCP.
fn plain_sessions() -> [Session; 3] {
    let endpoint = format!(r#"["tcp/127.0.0.1:{}"]"#, free_port());
    let none = "[]".to_owned();
    ["router", "client", "client"].map(|mode| {
        let (listen, connect) = if mode == "router" {
            (&endpoint, &none)
        } else {
            (&none, &endpoint)
        };
        let mut config = Config::default();
        for (key, value) in [
            ("mode", &*format!("{mode:?}")),
            ("listen/endpoints", listen),
            ("connect/endpoints", connect),
            ("scouting/multicast/enabled", "false"),
            ("transport/shared_memory/enabled", "false"),
        ] {
            config
                .insert_json5(key, value)
                .expect("a setting of zenoh's");
        }
        zenoh::open(config).wait().expect("a session")
    })
}

/// Median and 95th percentile, milliseconds.
fn summary(times: &[Duration]) -> [f64; 2] {
    let ms: Vec<f64> = times.iter().map(|time| time.as_secs_f64() * 1e3).collect();
    let ms = statistics::sorted(&ms);
    [0.5, 0.95].map(|q| statistics::quantile(&ms, q).unwrap_or(f64::NAN))
}

fn measure(mib: u32) -> bool {
    let router = TestRouter::open();
    let (agent, ego) = (router.join("agent-1", "1"), router.join("ego-1", "1"));
    let [_plain_router, plain_sender, plain_receiver] = plain_sessions();
    let messages = Messages::between(&agent, &ego);
    let plain = Bare::between(&plain_sender, &plain_receiver);
    let on_the_bus = Bare::between(agent.session(), ego.session());

    let map = features(mib);
    let mut times = [const { Vec::new() }; 3];
    for round in 0..WARM_UP + ROUNDS {
        let took = [
            messages.time(round, &map),
            plain.time(&map),
            on_the_bus.time(&map),
        ];
        if round >= WARM_UP {
            times
                .iter_mut()
                .zip(took)
                .for_each(|(times, took)| times.push(took));
        }
    }
    let [[ours, ours_p95], [plain, plain_p95], [bus, bus_p95]] = times.map(|times| summary(&times));
    let ratio = ours / plain;
    println!(
        "transport/{mib}MiB: ours p50 {ours:.2} ms, p95 {ours_p95:.2} ms; bare zenoh p50 {plain:.2} ms, \
         p95 {plain_p95:.2} ms; ratio of medians {ratio:.2}; \
         zenoh with the bus's settings p50 {bus:.2} ms, p95 {bus_p95:.2} ms, ratio {:.2}",
        ours / bus,
    );
    ratio <= AT_MOST
}

fn main() -> ExitCode {
    let wanted: Vec<String> = std::env::args()
        .skip(1)
        .filter(|arg| !arg.starts_with('-'))
        .collect();
    let sizes = [1, 8]
        .into_iter()
        .filter(|mib| wanted.is_empty() || wanted.iter().any(|name| *name == format!("{mib}MiB")));
    let mut all_good = true;
    for mib in sizes {
        all_good &= measure(mib);
    }
    if all_good {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}
