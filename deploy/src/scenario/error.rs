//! What is wrong with a scenario.

use std::path::PathBuf;

/// Why a scenario cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ScenarioError {
    /// The file cannot be read.
    #[error("cannot read scenario {}: {source}", path.display())]
    Read {
        /// The scenario file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file is not YAML, or a field is unknown, missing or of the wrong kind.
    #[error("{}{}: {reason}", path.display(), line.map_or(String::new(), |line| format!(":{line}")))]
    Syntax {
        /// The scenario file.
        path: PathBuf,
        /// Line of the offence, from 1.
        line: Option<u64>,
        /// What is wrong there.
        reason: String,
    },
    /// A field has a value that makes no sense.
    #[error("{}: {field} is {found}: {rule}", path.display())]
    Value {
        /// The scenario file.
        path: PathBuf,
        /// The field, with its parents.
        field: &'static str,
        /// What it says.
        found: String,
        /// What it may say.
        rule: &'static str,
    },
    /// A path names nothing.
    #[error("{}: {field}: {} does not exist", path.display(), missing.display())]
    Missing {
        /// The scenario file.
        path: PathBuf,
        /// The field, with its parents.
        field: &'static str,
        /// The file or folder that is not there.
        missing: PathBuf,
    },
}
