//! Tests of the page on a synthetic recorded and a synthetic live run.

use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use bus::web::fetch;
use bus::{Bus, BusOptions, Endpoint, Identity, PublisherOptions};
use protocol::message::{AgentTruth, FusedNeighbour, NeighbourState, StageTiming};
use protocol::{
    Bev, BevFeatures, BevGrid, Box3d, CavId, CodecConfig, Detection, Detections, Key, Lidar,
    PointCloud, Pose, PoseEstimate, RunId, Stamp, Stream, Topic, Track, Tracks, TrueObject, Truth,
    encode_features, wire,
};
use recording::{RecordingOptions, RecordingWriter};
use serde_json::Value;

use super::frame_assembler::{FrameAssembler, ReceivedMessage};
use super::scene_frame::ShownTrack;
use super::*;

const EGO: &str = "4279";
const OTHER: &str = "4288";
const TICKS: u64 = 5;
const TIMEOUT: Duration = Duration::from_secs(120);

fn cav(text: &str) -> CavId {
    CavId::new(text).unwrap()
}

fn pose_of(cav_id: &str, tick: u64) -> Pose {
    Pose::from_xyz_yaw(
        [tick as f64, if cav_id == EGO { 0.0 } else { 15.0 }, 1.9],
        0.2,
    )
}

fn cloud(tick: u64, count: u64) -> PointCloud {
    PointCloud {
        xyzi: (0..count)
            .map(|k| {
                [
                    (k % 173) as f32 * 0.4 - 34.0,
                    (k / 173) as f32 * 0.4 - 34.0,
                    tick as f32,
                    0.5,
                ]
            })
            .collect(),
    }
}

fn truth(tick: u64) -> Truth {
    let object = TrueObject {
        id: 7,
        class: "car".into(),
        world_from_object: Pose::from_xyz_yaw([20.0, 3.0, 0.8], 0.1),
        size_m: [4.0, 1.8, 1.6],
        speed_mps: None,
    };
    let agents = [EGO, OTHER].map(|cav_id| AgentTruth {
        cav: cav(cav_id),
        world_from_lidar: pose_of(cav_id, tick),
        objects: vec![object.clone()],
    });
    Truth {
        tick,
        agents: agents.into(),
    }
}

fn detections_of(ego: &str, tick: u64) -> Detections {
    let box3d = Box3d {
        center_m: [10.0, 0.0, -1.0],
        size_m: [4.0, 1.8, 1.6],
        heading_rad: 0.0,
    };
    Detections {
        ego: cav(ego),
        agent_frame: tick,
        method: "max".into(),
        pose: PoseEstimate::new(pose_of(ego, tick), 0.9),
        detections: vec![Detection {
            box3d,
            score: 0.8,
            source: None,
        }],
        fused: vec![FusedNeighbour {
            cav: cav(other_than(ego)),
            age_nanos: 0,
            confidence: 0.7,
            payload_bytes: 1_000,
            wire_bytes: 1_250,
        }],
        skipped: Vec::new(),
        neighbours: vec![NeighbourState {
            cav: cav(other_than(ego)),
            trust: Some(0.75),
            misbehaviour: None,
            clock_offset_s: Some(-0.25),
            capture_offset_s: Some(0.3),
        }],
        stages: [("transport", 2), ("wait", 12), ("fuse", 8), ("send", 1)]
            .map(|(stage, ms)| StageTiming::new(stage, Duration::from_millis(ms)))
            .into(),
    }
}

fn other_than(ego: &str) -> &'static str {
    if ego == EGO { OTHER } else { EGO }
}

/// A feature map of 4 by 2 cells.
fn feature_map(who: &str, tick: u64) -> Bev {
    let grid = BevGrid {
        x_min_m: -2.0,
        y_min_m: -1.0,
        cell_m: 1.0,
        width: 4,
        height: 2,
    };
    let features = BevFeatures {
        grid,
        channels: 1,
        code_of: None,
        values: (0..8).map(|cell| cell as f32).collect(),
    };
    let features = encode_features(features, &CodecConfig::default(), None).unwrap();
    Bev {
        pose: PoseEstimate::new(pose_of(who, tick), 0.9),
        features,
    }
}

fn stamp(who: &str, tick: u64, publish_nanos: u64) -> Stamp {
    Stamp {
        cav: cav(who),
        epoch: 1,
        sequence: tick,
        capture_nanos: 100_000_000 * (tick + 1),
        publish_nanos,
    }
}

/// A feature map of the other vehicle, which reaches the ego over a link, and later a result of the other vehicle.
fn messages_of_a_second_ego(tick: u64, now: u64) -> Vec<(Topic, Vec<u8>)> {
    let mapped = stamp(OTHER, tick, now + 25_000_000);
    let map = wire::encode(&mapped, feature_map(OTHER, tick))
        .unwrap()
        .to_vec();
    let detected = stamp(OTHER, tick, now + 30_000_000);
    let result = wire::encode(&detected, detections_of(OTHER, tick))
        .unwrap()
        .to_vec();
    vec![
        (
            Topic::Stream {
                cav: cav(OTHER),
                stream: Stream::Bev,
            },
            map.clone(),
        ),
        (
            Topic::Received {
                ego: cav(EGO),
                cav: cav(OTHER),
                stream: Stream::Bev,
            },
            map,
        ),
        (
            Topic::Stream {
                cav: cav(OTHER),
                stream: Stream::Detections,
            },
            result,
        ),
    ]
}

/// The messages of a tick, published at `now`; the result half a tick later. Live, there are previews only.
fn messages(tick: u64, now: u64, sweeps: Stream) -> Vec<(Topic, Vec<u8>)> {
    let mut all = vec![(
        Topic::Truth,
        wire::encode(&stamp("replay", tick, now), truth(tick))
            .unwrap()
            .to_vec(),
    )];
    for who in [EGO, OTHER] {
        let count = if sweeps == Stream::Preview {
            4_000
        } else {
            30_000
        };
        let lidar = Lidar {
            points: cloud(tick, count),
        };
        let swept = stamp(who, tick, now);
        all.push((
            Topic::stream(&cav(who), sweeps),
            wire::encode(&swept, lidar).unwrap().to_vec(),
        ));
        let estimate = PoseEstimate::new(pose_of(who, tick), 0.9);
        let posed = stamp(who, tick, now + 20_000_000);
        all.push((
            Topic::stream(&cav(who), Stream::Pose),
            wire::encode(&posed, estimate).unwrap().to_vec(),
        ));
    }
    let detected = stamp(EGO, tick, now + 50_000_000);
    all.push((
        Topic::stream(&cav(EGO), Stream::Detections),
        wire::encode(&detected, detections_of(EGO, tick))
            .unwrap()
            .to_vec(),
    ));
    all
}

/// The tracks that follow the ego's result of a tick: one object, 10 m ahead.
fn tracks(tick: u64) -> (Topic, Vec<u8>) {
    let Detections {
        ego,
        agent_frame,
        pose,
        detections,
        ..
    } = detections_of(EGO, tick);
    let track = Track {
        id: 3,
        box3d: detections[0].box3d,
        velocity_mps: [3.0, 4.0],
        covariance: [[0.0; 4]; 4],
        score: 0.8,
        hits: 1,
        age_s: 0.0,
        unseen_s: 0.0,
    };
    let stamp = stamp(EGO, tick, 51_000_000);
    let topic = Topic::stream(&ego, Stream::Tracks);
    let message = Tracks {
        ego,
        agent_frame,
        pose,
        tracks: vec![track],
        left_out: 0,
    };
    (topic, wire::encode(&stamp, message).unwrap().to_vec())
}

fn record(folder: &Path, has_second_ego: bool) -> RecordedRun {
    let file = folder.join(crate::operate::run_folder::RECORDING);
    let mut writer = RecordingWriter::create(&file, RecordingOptions::default()).unwrap();
    let run = RunId::new("test").unwrap();
    for tick in 0..TICKS {
        let mut all = messages(tick, 1_000_000_000 * tick, Stream::Lidar);
        if has_second_ego {
            all.extend(messages_of_a_second_ego(tick, 1_000_000_000 * tick));
        }
        all.push(tracks(tick));
        for (topic, payload) in all {
            let key: Key = topic.in_run(&run);
            writer
                .write(&key, 1_000_000_000 * tick + 60_000_000, &payload)
                .unwrap();
        }
    }
    writer.finish().unwrap();
    let mut sweeps =
        support::sweep_log::SweepLog::open(&folder.join(crate::operate::run_folder::SWEEP_LOG))
            .unwrap();
    (0..TICKS).for_each(|tick| {
        sweeps
            .note(100_000_000 * (tick + 1), 1_000_000_000 * tick + 3_000_000)
            .unwrap()
    });
    RecordedRun::open(folder).unwrap()
}

/// The JSON document of a scene frame, and the number of points that follow.
fn parsed(bytes: &[u8]) -> (Value, usize) {
    let (len, rest) = bytes.split_at(4);
    let (json, points) = rest.split_at(u32::from_le_bytes(len.try_into().unwrap()) as usize);
    (serde_json::from_slice(json).unwrap(), points.len() / 6)
}

fn check(frame: &Value, points: usize) {
    assert_eq!(
        (&frame["ego"], &frame["method"]),
        (&EGO.into(), &"max".into())
    );
    assert_eq!(
        frame["truth"].as_array().unwrap().len(),
        1,
        "all vehicles annotate it, and it is shown once"
    );
    // 10 m ahead of an ego at (tick, 0) with a heading of 0.2 rad to the left.
    let tick = frame["tick"].as_u64().unwrap() as f64;
    let x = frame["detections"][0]["center_m"][0].as_f64().unwrap();
    assert!((x - (tick + 10.0 * 0.2_f64.cos())).abs() < 1e-9, "{x}");
    assert!(
        (frame["latency_ms"].as_f64().unwrap() - 50.0).abs() < 1.0,
        "{}",
        frame["latency_ms"]
    );
    assert!(
        frame["posed_ms"]
            .as_f64()
            .is_none_or(|posed| (posed - 20.0).abs() < 1.0),
        "{}",
        frame["posed_ms"]
    );
    let vehicles = frame["vehicles"].as_array().unwrap();
    assert_eq!(vehicles.len(), 2);
    assert!(
        (vehicles[0]["confidence"].as_f64().unwrap() - 0.9).abs() < 1e-6
            && vehicles[0]["error_m"] == 0.0
    );
    let counted: u64 = vehicles
        .iter()
        .map(|vehicle| vehicle["points"].as_u64().unwrap())
        .sum();
    assert!(
        counted as usize == points && points <= 24_000,
        "{counted} and {points}"
    );
    let link = &frame["links"][0];
    assert_eq!(
        (&link["from"], &link["wire_bytes"], &link["is_fused"]),
        (&OTHER.into(), &1_250.into(), &true.into())
    );
    assert_eq!(
        (&link["trust"], &link["clock_ms"], &link["capture_ms"]),
        (&0.75.into(), &(-250.0).into(), &300.0.into())
    );
}

#[test]
fn a_recorded_run_is_shown_in_any_order() {
    let folder = tempfile::tempdir().unwrap();
    let run = record(folder.path(), false);
    assert_eq!((run.count(), run.name()), (TICKS as usize, "test"));
    for index in [3, 0, 4, 3] {
        let (frame, points) = parsed(&run.frame(index, None).unwrap().unwrap().to_bytes());
        assert_eq!(frame["tick"], index);
        check(&frame, points);
        assert!(points > 10_000, "two sweeps");
        let track = &frame["tracks"][0];
        let trail = track["trail_m"].as_array().unwrap();
        assert_eq!(
            (&track["id"], trail.len()),
            (&3.into(), index + 1),
            "{track}"
        );
        assert_eq!(
            trail.last().unwrap()[0],
            frame["detections"][0]["center_m"][0]
        );
        assert_eq!(
            frame["pace"],
            serde_json::json!({"ticks": 5, "answered": 5, "rate_hz": 1.0})
        );
        assert_eq!(
            (&frame["swept_ms"], &frame["posed_ms"]),
            (&3.0.into(), &20.0.into())
        );
    }
    assert!(run.frame(5, None).unwrap().is_none());
    let server = serve_recorded("127.0.0.1:0".parse().unwrap(), Arc::new(run)).unwrap();
    let about: Value = serde_json::from_slice(&fetch(server.address(), "/run").unwrap().1).unwrap();
    assert_eq!(
        (&about["mode"], about["timeline"].as_array().unwrap().len()),
        (&"recorded".into(), 5)
    );
    assert_eq!(about["timeline"][1]["latency_ms"], 50.0);
    let (status, body) = fetch(server.address(), "/frame/2").unwrap();
    assert!(status.contains("200"));
    check(&parsed(&body).0, parsed(&body).1);
    for path in ["/frame/99", "/frame/x", "/nothing"] {
        assert!(
            fetch(server.address(), path).unwrap().0.contains("404"),
            "{path}"
        );
    }
    assert!(matches!(
        RecordedRun::open(&folder.path().join("none")),
        Err(ViewError::NotRecorded(_))
    ));
}

#[test]
fn a_recording_with_nothing_to_show_is_refused_with_the_reason() {
    let all = messages(0, 0, Stream::Lidar);
    let of_another_version: Vec<_> = all
        .iter()
        .cloned()
        .map(|(topic, mut payload)| {
            // The version follows the four bytes that begin every message.
            payload[4] ^= 1;
            (topic, payload)
        })
        .collect();
    let sweeps: Vec<_> = all
        .into_iter()
        .filter(|(topic, _)| {
            matches!(
                topic,
                Topic::Stream {
                    stream: Stream::Lidar,
                    ..
                }
            )
        })
        .collect();
    let run = RunId::new("test").unwrap();
    for (recorded, reason) in [
        (
            of_another_version,
            "none of its messages can be read: it is of another version of this program",
        ),
        (sweeps, "no truth and no detections in it"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("run.mcap");
        let mut writer = RecordingWriter::create(&file, RecordingOptions::default()).unwrap();
        for (topic, payload) in recorded {
            writer.write(&topic.in_run(&run), 0, &payload).unwrap();
        }
        writer.finish().unwrap();
        let Err(error) = RecordedRun::open(&file) else {
            panic!("it is shown, and not: {reason}");
        };
        assert_eq!(error.to_string(), format!("{}: {reason}", file.display()));
    }
}

#[test]
fn every_ego_of_a_recorded_run_is_shown_with_its_own_results() {
    let folder = tempfile::tempdir().unwrap();
    let run = record(folder.path(), true);
    assert_eq!(
        Vec::from_iter(run.egos()),
        [&cav(EGO), &cav(OTHER)],
        "in the order of their results"
    );
    for (ego, latency_ms) in [
        (None, 50.0),
        (Some(EGO), 50.0),
        (Some(OTHER), 30.0),
        (Some("77"), 50.0),
    ] {
        let timeline = run.timeline(ego.map(cav).as_ref());
        assert_eq!(timeline[1].latency_ms, Some(latency_ms), "{ego:?}");
    }
    for (ego, name) in [(None, EGO), (Some(cav(OTHER)), OTHER)] {
        let (frame, _) = parsed(&run.frame(2, ego.as_ref()).unwrap().unwrap().to_bytes());
        assert_eq!(
            (&frame["ego"], &frame["egos"]),
            (&name.into(), &serde_json::json!([EGO, OTHER]))
        );
        assert_eq!(frame["links"][0]["from"], other_than(name));
    }
    let poses_only = tempfile::tempdir().unwrap();
    let poses_only = record(poses_only.path(), false);
    let mut ticks = poses_only.timeline(None).iter();
    assert!(ticks.all(|tick| tick.links.is_empty()));
    // Published 25 ms after the tick and recorded at 60 ms, long before the next tick.
    let links = &run.timeline(None)[2].links;
    assert_eq!(
        (links.len(), links[0].from.as_str(), links[0].waiting_bytes),
        (1, OTHER, Some(0))
    );
    assert!(
        links[0].sent_bytes > 100 && links[0].transit_ms == Some(35.0),
        "{links:?}"
    );

    let server = serve_recorded("127.0.0.1:0".parse().unwrap(), Arc::new(run)).unwrap();
    let [frame, about, map, no_map] = [
        format!("/frame/0?ego={OTHER}"),
        format!("/run?ego={OTHER}"),
        format!("/map/{OTHER}?at=1"),
        format!("/map/{EGO}?at=1"),
    ]
    .map(|path| fetch(server.address(), &path).unwrap().1);
    assert_eq!(parsed(&frame).0["ego"], OTHER);
    let about: Value = serde_json::from_slice(&about).unwrap();
    assert_eq!(about["timeline"][0]["latency_ms"], 30.0);
    assert_eq!(&map[map.len() - 8..], [0, 0, 0, 0, 0, 85, 170, 255]);
    assert!(no_map.is_empty(), "it has published none");
    for (path, known) in [
        ("/frame/0?ego=9999", [EGO, OTHER]),
        ("/frame/0?ego=A/B", [EGO, OTHER]),
        ("/map/9999?at=0", [EGO, OTHER]),
        ("/camera/9999/0?at=0", [EGO, OTHER]),
        ("/frame/5", ["only 5", "from 0"]),
        ("/frame/x", ["only 5", "from 0"]),
        ("/map/4288?at=x", ["only 5", "from 0"]),
        ("/camera/4288/0?at=5", ["only 5", "from 0"]),
    ] {
        let (status, body) = fetch(server.address(), path).unwrap();
        let body = String::from_utf8_lossy(&body);
        assert!(status.contains("404"), "{path}: {status}");
        assert!(known.iter().all(|part| body.contains(part)), "{body}");
    }
}

/// The frame that a message of a replay with this epoch completes.
fn completed_frame(
    assembly: &mut FrameAssembler,
    (topic, payload): &(Topic, Vec<u8>),
    epoch: u64,
) -> Option<SceneFrame> {
    let mut header = wire::decode_header([payload.as_slice()]).unwrap();
    header.stamp.epoch = epoch;
    assembly.add(&ReceivedMessage {
        topic,
        header: &header,
        arrived_nanos: 0,
        payload: Some(payload),
    })
}

#[test]
fn a_replay_that_begins_anew_is_shown_from_its_beginning() {
    let mut assembly = FrameAssembler::default();
    for (epoch, tick, expected, why) in [
        (1, 3, &[3][..], "the first"),
        (1, 2, &[], "never back in time"),
        (2, 0, &[0], "but another replay has a time of its own"),
        (2, 1, &[1], "and goes on"),
    ] {
        let shown: Vec<u64> = messages(tick, 0, Stream::Lidar)
            .iter()
            .filter_map(|message| completed_frame(&mut assembly, message, epoch)?.tick)
            .collect();
        assert_eq!(shown, expected, "{why}");
    }
}

/// Tracks shown with a live tick as they complete it, after its result and after its tracks.
fn shown_tracks(
    assembly: &mut FrameAssembler,
    tick: u64,
    has_tracks: bool,
) -> [Option<Vec<ShownTrack>>; 2] {
    let mut result = None;
    for message in messages(tick, 100_000_000 * tick, Stream::Preview) {
        result = completed_frame(assembly, &message, 1);
    }
    let tracked = has_tracks.then(|| completed_frame(assembly, &tracks(tick), 1));
    [result, tracked.flatten()].map(|frame| Some(frame?.tracks))
}

#[test]
fn a_live_frame_waits_for_tracks_as_long_as_the_ego_tracks() {
    let mut assembly = FrameAssembler::default();
    assert_eq!(
        shown_tracks(&mut assembly, 0, true),
        [Some(vec![]), None],
        "not known yet"
    );
    for tick in [1, 2] {
        let [result, tracks] = shown_tracks(&mut assembly, tick, true);
        assert!(result.is_none(), "tick {tick}");
        assert_eq!(tracks.unwrap()[0].trail_m.len() as u64, tick + 1);
    }
    assert_eq!(shown_tracks(&mut assembly, 3, false), [None, None]);
    assert_eq!(
        shown_tracks(&mut assembly, 4, false),
        [Some(vec![]), None],
        "it tracks no more"
    );
}

#[test]
fn ticks_without_a_result_count_as_unanswered_once_a_later_one_is_shown() {
    let mut assembly = FrameAssembler::default();
    let mut pace = Vec::new();
    for tick in 0..6 {
        for message in messages(tick, 100_000_000 * tick, Stream::Preview) {
            let is_result = matches!(
                message.0,
                Topic::Stream {
                    stream: Stream::Detections,
                    ..
                }
            );
            if !is_result || tick % 2 == 1 {
                let frame = completed_frame(&mut assembly, &message, 1);
                pace.extend(frame.map(|frame| (frame.pace.answered, frame.pace.ticks)));
            }
        }
    }
    assert_eq!(pace, [(1, 2), (2, 4), (3, 6)]);
}

/// A run that goes on at 10 Hz until dropped.
struct Traffic {
    endpoint: Endpoint,
    ending: Arc<AtomicBool>,
}

impl Traffic {
    fn start(has_second_ego: bool) -> Self {
        let endpoint = Endpoint::loopback(
            TcpListener::bind("127.0.0.1:0")
                .unwrap()
                .local_addr()
                .unwrap()
                .port(),
        );
        let ending = Arc::<AtomicBool>::default();
        let bus = join(&BusOptions::router(endpoint.clone()), "replay");
        std::thread::spawn({
            let ending = Arc::clone(&ending);
            move || publish(bus, &ending, has_second_ego)
        });
        Self { endpoint, ending }
    }
}

impl Drop for Traffic {
    fn drop(&mut self) {
        self.ending.store(true, Ordering::Relaxed);
    }
}

fn join(options: &BusOptions, name: &str) -> Bus {
    let identity = Identity {
        run: RunId::new("test").unwrap(),
        process: name.parse().unwrap(),
        cav: CavId::new(name).unwrap(),
    };
    Bus::join(options, identity).unwrap()
}

fn publish(bus: Bus, ending: &AtomicBool, has_second_ego: bool) {
    let mut publishers = std::collections::BTreeMap::new();
    for tick in 0.. {
        let now = bus::unix_nanos();
        let second = if has_second_ego {
            messages_of_a_second_ego(tick, now)
        } else {
            Vec::new()
        };
        for (topic, payload) in messages(tick, now, Stream::Preview)
            .into_iter()
            .chain(second)
        {
            if matches!(
                topic,
                Topic::Stream {
                    stream: Stream::Detections,
                    ..
                }
            ) {
                // As long as perception takes: sweeps are far ahead of their results.
                std::thread::sleep(Duration::from_millis(50));
            }
            let is_preview = matches!(
                topic,
                Topic::Stream {
                    stream: Stream::Preview,
                    ..
                }
            );
            let options = if is_preview {
                PublisherOptions::PREVIEW
            } else {
                PublisherOptions::SENSOR
            };
            let publisher = publishers
                .entry(topic.clone())
                .or_insert_with(|| bus.publisher(topic, options).unwrap());
            // Unchanged: stamp and all.
            publisher.submit_encoded(0, move |_| {
                Ok(protocol::Encoded {
                    head: payload,
                    body: protocol::Body::Empty,
                })
            });
        }
        std::thread::sleep(Duration::from_millis(50));
        if ending.load(Ordering::Relaxed) {
            return;
        }
    }
}

#[test]
fn a_live_run_is_shown_and_a_slow_page_delays_no_other() {
    let traffic = Traffic::start(false);
    let run = Arc::new(
        LiveRun::start(
            join(&BusOptions::client(traffic.endpoint.clone()), "viewer"),
            None,
        )
        .unwrap(),
    );
    let server = serve_live("127.0.0.1:0".parse().unwrap(), Arc::clone(&run)).unwrap();

    // The run is subscribed to only once a page is open.
    let moments: Vec<_> = moments_of(server.address(), "frames=20")
        .iter()
        .map(|bytes| parsed(bytes))
        .collect();
    let captures: Vec<f64> = moments
        .iter()
        .map(|(frame, _)| frame["capture_s"].as_f64().unwrap())
        .collect();
    assert!(
        captures.windows(2).all(|pair| pair[0] < pair[1]),
        "always a newer one: {captures:?}"
    );
    // On a busy machine the passive subscriber drops parts of some frames, but hardly ever of all.
    let (frame, points) = moments
        .iter()
        .find(|(frame, points)| {
            !frame["ego"].is_null() && !frame["truth"][0].is_null() && *points == 8_000
        })
        .expect("a whole moment");
    check(frame, *points);
    wait_for("no page is open", || run.watchers() == 0);

    // A browser that never reads.
    let mut asleep = TcpStream::connect(server.address()).unwrap();
    asleep.write_all(b"GET /live HTTP/1.1\r\n\r\n").unwrap();
    wait_for("it is counted as a watcher", || run.watchers() == 1);
    // Others are served meanwhile.
    assert_eq!(moments_of(server.address(), "frames=3").len(), 3);
    wait_for("it is dropped", || server.readers().dropped() == 1);
    wait_for("and no watcher any more", || run.watchers() == 0);

    // Reports of processes, also those of this viewer, do not make a silent run a live one.
    let mut open = TcpStream::connect(server.address()).unwrap();
    open.write_all(b"GET /live HTTP/1.1\r\n\r\n").unwrap();
    wait_for("it is watched", || {
        run.status().silent_s.is_some_and(|silent_s| silent_s < 0.5)
    });
    traffic.ending.store(true, Ordering::Relaxed);
    wait_for("the run is silent", || {
        run.status().silent_s.is_some_and(|silent_s| silent_s > 1.5)
    });
}

#[test]
fn another_ego_and_a_feature_map_of_a_live_run_are_shown_on_request() {
    let traffic = Traffic::start(true);
    let run = Arc::new(
        LiveRun::start(
            join(&BusOptions::client(traffic.endpoint.clone()), "viewer"),
            None,
        )
        .unwrap(),
    );
    let server = serve_live("127.0.0.1:0".parse().unwrap(), Arc::clone(&run)).unwrap();
    let mut default_view = TcpStream::connect(server.address()).unwrap();
    default_view
        .write_all(b"GET /live HTTP/1.1\r\n\r\n")
        .unwrap();
    // Read to the end: a page that takes nothing is disconnected.
    std::thread::spawn(move || io::copy(&mut default_view, &mut io::sink()));
    wait_for("the default view is watched", || run.watchers() == 1);
    for ego in [EGO, OTHER] {
        let moments = moments_of(server.address(), &format!("frames=10&ego={ego}"));
        let shown: Vec<Value> = moments
            .iter()
            .map(|bytes| parsed(bytes).0["ego"].clone())
            .collect();
        assert!(
            shown.iter().all(|shown| shown.is_null() || *shown == ego),
            "{shown:?}"
        );
        assert!(shown.iter().any(|shown| *shown == ego), "{shown:?}");
    }
    // Received once a page asks for it.
    let path = format!("/map/{OTHER}");
    wait_for("a feature map", || {
        !fetch(server.address(), &path).unwrap().1.is_empty()
    });
}

/// Moments of a live run, as many as the query says.
fn moments_of(address: SocketAddr, query: &str) -> Vec<Vec<u8>> {
    let mut connection = TcpStream::connect(address).unwrap();
    connection.set_read_timeout(Some(TIMEOUT)).unwrap();
    write!(connection, "GET /live?{query} HTTP/1.0\r\n\r\n").unwrap();
    let mut answer = Vec::new();
    connection.read_to_end(&mut answer).unwrap();
    let mut rest = &answer[answer
        .windows(4)
        .position(|bytes| bytes == b"\r\n\r\n")
        .unwrap()
        + 4..];
    let mut moments = Vec::new();
    while let Some((len, behind)) = rest.split_at_checked(4) {
        let (moment, next) = behind.split_at(u32::from_le_bytes(len.try_into().unwrap()) as usize);
        if !moment.is_empty() {
            moments.push(moment.to_vec());
        }
        rest = next;
    }
    moments
}

fn wait_for(what: &str, condition: impl Fn() -> bool) {
    let deadline = Instant::now() + TIMEOUT;
    while !condition() {
        assert!(Instant::now() < deadline, "{what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}
