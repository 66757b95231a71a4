//! `agent eval`: accuracy of a localizer on recorded sweeps.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use agent_offline::Error;
use agent_offline::evaluation::{
    Evaluated, EvaluatedSweep, LocalizationSummary, SweepSelection, csv, error_table, evaluate,
    evaluate_nearest, evaluate_source, reliability_charts,
};
use agent_offline::icp_map::{IcpMapPose, read_map};
use agent_offline::sweep_database::repeated;
use clap::{ArgGroup, ValueEnum};
use dataset::{self, LeftOut};
use localization::baselines::{LightLoc, ScanContext, load_baseline, load_descriptor};
use localization::covariance_scale::{COVARIANCE_KEY, CovarianceScale, NoScale};
use localization::map_registration::MapRegistration;
use localization::map_search::MapSearch;
use localization::pgc::confidence::{
    BAD_M, CONFIDENCE_KEY, Confidence, ConfidenceModel, FitReport, Labelled, Rejection,
};
use localization::pgc::head_files::{encoder_or_named, head_config};
use localization::pgc::pose_solver::{PoseSolver, Solver};
use localization::pgc::wrong_place::wrong_place_hint;
use localization::pgc::{Localize, Localizer, stored_confidence};
use localization::pose_source::{PoseSource, PoseSourceConfig, TrackedPose, TrackedPoseConfig};
use localization::registration::icp::IcpConfig;
use localization::registration::icp::surfel_map::SurfelMap;
use localization::registration::ransac::RansacConfig;
use localization::registration::sc2pcr::Sc2PcrConfig;
use nalgebra::Isometry3;
use perception::compute_device::ComputeDevice;
use perception::inference::Inference;
use perception::int8::InferencePrecision;
use perception::weights::{Weights, annotate};
use protocol::config::Section;
use serde::Serialize;
use serde_json::json;
use support::atomic_file;
use support::file_error::AtFile;
use support::output;
use support::provenance::Provenance;
use terminal::progress;

use super::retrieval::{self, RetrievalBy};
use super::scene_heads::{
    SceneHeadFile, by_head, check_place, generated_maps, is_elsewhere, surfel_map, with_files,
};
use support::cli::{BadInput, Outcome};

/// Options that change the tracker alone. What they require is a group of one option, here as below: clap forgets the
/// requirement of an option that another excludes.
const TRACKER_OPTIONS: [&str; 4] = [
    "tracking_measure_every",
    "tracking_phase",
    "tracking_global_period_s",
    "tracking_max_coast_s",
];

/// Localize recorded sweeps and compare with their true poses.
#[derive(Debug, clap::Args)]
#[command(group = ArgGroup::new("tracker").args(TRACKER_OPTIONS).multiple(true).requires("followed"))]
pub(crate) struct Args {
    /// Data sets, splits or scenarios of the heads' scenes; the layout is detected.
    #[arg(long, alias = "scene", value_name = "DIR", num_args = 1.., required = true)]
    dataset: Vec<PathBuf>,
    /// Weights of the encoder, or of a detector that has it [default: those that each head names].
    #[arg(long, value_name = "FILE")]
    encoder: Option<PathBuf>,
    /// Weights of the heads: FILE for all scenes, or MAP=FILE and MAP:SEED=FILE for generated ones [SEED: 0]; FILE may be
    /// the name of a released one (town1, town4). The report is over all scenes together.
    #[arg(long, visible_alias = "weights", value_name = "[MAP=]FILE|NAME")]
    #[arg(num_args = 1.., default_value = "town1")]
    head: Vec<SceneHeadFile>,
    /// Weights of a baseline (`agent train sgloc`, `diffloc`, `hypliloc`), instead of encoder and head.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["encoder", "head", "fit_confidence"])]
    baseline: Option<PathBuf>,
    /// Leave out what PGC adds to LightLoc: predicted error, refinement and confidence.
    #[arg(long, conflicts_with_all = ["baseline", "fit_confidence", "tracked"])]
    lightloc: bool,
    /// Answer with the pose of the sweep of these drives that is most similar (--by): a lower baseline.
    #[arg(
        long,
        value_name = "DIR",
        num_args = 1..,
        group = "drives",
        conflicts_with_all = ["lightloc", "fit_confidence", "tracked", "solver"]
    )]
    retrieval: Vec<PathBuf>,
    /// Descriptor of a sweep that --retrieval compares.
    #[arg(long, value_enum, default_value_t, requires = "drives")]
    by: RetrievalBy,
    /// Register every sweep against a point-cloud map of these drives through the same scene (ICP), starting at the
    /// pose of the GNSS receiver, instead of networks.
    #[arg(
        long,
        value_name = "DIR",
        num_args = 1..,
        group = "point_map",
        conflicts_with_all = ["encoder", "head", "baseline", "lightloc", "retrieval", "fit_confidence", "solver"]
    )]
    icp_map: Vec<PathBuf>,
    /// Register the poses of PGC to a surfel map of the place (`agent map`) or a released one (town1): poses to the millimetre.
    #[arg(long, value_name = "FILE|NAME", conflicts_with_all = ["baseline", "lightloc", "retrieval", "icp_map", "fit_confidence"])]
    surfel_map: Option<PathBuf>,
    /// Distance between two sweeps on that point-cloud map, metres.
    #[arg(long, value_name = "M", default_value_t = 5.0, requires = "point_map")]
    map_spacing_m: f64,
    /// Follow each vehicle from sweep to sweep (pose source tracked), and localize every sweep by itself beside it;
    /// files are written of the tracked poses.
    #[arg(long, group = "followed", conflicts_with_all = ["baseline", "icp_map", "fit_confidence"])]
    tracked: bool,
    /// Settings of the tracker.
    #[command(flatten)]
    tracker: Section<TrackedPoseConfig>,
    /// Sweeps of another weather, if the data set has them, for example fog_0.060.
    #[arg(long, value_name = "NAME")]
    variant: Option<String>,
    /// Use every N-th sweep of each vehicle.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    every: u32,
    /// Largest number of sweeps for each head, evenly over all there are [default: all].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    sweeps: Option<u32>,
    /// Search for the pose.
    #[arg(long, value_enum, default_value_t = Search::Ransac)]
    solver: Search,
    /// Seed of the search (--solver ransac) [default: 0].
    #[arg(long, conflicts_with_all = ["retrieval", "icp_map"])]
    seed: Option<u64>,
    /// Fit the confidence model and the rejection threshold to these sweeps, and write them into the head. Not on
    /// sweeps that results are reported on.
    #[arg(long, groups = ["fitted", "fits"])]
    fit_confidence: bool,
    /// Fit the size of the covariances to these sweeps and write it into the head, or with --surfel-map into that map; the
    /// confidence stays. From 2,995 poses on also the bound, which at most one of 1,000 exceeds.
    #[arg(long, group = "fits", conflicts_with_all = ["baseline", "icp_map", "lightloc", "retrieval", "tracked"])]
    fit_covariance: bool,
    /// Reject as few poses as leave at most this share of wrong ones, by its upper 95 % confidence limit; of too few sweeps
    /// for that, as leave the smallest limit (--fit-confidence, --fit-covariance).
    #[arg(long, value_name = "SHARE", requires = "fits", conflicts_with_all = ["good_loss", "surfel_map"])]
    max_wrong: Option<f64>,
    /// Largest share of poses less than 3 m off that --fit-confidence may reject.
    #[arg(long, value_name = "SHARE", default_value_t = 0.01)]
    #[arg(requires = "fitted")]
    good_loss: f64,
    /// Write a row per sweep.
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Write the reliability curve as PNG.
    #[arg(long, value_name = "FILE")]
    plot: Option<PathBuf>,
    /// Write the errors as a table that --pose-source noisy replays.
    #[arg(long, value_name = "FILE")]
    error_table: Option<PathBuf>,
    /// Device to compute on.
    #[arg(long, value_enum, default_value_t, conflicts_with = "icp_map")]
    device: ComputeDevice,
    /// Number format in which networks are computed; baselines are computed in floating point.
    #[arg(long, value_enum, default_value_t, conflicts_with_all = ["icp_map", "baseline"])]
    precision: InferencePrecision,
    /// Threads to compute with.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: u16,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Search {
    /// Random samples with local optimisation.
    Ransac,
    /// Second-order spatial compatibility.
    Sc2pcr,
}

/// Method under evaluation.
enum Subject {
    /// Localizer: uses sweeps alone.
    Localizer(Box<dyn Localize>),
    /// Pose source: also gets the pose of the GNSS receiver.
    Source(Box<dyn PoseSource>),
    /// The nearest of these poses, which needs the true one.
    Nearest(Vec<Isometry3<f64>>),
}

/// Localizes, fits, writes and prints.
pub(crate) fn run(args: &Args) -> anyhow::Result<Outcome> {
    tch::set_num_threads(i32::from(args.threads));
    let (option, rejection) = args.rejection();
    let checked = rejection.check();
    checked.map_err(|error| BadInput::new(format!("{option}: {error}")))?;
    if args.seed.is_some() && args.solver == Search::Sc2pcr {
        return Err(BadInput::new("--seed is for --solver ransac: sc2pcr draws nothing").into());
    }
    // The default head is not looked for where no head is used.
    let heads = match args.uses_head() {
        true => with_files(&args.head)?,
        false => args.head.clone(),
    };
    let groups = by_head(&heads, &args.dataset)?;
    if args.fits() && groups.len() > 1 {
        let count = groups.len();
        let reason = format!("one head is fitted, {count} are given");
        return Err(BadInput::new(reason).into());
    }
    args.note_own_drives()?;
    let (mut sweeps, mut tracked, mut left_out) = (Vec::new(), Vec::new(), LeftOut::default());
    for (head, scenes) in &groups {
        let evaluated = args.evaluate(args.subject(head, &mut left_out)?, scenes)?;
        sweeps.extend(evaluated.sweeps);
        left_out.merge(&evaluated.left_out);
        if args.tracked {
            tracked.extend(args.evaluate(args.tracking(head)?, scenes)?.sweeps);
        }
    }
    // Before anything is written or printed: the fit judges the sweeps anew.
    if let ([(head, _)], true) = (&groups[..], args.fits()) {
        args.fit(head, &mut sweeps)?;
    }
    args.write(if args.tracked { &tracked } else { &sweeps })?;
    let mut summary = LocalizationSummary::of(&sweeps);
    let registered = sweeps.iter().filter(|sweep| sweep.is_registered());
    summary.registered = args.surfel_map.as_ref().map(|_| registered.count());
    if let (Some(map), Some(0)) = (&args.surfel_map, summary.registered) {
        let map = map.display();
        output::note(format_args!(
            "{map}: registered no pose: is it a surfel map of this place, in the frame of the head?"
        ));
    }
    let is_lost = summary.no_pose == summary.sweeps && args.uses_head();
    if let ([(head, scenes)], true) = (&groups[..], is_lost) {
        let maps = generated_maps(scenes).unwrap_or_default();
        let map = maps.iter().flatten().next().map(ToString::to_string);
        let sweeps = summary.sweeps as u64;
        output::note(wrong_place_hint(sweeps, head, map.as_deref()));
    }
    let tracked = args.tracked.then(|| LocalizationSummary::of(&tracked));
    match &tracked {
        _ if args.json => {
            let mut document = match &tracked {
                Some(tracked) => json!({ "pgc": summary, "tracked": tracked }),
                None => json!(summary),
            };
            let heads = groups.iter().map(|(head, _)| *head);
            document["provenance"] = json!(args.provenance(heads)?);
            output::line(serde_json::to_string_pretty(&document)?)?;
        }
        Some(tracked) => {
            let (single, tracked) = (table(&summary), table(tracked));
            output::text(format!(
                "every sweep by itself\n{single}\ntracked\n{tracked}"
            ))?;
        }
        None => output::text(table(&summary))?,
    }
    Ok(left_out.print())
}

impl Args {
    fn subject(&self, head: &Path, left_out: &mut LeftOut) -> Result<Subject, BadInput> {
        if self.by == RetrievalBy::Position {
            let poses = retrieval::positions(&self.retrieval, left_out)?;
            return Ok(Subject::Nearest(poses));
        }
        if self.icp_map.is_empty() {
            let localizer = self.localizer(head, self.inference()?, left_out)?;
            return Ok(Subject::Localizer(localizer));
        }
        let spacing_m = self.map_spacing_m;
        let config = IcpConfig::default();
        let map = read_map(&self.icp_map, spacing_m, &config, left_out).map_err(BadInput::of)?;
        let source = IcpMapPose::new(Arc::new(map), config);
        Ok(Subject::Source(Box::new(source)))
    }

    /// Notes sweeps that are compared with themselves.
    fn note_own_drives(&self) -> Result<(), BadInput> {
        let drives = self.retrieval.iter().chain(&self.icp_map);
        if drives.clone().next().is_some()
            && let Some(reason) =
                repeated(self.dataset.iter().chain(drives)).map_err(BadInput::of)?
        {
            output::note(format_args!(
                "{reason}: a comparison with itself measures nothing"
            ));
        }
        Ok(())
    }

    /// Command, and digests of the program, the networks and all data that are read.
    fn provenance<'a>(&self, heads: impl Iterator<Item = &'a Path>) -> anyhow::Result<Provenance> {
        let mut scenarios = Vec::new();
        let others = self.retrieval.iter().chain(&self.icp_map);
        for folder in self.dataset.iter().chain(others) {
            scenarios.extend(dataset::open(folder)?.scenarios);
        }
        let mut files: Vec<PathBuf> = self.baseline.iter().cloned().collect();
        files.push(surfel_map(self.surfel_map.as_deref())?);
        for head in heads.filter(|_| self.uses_head()) {
            files.extend([self.encoder(head)?, head.to_owned()]);
        }
        // Without a map, or with one in place of a head, which has no encoder.
        files.retain(|file| !file.as_os_str().is_empty());
        let commit = env!("V2VLOC_COMMIT");
        Ok(dataset::provenance(&scenarios, files, commit)?)
    }

    /// True unless another method takes the place of the head.
    fn uses_head(&self) -> bool {
        let has_none = self.baseline.is_some() || self.by != RetrievalBy::Encoder;
        self.icp_map.is_empty() && !has_none
    }

    fn inference(&self) -> Result<Inference, BadInput> {
        let device = self.device.open();
        let device =
            device.map_err(|missing| BadInput::new(format!("--device cuda: {missing}")))?;
        Ok(Inference::new(device, self.precision))
    }

    fn tracking(&self, head: &Path) -> Result<Subject, BadInput> {
        let mut config = self.tracker.0.clone();
        config.encoder = self.encoder(head)?;
        config.head = head.to_owned();
        let checked = PoseSourceConfig::Tracked(config.clone()).validate();
        checked.map_err(BadInput::of)?;
        let localizer = TrackedPose::localizer(&config, self.inference()?).map_err(BadInput::of)?;
        let source = TrackedPose::new(self.registered(localizer)?, config);
        Ok(Subject::Source(Box::new(source)))
    }

    fn localizer(
        &self,
        head: &Path,
        inference: Inference,
        left_out: &mut LeftOut,
    ) -> Result<Box<dyn Localize>, BadInput> {
        let solver = match self.solver {
            Search::Ransac => Solver::Ransac(RansacConfig {
                seed: self.seed.unwrap_or(0),
                ..RansacConfig::default()
            }),
            Search::Sc2pcr => Solver::Sc2Pcr(Sc2PcrConfig::default()),
        };
        let plain = PoseSolver {
            solver: solver.clone(),
            ..PoseSolver::default()
        };
        let drives = &self.retrieval;
        // Methods without a head come first: the default head need not exist for them.
        if self.by == RetrievalBy::ScanContext {
            return retrieval::by_descriptor(drives, Box::new(ScanContext), left_out);
        }
        if let (Some(weights), false) = (&self.baseline, drives.is_empty()) {
            let tokens = load_descriptor(weights, inference.device).map_err(BadInput::of)?;
            return retrieval::by_descriptor(drives, tokens, left_out);
        }
        if let Some(weights) = &self.baseline {
            return load_baseline(weights, inference.device, plain).map_err(BadInput::of);
        }
        let encoder = self.encoder(head)?;
        if let Some(search) = MapSearch::of_file(head).map_err(BadInput::of)? {
            let needs_head = self.lightloc || self.fit_confidence || self.max_wrong.is_some();
            let chooses = self.solver == Search::Sc2pcr || self.seed.is_some();
            if needs_head || chooses || !drives.is_empty() {
                let head = head.display();
                return Err(BadInput::new(format!(
                    "{head}: a surfel map, --lightloc, --retrieval, --fit-confidence, --max-wrong, --solver and --seed need \
                     a head"
                )));
            }
            return self.registered(Box::new(search));
        }
        // A stored model may be of an earlier version with other features: a new fit does not read it.
        let load = match self.fit_confidence {
            true => Localizer::load_without_confidence,
            false => Localizer::load,
        };
        let mut localizer = load(&encoder, head, inference).map_err(BadInput::of)?;
        if self.lightloc {
            return Ok(Box::new(LightLoc::new(localizer, plain)));
        }
        if !drives.is_empty() {
            return retrieval::by_encoder(drives, localizer, left_out);
        }
        localizer.solver.solver = solver;
        self.registered(Box::new(localizer))
    }

    /// The localizer behind the surfel map, if there is one.
    fn registered(&self, localizer: Box<dyn Localize>) -> Result<Box<dyn Localize>, BadInput> {
        let map = surfel_map(self.surfel_map.as_deref())?;
        MapRegistration::of(localizer, &map, 0.0).map_err(BadInput::of)
    }

    fn encoder(&self, head: &Path) -> Result<PathBuf, BadInput> {
        encoder_or_named(self.encoder.as_deref(), head).map_err(BadInput::of)
    }

    fn evaluate(&self, subject: Subject, scenes: &[PathBuf]) -> anyhow::Result<Evaluated> {
        let options = SweepSelection {
            scenes: scenes.to_vec(),
            variant: self.variant.clone(),
            every: self.every as usize,
            sweeps: self.sweeps.map(|count| count as usize),
        };
        let bar = progress::bar(0, "sweeps");
        let mut on_sweep = progress::shown_on(&bar);
        let evaluated = match subject {
            Subject::Localizer(mut localizer) => evaluate(&mut *localizer, &options, &mut on_sweep),
            Subject::Source(mut source) => evaluate_source(&mut *source, &options, &mut on_sweep),
            Subject::Nearest(poses) => evaluate_nearest(&poses, &options, &mut on_sweep),
        };
        evaluated.map_err(|error| match error {
            // A network that fails is no fault of the input: exit code 1, not 2.
            Error::Localizer(_) => error.into(),
            _ => BadInput::of(error).into(),
        })
    }

    /// Choice of the threshold, and its option.
    fn rejection(&self) -> (&'static str, Rejection) {
        match self.max_wrong {
            Some(share) => ("--max-wrong", Rejection::MaxWrong(share)),
            None => ("--good-loss", Rejection::GoodLoss(self.good_loss)),
        }
    }

    fn fits(&self) -> bool {
        self.fit_confidence || self.fit_covariance
    }

    /// Fits confidence, threshold and covariance, as far as the options ask for, and writes them.
    fn fit(&self, head: &Path, sweeps: &mut [EvaluatedSweep]) -> anyhow::Result<()> {
        let mut fitted = None;
        // --max-wrong alone keeps the stored model and chooses its threshold anew.
        if self.fit_confidence || self.max_wrong.is_some() {
            let labelled: Vec<_> = sweeps.iter().filter_map(EvaluatedSweep::labelled).collect();
            let (model, report) = self.fit_confidence(head, &labelled)?;
            let confidence = Confidence::Calibrated(model.clone());
            // Covariances are fitted below to the poses that the new threshold leaves.
            for sweep in &mut *sweeps {
                sweep.judge_again(&confidence);
            }
            fitted = Some((model, report));
        }
        // Behind a map, the head's own poses keep the head's factors.
        let registered = self.surfel_map.is_some() || SurfelMap::is_in(head);
        let samples: Vec<_> = (sweeps.iter())
            .filter(|sweep| sweep.is_registered() == registered)
            .filter_map(EvaluatedSweep::pose_sample)
            .collect();
        let scale = CovarianceScale::fit(&samples, BAD_M);
        // Nothing is written unless all that was asked for can be.
        if let (true, Err(reason)) = (self.fit_covariance, &scale) {
            return Err(BadInput::of(reason.clone()).into());
        }
        self.check_place(head)?;
        if let Some((model, report)) = fitted {
            check_good(&report)?;
            write_fit(head, CONFIDENCE_KEY, &model)?;
            output::note(report_line(&report));
        }
        let map = Some(surfel_map(self.surfel_map.as_deref())?);
        let map = map.filter(|map| !map.as_os_str().is_empty());
        let fitted = map.as_deref().unwrap_or(head);
        match scale {
            Ok(scale) => write_fit(fitted, COVARIANCE_KEY, &scale),
            Err(reason) => reset_scale(head, &reason),
        }
    }

    /// Refuses to fit a head to drives none of which is of its place: those of others give the wrong poses of a fit.
    fn check_place(&self, head: &Path) -> Result<(), BadInput> {
        // A surfel map in place of a head has no configuration.
        let Ok((_, config)) = head_config(head) else {
            return Ok(());
        };
        let maps = generated_maps(&self.dataset)?;
        match maps.iter().all(|map| is_elsewhere(map.as_ref(), &config)) {
            true => check_place((head, &config), &maps, &[]),
            false => Ok(()),
        }
    }

    fn fit_confidence(
        &self,
        head: &Path,
        labelled: &[Labelled],
    ) -> anyhow::Result<(ConfidenceModel, FitReport)> {
        let (_, rejection) = self.rejection();
        if self.fit_confidence {
            return Ok(ConfidenceModel::fit(labelled, rejection).map_err(BadInput::of)?);
        }
        let stored = Weights::load(head).map_err(BadInput::of)?;
        let Confidence::Calibrated(mut model) = stored_confidence(&stored).map_err(BadInput::of)?
        else {
            let reason = format!("{}: has no confidence: --fit-confidence", head.display());
            return Err(BadInput::new(reason).into());
        };
        let report = model.choose_threshold(labelled, rejection);
        Ok((model, report.map_err(BadInput::of)?))
    }

    fn write(&self, sweeps: &[EvaluatedSweep]) -> anyhow::Result<()> {
        if let Some(path) = &self.csv {
            atomic_file::write(path, csv(sweeps)).at(path)?;
        }
        if let Some(path) = &self.error_table {
            atomic_file::write(path, error_table(sweeps)).at(path)?;
        }
        if let Some(path) = &self.plot {
            figures::save_png(&reliability_charts(sweeps), path)?;
        }
        Ok(())
    }
}

/// Writes fitted numbers into a file of weights or a map.
fn write_fit(file: &Path, key: &str, fitted: &impl Serialize) -> anyhow::Result<()> {
    let text = serde_json::to_string(fitted)?;
    let sha256 = annotate(file, key, &text)?;
    let file = file.display();
    output::note(format_args!(
        "{file}: {key} written, SHA-256 is now {sha256}: {text}"
    ));
    Ok(())
}

/// Refuses a threshold that was fitted to wrong poses alone: it would reject every pose.
fn check_good(report: &FitReport) -> Result<(), BadInput> {
    let poses = report.sweeps;
    match report.bad < poses {
        true => Ok(()),
        false => Err(BadInput::new(format!(
            "none of {poses} poses is within {BAD_M} m of the true one: a confidence that is fitted to them rejects all"
        ))),
    }
}

/// Notes why there is no scale for a new sigma. One that the head has was fitted to another sigma: it is reset.
fn reset_scale(head: &Path, reason: &NoScale) -> anyhow::Result<()> {
    output::note(format_args!(
        "the covariances are not fitted: {reason}; the head keeps no factors and no bound of another sigma"
    ));
    let stored = Weights::load(head).map_err(BadInput::of)?;
    match stored.metadata(COVARIANCE_KEY) {
        None => Ok(()),
        Some(_) => write_fit(head, COVARIANCE_KEY, &CovarianceScale::NONE),
    }
}

fn report_line(report: &FitReport) -> String {
    let (sweeps, bad) = (report.sweeps, report.bad);
    let (bad_rejected, good_rejected) = (report.bad_rejected, report.good_rejected);
    let good = sweeps - bad;
    let limit = 100.0 * report.wrong_limit;
    format!(
        "fitted to {sweeps} poses: rejects {bad_rejected} of {bad} bad ones, {good_rejected} of {good} good ones; of the \
         others at most {limit:.2} % are bad (95 % limit)"
    )
}

/// Report as text: the numbers of all rows first, a dash for a missing one; then the rows, some only where there is
/// something to report.
fn table(summary: &LocalizationSummary) -> String {
    let (rejected, ms) = (&summary.rejected, &summary.ms);
    let [under_3m, under_1m] = [summary.success_3m, summary.success_1m].map(percent);
    let [mean_m, p95_m, p99_m] = numbers([summary.mean_m, summary.p95_m, summary.p99_m], 2);
    let [mean_deg, p95_deg] = numbers([summary.mean_deg, summary.p95_deg], 2);
    let [p50_m, p50_deg] = numbers([summary.p50_m, summary.p50_deg], 3);
    let total_ms = ms.get("total").copied();
    let [max_m, max_deg] = numbers([summary.max_m, summary.max_deg], 2);
    let [total_ms] = numbers([total_ms], 1);
    let [sigma, ratio] = numbers([summary.sigma_spearman, summary.inlier_ratio_spearman], 2);
    let [calibration] = numbers([summary.calibration_error], 3);
    let shares = [rejected.bad_share, rejected.good_share];
    let [bad_share, good_share] = shares.map(|share| share.map_or("-".into(), percent));
    let stages = ms.iter().filter(|(stage, _)| *stage != "total");
    let stages = joined(stages.map(|(stage, ms)| format!("{stage} {ms:.1}")));
    let mut text = format!(
        "sweeps     {}, {} without a pose {:?}\n\
         success    {under_3m} under 3 m, {under_1m} under 1 m\n\
         position   mean {mean_m} m, median {p50_m}, 95 % {p95_m}, 99 % {p99_m}, largest {max_m}\n\
         rotation   mean {mean_deg} degrees, median {p50_deg}, 95 % {p95_deg}, largest {max_deg}\n\
         sigma      rank correlation {sigma} (inlier ratio {ratio}), calibration error {calibration}\n\
         rejected   {} poses: {bad_share} of {} errors above 3 m, {good_share} of the others\n\
         time       {total_ms} ms median, {:.1} mean: {stages}\n",
        summary.sweeps,
        summary.no_pose,
        summary.outcomes,
        rejected.poses,
        rejected.bad,
        summary.mean_ms
    );
    if let Some(low) = summary.low_coverage {
        let (sweeps, no_pose) = (low.sweeps, low.no_pose);
        text += &format!(
            "coverage   {sweeps} sweeps of low coverage (few training sweeps nearby), {no_pose} of them without a pose\n"
        );
    }
    if let Some(registered) = summary.registered {
        let poses = summary.sweeps - summary.no_pose + rejected.poses;
        text += &format!("registered {registered} of {poses} poses, to the surfel map\n");
    }
    if !summary.beyond_95.is_empty() {
        let shares = summary.beyond_95.iter();
        let shares = joined(shares.map(|(axis, share)| format!("{axis} {}", percent(*share))));
        text += &format!("covariance {shares} of the errors beyond 95 %\n");
    }
    if let Some(integrity) = summary.integrity {
        let (share, p50_m) = (percent(integrity.exceeded_share), integrity.p50_bound_m);
        text += &format!(
            "integrity  {share} of the errors exceed their bound of 95 % (median {p50_m:.2} m)\n"
        );
    }
    if let Some(bound) = summary.bound {
        let (exceeded, poses, p50_m) = (bound.exceeded, bound.poses, bound.p50_bound_m);
        text += &format!(
            "bound      {exceeded} of {poses} errors exceed their bound of one in 1,000 (median {p50_m:.2} m)\n"
        );
    }
    text
}

fn joined(parts: impl Iterator<Item = String>) -> String {
    parts.collect::<Vec<_>>().join(", ")
}

fn numbers<const N: usize>(values: [Option<f64>; N], digits: usize) -> [String; N] {
    values.map(|value| value.map_or("-".into(), |value| format!("{value:.digits$}")))
}

fn percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use perception::weights::{Precision, save};
    use tch::Device;
    use tch::nn::VarStore;

    use super::*;

    #[test]
    fn a_confidence_is_not_fitted_to_wrong_poses_alone() {
        let mut report = FitReport {
            sweeps: 57,
            bad: 56,
            bad_rejected: 56,
            good_rejected: 0,
            wrong_limit: 0.0,
        };
        check_good(&report).unwrap();
        report.bad = 57;
        let message = check_good(&report).unwrap_err().to_string();
        assert!(message.contains("none of 57 poses"), "{message}");
    }

    #[test]
    fn factors_of_another_sigma_do_not_stay() {
        let folder = tempfile::tempdir().unwrap();
        let head = folder.path().join("head.safetensors");
        let factors = r#"{"planar":2.0,"height":2.0,"tilt":2.0,"yaw":2.0,"bound":4.0}"#;
        let metadata = BTreeMap::from([(COVARIANCE_KEY.to_owned(), factors.to_owned())]);
        let none = VarStore::new(Device::Cpu);
        save(&head, &none, &metadata, Precision::Single).unwrap();
        reset_scale(&head, &NoScale::TooFew(45)).unwrap();
        let stored = Weights::load(&head).unwrap();
        let scale: CovarianceScale = stored.metadata_json(COVARIANCE_KEY).unwrap();
        assert_eq!(scale, CovarianceScale::NONE);
        // A head without factors gets none.
        let other = BTreeMap::from([("seed".to_owned(), "0".to_owned())]);
        save(&head, &none, &other, Precision::Single).unwrap();
        reset_scale(&head, &NoScale::TooFew(45)).unwrap();
        let stored = Weights::load(&head).unwrap();
        assert_eq!(stored.metadata(COVARIANCE_KEY), None);
    }

    #[test]
    fn the_registered_poses_have_a_row_where_there_is_a_surfel_map() {
        let mut summary = LocalizationSummary::of(&[]);
        assert!(!table(&summary).contains("registered"));
        (summary.sweeps, summary.no_pose, summary.registered) = (60, 5, Some(0));
        summary.rejected.poses = 2;
        assert!(table(&summary).contains("registered 0 of 57 poses"));
    }
}
