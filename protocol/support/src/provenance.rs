//! Provenance of a result: the command, and digests of everything that the result was made of.

use std::collections::BTreeMap;
use std::env;
use std::path::PathBuf;

use protocol::text::hex;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// Everything that a result was made of besides its settings. Digests are SHA-256, in hexadecimal digits.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// Command line that computed the result, the program first; empty where the result does not depend on it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub command: Vec<String>,
    /// Version of the programs.
    pub version: String,
    /// Commit of the checkout that they were built in; `unknown` outside one.
    pub commit: String,
    /// Digest of the program, or over all programs of a run.
    pub program_sha256: String,
    /// Digest over names, capture times and whole files of the evaluated sweeps and their annotations.
    pub data_sha256: String,
    /// Digest of every other file by its path: weights, TorchScript module, encoders and heads of the localization,
    /// tables of poses and errors, traces of the link.
    pub files_sha256: BTreeMap<PathBuf, String>,
}

impl Provenance {
    /// The same with the command line of this process.
    #[must_use]
    pub fn with_command(self) -> Self {
        let words = env::args_os().map(|word| word.to_string_lossy().into_owned());
        let command = words.collect();
        Self { command, ..self }
    }

    /// Digest of the settings, written as text, and of all that they were applied to; the command does not count.
    #[must_use]
    pub fn key(&self, settings: &str) -> String {
        let mut hash = Sha256::new();
        for part in [&self.program_sha256, &self.data_sha256] {
            hash.update(part);
        }
        for sha256 in self.files_sha256.values() {
            hash.update(sha256);
        }
        hash.update(settings);
        hex(&hash.finalize())
    }
}
