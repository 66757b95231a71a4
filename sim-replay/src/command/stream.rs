//! `sim-replay stream`: publishes a scene as live traffic.

use std::collections::BTreeMap;

use anyhow::Context;
use bus::log_to_stderr;
use dataset::{self, OpenOptions, Scenario};
use protocol::{CavId, DropReason, Role};
use sim_replay::config::{ReplayConfig, SceneConfig};
use sim_replay::stream::{Place, Replay, StreamError, StreamReport};
use support::output;

use super::{ProcessArgs, join, print_json};
use support::cli::Outcome;

/// Plays the scene and prints a summary to standard output.
pub(crate) fn run(args: ProcessArgs<ReplayConfig>) -> anyhow::Result<Outcome> {
    log_to_stderr();
    let config = args.config.validated()?;
    let scenario = match open(&config.scene) {
        Ok(scenario) => scenario,
        Err(error) => return Ok(Outcome::bad_input(&format_args!("{error:#}"))),
    };
    let name = CavId::new("replay")?;
    let (stop, bus) = join(&config.bus, &config.run, Role::Replay, &name)?;
    let replay = match Replay::prepare(&bus, &scenario, config.options(), &stop) {
        Ok(replay) => replay,
        // Failures of the run. All other errors are faults of the input, exit code 2.
        Err(error @ StreamError::Bus(_)) => return Err(error.into()),
        Err(error) => return Ok(Outcome::bad_input(&error)),
    };
    match replay.wait_until_ready() {
        Ok(()) => {}
        Err(StreamError::NotReady(_)) if stop.requested() => return Ok(Outcome::Done),
        Err(error) => return Err(error.into()),
    }
    tracing::info!(
        scenario = scenario.name,
        ticks = scenario.ticks.len(),
        rate = config.scene.rate,
        "the clock runs"
    );
    let report = replay.play();
    print(&report, args.json)?;
    bus.leave_at_end();
    // Not before: a replay that crashes while it leaves is restarted, and announces its end.
    let checkpoint = config.checkpoint.filter(|_| !stop.requested());
    if let Some(Err(error)) = checkpoint.map(|path| Place::end(&path)) {
        tracing::warn!("{error}; remove the checkpoint before the next replay");
    }
    Ok(Outcome::of(!report.is_complete()))
}

fn open(scene: &SceneConfig) -> anyhow::Result<Scenario> {
    let options = OpenOptions::with_intensity_scale(scene.intensity_scale);
    let dataset = dataset::open_with(&scene.dir, &options)?;
    for problem in &dataset.problems {
        tracing::warn!("{problem}");
    }
    let asked = scene.scenario.as_deref();
    let mut scenarios = dataset.scenarios.iter();
    let found = scenarios.find(|scenario| asked.is_none_or(|name| scenario.name == name));
    found.cloned().with_context(|| {
        let names = dataset.scenarios.iter().map(|scenario| &*scenario.name);
        let (dir, asked) = (scene.dir.display(), asked.unwrap_or("any"));
        let names = names.collect::<Vec<_>>().join(", ");
        format!("{dir}: no scenario {asked}; there are: {names}")
    })
}

fn print(report: &StreamReport, as_json: bool) -> anyhow::Result<()> {
    if as_json {
        return print_json(report);
    }
    let messages: u64 = report.sent.iter().map(|count| count.messages).sum();
    output::line(format_args!(
        "{} ticks, {messages} messages in {:.1} s",
        report.ticks, report.seconds
    ))?;
    let lateness = &report.lateness;
    output::line(format_args!(
        "late by p50 {:.1} ms, p95 {:.1} ms, at most {:.1} ms; {} ticks over 5 ms",
        lateness.p50_ms, lateness.p95_ms, lateness.max_ms, lateness.late_ticks
    ))?;
    if let Some(link) = &report.sensor_link {
        let (submitted, arrived, dropped) =
            (link.submitted, link.arrived, by_reason(&link.dropped));
        output::line(format_args!(
            "{submitted} sensor frames crossed a link: {arrived} arrived{dropped}"
        ))?;
    }
    let absent = "frames do not exist: their vehicles joined later or have left";
    counted(report.absent_frames, absent)?;
    let left_out = "objects or other parts of frames were left out, see the log";
    counted(report.left_out_parts, left_out)?;
    if !report.unsent.is_empty() {
        let unsent: u64 = report.unsent.values().sum();
        output::line(format_args!(
            "{unsent} of the messages were not sent{}",
            by_reason(&report.unsent)
        ))?;
    }
    // The losses of the run are printed last.
    counted(report.unreadable_frames, "frames could not be read")?;
    counted(report.unanswered, "ticks were not answered")
}

/// A line for what there is.
fn counted(count: u64, what: &str) -> anyhow::Result<()> {
    match count {
        0 => Ok(()),
        count => Ok(output::line(format_args!("{count} {what}"))?),
    }
}

fn by_reason(dropped: &BTreeMap<DropReason, u64>) -> String {
    dropped
        .iter()
        .map(|(reason, count)| format!(", {count} {reason}"))
        .collect()
}
