//! Subcommands: one file each, with its arguments and the call into the library.

mod methods;
mod replay_inputs;
mod run;

use anyhow::Context;
use bus::malloc_settings;
use support::cli::Outcome;
use support::sibling_program::Sibling;

/// Subcommands that read data sets.
pub(crate) const OFFLINE: Sibling = Sibling {
    program: "ego-fuser-offline",
    subcommands: &[
        (
            "align",
            "Compare alignment methods of two vehicles without GNSS",
        ),
        (
            "alignment-error",
            "Measure the part of pose offsets that a method's own alignment leaves",
        ),
        ("eval", "Measure AP on recorded scenes"),
        ("quantise", "Prepare weights for 8-bit inference"),
        ("train", "Train a method on scenes"),
    ],
};

/// Subcommands of `ego-fuser`.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Run the fusing vehicle of a live fleet
    Run(Box<run::Arguments>),
    /// List the collaboration methods and what each sends
    Methods(methods::Arguments),
    /// Decide again from the recorded inputs of a run
    ReplayInputs(replay_inputs::Arguments),
}

impl Command {
    /// Carries out the subcommand.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        match self {
            Self::Run(arguments) => {
                malloc_settings::ensure(&malloc_settings::KEPT_MEMORY)
                    .context("restarting with malloc settings")?;
                arguments.run()
            }
            Self::Methods(arguments) => arguments.run().map(|()| Outcome::Done),
            Self::ReplayInputs(arguments) => arguments.run(),
        }
    }
}
