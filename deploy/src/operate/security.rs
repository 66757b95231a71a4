//! Keys of one run: those of a folder, or generated for this run only.

use std::fs;
use std::path::{Path, PathBuf};

use bus::{AccessControl, BusOptions, Credentials, ROUTER, Result};
use protocol::{Principal, RunScope};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::operate::keys::{self, KeyFileError, KeyPlan};

/// Lifetime of the keys of one run, days.
const DAYS_OF_A_RUN: u32 = 30;

/// QUIC between all processes; each is restricted to its own topics.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Security {
    /// Folder that `v2vloc keys` has written, relative to the scenario file; absent: keys are generated for this run
    /// only.
    pub keys: Option<PathBuf>,
}

/// Folder with the keys of every process of a run.
#[derive(Debug)]
pub struct RunKeys {
    folder: PathBuf,
    /// Generated for this run, and deleted with it.
    is_own: bool,
}

impl RunKeys {
    /// Uses the folder that the scenario names, or generates keys for `principals` in `run_folder`.
    ///
    /// # Errors
    /// [`KeyFileError`] when they cannot be made.
    pub fn of(
        security: &Security,
        principals: Vec<Principal>,
        run_folder: &Path,
    ) -> Result<Self, KeyFileError> {
        if let Some(folder) = &security.keys {
            let (folder, is_own) = (folder.clone(), false);
            return Ok(Self { folder, is_own });
        }
        let (folder, is_own) = (run_folder.join("keys"), true);
        // Held before the keys are made: dropped on an error, it removes those that were written.
        let own = Self { folder, is_own };
        keys::make(&KeyPlan::new(&own.folder, principals, DAYS_OF_A_RUN))?;
        Ok(own)
    }

    /// The folder of one process.
    pub fn of_process(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }
}

/// A router with the keys in a folder, which admits every process with a certificate, into `runs` only.
///
/// # Errors
/// [`bus::BusError::Keys`] names the problem.
pub(crate) fn guarded(options: BusOptions, folder: &Path, runs: RunScope) -> Result<BusOptions> {
    let credentials = credentials(folder, ROUTER)?;
    let members = credentials.members()?;
    Ok(BusOptions {
        guard: Some(AccessControl { members, runs }),
        ..options.with_credentials(credentials)
    })
}

/// Credentials in a folder, of the process of that name.
///
/// # Errors
/// [`bus::BusError::Keys`] names the problem.
pub(crate) fn credentials(folder: &Path, name: &str) -> Result<Credentials> {
    let credentials = Credentials::read(folder)?;
    credentials.check_name(name)?;
    Ok(credentials)
}

impl Drop for RunKeys {
    fn drop(&mut self) {
        if self.is_own
            && let Err(error) = fs::remove_dir_all(&self.folder)
        {
            let folder = self.folder.display();
            tracing::warn!("{folder} holds keys that are no longer needed: {error}");
        }
    }
}
