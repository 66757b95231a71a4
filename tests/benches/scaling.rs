//! Scaling of one ego with the number of neighbours: cost per neighbour, latency of results, share of late feature
//! maps.
//!
//! `ego-fuser run` is the measured process. Its neighbours have no networks: each sends the feature map of one recorded
//! sweep repeatedly, 10 times a second, from its position on a ring around the ego. Method `max`, one thread.
//!
//! ```text
//! cargo build --release --workspace --bins
//! cargo bench -p tests --bench scaling -- --out deploy/results/scaling
//! cargo bench -p tests --bench scaling -- --out /tmp/scaling --models small --dtype f16 --agents 1,8 --seconds 10
//! ```
//!
//! Lattices (BEV grids): `lean`, that of the released weights (64 channels on 128 x 96 cells), and `small`, a quarter
//! of its area with untrained weights. The neighbours, the router and the ego share the machine. Writes `scaling.csv`
//! and `scaling.md`; the straight line is fitted to the counts at which at least 95 % of all feature maps were fused in
//! time.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use agent::agent::{Agent, AgentInput};
use anyhow::{Context, Result, bail};
use bus::bounded_queue::Pop;
use bus::{Barrier, Bus, BusOptions, Event, Identity, PublisherOptions, Route, open, unix_nanos};
use dataset::{self, LoadOptions};
use fusion::Method;
use fusion::model::CooperativeModel;
use localization::pose_source::RecordedPose;
use perception::detector::Detector;
use perception::model_config::DetectorConfig;
use perception::weights::{self, Weights};
use protocol::message::Bev;
use protocol::{
    CavId, CodecConfig, Detections, Dtype, EncodedFeatures, Limits, Pose, PoseEstimate, ProcessId,
    Role, RunId, Stream, Topic, encode_features, wire,
};
use support::statistics;
use tch::Device;
use tests::bus::{TIMEOUT, TestRouter};
use tests::machine;

const PERIOD: Duration = Duration::from_millis(100);
/// Longest wait of the ego for its neighbours, from the arrival of its own feature map.
const DEADLINE_MS: u32 = 80;
/// Ticks before the measurement.
const WARM_UP: u32 = 20;
/// Distance from the ego to every neighbour, metres.
const RING_M: f64 = 15.0;
/// Share of feature maps fused in time from which a count takes part in the fit.
const IN_TIME: f64 = 0.95;

/// Options of the benchmark.
struct Wanted {
    out: PathBuf,
    models: Vec<String>,
    dtype: Dtype,
    agents: Vec<usize>,
    seconds: u32,
}

fn wanted(arguments: &[String]) -> Result<Wanted> {
    let mut wanted = Wanted {
        out: PathBuf::new(),
        models: vec!["lean".into(), "small".into()],
        dtype: Dtype::I8,
        agents: vec![1, 2, 4, 8, 16, 32],
        seconds: 20,
    };
    let mut arguments = arguments.iter().filter(|argument| *argument != "--bench");
    while let Some(name) = arguments.next() {
        let value = arguments
            .next()
            .with_context(|| format!("{name} needs a value"))?;
        match name.as_str() {
            // cargo runs benches in the folder of their package.
            "--out" => wanted.out = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(value),
            "--models" => wanted.models = value.split(',').map(str::to_owned).collect(),
            "--dtype" => {
                wanted.dtype = match value.as_str() {
                    "f16" => Dtype::F16,
                    "i8" => Dtype::I8,
                    _ => Dtype::F32,
                }
            }
            "--agents" => {
                wanted.agents = value.split(',').map(str::parse).collect::<Result<_, _>>()?
            }
            "--seconds" => wanted.seconds = value.parse()?,
            _ => bail!("{name} is none of --out, --models, --dtype, --agents, --seconds"),
        }
    }
    if wanted.out == PathBuf::new() {
        bail!("--out DIR is required: the folder of the table");
    }
    Ok(wanted)
}

/// One line of the table; times in milliseconds.
struct Row {
    model: String,
    dtype: Dtype,
    bytes: u64,
    neighbours: usize,
    frames: usize,
    lost_frames: usize,
    /// Number of frames that were decided without all neighbours.
    incomplete: usize,
    in_time: f64,
    cpu_per_frame_ms: f64,
    latency_p50_ms: f64,
    latency_p99_ms: f64,
}

/// A result as received by the scorer.
struct ReceivedResult {
    capture_nanos: u64,
    publish_nanos: u64,
    in_time: usize,
}

/// The feature map of a recorded sweep, and weights of the BEV grid.
fn recorded_map(model: &str, folder: &Path, dtype: Dtype) -> Result<(PathBuf, EncodedFeatures)> {
    let file = match model {
        "lean" => {
            Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/weights/lean-max.safetensors")
        }
        "small" => {
            let config = DetectorConfig {
                lidar_range_m: [-25.6, -19.2, -3.0, 25.6, 19.2, 1.0],
                ..DetectorConfig::lean()
            };
            tch::manual_seed(7);
            let model = CooperativeModel::new(&config, Method::MAX, tch::Device::Cpu)?;
            let file = folder.join("small.safetensors");
            weights::save(
                &file,
                &model.variables,
                &model.about(),
                weights::Precision::Single,
            )?;
            file
        }
        _ => bail!("model must be lean or small"),
    };
    tests::scene::write(folder, &["0"], 1);
    let scenario = dataset::open(&folder.join("scene"))?.scenarios.remove(0);
    let frame = scenario.load(0, 0, &LoadOptions::default())?;
    let weights = Weights::load(&file)?;
    let detector = Detector::from_weights(&weights, &weights.detector_config()?, Device::Cpu)?;
    let mut agent = Agent::new(cav(0), Box::new(RecordedPose), detector);
    let input = AgentInput {
        capture_nanos: frame.capture_nanos,
        cloud: &frame.points,
        measured_pose: frame.world_from_lidar.as_ref(),
        motion: frame.motion(),
    };
    let features = agent.process(&input)?.perception.features;
    Ok((
        file,
        encode_features(
            features,
            &CodecConfig {
                dtype,
                ..CodecConfig::default()
            },
            None,
        )?,
    ))
}

fn cav(index: usize) -> CavId {
    CavId::new(&index.to_string()).expect("a number is an identifier")
}

fn topic(index: usize, stream: Stream) -> Topic {
    Topic::Stream {
        cav: cav(index),
        stream,
    }
}

/// On the ring around the ego.
fn pose(index: usize, count: usize) -> PoseEstimate {
    let angle = std::f64::consts::TAU * index as f64 / count as f64;
    let place = if index == 0 {
        [0.0; 3]
    } else {
        [RING_M * angle.cos(), RING_M * angle.sin(), 1.9]
    };
    PoseEstimate::new(
        Pose {
            translation_m: place,
            ..Pose::IDENTITY
        },
        1.0,
    )
}

fn measure(
    file: &Path,
    map: &EncodedFeatures,
    count: usize,
    seconds: u32,
) -> Result<(Row, Vec<ReceivedResult>)> {
    let router = TestRouter::open();
    let session = open(&BusOptions::client(router.endpoint.clone()))?;
    let joined = |index: usize| {
        let process = ProcessId::new(&format!("agent-{index}"))?;
        anyhow::Ok(Bus::over(
            session.clone(),
            Identity {
                run: RunId::new("test")?,
                process,
                cav: cav(index),
            },
        )?)
    };
    let fleet = (0..=count).map(joined).collect::<Result<Vec<_>>>()?;
    let scorer = router.join("scorer", "scorer");
    let inbox = scorer.inbox(4096, 1);
    let _subscription = scorer.subscribe(topic(0, Stream::Detections), &inbox)?;
    let presences = fleet
        .iter()
        .map(|bus| bus.announce(Role::Agent))
        .collect::<Result<Vec<_>, _>>()?;
    let publishers = fleet
        .iter()
        .enumerate()
        .map(|(index, bus)| bus.publisher(topic(index, Stream::Bev), PublisherOptions::FEATURES));
    let publishers = publishers.collect::<Result<Vec<_>, _>>()?;
    let mut ego = start_ego(&router, file)?;
    let mut routes = vec![Route {
        topic: topic(0, Stream::Detections),
        receiver: "scorer".parse()?,
    }];
    for index in 0..=count {
        routes.push(Route {
            topic: topic(index, Stream::Bev),
            receiver: "ego-0".parse()?,
        });
    }
    Barrier::new(routes).await_routes(&scorer)?.wait(TIMEOUT)?;

    let (began, mut cpu_ms, mut first_nanos) = (Instant::now(), 0.0, 0);
    let ticks = WARM_UP + seconds * 10;
    for tick in 0..ticks {
        thread::sleep((began + tick * PERIOD).saturating_duration_since(Instant::now()));
        let capture_nanos = unix_nanos();
        if tick == WARM_UP {
            (cpu_ms, first_nanos) = (machine::cpu_ms(ego.id())?, capture_nanos);
        }
        for (index, publisher) in publishers.iter().enumerate() {
            let (features, pose) = (map.clone(), pose(index, count));
            publisher.submit_encoded(capture_nanos, move |stamp| {
                wire::encode(stamp, Bev { pose, features })
            });
        }
    }
    thread::sleep(PERIOD * 3);
    let cpu_ms = machine::cpu_ms(ego.id())? - cpu_ms;
    publishers.into_iter().for_each(bus::Publisher::finish);
    presences
        .into_iter()
        .try_for_each(bus::LivelinessToken::withdraw)?;
    if !ego.wait()?.success() {
        bail!("the ego failed: see above");
    }
    let mut received = Vec::new();
    while let Pop::Item(_, Event::Message(arrival)) = inbox.take(Some(Instant::now())) {
        let result: Detections = arrival.decode(&Limits::DEFAULT)?;
        let in_time = result
            .fused
            .iter()
            .filter(|fused| fused.age_nanos == 0)
            .count();
        let (capture_nanos, publish_nanos) = (
            arrival.header.stamp.capture_nanos,
            arrival.header.stamp.publish_nanos,
        );
        if capture_nanos >= first_nanos {
            received.push(ReceivedResult {
                capture_nanos,
                publish_nanos,
                in_time,
            });
        }
    }
    Ok((
        row(map, count, (ticks - WARM_UP) as usize, cpu_ms, &received),
        received,
    ))
}

fn start_ego(router: &TestRouter, weights: &Path) -> Result<Child> {
    let mut command = Command::new(tests::fleet::programs().join("ego-fuser"));
    command.args([
        "run",
        "--run=test",
        "--ego=0",
        "--method=max",
        "--threads=1",
    ]);
    command
        .arg(format!("--connect={}", router.endpoint))
        .arg(format!("--deadline-ms={DEADLINE_MS}"));
    Ok(command
        .arg("--weights")
        .arg(weights)
        .stdout(Stdio::null())
        .spawn()?)
}

fn row(
    map: &EncodedFeatures,
    count: usize,
    ticks: usize,
    cpu_ms: f64,
    received: &[ReceivedResult],
) -> Row {
    let latencies: Vec<f64> = received
        .iter()
        .map(|received| {
            received
                .publish_nanos
                .saturating_sub(received.capture_nanos) as f64
                / 1e6
        })
        .collect();
    let latencies = statistics::sorted(&latencies);
    let quantile = |q: f64| statistics::quantile(&latencies, q).unwrap_or(f64::NAN);
    let fused: usize = received.iter().map(|received| received.in_time).sum();
    Row {
        model: String::new(),
        dtype: Dtype::F32,
        bytes: map.body.as_bytes().len() as u64,
        neighbours: count,
        frames: received.len(),
        lost_frames: ticks - received.len().min(ticks),
        incomplete: received
            .iter()
            .filter(|received| received.in_time < count)
            .count(),
        in_time: fused as f64 / (ticks * count) as f64,
        cpu_per_frame_ms: cpu_ms / received.len().max(1) as f64,
        latency_p50_ms: quantile(0.5),
        latency_p99_ms: quantile(0.99),
    }
}

/// Offset and slope of the straight line through the counts that are in time, and the share of the variance it
/// explains.
fn line(rows: &[&Row]) -> Option<[f64; 3]> {
    let points: Vec<[f64; 2]> = rows
        .iter()
        .filter(|row| row.in_time >= IN_TIME)
        .map(|row| [row.neighbours as f64, row.cpu_per_frame_ms])
        .collect();
    let count = points.len() as f64;
    let mean = |axis: usize| points.iter().map(|point| point[axis]).sum::<f64>() / count;
    let [x, y] = [mean(0), mean(1)];
    let sum = |of: &dyn Fn(&[f64; 2]) -> f64| points.iter().map(of).sum::<f64>();
    let (xx, xy, yy) = (
        sum(&|p| (p[0] - x).powi(2)),
        sum(&|p| (p[0] - x) * (p[1] - y)),
        sum(&|p| (p[1] - y).powi(2)),
    );
    (points.len() > 2).then(|| [y - x * xy / xx, xy / xx, xy * xy / (xx * yy)])
}

fn write(wanted: &Wanted, arguments: &str, rows: &[Row]) -> Result<()> {
    fs::create_dir_all(&wanted.out)?;
    let mut csv =
        "model,dtype,map_bytes,neighbours,frames,lost_frames,incomplete_frames,share_in_time,\
        ego_cpu_ms_per_frame,latency_p50_ms,latency_p99_ms\n"
            .to_owned();
    let mut markdown = format!(
        "`cargo bench -p tests --bench scaling -- {arguments}`\n\n{}\n\n\
        | model | dtype | KB a map | neighbours | frames | lost frames | incomplete | maps in time | ego CPU ms/frame | \
        latency p50 ms | p99 ms |\n|---|---|---|---|---|---|---|---|---|---|---|\n",
        machine::describe(),
    );
    for row in rows {
        let Row {
            model,
            dtype,
            bytes,
            neighbours,
            frames,
            lost_frames,
            incomplete,
            in_time,
            ..
        } = row;
        let [cpu, p50, p99] = [row.cpu_per_frame_ms, row.latency_p50_ms, row.latency_p99_ms];
        let dtype = format!("{dtype:?}").to_lowercase();
        writeln!(
            csv,
            "{model},{dtype},{bytes},{neighbours},{frames},{lost_frames},{incomplete},{in_time:.4},{cpu:.2},{p50:.1},{p99:.1}"
        )?;
        writeln!(
            markdown,
            "| {model} | {dtype} | {} | {neighbours} | {frames} | {lost_frames} | {incomplete} | {:.1} % | {cpu:.1} | {p50:.1} | {p99:.1} |",
            bytes / 1000,
            100.0 * in_time
        )?;
    }
    markdown.push('\n');
    for model in &wanted.models {
        let rows: Vec<&Row> = rows.iter().filter(|row| row.model == *model).collect();
        if let Some([offset, slope, share]) = line(&rows) {
            writeln!(
                markdown,
                "{model}: {offset:.1} ms and {slope:.2} ms for each neighbour, R^2 {share:.4}, over the counts with at \
                 least 95 % of the maps in time"
            )?;
        }
    }
    fs::write(wanted.out.join("scaling.csv"), csv)?;
    fs::write(wanted.out.join("scaling.md"), &markdown)?;
    println!("{markdown}");
    Ok(())
}

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args()
        .skip(1)
        .filter(|argument| argument != "--bench")
        .collect();
    let wanted = wanted(&arguments)?;
    tch::set_num_threads(1);
    let mut rows = Vec::new();
    for model in &wanted.models {
        let folder = tempfile::tempdir()?;
        let (file, map) = recorded_map(model, folder.path(), wanted.dtype)?;
        for &count in &wanted.agents {
            let (row, _) = measure(&file, &map, count, wanted.seconds)?;
            eprintln!(
                "{model}, {count}: {:.1} ms CPU a frame, {:.1} % in time, p99 {:.1} ms",
                row.cpu_per_frame_ms,
                100.0 * row.in_time,
                row.latency_p99_ms
            );
            rows.push(Row {
                model: model.clone(),
                dtype: wanted.dtype,
                ..row
            });
        }
    }
    write(&wanted, &arguments.join(" "), &rows)
}
