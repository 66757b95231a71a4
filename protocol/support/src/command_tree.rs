//! Command tree: subcommands and options of a command line as data, so that one program completes and documents those
//! of another.

use clap::builder::{
    PossibleValue, PossibleValuesParser, Resettable, Str, StyledStr, ValueParser, ValueRange,
};
use clap::{Arg, ArgAction, ArgGroup, Command, ValueHint};
use serde::{Deserialize, Serialize};

/// A command.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub(crate) struct CommandTree {
    pub name: String,
    about: Option<String>,
    long_about: Option<String>,
    after_help: Option<String>,
    is_hidden: bool,
    requires_subcommand: bool,
    arguments: Vec<ArgumentTree>,
    /// Names and members of the groups of which one argument has to be given.
    required_groups: Vec<(String, Vec<String>)>,
    pub subcommands: Vec<CommandTree>,
}

/// An option or a positional argument.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(default)]
struct ArgumentTree {
    id: String,
    short: Option<char>,
    long: Option<String>,
    help: Option<String>,
    long_help: Option<String>,
    heading: Option<String>,
    kind: Kind,
    /// Smallest and largest number of values.
    num_args: Option<(usize, usize)>,
    value_names: Vec<String>,
    /// Source of completions of a value, by the name that [`ValueHint`] parses.
    hint: Option<String>,
    default_values: Vec<String>,
    hides_default: bool,
    values: Vec<ValueTree>,
    hides_values: bool,
    conflicts: Vec<String>,
    requires_equals: bool,
    is_required: bool,
    is_hidden: bool,
    is_global: bool,
    is_last: bool,
}

/// Treatment of the values of an argument.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
enum Kind {
    #[default]
    Value,
    Values,
    Flag,
    Count,
}

/// A possible value.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(default)]
struct ValueTree {
    name: String,
    help: Option<String>,
    is_hidden: bool,
}

impl CommandTree {
    /// Describes a command that is not built yet.
    pub(crate) fn of(command: &Command) -> Self {
        let groups = command.get_groups().filter(|group| group.is_required_set());
        let group = |group: &ArgGroup| {
            (
                group.get_id().to_string(),
                group.get_args().map(ToString::to_string).collect(),
            )
        };
        Self {
            name: command.get_name().to_owned(),
            about: text(command.get_about()),
            long_about: text(command.get_long_about()),
            after_help: text(command.get_after_help()),
            is_hidden: command.is_hide_set(),
            requires_subcommand: command.is_subcommand_required_set(),
            arguments: command
                .get_arguments()
                .map(|argument| ArgumentTree::of(command, argument))
                .collect(),
            required_groups: groups.map(group).collect(),
            subcommands: command.get_subcommands().map(Self::of).collect(),
        }
    }

    /// The command, for completions and manual pages: it parses nothing.
    pub(crate) fn command(&self) -> Command {
        let group = |(id, members): &(String, Vec<String>)| {
            ArgGroup::new(kept(id))
                .args(members.iter().map(|id| kept(id)))
                .multiple(true)
                .required(true)
        };
        Command::new(kept(&self.name))
            .about(styled(&self.about))
            .long_about(styled(&self.long_about))
            .after_help(styled(&self.after_help))
            .hide(self.is_hidden)
            .subcommand_required(self.requires_subcommand)
            .args(self.arguments.iter().map(ArgumentTree::argument))
            .groups(self.required_groups.iter().map(group))
            .subcommands(self.subcommands.iter().map(Self::command))
    }
}

impl ArgumentTree {
    fn of(command: &Command, argument: &Arg) -> Self {
        let kind = match argument.get_action() {
            ArgAction::Append => Kind::Values,
            ArgAction::Count => Kind::Count,
            action if action.takes_values() => Kind::Value,
            _ => Kind::Flag,
        };
        let takes_values = argument.get_action().takes_values();
        let values = if takes_values {
            argument.get_possible_values()
        } else {
            Vec::new()
        };
        let names = |names: &[_]| names.iter().map(ToString::to_string).collect();
        let defaults = argument
            .get_default_values()
            .iter()
            .filter(|_| takes_values);
        Self {
            id: argument.get_id().to_string(),
            short: argument.get_short(),
            long: argument.get_long().map(str::to_owned),
            help: text(argument.get_help()),
            long_help: text(argument.get_long_help()),
            heading: argument.get_help_heading().map(str::to_owned),
            kind,
            num_args: argument
                .get_num_args()
                .map(|range| (range.min_values(), range.max_values())),
            value_names: argument.get_value_names().map(names).unwrap_or_default(),
            hint: takes_values
                .then(|| hint_name(argument.get_value_hint()))
                .flatten(),
            default_values: defaults
                .map(|value| value.to_string_lossy().into_owned())
                .collect(),
            hides_default: argument.is_hide_default_value_set(),
            values: values.iter().map(ValueTree::of).collect(),
            hides_values: argument.is_hide_possible_values_set(),
            conflicts: command
                .get_arg_conflicts_with(argument)
                .iter()
                .map(|other| other.get_id().to_string())
                .collect(),
            requires_equals: argument.is_require_equals_set(),
            is_required: argument.is_required_set(),
            is_hidden: argument.is_hide_set(),
            is_global: argument.is_global_set(),
            is_last: argument.is_last_set(),
        }
    }

    fn argument(&self) -> Arg {
        let action = match self.kind {
            Kind::Value => ArgAction::Set,
            Kind::Values => ArgAction::Append,
            Kind::Flag => ArgAction::SetTrue,
            Kind::Count => ArgAction::Count,
        };
        let hint: Option<ValueHint> = self.hint.as_ref().and_then(|hint| hint.parse().ok());
        let values = || PossibleValuesParser::new(self.values.iter().map(ValueTree::value));
        Arg::new(kept(&self.id))
            .short(self.short)
            .long(name(&self.long))
            .help(styled(&self.help))
            .long_help(styled(&self.long_help))
            .help_heading(name(&self.heading))
            .action(action)
            .num_args(Resettable::from(
                self.num_args
                    .map(|(least, most)| ValueRange::new(least..=most)),
            ))
            .value_names(self.value_names.iter().map(|name| kept(name)))
            .value_hint(hint)
            .default_values(self.default_values.iter().map(|value| kept(value)))
            .hide_default_value(self.hides_default)
            .value_parser((!self.values.is_empty()).then(|| ValueParser::from(values())))
            .hide_possible_values(self.hides_values)
            .conflicts_with_all(self.conflicts.iter().map(|id| kept(id)))
            .require_equals(self.requires_equals)
            .required(self.is_required)
            .hide(self.is_hidden)
            .global(self.is_global)
            .last(self.is_last)
    }
}

impl ValueTree {
    fn of(value: &PossibleValue) -> Self {
        Self {
            name: value.get_name().to_owned(),
            help: text(value.get_help()),
            is_hidden: value.is_hide_set(),
        }
    }

    fn value(&self) -> PossibleValue {
        let value = PossibleValue::new(kept(&self.name)).hide(self.is_hidden);
        match &self.help {
            Some(help) => value.help(kept(help)),
            None => value,
        }
    }
}

fn text(styled: Option<&StyledStr>) -> Option<String> {
    styled.map(ToString::to_string)
}

fn styled(text: &Option<String>) -> Resettable<StyledStr> {
    text.as_ref().map(StyledStr::from).into()
}

fn name(text: &Option<String>) -> Resettable<Str> {
    text.as_deref().map(|text| Str::from(kept(text))).into()
}

/// A text for the rest of the process, which clap demands: this process writes a few files and ends.
fn kept(text: &str) -> &'static str {
    text.to_owned().leak()
}

/// Name of a hint as it is parsed; `None` for the default.
fn hint_name(hint: ValueHint) -> Option<String> {
    (hint != ValueHint::Unknown).then(|| format!("{hint:?}"))
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use clap::{CommandFactory, Parser, ValueEnum};
    use clap_complete::Shell;

    use super::*;

    #[derive(Debug, Clone, Copy, ValueEnum)]
    enum Format {
        /// Binary.
        Half,
        Text,
    }

    /// Does it.
    #[derive(Debug, Parser)]
    #[command(name = "program", version, after_help = "Exit codes: 0 and 1.")]
    enum Program {
        /// Train it.
        Train(Train),
        /// Hidden.
        #[command(hide = true)]
        Work { number: u32 },
        /// Has two.
        #[command(subcommand)]
        Both(Both),
    }

    #[derive(Debug, clap::Subcommand)]
    enum Both {
        /// The first.
        First,
        /// The second.
        Second {
            /// Files, at least one.
            #[arg(required = true)]
            files: Vec<PathBuf>,
        },
    }

    #[derive(Debug, clap::Args)]
    #[command(group = ArgGroup::new("source").args(["scene", "list"]).required(true))]
    struct Train {
        /// The scene.
        ///
        /// With more about it.
        #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath, conflicts_with = "list")]
        scene: Option<PathBuf>,
        #[arg(short, long, value_delimiter = ',', num_args = 1.., help_heading = "Other")]
        list: Vec<u32>,
        /// Number format.
        #[arg(long, value_enum, default_value = "half")]
        format: Format,
        #[arg(long, default_value_t = 3, hide_default_value = true)]
        epochs: u32,
        /// Hurry.
        #[arg(long, conflicts_with_all = ["epochs", "source"])]
        fast: bool,
        #[arg(short = 'n', action = ArgAction::Count)]
        count: u8,
        #[arg(long, hide = true)]
        worker: bool,
        #[arg(long, num_args = 0..=1, require_equals = true, default_missing_value = "true")]
        clock: Option<bool>,
        rest: Option<String>,
    }

    /// The subcommands after their way through JSON.
    fn told() -> Command {
        let json = serde_json::to_string(&CommandTree::of(&Program::command())).unwrap();
        let told: CommandTree = serde_json::from_str(&json).unwrap();
        let own = Command::new("program")
            .version(env!("CARGO_PKG_VERSION"))
            .about("Does it")
            .subcommand_required(true);
        own.arg_required_else_help(true)
            .after_help("Exit codes: 0 and 1.")
            .subcommands(told.command().get_subcommands())
    }

    #[test]
    fn completions_are_those_of_the_program_itself() {
        for shell in [Shell::Bash, Shell::Zsh, Shell::Fish] {
            let script = |mut command: Command| {
                let mut script = Vec::new();
                clap_complete::generate(shell, &mut command, "program", &mut script);
                String::from_utf8(script).unwrap()
            };
            assert_eq!(script(told()), script(Program::command()), "{shell}");
        }
    }

    #[test]
    fn manual_pages_are_those_of_the_program_itself() {
        let pages = |command: Command| {
            let folder = tempfile::tempdir().unwrap();
            clap_mangen::generate_to(command, folder.path()).unwrap();
            let read = |name: &str| std::fs::read_to_string(folder.path().join(name)).unwrap();
            [
                "program.1",
                "program-train.1",
                "program-both.1",
                "program-both-second.1",
            ]
            .map(read)
        };
        assert_eq!(pages(told()), pages(Program::command()));
    }
}
