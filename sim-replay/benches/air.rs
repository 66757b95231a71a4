//! What a message costs beside the network it goes over: `air/<what>/<KiB>`, from before encoding to after decoding, over
//! zenoh on loopback, next to raw zenoh from put to callback with a payload of the same bytes.
//!
//! `cargo bench -p sim-replay --bench air`. The two take turns, so that whatever else the machine does hits both; on a busy
//! machine the least times say more than the medians.

use std::net::TcpListener;
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use protocol::{
    Bev, BevFeatures, BevGrid, CavId, CodecConfig, Limits, Pose, PoseEstimate, Stamp, encode_features, wire,
};
use sim_replay::bus::{BusOptions, Endpoint, open};
use zenoh::Wait;
use zenoh::bytes::ZBytes;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;

const CHANNELS: usize = 64;
const ROUNDS: usize = 60;
const PATIENCE: Duration = Duration::from_secs(10);

type Failure = Box<dyn std::error::Error>;

fn features(kib: usize) -> BevFeatures {
    let cells = kib * 1024 / 4 / CHANNELS;
    let grid = BevGrid { x_min_m: -51.2, y_min_m: -38.4, cell_m: 0.8, width: 32, height: cells as u32 / 32 };
    let values = (0..CHANNELS * cells).map(|index| (index % 1013) as f32 * 0.01).collect();
    BevFeatures { grid, channels: CHANNELS as u32, values }
}

/// Puts a payload of `values`' bytes and waits until the subscriber's callback has it.
fn raw(publisher: &Publisher, arrivals: &Receiver<ZBytes>, values: Vec<f32>) -> Result<Duration, Failure> {
    let bytes = values.len() * 4;
    let payload = bytes::Bytes::from_owner(protocol::Body::Floats(values));
    let begin = Instant::now();
    publisher.put(payload).wait().map_err(|cause| cause.to_string())?;
    let arrived = arrivals.recv_timeout(PATIENCE)?;
    let time = begin.elapsed();
    assert_eq!(arrived.len(), bytes);
    Ok(time)
}

/// Encodes, sends, receives and decodes a map.
fn message(publisher: &Publisher, arrivals: &Receiver<ZBytes>, features: BevFeatures) -> Result<Duration, Failure> {
    let stamp = Stamp { cav: CavId::new("4279")?, epoch: 1, sequence: 1, capture_nanos: 0, publish_nanos: 0 };
    let expected = features.values[features.values.len() - 1];
    let begin = Instant::now();
    let features = encode_features(features, &CodecConfig::default(), None)?;
    let encoded = wire::encode(&stamp, Bev { pose: PoseEstimate::new(Pose::IDENTITY, 1.0), features })?;
    let mut writer = ZBytes::writer();
    writer.append(encoded.head.into());
    writer.append(bytes::Bytes::from_owner(encoded.body).into());
    publisher.put(writer.finish()).wait().map_err(|cause| cause.to_string())?;
    let arrived = arrivals.recv_timeout(PATIENCE)?;
    let (_, bev) = wire::decode::<Bev>(arrived.slices(), &Limits::DEFAULT)?;
    let decoded = bev.features.decode(&Limits::DEFAULT)?;
    let time = begin.elapsed();
    assert_eq!(decoded.features.values.last(), Some(&expected));
    Ok(time)
}

/// Median and least, milliseconds.
fn summary(mut times: Vec<Duration>) -> [f64; 2] {
    times.sort_unstable();
    [times[times.len() / 2], times[0]].map(|time| time.as_secs_f64() * 1e3)
}

fn main() -> Result<(), Failure> {
    let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
    let router = open(&BusOptions::router(Endpoint::loopback(port)))?;
    let client = open(&BusOptions::client(Endpoint::loopback(port)))?;
    let (arrive, arrivals) = channel();
    let subscriber = router.declare_subscriber("v2v/bench/4279/bev").callback(move |sample| {
        // The receiver has gone only when the benchmark is over.
        let _ = arrive.send(sample.payload().clone());
    });
    let subscriber = subscriber.wait().map_err(|cause| cause.to_string())?;
    let publisher = client.declare_publisher("v2v/bench/4279/bev").congestion_control(CongestionControl::Block);
    let publisher = publisher.wait().map_err(|cause| cause.to_string())?;
    let deadline = Instant::now() + PATIENCE;
    while !publisher.matching_status().wait().map_err(|cause| cause.to_string())?.matching() {
        assert!(Instant::now() < deadline, "no route between two sessions of one process");
        std::thread::yield_now();
    }

    for kib in [64, 1024, 8192] {
        let features = features(kib);
        let (mut raw_times, mut message_times) = (Vec::new(), Vec::new());
        for round in 0..ROUNDS + 5 {
            let raw_time = raw(&publisher, &arrivals, features.values.clone())?;
            let message_time = message(&publisher, &arrivals, features.clone())?;
            // The first rounds warm memory and connection.
            if round >= 5 {
                raw_times.push(raw_time);
                message_times.push(message_time);
            }
        }
        let ([raw_p50, raw_min], [p50, min]) = (summary(raw_times), summary(message_times));
        println!("air/raw/{kib:<8} p50 {raw_p50:8.3} ms            min {raw_min:8.3} ms");
        println!(
            "air/message/{kib:<4} p50 {p50:8.3} ms {:6.3} x    min {min:8.3} ms {:6.3} x",
            p50 / raw_p50,
            min / raw_min
        );
    }
    drop((subscriber, publisher));
    client.close().wait().map_err(|cause| cause.to_string())?;
    router.close().wait().map_err(|cause| cause.to_string())?;
    Ok(())
}
