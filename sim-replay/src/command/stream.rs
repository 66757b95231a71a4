//! `sim-replay stream`: a scene as live traffic.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use bus::{BusArgs, Route, STOP_LIMIT, log_to_stderr};
use dataset::{self, IntensityScale, LoadOptions, OpenOptions, Scenario};
use link::{CapacityConfig, DelayLaw, LinkConfig, LossLaw};
use protocol::{CavId, DropReason, Role};
use sim_replay::stream::{AirReport, Replay, StreamError, StreamOptions, StreamReport};
use support::output;

use support::cli::Outcome;

/// Publish a scene as if its vehicles were driving now.
///
/// The clock starts when all expected routes have carried a probe. While it runs, control messages (`pause`, `resume`,
/// `step`, `seek`, `start` with another rate) steer it.
///
/// Where the clock keeps its own pace, a newer sweep takes the place of one that still waits for the network: the last line
/// says how many. Exit code 3 is for frames that cannot be read and ticks that are not answered.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Dataset, split or scenario; the layout is found out.
    dir: PathBuf,
    #[command(flatten)]
    bus: BusArgs,
    /// Scenario to play [default: the first].
    #[arg(long)]
    scenario: Option<String>,
    /// Vehicles that take part [default: all].
    #[arg(long, value_delimiter = ',', allow_hyphen_values = true)]
    agents: Vec<CavId>,
    /// Seconds of the scene per second; 0: as fast as the bus takes it, dropping nothing.
    #[arg(long, default_value_t = 1.0)]
    rate: f64,
    /// Start again after the last tick.
    #[arg(long = "loop")]
    repeats: bool,
    /// First tick, counted from 0.
    #[arg(long, default_value_t = 0)]
    seek: usize,
    /// Ticks to play [default: to the end, or for ever with --loop].
    #[arg(long)]
    frames: Option<usize>,
    /// Variant of the sweeps, for example fog_0.060 [default: the plain ones].
    #[arg(long)]
    variant: Option<String>,
    /// Number that stored intensities are divided by [default: auto; `sim-replay inspect --help` says by what].
    #[arg(long, value_name = "auto|1|255|NUMBER", default_value_t, hide_default_value = true)]
    intensity_scale: IntensityScale,
    /// Publish radar sweeps too.
    #[arg(long)]
    radar: bool,
    /// A route that has to stand before the clock starts, TOPIC>PROCESS, for example 4288/bev>ego-4279; repeatable.
    /// The routes from here to every vehicle's agent are expected anyway.
    #[arg(long = "expect", value_name = "ROUTE", allow_hyphen_values = true)]
    expect: Vec<Route>,
    /// Do not wait for the vehicles' agents.
    #[arg(long)]
    no_wait: bool,
    /// Seconds to wait for all routes.
    #[arg(long, default_value_t = 60.0)]
    ready_timeout: f64,
    /// Publish a tick only when these egos have answered the one before: slow, but nothing is ever late.
    #[arg(long, value_delimiter = ',', value_name = "EGO", allow_hyphen_values = true)]
    lockstep: Vec<CavId>,
    /// Seconds to wait for an ego's answer under --lockstep.
    #[arg(long, default_value_t = 60.0)]
    answer_timeout: f64,
    /// Mean delay of sensor frames on their way to the agents, milliseconds.
    #[arg(long, value_name = "MS")]
    latency: Option<f64>,
    /// Standard deviation of that delay, milliseconds; the order of frames stays.
    #[arg(long, value_name = "MS", requires = "latency")]
    jitter: Option<f64>,
    /// Rate of each vehicle's link from its sensors, Mbit/s.
    #[arg(long, value_name = "MBPS")]
    bandwidth: Option<f64>,
    /// Share of the sensor frames that get lost.
    #[arg(long, value_name = "SHARE")]
    loss: Option<f64>,
    /// Same seed, same delays and losses.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Note here after each tick how far the replay is, and go on from there where the file is there already.
    #[arg(long, value_name = "FILE")]
    bookmark: Option<PathBuf>,
    /// Print a JSON summary.
    #[arg(long)]
    json: bool,
}

/// Plays the scene and prints a summary to standard output.
pub(crate) fn run(args: &Args) -> anyhow::Result<Outcome> {
    log_to_stderr();
    let scenario = match open(args) {
        Ok(scenario) => scenario,
        Err(error) => return Ok(bad_input(&error)),
    };
    let stop = args.bus.stop().context("installing signal handlers")?;
    let bus = args.bus.join(Role::Replay, &CavId::new("replay")?)?;
    let replay = match Replay::prepare(&bus, &scenario, args.options(), &stop) {
        Ok(replay) => replay,
        Err(
            error @ (StreamError::NoAgent { .. }
            | StreamError::NoTick { .. }
            | StreamError::Rate(_)
            | StreamError::Bookmark(_)
            | StreamError::Link(_)
            | StreamError::LinkInLockstep),
        ) => {
            return Ok(bad_input(&error.into()));
        }
        Err(error) => return Err(error.into()),
    };
    match replay.wait_until_ready() {
        Ok(()) => {}
        Err(StreamError::NotReady(_)) if stop.requested() => return Ok(Outcome::Done),
        Err(error) => return Err(error.into()),
    }
    tracing::info!(scenario = scenario.name, ticks = scenario.ticks.len(), rate = args.rate, "the clock runs");
    let report = replay.play();
    print(&report, args.json)?;
    if let Err(overdue) = bus.leave(STOP_LIMIT) {
        tracing::warn!("{overdue}");
    }
    Ok(if report.is_complete() { Outcome::Done } else { Outcome::DataLost })
}

impl Args {
    fn options(&self) -> StreamOptions {
        let seconds = |seconds| Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX);
        StreamOptions {
            agents: self.agents.clone(),
            rate: self.rate,
            repeats: self.repeats,
            seek: self.seek,
            frames: self.frames,
            load: LoadOptions { lidar_variant: self.variant.clone(), points: true, radar: self.radar },
            await_agents: !self.no_wait,
            expect: self.expect.clone(),
            patience: seconds(self.ready_timeout),
            lockstep: self.lockstep.clone(),
            answer_patience: seconds(self.answer_timeout),
            link: self.link().map(|link| (link, self.seed)),
            bookmark: self.bookmark.clone(),
        }
    }

    /// The link from sensors to agents; none where nothing is asked of it.
    fn link(&self) -> Option<LinkConfig> {
        let Self { latency, jitter, bandwidth, loss, .. } = self;
        if latency.is_none() && bandwidth.is_none() && loss.is_none() {
            return None;
        }
        Some(LinkConfig {
            delay: match (latency, jitter) {
                (None, _) => DelayLaw::None,
                (Some(mean_ms), None) => DelayLaw::ConstantMs(*mean_ms),
                (Some(mean_ms), Some(std_ms)) => DelayLaw::Normal { mean_ms: *mean_ms, std_ms: *std_ms },
            },
            capacity: bandwidth.map_or(CapacityConfig::Unlimited, |rate_mbps| CapacityConfig::TokenBucket {
                rate_mbps,
                burst_bytes: 0,
            }),
            loss: loss.map_or(LossLaw::None, LossLaw::Bernoulli),
            // A vehicle's own bus does not reorder.
            keep_order: true,
            ..LinkConfig::default()
        })
    }
}

fn open(args: &Args) -> anyhow::Result<Scenario> {
    let options = OpenOptions { intensity_scale: args.intensity_scale, ..OpenOptions::default() };
    let dataset = dataset::open_with(&args.dir, &options)?;
    for problem in &dataset.problems {
        tracing::warn!("{problem}");
    }
    let names = || dataset.scenarios.iter().map(|scenario| scenario.name.as_str()).collect::<Vec<_>>().join(", ");
    let found = match &args.scenario {
        None => dataset.scenarios.first().cloned(),
        Some(name) => dataset.scenarios.iter().find(|scenario| scenario.name == *name).cloned(),
    };
    found.with_context(|| {
        let asked = args.scenario.as_deref().unwrap_or("any");
        format!("{}: no scenario {asked}; there are: {}", args.dir.display(), names())
    })
}

fn bad_input(error: &anyhow::Error) -> Outcome {
    output::note(format_args!("error: {error:#}"));
    Outcome::BadInput
}

fn print(report: &StreamReport, as_json: bool) -> anyhow::Result<()> {
    if as_json {
        output::line(serde_json::to_string(report)?)?;
        return Ok(());
    }
    let messages: u64 = report.sent.iter().map(|count| count.messages).sum();
    output::line(format_args!("{} ticks, {messages} messages in {:.1} s", report.ticks, report.seconds))?;
    let lateness = &report.lateness;
    output::line(format_args!(
        "late by p50 {:.1} ms, p95 {:.1} ms, at most {:.1} ms; {} ticks over 5 ms",
        lateness.p50_ms, lateness.p95_ms, lateness.max_ms, lateness.late_ticks
    ))?;
    if let Some(AirReport { offered, arrived, dropped }) = &report.air {
        output::line(format_args!("{offered} sensor frames crossed a link: {arrived} arrived{}", by_reason(dropped)))?;
    }
    if report.absent_frames > 0 {
        output::line(format_args!(
            "{} frames do not exist: their vehicles came later or have left",
            report.absent_frames
        ))?;
    }
    if report.left_out_parts > 0 {
        output::line(format_args!(
            "{} objects or other parts of frames were left out, see the log",
            report.left_out_parts
        ))?;
    }
    if !report.unsent.is_empty() {
        let unsent: u64 = report.unsent.values().sum();
        output::line(format_args!("{unsent} of the messages were not sent{}", by_reason(&report.unsent)))?;
    }
    // What the run lost stands last.
    if report.unreadable_frames > 0 {
        output::line(format_args!("{} frames could not be read", report.unreadable_frames))?;
    }
    if report.unanswered > 0 {
        output::line(format_args!("{} ticks were not answered", report.unanswered))?;
    }
    Ok(())
}

fn by_reason(dropped: &BTreeMap<DropReason, u64>) -> String {
    dropped.iter().map(|(reason, count)| format!(", {count} {reason}")).collect()
}
