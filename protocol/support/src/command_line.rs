//! Command line: parsing with the options of all programs.

use std::{env, io, process};

use clap::{ArgAction, ArgMatches, Args, Command, FromArgMatches, Parser};

use crate::list_values::with_lists_joined;
use crate::output::{self, Verbosity};
use crate::sibling_program::Sibling;

/// Variable that asks for a completion script (`bash`, `zsh`, `fish`, ...) on standard output, or for manual pages in a
/// folder (`man:FOLDER`), instead of running.
pub const GENERATE: &str = "V2VLOC_GENERATE";

/// Place of the last option in the help, before `--help`.
const LAST: usize = 998;

/// Parses the command line of a program with the subcommands that `sibling`, a program beside it, carries out: where one
/// of these is given, the process becomes that program, which also writes the completions and manual pages of both.
pub fn parse_beside<P: Parser>(sibling: &Sibling) -> P {
    if env::var_os(GENERATE).is_some() {
        end_if_failed(Some(sibling.exec_generator()));
    }
    // Before clap parses: it would print the help of a subcommand whose options it does not know.
    end_if_failed(sibling.exec_help(env::args_os()));
    let matches = matches(sibling.extend(P::command()));
    end_if_failed(sibling.exec_subcommand(&matches));
    P::from_arg_matches(&matches).unwrap_or_else(|error| error.exit())
}

/// Parses the command line of this process by `command`; sets the verbosity of its messages. Ends the process on wrong
/// usage.
pub fn parse_arguments<P: Parser>(command: Command) -> P {
    P::from_arg_matches(&matches(command)).unwrap_or_else(|error| error.exit())
}

/// Arguments of this process; sets the verbosity of its messages.
fn matches(command: Command) -> ArgMatches {
    let command = with_negative_numbers(with_verbosity(command));
    let words = with_lists_joined(&command, env::args_os());
    let matches = command.get_matches_from(words);
    let options = VerbosityOptions::from_arg_matches(&matches);
    output::set_verbosity(options.map_or(Verbosity::Usual, |options| options.verbosity()));
    matches
}

fn end_if_failed(error: Option<io::Error>) {
    if let Some(error) = error {
        output::error(error);
        process::exit(1)
    }
}

/// The command with negative numbers as values of its options: those that are out of bounds are named, not taken for
/// options.
fn with_negative_numbers(command: Command) -> Command {
    command
        .mut_args(|arg| {
            let takes_values = arg.get_long().is_some() && arg.get_action().takes_values();
            match takes_values && !arg.is_allow_hyphen_values_set() {
                true => arg.allow_negative_numbers(true),
                false => arg,
            }
        })
        .mut_subcommands(with_negative_numbers)
}

/// The command with the options of the verbosity on standard error.
pub fn with_verbosity(command: Command) -> Command {
    VerbosityOptions::augment_args(command)
}

#[derive(clap::Args)]
#[group(skip)]
struct VerbosityOptions {
    /// Log more, -vv even more; RUST_LOG sets single parts
    #[arg(short, long, action = ArgAction::Count, global = true, conflicts_with = "quiet", display_order = LAST - 1)]
    verbose: u8,
    /// Errors only on standard error: no progress, notes and warnings
    #[arg(short, long, global = true, display_order = LAST)]
    quiet: bool,
}

impl VerbosityOptions {
    fn verbosity(&self) -> Verbosity {
        match (self.quiet, self.verbose) {
            (true, _) => Verbosity::Quiet,
            (false, 0) => Verbosity::Usual,
            (false, 1) => Verbosity::Debug,
            (false, _) => Verbosity::Trace,
        }
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[derive(Debug, Parser)]
    #[command(name = "program")]
    struct Cli {
        #[command(subcommand)]
        command: Sub,
    }

    #[derive(Debug, clap::Subcommand)]
    enum Sub {
        /// Does it.
        Act {
            #[arg(long)]
            fast: bool,
        },
    }

    fn parsed(line: &str) -> Result<ArgMatches, clap::Error> {
        with_verbosity(Cli::command()).try_get_matches_from(line.split(' '))
    }

    #[test]
    fn verbosity_is_known_to_every_subcommand() {
        for (line, expected) in [
            ("program act --fast", Verbosity::Usual),
            ("program -v act", Verbosity::Debug),
            ("program act -vv", Verbosity::Trace),
            ("program act --quiet", Verbosity::Quiet),
        ] {
            let matches = parsed(line).unwrap();
            let options = VerbosityOptions::from_arg_matches(&matches).unwrap();
            assert_eq!(options.verbosity(), expected, "{line}");
            let Sub::Act { fast } = Cli::from_arg_matches(&matches).unwrap().command;
            assert_eq!(fast, line.contains("--fast"));
        }
        assert!(parsed("program act -v -q").is_err());
    }
}
