//! Subcommands: one file each, with its arguments and the call into the library.

mod methods;
mod run;

use std::io;
use std::process::ExitCode;

use anyhow::Context;
use bus::BusError;
use bus::malloc_settings;
use support::sibling_program::Forwarded;

/// Program of the offline subcommands.
const OFFLINE: &str = "ego-fuser-offline";

/// Subcommands of `ego-fuser`.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Compare ways to align two vehicles without GNSS
    Align(Forwarded),
    /// List the collaboration methods and what each sends
    Methods(methods::Arguments),
    /// Measure AP on recorded scenes
    Eval(Forwarded),
    /// Measure what a method's own alignment leaves of offsets that are put on true poses
    Residual(Forwarded),
    /// Run the fusing vehicle of a live fleet
    Run(Box<run::Arguments>),
    /// Train a method on scenes
    Train(Forwarded),
}

impl Command {
    /// Carries out the subcommand.
    pub(crate) fn run(self) -> anyhow::Result<()> {
        let offline = |forwarded: Forwarded, name| -> io::Result<()> { Err(forwarded.exec(OFFLINE, name)) };
        match self {
            Self::Methods(arguments) => arguments.run(),
            Self::Run(arguments) => {
                malloc_settings::ensure(&malloc_settings::KEPT_MEMORY).context("this program again")?;
                arguments.run()
            }
            Self::Align(forwarded) => Ok(offline(forwarded, "align")?),
            Self::Eval(forwarded) => Ok(offline(forwarded, "eval")?),
            Self::Residual(forwarded) => Ok(offline(forwarded, "residual")?),
            Self::Train(forwarded) => Ok(offline(forwarded, "train")?),
        }
    }
}

/// Usage or input at fault, and not the program: exit code 2.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(crate) struct BadInput(pub(crate) String);

/// Exit code of a command that failed: 2 for bad usage or input, 1 otherwise.
pub(crate) fn exit_code(error: &anyhow::Error) -> ExitCode {
    let is_bad_input = error.chain().any(|cause| cause.is::<BadInput>()) || BusError::is_behind(error.as_ref());
    if is_bad_input { ExitCode::from(2) } else { ExitCode::FAILURE }
}
