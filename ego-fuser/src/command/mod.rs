//! Subcommands: one file each, with its arguments and the call into the library.

mod methods;
mod run;

use std::io;

use anyhow::Context;
use bus::malloc_settings;
use support::cli::Outcome;
use support::sibling_program::Forwarded;

/// Program of the offline subcommands.
const OFFLINE: &str = "ego-fuser-offline";

/// Subcommands of `ego-fuser`.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Compare alignment methods of two vehicles without GNSS
    Align(Forwarded),
    /// List the collaboration methods and what each sends
    Methods(methods::Arguments),
    /// Measure AP on recorded scenes
    Eval(Forwarded),
    /// Measure the part of pose offsets that a method's own alignment leaves
    AlignmentError(Forwarded),
    /// Prepare weights for 8-bit inference
    Quantise(Forwarded),
    /// Run the fusing vehicle of a live fleet
    Run(Box<run::Arguments>),
    /// Train a method on scenes
    Train(Forwarded),
}

impl Command {
    /// Carries out the subcommand.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        let offline = |forwarded: Forwarded, name| -> io::Result<()> { Err(forwarded.exec(OFFLINE, name)) };
        match self {
            Self::Methods(arguments) => arguments.run()?,
            Self::Run(arguments) => {
                malloc_settings::ensure(&malloc_settings::KEPT_MEMORY).context("restarting with malloc settings")?;
                arguments.run()?;
            }
            Self::Align(forwarded) => offline(forwarded, "align")?,
            Self::Eval(forwarded) => offline(forwarded, "eval")?,
            Self::AlignmentError(forwarded) => offline(forwarded, "alignment-error")?,
            Self::Quantise(forwarded) => offline(forwarded, "quantise")?,
            Self::Train(forwarded) => offline(forwarded, "train")?,
        }
        Ok(Outcome::Done)
    }
}
