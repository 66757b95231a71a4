//! `sim-replay record`: a live run into a file.

use std::path::PathBuf;

use anyhow::Context;
use bus::{BusArgs, STOP_LIMIT, log_to_stderr};
use protocol::{CavId, Role, Stream};
use recording::RecordingOptions;
use sim_replay::recorder::{self, RecordReport, RecorderError, RecorderOptions};
use support::output;

use support::cli::Outcome;

/// Write everything that is said in a run into an MCAP file, which `sim-replay stream` plays and Foxglove opens.
///
/// Ends when the replay does, or on Ctrl-C. A file that was cut short plays up to its last whole chunk.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    bus: BusArgs,
    /// The new file.
    #[arg(long, value_name = "FILE.mcap")]
    out: PathBuf,
    /// Streams to leave out, for example bev, which is most of the bytes.
    #[arg(long, value_delimiter = ',', value_name = "STREAM")]
    without: Vec<Stream>,
    /// Leave out the channels for ROS 2 tools: half as large, and still exactly what was said.
    #[arg(long)]
    plain: bool,
    /// zstd level, 1 to 22 [default: not packed; clouds and maps hardly shrink].
    #[arg(long, value_name = "LEVEL", value_parser = clap::value_parser!(u32).range(1..=22))]
    zstd: Option<u32>,
    /// Go on when the replay ends, for the next one; always so with --supervised.
    #[arg(long)]
    keep_running: bool,
    /// Print a JSON summary.
    #[arg(long)]
    json: bool,
}

/// Records and prints a summary to standard output.
pub(crate) fn run(args: &Args) -> anyhow::Result<Outcome> {
    log_to_stderr();
    let stop = args.bus.stop().context("installing signal handlers")?;
    let bus = args.bus.join(Role::Recorder, &CavId::new("recorder")?)?;
    let options = RecorderOptions {
        out: args.out.clone(),
        recording: RecordingOptions { zstd_level: args.zstd, with_ros: !args.plain },
        without: args.without.clone(),
        keeps_running: args.keep_running || args.bus.supervised,
    };
    // Who waits for the report is told at once of a failure; the last line counts.
    let mut on_failure = |report: &RecordReport| {
        if args.json && serde_json::to_string(report).map_err(Into::into).and_then(output::line).is_err() {
            tracing::error!("the failure cannot be printed");
        }
    };
    let report = match recorder::record(&bus, &options, &stop, &mut on_failure) {
        Ok(report) => report,
        Err(RecorderError::Recording(error)) => {
            output::note(format_args!("error: {error}"));
            return Ok(Outcome::BadInput);
        }
        Err(error) => return Err(error.into()),
    };
    print(&report, args.json)?;
    if let Err(overdue) = bus.leave(STOP_LIMIT) {
        tracing::warn!("{overdue}");
    }
    Ok(if report.is_complete() { Outcome::Done } else { Outcome::DataLost })
}

fn print(report: &RecordReport, as_json: bool) -> anyhow::Result<()> {
    if as_json {
        output::line(serde_json::to_string(report)?)?;
        return Ok(());
    }
    output::line(format_args!(
        "{} messages, {:.1} MB in {}",
        report.messages,
        report.bytes as f64 / 1e6,
        report.file.display()
    ))?;
    report.loss_in_words().map_or(Ok(()), |words| Ok(output::line(words)?))
}
