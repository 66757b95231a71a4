//! `v2vloc bench`: what a frame costs on this machine, in milliseconds and in units.

use std::path::PathBuf;
use std::time::Duration;

use deploy::report::Capacity;
use fusion::Method;
use runner::fleet::Fleet;
use runner::run::capacity::estimate;
use runner::scenario::{FieldOverride, Scenario};
use serde_json::Value;
use support::cli::{BadInput, Outcome};
use support::output;
use terminal::text_table::TextTable;

use super::programs;

/// Measures every stage of an agent's sweep and of an ego's frame, with as many processes at once as compute in a live
/// run. A unit is the time of one 3x3 convolution from 64 to 64 channels on 96 x 128 in 32 bits, on one thread that is
/// held to AVX2: figures in units compare between machines.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// The scenario; deploy/scenarios holds commented samples.
    scenario: PathBuf,
    /// Data set, split or scenario in place of the scenario's.
    #[arg(long, value_name = "DIR")]
    dataset: Option<PathBuf>,
    /// Fusion methods in place of the scenario's.
    #[arg(long, value_name = "NAME", num_args = 1.., value_delimiter = ',')]
    method: Vec<Method>,
    /// Another value for a field of the scenario, by its path. May be repeated.
    #[arg(long, value_name = "FIELD=VALUE")]
    set: Vec<FieldOverride>,
    /// Seconds of computing for each method.
    #[arg(long, value_name = "S", default_value_t = 5)]
    seconds: u64,
    /// Print JSON instead of tables.
    #[arg(long)]
    json: bool,
}

impl Arguments {
    /// Measures and prints.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        let mut scenario = Scenario::read_with(&self.scenario, &self.set).map_err(BadInput::of)?;
        if let Some(dataset) = &self.dataset {
            scenario.scene.dir = std::path::absolute(dataset)?;
        }
        let methods = match self.method.as_slice() {
            [] => vec![scenario.method],
            named => named.to_vec(),
        };
        let mut all = Vec::new();
        for method in methods {
            scenario.method = method;
            scenario.check(&self.scenario).map_err(BadInput::of)?;
            let fleet = Fleet::plan(&scenario).map_err(BadInput::of)?;
            let budget = Duration::from_secs(self.seconds);
            let capacity = estimate(&fleet, &programs()?, budget)?.ok_or_else(|| {
                BadInput::new("a scenario without a pace of its own on the CPU cannot be measured")
            })?;
            if !self.json {
                print(&capacity, all.is_empty())?;
            }
            all.push(in_json(&capacity)?);
        }
        if self.json {
            output::line(serde_json::to_string_pretty(&all)?)?;
        }
        Ok(Outcome::Done)
    }
}

/// Costs of a method in milliseconds, and those of agent, ego and frame in units.
fn in_json(capacity: &Capacity) -> anyhow::Result<Value> {
    let mut costs = serde_json::to_value(capacity)?;
    for (name, ms) in [
        ("agent_units", capacity.agent_ms),
        ("ego_units", capacity.fuse_ms),
        ("frame_units", capacity.needed_ms),
    ] {
        costs[name] = (ms / capacity.unit_ms).into();
    }
    Ok(costs)
}

/// Prints the costs of a method, the first one under the machine.
fn print(capacity: &Capacity, is_first: bool) -> anyhow::Result<()> {
    let machine = &capacity.machine;
    if is_first {
        output::line(format_args!(
            "machine  {} cores, {}; a unit takes {:.1} ms\n",
            machine.cores, machine.instructions, capacity.unit_ms
        ))?;
    }
    let mut table = TextTable::of(&[capacity.method.as_str(), "stage"], &["ms", "units"]);
    let vehicles = format!("frame of {} vehicles", capacity.vehicles);
    let mut rows = Vec::new();
    // The sums are means over all processes, the stages are those of the first one alone.
    let sums = [("agent", capacity.agent_ms), ("ego", capacity.fuse_ms)];
    for ((part, sum), stages) in sums.into_iter().zip(&capacity.stages) {
        rows.extend(stages.iter().map(|(stage, ms)| (part, stage.as_str(), *ms)));
        rows.push((part, "all", sum));
    }
    rows.push(("messages", "all, expected", capacity.messages_ms));
    rows.push((vehicles.as_str(), "all", capacity.needed_ms));
    for (part, stage, ms) in rows {
        let units = ms / capacity.unit_ms;
        table.row([
            part.into(),
            stage.into(),
            format!("{ms:.1}"),
            format!("{units:.2}"),
        ]);
    }
    output::text(format_args!("{table}\n"))?;
    Ok(())
}
