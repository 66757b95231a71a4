//! Subcommands that read data sets: one file each, with its arguments and the call into the library.

mod align;
mod alignment_error;
mod eval;
mod quantise;
mod train;

use std::path::PathBuf;

use agent_offline::sweep_database::repeated;
use anyhow::Context;
use bus::malloc_settings;
use dataset::evaluation_protocol::{EvaluationProtocol, ProtocolConfig, lacking};
use dataset::{self, Dataset, IntensityOption, LeftOut, OpenOptions, Scenario, findings};
use serde::Serialize;
use serde_json::json;
use support::cli::{BadInput, Outcome};
use support::output;

/// Subcommands of `ego-fuser` that read data sets.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Compare alignment methods of two vehicles without GNSS.
    Align(Box<align::Arguments>),
    /// Measure AP on recorded scenes.
    Eval(eval::Arguments),
    /// Measure the part of pose offsets that a method's own alignment leaves.
    AlignmentError(alignment_error::Arguments),
    /// Prepare weights for 8-bit inference.
    Quantise(quantise::Arguments),
    /// Train a method on scenes.
    Train(Box<train::Arguments>),
}

/// A data set's evaluation protocol and scenarios.
type EvalSet = (EvaluationProtocol, Vec<Scenario>);

/// Data sets of a command.
#[derive(Debug, clap::Args)]
struct DataSets {
    /// Datasets, splits or scenarios; the first vehicle of each scenario is the ego.
    #[arg(long = "dataset", required = true, num_args = 1.., value_name = "DIR")]
    data: Vec<PathBuf>,
    #[command(flatten)]
    intensity: IntensityOption,
}

impl Command {
    /// Runs it.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        malloc_settings::ensure(&malloc_settings::KEPT_MEMORY)
            .context("restarting with malloc settings")?;
        match self {
            Self::Align(arguments) => arguments.run(),
            Self::Eval(arguments) => arguments.run(),
            Self::AlignmentError(arguments) => arguments.run(),
            Self::Quantise(arguments) => arguments.run(),
            Self::Train(arguments) => arguments.run().map(|()| Outcome::Done),
        }
    }
}

/// All scenarios of some datasets.
impl DataSets {
    fn options(&self) -> OpenOptions {
        OpenOptions::with_intensity_scale(self.intensity.scale)
    }

    /// Each of them, with what is unused or implausible in it; also by the protocol, if that is asked for. A scenario that
    /// is there twice would count twice.
    fn open(
        &self,
        left_out: &mut LeftOut,
        protocol: Option<&ProtocolConfig>,
    ) -> Result<Vec<Dataset>, BadInput> {
        if let Some(reason) = repeated(&self.data).map_err(BadInput::of)? {
            return Err(BadInput::new(reason));
        }
        let mut all = Vec::with_capacity(self.data.len());
        for folder in &self.data {
            let opened = dataset::open_with(folder, &self.options()).map_err(BadInput::of)?;
            left_out.add_files(&opened.problems);
            let protocol = protocol.map(|protocol| protocol.resolve(opened.layout));
            let protocol = protocol.transpose().map_err(BadInput::new)?;
            let (scale, rule) = (self.intensity.scale, protocol.map(|it| it.ground_truth));
            left_out.add_findings(findings::sampled(&opened.scenarios, scale, rule.as_ref()));
            all.push(opened);
        }
        Ok(all)
    }

    /// The data sets as a protocol, or that of their layout, arranges them, with at most `frames` of each scenario. Notes
    /// numbers below the requested ones.
    fn evaluated(
        &self,
        left_out: &mut LeftOut,
        protocol: Option<&ProtocolConfig>,
        frames: Option<usize>,
    ) -> Result<Vec<EvalSet>, BadInput> {
        let mut all = Vec::new();
        for (folder, opened) in self.data.iter().zip(self.open(left_out, protocol)?) {
            let asked = protocol.cloned().unwrap_or_default();
            let arranged = asked.arrange_all(folder, &opened, frames);
            let arranged = arranged.map_err(BadInput::of)?;
            let sentences = lacking(&opened.scenarios, &arranged.1, None, frames);
            sentences.into_iter().for_each(output::note);
            all.push(arranged);
        }
        Ok(all)
    }

    /// The scenarios as the protocol of their layout arranges them, each with its communication range, metres.
    fn arranged(&self, left_out: &mut LeftOut) -> Result<Vec<(Scenario, f64)>, BadInput> {
        let sets = self.evaluated(left_out, None, None)?.into_iter();
        let scenarios = sets.flat_map(|(protocol, scenarios)| {
            let range_m = protocol.ground_truth.comm_range_m;
            scenarios.into_iter().map(move |one| (one, range_m))
        });
        Ok(scenarios.collect())
    }

    fn scenarios(&self, left_out: &mut LeftOut) -> Result<Vec<Scenario>, BadInput> {
        let all = self.open(left_out, None)?;
        Ok(all.into_iter().flat_map(|data| data.scenarios).collect())
    }
}

/// Rows of a result as JSON, each with command and digests of what the result was made from.
fn rows_with_provenance<'a>(
    rows: &impl Serialize,
    scenarios: impl IntoIterator<Item = &'a Scenario>,
    files: impl IntoIterator<Item = PathBuf>,
) -> anyhow::Result<String> {
    let provenance = dataset::provenance(scenarios, files, env!("V2VLOC_COMMIT"))?;
    let mut rows = json!(rows);
    for row in rows.as_array_mut().into_iter().flatten() {
        row["provenance"] = json!(provenance);
    }
    Ok(serde_json::to_string_pretty(&rows)?)
}

/// Prints the findings, and their counts where data are missing.
fn print_left_out(left_out: &LeftOut) -> Outcome {
    let outcome = left_out.print();
    if outcome == Outcome::DataLost {
        output::note(left_out);
    }
    outcome
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::Path;

    use clap::Parser;
    use dataset::evaluation_protocol::EgoKind;

    use super::*;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        data: DataSets,
    }

    /// Writes a scenario of one tick.
    fn write_scenario(folder: &Path, agents: i32) {
        let cloud = "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 1\nHEIGHT 1\n\
                     VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 1\nDATA ascii\n1 2 3 0.5\n";
        for agent in 0..agents {
            let folder = folder.join(agent.to_string());
            fs::create_dir_all(&folder).unwrap();
            let pose = "lidar_pose: [0, 0, 2, 0, 0, 0]\nvehicles: {}\n";
            fs::write(folder.join("000000.yaml"), pose).unwrap();
            fs::write(folder.join("000000.pcd"), cloud).unwrap();
        }
    }

    #[test]
    fn no_more_agents_take_part_than_the_protocol_allows() {
        let folder = tempfile::tempdir().unwrap();
        write_scenario(folder.path(), 9);
        let place = folder.path().to_str().unwrap();
        let line = Line::try_parse_from(["align", "--dataset", place]).unwrap();
        let scenarios = line.data.arranged(&mut LeftOut::default()).unwrap();
        let [(scenario, comm_range_m)] = &scenarios[..] else {
            panic!("{scenarios:?}")
        };
        assert_eq!((scenario.agents.len(), *comm_range_m), (7, 70.0));
    }

    #[test]
    fn data_that_are_given_twice_and_data_without_an_ego_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let [all, one] = [folder.path().to_owned(), folder.path().join("one")];
        write_scenario(&one, 1);
        let problem = |data: [&PathBuf; 2], protocol: ProtocolConfig| {
            let data = DataSets {
                data: data.into_iter().cloned().collect(),
                intensity: IntensityOption::default(),
            };
            let opened = data.evaluated(&mut LeftOut::default(), Some(&protocol), None);
            opened.unwrap_err().to_string()
        };
        for data in [[&one, &one], [&all, &one]] {
            let twice = problem(data, ProtocolConfig::default());
            assert!(twice.contains("both have the sweeps"), "{twice}");
        }
        let two = folder.path().join("two");
        write_scenario(&two, 1);
        let units = ProtocolConfig {
            ego_kind: Some(EgoKind::Unit),
            ..ProtocolConfig::default()
        };
        let none = problem([&one, &two], units);
        assert!(none.contains("one: no scenario in it has an ego"), "{none}");
    }

    #[test]
    fn numbers_without_a_meaning_are_refused() {
        #[derive(Parser)]
        struct Tool {
            #[command(subcommand)]
            _command: Command,
        }
        for line in [
            "eval --dataset d --weights w --threads 0",
            "align --dataset d --threads 257",
            "align --dataset d --frames 0",
            "alignment-error --dataset d --weights w --every 0",
        ] {
            let error = Tool::try_parse_from(["tool"].into_iter().chain(line.split(' ')));
            let error = error.err().unwrap().to_string();
            assert!(error.contains("invalid value"), "{line}: {error}");
        }
    }
}
