//! Keys of one run: those of a folder, or generated for this run only.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use bus::shutdown::Stop;
use bus::{AccessControl, BusError, BusOptions, Credentials, ROUTER, Rejection, RejectionLog};
use protocol::{Principal, RunId, RunScope};
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
            return Ok(Self {
                folder: folder.clone(),
                is_own: false,
            });
        }
        let own = Self {
            folder: run_folder.join("keys"),
            is_own: true,
        };
        keys::make(&KeyPlan::new(&own.folder, principals, DAYS_OF_A_RUN))?;
        Ok(own)
    }

    /// The folder of one process.
    #[must_use]
    pub fn of_process(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }

    /// A router with these keys that admits every process with a certificate, into `run` only.
    ///
    /// # Errors
    /// [`BusError::Keys`] names the problem.
    pub(crate) fn for_router(
        &self,
        options: BusOptions,
        run: &RunId,
    ) -> Result<BusOptions, BusError> {
        let credentials = self.read(ROUTER)?;
        let guard = AccessControl {
            members: credentials.members()?,
            runs: RunScope::One(run.clone()),
        };
        Ok(options
            .with_credentials(credentials)
            .with_access_control(guard))
    }

    /// A client with the keys of the process of that name.
    ///
    /// # Errors
    /// [`BusError::Keys`] names the problem.
    pub(crate) fn for_client(
        &self,
        options: BusOptions,
        name: &str,
    ) -> Result<BusOptions, BusError> {
        Ok(options.with_credentials(self.read(name)?))
    }

    fn read(&self, name: &str) -> Result<Credentials, BusError> {
        let credentials = Credentials::read(&self.of_process(name))?;
        credentials.check_name(name)?;
        Ok(credentials)
    }
}

impl Drop for RunKeys {
    fn drop(&mut self) {
        if self.is_own
            && let Err(error) = fs::remove_dir_all(&self.folder)
        {
            tracing::warn!(
                "{} holds keys that are no longer needed: {error}",
                self.folder.display()
            );
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
    pub fn over(place: &RouterEndpoint) -> Result<Self, BusError> {
        let stop = Stop::new();
        if !place.is_guarded {
            return Ok(Self { stop, thread: None });
        }
        let (session, ending) = (place.session.clone(), stop.clone());
        let mut refusals = RejectionLog::of(&place.endpoint);
        let look = move || {
            loop {
                let ended = ending.wait_until(Instant::now() + LOOK_ROUND);
                refusals.update(&session);
                if ended {
                    return refusals;
                }
            }
        };
        let thread = thread::Builder::new().name("refusals".into()).spawn(look);
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
        let counts = self
            .thread
            .take()
            .and_then(|thread| thread.join().ok())
            .map_or_else(BTreeMap::new, |all| all.counts());
        for (
            Rejection {
                peer,
                reason,
                message,
            },
            count,
        ) in &counts
        {
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
