//! Command line: parsing, shell completions and manual pages.

use std::path::Path;
use std::{env, io, process};

use clap::{Command, CommandFactory, Parser};
use clap_complete::Shell;
use support::command_line::{GENERATE, parse_arguments, with_verbosity};
use support::output;

/// Parses the command line of this process; sets the verbosity of its messages. Ends the process on wrong usage, as
/// [`Parser::parse`].
pub fn parse<P: Parser>() -> P {
    end_if_generated(P::command);
    parse_arguments(P::command())
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
    use super::*;

    #[derive(Debug, Parser)]
    #[command(name = "program")]
    struct Cli {
        #[command(subcommand)]
        _command: Sub,
    }

    #[derive(Debug, clap::Subcommand)]
    enum Sub {
        /// Does it.
        Act,
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
