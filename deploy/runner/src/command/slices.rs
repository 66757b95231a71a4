//! Options of commands whose cells several machines can compute.

use std::path::Path;

use runner::experiment::slices::{Engine, Slice};
use support::cli::BadInput;

#[derive(Debug, clap::Args)]
pub(crate) struct SliceArgs {
    /// Compute only slice M of N, and write no table: the same command without it does when all slices have ended
    /// [default: in a task of a Slurm array the slice of the task, else everything].
    #[arg(long, value_name = "M/N", conflicts_with = "print")]
    slice: Option<Slice>,
    /// Print the file with which an engine runs all slices and then this command; nothing is computed.
    #[arg(long, value_enum, value_name = "ENGINE")]
    #[arg(group = "printed", requires = "slices")]
    print: Option<Engine>,
    /// Number of slices (--print).
    #[arg(long, value_name = "N", requires = "printed", value_parser = clap::value_parser!(u16).range(1..=10_000))]
    slices: Option<u16>,
}

impl SliceArgs {
    /// The slice that this process computes.
    pub(crate) fn slice(&self) -> Result<Option<Slice>, BadInput> {
        match self.slice {
            Some(slice) => Ok(Some(slice)),
            None => Slice::of_slurm(|name| std::env::var(name).ok()).map_err(BadInput::new),
        }
    }

    /// The file of the engine that is asked for, for `command`, which writes `result` at its end.
    pub(crate) fn engine_file(&self, command: &[&str], result: &Path) -> Option<String> {
        let slices = usize::from(self.slices.unwrap_or(1));
        Some(self.print?.file(command, slices, result))
    }
}
