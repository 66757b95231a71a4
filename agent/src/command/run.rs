//! `agent run`: one vehicle of a live fleet.

use std::path::PathBuf;
use std::str::FromStr;

use agent::agent::Agent;
use agent::attack::{Attack, Lie};
use agent::node::{self, NodeOptions};
use agent::output_filter::{OutputFilter, Unfiltered};
use agent::rate::RateConfig;
use anyhow::Context;
use bus::{BusArgs, STOP_LIMIT, log_to_stderr};
use clap::ValueEnum;
use localization::pose_source::motion_gate::SanityConfig;
use localization::pose_source::{
    EndToEndPoseConfig, NoiseMode, NoisyPoseConfig, PgcConfig, PoseSource, PoseSourceConfig,
};
use perception::detector::Detector;
use protocol::{CavId, CodecConfig, ConfidenceGate, Dtype, Role, Smoothing, Stream};
use support::output;

use support::cli::BadInput;

/// Run one vehicle: its sensors in; pose, feature map, boxes or points out.
///
/// Ends when the replay does, or on Ctrl-C or SIGTERM.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    bus: BusArgs,
    /// The vehicle.
    #[arg(long, allow_hyphen_values = true)]
    cav: CavId,
    /// Weights of the detector (safetensors; its configuration is inside).
    #[arg(long)]
    weights: PathBuf,
    /// Where the vehicle takes its pose from.
    #[arg(long, value_enum, default_value_t = PoseFrom::Recorded)]
    pose_source: PoseFrom,
    #[command(flatten)]
    noise: NoiseArgs,
    #[command(flatten)]
    localizer: LocalizerArgs,
    /// What to send beside the pose.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "bev")]
    publish: Vec<Published>,
    /// How exactly feature values are written.
    #[arg(long, value_enum, default_value_t = Exactness::F32)]
    dtype: Exactness,
    /// Confidence that a cell must exceed to be sent [default: all cells are sent].
    #[arg(long, value_name = "CONFIDENCE", allow_negative_numbers = true)]
    gate: Option<f32>,
    /// Window that the confidence is smoothed with first: edge in cells, sigma in cells; or none.
    #[arg(long, value_name = "CELLS,SIGMA", default_value = "5,1", requires = "gate")]
    gate_smoothing: SmoothingArg,
    /// Most bytes of a feature map, before packing: the cells with the highest confidence that fit are sent
    /// [default: all].
    #[arg(long, value_name = "BYTES", visible_alias = "budget-bytes")]
    budget: Option<u64>,
    /// zstd level, 1 to 22 [default: maps are not packed].
    #[arg(long, value_name = "LEVEL", visible_alias = "zstd-level", value_parser = clap::value_parser!(i32).range(1..=22))]
    zstd: Option<i32>,
    #[command(flatten)]
    rate: RateArgs,
    /// Tell lies, to see what they do to the fleet.
    #[arg(long, value_enum)]
    lie: Option<LieAbout>,
    /// Threads to compute with; the same number gives the same bits.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: u16,
    /// Go on when the replay ends, for the next one; always so with --supervised.
    #[arg(long)]
    keep_running: bool,
    /// Note in this file when each sweep came: capture time and arrival, nanoseconds.
    #[arg(long, value_name = "FILE")]
    sweep_log: Option<PathBuf>,
    /// Print a JSON summary at the end.
    #[arg(long)]
    json: bool,
}

/// What feature maps are fitted to: first in coarser numbers, then with fewer cells, the most confident ones.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Fitting feature maps to the air")]
struct RateArgs {
    /// Most bytes of a message with a map, header and metadata included.
    #[arg(long, value_name = "BYTES")]
    message_bytes: Option<u64>,
    /// Most bytes per second of such messages.
    #[arg(long, value_name = "BYTES")]
    bytes_per_second: Option<u64>,
    /// Send less while maps wait for earlier ones to leave, and more again when they do not.
    #[arg(long)]
    watch_queue: bool,
}

/// Error on the recorded pose, with --pose-source noisy.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Noise on the pose (--pose-source noisy)")]
struct NoiseArgs {
    /// How the errors of successive frames hang together.
    #[arg(long, value_enum, default_value_t = Mode::Fixed)]
    noise_mode: Mode,
    /// Standard deviation of x, y and z, metres.
    #[arg(long, visible_alias = "noise-std-m", default_value_t = NoisyPoseConfig::default().position_std_m)]
    noise_position_std: f64,
    /// Standard deviation of yaw, degrees.
    #[arg(long, visible_alias = "noise-std-deg", default_value_t = NoisyPoseConfig::default().heading_std_deg)]
    noise_heading_std: f64,
    /// Same seed, same errors.
    #[arg(long, default_value_t = NoisyPoseConfig::default().seed)]
    noise_seed: u64,
    /// Seconds between two draws, for the modes that depend on time.
    #[arg(long, default_value_t = NoisyPoseConfig::default().step_s)]
    noise_step: f64,
    /// Seconds after which an autoregressive error has decayed to 1/e.
    #[arg(long, default_value_t = NoisyPoseConfig::default().decay_s)]
    noise_decay: f64,
    /// File of errors for the replayed mode.
    #[arg(long)]
    noise_table: Option<PathBuf>,
}

/// Networks that find the pose, with --pose-source pgc or end-to-end.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Pose from the sweep alone (--pose-source pgc, end-to-end)")]
struct LocalizerArgs {
    /// Weights of the localizer's encoder.
    #[arg(long, required_if_eq("pose_source", "pgc"))]
    encoder: Option<PathBuf>,
    /// Weights of the town's head.
    #[arg(long, required_if_eq("pose_source", "pgc"))]
    head: Option<PathBuf>,
    /// Weights of a network that was trained end to end.
    #[arg(long, value_name = "FILE", required_if_eq_any([("pose_source", "end-to-end"), ("pose_source", "end_to_end")]))]
    end_to_end: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum PoseFrom {
    /// The recording's own pose.
    Recorded,
    /// That pose with an error.
    Noisy,
    /// From the LiDAR sweep alone.
    Pgc,
    /// The same by a network that was trained end to end, to compare with.
    #[value(alias = "end_to_end")]
    EndToEnd,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum LieAbout {
    /// A pose 5 to 30 m off, and sure of it.
    ShiftedPose,
    /// Noise instead of what is seen.
    Noise,
    /// What was seen first, again and again.
    Copied,
    /// Ten vehicles that are not there.
    Invented,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Mode {
    /// One offset, the same for all vehicles and frames.
    Fixed,
    /// Drawn anew for every vehicle and frame.
    Independent,
    /// Wanders, as a filter's error does.
    Autoregressive,
    /// From a file.
    Replayed,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Published {
    /// Feature maps.
    Bev,
    /// Its own detections.
    Boxes,
    /// Its points, for the early-fusion baseline.
    Points,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Exactness {
    /// 4 bytes, exact.
    F32,
    /// 2 bytes.
    F16,
    /// 1 byte and a scale per channel.
    I8,
}

/// `5,1`: a window of 5 x 5 cells with a sigma of one cell; `none`: no smoothing.
#[derive(Debug, Clone, Copy, PartialEq)]
struct SmoothingArg(Option<Smoothing>);

impl FromStr for SmoothingArg {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "none" {
            return Ok(Self(None));
        }
        let (kernel, sigma) = text.split_once(',').ok_or_else(|| format!("{text:?} is not CELLS,SIGMA or none"))?;
        let kernel = kernel.trim().parse().map_err(|error| format!("window {kernel:?}: {error}"))?;
        let sigma = sigma.trim().parse().map_err(|error| format!("sigma {sigma:?}: {error}"))?;
        Ok(Self(Some(Smoothing { kernel, sigma })))
    }
}

/// Loads the models, joins the run and works until the replay ends.
pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    log_to_stderr();
    tch::set_num_threads(i32::from(args.threads));
    let agent = args.agent().map_err(BadInput::of)?;
    let filter = args.output_filter();
    let stop = args.bus.stop().context("installing signal handlers")?;
    let bus = args.bus.join(Role::Agent, &args.cav)?;
    tracing::info!(cav = %args.cav, weights = %args.weights.display(), "ready");
    let report = node::run_filtered(&bus, agent, filter, &args.options(), &stop)?;
    if let Err(overdue) = bus.leave(STOP_LIMIT) {
        tracing::warn!("{overdue}");
    }
    if args.json {
        output::line(serde_json::to_string(&report)?)?;
    } else {
        output::line(format_args!(
            "{} sweeps, {} without a pose, {} failed",
            report.sweeps, report.no_pose, report.failed
        ))?;
    }
    Ok(())
}

impl Args {
    fn agent(&self) -> anyhow::Result<Agent> {
        let detector = Detector::load(&self.weights).context("weights")?;
        Ok(Agent::new(self.cav.clone(), self.pose_source()?, detector))
    }

    fn output_filter(&self) -> Box<dyn OutputFilter> {
        let lie = match self.lie {
            None => return Box::new(Unfiltered),
            Some(LieAbout::ShiftedPose) => Lie::ShiftedPose,
            Some(LieAbout::Noise) => Lie::Noise,
            Some(LieAbout::Copied) => Lie::Copied,
            Some(LieAbout::Invented) => Lie::Invented,
        };
        Box::new(Attack::new(lie, &self.cav, 0))
    }

    fn pose_source(&self) -> anyhow::Result<Box<dyn PoseSource>> {
        let config = match self.pose_source {
            PoseFrom::Recorded => PoseSourceConfig::Recorded,
            PoseFrom::Noisy => PoseSourceConfig::Noisy(self.noise.config()),
            PoseFrom::Pgc => PoseSourceConfig::Pgc(self.localizer.pgc()?),
            PoseFrom::EndToEnd => PoseSourceConfig::EndToEnd(self.localizer.end_to_end()?),
        };
        Ok(config.build()?)
    }

    fn options(&self) -> NodeOptions {
        let stream = |published: &Published| match published {
            Published::Bev => Stream::Bev,
            Published::Boxes => Stream::Boxes,
            Published::Points => Stream::Points,
        };
        let dtype = match self.dtype {
            Exactness::F32 => Dtype::F32,
            Exactness::F16 => Dtype::F16,
            Exactness::I8 => Dtype::I8,
        };
        let gate = self.gate.map(|threshold| ConfidenceGate { threshold, smoothing: self.gate_smoothing.0 });
        NodeOptions {
            publish: self.publish.iter().map(stream).collect(),
            codec: CodecConfig { dtype, gate, budget_bytes: self.budget, zstd_level: self.zstd },
            rate: self.rate.config(),
            keeps_running: self.keep_running || self.bus.supervised,
            sweep_log: self.sweep_log.clone(),
            ..NodeOptions::default()
        }
    }
}

impl RateArgs {
    fn config(&self) -> RateConfig {
        let Self { message_bytes, bytes_per_second, watch_queue } = *self;
        RateConfig { message_bytes, bytes_per_second, watch_queue }
    }
}

impl LocalizerArgs {
    fn pgc(&self) -> anyhow::Result<PgcConfig> {
        let needed =
            |path: &Option<PathBuf>, name| path.clone().with_context(|| format!("--pose-source pgc needs {name}"));
        Ok(PgcConfig {
            encoder: needed(&self.encoder, "--encoder")?,
            head: needed(&self.head, "--head")?,
            sanity: SanityConfig::default(),
        })
    }

    fn end_to_end(&self) -> anyhow::Result<EndToEndPoseConfig> {
        let weights = self.end_to_end.clone().context("--pose-source end-to-end needs --end-to-end")?;
        Ok(EndToEndPoseConfig { weights, sanity: SanityConfig::default() })
    }
}

impl NoiseArgs {
    fn config(&self) -> NoisyPoseConfig {
        NoisyPoseConfig {
            mode: match self.noise_mode {
                Mode::Fixed => NoiseMode::Fixed,
                Mode::Independent => NoiseMode::Independent,
                Mode::Autoregressive => NoiseMode::Autoregressive,
                Mode::Replayed => NoiseMode::Replayed,
            },
            position_std_m: self.noise_position_std,
            heading_std_deg: self.noise_heading_std,
            seed: self.noise_seed,
            step_s: self.noise_step,
            decay_s: self.noise_decay,
            table: self.noise_table.clone(),
        }
    }
}
