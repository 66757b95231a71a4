//! `v2vloc capacity`: estimate of the pace of a run, for the process that runs it.

use std::io::{self, Read};

use anyhow::Context;
use runner::fleet::Fleet;
use runner::run::capacity::estimate;
use runner::scenario::Scenario;
use support::cli::{BadInput, Outcome};
use support::output;

/// Largest scenario that is read, bytes.
const MAX_BYTES: u64 = 1 << 20;

/// Reads a scenario as JSON from standard input and prints the estimate as JSON; null if there is none.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {}

impl Arguments {
    /// Estimates and prints.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        let scenario: Scenario =
            serde_json::from_reader(io::stdin().lock().take(MAX_BYTES)).context("scenario")?;
        let fleet = Fleet::plan(&scenario).map_err(BadInput::of)?;
        let capacity = estimate(&fleet)?;
        output::line(serde_json::to_string(&capacity)?)?;
        Ok(Outcome::Done)
    }
}
