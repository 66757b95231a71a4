//! `agent localize`: writes the poses of recorded sweeps to a table.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

use agent_offline::evaluation::estimate_pose;
use agent_offline::sweep_database::present_sweeps;
use dataset::{self, IntensityScale, LeftOut, LoadOptions, Problem, ReadError, Scenario, findings};
use indicatif::ProgressBar;
use localization::pgc::head_files::encoder_or_named;
use localization::pgc::wrong_place::wrong_place_hint;
use localization::pose_source::{LocalizedPose, PgcConfig, PoseRow, PoseSource, PoseTable};
use perception::inference::Inference;
use perception::int8::InferencePrecision;
use support::file_digests::FileDigests;
use support::output;
use terminal::progress;

use super::scene_heads::{SceneHeadFile, head_of, surfel_map, with_files};
use support::cli::{BadInput, Outcome};
use tch::Device;

/// Localize every sweep of scenes once and write poses and confidences to a table, for training and evaluation.
///
/// Scenarios that are in the table already are skipped, so an interrupted run continues where it stopped; their sweeps that
/// the table lacks are named.
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
    /// wrote, or a released one (town1) [default: none].
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
    let (mut scenarios, mut folders) = (Vec::new(), BTreeMap::new());
    for folder in &args.dataset {
        for scenario in dataset::open(folder).map_err(BadInput::of)?.scenarios {
            let name = PoseTable::key(&scenario.name).to_owned();
            if let Some(other) = folders.insert(name, folder.display()) {
                let (folder, name) = (folder.display(), scenario.name);
                return Err(BadInput::new(format!(
                    "{other} and {folder} both have a scenario {name}: a table has one of a name"
                ))
                .into());
            }
            scenarios.push(scenario);
        }
    }
    // All heads are found before any is computed with.
    let files = with_files(&args.head)?;
    let digests = FileDigests::default();
    let (mut tasks, mut left_out) = (Vec::new(), LeftOut::default());
    for scenario in &scenarios {
        let config = args.config(head_of(&files, scenario)?)?;
        let origin = origin(scenario, &config, &digests).map_err(BadInput::of)?;
        let origin = origin + precision_text(args.precision);
        match done.origin(&scenario.name) {
            None => tasks.push((scenario, config, origin)),
            Some(before) if before == origin => add_missing(&done, scenario, &mut left_out),
            Some(before) => {
                let (out, name) = (args.out.display(), &scenario.name);
                return Err(BadInput::new(format!(
                    "{out}: its poses of {name} are of other networks or data ({before:?}) than these ({origin:?}): --out another \
                     file"
                ))
                .into());
            }
        }
    }
    let sweeps = tasks.iter().map(|(scenario, ..)| present_sweeps(scenario));
    let sweeps = sweeps.flatten().count();
    if sweeps == 0 && done.rows() == 0 {
        return Err(BadInput::new(format!("no sweep in {:?}", args.dataset)).into());
    }
    let bar = progress::bar(sweeps, "sweeps");
    let mut found = 0;
    left_out.add_findings(findings::sampled(&scenarios, IntensityScale::AUTO, None));
    let inference = Inference::new(Device::Cpu, args.precision);
    for of_head in tasks.chunk_by(|(_, one, _), (_, next, _)| one == next) {
        let mut source = LocalizedPose::pgc(&of_head[0].1, inference).map_err(BadInput::of)?;
        for (scenario, _, origin) in of_head {
            let rows = localized(&mut source, scenario, &mut left_out, &bar);
            // Appended as a whole: an interrupted scenario is not in the table and is done again.
            PoseTable::append(&args.out, &scenario.name, origin, &rows)?;
            let poses = rows.iter().map(|row| row.estimate.world_from_cav());
            found += poses.flatten().count();
        }
    }
    bar.finish_and_clear();
    if let (0, 1.., Some((scenario, config, _))) = (found, sweeps, tasks.first()) {
        let map = scenario.generated_map().ok().map(|map| map.to_string());
        let head = &config.head;
        output::note(wrong_place_hint(sweeps as u64, head, map.as_deref()));
    }
    output::line(format_args!(
        "{sweeps} sweeps, {found} with a pose; {} were in the table before: {}",
        done.rows(),
        args.out.display()
    ))?;
    Ok(left_out.print())
}

impl Args {
    fn config(&self, head: &Path) -> Result<PgcConfig, BadInput> {
        Ok(PgcConfig {
            encoder: encoder_or_named(self.encoder.as_deref(), head).map_err(BadInput::of)?,
            head: head.to_owned(),
            surfel_map: surfel_map(self.surfel_map.as_deref())?,
            ..PgcConfig::default()
        })
    }
}

/// Digests of all that the poses of a scenario are computed from.
fn origin(scenario: &Scenario, config: &PgcConfig, digests: &FileDigests) -> io::Result<String> {
    let mut text = format!("data {}", dataset::scenario_sha256(scenario, digests));
    let (head, encoder, map) = (&config.head, &config.encoder, &config.surfel_map);
    let files = [("head", head), ("encoder", encoder), ("surfel map", map)];
    for (name, file) in files {
        if !file.as_os_str().is_empty() {
            text += &format!(" {name} {}", digests.sha256(file)?);
        }
    }
    Ok(text)
}

/// Number format at the end of an origin; tables of before, of the default, state none.
fn precision_text(precision: InferencePrecision) -> &'static str {
    match precision {
        InferencePrecision::Int8 => "",
        InferencePrecision::Float => " precision float",
    }
}

/// Localizes a scenario, vehicle by vehicle in the order of time.
fn localized<'a>(
    source: &mut LocalizedPose,
    scenario: &'a Scenario,
    left_out: &mut LeftOut,
    bar: &ProgressBar,
) -> Vec<PoseRow<'a>> {
    let mut rows = Vec::new();
    for (agent, cav) in scenario.agents.iter().enumerate() {
        source.begin();
        for tick in (0..scenario.ticks.len()).filter(|&tick| scenario.is_present(agent, tick)) {
            bar.inc(1);
            match scenario.load(agent, tick, &LoadOptions::default()) {
                Ok(frame) => rows.push(PoseRow {
                    cav,
                    capture_nanos: frame.capture_nanos,
                    estimate: estimate_pose(source, &frame, None),
                }),
                Err(error) => left_out.add_unreadable(agent, Problem::from(&error)),
            }
        }
    }
    rows
}

/// Names the sweeps of a scenario that its table lacks.
fn add_missing(table: &PoseTable, scenario: &Scenario, left_out: &mut LeftOut) {
    for (agent, tick) in present_sweeps(scenario) {
        let capture_nanos = scenario.ticks[tick].capture_nanos;
        let cav = &scenario.agents[agent];
        if table.get(&scenario.name, cav, capture_nanos).is_none() {
            let reason = "the table has no row of this sweep, which could not be read before";
            let path = scenario.points_path(agent, tick, None);
            let missing =
                path.map_or_else(|error| error, |path| ReadError::malformed(&path, reason));
            left_out.add_unreadable(agent, Problem::from(&missing));
        }
    }
}

#[cfg(test)]
mod tests {
    use simulator::generate::{Subset, SynthOptions, generate};

    use super::*;

    #[test]
    fn sweeps_that_the_table_lacks_are_named_again() {
        let folder = tempfile::tempdir().unwrap();
        let drive = folder.path().join("drive");
        let options = SynthOptions {
            frames: 2,
            ..SynthOptions::new(Subset::Town1loc, 11, drive.clone())
        };
        generate(&options, &|_| {}).unwrap();
        let scenario = dataset::open(&drive).unwrap().scenarios.swap_remove(0);
        let rows = scenario.ticks.iter().map(|tick| PoseRow {
            cav: &scenario.agents[0],
            capture_nanos: tick.capture_nanos,
            estimate: localization::pose_source::NO_SOURCE,
        });
        let rows: Vec<PoseRow<'_>> = rows.collect();
        let missing = |rows: &[PoseRow<'_>]| {
            let out = folder.path().join(rows.len().to_string());
            PoseTable::append(&out, &scenario.name, "data 0", rows).unwrap();
            let mut left_out = LeftOut::default();
            add_missing(&PoseTable::read(&out).unwrap(), &scenario, &mut left_out);
            (left_out.ticks, left_out.reasons())
        };
        assert_eq!(missing(&rows).0, 0);
        let (ticks, reasons) = missing(&rows[..1]);
        let stem = &scenario.ticks[1].stem;
        let names_it = reasons.contains(stem) && reasons.contains("no row of this sweep");
        assert!(ticks == 1 && names_it, "{reasons}");
    }

    #[test]
    fn poses_in_another_number_format_have_another_origin() {
        let [default, float] = [InferencePrecision::default(), InferencePrecision::Float];
        assert_eq!(precision_text(default), "", "as in the tables of before");
        assert_eq!(precision_text(float), " precision float");
    }
}
