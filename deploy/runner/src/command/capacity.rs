//! `v2vloc capacity`: what the pace of a run is estimated from, measured for the process that runs it.

use std::io::{self, Read};
use std::time::Duration;

use anyhow::Context;
use runner::fleet::Fleet;
use runner::run::capacity::measure;
use runner::run::machine::unit_ms;
use runner::scenario::Scenario;
use support::cli::{BadInput, Outcome};
use support::output;

/// Largest scenario that is read, bytes.
const MAX_BYTES: u64 = 1 << 20;

/// Reads a scenario as JSON from standard input and prints what was measured as JSON.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Print the unit of compute times instead, milliseconds; no scenario is read.
    #[arg(long)]
    unit: bool,
    /// Time for computing frames, milliseconds.
    #[arg(long, value_name = "MS", default_value_t = 600)]
    budget_ms: u64,
}

impl Arguments {
    /// Measures and prints.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        if self.unit {
            output::line(serde_json::to_string(&unit_ms())?)?;
            return Ok(Outcome::Done);
        }
        let scenario: Scenario =
            serde_json::from_reader(io::stdin().lock().take(MAX_BYTES)).context("scenario")?;
        let fleet = Fleet::plan(&scenario).map_err(BadInput::of)?;
        let measured = measure(&fleet, Duration::from_millis(self.budget_ms))?;
        output::line(serde_json::to_string(&measured)?)?;
        Ok(Outcome::Done)
    }
}
