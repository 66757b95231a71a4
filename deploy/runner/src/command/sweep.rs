//! `v2vloc sweep`.

use std::fs;
use std::path::PathBuf;

use figures::FigureError;
use runner::experiment::sweep::{self, ExperimentSweep, WorkerError};
use support::output;

use super::left_out;
use super::slices::SliceArgs;
use support::cli::{BadInput, Outcome};

#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// The experiment; deploy/experiments holds ready ones.
    experiment: PathBuf,
    /// Folder of the results; runs that it holds already are not repeated [default: sweeps/NAME].
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Number of compute processes, each with one thread. The results do not depend on it.
    #[arg(long, default_value_t = 1, conflicts_with = "print", value_parser = clap::value_parser!(u16).range(1..=256))]
    jobs: u16,
    /// Only print the number of runs, and the time that they will take where the data set exists; nothing is written.
    #[arg(long, conflicts_with_all = ["slice", "print"])]
    dry_run: bool,
    /// Keep the feature maps of all sweeps after the last run: a grid that is extended later needs no encoding again.
    #[arg(long, conflicts_with_all = ["dry_run", "slice", "print"])]
    keep_feature_maps: bool,
    #[command(flatten)]
    slices: SliceArgs,
    /// Print the settings and metrics of every run as JSON instead of a table.
    #[arg(long, conflicts_with_all = ["dry_run", "slice", "print"])]
    json: bool,
    /// Compute the runs whose numbers come on standard input, for another sweep.
    #[arg(long, hide = true)]
    worker: bool,
}

impl Arguments {
    /// Runs the experiment and prints its table.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        // One thread for each process: parallel work comes from --jobs alone.
        tch::set_num_threads(1);
        let name = sweep::read(&self.experiment).map_err(BadInput::of)?.name;
        let out = self
            .out
            .unwrap_or_else(|| PathBuf::from("sweeps").join(&name));
        let (file, folder) = (self.experiment.to_string_lossy(), out.to_string_lossy());
        let command = ["v2vloc", "sweep", &*file, "--out", &*folder];
        let result = out.join(format!("{name}.csv"));
        if let Some(text) = self.slices.engine_file(&command, &result) {
            output::text(&text)?;
            return Ok(Outcome::Done);
        }
        let jobs = usize::from(self.jobs);
        if self.dry_run {
            ExperimentSweep::announce(&self.experiment, &out, jobs).map_err(BadInput::of)?;
            return Ok(Outcome::Done);
        }
        let sweep = ExperimentSweep::open(&self.experiment, &out).map_err(BadInput::of)?;
        // Before the slice: a worker of a Slurm task inherits the variables of its array.
        if self.worker {
            sweep.work()?;
            return Ok(Outcome::Done);
        }
        if let Some(slice) = self.slices.slice()? {
            sweep.run_slice(slice, jobs).map_err(blamed)?;
            output::note(format_args!(
                "slice {slice} is computed; without --slice, this command writes the table"
            ));
            // The last command names what was left out: an engine takes a slice with another exit code as failed.
            return Ok(Outcome::Done);
        }
        let (table, runs) = sweep.run(jobs, self.keep_feature_maps).map_err(blamed)?;
        match self.json {
            true => output::line(serde_json::to_string_pretty(&runs)?)?,
            false => output::text(&table)?,
        }
        // Prints how much space the feature maps take.
        let maps = out.join("maps");
        let files = fs::read_dir(&maps).into_iter().flatten().flatten();
        let sizes = files.filter_map(|file| Some(file.metadata().ok()?.len()));
        let bytes: u64 = sizes.sum();
        if bytes > 0 {
            let (megabytes, folder) = (bytes as f64 / 1e6, maps.display());
            output::note(format_args!(
                "{megabytes:.1} MB of feature maps in {folder}"
            ));
        }
        output::note(format_args!("all columns and the report: {folder}"));
        Ok(left_out(runs.iter().map(|run| &run.cell.metrics.left_out)))
    }
}

/// An error of the input, unless a worker or a drawing has failed.
fn blamed(error: anyhow::Error) -> anyhow::Error {
    match error.is::<WorkerError>() || error.is::<FigureError>() {
        true => error,
        false => BadInput::of(error).into(),
    }
}
