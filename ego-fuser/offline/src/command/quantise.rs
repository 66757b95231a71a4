//! `ego-fuser quantise`: scales of activations for 8-bit inference, stored in the weights file.

use std::path::PathBuf;

use anyhow::Result;
use dataset::LeftOut;
use ego_fuser_offline::scale_search::search_scales;
use perception::int8::SCALES_KEY;
use perception::weights::annotate;
use support::cli::{BadInput, Outcome};
use support::output;

use super::DataSets;

/// Search the scales of activations on a few training sweeps and store them in the weights files, which are then
/// computed in 8-bit integers.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Weights files; their parameters stay as they are.
    #[arg(required = true, value_name = "FILE")]
    weights: Vec<PathBuf>,
    #[command(flatten)]
    data: DataSets,
    /// Number of frames of each scenario.
    #[arg(long, value_name = "N", default_value_t = 5)]
    frames: usize,
}

impl Arguments {
    /// Searches, stores and prints a line per file.
    pub(crate) fn run(self) -> Result<Outcome> {
        tch::set_num_threads(1);
        let mut unused = LeftOut::default();
        let scenarios = self.data.scenarios(&mut unused)?;
        if scenarios.iter().all(|scenario| scenario.ticks.is_empty()) || self.frames == 0 {
            let reason = "--dataset and --frames: no frame to search scales on";
            return Err(BadInput::new(reason).into());
        }
        let mut left_out = unused.clone();
        for path in &self.weights {
            let file = path.display();
            // The same sweeps for every file.
            left_out = unused.clone();
            let scales = search_scales(path, &scenarios, self.frames, &mut left_out)
                .map_err(BadInput::of)?;
            if scales.is_empty() {
                output::line(format_args!("{file}: no layer can be quantised, unchanged"))?;
                continue;
            }
            let sha256 = annotate(path, SCALES_KEY, &serde_json::to_string(&scales)?)
                .map_err(BadInput::of)?;
            let count = scales.len();
            output::line(format_args!(
                "{file}: {count} activations, SHA-256 {sha256}"
            ))?;
        }
        Ok(left_out.print())
    }
}
