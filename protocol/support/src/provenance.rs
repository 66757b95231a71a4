//! Provenance of a result: the command, and digests of everything that the result was made of.

use std::collections::BTreeMap;
use std::env;
use std::io;
use std::path::PathBuf;

use protocol::text::hex;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::file_digests::FileDigests;

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
    /// Hashes programs and files, besides the data of that hash; without `programs`, the one that runs. `commit` is that
    /// of the checkout that they were built in.
    ///
    /// # Errors
    /// The first file that cannot be read, by name.
    pub fn collect(
        programs: &[PathBuf],
        data_sha256: String,
        files: impl IntoIterator<Item = PathBuf>,
        commit: &str,
        digests: &FileDigests,
    ) -> io::Result<Self> {
        let files_sha256 = files
            .into_iter()
            .map(|file| digests.sha256(&file).map(|sha256| (file, sha256)))
            .collect::<io::Result<_>>()?;
        Ok(Self {
            command: Vec::new(),
            version: env!("CARGO_PKG_VERSION").into(),
            commit: commit.into(),
            program_sha256: match programs {
                [] => digests.program_sha256()?,
                programs => hash_programs(programs, digests)?,
            },
            data_sha256,
            files_sha256,
        })
    }

    /// The same with the command line of this process.
    #[must_use]
    pub fn with_command(self) -> Self {
        let words = env::args_os().map(|word| word.to_string_lossy().into_owned());
        let command = words.collect();
        Self { command, ..self }
    }

    /// Digest of the settings, written as text, and of all that they were applied to; the command does not count.
    pub fn key(&self, settings: &str) -> String {
        let mut hash = Sha256::new();
        let digests = [&self.program_sha256, &self.data_sha256].into_iter();
        for sha256 in digests.chain(self.files_sha256.values()) {
            hash.update(sha256);
        }
        hash.update(settings);
        hex(&hash.finalize())
    }
}

/// One hash over many programs: name and content of each.
fn hash_programs(programs: &[PathBuf], digests: &FileDigests) -> io::Result<String> {
    let mut all = Sha256::new();
    for path in programs {
        let name = path.file_name().unwrap_or_default().display();
        all.update(format!("{name} {}\n", digests.sha256(path)?));
    }
    Ok(hex(&all.finalize()))
}
