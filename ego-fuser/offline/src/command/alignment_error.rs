//! `ego-fuser alignment-error`: the part of pose offsets that a method's own alignment leaves.

use std::path::PathBuf;

use anyhow::Result;
use dataset::LeftOut;
use ego_fuser_offline::alignment_error::{AlignmentError, AlignmentMeter, Offset};
use perception::weights::Weights;
use support::output;
use terminal::text_table::{Side, TextTable};

use super::{DataSets, print_left_out, rows_with_provenance};
use support::cli::{BadInput, Outcome};

/// Add offsets to the true poses of neighbours and measure the part that the method's own alignment corrects.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    data: DataSets,
    /// Weights of a method that aligns maps itself, such as pastat.
    #[arg(long, value_name = "FILE")]
    weights: PathBuf,
    /// Distances, metres.
    #[arg(long, value_delimiter = ',', default_value = "0,0.5,1,2")]
    shifts_m: Vec<f64>,
    /// Angles, degrees.
    #[arg(long, value_delimiter = ',', default_value = "1,2")]
    turns_deg: Vec<f64>,
    /// Take every N-th tick of each scenario.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    every: u32,
    /// Seed of the directions.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

impl Arguments {
    /// Measures and prints a line per offset.
    pub(crate) fn run(self) -> Result<Outcome> {
        tch::set_num_threads(1);
        let mut values = self.shifts_m.iter().chain(&self.turns_deg);
        if !values.all(|value| (0.0..=100.0).contains(value)) {
            return Err(BadInput::new("--shifts-m and --turns-deg are 0 to 100").into());
        }
        let shifts = self.shifts_m.iter().map(|&shift_m| (shift_m, 0.0));
        let turns = self.turns_deg.iter().map(|&turn_deg| (0.0, turn_deg));
        let offsets: Vec<Offset> = shifts
            .chain(turns)
            .map(|(shift_m, turn_deg)| Offset { shift_m, turn_deg })
            .collect();
        let weights = Weights::load(&self.weights).map_err(BadInput::of)?;
        let mut meter = AlignmentMeter::load(&weights).map_err(BadInput::of)?;
        let mut left_out = LeftOut::default();
        let scenarios = self.data.arranged(&mut left_out)?;
        let every = self.every as usize;
        let found = meter.measure(&scenarios, every, &offsets, self.seed, &mut left_out)?;
        if self.json {
            let weights = [self.weights.clone()];
            let scenarios = scenarios.iter().map(|(scenario, _)| scenario);
            output::line(rows_with_provenance(&found, scenarios, weights)?)?;
        } else {
            output::text(table(&found))?;
        }
        Ok(print_left_out(&left_out))
    }
}

fn table(found: &[AlignmentError]) -> TextTable {
    let mut table = TextTable::new([
        ("offset", Side::Left),
        ("pairs", Side::Right),
        ("mean m before/after", Side::Right),
        ("median m before/after", Side::Right),
        ("mean degrees before/after", Side::Right),
    ]);
    for summary in found {
        let Offset { shift_m, turn_deg } = summary.offset;
        let [mean, median, angle] = [summary.mean_m, summary.p50_m, summary.mean_deg]
            .map(|[before, after]| format!("{before:.3} / {after:.3}"));
        table.row([
            format!("{shift_m} m {turn_deg} deg"),
            summary.pairs.to_string(),
            mean,
            median,
            angle,
        ]);
    }
    table
}
