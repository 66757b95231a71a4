//! Requirements between options: clap drops the one for an option that another given option excludes, so such an option is
//! required as a group of its own.

use std::fs;
use std::path::{Path, PathBuf};

/// Folders of the programs' sources.
const SOURCES: [&str; 5] = ["agent", "deploy", "ego-fuser", "protocol", "sim-replay"];
/// Fewer requirements found than this: the search no longer reads how they are written.
const FEWEST: usize = 20;

/// Rust sources below a folder.
fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|ending| ending == "rs") {
            found.push(path);
        }
    }
}

/// Text between each `start` and the `end` after it.
fn parts<'a>(text: &'a str, start: &str, end: &str) -> Vec<&'a str> {
    let after = text.split(start).skip(1);
    let parts = after.filter_map(|rest| rest.split_once(end));
    parts.map(|(part, _)| part).collect()
}

/// The attributes of the option with this name, from the end of the field before it on; empty for a group of options.
fn attributes<'a>(text: &'a str, option: &str) -> &'a str {
    let fields = ["", "pub(crate) "].map(|public| format!("\n    {public}{option}: "));
    let field = fields.iter().find_map(|field| text.find(field));
    let before = &text[..field.unwrap_or(0)];
    // A field ends with a comma behind its type; an attribute with a bracket.
    let lines = before.rmatch_indices(",\n    ");
    let mut ends = lines.filter(|(at, _)| before[at + 6..].starts_with(['#', '/']));
    &before[ends.next().map_or(0, |(at, _)| at)..]
}

/// True if options exclude this one, or it them.
fn is_excluded(text: &str, option: &str) -> bool {
    let quoted = format!("\"{option}\"");
    let mut lists = parts(text, "conflicts_with_all = [", "]");
    lists.extend(parts(text, "conflicts_with = ", "]"));
    let is_listed = lists.iter().any(|list| list.contains(&quoted));
    // A constant list of options.
    let is_named = text.lines().any(|line| line.trim() == format!("{quoted},"));
    let own = attributes(text, option);
    !own.is_empty() && (is_listed || is_named || own.contains("conflicts_with"))
}

#[test]
fn a_requirement_names_no_option_that_another_excludes() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let mut files = Vec::new();
    for folder in SOURCES {
        sources(&root.join(folder), &mut files);
    }
    let (mut found, mut wrong) = (0, Vec::new());
    for file in files {
        let text = fs::read_to_string(&file).unwrap();
        for start in ["requires = \"", ".requires(\""] {
            for required in parts(&text, start, "\"") {
                found += 1;
                if is_excluded(&text, required) {
                    wrong.push(format!("{}: {required}", file.display()));
                }
            }
        }
    }
    assert!(found >= FEWEST, "{found}");
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}
