//! `v2vloc demo`.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::Context;
use deploy::operate::run_folder::name_of_now;
use deploy::view::show_recorded;
use fusion::Method;
use protocol::RunId;
use runner::experiment::report;
use runner::run::run_fleet::{RunOptions, RunResult, run_scenario};
use runner::scenario::Scenario;
use simulator::generate::{self, Subset, SynthError, SynthOptions};
use support::{output, shared_files};
use terminal::progress;

use super::programs;
use support::cli::{BadInput, Interrupted, Outcome};

/// Seeds from here on are never trained with.
const SEED: u64 = 1000;
/// The scenario of the demo, among the files that come with the programs.
const SCENARIO: &str = "scenarios/demo.yaml";

#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// The scenario to run on the generated scene [default: demo.yaml, which comes with the programs].
    #[arg(long, value_name = "FILE")]
    scenario: Option<PathBuf>,
    /// Folder of the generated scenes; an existing scene is used again.
    #[arg(long, value_name = "DIR", default_value = "scenes")]
    scenes_dir: PathBuf,
    /// Folder of the run folders.
    #[arg(long, default_value = "runs")]
    runs: PathBuf,
    /// Name of the run [default: the time]. With several methods each appends its own.
    #[arg(long)]
    name: Option<RunId>,
    /// Seed of the scene; below 1000 are scenes that the detector may have been trained with.
    #[arg(long, default_value_t = SEED)]
    seed: u64,
    /// Frames of the scene, at 10 Hz.
    #[arg(long, default_value_t = 60)]
    frames: usize,
    /// Vehicles that connect, 2 to 4.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u8).range(2..=4))]
    vehicles: u8,
    /// Fusion methods, one run each.
    #[arg(long, value_name = "NAME", num_args = 1.., value_delimiter = ',', default_value = "none,late,max,pastat")]
    method: Vec<Method>,
    /// Seconds of the scene per second: below 1 slower, for machines that do not keep up.
    #[arg(long, value_name = "TIMES", default_value_t = 1.0)]
    rate: f64,
    /// Record the last method's run and show it in a browser afterwards, until Ctrl-C.
    #[arg(long)]
    view: bool,
    /// Address of the page (--view).
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:8088")]
    #[arg(requires = "view")]
    page: SocketAddr,
    /// Print the metrics of the last method's run as JSON instead of a table of all.
    #[arg(long)]
    json: bool,
}

impl Arguments {
    /// Generates the scene, runs the methods and prints their metrics.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        let file = self.scenario()?;
        let mut scenario = Scenario::read(&file).map_err(BadInput::of)?;
        scenario.scene.dir = self.scene()?;
        scenario.scene.rate = self.rate;
        let name = self.name.clone().unwrap_or_else(|| name_of_now("demo"));
        let mut results = Vec::new();
        for &method in &self.method {
            scenario.method = method;
            scenario.run = Some(RunId::new(&format!("{name}-{method}")).map_err(BadInput::of)?);
            // Only the last run is shown, so only that one needs a recording.
            if self.view && Some(&method) == self.method.last() {
                scenario.record.get_or_insert_default();
            }
            scenario.check(&file).map_err(BadInput::of)?;
            let options = RunOptions {
                runs: self.runs.clone(),
                programs: programs()?,
                prefix: "demo",
            };
            let result =
                run_scenario(&scenario, &options).with_context(|| format!("method {method}"))?;
            if !self.json {
                output::line(report::run_report(&result))?;
            }
            let interrupted = result.interrupted;
            results.push(result);
            if interrupted {
                break;
            }
        }
        self.print(&results)?;
        for result in &results {
            report::print_loss(result, results.len() > 1);
        }
        if let Some(last) = results.last().filter(|last| self.view && !last.interrupted) {
            show_recorded(&last.folder.file("recording.mcap"), self.page)?;
        }
        match self.method.get(results.len()..) {
            None | Some([]) => Ok(Outcome::of(results.iter().any(RunResult::lost_data))),
            Some(left) => {
                let left: Vec<&str> = left.iter().map(|method| method.name()).collect();
                let text = format!("ended on request; not run: {}", left.join(", "));
                Err(anyhow::Error::from(Interrupted).context(text))
            }
        }
    }

    fn scenario(&self) -> Result<PathBuf, BadInput> {
        self.scenario
            .clone()
            .or_else(|| shared_files::shared(SCENARIO).into_iter().next())
            .ok_or_else(|| {
                BadInput::new(format!(
                    "{SCENARIO} is not beside the programs: name a file by --scenario"
                ))
            })
    }

    /// Folder of the scene, which is generated if it does not exist.
    fn scene(&self) -> anyhow::Result<PathBuf> {
        let scenes = std::path::absolute(&self.scenes_dir)?;
        let name = format!("v2vdet-{}-{}x{}", self.seed, self.vehicles, self.frames);
        let folder = scenes.join(&name);
        let vehicles = usize::from(self.vehicles);
        let options = SynthOptions {
            frames: self.frames,
            agents: vehicles..=vehicles,
            ..SynthOptions::new(Subset::V2vdet, self.seed, folder.clone())
        };
        if generate::are_kept(&options).map_err(BadInput::of)? {
            return Ok(folder);
        }
        output::note(format_args!(
            "generating {} frames of {} vehicles (seed {}) into {}",
            self.frames,
            self.vehicles,
            self.seed,
            folder.display()
        ));
        let began = Instant::now();
        generate(&options)?;
        let seconds = began.elapsed().as_secs_f64();
        output::note(format_args!("generated in {seconds:.1} s"));
        Ok(folder)
    }

    fn print(&self, results: &[RunResult]) -> anyhow::Result<()> {
        let Some(last) = results.last() else {
            return Ok(());
        };
        if self.json {
            output::line(serde_json::to_string_pretty(&last.metrics)?)?;
            return Ok(());
        }
        let metrics = results.iter().map(|result| result.metrics.clone());
        output::text(report::table(&Vec::from_iter(metrics)))?;
        output::text(report::run_notes(last))?;
        Ok(())
    }
}

/// Generates a scene with a progress bar.
fn generate(options: &SynthOptions) -> anyhow::Result<()> {
    let bar = progress::percent_bar(options.scenes);
    let generated = generate::generate_whole(options, &|thousandths| bar.set_position(thousandths));
    bar.finish_and_clear();
    match generated {
        Ok(_) => Ok(()),
        Err(error @ (SynthError::Write(_) | SynthError::TooFewCompanions { .. })) => {
            Err(error.into())
        }
        Err(error) => Err(BadInput::of(error).into()),
    }
}
