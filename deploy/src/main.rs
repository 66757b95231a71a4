//! Command line of `v2vloc`.

#![warn(clippy::print_stdout, clippy::print_stderr)]

mod command;

use std::process::ExitCode;

use clap::Parser;
use support::output;

/// Collaborative perception without GNSS as a distributed system: run it, judge it, look at it.
#[derive(Debug, Parser)]
#[command(
    name = "v2vloc",
    version,
    arg_required_else_help = true,
    after_help = "Exit codes: 0 done, 1 failed, 2 bad usage or input, 3 finished but data was lost beyond what the \
                  link dropped."
)]
struct CommandLine {
    #[command(subcommand)]
    command: command::Command,
}

fn main() -> ExitCode {
    bus::log_to_stderr();
    match CommandLine::parse().command.run() {
        Ok(outcome) => outcome.into(),
        Err(error) => {
            output::note(format_args!("v2vloc: {}", in_words(&error)));
            command::exit_code(&error)
        }
    }
}

/// The chain of causes on one line, without those that the message above them quotes already.
fn in_words(error: &anyhow::Error) -> String {
    error.chain().fold(String::new(), |words, cause| {
        let cause = cause.to_string();
        match words.as_str() {
            "" => cause,
            said if said.contains(&cause) => words,
            said => format!("{said}: {cause}"),
        }
    })
}
