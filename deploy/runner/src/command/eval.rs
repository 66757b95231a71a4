//! `v2vloc eval`.

use std::path::{Path, PathBuf};

use agent::attack::{AttackConfig, Falsification};
use agent::config::{AgentSettings, ModelConfig, SentBoxes, Threads};
use agent::rate::RateConfig;
use anyhow::Context;
use clap::ArgGroup;
use dataset::IntensityOption;
use dataset::evaluation_protocol::ProtocolConfig;
use ego_fuser::config::EgoSettings;
use ego_fuser_offline::evaluation::stepped::ComputeTimes;
use ego_fuser_offline::evaluation::{EmulatedLink, Setup};
use fusion::Method;
use link::{CapacityConfig, LatencyModel};
use localization::pose_source::PoseSourceConfig;
use perception::int8::InferencePrecision;
use protocol::config::Section;
use protocol::{CodecConfig, Dtype};
use runner::experiment::evaluation::{OpenedData, Trial, evaluate};
use runner::experiment::report;
use runner::experiment::spec::Experiment;
use runner::experiment::table;
use support::file_error::FileError;
use support::output;
use support::sampling::repeated;
use terminal::progress;
use training::feature_store::KeptMaps;

use super::left_out;
use super::slices::SliceArgs;
use support::cli::{BadInput, Outcome};

/// Options and groups of options, beside those of pose sources, that a file of tables states itself.
const OF_ONE_TABLE: [&str; 21] = [
    "dataset",
    "method",
    "weights",
    "precision",
    "pose_source",
    "CodecConfig",
    "RateConfig",
    "emulation",
    "delay_ms",
    "max_age_ms",
    "attack",
    "trust",
    "boxes",
    "neighbour_weights",
    "box_alignment",
    "feature_maps",
    "frames",
    "scenarios",
    "intensity_scale",
    "ProtocolConfig",
    "json",
];

#[derive(Debug, clap::Args)]
#[command(group = ArgGroup::new("emulation").args(["link", "bandwidth_mbps", "latency_ms"]).multiple(true))]
#[command(group = ArgGroup::new("sliced").args(["slice", "print"]).requires("tables"))]
pub(crate) struct Arguments {
    /// Data set, split or scenario; its layout is detected. The first vehicle of each scenario is the ego.
    #[arg(long, value_name = "DIR", required_unless_present = "table")]
    dataset: Option<PathBuf>,
    /// Fusion methods, as `ego-fuser methods` lists them; several give one table.
    #[arg(long, value_name = "NAME", num_args = 1.., value_delimiter = ',', required_unless_present = "table")]
    method: Vec<Method>,
    /// Weights of the detector; or a folder with *-METHOD.safetensors or METHOD/weights.safetensors for each method; or
    /// the folder of a training.
    #[arg(long, value_name = "FILE", required_unless_present = "table")]
    weights: Option<PathBuf>,
    /// Number format in which networks are computed.
    #[arg(long, value_enum, default_value_t)]
    precision: InferencePrecision,
    /// Instead: a file of tables, rows of methods and columns of conditions; cells that are done are kept in --out.
    // Required as a group of one option, as is --attack: clap forgets the requirement of an option that another excludes.
    #[arg(long, value_name = "FILE", group = "tables", requires = "out")]
    #[arg(conflicts_with_all = OF_ONE_TABLE.iter().chain(PoseSourceConfig::OPTION_GROUPS).copied())]
    table: Option<PathBuf>,
    #[command(flatten)]
    slices: SliceArgs,
    /// Folder for metrics.json, detections.jsonl, tracks.jsonl, truth.jsonl, frames.csv and precision_recall.csv of each method; with
    /// --table, of the tables [default: nothing is written].
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten, next_help_heading = "Pose")]
    pose: Section<PoseSourceConfig>,
    #[command(flatten)]
    codec: Section<CodecConfig>,
    #[command(flatten)]
    rate: Section<RateConfig>,
    /// Neighbours send their detections in place of feature maps, or beside them.
    #[arg(long, value_enum)]
    boxes: Option<SentBoxes>,
    /// Weights of neighbours with a network of their own. Absent: that of the ego.
    #[arg(long, value_name = "FILE")]
    neighbour_weights: Option<PathBuf>,
    /// Delay of the messages of neighbours, milliseconds.
    #[arg(long, value_name = "MS", default_value_t = 0)]
    delay_ms: u64,
    /// Link emulation between neighbours and ego, in simulation time: a preset of `sim-replay link`, or a file.
    #[arg(long, value_name = "PRESET|FILE", conflicts_with = "delay_ms")]
    link: Option<String>,
    /// Rate of the link, Mbit/s, inf for unlimited; replaces that of --link.
    #[arg(long, value_name = "MBPS", conflicts_with = "delay_ms")]
    bandwidth_mbps: Option<f64>,
    /// Latency of the link after the last bit, milliseconds; replaces that of --link.
    #[arg(long, value_name = "MS", conflicts_with = "delay_ms")]
    latency_ms: Option<f64>,
    /// Same seed, same losses and latencies (--link).
    #[arg(long, default_value_t = 0, requires = "emulation")]
    seed: u64,
    /// Longest time that a frame waits for its neighbours, milliseconds (--link) [default: that of ego-fuser run].
    #[arg(long, value_name = "MS", requires = "emulation")]
    deadline_ms: Option<u64>,
    /// Largest age of a feature map that is still fused, by capture time and beyond --delay-ms, milliseconds [default: that
    /// of ego-fuser run].
    #[arg(long, value_name = "MS")]
    max_age_ms: Option<u64>,
    /// Compute time of pose, map and fusion, milliseconds, for example 20,60,30; without it no latency is reported
    /// (--link).
    #[arg(long, value_name = "MS,MS,MS", value_delimiter = ',', num_args = 1)]
    #[arg(default_value = "0,0,0", requires = "emulation")]
    compute_ms: Vec<f64>,
    /// Attack by neighbours: falsified messages, to measure their effect on the ego.
    #[arg(long, value_enum, value_name = "ATTACK", group = "attacked")]
    attack: Option<Falsification>,
    /// Number of attackers, the first neighbours of every scenario (--attack).
    #[arg(long, default_value_t = 1, requires = "attacked")]
    attackers: usize,
    /// Seed of the falsified messages (--attack).
    #[arg(long, default_value_t = 0, requires = "attacked")]
    attack_seed: u64,
    /// Misbehaviour detection: excludes neighbours whose messages contradict the ego's own detections.
    #[arg(long)]
    trust: bool,
    /// Box alignment: the ego carries neighbours' boxes to the time of its frame and corrects their poses.
    #[arg(long)]
    box_alignment: bool,
    /// Keep the feature maps of the encoder in this folder, so that each is computed once for many evaluations.
    #[arg(long, value_name = "DIR")]
    feature_maps: Option<PathBuf>,
    /// Largest number of frames of each scenario [default: all].
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    frames: Option<u64>,
    /// Largest number of scenarios to evaluate, evenly spread [default: all].
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    scenarios: Option<u64>,
    #[command(flatten)]
    intensity: IntensityOption,
    /// Number of compute threads, 1 to 256 [default: 1].
    #[arg(long, conflicts_with = "print")]
    threads: Option<Threads>,
    #[command(flatten)]
    protocol: ProtocolConfig,
    /// Print AP by distance and by class of the objects too; JSON has both in any case.
    #[arg(long, conflicts_with_all = ["json", "table"])]
    breakdown: bool,
    /// Print JSON in the shape of metrics.json (a list of them for several methods) instead of a table.
    #[arg(long)]
    json: bool,
}

impl Arguments {
    /// Evaluates every method and prints the metrics.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        let threads = self.threads.unwrap_or_default();
        threads.validate().map_err(BadInput::of)?;
        threads.apply();
        if let (Some(spec), Some(out)) = (&self.table, &self.out) {
            return tables(spec, out, &self.slices);
        }
        let trial = self.trial()?;
        let data = OpenedData::open(&trial).map_err(BadInput::of)?;
        trial.check_participants(&data).map_err(BadInput::of)?;
        let lacking = data.lacking(trial.scenarios, trial.setup.frames);
        lacking.into_iter().for_each(output::note);
        // Before the first is evaluated: weights that are wrong must not cost the results of others.
        for &method in &self.method {
            trial.evaluator(&data, method).map_err(BadInput::of)?;
        }
        let frames = self.method.len() * data.frame_count(trial.scenarios);
        let bar = progress::bar(frames, "frames");
        let mut all = Vec::new();
        for &method in &self.method {
            bar.set_message(method.name());
            all.push(evaluate(&trial, &data, method, &mut || bar.inc(1)).map_err(BadInput::of)?);
        }
        bar.finish_and_clear();
        match (self.json, &all[..]) {
            (true, [one]) => output::line(serde_json::to_string_pretty(one)?)?,
            (true, several) => output::line(serde_json::to_string_pretty(several)?)?,
            (false, several) => {
                output::text(report::table(several))?;
                if self.breakdown {
                    output::line("")?;
                    output::text(report::breakdown(several))?;
                }
            }
        }
        if let Some((metrics, dataset)) = all.first().zip(self.dataset.as_deref()) {
            report::print_unlocated(metrics, &self.pose.0, dataset);
        }
        Ok(left_out(all.iter().map(|metrics| &metrics.left_out)))
    }

    fn trial(&self) -> Result<Trial, BadInput> {
        self.pose.0.validate().map_err(BadInput::of)?;
        self.codec.0.validate().map_err(BadInput::of)?;
        if self.rate.0.watch_queue {
            let reason = "--watch-queue: no map waits in the queue of an agent in an evaluation";
            return Err(BadInput::new(reason));
        }
        if let Some(twice) = repeated(&self.method) {
            return Err(BadInput::new(format!("--method names {twice} twice")));
        }
        let intensity_scale = self.intensity.scale;
        let trial = Trial {
            // Required unless --table is given, which does not come here.
            dataset: self.dataset.clone().unwrap_or_default(),
            scenarios: self.scenarios.map(|count| count as usize),
            intensity_scale,
            protocol: self.protocol.clone(),
            setup: Setup {
                models: ModelConfig {
                    weights: self.weights.clone().unwrap_or_default(),
                    precision: self.precision,
                    ..ModelConfig::default()
                },
                agents: AgentSettings {
                    pose: self.pose.0.clone().with_networks().map_err(BadInput::of)?,
                    codec: self.codec.0,
                    rate: self.rate.0,
                    boxes: self.boxes,
                    weights: self.neighbour_weights.clone(),
                    falsification: None,
                },
                attack: self.attack.map(|falsification| AttackConfig {
                    falsification,
                    attackers: self.attackers,
                    seed: self.attack_seed,
                }),
                ego: self.ego()?,
                link: self.emulates_link().then(|| self.link()).transpose()?,
                delay_ms: self.delay_ms,
                compute: self.compute()?,
                frames: self.frames.map(|count| count as usize),
                ..Setup::default()
            },
            maps: self.feature_maps.as_ref().map(|folder| KeptMaps {
                folder: folder.clone(),
                // Whatever is sent: the cache changes no result.
                dtype: Dtype::F32,
                // The folder was asked for by name, so its size has no limit.
                limit_bytes: u64::MAX,
                intensity_scale,
            }),
            out: self.out.clone(),
        };
        trial.check(&self.method).map_err(BadInput::of)?;
        Ok(trial)
    }

    fn emulates_link(&self) -> bool {
        self.link.is_some() || self.bandwidth_mbps.is_some() || self.latency_ms.is_some()
    }

    fn link(&self) -> Result<EmulatedLink, BadInput> {
        let model = self.link.as_deref().unwrap_or("ideal");
        let mut link = EmulatedLink::open(model, self.seed).map_err(BadInput::of)?;
        if let Some(bandwidth_mbps) = self.bandwidth_mbps {
            link.config.capacity = CapacityConfig::of_mbps(bandwidth_mbps);
        }
        if let Some(latency_ms) = self.latency_ms {
            link.config.latency = LatencyModel::ConstantMs(latency_ms);
        }
        if self.bandwidth_mbps.is_some() && link.config.latency.has_rate() {
            let rule = "--bandwidth-mbps: the latency of link MODEL has a rate of its own; add --latency-ms";
            return Err(BadInput::new(rule.replace("MODEL", model)));
        }
        link.config.validate().map_err(BadInput::of)?;
        Ok(link)
    }

    fn compute(&self) -> Result<ComputeTimes, BadInput> {
        let &[pose_ms, map_ms, fuse_ms] = &self.compute_ms[..] else {
            let found = self.compute_ms.len();
            return Err(BadInput::new(format!(
                "--compute-ms takes 3 numbers, not {found}"
            )));
        };
        let compute = ComputeTimes {
            pose_ms,
            map_ms,
            fuse_ms,
        };
        compute.validate("--compute-ms").map_err(BadInput::of)?;
        Ok(compute)
    }

    fn ego(&self) -> Result<EgoSettings, BadInput> {
        let defaults = EgoSettings::default();
        let ego = EgoSettings {
            deadline_ms: self.deadline_ms.unwrap_or(defaults.deadline_ms),
            max_age_ms: self.max_age_ms.unwrap_or(defaults.max_age_ms),
            trust: self.trust,
            box_alignment: self.box_alignment,
            ..defaults
        };
        ego.validate().map_err(BadInput::of)?;
        Ok(ego)
    }
}

/// Fills tables and prints them.
fn tables(file: &Path, out: &Path, slices: &SliceArgs) -> anyhow::Result<Outcome> {
    let experiment = Experiment::read(file).map_err(BadInput::of)?;
    let Some(last) = experiment.tables.last() else {
        let problem = "this is an experiment: v2vloc sweep FILE";
        return Err(BadInput::of(FileError::new(file, problem)).into());
    };
    let (name, folder) = (file.to_string_lossy(), out.to_string_lossy());
    let command = ["v2vloc", "eval", "--table", &*name, "--out", &*folder];
    let last = &last.name;
    if let Some(text) = slices.engine_file(&command, &out.join(format!("{last}.csv"))) {
        output::text(&text)?;
        return Ok(Outcome::Done);
    }
    let slice = slices.slice()?;
    let bar = progress::spinner("frames");
    // Shows which cell is computed; without a terminal, where the spinner shows nothing, on a line of its own.
    let mut on_cell = |cell: &str, known: bool| {
        let known = if known { ", known" } else { "" };
        let text = format!("{cell}{known}");
        if bar.is_hidden() {
            output::note(&text);
        }
        bar.set_message(text);
    };
    let filled = table::run(&experiment, out, slice, &mut on_cell, &mut || bar.tick())
        .with_context(|| file.display().to_string())
        .map_err(BadInput::of)?;
    bar.finish_and_clear();
    if let Some(slice) = slice {
        output::note(format_args!(
            "slice {slice} is computed; without --slice, this command writes the tables"
        ));
    }
    for table in &filled {
        output::line(table::markdown(table))?;
    }
    let rows = filled.iter().flat_map(|table| &table.rows);
    let cells = rows.flat_map(|(_, cells)| cells.iter().flatten());
    Ok(left_out(cells.map(|cell| &cell.metrics.left_out)))
}
