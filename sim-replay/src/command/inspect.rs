//! `sim-replay inspect`: what is in a dataset, and what is wrong with it.

use std::path::PathBuf;

use indicatif::{ProgressBar, ProgressStyle};
use sim_replay::inspect::{Report, inspect};
use sim_replay::output;

use crate::cli::Outcome;

/// Say what a dataset holds (agents, frames, points, rates, boxes, merged ground truth) and what is wrong with it.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Dataset, split, scenario or sequence; the layout is found out.
    dir: PathBuf,
    /// Print JSON instead of a table.
    #[arg(long)]
    json: bool,
}

/// Prints the findings to standard output.
pub(crate) fn run(args: &Args) -> anyhow::Result<Outcome> {
    let report = with_progress(args);
    if args.json {
        output::line(serde_json::to_string_pretty(&report)?)?;
    } else {
        output::line(&report)?;
    }
    Ok(if report.problems.is_empty() { Outcome::Done } else { Outcome::BadInput })
}

/// Reads everything; a bar on a terminal says how far.
fn with_progress(args: &Args) -> Report {
    // Hidden by itself where stderr is no terminal.
    let bar = ProgressBar::new(0);
    if let Ok(style) = ProgressStyle::with_template("{bar:40} {pos}/{len} frames, {eta} left") {
        bar.set_style(style);
    }
    let report = inspect(&args.dir, &|done, total| {
        bar.set_length(total as u64);
        bar.set_position(done as u64);
    });
    bar.finish_and_clear();
    report
}
