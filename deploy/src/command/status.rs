//! `v2vloc status`.

use std::time::Duration;

use crate::operate::remote_status::RemoteStatus;
use crate::operate::status::RunStatus;
use anyhow::ensure;
use support::output;

use super::watched_run::WatchedRun;
use support::cli::{BadInput, Outcome};

/// Time of observation: processes report twice a second.
const OBSERVED: Duration = Duration::from_millis(2500);

#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    run: WatchedRun,
    /// Print JSON instead of a table.
    #[arg(long)]
    json: bool,
}

impl Arguments {
    /// Prints the state of the run.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        if let Some((name, router)) = self.run.remote() {
            let bus = self.run.bus(name, router)?;
            let status = RemoteStatus::observe(&bus, OBSERVED)?;
            return self.print(&status, &status.table(), &status.run, &status.troubles());
        }
        let status = RunStatus::read(&self.run.folder()?).map_err(BadInput::of)?;
        self.print(&status, &status.table(), &status.run, &status.troubles())
    }

    /// Prints a status; then an error for a run with problems.
    fn print(
        &self,
        status: &impl serde::Serialize,
        table: &str,
        run: &str,
        troubles: &[String],
    ) -> anyhow::Result<Outcome> {
        match self.json {
            true => output::line(serde_json::to_string_pretty(status)?)?,
            false => output::text(table)?,
        }
        let (is_well, troubles) = (troubles.is_empty(), troubles.join("; "));
        ensure!(is_well, "run {run} is not well: {troubles}");
        Ok(Outcome::Done)
    }
}
