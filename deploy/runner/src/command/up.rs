//! `v2vloc up`.

use std::path::PathBuf;

use dataset::evaluation_protocol::fewer;
use fusion::Method;
use protocol::RunId;
use runner::experiment::report;
use runner::experiment::without_effect::without_effect;
use runner::run::run_fleet::{RunOptions, run_scenario};
use runner::scenario::{FieldOverride, Scenario};
use support::output;

use super::programs;
use support::cli::{BadInput, Outcome};

#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// The scenario; deploy/scenarios holds commented samples.
    scenario: PathBuf,
    /// Name of the run, 1 to 32 characters of a-z, 0-9, '_' and '-' [default: the scenario's, else the time].
    #[arg(long)]
    name: Option<RunId>,
    /// Folder of the run folders.
    #[arg(long, default_value = "runs")]
    runs: PathBuf,
    /// Data set, split or scenario in place of the scenario's.
    #[arg(long, value_name = "DIR")]
    dataset: Option<PathBuf>,
    /// Fusion method in place of the scenario's, one of `ego-fuser methods`.
    #[arg(long)]
    method: Option<Method>,
    /// Number of frames to play in place of the scenario's.
    #[arg(long)]
    frames: Option<usize>,
    /// Seconds of the scene per second in place of the scenario's: below 1 slower, for machines that do not keep up.
    #[arg(long, value_name = "TIMES")]
    rate: Option<f64>,
    /// Another value for a field of the scenario, by its path: scene.lockstep=true, agents.codec.dtype=i8. May be
    /// repeated.
    #[arg(long, value_name = "FIELD=VALUE")]
    set: Vec<FieldOverride>,
    /// Record all messages in recording.mcap in the run folder; the scenario may exclude some.
    #[arg(long)]
    record: bool,
    /// Serve counters and times to Prometheus: the scorer at this address, the other processes on the ports that
    /// follow.
    #[arg(long, value_name = "HOST:PORT")]
    metrics: Option<std::net::SocketAddr>,
    /// Print metrics.json instead of a table.
    #[arg(long)]
    json: bool,
}

impl Arguments {
    /// Runs the scenario and prints the result.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        let scenario = Scenario::read_with(&self.scenario, &self.set);
        let mut scenario = scenario.map_err(BadInput::of)?;
        if let Some(dataset) = self.dataset {
            scenario.scene.dir = std::path::absolute(dataset)?;
        }
        scenario.run = self.name.or(scenario.run);
        scenario.method = self.method.unwrap_or(scenario.method);
        scenario.scene.frames = self.frames.or(scenario.scene.frames);
        scenario.scene.rate = self.rate.unwrap_or(scenario.scene.rate);
        if self.record {
            scenario.record.get_or_insert_default();
        }
        scenario.network.metrics = self.metrics.or(scenario.network.metrics);
        // Only now: options may fill in or replace what the file says.
        scenario.check(&self.scenario).map_err(BadInput::of)?;
        let options = RunOptions {
            runs: self.runs,
            programs: programs()?,
            prefix: "up",
        };
        without_effect(&scenario).into_iter().for_each(output::note);
        let result = run_scenario(&scenario, &options)?;
        let is_whole = !scenario.scene.repeat && !result.interrupted;
        let asked = scenario.scene.frames.filter(|_| is_whole);
        let fewer = fewer("frames", result.metrics.ticks as usize, asked);
        fewer.into_iter().for_each(output::note);
        if self.json {
            output::line(serde_json::to_string_pretty(&result.metrics)?)?;
        } else {
            output::text(report::run_table(&result))?;
        }
        if let Some(pose) = scenario.poses().first() {
            report::print_unlocated(&result.metrics, pose, &scenario.scene.dir);
        }
        report::print_loss(&result, false);
        Ok(Outcome::of(result.lost_data()))
    }
}
