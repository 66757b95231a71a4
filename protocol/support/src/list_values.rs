//! Lists on a command line: blanks after their commas, in one word or between words, belong to no value.

use std::ffi::OsString;

use clap::{Arg, Command};

/// The words of a command line, where the values of each option with a comma between values are one word again:
/// `--method max, late` and `--method "max, late"` are `--method max,late`.
pub(crate) fn with_lists_joined(
    command: &Command,
    words: impl IntoIterator<Item = OsString>,
) -> Vec<OsString> {
    let (mut of, mut is_list, mut joined) = (command, false, Vec::<OsString>::new());
    for word in words {
        let Some(text) = word.to_str() else {
            joined.push(word);
            continue;
        };
        if let Some(option) = text.strip_prefix("--") {
            let (name, value) = option.split_once('=').unwrap_or((option, ""));
            let options = of.get_arguments();
            let mut named = options.filter(|arg: &&Arg| arg.get_long() == Some(name));
            is_list = named.any(|arg| arg.get_value_delimiter() == Some(','));
            let is_value = is_list && !value.is_empty();
            // The list continues in the next word after `--name` alone, and after a comma at the end.
            is_list &= value.is_empty() || value.trim_end().ends_with(',');
            joined.push(match is_value {
                true => format!("--{name}={}", without_blanks(value)).into(),
                false => word,
            });
            continue;
        }
        if !is_list {
            // Options after the name of a subcommand are those of the subcommand.
            of = of.find_subcommand(text).unwrap_or(of);
            joined.push(word);
            continue;
        }
        let text = without_blanks(text);
        is_list = text.ends_with(',');
        let last = joined.last_mut();
        match last.filter(|last| last.as_encoded_bytes().ends_with(b",")) {
            Some(last) => last.push(text),
            None => joined.push(text.into()),
        }
    }
    joined
}

/// The list without the blanks around its commas.
fn without_blanks(list: &str) -> String {
    let values: Vec<&str> = list.split(',').map(str::trim).collect();
    values.join(",")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blanks_after_the_commas_of_a_list_belong_to_no_value() {
        let list = Arg::new("method")
            .long("method")
            .value_delimiter(',')
            .num_args(1..);
        let eval = Command::new("eval")
            .arg(list)
            .arg(Arg::new("out").long("out"));
        let command = Command::new("program").subcommand(eval);
        for (words, expected) in [
            (
                vec!["eval", "--method", "max,", "late"],
                vec!["eval", "--method", "max,late"],
            ),
            (
                vec!["eval", "--method", "max, late ,none"],
                vec!["eval", "--method", "max,late,none"],
            ),
            (
                vec!["eval", "--method=max,", "late", "--out", "a, b"],
                vec!["eval", "--method=max,late", "--out", "a, b"],
            ),
            (
                vec!["eval", "--method", "max", "late"],
                vec!["eval", "--method", "max", "late"],
            ),
            (
                vec!["eval", "--method", "max,", "late", "a, b"],
                vec!["eval", "--method", "max,late", "a, b"],
            ),
            (vec!["--method", "max, late"], vec!["--method", "max, late"]),
        ] {
            let joined = with_lists_joined(&command, words.iter().map(OsString::from));
            assert_eq!(joined, expected, "{words:?}");
        }
    }
}
