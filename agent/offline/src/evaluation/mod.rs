//! Evaluation of a localizer on recorded sweeps with known poses.

mod summary;
mod table;

use crate::Error;
use crate::sweep_database::{open_drives, posed, present_sweeps, repeated};
use std::path::PathBuf;

use dataset::frame::Frame;
use dataset::{LeftOut, LoadOptions, Problem, ReadError};
use protocol::{CavId, Pose, PoseError, PoseEstimate};

pub use summary::{
    CalibrationBin, CoverageSummary, IntegritySummary, LocalizationSummary, RejectionSummary,
    reliability_charts,
};
pub use table::{csv, error_table};

use localization::covariance_scale::{MAX_VARIANCE, PoseSample};
use localization::pgc::confidence::{Confidence, Labelled};
use localization::pgc::{Localization, Localize, LocalizerError, LocalizerInput, stopwatch};
use localization::pose_covariance::{pose_covariance, position_bound_m, unscaled_covariance};
use localization::pose_source::{NO_SOURCE, PoseInput, PoseSource};
use nalgebra::Isometry3;
use support::sampling::evenly_spread;

/// Selection of sweeps.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SweepSelection {
    /// Data sets, splits or scenarios, all of one world.
    pub scenes: Vec<PathBuf>,
    /// A variant of the sweeps, for example `fog_0.060`.
    pub variant: Option<String>,
    /// Stride in ticks between two sweeps that are used.
    pub every: usize,
    /// Largest number of sweeps, evenly over all there are.
    pub sweeps: Option<usize>,
}

/// Result of one sweep.
#[derive(Debug, Clone, PartialEq)]
pub struct EvaluatedSweep {
    /// Name of the scenario.
    pub scenario: String,
    /// Vehicle.
    pub cav: CavId,
    /// Name of the frame.
    pub stem: String,
    /// True `world_from_lidar`.
    pub truth: Pose,
    /// True if the drives of the head cover the place; `None` if it does not state its drives.
    pub is_covered: Option<bool>,
    /// Result of the localizer.
    pub localization: Localization,
}

impl EvaluatedSweep {
    /// Error of the estimated pose, rejected or not.
    pub fn error(&self) -> Option<PoseError> {
        let pose: Pose = self.localization.found?.world_from_sensor.into();
        Some(PoseError::between(&pose, &self.truth))
    }

    /// Error of the pose that is published, if there is one.
    fn published_error(&self) -> Option<PoseError> {
        let pose = self.localization.estimate.world_from_cav()?;
        Some(PoseError::between(pose, &self.truth))
    }

    /// Sample for the fit of a confidence model.
    pub fn labelled(&self) -> Option<Labelled> {
        let found = self.localization.found?;
        Some(Labelled {
            evidence: found.evidence,
            error_m: self.error()?.distance_m,
        })
    }

    /// True if its pose was registered to a map.
    pub fn is_registered(&self) -> bool {
        let found = self.localization.found;
        found.is_some_and(|found| found.is_registered)
    }

    /// Sample for the fit of a covariance: a pose that is published, and that its method constrains.
    pub fn pose_sample(&self) -> Option<PoseSample> {
        let found = self.localization.found.filter(|found| !found.is_rejected)?;
        let covariance = Some(unscaled_covariance(&found));
        let covariance = covariance.filter(|covariance| covariance[0][0] < MAX_VARIANCE)?;
        let pose = (&found.world_from_sensor, found.sigma, found.start_std_m);
        Some(PoseSample::of(pose, covariance, &self.truth.isometry()))
    }

    /// The same with the covariance that is published.
    fn published_sample(&self) -> Option<PoseSample> {
        let mut sample = self.pose_sample()?;
        sample.covariance = pose_covariance(&self.localization.found?);
        Some(sample)
    }

    /// Error in the plane of the localizer's published pose and its bound, which at most one in 1,000 exceeds, metres, if
    /// it has one.
    fn bounded_error(&self) -> Option<(f64, f64)> {
        let bound_m = position_bound_m(&self.localization.found?)?;
        Some((self.pose_sample()?.off_m(), bound_m))
    }

    /// Applies another confidence model to the estimated pose.
    pub fn judge_again(&mut self, confidence: &Confidence) {
        let Some(found) = &mut self.localization.found else {
            return;
        };
        found.sigma = confidence.sigma(&found.evidence);
        found.is_rejected = confidence.rejects(found.sigma);
        self.localization.estimate = localization::pgc::pose_solver::estimate(&Ok(*found));
    }
}

/// Results of all sweeps.
#[derive(Debug, Default)]
pub struct Evaluated {
    /// Results vehicle by vehicle, in the order of time.
    pub sweeps: Vec<EvaluatedSweep>,
    /// Sweeps and other data that could not be used.
    pub left_out: LeftOut,
}

/// Localizes every sweep of the scenes in turn; `on_sweep` gets the number done and the number of all.
///
/// # Errors
/// [`Error`] when a data set cannot be opened or is there twice, and where no sweep is left. Sweeps that cannot be read or
/// have no true pose are left out and counted.
pub fn evaluate(
    localizer: &mut dyn Localize,
    options: &SweepSelection,
    on_sweep: &mut dyn FnMut(usize, usize),
) -> Result<Evaluated, Error> {
    let mut evaluated = evaluate_with(options, on_sweep, |frame, _, _| {
        localizer.localize(LocalizerInput::of(&frame.points))
    })?;
    for sweep in &mut evaluated.sweeps {
        let [x, y, _] = sweep.truth.translation_m;
        sweep.is_covered = localizer.driven_area().map(|area| area.covers([x, y]));
    }
    Ok(evaluated)
}

/// The same for a pose source, which gets the pose of the GNSS receiver.
///
/// # Errors
/// As [`evaluate`].
pub fn evaluate_source(
    source: &mut dyn PoseSource,
    options: &SweepSelection,
    on_sweep: &mut dyn FnMut(usize, usize),
) -> Result<Evaluated, Error> {
    evaluate_with(options, on_sweep, |frame, _, is_first| {
        if is_first {
            source.begin();
        }
        let measured = frame.gnss_world_from_lidar();
        let mut times = stopwatch();
        let estimate = estimate_pose(source, frame, measured.as_ref());
        times.lap("pose solve");
        Ok(Localization::from_estimate(estimate, times))
    })
}

/// The pose of a frame, starting at a measured one where there is one.
pub fn estimate_pose(
    source: &mut dyn PoseSource,
    frame: &Frame,
    measured: Option<&Pose>,
) -> PoseEstimate {
    let input = PoseInput {
        cav: &frame.cav,
        capture_nanos: frame.capture_nanos,
        cloud: &frame.points,
        levels: None,
        measured,
        motion: frame.motion(),
    };
    // As in a live run: the answer first, then what the source keeps of the sweep.
    let estimate = source.estimate(&input);
    source.observe(&input);
    estimate
}

/// The same for an oracle: the pose of the nearest of some sweeps, the most that retrieval among them can give.
///
/// # Errors
/// As [`evaluate`].
pub fn evaluate_nearest(
    world_from_sensor: &[Isometry3<f64>],
    options: &SweepSelection,
    on_sweep: &mut dyn FnMut(usize, usize),
) -> Result<Evaluated, Error> {
    evaluate_with(options, on_sweep, |_, truth, _| {
        let truth = truth.isometry().translation.vector;
        let nearest = world_from_sensor.iter().min_by(|a, b| {
            let [a, b] = [a, b].map(|pose| (pose.translation.vector - truth).norm_squared());
            a.total_cmp(&b)
        });
        let estimate = nearest.map_or(NO_SOURCE, |&pose| PoseEstimate::new(pose.into(), 1.0));
        Ok(Localization::from_estimate(estimate, stopwatch()))
    })
}

/// Calls `localize` with each sweep, its true pose and whether it is the first of a vehicle in a scenario.
fn evaluate_with(
    options: &SweepSelection,
    on_sweep: &mut dyn FnMut(usize, usize),
    mut localize: impl FnMut(&Frame, &Pose, bool) -> Result<Localization, LocalizerError>,
) -> Result<Evaluated, Error> {
    // Sweeps that count twice are no further evidence: a fit asks for a number of poses.
    if let Some(reason) = repeated(&options.scenes)? {
        return Err(Error::Input(reason));
    }
    let mut evaluated = Evaluated::default();
    let scenes = options.scenes.iter();
    let datasets = scenes.map(|folder| open_drives(folder, &mut evaluated.left_out));
    let datasets = datasets.collect::<Result<Vec<_>, _>>()?;
    let mut all = Vec::new();
    for scenario in datasets.iter().flat_map(|dataset| &dataset.scenarios) {
        let used =
            present_sweeps(scenario).filter(|(_, tick)| tick.is_multiple_of(options.every.max(1)));
        all.extend(used.map(|sweep| (scenario, sweep)));
    }
    let chosen = evenly_spread(&all, options.sweeps.unwrap_or(usize::MAX));
    let load = LoadOptions {
        lidar_variant: options.variant.clone(),
        ..LoadOptions::default()
    };
    let mut last = None;
    for (place, &(scenario, (agent, tick))) in chosen.iter().enumerate() {
        on_sweep(place + 1, chosen.len());
        let (frame, truth) = match posed(scenario, agent, tick, &load) {
            Ok(posed) => posed,
            // A variant that does not exist is missing from every sweep: the option is wrong, not the data.
            Err(error @ ReadError::NoSuch { .. }) => return Err(error.into()),
            Err(error) => {
                let problem = Problem::from(&error);
                evaluated.left_out.add_unreadable(agent, problem);
                continue;
            }
        };
        let stem = scenario.ticks[tick].stem.clone();
        let vehicle = (std::ptr::from_ref(scenario), agent);
        let is_first = last.replace(vehicle) != Some(vehicle);
        evaluated.sweeps.push(EvaluatedSweep {
            scenario: scenario.name.clone(),
            is_covered: None,
            localization: localize(&frame, &truth, is_first)?,
            cav: frame.cav,
            stem,
            truth,
        });
    }
    if evaluated.sweeps.is_empty() {
        let (scenes, reasons) = (options.scenes.clone(), evaluated.left_out.reasons());
        return Err(Error::NoSweeps(scenes, reasons));
    }
    Ok(evaluated)
}

/// Name of a sweep's outcome.
fn outcome(estimate: &PoseEstimate) -> &'static str {
    match estimate {
        PoseEstimate::Pose { .. } => "pose",
        PoseEstimate::NoPose { reason, .. } => reason.into(),
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use localization::pgc::test_scene::SyntheticScene;
    use protocol::PointCloud;
    use simulator::generate::{Subset, SynthOptions, generate};

    /// Sweeps of a scene of increasing difficulty; every tenth is empty.
    pub(crate) fn evaluated(count: u64) -> Vec<EvaluatedSweep> {
        (0..count)
            .map(|seed| {
                let hardness = seed as f64 / count as f64;
                let outliers = 0.1 + 0.85 * hardness;
                let twins = 0.6 * hardness;
                let cells = if seed % 10 == 9 { 0 } else { 300 };
                let mut scene = SyntheticScene {
                    cells,
                    outliers,
                    twins,
                    next_seed: seed,
                    ..SyntheticScene::default()
                };
                EvaluatedSweep {
                    scenario: "town".into(),
                    cav: CavId::new("7").unwrap(),
                    stem: format!("{seed:06}"),
                    truth: scene.world_from_sensor(seed).into(),
                    is_covered: None,
                    localization: scene
                        .localize(LocalizerInput::of(&PointCloud::default()))
                        .unwrap(),
                }
            })
            .collect()
    }

    #[test]
    fn another_confidence_changes_the_published_pose_and_not_the_estimated_one() {
        let mut sweep = evaluated(10).swap_remove(0);
        let found = sweep.error().unwrap();
        assert_eq!(sweep.published_error(), Some(found));
        let strict = localization::pgc::confidence::ConfidenceModel {
            reject_below: 1.0,
            ..localization::pgc::confidence::ConfidenceModel::example()
        };
        sweep.judge_again(&Confidence::Calibrated(strict));
        assert_eq!(
            (sweep.error(), sweep.published_error()),
            (Some(found), None)
        );
        assert_eq!(outcome(&sweep.localization.estimate), "low_confidence");
    }

    #[test]
    fn a_pose_without_a_covariance_is_no_sample_of_one() {
        let mut sweep = evaluated(10).swap_remove(0);
        assert!(sweep.pose_sample().is_some());
        let estimate = PoseEstimate::new(sweep.truth, 0.9);
        sweep.localization = Localization::from_estimate(estimate, stopwatch());
        assert_eq!(sweep.pose_sample(), None);
        let summary = LocalizationSummary::of(&[sweep]);
        assert!(summary.beyond_95.is_empty(), "{summary:?}");
    }

    /// A source that counts its sweeps since the last beginning.
    #[derive(Debug, Default)]
    struct Counting(Vec<usize>);

    impl PoseSource for Counting {
        fn begin(&mut self) {
            self.0.push(0);
        }

        fn estimate(&mut self, _: &PoseInput<'_>) -> PoseEstimate {
            *self.0.last_mut().unwrap() += 1;
            NO_SOURCE
        }
    }

    #[test]
    fn a_source_begins_with_every_vehicle_and_drive_and_sweeps_without_a_pose_are_left_out() {
        let folder = tempfile::tempdir().unwrap();
        let scenes = [11_u64, 12].map(|seed| {
            let out = folder.path().join(seed.to_string());
            let options = SynthOptions {
                frames: 3,
                ..SynthOptions::new(Subset::Town1loc, seed, out.clone())
            };
            generate(&options, &|_| {}).unwrap();
            out
        });
        let last = dataset::open(&scenes[1]).unwrap().scenarios.swap_remove(0);
        let file = last.points_path(0, 0, None).unwrap().with_extension("yaml");
        let text = std::fs::read_to_string(&file).unwrap();
        std::fs::write(&file, text.replace("lidar_pose", "other_pose")).unwrap();
        let options = SweepSelection {
            scenes: scenes.to_vec(),
            variant: None,
            every: 1,
            sweeps: None,
        };
        let mut source = Counting::default();
        let evaluated = evaluate_source(&mut source, &options, &mut |_, _| ()).unwrap();
        assert_eq!((source.0, evaluated.left_out.ticks), (vec![3, 2], 1));
    }

    #[test]
    fn sweeps_that_are_given_twice_are_refused_by_whatever_path() {
        let folder = tempfile::tempdir().unwrap();
        let drive = folder.path().join("drive");
        let options = SynthOptions {
            frames: 1,
            ..SynthOptions::new(Subset::Town1loc, 11, drive.clone())
        };
        generate(&options, &|_| {}).unwrap();
        let name = dataset::open(&drive).unwrap().scenarios[0].name.clone();
        for again in [drive.join("."), drive.join(&name)] {
            let options = SweepSelection {
                scenes: vec![drive.clone(), again],
                variant: None,
                every: 1,
                sweeps: None,
            };
            let refused = evaluate_source(&mut Counting::default(), &options, &mut |_, _| ());
            let message = refused.unwrap_err().to_string();
            assert!(
                message.contains("both have the sweeps of scenario"),
                "{message}"
            );
        }
    }

    #[test]
    fn folders_without_sweeps_are_named() {
        let empty = tempfile::tempdir().unwrap();
        let options = SweepSelection {
            scenes: vec![empty.path().to_owned()],
            variant: None,
            every: 1,
            sweeps: None,
        };
        let error = evaluate(&mut SyntheticScene::default(), &options, &mut |_, _| {})
            .unwrap_err()
            .to_string();
        assert!(
            error.contains(&empty.path().display().to_string()),
            "{error}"
        );
    }
}
