//! Options of a command line from the fields of a configuration; their defaults are those of `Default`.

use std::collections::BTreeMap;

use clap::builder::{Resettable, StyledStr};
use clap::{Arg, ArgAction, ArgMatches, Args, Command, FromArgMatches};
use serde::Serialize;
use serde_json::Value;

/// A part of a configuration on a command line: its defaults, changed by the options that are given.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Section<T>(pub T);

impl<T: Args + Default + Serialize> FromArgMatches for Section<T> {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let mut section = T::default();
        section.update_from_arg_matches(matches)?;
        Ok(Self(section))
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        self.0.update_from_arg_matches(matches)
    }
}

impl<T: Args + Default + Serialize> Args for Section<T> {
    fn augment_args(command: Command) -> Command {
        let defaults = serde_json::to_value(T::default()).unwrap_or_default();
        let command = T::augment_args_for_update(command);
        document(command, options_of::<T>(), &defaults).next_help_heading(None::<&str>)
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

/// The options of a type that a configuration consists of.
pub fn options_of<A: Args>() -> impl Iterator<Item = Arg> {
    let command = A::augment_args_for_update(Command::new("options"));
    let options: Vec<Arg> = command.get_arguments().cloned().collect();
    options.into_iter()
}

/// Appends its default to the help of each of `options`, and lets flags be switched off (`--flag=false`), so that they
/// can override a file.
pub fn document(command: Command, options: impl Iterator<Item = Arg>, defaults: &Value) -> Command {
    let defaults = names(defaults);
    options.fold(command, |command, option| {
        let id = option.get_id().clone();
        let default = defaults.get(id.as_str()).and_then(text);
        command.mut_arg(&id, |option| with_default(switchable(option), default))
    })
}

fn with_default(option: Arg, default: Option<String>) -> Arg {
    let Some(default) = default else {
        return option;
    };
    let [short, long] = [option.get_help(), option.get_long_help()].map(|help| {
        let help = help.map(|help| StyledStr::from(format!("{help} [default: {default}]")));
        Resettable::<StyledStr>::from(help)
    });
    option.help(short).long_help(long)
}

fn switchable(option: Arg) -> Arg {
    if !matches!(option.get_action(), ArgAction::SetTrue) {
        return option;
    }
    let option = option.action(ArgAction::Set).num_args(0..=1);
    let option = option.require_equals(true).value_name("true|false");
    option.default_missing_value("true")
}

/// Values by the names that an option for them may have: the field alone, or with its sections, joined by `_`.
fn names(defaults: &Value) -> BTreeMap<String, Value> {
    let mut leaves = Vec::new();
    collect(defaults, &mut Vec::new(), &mut leaves);
    let mut names = BTreeMap::new();
    for (path, value) in &leaves {
        for start in 0..path.len() {
            let name = path.get(start..).unwrap_or_default();
            let named = leaves.iter().filter(|(other, _)| other.ends_with(name));
            // A short name that two sections share names neither. The whole path (start 0) is kept.
            if named.count() == 1 || start == 0 {
                names.insert(name.join("_"), value.clone());
            }
        }
    }
    names
}

fn collect(value: &Value, path: &mut Vec<String>, leaves: &mut Vec<(Vec<String>, Value)>) {
    let Value::Object(fields) = value else {
        leaves.push((path.clone(), value.clone()));
        return;
    };
    for (name, value) in fields {
        path.push(name.clone());
        collect(value, path, leaves);
        path.pop();
    }
}

/// A default in the form in which it is typed; `None` if there is no default, or if it is empty or false.
fn text(value: &Value) -> Option<String> {
    match value {
        Value::Null | Value::Bool(false) | Value::Object(_) => None,
        Value::Bool(true) => Some("true".into()),
        Value::Number(number) => Some(number.to_string()),
        Value::String(text) => Some(text.clone()),
        Value::Array(values) => {
            let texts: Vec<String> = values.iter().filter_map(text).collect();
            Some(texts.join(",")).filter(|text| !text.is_empty())
        }
    }
}
