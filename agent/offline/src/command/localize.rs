//! `agent localize`: writes the poses of recorded sweeps to a table.

use std::path::{Path, PathBuf};

use agent_offline::evaluation::estimate_pose;
use dataset::{self, IntensityScale, LeftOut, LoadOptions, Problem, Scenario, findings};
use indicatif::ProgressBar;
use localization::pgc::head_files::encoder_or_named;
use localization::pgc::wrong_place::wrong_place_hint;
use localization::pose_source::{LocalizedPose, PgcConfig, PoseRow, PoseTable};
use perception::inference::Inference;
use perception::int8::InferencePrecision;
use support::output;
use terminal::progress;

use super::scene_heads::{SceneHeadFile, head_of, surfel_map, with_files};
use support::cli::{BadInput, Outcome};
use tch::Device;

/// Localize every sweep of scenes once and write poses and confidences to a table, for training and evaluation.
///
/// Scenarios that are in the table already are skipped, so an interrupted run continues where it stopped.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Data sets, splits or scenarios.
    #[arg(long, value_name = "DIR", num_args = 1.., required = true)]
    dataset: Vec<PathBuf>,
    /// Weights of the encoder, or of a detector that has it [default: those that each head names].
    #[arg(long, value_name = "FILE")]
    encoder: Option<PathBuf>,
    /// Weights of the heads: FILE for all scenes, or MAP=FILE and MAP:SEED=FILE for generated ones [SEED: 0]; FILE may be
    /// the name of a released one (town1, town4).
    #[arg(long, value_name = "[MAP=]FILE|NAME", num_args = 1.., required = true)]
    head: Vec<SceneHeadFile>,
    /// The table.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Surfel map of the place, to which poses are registered, to the millimetre: a file, the folder that `agent map`
    /// wrote, or a released one (town1, town4) [default: none].
    #[arg(long, value_name = "FILE|NAME")]
    surfel_map: Option<PathBuf>,
    /// Number format in which networks are computed.
    #[arg(long, value_enum, default_value_t)]
    precision: InferencePrecision,
    /// Threads to compute with.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: u16,
}

/// Localizes the scenarios that are not in the table yet.
pub(crate) fn run(args: &Args) -> anyhow::Result<Outcome> {
    tch::set_num_threads(i32::from(args.threads));
    let done = match args.out.exists() {
        true => PoseTable::read(&args.out).map_err(BadInput::of)?,
        false => PoseTable::default(),
    };
    let mut scenarios = Vec::new();
    for folder in &args.dataset {
        scenarios.extend(dataset::open(folder).map_err(BadInput::of)?.scenarios);
    }
    scenarios.retain(|scenario| !done.has(&scenario.name));
    // All heads are found before any is computed with.
    let files = with_files(&args.head)?;
    let heads = scenarios.iter().map(|scenario| head_of(&files, scenario));
    let heads: Vec<&Path> = heads.collect::<Result<_, _>>()?;
    let first_head = heads.first().copied();
    let sweeps: usize = scenarios.iter().map(frames).sum();
    if sweeps == 0 && done.is_empty() {
        return Err(BadInput::new(format!("no sweep in {:?}", args.dataset)).into());
    }
    let bar = progress::bar(sweeps, "sweeps");
    let mut found = 0;
    let mut left_out = LeftOut::default();
    left_out.add_findings(findings::sampled(&scenarios, IntensityScale::AUTO));
    for (scenario, head) in scenarios.iter().zip(heads) {
        found += args.localize(scenario, head, &mut left_out, &bar)?;
    }
    bar.finish_and_clear();
    if let (0, 1.., Some(head), Some(scenario)) = (found, sweeps, first_head, scenarios.first()) {
        let map = scenario.generated_map().ok().map(|map| map.to_string());
        output::note(wrong_place_hint(sweeps as u64, head, map.as_deref()));
    }
    output::line(format_args!(
        "{sweeps} sweeps, {found} with a pose; {} were in the table before: {}",
        done.len(),
        args.out.display()
    ))?;
    Ok(left_out.print())
}

impl Args {
    /// Localizes a scenario, vehicle by vehicle in the order of time, and appends it; the number of sweeps with a pose.
    fn localize(
        &self,
        scenario: &Scenario,
        head: &Path,
        left_out: &mut LeftOut,
        bar: &ProgressBar,
    ) -> anyhow::Result<usize> {
        let config = PgcConfig {
            encoder: encoder_or_named(self.encoder.as_deref(), head).map_err(BadInput::of)?,
            head: head.to_owned(),
            surfel_map: surfel_map(self.surfel_map.as_deref())?,
            ..PgcConfig::default()
        };
        let mut rows: Vec<PoseRow<'_>> = Vec::new();
        let inference = Inference::new(Device::Cpu, self.precision);
        for (agent, cav) in scenario.agents.iter().enumerate() {
            let mut source = LocalizedPose::pgc(&config, inference).map_err(BadInput::of)?;
            for tick in (0..scenario.ticks.len()).filter(|&tick| scenario.is_present(agent, tick)) {
                bar.inc(1);
                let frame = match scenario.load(agent, tick, &LoadOptions::default()) {
                    Ok(frame) => frame,
                    Err(error) => {
                        left_out.add_unreadable(agent, Problem::from(&error));
                        continue;
                    }
                };
                rows.push(PoseRow {
                    cav,
                    capture_nanos: frame.capture_nanos,
                    estimate: estimate_pose(&mut source, &frame, None),
                });
            }
        }
        // Appended as a whole: an interrupted scenario is not in the table and is done again.
        PoseTable::append(&self.out, &scenario.name, &rows)?;
        let poses = rows.iter().map(|row| row.estimate.world_from_cav());
        Ok(poses.flatten().count())
    }
}

/// Number of frames of a scenario.
fn frames(scenario: &Scenario) -> usize {
    scenario.agents.len() * scenario.ticks.len() - scenario.absent_frames()
}
