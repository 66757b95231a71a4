//! Configuration of a process: a file (`--config FILE`), changed by the given options of the command line.
//!
//! One type defines file, command line and JSON schema: serde reads and writes it, clap makes an option of every field,
//! and the doc comment of a field is help text and description. `Default` is the only source of defaults; the help
//! quotes them.

use std::path::PathBuf;

use clap::{Arg, ArgMatches, Args, Command, FromArgMatches};
use protocol::config::{FieldError, document, options_of};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use support::cli::BadInput;
use support::file_error::FileError;

/// Configuration of one process.
pub trait ProcessConfig: Args + Serialize + DeserializeOwned {
    /// Fields without a default: `run`, or `models.weights` in a section. The option of each has the last part as its
    /// name.
    const REQUIRED: &'static [&'static str];

    /// Checks the values of all fields.
    ///
    /// # Errors
    /// [`FieldError`] for the first value that is not allowed.
    fn validate(&self) -> Result<(), FieldError>;
}

/// The configuration with the required fields from `value_of` their option and defaults elsewhere.
///
/// # Errors
/// A value that its field does not accept.
pub fn minimal<C: ProcessConfig>(
    value_of: impl Fn(&str) -> String,
) -> Result<C, serde_json::Error> {
    let mut root = json!({});
    for field in C::REQUIRED {
        let place = field.split('.');
        let place = place.fold(&mut root, |place, part| &mut place[part]);
        *place = Value::String(value_of(option_name(field)));
    }
    serde_json::from_value(root)
}

/// Name of the option of a required field.
fn option_name(field: &str) -> &str {
    field.rsplit('.').next().unwrap_or(field)
}

/// Options of a process: those of its configuration, and `--config`.
#[derive(Debug, Clone)]
pub struct Configured<C> {
    file: Option<PathBuf>,
    config: C,
}

impl<C: ProcessConfig> Configured<C> {
    /// The configuration, its values checked.
    ///
    /// # Errors
    /// [`BadInput`] states file, field and value.
    pub fn validated(self) -> Result<C, BadInput> {
        match (self.config.validate(), self.file) {
            (Ok(()), _) => Ok(self.config),
            (Err(error), Some(file)) => Err(BadInput::of(FileError::new(file, error))),
            (Err(error), None) => Err(BadInput::of(error)),
        }
    }
}

impl<C: ProcessConfig> FromArgMatches for Configured<C> {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let file = matches.get_one::<PathBuf>("config").cloned();
        // Step 1: the file, or required options over the defaults.
        let mut config: C = match &file {
            Some(path) => support::config_file::read(path).map_err(refused)?,
            None => minimal(|option| text_of(matches, option)).map_err(refused)?,
        };
        // Step 2: the options that are given override it, the others keep its values.
        config.update_from_arg_matches(matches)?;
        Ok(Self { file, config })
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        self.config.update_from_arg_matches(matches)
    }
}

fn refused(error: impl std::fmt::Display) -> clap::Error {
    let kind = clap::error::ErrorKind::ValueValidation;
    clap::Error::raw(kind, format!("{error}\n"))
}

/// The option as it was given. A path that is not valid text is set again, exactly, with all other options.
fn text_of(matches: &ArgMatches, option: &str) -> String {
    let given = matches.get_raw(option).and_then(|mut values| values.next());
    given.map_or_else(String::new, |value| value.to_string_lossy().into_owned())
}

impl<C: ProcessConfig> Args for Configured<C> {
    fn augment_args(command: Command) -> Command {
        let config = Arg::new("config")
            .long("config")
            .value_name("FILE")
            .value_parser(clap::value_parser!(PathBuf))
            .help("Configuration of this process, YAML; given options override it");
        // A word that is valid as an id, a path and a name.
        let defaults = minimal::<C>(|_| "x".into())
            .and_then(serde_json::to_value)
            .unwrap_or_default();
        let required: Vec<&str> = C::REQUIRED.iter().copied().map(option_name).collect();
        let options =
            // The help must not quote the placeholder of a required field as its default.
            options_of::<C>().filter(|option| !required.contains(&option.get_id().as_str()));
        let command = C::augment_args_for_update(command.arg(config));
        document(command, options, &defaults).next_help_heading(None::<&str>)
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use serde::Deserialize;

    use super::*;

    #[derive(Debug, Clone, PartialEq, Serialize, Deserialize, clap::Args)]
    #[serde(default, deny_unknown_fields)]
    struct Section {
        /// Waits so long.
        #[arg(id = "section_seconds", long = "section-seconds")]
        seconds: f64,
        /// Goes on.
        #[arg(long)]
        goes_on: bool,
    }

    impl Default for Section {
        fn default() -> Self {
            Self {
                seconds: 2.5,
                goes_on: false,
            }
        }
    }

    #[derive(Debug, Clone, PartialEq, Serialize, Deserialize, clap::Args)]
    #[serde(deny_unknown_fields)]
    struct Config {
        /// Name.
        #[arg(long, required_unless_present = "config")]
        name: String,
        #[command(flatten)]
        #[serde(default)]
        section: Section,
    }

    impl ProcessConfig for Config {
        const REQUIRED: &'static [&'static str] = &["name"];

        fn validate(&self) -> Result<(), FieldError> {
            protocol::config::above_zero("section.seconds", self.section.seconds)
        }
    }

    #[derive(Debug, Parser)]
    struct Cli {
        #[command(flatten)]
        config: Configured<Config>,
    }

    fn config(name: &str, seconds: f64, goes_on: bool) -> Config {
        Config {
            name: name.into(),
            section: Section { seconds, goes_on },
        }
    }

    fn parsed(arguments: &[&str]) -> Result<Config, String> {
        let cli = Cli::try_parse_from([&["program"], arguments].concat())
            .map_err(|error| error.to_string())?;
        cli.config.validated().map_err(|error| error.to_string())
    }

    #[test]
    fn options_override_fields_of_a_file_only() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("c.yaml");
        std::fs::write(&path, "name: a\nsection: {seconds: 4, goes_on: true}\n").unwrap();
        let file = path.to_str().unwrap();
        assert_eq!(parsed(&["--name", "b"]).unwrap(), config("b", 2.5, false));
        assert_eq!(parsed(&["--config", file]).unwrap(), config("a", 4.0, true));
        assert_eq!(
            parsed(&["--config", file, "--name=b", "--goes-on=false"]).unwrap(),
            config("b", 4.0, false)
        );
        assert_eq!(
            parsed(&["--name=b", "--goes-on", "--section-seconds=1"]).unwrap(),
            config("b", 1.0, true)
        );
        assert!(parsed(&[]).unwrap_err().contains("--name"));
        let message = parsed(&["--config", file, "--section-seconds=0"]).unwrap_err();
        assert!(
            message.contains("c.yaml: section.seconds is 0"),
            "{message}"
        );
        std::fs::write(&path, "nam: a\n").unwrap();
        let message = parsed(&["--config", file]).unwrap_err();
        assert!(
            message.contains("c.yaml:1: ") && message.contains("nam"),
            "{message}"
        );
    }

    #[test]
    fn the_help_quotes_the_defaults() {
        let help = <Cli as clap::CommandFactory>::command()
            .render_help()
            .to_string();
        assert!(help.contains("Waits so long [default: 2.5]"), "{help}");
        assert!(
            help.contains("--goes-on[=<true|false>]") && !help.contains("Name [default"),
            "{help}"
        );
    }
}
