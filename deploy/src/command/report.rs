//! `v2vloc report`.

use std::path::PathBuf;

use deploy::operate::status::RunStatus;
use deploy::report::RunReport;
use support::output;

use support::cli::BadInput;
use support::cli::Outcome;

#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Folder of a run that has ended, or its name in --runs [default: the newest in --runs].
    run: Option<PathBuf>,
    /// Folder of the run folders.
    #[arg(long, default_value = "runs")]
    runs: PathBuf,
    /// Print report.json instead of tables: times in milliseconds, CPU in seconds, sizes in bytes.
    #[arg(long)]
    json: bool,
}

impl Arguments {
    /// Prints the report of the run.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        let folder = RunStatus::folder(self.run, &self.runs).map_err(BadInput::of)?;
        let report = RunReport::read(&folder).map_err(BadInput::of)?;
        if self.json {
            output::line(serde_json::to_string_pretty(&report)?)?;
        } else {
            output::text(format_args!(
                "run       {}, {} with {} poses, {} clock\n{report}",
                report.run, report.method, report.pose_source, report.clock
            ))?;
        }
        Ok(Outcome::Done)
    }
}
