//! One file per subcommand: its arguments, and the call into the library.

mod align;
mod eval;
mod methods;
mod run;
mod train;

use std::process::ExitCode;

/// What `ego-fuser` can be asked to do.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Compare ways to align two vehicles without GNSS.
    Align(Box<align::Arguments>),
    /// List the collaboration methods and what each sends.
    Methods(methods::Arguments),
    /// Measure AP on recorded scenes.
    Eval(eval::Arguments),
    /// Run the fusing vehicle of a live fleet.
    Run(run::Arguments),
    /// Train a method on scenes.
    Train(Box<train::Arguments>),
}

impl Command {
    /// Does what was asked.
    pub(crate) fn run(self) -> anyhow::Result<()> {
        match self {
            Self::Align(arguments) => arguments.run(),
            Self::Methods(arguments) => arguments.run(),
            Self::Eval(arguments) => arguments.run(),
            Self::Run(arguments) => arguments.run(),
            Self::Train(arguments) => arguments.run(),
        }
    }
}

/// Usage or input at fault, and not the program: exit code 2.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(crate) struct BadInput(pub(crate) String);

/// Exit code of a failed command: 2 for bad usage or input, 1 otherwise.
pub(crate) fn exit_code(error: &anyhow::Error) -> ExitCode {
    if error.chain().any(|cause| cause.is::<BadInput>()) { ExitCode::from(2) } else { ExitCode::FAILURE }
}
