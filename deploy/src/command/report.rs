//! `v2vloc report`.

use std::path::{Path, PathBuf};

use crate::operate::status::RunStatus;
use crate::report::{Comparison, RunReport, TrackReport, TrackTable};
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
    /// Track the objects, and print the quality of the tracks instead: AMOTA, AMOTP, MOTA, IDS, FRAG, HOTA, IDF1, a row
    /// for each run. Takes folders of `v2vloc eval --out` too. Distances in metres.
    #[arg(long)]
    tracks: bool,
}

impl Arguments {
    /// Prints the report of the run, or a comparison of several.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        let newest = self.named.is_empty().then_some(None);
        let runs = self.named.iter().cloned().map(Some).chain(newest);
        let folders = runs.map(|run| RunStatus::folder(run, &self.runs).map_err(BadInput::of));
        match folders.collect::<Result<Vec<_>, _>>()?.as_slice() {
            folders if self.tracks => self.track(folders),
            [folder] => self.print(folder),
            several => self.compare(several),
        }
    }

    fn print(&self, folder: &Path) -> anyhow::Result<Outcome> {
        let report = RunReport::read(folder).map_err(BadInput::of)?;
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

    fn track(&self, folders: &[PathBuf]) -> anyhow::Result<Outcome> {
        let reports =
            { folders.iter() }.map(|folder| TrackReport::read(folder).map_err(BadInput::of));
        match reports.collect::<Result<Vec<_>, _>>()?.as_slice() {
            [report] if self.json => output::line(serde_json::to_string_pretty(report)?)?,
            reports if self.json => output::line(serde_json::to_string_pretty(reports)?)?,
            reports => output::text(TrackTable(reports))?,
        }
        Ok(Outcome::Done)
    }

    fn compare(&self, folders: &[PathBuf]) -> anyhow::Result<Outcome> {
        if self.json {
            let reports = folders.iter().map(|folder| RunReport::read(folder));
            let reports = reports
                .collect::<Result<Vec<_>, _>>()
                .map_err(BadInput::of)?;
            output::line(serde_json::to_string_pretty(&reports)?)?;
        } else {
            output::text(Comparison::read(folders).map_err(BadInput::of)?)?;
        }
        Ok(Outcome::Done)
    }
}
