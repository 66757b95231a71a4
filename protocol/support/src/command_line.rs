//! Command line: parsing with the options of all programs, shell completions and manual pages.

use std::env;
use std::path::Path;
use std::{io, process};

use clap::{Arg, ArgAction, ArgMatches, Command, CommandFactory, Parser};
use clap_complete::Shell;

use crate::list_values::with_lists_joined;
use crate::output::{self, Verbosity};
use crate::sibling_program::Sibling;

/// Variable that asks for a completion script (`bash`, `zsh`, `fish`, ...) on standard output, or for manual pages in a
/// folder (`man:FOLDER`), instead of running.
const GENERATE: &str = "V2VLOC_GENERATE";

/// Place of the last option in the help, before `--help`.
const LAST: usize = 998;

/// Parses the command line of this process; sets the verbosity of its messages. Ends the process on wrong usage, as
/// [`Parser::parse`].
pub fn parse<P: Parser>() -> P {
    end_if_generated(P::command);
    parse_arguments(P::command())
}

/// Parses the command line of a program with the subcommands that `sibling`, a program beside it, carries out: where one
/// of these is given, the process becomes that program.
pub fn parse_beside<P: Parser>(sibling: &Sibling) -> P {
    if env::var_os(GENERATE).is_some() {
        let error = sibling.exec_generator();
        output::note(format_args!(
            "without the options of {}: {error}",
            sibling.program
        ));
    }
    end_if_generated(|| sibling.extend(P::command()));
    end_if_failed(sibling.exec_help(env::args_os()));
    let matches = matches(sibling.extend(P::command()));
    end_if_failed(sibling.exec_subcommand(&matches));
    P::from_arg_matches(&matches).unwrap_or_else(|error| error.exit())
}

/// Parses the command line of a sibling of the program `Front`; completions and manual pages are those of `Front` with
/// the subcommands of both.
pub fn parse_behind<P: Parser, Front: CommandFactory>() -> P {
    end_if_generated(|| {
        let own = P::command();
        let shown = own
            .get_subcommands()
            .filter(|command| !command.is_hide_set());
        Front::command().subcommands(shown.cloned())
    });
    parse_arguments(P::command())
}

fn parse_arguments<P: Parser>(command: Command) -> P {
    P::from_arg_matches(&matches(command)).unwrap_or_else(|error| error.exit())
}

/// Arguments of this process; sets the verbosity of its messages.
fn matches(command: Command) -> ArgMatches {
    let command = with_negative_numbers(with_verbosity(command));
    let words = with_lists_joined(&command, env::args_os());
    let matches = command.get_matches_from(words);
    output::set_verbosity(verbosity(
        matches.get_count("verbose"),
        matches.get_flag("quiet"),
    ));
    matches
}

fn end_if_generated(command: impl FnOnce() -> Command) {
    let Some(wanted) = env::var_os(GENERATE) else {
        return;
    };
    let wanted = wanted.to_string_lossy();
    let generated = generate(with_verbosity(command()), &wanted);
    if let Err(error) = &generated {
        output::error(format_args!("{GENERATE}={wanted}: {error}"));
    }
    process::exit(if generated.is_ok() { 0 } else { 2 });
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

/// The options of the verbosity on standard error.
fn with_verbosity(command: Command) -> Command {
    let verbose = Arg::new("verbose")
        .short('v')
        .long("verbose")
        .action(ArgAction::Count)
        .global(true);
    let quiet = Arg::new("quiet")
        .short('q')
        .long("quiet")
        .action(ArgAction::SetTrue)
        .global(true);
    command
        .arg(
            verbose
                .help("Log more, -vv even more; RUST_LOG sets single parts")
                .conflicts_with("quiet")
                .display_order(LAST - 1),
        )
        .arg(
            quiet
                .help("Errors only on standard error: no progress, notes and warnings")
                .display_order(LAST),
        )
}

fn verbosity(verbose: u8, quiet: bool) -> Verbosity {
    match (quiet, verbose) {
        (true, _) => Verbosity::Quiet,
        (false, 0) => Verbosity::Usual,
        (false, 1) => Verbosity::Debug,
        (false, _) => Verbosity::Trace,
    }
}

fn generate(mut command: Command, wanted: &str) -> io::Result<()> {
    if let Some(folder) = wanted.strip_prefix("man:") {
        return clap_mangen::generate_to(command, Path::new(folder));
    }
    let shell: Shell = wanted
        .parse()
        .map_err(|error: String| io::Error::new(io::ErrorKind::InvalidInput, error))?;
    let name = command.get_name().to_owned();
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut command, name, &mut script);
    output::text(String::from_utf8_lossy(&script))
}

#[cfg(test)]
mod tests {
    use clap::FromArgMatches;

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

    #[test]
    fn verbosity_is_known_to_every_subcommand() {
        let of = |line: &str| with_verbosity(Cli::command()).try_get_matches_from(line.split(' '));
        for (line, expected) in [
            ("program act --fast", Verbosity::Usual),
            ("program -v act", Verbosity::Debug),
            ("program act -vv", Verbosity::Trace),
            ("program act --quiet", Verbosity::Quiet),
        ] {
            let matches = of(line).unwrap();
            assert_eq!(
                verbosity(matches.get_count("verbose"), matches.get_flag("quiet")),
                expected,
                "{line}"
            );
            let Sub::Act { fast } = Cli::from_arg_matches(&matches).unwrap().command;
            assert_eq!(fast, line.contains("--fast"));
        }
        assert!(of("program act -v -q").is_err());
    }

    #[test]
    fn manual_pages_are_written_and_an_unknown_shell_is_named() {
        let folder = tempfile::tempdir().unwrap();
        generate(Cli::command(), &format!("man:{}", folder.path().display())).unwrap();
        let mut pages: Vec<_> = folder
            .path()
            .read_dir()
            .unwrap()
            .map(|page| page.unwrap().file_name())
            .collect();
        pages.sort();
        assert!(
            pages.contains(&"program.1".into()) && pages.contains(&"program-act.1".into()),
            "{pages:?}"
        );
        assert!(generate(Cli::command(), "tcsh").is_err());
    }
}
