//! Cost of a message compared with the raw network: `link/<route>/<what>/<pace>/<KiB>`.
//!
//! - `fleet`: from one client over the router to another, the route between an agent and an ego;
//! - `direct`: from a client into the router's own process, the route to the scorer.
//!
//! - `raw`: zenoh on loopback from put to callback, with a payload of the size of a feature map;
//! - `raw-copied`: the same until the bytes are contiguous, the minimum for any use of them;
//! - `message`: from before encoding a dense `f32` feature map to after decoding it, checksums and value checks
//!   included.
//!
//! `cargo bench -p link --bench emulator`. The two alternate, so that other load on the machine affects both: each at
//! 10 Hz, as a sensor does, and then back to back. On a busy machine the minima are more reliable than the medians.

use std::net::TcpListener;
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use bus::{BusOptions, Endpoint, open};
use protocol::{
    Bev, BevFeatures, BevGrid, CavId, CodecConfig, Limits, Pose, PoseEstimate, Stamp,
    encode_features, wire,
};
use zenoh::Session;
use zenoh::Wait;
use zenoh::bytes::ZBytes;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;

const CHANNELS: usize = 64;
const ROUNDS: usize = 40;
const WARM_UP: usize = 5;
const TIMEOUT: Duration = Duration::from_secs(10);

type Failure = Box<dyn std::error::Error>;

fn features(kib: usize) -> BevFeatures {
    let cells = kib * 1024 / 4 / CHANNELS;
    let grid = BevGrid {
        x_min_m: -51.2,
        y_min_m: -38.4,
        cell_m: 0.8,
        width: 32,
        height: cells as u32 / 32,
    };
    let values = (0..CHANNELS * cells)
        .map(|index| (index % 1013) as f32 * 0.01)
        .collect();
    BevFeatures {
        grid,
        channels: CHANNELS as u32,
        code_of: None,
        values,
    }
}

/// Puts a payload of `values`' bytes; returns the time until the subscriber's callback has it, and until its bytes are
/// contiguous, as any use of them requires.
fn raw(
    publisher: &Publisher,
    arrivals: &Receiver<ZBytes>,
    values: Vec<f32>,
) -> Result<[Duration; 2], Failure> {
    let bytes = values.len() * 4;
    let payload = bytes::Bytes::from_owner(protocol::Body::Floats(values));
    let begin = Instant::now();
    publisher
        .put(payload)
        .wait()
        .map_err(|cause| cause.to_string())?;
    let arrived = arrivals.recv_timeout(TIMEOUT)?;
    let in_callback = begin.elapsed();
    let together = arrived.to_bytes();
    let time = begin.elapsed();
    assert_eq!(together.len(), bytes);
    Ok([in_callback, time])
}

/// Encodes, sends, receives and decodes a feature map.
fn message(
    publisher: &Publisher,
    arrivals: &Receiver<ZBytes>,
    features: BevFeatures,
) -> Result<Duration, Failure> {
    let stamp = Stamp {
        cav: CavId::new("4279")?,
        epoch: 1,
        sequence: 1,
        capture_nanos: 0,
        publish_nanos: 0,
    };
    let expected = features.values[features.values.len() - 1];
    let begin = Instant::now();
    let features = encode_features(features, &CodecConfig::default(), None)?;
    let encoded = wire::encode(
        &stamp,
        Bev {
            pose: PoseEstimate::new(Pose::IDENTITY, 1.0),
            features,
        },
    )?;
    let mut writer = ZBytes::writer();
    writer.append(encoded.head.into());
    writer.append(bytes::Bytes::from_owner(encoded.body).into());
    publisher
        .put(writer.finish())
        .wait()
        .map_err(|cause| cause.to_string())?;
    let arrived = arrivals.recv_timeout(TIMEOUT)?;
    let (_, bev) = wire::decode::<Bev>(arrived.slices(), &Limits::DEFAULT)?;
    let decoded = bev.features.decode(&Limits::DEFAULT)?;
    let time = begin.elapsed();
    assert_eq!(decoded.features.values.last(), Some(&expected));
    Ok(time)
}

/// Median and minimum, milliseconds.
fn summary(mut times: Vec<Duration>) -> [f64; 2] {
    times.sort_unstable();
    [times[times.len() / 2], times[0]].map(|time| time.as_secs_f64() * 1e3)
}

fn report(case: &str, times: Vec<Duration>, [raw_p50, raw_min]: [f64; 2]) {
    let [p50, min] = summary(times);
    let (ratio, min_ratio) = (p50 / raw_p50, min / raw_min);
    println!(
        "link/{case}: p50 {p50:.3} ms ({ratio:.2} x raw), min {min:.3} ms ({min_ratio:.2} x raw)"
    );
}

fn main() -> Result<(), Failure> {
    let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
    let router = open(&BusOptions::router(Endpoint::loopback(port)))?;
    let sender = open(&BusOptions::client(Endpoint::loopback(port)))?;
    let receiver = open(&BusOptions::client(Endpoint::loopback(port)))?;
    measure("fleet", &sender, &receiver)?;
    measure("direct", &sender, &router)?;
    for session in [receiver, sender, router] {
        session.close().wait().map_err(|cause| cause.to_string())?;
    }
    Ok(())
}

fn measure(route: &str, sender: &Session, receiver: &Session) -> Result<(), Failure> {
    let (arrive, arrivals) = channel();
    let subscriber = receiver
        .declare_subscriber("v2v/bench/4279/bev")
        .callback(move |sample| {
            // The receiver is dropped only when the benchmark ends.
            let _ = arrive.send(sample.payload().clone());
        });
    let subscriber = subscriber.wait().map_err(|cause| cause.to_string())?;
    let publisher = sender
        .declare_publisher("v2v/bench/4279/bev")
        .congestion_control(CongestionControl::Block);
    let publisher = publisher.wait().map_err(|cause| cause.to_string())?;
    let deadline = Instant::now() + TIMEOUT;
    while !publisher
        .matching_status()
        .wait()
        .map_err(|cause| cause.to_string())?
        .matching()
    {
        assert!(
            Instant::now() < deadline,
            "no route between two sessions of one process"
        );
        std::thread::yield_now();
    }

    for (pace, pause) in [
        ("10-hz", Duration::from_millis(50)),
        ("back-to-back", Duration::ZERO),
    ] {
        for kib in [64, 1024, 8192] {
            let features = features(kib);
            let (mut raw_times, mut copied_times, mut message_times) =
                (Vec::new(), Vec::new(), Vec::new());
            for round in 0..WARM_UP + ROUNDS {
                std::thread::sleep(pause);
                let [raw_time, copied_time] = raw(&publisher, &arrivals, features.values.clone())?;
                std::thread::sleep(pause);
                let message_time = message(&publisher, &arrivals, features.clone())?;
                if round >= WARM_UP {
                    raw_times.push(raw_time);
                    copied_times.push(copied_time);
                    message_times.push(message_time);
                }
            }
            let base = summary(raw_times.clone());
            report(&format!("{route}/raw/{pace}/{kib}"), raw_times, base);
            report(
                &format!("{route}/raw-copied/{pace}/{kib}"),
                copied_times,
                base,
            );
            report(
                &format!("{route}/message/{pace}/{kib}"),
                message_times,
                base,
            );
        }
    }
    publisher
        .undeclare()
        .wait()
        .map_err(|cause| cause.to_string())?;
    Ok(subscriber
        .undeclare()
        .wait()
        .map_err(|cause| cause.to_string())?)
}
