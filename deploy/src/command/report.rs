//! `v2vloc report`.

use std::path::{Path, PathBuf};

use crate::operate::status::RunStatus;
use crate::report::{Comparison, RunReport, TrackReport, distinguish, track_table};
use serde::Serialize;
use support::cli::{BadInput, Outcome};
use support::file_error::Result;
use support::output;

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
        let folders = runs.map(|run| RunStatus::folder(run, &self.runs));
        let folders = folders.collect::<Result<Vec<_>, _>>()?;
        if self.tracks {
            let mut reports = read(&folders, TrackReport::read)?;
            let names = reports.iter_mut().map(|report| &mut report.run);
            distinguish(&mut Vec::from_iter(names), &folders);
            match self.json {
                true => print_json(&reports)?,
                false => output::text(track_table(&reports))?,
            }
            let is_lossy = reports.iter().any(TrackReport::has_left_out_ticks);
            return Ok(Outcome::of(is_lossy));
        }
        match (self.json, &folders[..]) {
            (true, folders) => print_json(&read(folders, RunReport::read)?)?,
            (false, [folder]) => {
                let report = RunReport::read(folder).map_err(BadInput::of)?;
                output::text(format_args!(
                    "run       {}, {} with {} poses, {} clock\n{report}",
                    report.run, report.method, report.pose_source, report.clock
                ))?;
            }
            (false, several) => {
                output::text(Comparison::read(several).map_err(BadInput::of)?)?;
            }
        }
        Ok(Outcome::Done)
    }
}

/// Reads the reports of some runs.
fn read<T>(folders: &[PathBuf], read: impl Fn(&Path) -> Result<T>) -> Result<Vec<T>, BadInput> {
    let reports = folders.iter().map(|folder| read(folder));
    reports.collect::<Result<_, _>>().map_err(BadInput::of)
}

/// Prints a report, or a list of several.
fn print_json(reports: &[impl Serialize]) -> anyhow::Result<()> {
    match reports {
        [report] => output::line(serde_json::to_string_pretty(report)?)?,
        several => output::line(serde_json::to_string_pretty(several)?)?,
    }
    Ok(())
}
