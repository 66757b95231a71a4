//! Two ends of a connection: an agent that offers feature maps, an ego that receives them.

use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Mutex;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::Result;
use bus::shutdown::Stop;
use bus::{
    Barrier, Bus, BusOptions, Endpoint, Event, Identity, PublisherOptions, Route, open, unix_nanos,
};
use link::{CapacityConfig, LinkConfig, LinkEmulator, QueueConfig};
use protocol::message::Bev;
use protocol::{
    BevFeatures, BevGrid, CavId, CodecConfig, Ledger, Limits, Pose, PoseEstimate, ProcessId, Role,
    RunId, Stream, Topic, encode_features,
};
use serde::{Deserialize, Serialize};
use sim_replay::link_node;
use tests::bus::{TIMEOUT, free_port, link_options};
use zenoh::bytes::ZBytes;
use zenoh::{Session, Wait};

use super::{Cell, PERIOD};

/// Time without a message after which no more is expected.
const SILENCE: Duration = Duration::from_secs(3);

/// Observations of both ends of a run.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct Measurement {
    pub(crate) submissions: Vec<Submission>,
    pub(crate) arrivals: Vec<Arrived>,
    /// Of all processes; empty without message accounting.
    pub(crate) ledger: Ledger,
}

/// One call of the publisher.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(crate) struct Submission {
    /// Start of the call; sent as the capture time.
    pub(crate) capture_nanos: u64,
    /// Duration of the call.
    pub(crate) waited_nanos: u64,
}

/// One feature map received by the ego.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(crate) struct Arrived {
    pub(crate) capture_nanos: u64,
    pub(crate) nanos: u64,
    pub(crate) bytes: u64,
}

/// Topic of the agent's feature map.
pub(crate) fn sent_topic() -> Topic {
    Topic::Stream {
        cav: cav("7"),
        stream: Stream::Bev,
    }
}

pub(crate) fn cav(text: &str) -> CavId {
    CavId::new(text).expect("an identifier")
}

/// Agent, link and ego over a router on loopback. The router is a process of its own, as in a run: a router that waits
/// for a receiver blocks a thread on which all sessions of a process read, the receiver's own among them.
pub(crate) fn over_link(cell: &Cell) -> Result<Measurement> {
    let endpoint = Endpoint::loopback(free_port());
    let mut router = Command::new(std::env::current_exe()?);
    let router = router
        .args(["router", endpoint.as_str()])
        .stdin(Stdio::piped())
        .spawn()?;
    let seen = between(cell, &endpoint);
    // The end of its input ends it.
    router.wait_with_output()?;
    seen
}

fn between(cell: &Cell, router: &Endpoint) -> Result<Measurement> {
    let join = |name, cav| join(router, name, cav);
    let (agent, link, ego) = (
        join("agent-7", "7")?,
        join("link-9", "9")?,
        join("ego-9", "9")?,
    );
    let config = LinkConfig {
        capacity: CapacityConfig::TokenBucket {
            bandwidth_mbps: cell.rate_mbps,
            burst_bytes: 0,
        },
        queue: QueueConfig {
            keep_last: true,
            ..QueueConfig::default()
        },
        ..LinkConfig::default()
    };
    let emulator = LinkEmulator::new(config, Path::new("."), 1)?;
    let options = link_options(cav("9"), Stream::Bev);
    let received = Topic::Received {
        ego: cav("9"),
        cav: cav("7"),
        stream: Stream::Bev,
    };
    let stop = Stop::new();
    let (submissions, arrivals) = thread::scope(|scope| {
        let carrying = scope.spawn(|| link_node::run(&link, emulator, &options, &stop));
        let receiving = scope.spawn(|| receive(&ego, &received));
        let submissions = send(
            &agent,
            cell,
            &[(sent_topic(), "link-9"), (received.clone(), "ego-9")],
        );
        // Messages in flight are counted as such without waiting for them.
        stop.request();
        carrying.join().expect("no panic")?;
        anyhow::Ok((submissions?, receiving.join().expect("no panic")?))
    })?;
    let mut ledger = Ledger::default();
    [&agent, &link, &ego]
        .iter()
        .for_each(|bus| ledger.merge(&bus.stats().ledger()));
    Ok(Measurement {
        submissions,
        arrivals,
        ledger,
    })
}

/// Routes messages until its input ends.
pub(crate) fn route(endpoint: &str) -> Result<()> {
    let _router = open(&BusOptions::router(endpoint.parse()?))?;
    std::io::copy(&mut std::io::stdin(), &mut std::io::sink())?;
    Ok(())
}

/// A client in the run of this benchmark.
pub(crate) fn join(router: &Endpoint, process: &str, cav: &str) -> Result<Bus> {
    let identity = Identity {
        run: RunId::new("slow-link")?,
        process: ProcessId::new(process)?,
        cav: self::cav(cav),
    };
    Ok(Bus::join(&BusOptions::client(router.clone()), identity)?)
}

/// Offers feature maps until the time is over, as an agent does, and waits until they are sent.
pub(crate) fn send(agent: &Bus, cell: &Cell, routes: &[(Topic, &str)]) -> Result<Vec<Submission>> {
    let presence = agent.announce(Role::Agent)?;
    let publisher = agent.publisher(sent_topic(), PublisherOptions::FEATURES)?;
    let routes = routes.iter().map(|(topic, receiver)| {
        Ok(Route {
            topic: topic.clone(),
            receiver: receiver.parse()?,
        })
    });
    Barrier::new(routes.collect::<Result<Vec<_>>>()?)
        .await_routes(agent)?
        .wait(TIMEOUT)?;
    let map = features(cell.bytes);
    let submissions = at_10_hz(
        cell,
        || map.clone(),
        |capture_nanos, map| {
            publisher.submit_encoded(capture_nanos, move |stamp| {
                let features = encode_features(map, &CodecConfig::default(), None)?;
                protocol::wire::encode(
                    stamp,
                    Bev {
                        pose: PoseEstimate::new(Pose::IDENTITY, 1.0),
                        features,
                    },
                )
            });
        },
    );
    publisher.finish();
    presence.withdraw()?;
    Ok(submissions)
}

/// Receives feature maps, decodes them, and records the times.
pub(crate) fn receive(ego: &Bus, topic: &Topic) -> Result<Vec<Arrived>> {
    let inbox = ego.inbox(64, 1);
    let _subscription = ego.subscribe(topic.clone(), &inbox)?;
    let mut arrivals = Vec::new();
    while let bus::bounded_queue::Pop::Item(_, Event::Message(arrival)) = inbox.take(None) {
        if inbox.decode::<Bev>(&arrival, &Limits::DEFAULT).is_some() {
            ego.stats().received(topic);
            let capture_nanos = arrival.header.stamp.capture_nanos;
            arrivals.push(Arrived {
                capture_nanos,
                nanos: unix_nanos(),
                bytes: arrival.wire_bytes(),
            });
        }
    }
    Ok(arrivals)
}

const PLAIN_KEY: &str = "v2v/plain";

/// The same with bare zenoh: the capture time and zeros.
pub(crate) fn send_plain(session: &Session, cell: &Cell) -> Result<Vec<Submission>> {
    let publisher = session
        .declare_publisher(PLAIN_KEY)
        .wait()
        .map_err(anyhow::Error::from_boxed)?;
    tests::bus::wait_for("a route", || {
        publisher
            .matching_status()
            .wait()
            .is_ok_and(|status| status.matching())
    });
    let bytes = cell.bytes;
    let submissions = at_10_hz(
        cell,
        || vec![0_u8; bytes],
        |capture_nanos, mut map| {
            map[..8].copy_from_slice(&capture_nanos.to_le_bytes());
            // It returns Ok also for messages that it drops.
            if let Err(cause) = publisher.put(ZBytes::from(map)).wait() {
                eprintln!("zenoh refuses a message: {cause}");
            }
        },
    );
    Ok(submissions)
}

/// Receives messages until `is_over` and none has come for a while.
pub(crate) fn receive_plain(session: &Session, is_over: impl Fn() -> bool) -> Result<Vec<Arrived>> {
    let arrivals = std::sync::Arc::new(Mutex::new(Vec::new()));
    let collected = std::sync::Arc::clone(&arrivals);
    let subscriber = session
        .declare_subscriber(PLAIN_KEY)
        .callback(move |sample| {
            let nanos = unix_nanos();
            let payload = sample.payload().to_bytes();
            let Some(capture) = payload.first_chunk() else {
                return;
            };
            let arrived = Arrived {
                capture_nanos: u64::from_le_bytes(*capture),
                nanos,
                bytes: payload.len() as u64,
            };
            collected.lock().expect("no panic").push(arrived);
        });
    let _subscriber = subscriber.wait().map_err(anyhow::Error::from_boxed)?;
    let (mut count, mut since) = (0, Instant::now());
    while !is_over() || since.elapsed() < SILENCE {
        thread::sleep(Duration::from_millis(50));
        let now = arrivals.lock().expect("no panic").len();
        if now != count || !is_over() {
            (count, since) = (now, Instant::now());
        }
    }
    let arrivals = arrivals.lock().expect("no panic").clone();
    Ok(arrivals)
}

/// Calls `submit` at the rate of a LiDAR, with a feature map made before.
fn at_10_hz<M>(
    cell: &Cell,
    make: impl Fn() -> M,
    mut submit: impl FnMut(u64, M),
) -> Vec<Submission> {
    let began = Instant::now();
    let count = (cell.duration.as_secs_f64() / PERIOD.as_secs_f64()).round() as u32;
    let ticks = (0..count).map(|tick| {
        let map = make();
        thread::sleep((began + tick * PERIOD).saturating_duration_since(Instant::now()));
        let (capture_nanos, called) = (unix_nanos(), Instant::now());
        submit(capture_nanos, map);
        Submission {
            capture_nanos,
            waited_nanos: called.elapsed().as_nanos() as u64,
        }
    });
    ticks.collect()
}

/// A feature map of `bytes`: 64 channels of f32.
fn features(bytes: usize) -> BevFeatures {
    let (channels, cells) = (64, bytes / 4 / 64);
    let width = cells.isqrt().next_power_of_two();
    let grid = BevGrid {
        x_min_m: -51.2,
        y_min_m: -38.4,
        cell_m: 0.8,
        width: width as u32,
        height: (cells / width) as u32,
    };
    let values = (0..channels * cells)
        .map(|index| (index % 1009) as f32 * 0.01)
        .collect();
    BevFeatures {
        grid,
        channels: channels as u32,
        code_of: None,
        values,
    }
}
