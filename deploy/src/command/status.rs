//! `v2vloc status`.

use std::path::PathBuf;
use std::time::Duration;

use crate::operate::remote_status::RemoteStatus;
use crate::operate::status::RunStatus;
use anyhow::ensure;
use bus::Endpoint;
use protocol::RunId;
use support::output;

use super::viewer_bus;
use support::cli::{BadInput, Outcome};

/// Time of observation: processes report twice a second.
const OBSERVED: Duration = Duration::from_millis(2500);

#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Folder of the run [default: the one in --runs with the newest status].
    #[arg(conflicts_with = "connect")]
    run: Option<PathBuf>,
    /// Folder of the run folders.
    #[arg(long, default_value = "runs", conflicts_with = "connect")]
    runs: PathBuf,
    /// Router of a run without a folder here, tcp/HOST:PORT: its processes are observed for 2.5 s.
    #[arg(long, requires = "name", value_name = "ENDPOINT")]
    connect: Option<Endpoint>,
    /// Name of the run (--connect).
    #[arg(long = "run", id = "name", requires = "connect", value_name = "NAME")]
    name: Option<RunId>,
    /// Folder with the viewer's keys, where the run has security (--connect).
    #[arg(long, value_name = "DIR", requires = "connect")]
    keys: Option<PathBuf>,
    /// Print JSON instead of a table.
    #[arg(long)]
    json: bool,
}

impl Arguments {
    /// Prints the state of the run.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        if let (Some(router), Some(name)) = (&self.connect, &self.name) {
            let bus = viewer_bus(name, router, self.keys.as_deref())?;
            let status = RemoteStatus::observe(&bus, OBSERVED)?;
            self.print(&status, &status.table())?;
            return check(&status.run, &status.troubles());
        }
        let folder = RunStatus::folder(self.run.clone(), &self.runs).map_err(BadInput::of)?;
        let status = RunStatus::read(&folder).map_err(BadInput::of)?;
        self.print(&status, &status.table())?;
        check(&status.run, &status.troubles())
    }

    fn print(&self, status: &impl serde::Serialize, table: &str) -> anyhow::Result<()> {
        if self.json {
            output::line(serde_json::to_string_pretty(status)?)?
        } else {
            output::text(table)?
        }
        Ok(())
    }
}

/// An error for a run with problems.
fn check(run: &str, troubles: &[String]) -> anyhow::Result<Outcome> {
    let (is_well, troubles) = (troubles.is_empty(), troubles.join("; "));
    ensure!(is_well, "run {run} is not well: {troubles}");
    Ok(Outcome::Done)
}
