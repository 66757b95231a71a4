//! One file per sub-command: its arguments and its `run`.

pub(crate) mod convert;
pub(crate) mod export;
pub(crate) mod inspect;
pub(crate) mod link;
pub(crate) mod record;
pub(crate) mod recover;
pub(crate) mod stream;
pub(crate) mod synth;

use anyhow::Context;
use bus::shutdown::Stop;
use bus::{Bus, BusConfig, Configured, ProcessConfig};
use protocol::{CavId, Role, RunId};
use serde::Serialize;
use support::output;

// Without a doc comment, which clap would show as the description of the sub-command.
#[derive(Debug, clap::Args)]
pub(crate) struct ProcessArgs<C: ProcessConfig> {
    #[command(flatten)]
    config: Configured<C>,
    /// Print a JSON summary.
    #[arg(long)]
    json: bool,
}

/// Prints a report as one line of JSON.
fn print_json(report: &impl Serialize) -> anyhow::Result<()> {
    Ok(output::line(serde_json::to_string(report)?)?)
}

/// Joins a run under a name; signals request its stop.
fn join(bus: &BusConfig, run: &RunId, role: Role, name: &CavId) -> anyhow::Result<(Stop, Bus)> {
    let stop = bus.stop().context("installing signal handlers")?;
    let bus = bus.join(&stop, run, role, name)?;
    Ok((stop, bus))
}
