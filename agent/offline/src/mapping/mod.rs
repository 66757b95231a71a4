//! A head for a place, from drives with poses: held-out sweeps, training within a time, scales, confidence, accuracy.

mod check;
mod coverage;
mod held_out;
mod plan;
mod report;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use dataset::reasons;
use nalgebra::Vector3;

pub use coverage::Coverage;
pub use report::{HeldOutAccuracy, PlaceReport};

use self::check::Check;
use self::plan::{Plan, StoredPlan, feature_bytes, too_little_memory};
use crate::evaluation::LocalizationSummary;
use crate::training::{
    CELLS, FeatureCache, SceneSummary, SceneTrainConfig, SweepAugmentation, SweepList,
    train_scene_on,
};
use crate::{Error, Result};
use localization::covariance_scale::{COVARIANCE_KEY, CovarianceScale};
use localization::pgc::confidence::{
    BAD_M, CONFIDENCE_KEY, Confidence, ConfidenceModel, FitReport, Rejection,
};
use localization::pgc::head_files::ENCODER_FILE;
use localization::pgc::{CellEncoder, Localizer};
use perception::inference::Inference;
use perception::int8::{SCALES_KEY, ScaleSearch};
use perception::train::{Length, RunConfig, TrainingEvent};
use perception::weights::annotate;
use support::file_error::AtFile;
use support::sampling::evenly_spread;

/// Sweeps that are encoded to measure their time.
const PROBES: usize = 8;
/// Batches of a pass over the cells, and the bounds of a batch: a small place has smaller ones, and so more steps.
const BATCHES: usize = 40;
const LEAST_BATCH: usize = 512;
const MOST_BATCH: usize = 1024;
/// Time between two checkpoints.
const CHECKPOINT_EVERY: Duration = Duration::from_secs(120);

/// Configuration of a map.
#[derive(Debug, Clone)]
pub struct MapConfig {
    /// Data sets, splits or drives with poses, all in one frame.
    pub drives: Vec<PathBuf>,
    /// Name of the place.
    pub place: String,
    /// Weights of the encoder.
    pub encoder: PathBuf,
    /// Time of everything.
    pub time: Duration,
    /// Largest number of training sweeps.
    pub most_sweeps: Option<usize>,
    /// Choice of the confidence below which poses are rejected.
    pub rejection: Rejection,
    /// Folder, device, precision, threads and seed, true to resume; its length is not used.
    pub run: RunConfig,
}

/// Progress of a map.
#[derive(Debug)]
pub enum MapProgress {
    /// A line that stays.
    Note(String),
    /// Seconds since the start, and what is being done.
    At(f64, String),
}

/// Trains and checks a head; writes weights, encoder, checkpoint and curve into `config.run.out`.
///
/// # Errors
/// [`Error`]; a checkpoint may stay.
pub fn make_map(config: &MapConfig, observe: &mut dyn FnMut(MapProgress)) -> Result<PlaceReport> {
    let mut map = MapMaking {
        config,
        started: Instant::now(),
        observe,
    };
    let sweeps = map.survey()?;
    let plan = map.plan(&sweeps)?;
    let used = evenly_spread(&sweeps.training, plan.training);
    let training = Arc::new(sweeps.list.subset(&used));
    let checked = evenly_spread(&sweeps.held_out, plan.checked);
    let held_out = sweeps.list.subset(&checked);
    let coverage = sweeps.coverage(&used);
    let (summary, run) = map.train(&training, &plan)?;
    map.copy_encoder()?;
    let weights = summary.trained.weights.clone();
    // Scales come first: the check, and what is fitted to it, is then of 8-bit inference as in a vehicle.
    let (activation_scales, scaled) = map.quantise(&weights, &training, plan.scale_sweeps)?;
    let mut checked = map.check(&weights, &held_out)?;
    let (confidence, sha256) = map.fit(&weights, &mut checked)?;
    let (mut data, more) = (training.data(), held_out.data().problems.into_iter());
    // Problems of the data set itself are in both.
    data.problems
        .extend(more.skip(sweeps.list.data().problems.len()));
    // Those are in neither list.
    data.without_pose += sweeps.list.len() - sweeps.training.len() - sweeps.held_out.len();
    let accuracy = (!checked.sweeps.is_empty())
        .then(|| HeldOutAccuracy::of(&LocalizationSummary::of(&checked.sweeps)));
    Ok(PlaceReport {
        place: config.place.clone(),
        sha256: sha256
            .or(scaled)
            .unwrap_or_else(|| summary.trained.sha256.clone()),
        // The cache counts every copy as a sweep.
        training_sweeps: summary.sweeps / plan.copies.max(1),
        copies: plan.copies,
        cell_error_m: summary.error_m,
        held_out: accuracy,
        confidence,
        activation_scales,
        coverage: coverage.ok_or_else(|| map.no_poses(&sweeps.list))?,
        left_out: data.left_out(),
        seconds: map.seconds(),
        trained: summary.trained,
        run,
    })
}

/// The sweeps of the drives; those with poses are trained on or held out.
struct MapSweeps {
    list: SweepList,
    /// Drive and position of each sweep of the list, metres; `None` without a pose.
    positions: Vec<(usize, Option<Vector3<f64>>)>,
    training: Vec<usize>,
    held_out: Vec<usize>,
}

impl MapSweeps {
    /// Coverage of some sweeps.
    fn coverage(&self, indices: &[usize]) -> Option<Coverage> {
        let positions = indices.iter().map(|&index| self.positions[index]);
        let known = positions.filter_map(|(drive, position)| Some((drive, position?)));
        let known: Vec<(usize, Vector3<f64>)> = known.collect();
        let drives = known.chunk_by(|(one, _), (next, _)| one == next);
        let drives = drives.map(|drive| drive.iter().map(|(_, position)| *position).collect());
        Coverage::of(&drives.collect::<Vec<Vec<_>>>())
    }
}

struct MapMaking<'a> {
    config: &'a MapConfig,
    started: Instant,
    observe: &'a mut dyn FnMut(MapProgress),
}

impl MapMaking<'_> {
    fn seconds(&self) -> f64 {
        self.started.elapsed().as_secs_f64()
    }

    fn note(&mut self, text: String) {
        (self.observe)(MapProgress::Note(text));
    }

    fn at(&mut self, text: String) {
        let seconds = self.seconds();
        (self.observe)(MapProgress::At(seconds, text));
    }

    fn no_poses(&self, list: &SweepList) -> Error {
        Error::NoSweeps(self.config.drives.clone(), reasons(list.data().problems))
    }

    /// Reads the poses and holds sweeps out.
    fn survey(&mut self) -> Result<MapSweeps> {
        let list = SweepList::open(&self.config.drives)?;
        self.at(format!("reading the poses of {} sweeps", list.len()));
        let positions = list.positions();
        let (mut training, mut held) = (Vec::new(), Vec::new());
        let known: Vec<(usize, usize, Vector3<f64>)> = (positions.iter().enumerate())
            .filter_map(|(index, &(drive, position))| Some((index, drive, position?)))
            .collect();
        // Drive by drive, as the list has them: the step from the end of one to the start of the next is no part of a path.
        for drive in known.chunk_by(|(_, one, _), (_, next, _)| one == next) {
            let path: Vec<Vector3<f64>> = drive.iter().map(|(.., position)| *position).collect();
            for (&(index, ..), is_held_out) in drive.iter().zip(held_out::held_out(&path)) {
                match is_held_out {
                    true => held.push(index),
                    false => training.push(index),
                }
            }
        }
        if training.is_empty() {
            return Err(self.no_poses(&list));
        }
        Ok(MapSweeps {
            list,
            positions,
            training,
            held_out: held,
        })
    }

    /// Measures the time of a sweep, plans and announces; or takes the plan of the map that is resumed.
    fn plan(&mut self, sweeps: &MapSweeps) -> Result<Plan> {
        let run = &self.config.run;
        // A new measurement could give another plan, and with it another batch, which the checkpoint refuses.
        if run.resume {
            let plan = StoredPlan::read(&run.out, &sweeps.list.data().sha256)?;
            let (encoded, encoding_s) = (plan.training * plan.copies, plan.encoding_s);
            self.note(format!(
                "resuming: {encoded} sweeps are encoded again, in {encoding_s:.0} s, before the training"
            ));
            return Ok(plan);
        }
        let (encoder, _) = CellEncoder::load(&self.config.encoder, run.device)?;
        let most = self.config.most_sweeps.unwrap_or(usize::MAX);
        let wanted = most.min(sweeps.training.len());
        let probes = Arc::new(sweeps.list.subset(&evenly_spread(&sweeps.training, PROBES)));
        let unchanged = SweepAugmentation::NONE;
        let began = Instant::now();
        // The first sweeps are slower: they are not counted, unless there are no others.
        let mut first_s = 0.0;
        // The cache reports after every batch of 4 sweeps, so this number is met exactly.
        let first = 4.min(probes.len());
        let built = FeatureCache::build(&probes, &encoder, unchanged, run, &mut |progress| {
            if matches!(progress, TrainingEvent::Encoding(done, _) if *done == first) {
                first_s = began.elapsed().as_secs_f64();
            }
        });
        match built.map(drop) {
            Err(Error::NoSweeps(..)) => return Err(self.no_poses(&probes)),
            built => built?,
        }
        let all_s = began.elapsed().as_secs_f64();
        let sweep_s = match probes.len() - first {
            0 => all_s / probes.len().max(1) as f64,
            later => (all_s - first_s) / later as f64,
        };
        let left_s = self.config.time.as_secs_f64() - self.seconds();
        let plan = Plan::new(wanted, sweeps.held_out.len(), sweep_s, left_s);
        let encoded = plan.training * plan.copies;
        let needed = feature_bytes(encoded, encoder.format().cell_channels());
        if let Some(free) = too_little_memory(needed) {
            return Err(Error::Input(format!(
                "features of {encoded} sweeps take {} MB, {} MB are free: --sweeps N uses fewer",
                needed >> 20,
                free >> 20
            )));
        }
        self.announce(sweeps, &plan, wanted);
        let data_sha256 = sweeps.list.data().sha256;
        StoredPlan { data_sha256, plan }.write(&run.out)?;
        Ok(plan)
    }

    fn announce(&mut self, sweeps: &MapSweeps, plan: &Plan, wanted: usize) {
        let (training, checked, copies) = (plan.training, plan.checked, plan.copies);
        let total_s = self.config.time.as_secs_f64();
        if training < wanted {
            let minutes = (total_s * wanted as f64 / training as f64 / 60.0).ceil();
            self.note(format!(
                "{training} of {wanted} training sweeps are used, evenly spread: there is no time for more; --minutes \
                 {minutes:.0} would use all"
            ));
        }
        let left_s = total_s - self.seconds() - plan.encoding_s - plan.after_training_s();
        let (training_s, encoding_s) = (left_s.max(0.0), plan.encoding_s);
        let (scales_s, check_s) = (plan.scales_s, plan.check_s);
        let copies = match copies > 1 {
            true => format!(" in {copies} copies, rotated and thinned"),
            false => String::new(),
        };
        self.note(format!(
            "{training} training sweeps{copies}, {checked} of {} held-out sweeps; encoding {encoding_s:.0} s, training \
             {training_s:.0} s, scales for 8-bit inference {scales_s:.0} s, check {check_s:.0} s: {:.1} min in all",
            sweeps.held_out.len(),
            total_s / 60.0
        ));
    }

    fn train(
        &mut self,
        training: &Arc<SweepList>,
        plan: &Plan,
    ) -> Result<(SceneSummary, RunConfig)> {
        // Above 0 however long the preparation took: a negative duration would panic.
        let training_end_s = self.config.time.as_secs_f64() - plan.after_training_s();
        let left_s = (training_end_s - self.seconds()).max(1.0);
        let mut run = self.config.run.clone();
        run.length = Length::Time(Duration::from_secs_f64(left_s));
        run.batch = (plan.training * plan.copies * CELLS / BATCHES).clamp(LEAST_BATCH, MOST_BATCH);
        let classes = (plan.training / 12).clamp(4, 150).min(plan.training.max(1)) as i64;
        let config = SceneTrainConfig {
            init: None,
            scenes: self.config.drives.clone(),
            validation: Vec::new(),
            validation_sweeps: 0,
            encoder: self.config.encoder.clone(),
            scene_name: self.config.place.clone(),
            classes,
            centres: (10 * classes).min(1400),
            width: 448,
            blocks: 3,
            refiner: true,
            augmentation: SweepAugmentation {
                copies: plan.copies,
                turn_rad: 10.0_f64.to_radians(),
                keep: 0.7,
            },
            redundancy: None,
            run: run.clone(),
            validate_every: CHECKPOINT_EVERY,
        };
        let started = self.started;
        let observe = &mut *self.observe;
        let mut steps_began_s = None;
        let summary = train_scene_on(&config, training, None, &mut |progress| {
            let mut seconds = started.elapsed().as_secs_f64();
            let text = match progress {
                TrainingEvent::Encoding(done, all) => format!("encoding, {done} of {all} sweeps"),
                TrainingEvent::Note(text) => text.clone(),
                TrainingEvent::Stepped(report) => {
                    // A resumed training has a part behind it.
                    let began_s: f64 = *steps_began_s.get_or_insert(seconds);
                    seconds = began_s + report.share_done * (training_end_s - began_s).max(0.0);
                    format!("training, {}", report.text)
                }
                TrainingEvent::Read(_) | TrainingEvent::Validated(_) => return,
            };
            observe(MapProgress::At(seconds, text));
        })?;
        Ok((summary, run))
    }

    /// Copies the encoder beside the head, so that the folder is all that is needed.
    fn copy_encoder(&self) -> Result<()> {
        let path = self.config.run.out.join(ENCODER_FILE);
        // The encoder may lie in the folder already: a file that is copied onto itself would be emptied.
        let is_there = path.canonicalize().ok() == self.config.encoder.canonicalize().ok();
        if !is_there {
            std::fs::copy(&self.config.encoder, &path).at(&path)?;
        }
        Ok(())
    }

    /// Searches the scales of activations: their number, and the digest of the weights with them, if there are any.
    fn quantise(
        &mut self,
        weights: &Path,
        training: &SweepList,
        sweeps: usize,
    ) -> Result<(usize, Option<String>)> {
        self.at("scales for 8-bit inference".to_owned());
        let localizer =
            Localizer::load_without_confidence(&self.config.encoder, weights, Inference::FLOAT)?;
        let mut search = ScaleSearch::default();
        let all: Vec<usize> = (0..training.len()).collect();
        for index in evenly_spread(&all, sweeps) {
            if let Some((frame, ..)) = training.frame(index) {
                localizer.observe(&frame.points, &mut search)?;
            }
        }
        let scales = search.scales();
        if scales.is_empty() {
            return Ok((0, None));
        }
        let text = serde_json::to_string(&scales).expect("scales are numbers");
        let sha256 = annotate(weights, SCALES_KEY, &text)?;
        Ok((scales.len(), Some(sha256)))
    }

    fn check(&mut self, weights: &Path, held_out: &SweepList) -> Result<Check> {
        let (encoder, inference) = (&self.config.encoder, Inference::default());
        let mut localizer = Localizer::load_without_confidence(encoder, weights, inference)?;
        let started = self.started;
        let observe = &mut *self.observe;
        let (seed, end) = (self.config.run.seed, started + self.config.time);
        let checked = check::check(&mut localizer, held_out, seed, end, &mut |done, all| {
            let text = format!("checking, {done} of {all} sweeps and copies, each mirrored too");
            observe(MapProgress::At(started.elapsed().as_secs_f64(), text));
        });
        Ok(checked?)
    }

    /// Fits confidence and covariance, writes them into the head and applies the confidence; the report and the new digest.
    fn fit(
        &mut self,
        weights: &Path,
        checked: &mut Check,
    ) -> Result<(Option<FitReport>, Option<String>)> {
        let (model, report) = match ConfidenceModel::fit(&checked.labelled, self.config.rejection) {
            Ok(fitted) => fitted,
            Err(error) => {
                self.note(format!("the confidence is not fitted: {error}"));
                return Ok((None, None));
            }
        };
        let text = serde_json::to_string(&model).expect("a model is numbers");
        let mut sha256 = annotate(weights, CONFIDENCE_KEY, &text)?;
        let confidence = Confidence::Calibrated(model);
        // Judged by the new model first: rejected poses are no samples for the covariances.
        let mut samples = Vec::new();
        for sweep in checked.sweeps.iter_mut().chain(&mut checked.copies) {
            sweep.judge_again(&confidence);
            samples.extend(sweep.pose_sample());
        }
        match CovarianceScale::fit(&samples, BAD_M) {
            Ok(scale) => {
                let text = serde_json::to_string(&scale).expect("a scale is numbers");
                sha256 = annotate(weights, COVARIANCE_KEY, &text)?;
            }
            Err(reason) => self.note(format!("the covariances are not fitted: {reason}")),
        }
        Ok((Some(report), Some(sha256)))
    }
}
