//! `sim-replay convert`: write a data set in another layout.

use std::io::IsTerminal;
use std::path::PathBuf;

use indicatif::ProgressBar;
use sim_replay::dataset;
use sim_replay::output;
use sim_replay::synth::{ConvertOptions, Converted, SceneLayout, SynthError, convert};

use crate::cli::Outcome;

/// Problems that are printed; all are counted, and stand in the JSON summary.
const SHOWN_PROBLEMS: usize = 10;

/// Write a data set in another layout: sweeps, poses and boxes stay what they are, as far as the layout holds them.
///
/// The layout of the input is found out, as by `inspect`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The data set, split, scenario or sequence, or a recording.
    from: PathBuf,
    /// Folder for the scenarios; made if missing.
    #[arg(long)]
    out: PathBuf,
    /// Layout of the files.
    #[arg(long, value_enum)]
    layout: SceneLayout,
    /// Write into a folder that is not empty; what the layout writes there is replaced.
    #[arg(long)]
    force: bool,
    /// Print a JSON summary.
    #[arg(long)]
    json: bool,
}

/// Converts and prints a summary to standard output.
pub(crate) fn run(args: &Args) -> anyhow::Result<Outcome> {
    let input = match dataset::open(&args.from) {
        Ok(input) => input,
        Err(error) => {
            output::note(format_args!("error: {error}"));
            return Ok(Outcome::BadInput);
        }
    };
    let bar = if std::io::stderr().is_terminal() { ProgressBar::new(0) } else { ProgressBar::hidden() };
    let options = ConvertOptions { out: args.out.clone(), layout: args.layout, force: args.force };
    let result = convert(&input, &options, &|done, total| {
        bar.set_length(total as u64);
        bar.set_position(done as u64);
    });
    bar.finish_and_clear();
    match result {
        Ok(converted) => {
            print(&converted, args)?;
            Ok(if converted.left_out.is_nothing() { Outcome::Done } else { Outcome::DataLost })
        }
        Err(error @ SynthError::Write { .. }) => Err(error.into()),
        Err(error) => {
            output::note(format_args!("error: {error}"));
            Ok(Outcome::BadInput)
        }
    }
}

fn print(converted: &Converted, args: &Args) -> std::io::Result<()> {
    let Converted { scenarios, agent_frames, omitted, left_out } = converted;
    for problem in left_out.problems().take(SHOWN_PROBLEMS) {
        output::note(format_args!("left out: {}", problem.message));
    }
    if args.json {
        let report = serde_json::json!({
            "out": args.out, "layout": args.layout.name(), "scenarios": scenarios, "agent_frames": agent_frames,
            "omitted": omitted, "left_out": left_out,
        });
        return output::line(report);
    }
    output::line(format_args!(
        "{}: {scenarios} scenarios, {agent_frames} agent-frames, layout {}",
        args.out.display(),
        args.layout.name()
    ))?;
    super::synth::print_omitted(omitted)?;
    let summary = left_out.to_string();
    if summary.is_empty() { Ok(()) } else { output::line(summary) }
}
