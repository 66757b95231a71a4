//! `sim-replay convert`: write a data set in another layout.

use std::io::IsTerminal;
use std::path::PathBuf;

use indicatif::ProgressBar;
use sim_replay::dataset;
use sim_replay::synth::{ConvertOptions, Converted, SceneLayout, SynthError, convert};

use crate::cli::Outcome;

/// Problems that are printed; the others are counted.
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
            eprintln!("error: {error}");
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
        Ok(mut converted) => {
            converted.problems.extend(input.problems);
            print(&converted, args);
            Ok(if converted.problems.is_empty() { Outcome::Done } else { Outcome::DataLost })
        }
        Err(error @ SynthError::Write { .. }) => Err(error.into()),
        Err(error) => {
            eprintln!("error: {error}");
            Ok(Outcome::BadInput)
        }
    }
}

fn print(converted: &Converted, args: &Args) {
    let Converted { scenarios, agent_frames, left_out, problems } = converted;
    for problem in problems.iter().take(SHOWN_PROBLEMS) {
        eprintln!("left out: {problem}");
    }
    if let Some(more) = problems.len().checked_sub(SHOWN_PROBLEMS).filter(|more| *more > 0) {
        eprintln!("left out: {more} more");
    }
    if args.json {
        let problems: Vec<String> = problems.iter().map(ToString::to_string).collect();
        let report = serde_json::json!({
            "out": args.out, "layout": args.layout.name(), "scenarios": scenarios, "agent_frames": agent_frames,
            "left_out": left_out, "problems": problems,
        });
        println!("{report}");
        return;
    }
    println!(
        "{}: {scenarios} scenarios, {agent_frames} agent-frames, layout {}",
        args.out.display(),
        args.layout.name()
    );
    super::synth::print_left_out(left_out);
}
