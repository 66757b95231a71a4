//! `v2vloc eval`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use agent::attack::{AttackConfig, Lie};
use agent::rate::RateConfig;
use clap::ValueEnum;
use dataset::IntensityScale;
use dataset::evaluation_protocol::ProtocolConfig;
use deploy::experiment::evaluation::{EvaluationOptions, Part, evaluate, frame_count};
use deploy::experiment::report;
use deploy::experiment::table::{self, TableObserver, TableSpec};
use ego_fuser::misbehaviour::TrustConfig;
use ego_fuser::pairing::PairingConfig;
use ego_fuser_offline::evaluation::stepped::{ComputeTimes, Crew, SteppedConfig};
use fusion::Method;
use indicatif::ProgressBar;
use link::LinkConfig;
use localization::pose_source::motion_gate::SanityConfig;
use localization::pose_source::{
    CachedPoseConfig, EndToEndPoseConfig, NoiseMode, NoisyPoseConfig, PgcConfig, PoseSourceConfig,
};
use protocol::{CodecConfig, ConfidenceGate, Dtype};
use support::output;
use support::progress;
use training::feature_store::KeptMaps;

use super::left_out;
use support::cli::BadInput;
use support::cli::Outcome;

#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Data set, split or scenario; the layout is found out. The first vehicle of each scenario is the ego.
    #[arg(long, value_name = "DIR", required_unless_present = "table")]
    dataset: Option<PathBuf>,
    /// Fusion methods, as `ego-fuser methods` lists them; several give one table.
    #[arg(long, value_name = "NAME", value_delimiter = ',', required_unless_present = "table")]
    method: Vec<Method>,
    /// Weights of the detector; or a folder with *-METHOD.safetensors or METHOD/weights.safetensors for each method; or the
    /// folder of a training.
    #[arg(long, value_name = "FILE", required_unless_present = "table")]
    weights: Option<PathBuf>,
    /// Instead: a file of tables, rows of methods and columns of conditions; cells that are done are kept in --out.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["dataset", "method", "weights"], requires = "out")]
    table: Option<PathBuf>,
    /// Where tables are written (--table).
    #[arg(long, value_name = "DIR", requires = "table")]
    out: Option<PathBuf>,
    /// Where the vehicles' poses come from.
    #[arg(long, value_enum, default_value_t = PoseFrom::Recorded)]
    pose_source: PoseFrom,
    /// Standard deviation of x, y and z, metres (--pose-source noisy).
    #[arg(long, default_value_t = NoisyPoseConfig::default().position_std_m)]
    noise_position_std: f64,
    /// Standard deviation of yaw, degrees (--pose-source noisy).
    #[arg(long, default_value_t = NoisyPoseConfig::default().heading_std_deg)]
    noise_heading_std: f64,
    /// How the errors of successive frames hang together (--pose-source noisy).
    #[arg(long, value_enum, default_value_t = Mode::Fixed)]
    noise_mode: Mode,
    /// Same seed, same errors (--pose-source noisy).
    #[arg(long, default_value_t = NoisyPoseConfig::default().seed)]
    noise_seed: u64,
    /// Weights of the localizer's encoder (--pose-source pgc).
    #[arg(long, value_name = "FILE", required_if_eq("pose_source", "pgc"))]
    encoder: Option<PathBuf>,
    /// Weights of the town's head (--pose-source pgc).
    #[arg(long, value_name = "FILE", required_if_eq("pose_source", "pgc"))]
    head: Option<PathBuf>,
    /// Weights of a network that was trained end to end (--pose-source end-to-end).
    #[arg(long, value_name = "FILE", required_if_eq("pose_source", "end-to-end"))]
    end_to_end: Option<PathBuf>,
    /// A table of poses that `agent localize` wrote (--pose-source cached).
    #[arg(long, value_name = "FILE", required_if_eq("pose_source", "cached"))]
    poses: Option<PathBuf>,
    /// How long messages of neighbours are under way, milliseconds.
    #[arg(long, value_name = "MS", default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=10_000))]
    delay: u64,
    /// The emulated air between neighbours and ego, in virtual time: a preset of `sim-replay link`, or a file.
    #[arg(long, value_name = "PRESET|FILE", conflicts_with = "delay")]
    link: Option<String>,
    /// Same seed, same losses and delays (--link).
    #[arg(long, default_value_t = 0, requires = "link")]
    seed: u64,
    /// The ego fuses what has arrived so long after its sweep, but not before its own map is there, milliseconds (--link).
    #[arg(long, value_name = "MS", default_value_t = 0, requires = "link")]
    deadline: u64,
    /// Oldest map that is still fused, by capture time, milliseconds (--link).
    #[arg(long, value_name = "MS", default_value_t = 300, requires = "link")]
    max_age: u64,
    /// Compute time of pose, map and fusion, milliseconds, for example 20,60,30; without it no latency is told (--link).
    #[arg(long, value_name = "MS,MS,MS", value_delimiter = ',', num_args = 1, default_values_t = [0.0; 3], requires = "link")]
    compute: Vec<f64>,
    /// Lets neighbours lie: to see what that does to the ego.
    #[arg(long, value_enum, value_name = "LIE")]
    attack: Option<Attack>,
    /// How many of them lie, the first of every scenario (--attack).
    #[arg(long, default_value_t = 1, requires = "attack")]
    liars: usize,
    /// Same seed, same lies (--attack).
    #[arg(long, default_value_t = 0, requires = "attack")]
    attack_seed: u64,
    /// Leaves out neighbours whose words do not fit what the ego sees itself.
    #[arg(long)]
    trust: bool,
    /// How exactly feature values cross the air.
    #[arg(long, value_enum, default_value_t = Exactness::F32)]
    dtype: Exactness,
    /// Confidence that a cell must exceed to be sent, smoothed as Where2comm does [default: what the method says].
    #[arg(long, value_name = "CONFIDENCE", allow_negative_numbers = true)]
    gate: Option<f32>,
    /// Most bytes of a feature map, before packing [default: all cells].
    #[arg(long, value_name = "BYTES")]
    budget: Option<u64>,
    /// zstd level, 1 to 22 [default: maps are not packed].
    #[arg(long, value_name = "LEVEL", value_parser = clap::value_parser!(i32).range(1..=22))]
    zstd: Option<i32>,
    /// Most bytes of a neighbour's message with a map: coarser numbers, then the most confident cells [default: any size].
    #[arg(long, value_name = "BYTES")]
    message_bytes: Option<u64>,
    /// Most bytes per second of a neighbour's messages with maps, in the same way [default: any].
    #[arg(long, value_name = "BYTES")]
    bytes_per_second: Option<u64>,
    /// Keep the maps of the encoder in this folder, so that each is computed once for many evaluations.
    #[arg(long, value_name = "DIR")]
    maps: Option<PathBuf>,
    /// Frames to judge at most, over all scenarios [default: all].
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    frames: Option<u64>,
    /// Scenarios to judge at most, evenly spread [default: all].
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    scenarios: Option<u64>,
    /// Number that stored intensities are divided by [default: auto; `sim-replay inspect --help` says by what].
    #[arg(long, value_name = "auto|1|255|NUMBER", default_value_t, hide_default_value = true)]
    intensity_scale: IntensityScale,
    /// Threads to compute with.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: u16,
    #[command(flatten)]
    protocol: ProtocolConfig,
    /// Print JSON in the shape of metrics.json (a list of them for several methods) instead of a table.
    #[arg(long)]
    json: bool,
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
    EndToEnd,
    /// Found before, from a table.
    Cached,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Attack {
    /// A pose 5 to 30 m off, and sure of it.
    ShiftedPose,
    /// Noise instead of what is seen.
    Noise,
    /// What another vehicle said.
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

fn at_most(count: u64) -> usize {
    usize::try_from(count).unwrap_or(usize::MAX)
}

impl Arguments {
    /// Evaluates every method and prints the numbers.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        tch::set_num_threads(i32::from(self.threads));
        if let (Some(spec), Some(out)) = (&self.table, &self.out) {
            return tables(spec, out);
        }
        let options = self.options()?;
        let bar = progress::bar(self.method.len() * frame_count(&options)?, "frames");
        let mut all = Vec::new();
        for &method in &self.method {
            bar.set_message(method.name());
            all.push(evaluate(&options, method, &mut || bar.inc(1))?);
        }
        bar.finish_and_clear();
        match (self.json, &all[..]) {
            (true, [one]) => output::line(serde_json::to_string_pretty(one)?)?,
            (true, several) => output::line(serde_json::to_string_pretty(several)?)?,
            (false, several) => {
                output::text(report::table(several))?;
                if let Some(protocol) = several.iter().find_map(|metrics| metrics.protocol.as_ref()) {
                    output::line(protocol)?;
                }
            }
        }
        Ok(left_out(all.iter().map(|metrics| &metrics.left_out)))
    }

    fn options(&self) -> Result<EvaluationOptions, BadInput> {
        let codec = CodecConfig {
            dtype: match self.dtype {
                Exactness::F32 => Dtype::F32,
                Exactness::F16 => Dtype::F16,
                Exactness::I8 => Dtype::I8,
            },
            gate: self.gate.map(|threshold| ConfidenceGate { threshold, ..ConfidenceGate::default() }),
            budget_bytes: self.budget,
            zstd_level: self.zstd,
        };
        Ok(EvaluationOptions {
            // Required where there is no table.
            dataset: self.dataset.clone().unwrap_or_default(),
            weights: self.weights.clone().unwrap_or_default(),
            pose_source: self.pose_source()?,
            codec,
            rate: RateConfig {
                message_bytes: self.message_bytes,
                bytes_per_second: self.bytes_per_second,
                watch_queue: false,
            },
            delay_nanos: self.delay * 1_000_000,
            attack: self.attack.map(|attack| AttackConfig {
                lie: match attack {
                    Attack::ShiftedPose => Lie::ShiftedPose,
                    Attack::Noise => Lie::Noise,
                    Attack::Copied => Lie::Copied,
                    Attack::Invented => Lie::Invented,
                },
                liars: self.liars,
                seed: self.attack_seed,
            }),
            trust: self.trust.then(TrustConfig::default),
            maps: self.maps.as_ref().map(|folder| KeptMaps {
                folder: folder.clone(),
                dtype: codec.dtype,
                limit_bytes: u64::MAX,
                intensity_scale: self.intensity_scale,
            }),
            frames: self.frames.map(at_most),
            stepped: self.link.as_deref().map(|link| self.stepped(link)).transpose()?,
            part: Part { scenarios: self.scenarios.map(at_most), ticks: None, intensity_scale: self.intensity_scale },
            protocol: self.protocol.clone(),
        })
    }

    fn stepped(&self, link: &str) -> Result<SteppedConfig, BadInput> {
        let (link, link_folder) = LinkConfig::open(link).map_err(BadInput::of)?;
        let &[pose_ms, map_ms, fuse_ms] = &self.compute[..] else {
            return Err(BadInput::new(format!("--compute takes 3 numbers, not {}", self.compute.len())));
        };
        if let Some(ms) = self.compute.iter().find(|ms| !(0.0..=60_000.0).contains(*ms)) {
            return Err(BadInput::new(format!("--compute: {ms} is not 0 to 60000 ms")));
        }
        let nanos = |ms: u64| ms.saturating_mul(1_000_000);
        Ok(SteppedConfig {
            link,
            link_folder,
            seed: self.seed,
            deadline_nanos: nanos(self.deadline),
            pairing: PairingConfig { max_age_nanos: nanos(self.max_age), ..PairingConfig::default() },
            compute: ComputeTimes { pose_ms, map_ms, fuse_ms },
            crew: Crew::First(usize::MAX),
            vehicles: BTreeMap::new(),
            ticks: 0..usize::MAX,
            lidar_variant: None,
        })
    }

    fn pose_source(&self) -> Result<PoseSourceConfig, BadInput> {
        match self.pose_source {
            PoseFrom::Recorded => Ok(PoseSourceConfig::Recorded),
            PoseFrom::Noisy => Ok(PoseSourceConfig::Noisy(NoisyPoseConfig {
                mode: match self.noise_mode {
                    Mode::Fixed => NoiseMode::Fixed,
                    Mode::Independent => NoiseMode::Independent,
                    Mode::Autoregressive => NoiseMode::Autoregressive,
                },
                position_std_m: self.noise_position_std,
                heading_std_deg: self.noise_heading_std,
                seed: self.noise_seed,
                ..NoisyPoseConfig::default()
            })),
            PoseFrom::Pgc => match (&self.encoder, &self.head) {
                (Some(encoder), Some(head)) => Ok(PoseSourceConfig::Pgc(PgcConfig {
                    encoder: encoder.clone(),
                    head: head.clone(),
                    sanity: SanityConfig::default(),
                })),
                _ => Err(BadInput::new("--pose-source pgc needs --encoder and --head")),
            },
            PoseFrom::EndToEnd => match &self.end_to_end {
                Some(weights) => Ok(PoseSourceConfig::EndToEnd(EndToEndPoseConfig {
                    weights: weights.clone(),
                    sanity: SanityConfig::default(),
                })),
                None => Err(BadInput::new("--pose-source end-to-end needs --end-to-end")),
            },
            PoseFrom::Cached => match &self.poses {
                Some(file) => Ok(PoseSourceConfig::Cached(CachedPoseConfig { file: file.clone(), scenario: None })),
                None => Err(BadInput::new("--pose-source cached needs --poses")),
            },
        }
    }
}

/// Fills tables and prints them.
fn tables(spec: &Path, out: &Path) -> anyhow::Result<Outcome> {
    let mut progress = TableProgress(progress::spinner("frames"));
    let filled = table::run(&TableSpec::read(spec)?, out, &mut progress)?;
    progress.0.finish_and_clear();
    filled.iter().try_for_each(|table| output::line(table::markdown(table)))?;
    let cells = filled.iter().flat_map(|table| &table.rows).flat_map(|row| row.cells.iter().flatten());
    Ok(left_out(cells.map(|cell| &cell.metrics.left_out)))
}

/// Shows on standard error which cell is computed.
struct TableProgress(ProgressBar);

impl TableObserver for TableProgress {
    fn cell(&mut self, table: &str, row: &str, column: &str, known: bool) {
        let text = format!("{table}: {row}, {column}{}", if known { ", known" } else { "" });
        if self.0.is_hidden() {
            output::note(&text);
        }
        self.0.set_message(text);
    }

    fn frame(&mut self) {
        self.0.tick();
    }
}
