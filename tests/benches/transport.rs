//! `transport/1MiB` and `transport/8MiB`: a feature map from the agent's thread to the ego's, against the same bytes put
//! by bare zenoh and seen by its callback; the two take turns in one run, over one router on loopback, without shared
//! memory.
//!
//! ```text
//! cargo bench -p tests --bench transport [-- 8MiB]
//! ```
//!
//! Ours ends when the map is decoded: header, checksum and every value checked, the tensor in aligned memory. Fails
//! when what arrives is not what was sent, or when ours takes more than 1.2 times as long.

use std::process::ExitCode;
use std::sync::mpsc;
use std::time::{Duration, Instant};

use protocol::message::Bev;
use protocol::{BevFeatures, BevGrid, CodecConfig, Limits, Pose, PoseEstimate, Topic, encode_features};
use sim_replay::bus::{Barrier, Event, PublisherOptions, Route};
use tests::bus::{PATIENCE, TestRouter, next_event};
use zenoh::Wait;
use zenoh::bytes::ZBytes;
use zenoh::qos::CongestionControl;

const ROUNDS: usize = 200;
const WARM_UP: usize = 20;
const AT_MOST: f64 = 1.2;

/// A map of `mib` MiB: 64 channels on a square.
fn features(mib: u32) -> BevFeatures {
    let (channels, cells) = (64, mib << 12);
    let width = (f64::from(cells).sqrt() as u32).next_power_of_two();
    let grid = BevGrid { x_min_m: -51.2, y_min_m: -38.4, cell_m: 0.8, width, height: cells / width };
    let values = (0..channels * cells).map(|index| (index % 1009) as f32 * 0.01).collect();
    BevFeatures { grid, channels, values }
}

fn quantile(sorted: &[Duration], quantile: f64) -> f64 {
    sorted[((sorted.len() - 1) as f64 * quantile).round() as usize].as_secs_f64() * 1e3
}

fn measure(mib: u32) -> bool {
    let router = TestRouter::open();
    let (agent, ego) = (router.join("agent-1", "1"), router.join("ego-1", "1"));
    let topic: Topic = "1/bev".parse().expect("a topic");
    let publisher = agent.publisher(topic.clone(), PublisherOptions::FEATURES.lossless(2)).expect("a publisher");
    let inbox = ego.inbox(4, 1);
    let _subscription = ego.subscribe(topic.clone(), &inbox).expect("a subscription");

    let key = "v2v/test/raw";
    let (arrived, arrival) = mpsc::channel();
    let _raw = ego
        .session()
        .declare_subscriber(key)
        .callback(move |sample| {
            let _ = arrived.send((Instant::now(), sample.payload().len()));
        })
        .wait()
        .expect("a subscription");
    let raw = agent.session().declare_publisher(key).congestion_control(CongestionControl::Block);
    let raw = raw.wait().expect("a publisher");

    let route = Route { topic, receiver: ego.identity().process.clone() };
    Barrier::new([route]).attend(&agent).expect("a bus").wait(PATIENCE).expect("a route");
    while !raw.matching_status().wait().expect("a session").matching() {
        std::thread::sleep(Duration::from_millis(1));
    }

    let map = features(mib);
    let pose = PoseEstimate::new(Pose::IDENTITY, 1.0);
    let bytes = ZBytes::from(vec![7_u8; map.values.len() * 4]);
    let (mut ours, mut bare) = (Vec::new(), Vec::new());
    for round in 0..WARM_UP + ROUNDS {
        let sent = map.clone();
        let began = Instant::now();
        publisher.offer_encoded(round as u64, move |stamp| {
            let features = encode_features(sent, &CodecConfig::default(), None)?;
            protocol::wire::encode(stamp, Bev { pose, features })
        });
        let (_, Event::Message(arrival_of_map)) = next_event(&inbox) else { panic!("an end") };
        let bev: Bev = arrival_of_map.decode(&Limits::DEFAULT).expect("a sound message");
        let decoded = bev.features.decode(&Limits::DEFAULT).expect("sound features");
        let took = began.elapsed();
        assert_eq!(decoded.features, map);
        drop((decoded, arrival_of_map));

        let began = Instant::now();
        raw.put(bytes.clone()).wait().expect("a session");
        let (seen, length) = arrival.recv_timeout(PATIENCE).expect("the raw message");
        assert_eq!(length, bytes.len());
        if round >= WARM_UP {
            ours.push(took);
            bare.push(seen - began);
        }
    }
    ours.sort_unstable();
    bare.sort_unstable();
    let ratio = quantile(&ours, 0.5) / quantile(&bare, 0.5);
    println!(
        "transport/{mib}MiB: ours p50 {:.2} ms, p95 {:.2} ms; zenoh alone p50 {:.2} ms, p95 {:.2} ms; ratio of medians {ratio:.2}",
        quantile(&ours, 0.5),
        quantile(&ours, 0.95),
        quantile(&bare, 0.5),
        quantile(&bare, 0.95),
    );
    ratio <= AT_MOST
}

fn main() -> ExitCode {
    let wanted: Vec<String> = std::env::args().skip(1).filter(|arg| !arg.starts_with('-')).collect();
    let sizes =
        [1, 8].into_iter().filter(|mib| wanted.is_empty() || wanted.iter().any(|name| *name == format!("{mib}MiB")));
    let mut all_good = true;
    for mib in sizes {
        all_good &= measure(mib);
    }
    if all_good { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
