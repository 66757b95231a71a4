//! `agent map`: a head for a place of one's own, in one command.

use std::path::{Path, PathBuf};
use std::time::Duration;

use agent_offline::TrainingBar;
use agent_offline::icp_map::{check_spacing, read_map};
use agent_offline::mapping::{MapConfig, MapProgress, PlaceReport, make_map};
use anyhow::Context;
use bus::malloc_settings;
use dataset::LeftOut;
use localization::pgc::confidence::Rejection;
use localization::pgc::head_files::{ENCODER_FILE, SURFELS_FILE, released_encoder};
use localization::registration::icp::surfel_map::{SurfelMap, check_voxel};
use perception::compute_device::ComputeDevice;
use perception::compute_precision::ComputePrecision;
use perception::train::{Interruption, Length, ModelCard, RunConfig, check_out};
use support::cli::{BadInput, Outcome};
use support::file_error::AtFile;
use support::{atomic_file, output};

use super::scene_heads::check_one_map;

/// Choice of the threshold without `--max-wrong`.
const GOOD_LOSS: Rejection = Rejection::GoodLoss(0.01);
/// Name of the report beside the weights.
const REPORT_FILE: &str = "map.json";

/// Make a head for a place from drives through it, with which vehicles are localized there (agent locate, agent run).
///
/// Drives are data sets in any layout with poses, or folders of clouds with a file of poses (`sim-replay inspect` lists
/// them); all poses are in one frame, which becomes that of the map. Drive every road, wide ones in both directions: roads
/// that were not driven give no pose. An eighth of the sweeps is held out, in contiguous pieces; the head is trained on the
/// others, and its confidence fitted and its accuracy measured on the held-out ones. Writes weights, encoder, model card and
/// map.json.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Drives through the place.
    #[arg(required = true, value_name = "DRIVE")]
    drives: Vec<PathBuf>,
    /// Folder of the results.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Name of the place, for messages and the model card [default: name of the folder; of a surfel map alone: none].
    /// Only the surfel map of the same place goes with a head.
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    /// Time of everything, reading and encoding included, minutes.
    #[arg(long, default_value_t = 10.0)]
    minutes: f64,
    /// Make the surfel map alone, in seconds, without training: it can take the place of a head.
    #[arg(long, visible_alias = "quick", conflicts_with_all = ["minutes", "sweeps", "encoder", "seed", "device", "threads", "resume", "json"])]
    surfels_only: bool,
    /// Distance between two sweeps of a drive in the surfel map, metres.
    #[arg(long, value_name = "M", default_value_t = 5.0)]
    surfel_spacing_m: f64,
    /// Side of the surfel map's voxels, each of which has one plane, metres: 0.7 halves the file.
    #[arg(long, value_name = "M", default_value_t = 0.5)]
    surfel_voxel_m: f64,
    /// Reject as few poses as leave at most this share of wrong ones, by its upper 95 % confidence limit on held-out sweeps
    /// and their mirror images; of too few sweeps for that, as leave the smallest limit [default: reject 1 % of the right
    /// ones].
    #[arg(long, value_name = "SHARE", conflicts_with = "surfels_only")]
    max_wrong: Option<f64>,
    /// Largest number of training sweeps, evenly spread [default: as many as there is time for].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    sweeps: Option<u32>,
    /// Weights of the encoder, or of a detector, whose backbone then serves both [default: the released encoder].
    #[arg(long, value_name = "FILE")]
    encoder: Option<PathBuf>,
    /// Seed of parameters and order.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Device to train on.
    #[arg(long, value_enum, default_value_t)]
    device: ComputeDevice,
    /// Threads of the network on the CPU [default: half as many as cores].
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: Option<u16>,
    /// Go on with the map in --out that Ctrl-C has stopped; sweeps are encoded again.
    #[arg(long)]
    resume: bool,
    /// Overwrite the map in --out.
    #[arg(long, conflicts_with = "resume")]
    force: bool,
    /// Print the report as JSON.
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &Args) -> anyhow::Result<Outcome> {
    // The surfel map is made last: its options are refused before the training, not after it.
    check_spacing(args.surfel_spacing_m).map_err(BadInput::of)?;
    check_voxel(args.surfel_voxel_m).map_err(BadInput::of)?;
    if args.surfels_only {
        check_one_map(&args.drives)?;
        check_out(&args.out, false, args.force).map_err(BadInput::of)?;
        atomic_file::create_folder(&args.out).at(&args.out)?;
        return Ok(args.write_surfels()?.print());
    }
    // This may execute the program again: before anything is read or written.
    malloc_settings::ensure(&malloc_settings::FEW_PRODUCTS)
        .context("cannot execute this program again")?;
    let config = args.config()?;
    let bar = TrainingBar::of(Length::Time(config.time));
    let total_s = config.time.as_secs_f64();
    let made = make_map(&config, &mut |progress: MapProgress| match progress {
        MapProgress::Note(text) => bar.print_line(&text),
        MapProgress::At(seconds, text) => bar.report((seconds / total_s).min(1.0), seconds, &text),
    });
    bar.finish();
    let report = made.map_err(|error| match error.is_bad_input() {
        true => BadInput::of(error).into(),
        false => anyhow::Error::from(error),
    })?;
    write(&config, &report)?;
    let head = report.trained.weights.display();
    if args.json {
        output::line(serde_json::to_string_pretty(&report)?)?;
    } else {
        output::text(text(&report))?;
        output::line(format_args!("head       {head}"))?;
    }
    if let Some(left_out) = &report.left_out {
        output::note(format_args!("left out: {left_out}"));
    }
    // The training may have read some of the sweeps only: what the others lack is named here. Findings are, once more.
    let surfels = args.write_surfels()?.print();
    Ok(report.left_out.map_or(surfels, |_| Outcome::DataLost))
}

impl Args {
    /// Writes the planes of the place beside the head.
    fn write_surfels(&self) -> anyhow::Result<LeftOut> {
        let mut left_out = LeftOut::default();
        let config = SurfelMap::building(self.surfel_voxel_m);
        let target = read_map(&self.drives, self.surfel_spacing_m, &config, &mut left_out);
        let target = target.map_err(BadInput::of)?;
        let path = self.out.join(SURFELS_FILE);
        let sha256 = SurfelMap::write(&path, &self.place(), &target)?;
        let (planes, path) = (target.planes(), path.display());
        output::note(format_args!("{path}: {planes} planes, SHA-256 {sha256}"));
        Ok(left_out)
    }

    /// Name of the place. That of a surfel map alone is not known unless it is given: its head may have another.
    fn place(&self) -> String {
        match &self.name {
            Some(name) => name.clone(),
            None if self.surfels_only => String::new(),
            None => name_of(&self.out),
        }
    }

    fn config(&self) -> anyhow::Result<MapConfig> {
        check_one_map(&self.drives)?;
        let minutes = self.minutes;
        let time = Duration::try_from_secs_f64(60.0 * minutes).ok();
        let time = time.filter(|time| !time.is_zero());
        let time =
            time.ok_or_else(|| BadInput::new(format!("--minutes is {minutes}, must be above 0")))?;
        check_out(&self.out, self.resume, self.force).map_err(BadInput::of)?;
        let encoder = self.encoder.clone().or_else(released_encoder);
        let encoder =
            encoder.ok_or_else(|| BadInput::new("no released encoder is found: --encoder FILE"))?;
        let rejection = self.max_wrong.map_or(GOOD_LOSS, Rejection::MaxWrong);
        let checked = rejection.check();
        checked.map_err(|error| BadInput::new(format!("--max-wrong: {error}")))?;
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let threads = self.threads.map_or((cores / 2).clamp(1, 16), usize::from);
        tch::set_num_threads(i32::try_from(threads).unwrap_or(1));
        let device = self.device.open();
        let device =
            device.map_err(|missing| BadInput::new(format!("--device cuda: {missing}")))?;
        Ok(MapConfig {
            drives: self.drives.clone(),
            place: self.place(),
            encoder,
            time,
            rejection,
            most_sweeps: self.sweeps.map(|count| count as usize),
            run: RunConfig {
                learning_rate: 2e-3,
                seed: self.seed,
                device,
                precision: ComputePrecision::fastest_on(device),
                loader_threads: (threads / 2).max(1),
                resume: self.resume,
                interruption: Interruption::by_signals().context("cannot catch Ctrl-C")?,
                command: std::env::args().collect::<Vec<_>>().join(" "),
                ..RunConfig::new(Length::Time(time), &self.out)
            },
        })
    }
}

fn name_of(folder: &Path) -> String {
    let absolute = std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned());
    let name = absolute.file_name().map(|name| name.to_string_lossy());
    name.map_or("place".to_owned(), |name| name.into_owned())
}

/// Report as text.
fn text(report: &PlaceReport) -> String {
    let accuracy = report.held_out.map(|accuracy| accuracy.text());
    let accuracy = accuracy.unwrap_or("not measured: too few sweeps".to_owned());
    let confidence = match &report.confidence {
        Some(fit) => {
            let (bad, good, limit) = (fit.bad, fit.sweeps - fit.bad, 100.0 * fit.wrong_limit);
            let (bad_rejected, good_rejected) = (fit.bad_rejected, fit.good_rejected);
            format!(
                "rejects {bad_rejected} of {bad} wrong poses, {good_rejected} of {good} right ones; of the others at most {limit:.1} % are wrong (95 % limit)"
            )
        }
        None => "not fitted: too few poses".to_owned(),
    };
    format!(
        "place      {}\ntraining   {}\naccuracy   {accuracy}\nconfidence {confidence}\ndriven     {}\n{}{}\n",
        report.place,
        report.training_text(),
        report.coverage_text(),
        indented(&report.coverage.area.picture()),
        report.limits_text()
    )
}

fn indented(text: &str) -> String {
    text.lines()
        .map(|line| format!("           {line}\n"))
        .collect()
}

/// Writes the model card and the report.
fn write(config: &MapConfig, report: &PlaceReport) -> anyhow::Result<()> {
    let title = format!("Scene head of {}", report.place);
    let about =
        "World coordinates of cells on the features of a frozen encoder, made by `agent map`.";
    let mut card = ModelCard::new(&title, about);
    let (sweeps, drives) = (report.training_sweeps, config.drives.len());
    let data = format!("{sweeps} sweeps of {drives} drives");
    card.trained(&report.run, &report.trained, &data, "cells");
    let sha256 = format!("SHA-256 `{}`", report.sha256);
    card.row("file with confidence and scales", sha256);
    card.row("copies of each sweep", report.copies);
    card.row("encoder", format_args!("`{ENCODER_FILE}` beside the head"));
    let accuracy = report.held_out.map(|accuracy| accuracy.text());
    card.row("accuracy", accuracy.as_deref().unwrap_or("not measured"));
    card.row("driven", report.coverage_text());
    let time = format!("{:.0} s", report.seconds);
    card.row("time of everything", time);
    card.paragraph(&report.limits_text());
    let (cell_m, picture) = (report.coverage.area.cell_m, report.coverage.area.picture());
    card.paragraph(&format!(
        "Cells of {cell_m:.0} m with sweeps (#), north up:\n\n```\n{picture}```"
    ));
    card.write(&config.run.out)?;
    let path = config.run.out.join(REPORT_FILE);
    let json = serde_json::to_string_pretty(report)? + "\n";
    atomic_file::write(&path, json.as_bytes()).with_context(|| path.display().to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_is_named_after_its_folder() {
        assert_eq!(name_of(Path::new("runs/my town/")), "my town");
        assert_eq!(indented("#.\n##\n"), "           #.\n           ##\n");
    }
}
