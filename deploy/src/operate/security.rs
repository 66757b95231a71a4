//! Keys of one run: those of a folder, or generated for this run only.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use bus::shutdown::Stop;
use bus::{
    AccessControl, BusError, BusOptions, Credentials, ROUTER, Rejection, RejectionLog, Result,
};
use protocol::{Principal, RunScope};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::operate::keys::{self, KeyError, KeyPlan};
use crate::operate::network::RouterEndpoint;

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
    /// [`KeyError`] when they cannot be made.
    pub fn of(
        security: &Security,
        principals: Vec<Principal>,
        run_folder: &Path,
    ) -> Result<Self, KeyError> {
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
/// [`BusError::Keys`] names the problem.
pub(crate) fn guarded(options: BusOptions, folder: &Path, runs: RunScope) -> Result<BusOptions> {
    let credentials = credentials(folder, ROUTER)?;
    let members = credentials.members()?;
    let options = options.with_credentials(credentials);
    Ok(options.with_access_control(AccessControl { members, runs }))
}

/// Credentials in a folder, of the process of that name.
///
/// # Errors
/// [`BusError::Keys`] names the problem.
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

/// Interval at which the refusals of a run's router are read.
const LOOK_ROUND: Duration = Duration::from_secs(1);

/// Reads the refusals of a run's router.
pub struct RefusalWatch {
    stop: Stop,
    thread: Option<JoinHandle<RejectionLog>>,
}

impl RefusalWatch {
    /// Follows the router of this process; one that runs elsewhere keeps its own log.
    ///
    /// # Errors
    /// [`BusError::Thread`] when the system gives no thread.
    pub fn over(place: &RouterEndpoint) -> Result<Self> {
        let stop = Stop::new();
        if !place.is_guarded {
            return Ok(Self { stop, thread: None });
        }
        let (session, ending) = (place.session.clone(), stop.clone());
        let mut refusals = RejectionLog::of(&place.endpoint);
        let builder = thread::Builder::new().name("refusals".into());
        let thread = builder.spawn(move || {
            loop {
                let ended = ending.wait_until(Instant::now() + LOOK_ROUND);
                // Once more after the request, so that the last refusals count.
                refusals.update(&session);
                if ended {
                    return refusals;
                }
            }
        });
        let thread = thread.map_err(|cause| BusError::Thread {
            what: "refusals".into(),
            cause,
        })?;
        Ok(Self {
            stop,
            thread: Some(thread),
        })
    }

    /// All refusals, which are also logged.
    pub fn finish(mut self) -> BTreeMap<Rejection, u64> {
        self.stop.request();
        let read = self.thread.take().and_then(|thread| thread.join().ok());
        let counts = read.map_or_else(BTreeMap::new, |all| all.counts());
        for (refused, count) in &counts {
            let Rejection {
                peer,
                reason,
                message,
            } = refused;
            tracing::warn!(%peer, %reason, what = %message, count, "refused by the router");
        }
        counts
    }
}

impl Drop for RefusalWatch {
    fn drop(&mut self) {
        self.stop.request();
    }
}
