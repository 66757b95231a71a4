//! `v2vloc status`.

use std::path::PathBuf;

use deploy::operate::status::RunStatus;
use support::output;

use support::cli::BadInput;
use support::cli::Outcome;

#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Folder of the run [default: the one in --runs with the newest status].
    run: Option<PathBuf>,
    /// Folder of the run folders.
    #[arg(long, default_value = "runs")]
    runs: PathBuf,
    /// Print JSON instead of a table.
    #[arg(long)]
    json: bool,
}

impl Arguments {
    /// Prints the state of the run.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        let bad_input = |error: deploy::operate::status::StatusError| BadInput::of(error);
        let folder = RunStatus::folder(self.run, &self.runs).map_err(bad_input)?;
        let status = RunStatus::read(&folder).map_err(bad_input)?;
        if self.json {
            output::line(serde_json::to_string_pretty(&status)?)?;
        } else {
            output::text(status.table())?;
        }
        let troubles = status.troubles();
        anyhow::ensure!(troubles.is_empty(), "run {} is not well: {}", status.run, troubles.join("; "));
        Ok(Outcome::Done)
    }
}
