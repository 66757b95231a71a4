//! Sweeps of an agent and frames of the ego with released weights on a recorded scene: time of each stage, by method and
//! number of vehicles, in milliseconds and in units that hardly depend on the machine.
//!
//! `cargo bench -p ego-fuser --bench ego_frame -- --scene SCENE --weights deploy/weights pastat max`
//!
//! Maps pass through the codec as live ones do. Poses err by 0.2 m. Each frame is computed several times, on the same
//! history; a figure is the mean over the frames of each frame's fastest run. `--boxes FILE` writes what was detected,
//! so that two versions can be compared. A unit is the time of one 3x3 convolution of 64 to 64 channels on 96 x 128 cells
//! in 32-bit floating point on one thread. `ONEDNN_MAX_CPU_ISA=AVX2 ATEN_CPU_CAPABILITY=avx2` holds libtorch to AVX2.

use std::collections::BTreeMap;
use std::error::Error;
use std::fs;
use std::hint::black_box;
use std::path::PathBuf;
use std::time::Instant;

use agent::agent::{Agent, AgentInput};
use agent::agent_output::AgentOutput;
use bus::malloc_settings;
use clap::Parser;
use dataset::frame::Frame;
use dataset::{LoadOptions, Scenario};
use ego_fuser::ego::{Content, Ego, View};
use fusion::{Exchange, Method};
use localization::pose_source::PoseSourceConfig;
use perception::detector::Detector;
use perception::inference::Inference;
use perception::int8::InferencePrecision;
use perception::weights::Weights;
use protocol::codec::encode_features;
use protocol::{CodecConfig, EncodedFeatures, Limits, Pose, PoseEstimate, StageTiming};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use support::stage_times::StageTimes;
use tch::{Device, Kind, Tensor};

/// Largest error of a pose along x and y, metres.
const POSE_ERROR_M: f64 = 0.2;
/// The same of its heading, radians.
const HEADING_ERROR_RAD: f64 = 0.004;
/// Convolutions of which the fastest is the unit.
const UNIT_RUNS: usize = 40;
/// Confidence of every pose.
const CONFIDENCE: f32 = 0.9;

type Failure = Box<dyn Error>;

/// Times frames of the ego.
#[derive(Debug, Parser)]
struct Arguments {
    /// Methods, each with its released weights.
    methods: Vec<Method>,
    /// A scenario with as many vehicles as are asked for.
    #[arg(long)]
    scene: PathBuf,
    /// Folder of the released weights.
    #[arg(long, default_value = "deploy/weights")]
    weights: PathBuf,
    /// Number format in which networks are computed.
    #[arg(long, value_enum, default_value_t)]
    precision: InferencePrecision,
    /// Numbers of vehicles, the ego included.
    #[arg(long, num_args = 1.., default_values_t = [2, 3, 4])]
    vehicles: Vec<usize>,
    /// Frames, one after another.
    #[arg(long, default_value_t = 6)]
    frames: usize,
    /// Runs over all frames.
    #[arg(long, default_value_t = 8)]
    runs: usize,
    /// Written: detections of the last run.
    #[arg(long)]
    boxes: Option<PathBuf>,
    /// Passed by `cargo bench`.
    #[arg(long, hide = true)]
    bench: bool,
}

/// One vehicle's message of a frame, its map still encoded.
struct Sent {
    view: View,
    features: Option<EncodedFeatures>,
}

fn main() -> Result<(), Failure> {
    malloc_settings::ensure(&malloc_settings::KEPT_MEMORY)?;
    tch::set_num_threads(1);
    let arguments = Arguments::parse();
    let scenario = dataset::open(&arguments.scene)?
        .scenarios
        .into_iter()
        .next()
        .ok_or("no scenario")?;
    let unit_ms = unit_ms();
    println!("unit: {unit_ms:.2} ms");
    let mut boxes = String::new();
    for &method in &arguments.methods {
        // Boxes and single vehicles have the weights of `none`.
        let named = arguments.weights.join(format!("lean-{method}.safetensors"));
        let weights = if named.exists() {
            named
        } else {
            arguments.weights.join("lean-none.safetensors")
        };
        for &vehicles in &arguments.vehicles {
            let weights = Weights::load(&weights)?.with_precision(arguments.precision);
            let mut sweep = BTreeMap::new();
            let size = [vehicles, arguments.frames];
            let frames = sent(&scenario, &weights, method, size, &mut sweep)?;
            let mut best: Vec<BTreeMap<String, f64>> = vec![BTreeMap::new(); frames.len()];
            for run in 0..arguments.runs {
                let mut ego = Ego::from_weights(&weights, Some(method), Device::Cpu)?;
                for (index, (frame, best)) in frames.iter().zip(&mut best).enumerate() {
                    let found = timed(&mut ego, frame, best)?;
                    if run + 1 == arguments.runs {
                        boxes += &format!("{method} {vehicles} {index} {found}\n");
                    }
                }
            }
            print(&format!("{method}/{vehicles} sweep"), &[sweep], unit_ms);
            print(&format!("{method}/{vehicles} frame"), &best, unit_ms);
        }
    }
    if let Some(path) = &arguments.boxes {
        fs::write(path, boxes)?;
    }
    Ok(())
}

/// The fastest of some convolutions, milliseconds.
fn unit_ms() -> f64 {
    let of = |size: &[i64]| Tensor::rand(size, (Kind::Float, Device::Cpu));
    let (map, weight) = (
        of(&[1, 96, 128, 64]).permute([0, 3, 1, 2]),
        of(&[64, 64, 3, 3]),
    );
    let times = (0..UNIT_RUNS).map(|_| {
        let start = Instant::now();
        let _ = black_box(map.conv2d(&weight, None::<&Tensor>, [1, 1], [1, 1], [1, 1], 1));
        start.elapsed().as_secs_f64() * 1e3
    });
    times.fold(f64::INFINITY, f64::min)
}

/// Lowers the fastest time of each stage, milliseconds.
fn lower(best: &mut BTreeMap<String, f64>, stages: impl IntoIterator<Item = (String, f64)>) {
    for (stage, ms) in stages {
        let least = best.entry(stage).or_insert(f64::INFINITY);
        *least = least.min(ms);
    }
}

/// Name and duration of a stage, milliseconds.
fn in_ms(stage: &StageTiming) -> (String, f64) {
    (stage.stage.clone(), stage.nanos as f64 * 1e-6)
}

/// Computes one frame and lowers the fastest time of each stage, milliseconds; returns the boxes as text.
fn timed(
    ego: &mut Ego,
    frame: &[Sent],
    best: &mut BTreeMap<String, f64>,
) -> Result<String, Failure> {
    let mut times = StageTimes::start();
    let views = frame
        .iter()
        .map(Sent::received)
        .collect::<Result<Vec<View>, Failure>>()?;
    times.lap("decode");
    let start = Instant::now();
    let output = ego.detect(&views[0], &views[1..])?;
    let whole_ms = start.elapsed().as_secs_f64() * 1e3;
    let stages = times.into_timings().into_iter().chain(output.stages);
    let mut all: Vec<(String, f64)> = stages.map(|stage| in_ms(&stage)).collect();
    let staged_ms: f64 = all.iter().skip(1).map(|(_, ms)| ms).sum();
    all.push(("keep".to_owned(), whole_ms - staged_ms));
    lower(best, all);
    let text = |found: &protocol::Detection| {
        let [x, y, _] = found.box3d.center_m;
        format!(
            "{:.4} {x:.3} {y:.3} {:.4}",
            found.score, found.box3d.heading_rad
        )
    };
    Ok(output
        .detections
        .iter()
        .map(text)
        .collect::<Vec<_>>()
        .join("; "))
}

impl Sent {
    /// As the ego's node hands it to the pipeline.
    fn received(&self) -> Result<View, Failure> {
        let View {
            cav,
            pose,
            capture_nanos,
            content,
        } = &self.view;
        let content = match &self.features {
            Some(features) => Content::Features(features.clone().decode(&Limits::DEFAULT)?),
            None => content.clone(),
        };
        Ok(View {
            cav: cav.clone(),
            pose: *pose,
            capture_nanos: *capture_nanos,
            content,
        })
    }
}

/// Messages of all vehicles, frame by frame; `sweep` gets the fastest time of each stage of an agent.
fn sent(
    scenario: &Scenario,
    weights: &Weights,
    method: Method,
    [vehicles, frames]: [usize; 2],
    sweep: &mut BTreeMap<String, f64>,
) -> Result<Vec<Vec<Sent>>, Failure> {
    let mut random = ChaCha8Rng::seed_from_u64(vehicles as u64);
    let mut agents = Vec::new();
    for cav in scenario.agents.iter().take(vehicles) {
        let source = PoseSourceConfig::Recorded
            .for_scenario(&scenario.name)
            .build(Inference::default())?;
        agents.push(Agent::new(
            cav.clone(),
            source,
            Detector::from_weights(weights, &weights.detector_config()?, Device::Cpu)?,
        ));
    }
    let mut all = Vec::with_capacity(frames);
    for tick in 0..frames {
        let loaded = scenario.load_tick(tick, 0..vehicles, &LoadOptions::default());
        let mut sent = Vec::with_capacity(vehicles);
        for (agent, frame) in &loaded.frames {
            sent.push(message(
                &mut agents[*agent],
                frame,
                method,
                *agent == 0,
                &mut random,
                sweep,
            )?);
        }
        all.push(sent);
    }
    Ok(all)
}

fn message(
    agent: &mut Agent,
    frame: &Frame,
    method: Method,
    is_ego: bool,
    random: &mut ChaCha8Rng,
    sweep: &mut BTreeMap<String, f64>,
) -> Result<Sent, Failure> {
    let input = AgentInput {
        capture_nanos: frame.capture_nanos,
        cloud: &frame.points,
        measured_pose: frame.world_from_lidar.as_ref(),
        motion: frame.motion(),
    };
    let AgentOutput {
        mut pose,
        perception,
    } = agent.process(&input)?;
    lower(sweep, perception.times.iter().map(in_ms));
    if let PoseEstimate::Pose {
        world_from_cav,
        confidence,
        ..
    } = &mut pose
    {
        let [x, y, z] = world_from_cav.translation_m;
        let mut error = |most: f64| random.random_range(-most..most);
        let place = [x + error(POSE_ERROR_M), y + error(POSE_ERROR_M), z];
        *world_from_cav =
            Pose::from_xyz_yaw(place, world_from_cav.yaw_rad() + error(HEADING_ERROR_RAD));
        *confidence = CONFIDENCE;
    }
    let (content, features) = match method.own_content() {
        Exchange::Points => (Content::Points(agent.share_points(&frame.points)), None),
        Exchange::Boxes => (
            Content::Boxes(perception.detections.into_iter().map(Into::into).collect()),
            None,
        ),
        Exchange::Features | Exchange::Nothing => {
            let gate = method.gate().filter(|_| !is_ego);
            let codec = CodecConfig {
                gate,
                ..CodecConfig::default()
            };
            let confidence = Some(&perception.confidence[..]);
            let features = encode_features(perception.features, &codec, confidence)?;
            (Content::Boxes(Vec::new()), Some(features))
        }
    };
    let view = View {
        cav: frame.cav.clone(),
        pose,
        capture_nanos: frame.capture_nanos,
        content,
    };
    Ok(Sent { view, features })
}

/// One line: the mean over the frames from the third on, where the history is full, and the sum of the stages.
fn print(what: &str, best: &[BTreeMap<String, f64>], unit_ms: f64) {
    let full = &best[best.len().min(3) - 1..];
    let stages = full.last().into_iter().flat_map(BTreeMap::keys);
    let mean = |stage: &String| {
        full.iter()
            .filter_map(|frame| frame.get(stage))
            .sum::<f64>()
            / full.len() as f64
    };
    let stages: Vec<(&String, f64)> = stages.map(|stage| (stage, mean(stage))).collect();
    let sum: f64 = stages.iter().map(|(_, ms)| ms).sum();
    let text = |name: &str, ms: f64| format!("{name} {ms:.2} ms = {:.2} units", ms / unit_ms);
    let mut texts: Vec<String> = stages.iter().map(|(name, ms)| text(name, *ms)).collect();
    texts.push(text("sum", sum));
    println!("{what}: {}", texts.join(", "));
}
