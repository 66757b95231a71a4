//! Watched run: the options that name a run, by its folder or by a router.

use std::path::PathBuf;

use bus::{Bus, Endpoint};
use protocol::{Principal, Role, RunId};
use support::cli::BadInput;

use super::client;
use crate::operate::status::RunStatus;

#[derive(Debug, clap::Args)]
pub(crate) struct WatchedRun {
    /// Folder of a run, or its name in --runs [default: the one in --runs with the newest status].
    #[arg(conflicts_with = "connect")]
    pub(crate) run: Option<PathBuf>,
    /// Folder of the run folders.
    #[arg(long, default_value = "runs", conflicts_with = "connect")]
    runs: PathBuf,
    /// Router of a live run without a folder here, tcp/HOST:PORT; `v2vloc up` prints it.
    // Required as a group of one option: clap forgets the requirement of an option that another excludes.
    #[arg(long, group = "remote", requires = "name", value_name = "ENDPOINT")]
    connect: Option<Endpoint>,
    /// Name of the run (--connect).
    #[arg(long = "run", id = "name", requires = "remote", value_name = "NAME")]
    name: Option<RunId>,
    /// Folder with the viewer's keys, where the run has security; `v2vloc keys` writes DIR/viewer (--connect).
    #[arg(long, value_name = "DIR", requires = "remote")]
    keys: Option<PathBuf>,
}

impl WatchedRun {
    /// Name and router of a run without a folder here.
    pub(crate) fn remote(&self) -> Option<(&RunId, &Endpoint)> {
        self.name.as_ref().zip(self.connect.as_ref())
    }

    /// Folder of the run.
    pub(crate) fn folder(&self) -> Result<PathBuf, BadInput> {
        RunStatus::folder(self.run.clone(), &self.runs)
    }

    /// Session of a viewer.
    pub(crate) fn bus(&self, name: &RunId, router: &Endpoint) -> anyhow::Result<Bus> {
        let viewer = Principal::of_role(Role::Viewer);
        let (identity, options) = client(name, &viewer, router, self.keys.as_deref())?;
        Ok(Bus::join(&options, identity)?)
    }
}
