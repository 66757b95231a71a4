//! Sibling program: subcommands that another program of the same folder carries out.
//!
//! A program links what its own subcommands need. Others, which need more, are in a program of their own and are called
//! by the same name, as Git and Cargo do it.

use std::env;
use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::{io, process};

use clap::{Arg, ArgAction, ArgMatches, Command};

use crate::output::{Verbosity, verbosity};

/// Argument of the subcommands: everything behind their name, `--help` included.
const REST: &str = "forwarded";

/// A program beside this one, and the subcommands that it carries out.
#[derive(Debug, Clone, Copy)]
pub struct Sibling {
    /// File name of the program.
    pub program: &'static str,
    /// Name and purpose of each subcommand.
    pub subcommands: &'static [(&'static str, &'static str)],
}

impl Sibling {
    /// Adds the subcommands to `command`. Their options are known to the program only.
    pub(crate) fn extend(&self, command: Command) -> Command {
        let rest = Arg::new(REST)
            .action(ArgAction::Append)
            .value_parser(clap::value_parser!(OsString))
            .num_args(0..)
            .trailing_var_arg(true)
            .allow_hyphen_values(true)
            .hide(true);
        command.subcommands(self.subcommands.iter().map(|(name, about)| {
            Command::new(*name)
                .about(*about)
                .disable_help_flag(true)
                .arg(rest.clone())
        }))
    }

    /// Replaces this process by the program if the arguments ask for the help of one of the subcommands. Returns only
    /// otherwise or on failure.
    pub(crate) fn exec_help(
        &self,
        mut arguments: impl Iterator<Item = OsString>,
    ) -> Option<io::Error> {
        let help = arguments.nth(1)?;
        let rest: Vec<OsString> = arguments.collect();
        let name = rest.first()?.to_str()?;
        if help != "help" || !self.has(name) {
            return None;
        }
        Some(self.exec(name, [&help].into_iter().chain(&rest)))
    }

    /// Replaces this process by the program, which writes completions and manual pages of both. Returns only on failure.
    pub(crate) fn exec_generator(&self) -> io::Error {
        self.exec("the generator of completions", std::iter::empty())
    }

    /// Replaces this process by the program if the command line names one of the subcommands. Returns only otherwise
    /// or on failure.
    pub(crate) fn exec_subcommand(&self, matches: &ArgMatches) -> Option<io::Error> {
        let (name, matches) = matches.subcommand().filter(|(name, _)| self.has(name))?;
        let rest = matches.get_many::<OsString>(REST).into_iter().flatten();
        Some(self.exec(name, [&OsString::from(name)].into_iter().chain(rest)))
    }

    fn has(&self, name: &str) -> bool {
        self.subcommands.iter().any(|(known, _)| *known == name)
    }

    fn exec<'a>(&self, name: &str, arguments: impl Iterator<Item = &'a OsString>) -> io::Error {
        // Options before the subcommand were parsed here: the sibling gets them again.
        let verbosity: &[&str] = match verbosity() {
            Verbosity::Quiet => &["--quiet"],
            Verbosity::Usual => &[],
            Verbosity::Debug => &["-v"],
            Verbosity::Trace => &["-vv"],
        };
        let path = self.path();
        let mut command = process::Command::new(&path);
        let error = command.args(verbosity).args(arguments).exec();
        let message = format!("{name} is part of the program {}: {error}", path.display());
        io::Error::new(error.kind(), message)
    }

    /// The program of the same folder, or else the one in `PATH`.
    fn path(&self) -> PathBuf {
        let beside = env::current_exe().map(|own| own.with_file_name(self.program));
        let beside = beside.ok().filter(|path| path.exists());
        beside.unwrap_or_else(|| self.program.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIBLING: Sibling = Sibling {
        program: "/no/program",
        subcommands: &[("train", "Train"), ("eval", "Evaluate")],
    };

    fn failure(line: &str) -> Option<String> {
        let words = line.split(' ').map(OsString::from);
        let help = SIBLING.exec_help(words.clone());
        let error = help.or_else(|| {
            let command = Command::new("program").subcommand(Command::new("run"));
            SIBLING.exec_subcommand(&SIBLING.extend(command).get_matches_from(words))
        });
        error.map(|error| error.to_string())
    }

    #[test]
    fn a_program_that_is_missing_is_named() {
        for line in [
            "program train --fast -v x",
            "program train --help",
            "program help train",
        ] {
            let message = failure(line).unwrap();
            assert!(
                message.starts_with("train is part of the program /no/program: "),
                "{line}: {message}"
            );
        }
        assert_eq!(failure("program run"), None);
    }

    #[test]
    fn everything_behind_the_name_is_passed_on() {
        let matches = SIBLING
            .extend(Command::new("program"))
            .get_matches_from(["program", "eval", "--a=1", "-h", "--", "b"]);
        let rest: Vec<_> = matches
            .subcommand()
            .unwrap()
            .1
            .get_many::<OsString>(REST)
            .unwrap()
            .collect();
        assert_eq!(rest, ["--a=1", "-h", "--", "b"]);
    }
}
