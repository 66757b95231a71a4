//! `v2vloc report`.

use std::path::PathBuf;

use crate::operate::status::RunStatus;
use crate::report::{Comparison, RunReport};
use support::output;

use support::cli::{BadInput, Outcome};

#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Folder of a run that has ended, or its name in --runs; several are compared [default: the newest in --runs].
    #[arg(value_name = "RUN")]
    named: Vec<PathBuf>,
    /// Folder of the run folders.
    #[arg(long, default_value = "runs")]
    runs: PathBuf,
    /// Print report.json (a list of them for several runs) instead of tables: times in milliseconds, CPU in seconds, sizes in bytes.
    #[arg(long)]
    json: bool,
}

impl Arguments {
    /// Prints the report of the run, or a comparison of several.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        match self.named.as_slice() {
            [] => self.print(None),
            [run] => self.print(Some(run.clone())),
            several => self.compare(several),
        }
    }

    fn print(&self, run: Option<PathBuf>) -> anyhow::Result<Outcome> {
        let folder = RunStatus::folder(run, &self.runs).map_err(BadInput::of)?;
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

    fn compare(&self, several: &[PathBuf]) -> anyhow::Result<Outcome> {
        let folder = |run: &PathBuf| RunStatus::folder(Some(run.clone()), &self.runs);
        let folders = several.iter().map(folder).collect::<Result<Vec<_>, _>>();
        let folders = folders.map_err(BadInput::of)?;
        if self.json {
            let reports = folders.iter().map(|folder| RunReport::read(folder));
            let reports = reports
                .collect::<Result<Vec<_>, _>>()
                .map_err(BadInput::of)?;
            output::line(serde_json::to_string_pretty(&reports)?)?;
        } else {
            output::text(Comparison::read(&folders).map_err(BadInput::of)?)?;
        }
        Ok(Outcome::Done)
    }
}
