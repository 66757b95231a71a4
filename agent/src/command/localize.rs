//! `agent localize`: the poses of recorded sweeps, found once and kept.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use agent::pose_source::sanity::SanityConfig;
use agent::pose_source::{LocalizedPose, PgcConfig, PoseInput, PoseRow, PoseSource, PoseTable};
use anyhow::Context;
use indicatif::{ProgressBar, ProgressStyle};
use protocol::PoseEstimate;
use serde::Deserialize;
use sim_replay::dataset::{self, LoadOptions, Scenario};

use crate::cli::BadInput;

/// Localise every sweep of scenes once and write poses and confidences as a table, for trainings and evaluations.
///
/// Scenarios that the table has already are left alone, so an interrupted run goes on where it was.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Data sets, splits or scenarios.
    #[arg(long, value_name = "DIR", num_args = 1.., required = true)]
    scene: Vec<PathBuf>,
    /// Weights of the encoder.
    #[arg(long, value_name = "FILE")]
    encoder: PathBuf,
    /// Weights of the heads: FILE for all scenes, or TOWN=FILE and TOWN:SEED=FILE for generated ones [SEED: 0].
    #[arg(long, value_name = "[TOWN=]FILE", num_args = 1.., required = true)]
    head: Vec<TownHead>,
    /// The table.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Threads to compute with.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: u16,
}

/// A generated town: the name of its map and the seed of all that stands on it.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
struct Town {
    #[serde(rename = "town")]
    name: String,
    town_seed: u64,
}

/// Weights, and the town they are of.
#[derive(Debug, Clone, PartialEq, Eq)]
struct TownHead {
    town: Option<Town>,
    weights: PathBuf,
}

impl FromStr for TownHead {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let Some((town, weights)) = text.split_once('=') else {
            return Ok(Self { town: None, weights: text.into() });
        };
        let (name, seed) = town.split_once(':').unwrap_or((town, "0"));
        let town_seed = seed.parse().map_err(|_| format!("{seed:?} is no seed of a town"))?;
        Ok(Self { town: Some(Town { name: name.to_owned(), town_seed }), weights: weights.into() })
    }
}

/// The part of `data_protocol.yaml` that tells the town.
#[derive(Debug, Deserialize)]
struct ProtocolFile {
    generator: Town,
}

/// Localises what the table does not have yet.
pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    tch::set_num_threads(i32::from(args.threads));
    let done = if args.out.exists() { PoseTable::read(&args.out).map_err(bad)? } else { PoseTable::default() };
    let mut scenarios = Vec::new();
    for folder in &args.scene {
        scenarios.extend(dataset::open(folder).map_err(bad)?.scenarios);
    }
    scenarios.retain(|scenario| !done.has(&scenario.name));
    // Which head each needs is known before any is computed with.
    let heads: Vec<&Path> = scenarios.iter().map(|scenario| args.head_of(scenario)).collect::<anyhow::Result<_>>()?;
    let sweeps: usize = scenarios.iter().map(|scenario| scenario.agents.len() * scenario.ticks.len()).sum();
    let bar = ProgressBar::new(sweeps as u64)
        .with_style(ProgressStyle::with_template("{bar:30} {pos}/{len} sweeps  {eta} left")?);
    let mut found = 0;
    for (scenario, head) in scenarios.iter().zip(heads) {
        found += args.localize(scenario, head, &bar)?;
    }
    bar.finish_and_clear();
    println!("{sweeps} sweeps, {found} with a pose; {} were there before: {}", done.len(), args.out.display());
    Ok(())
}

impl Args {
    fn head_of(&self, scenario: &Scenario) -> anyhow::Result<&Path> {
        if let Some(head) = self.head.iter().find(|head| head.town.is_none()) {
            return Ok(&head.weights);
        }
        let town = town_of(scenario).with_context(|| format!("the town of scenario {}", scenario.name)).map_err(bad)?;
        let head = self.head.iter().find(|head| head.town.as_ref() == Some(&town));
        let Town { name, town_seed } = &town;
        let missing = || bad(anyhow::anyhow!("{}: no --head for town {name}:{town_seed}", scenario.name));
        Ok(&head.ok_or_else(missing)?.weights)
    }

    /// Localises a scenario, vehicle by vehicle in the order of time, and appends it; how many sweeps have a pose.
    fn localize(&self, scenario: &Scenario, head: &Path, bar: &ProgressBar) -> anyhow::Result<usize> {
        let sanity = SanityConfig::default();
        let config = PgcConfig { encoder: self.encoder.clone(), head: head.to_owned(), sanity };
        let mut rows: Vec<PoseRow<'_>> = Vec::new();
        for (agent, cav) in scenario.agents.iter().enumerate() {
            let mut source = LocalizedPose::pgc(&config).map_err(bad)?;
            for tick in 0..scenario.ticks.len() {
                let frame = scenario.load(agent, tick, &LoadOptions::default()).map_err(bad)?;
                let capture_nanos = frame.capture_nanos;
                let input = PoseInput { cav, capture_nanos, cloud: &frame.points, measured: None };
                rows.push(PoseRow { cav, capture_nanos, estimate: source.estimate(&input) });
                bar.inc(1);
            }
        }
        PoseTable::append(&self.out, &scenario.name, &rows)?;
        Ok(rows.iter().filter(|row| matches!(row.estimate, PoseEstimate::Pose { .. })).count())
    }
}

/// Reads which generated town a scenario lies in.
fn town_of(scenario: &Scenario) -> anyhow::Result<Town> {
    let points = scenario.points_path(0, 0, None)?;
    let folder = points.ancestors().nth(2).context("it lies in no folder")?;
    let path = folder.join("data_protocol.yaml");
    let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    let file: ProtocolFile = serde_saphyr::from_str(&text).with_context(|| path.display().to_string())?;
    Ok(file.generator)
}

fn bad(error: impl Into<anyhow::Error>) -> anyhow::Error {
    BadInput(error.into()).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heads_are_of_one_town_or_of_all() {
        let town = |name: &str, town_seed| Some(Town { name: name.into(), town_seed });
        for (text, expected) in [("h.st", None), ("town1=h.st", town("town1", 0)), ("town4:3=h.st", town("town4", 3))] {
            let head: TownHead = text.parse().unwrap();
            assert_eq!((head.town, head.weights), (expected, PathBuf::from("h.st")), "{text}");
        }
        assert!("town1:x=h".parse::<TownHead>().unwrap_err().contains('x'));
    }

    #[test]
    fn the_town_of_a_generated_scene_is_read_from_its_protocol() {
        let text = "description: x\ngenerator:\n  name: synth\n  town: 'town4'\n  town_seed: 5\nworld:\n  seed: 1\n";
        let file: ProtocolFile = serde_saphyr::from_str(text).unwrap();
        assert_eq!(file.generator, Town { name: "town4".into(), town_seed: 5 });
    }
}
