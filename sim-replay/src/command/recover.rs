//! `sim-replay recover`: makes an indexed recording from a damaged one.

use std::path::PathBuf;

use bus::log_to_stderr;
use recording::recover;
use sim_replay::config::RecordingConfig;
use support::output;

use super::print_json;
use support::cli::{BadInput, Outcome};

/// Copy the readable part of a truncated (power, disk, kill) or damaged recording into a new, indexed file.
///
/// `stream` replays such a recording as it is; other programs need the index.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The truncated or damaged recording.
    from: PathBuf,
    /// The new file.
    #[arg(long, value_name = "FILE.mcap")]
    out: PathBuf,
    /// Leave out the channels for ROS 2 tools.
    #[arg(long)]
    plain: bool,
    /// Print a JSON summary.
    #[arg(long)]
    json: bool,
}

/// Copies and reports the losses.
pub(crate) fn run(args: &Args) -> anyhow::Result<Outcome> {
    log_to_stderr();
    let config = RecordingConfig {
        plain: args.plain,
        ..RecordingConfig::default()
    };
    let report = recover(&args.from, &args.out, config.options()).map_err(BadInput::of)?;
    if args.json {
        print_json(&report)?;
    } else {
        let (messages, out) = (report.messages, args.out.display());
        output::line(format_args!("{messages} messages in {out}"))?;
        report.damage.iter().try_for_each(output::line)?;
    }
    Ok(Outcome::of(!report.damage.is_empty()))
}
