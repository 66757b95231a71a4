//! Subcommands that read data sets: one file each, with its arguments and the call into the library.

mod align;
mod alignment_error;
mod eval;
mod quantise;
mod train;

use std::path::PathBuf;

use anyhow::Context;
use bus::malloc_settings;
use dataset::evaluation_protocol::ProtocolConfig;
use dataset::{self, Dataset, IntensityOption, LeftOut, OpenOptions, Scenario, findings};
use serde::Serialize;
use serde_json::json;
use support::cli::{BadInput, Outcome};
use support::output;

/// Subcommands of `ego-fuser` that read data sets.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Compare alignment methods of two vehicles without GNSS.
    Align(Box<align::Arguments>),
    /// Measure AP on recorded scenes.
    Eval(eval::Arguments),
    /// Measure the part of pose offsets that a method's own alignment leaves.
    AlignmentError(alignment_error::Arguments),
    /// Prepare weights for 8-bit inference.
    Quantise(quantise::Arguments),
    /// Train a method on scenes.
    Train(Box<train::Arguments>),
}

/// Data sets of a command.
#[derive(Debug, clap::Args)]
struct DataSets {
    /// Datasets, splits or scenarios; the first vehicle of each scenario is the ego.
    #[arg(long = "dataset", required = true, num_args = 1.., value_name = "DIR")]
    data: Vec<PathBuf>,
    #[command(flatten)]
    intensity: IntensityOption,
}

impl Command {
    /// Runs it.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        malloc_settings::ensure(&malloc_settings::KEPT_MEMORY)
            .context("restarting with malloc settings")?;
        match self {
            Self::Align(arguments) => arguments.run(),
            Self::Eval(arguments) => arguments.run(),
            Self::AlignmentError(arguments) => arguments.run(),
            Self::Quantise(arguments) => arguments.run(),
            Self::Train(arguments) => arguments.run().map(|()| Outcome::Done),
        }
    }
}

/// All scenarios of some datasets.
impl DataSets {
    fn options(&self) -> OpenOptions {
        OpenOptions::with_intensity_scale(self.intensity.scale)
    }

    /// Each of them, with what is unused or implausible in it; also by the protocol, if that is asked for.
    fn open(
        &self,
        left_out: &mut LeftOut,
        protocol: Option<&ProtocolConfig>,
    ) -> Result<Vec<Dataset>, BadInput> {
        let mut all = Vec::with_capacity(self.data.len());
        for folder in &self.data {
            let opened = dataset::open_with(folder, &self.options()).map_err(BadInput::of)?;
            left_out.add_files(&opened.problems);
            let protocol = protocol.map(|protocol| protocol.resolve(opened.layout));
            let protocol = protocol.transpose().map_err(BadInput::new)?;
            let (scale, rule) = (self.intensity.scale, protocol.map(|it| it.ground_truth));
            left_out.add_findings(findings::sampled(&opened.scenarios, scale, rule.as_ref()));
            all.push(opened);
        }
        Ok(all)
    }

    fn scenarios(&self, left_out: &mut LeftOut) -> Result<Vec<Scenario>, BadInput> {
        let all = self.open(left_out, None)?;
        Ok(all.into_iter().flat_map(|data| data.scenarios).collect())
    }
}

/// Rows of a result as JSON, each with command and digests of what the result was made from.
fn rows_with_provenance<'a>(
    rows: &impl Serialize,
    scenarios: impl IntoIterator<Item = &'a Scenario>,
    files: impl IntoIterator<Item = PathBuf>,
) -> anyhow::Result<String> {
    let provenance = dataset::provenance(scenarios, files, env!("V2VLOC_COMMIT"))?;
    let mut rows = json!(rows);
    for row in rows.as_array_mut().into_iter().flatten() {
        row["provenance"] = json!(provenance);
    }
    Ok(serde_json::to_string_pretty(&rows)?)
}

/// Prints the findings, and their counts where data are missing.
fn print_left_out(left_out: &LeftOut) -> Outcome {
    let outcome = left_out.print();
    if outcome == Outcome::DataLost {
        output::note(left_out);
    }
    outcome
}
