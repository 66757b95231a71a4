//! Configuration files: YAML of a bounded size into typed values, with errors that state file, line and field.

use std::collections::BTreeMap;
use std::path::Path;

use crate::bounded_file;
use crate::file_error::{AtFile, FileError};
use crate::unknown_field;
use protocol::text::excerpt;
use serde::de::{DeserializeOwned, IgnoredAny};

/// Maximum size of a file, bytes.
const MAX_BYTES: u64 = 1 << 20;
/// Characters of a line that an error states at most: a value with its field on a screen.
const MAX_LINE_CHARS: usize = 80;

/// Reads a YAML file of at most 1 MiB.
///
/// # Errors
/// [`FileError`] states the file, and the line if there is one.
pub fn read<T: DeserializeOwned>(path: &Path) -> Result<T, FileError> {
    parse(&bounded_file::read_text(path, MAX_BYTES).at(path)?, path)
}

/// Parses YAML; `path` is stated in errors.
///
/// # Errors
/// [`FileError`].
pub fn parse<T: DeserializeOwned>(text: &str, path: &Path) -> Result<T, FileError> {
    let mut field = None;
    // Only with the names of the fields on the way: `T` is compiled for one deserializer.
    let parsed = serde_saphyr::with_deserializer_from_str(text, |deserializer| {
        serde_path_to_error::deserialize(deserializer).map_err(|error| {
            field = Some(error.path().to_string());
            error.into_inner()
        })
    });
    parsed.map_err(|error| {
        // A file that is no YAML may begin like one with an unknown field.
        let (error, field) = match serde_saphyr::from_str::<IgnoredAny>(text) {
            Err(no_yaml) => (no_yaml, None),
            Ok(_) => (error, field.filter(|field| field != ".")),
        };
        let fields = match &field {
            // The hint about kinds of files concerns fields of the top level only.
            Some(nested) if nested.contains('.') => Vec::new(),
            _ => serde_saphyr::from_str::<BTreeMap<String, IgnoredAny>>(text)
                .map_or_else(|_| Vec::new(), |fields| fields.into_keys().collect()),
        };
        let reason = unknown_field::explained(reason(&error), &fields);
        let line = error.location().map(|location| location.line());
        let reason = with_value(reason, line, text);
        let problem = field.map_or(reason.clone(), |field| format!("{field}: {reason}"));
        FileError {
            line,
            ..FileError::new(path, problem)
        }
    })
}

/// Text of an error in one line, without its position.
fn reason(error: &serde_saphyr::Error) -> String {
    let text = error.without_snippet().to_string();
    let line = text.lines().next().unwrap_or_default().trim();
    line.rsplit_once(" at line ")
        .map_or(line, |(reason, _)| reason)
        .to_owned()
}

/// The reason, and where it states a kind of value alone ("invalid u64"), the text of the line with the value found.
fn with_value(reason: String, line: Option<u64>, text: &str) -> String {
    let mut lines = text.lines().zip(1..);
    let found = lines.find(|(_, number)| line == Some(*number));
    match found.filter(|_| reason.starts_with("invalid ") && !reason.contains(':')) {
        Some((found, _)) => format!("{reason} in {:?}", excerpt(found.trim(), MAX_LINE_CHARS)),
        None => reason,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, serde::Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Small {
        #[expect(dead_code, reason = "only its name matters")]
        rate: f64,
    }

    #[derive(Debug, serde::Deserialize)]
    struct Nested {
        #[expect(dead_code, reason = "only its fields matter")]
        scene: Small,
    }

    fn error_of(text: &str) -> String {
        parse::<Nested>(text, Path::new("a.yaml"))
            .unwrap_err()
            .to_string()
    }

    #[test]
    fn a_wrong_field_is_named_with_its_place_once() {
        let message = error_of("scene:\n  rate: fast\n");
        assert!(
            message.starts_with("a.yaml:2: scene.rate: ") && !message.contains("at line"),
            "{message}"
        );
        let message = error_of("scene: {rat: 1}\n");
        assert!(
            message.starts_with("a.yaml:1: scene.rat: unknown field `rat`, expected"),
            "{message}"
        );
        assert_eq!(error_of("{}"), "a.yaml:1: missing field `scene`");
    }

    #[test]
    fn a_wrong_value_is_stated_as_its_line_is() {
        let reason = "scene.rate: invalid floating point in";
        let message = error_of("scene:\n  rate: 0x10\n");
        assert_eq!(message, format!("a.yaml:2: {reason} \"rate: 0x10\""));
        let long = "x".repeat(1000);
        let message = error_of(&format!("scene: {{rate: {long}}}\n"));
        assert!(message.contains(reason) && message.len() < 200, "{message}");
    }

    #[test]
    fn a_file_that_is_no_yaml_says_so_before_its_fields() {
        let message = error_of("scene: {rat: 1}\nthis is: [not yaml\n");
        assert!(
            !message.contains("rat") && !message.contains("this is"),
            "{message}"
        );
        assert_eq!(message, "a.yaml:2: unclosed bracket '['");
    }

    #[test]
    fn errors_state_file_line_and_field() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.yaml");
        let missing = read::<Small>(&path).unwrap_err().to_string();
        assert!(missing.contains("a.yaml: "), "{missing}");
        std::fs::write(&path, "# first\nrat: 1\n").unwrap();
        let unknown = read::<Small>(&path).unwrap_err().to_string();
        assert!(
            unknown.contains("a.yaml:2: ") && unknown.contains("rat"),
            "{unknown}"
        );
    }
}
