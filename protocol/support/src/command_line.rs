//! Command line: parsing with the options of all programs, shell completions and manual pages.

use std::env;
use std::io;
use std::path::Path;
use std::process;

use clap::{Arg, ArgAction, Command, Parser};
use clap_complete::Shell;

use crate::command_tree::CommandTree;
use crate::list_values::with_lists_joined;
use crate::output::{self, Verbosity};
use crate::sibling_program::Sibling;

/// Variable that asks for a completion script (`bash`, `zsh`, `fish`, ...) on standard output, or for manual pages in a
/// folder (`man:FOLDER`), instead of running.
pub(crate) const GENERATE: &str = "V2VLOC_GENERATE";
/// Value of the variable that asks for the subcommands and their options as JSON: what a program asks its sibling for.
pub(crate) const DESCRIPTION: &str = "description";

/// Place of the last option in the help, before `--help`.
const LAST: usize = 998;

/// Parses the command line of this process; sets the verbosity of its messages. Ends the process on wrong usage, as
/// [`Parser::parse`].
#[must_use]
pub fn parse<P: Parser>() -> P {
    parse_with(None)
}

/// The same with the subcommands that a program beside this one carries out: where one of these is given, the process
/// becomes that program.
#[must_use]
pub fn parse_beside<P: Parser>(sibling: &Sibling) -> P {
    parse_with(Some(sibling))
}

fn parse_with<P: Parser>(sibling: Option<&Sibling>) -> P {
    if let Some(wanted) = env::var_os(GENERATE) {
        let wanted = wanted.to_string_lossy();
        let generated = generate(P::command(), sibling, &wanted);
        if let Err(error) = &generated {
            output::error(format_args!("{GENERATE}={wanted}: {error}"));
        }
        process::exit(if generated.is_ok() { 0 } else { 2 });
    }
    let end = |error: io::Error| -> ! {
        output::error(error);
        process::exit(1)
    };
    sibling
        .and_then(|sibling| sibling.exec_help(env::args_os()))
        .map(end);
    let own = P::command();
    let command = sibling.map_or_else(|| own.clone(), |sibling| sibling.extend(own.clone()));
    let command = with_negative_numbers(with_verbosity(command));
    let matches = command
        .clone()
        .get_matches_from(with_lists_joined(&command, env::args_os()));
    output::set_verbosity(verbosity(
        matches.get_count("verbose"),
        matches.get_flag("quiet"),
    ));
    sibling
        .and_then(|sibling| sibling.exec_subcommand(&matches))
        .map(end);
    P::from_arg_matches(&matches).unwrap_or_else(|error| error.exit())
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

fn generate(command: Command, sibling: Option<&Sibling>, wanted: &str) -> io::Result<()> {
    if wanted == DESCRIPTION {
        return output::line(serde_json::to_string(&CommandTree::of(&command))?);
    }
    let mut command = with_verbosity(
        sibling.map_or_else(|| command.clone(), |sibling| complete(&command, sibling)),
    );
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

/// The command with the subcommands of a sibling; without their options where the sibling is not installed.
fn complete(command: &Command, sibling: &Sibling) -> Command {
    sibling
        .extend_described(command.clone())
        .unwrap_or_else(|error| {
            output::note(format_args!(
                "without the options of {}: {error}",
                sibling.program
            ));
            sibling.extend(command.clone())
        })
}

#[cfg(test)]
mod tests {
    use clap::{CommandFactory, FromArgMatches};

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
        generate(
            Cli::command(),
            None,
            &format!("man:{}", folder.path().display()),
        )
        .unwrap();
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
        assert!(generate(Cli::command(), None, "tcsh").is_err());
    }
}
