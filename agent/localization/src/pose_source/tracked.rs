//! Tracked pose: the prediction of a pose tracker, published at once; the sweep is measured afterwards.
//!
//! The pose of a sweep is known before anything is computed from it. What the localizer measures in the sweep corrects
//! the poses of later ones. A vehicle that is lost is localized first, as by `pgc`.

use std::path::{Path, PathBuf};

use perception::inference::Inference;
use protocol::config::{FieldError, within};
use protocol::{CavId, EgoMotion, NoPoseReason, PlanarCovariance, PoseEstimate, StageTiming};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::settings::{PoseSettings, require_file};
use super::{PoseInput, PoseSource, PoseSourceError, no_pose};
use crate::pgc::{Localization, Localize, LocalizerError};
use crate::place_localizer::place_localizer;
use crate::tracker::{
    Correction, MotionContradiction, PoseMeasurement, PoseTracker, TrackedState, seconds,
};

/// Networks of PGC and settings of the tracker.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(default, deny_unknown_fields)]
pub struct TrackedPoseConfig {
    /// Weights of the encoder: the scene encoder, or a detector whose backbone serves both. Absent: those that the head
    /// names.
    #[arg(skip)]
    pub encoder: PathBuf,
    /// Weights of the scene-specific head, or the name of a released one; or a surfel map in its place.
    #[arg(skip)]
    pub head: PathBuf,
    /// Surfel map of the place, or the name of a released one. Absent: poses are not registered to a map.
    #[arg(skip)]
    pub surfel_map: PathBuf,
    /// Least confidence of a pose that is found without a prediction, 0 to 1: others are rejected, beside those that the
    /// head rejects.
    #[arg(skip)]
    pub min_confidence: f64,
    /// Sweeps from one measurement to the next, 1 to 100, of a vehicle that measures its yaw rate; of one without, half
    /// as many (pose source tracked).
    #[arg(id = "tracking_measure_every", long = "measure-every")]
    #[arg(value_name = "SWEEPS")]
    pub measure_every: u32,
    /// Number of the first measured sweep: vehicles on one machine take turns (pose source tracked).
    #[arg(id = "tracking_phase", long = "measure-phase", value_name = "SWEEPS")]
    pub phase: u32,
    /// Longest time between two measurements by the whole localizer, which uses no prediction, seconds (pose source
    /// tracked).
    #[arg(id = "tracking_global_period_s", long = "global-period-s")]
    #[arg(value_name = "S")]
    pub global_period_s: f64,
    /// Longest time without an accepted measurement, seconds; then the vehicle is lost (pose source tracked).
    #[arg(id = "tracking_max_coast_s", long = "max-coast-s", value_name = "S")]
    pub max_coast_s: f64,
}

impl Default for TrackedPoseConfig {
    /// A measurement in every fourth sweep (every second without yaw rate), one of the whole localizer every two seconds.
    fn default() -> Self {
        Self {
            encoder: PathBuf::new(),
            head: PathBuf::new(),
            surfel_map: PathBuf::new(),
            min_confidence: 0.0,
            measure_every: 4,
            phase: 0,
            global_period_s: 2.0,
            max_coast_s: 3.0,
        }
    }
}

impl PoseSettings for TrackedPoseConfig {
    fn build(&self, inference: Inference) -> Result<Box<dyn PoseSource>, PoseSourceError> {
        let localizer = TrackedPose::localizer(self, inference)?;
        Ok(Box::new(TrackedPose::new(localizer, self.clone())))
    }

    fn validate(&self) -> Result<(), FieldError> {
        require_file("tracked.head", "--head", &self.head)?;
        within("tracked.min_confidence", self.min_confidence, 0.0, 1.0)?;
        within("tracked.measure_every", self.measure_every, 1, 100)?;
        within("tracked.global_period_s", self.global_period_s, 0.0, 3600.0)?;
        within("tracked.max_coast_s", self.max_coast_s, 0.0, 60.0)
    }

    fn networks(&mut self) -> Option<([&mut PathBuf; 3], &mut f64)> {
        let files = [&mut self.encoder, &mut self.head, &mut self.surfel_map];
        Some((files, &mut self.min_confidence))
    }

    fn option_prefix() -> &'static str {
        "tracking"
    }

    fn set_turn(&mut self, turn: u32) {
        self.phase = self.phase.saturating_add(turn);
    }

    fn measure_every_sweep(&mut self) {
        self.measure_every = 1;
    }

    /// Without yaw rate the prediction lags in turns.
    fn measuring_interval(&self, motion: &EgoMotion) -> u32 {
        match motion.yaw_rate_rad_s {
            Some(_) => self.measure_every,
            None => self.measure_every.div_ceil(2),
        }
    }
}

/// Longest time for which the last pose of a lost vehicle tells where it is, seconds.
const LAST_PLACE_S: f64 = 60.0;
/// Largest number of parts of the scene in which a sweep is sought: a lost vehicle is sought again in its next sweep, and
/// outside the scene every sweep costs them all.
const MOST_PARTS: usize = 4;

/// Follows one vehicle and measures its pose in some of its sweeps.
#[derive(Debug)]
pub struct TrackedPose {
    localizer: Box<dyn Localize>,
    config: TrackedPoseConfig,
    tracker: PoseTracker,
    /// Number of sweeps so far.
    sweeps: u64,
    /// Capture time of the last sweep that was measured, and of the last that was by the whole localizer, nanoseconds.
    measured_nanos: Option<u64>,
    global_nanos: Option<u64>,
    /// Capture time of the last sweep with a pose, nanoseconds, and x and y of that pose, metres.
    last_place: Option<(u64, [f64; 2])>,
    jumps: u64,
    /// True of the speed, and of the yaw rate, if it was named as one that is not used.
    is_reported: [bool; 2],
    times: Vec<StageTiming>,
}

impl TrackedPose {
    /// Reads the networks: the localizer of a tracked vehicle.
    ///
    /// # Errors
    /// [`LocalizerError`] names the file and what is wrong with it.
    pub fn localizer(
        config: &TrackedPoseConfig,
        inference: Inference,
    ) -> Result<Box<dyn Localize>, LocalizerError> {
        let files: [&Path; 3] = [&config.encoder, &config.head, &config.surfel_map];
        place_localizer(files, config.min_confidence, inference, |pgc| {
            pgc.most_parts = MOST_PARTS;
        })
    }

    /// Follows a vehicle with another localizer.
    pub fn new(localizer: Box<dyn Localize>, config: TrackedPoseConfig) -> Self {
        Self {
            localizer,
            tracker: PoseTracker::new(config.max_coast_s),
            config,
            sweeps: 0,
            measured_nanos: None,
            global_nanos: None,
            last_place: None,
            jumps: 0,
            is_reported: [false; 2],
            times: Vec::new(),
        }
    }

    /// Measures a sweep, near the predicted pose if there is one. `None` if the localizer fails.
    fn measure(
        &mut self,
        input: &PoseInput<'_>,
        predicted: Option<&TrackedState>,
    ) -> Option<Localization> {
        self.measured_nanos = Some(input.capture_nanos);
        if predicted.is_none() {
            self.global_nanos = Some(input.capture_nanos);
        }
        let predicted = predicted.map(|state| state.world_from_lidar);
        match self.localizer.localize(input.sweep(predicted)) {
            Ok(localization) => {
                self.times = localization.times.timings().to_vec();
                Some(localization)
            }
            Err(error) => {
                tracing::error!(cav = %input.cav, capture_nanos = input.capture_nanos, "no pose: {error}");
                None
            }
        }
    }

    /// Corrects the tracker by the pose of a sweep; false if it has none.
    fn correct(&mut self, capture_nanos: u64, localization: &Localization) -> bool {
        // A pose that the localizer rejects is `found` as well and must not correct the tracker.
        let published = localization.estimate.world_from_cav();
        let Some(found) = published.and(localization.found.as_ref()) else {
            return false;
        };
        let measurement = PoseMeasurement::new(capture_nanos, found);
        match self.tracker.correct(&measurement) {
            Correction::Rejected | Correction::Relocated => self.jumps += 1,
            Correction::Started | Correction::Accepted => {}
        }
        true
    }

    /// Names a speed or a yaw rate that is not used from here on, once.
    fn report_refuted(&mut self, cav: &CavId) {
        let refuted = self.tracker.refuted().into_iter();
        let of = [("speed", "m/s"), ("yaw rate", "rad/s")];
        for ((refuted, is_reported), (name, unit)) in refuted.zip(&mut self.is_reported).zip(of) {
            let news = refuted.filter(|_| !std::mem::replace(is_reported, true));
            if let Some(MotionContradiction { measured, of_poses }) = news {
                tracing::warn!(
                    %cav,
                    "the vehicle measures a {name} of {measured:.2} {unit} where its poses give {of_poses:.2} {unit}: its \
                     {name} is not used from here on"
                );
            }
        }
    }

    /// Localizes a vehicle that is lost, or was found by one pose that no other confirms yet.
    fn start(&mut self, input: &PoseInput<'_>) -> PoseEstimate {
        let Some(localization) = self.measure(input, None) else {
            return no_pose(NoPoseReason::Failed);
        };
        let has_pose = self.correct(input.capture_nanos, &localization);
        // Without a pose nothing is tracked: what the localizer gives as the reason is published.
        match self.tracker.state().filter(|_| has_pose) {
            Some(state) => published(&state),
            None if localization.found.is_none_or(|found| found.is_rejected)
                && self.has_low_coverage(input.capture_nanos) =>
            {
                PoseEstimate::no_pose(NoPoseReason::LowCoverage, localization.inlier_count)
            }
            None => localization.estimate,
        }
    }

    /// True if the head was trained on few or no sweeps near the last pose of the vehicle, and that is recent.
    fn has_low_coverage(&self, capture_nanos: u64) -> bool {
        let (Some((nanos, place_m)), Some(area)) = (self.last_place, self.localizer.driven_area())
        else {
            return false;
        };
        (0.0..LAST_PLACE_S).contains(&seconds(nanos, capture_nanos)) && !area.covers(place_m)
    }

    /// True if the sweep is one of those that are measured.
    fn is_due(&self, mut motion: EgoMotion) -> bool {
        if let [_, Some(_)] = self.tracker.refuted() {
            motion.yaw_rate_rad_s = None;
        }
        let interval = u64::from(self.config.measuring_interval(&motion));
        // Sweeps count from 1: with phase 0 the first one is due.
        let turn = self.sweeps + interval - 1 + u64::from(self.config.phase);
        self.tracker.needs_measurement() || turn.is_multiple_of(interval)
    }

    /// True if the sweep is measured without the prediction.
    fn is_global_due(&self, capture_nanos: u64) -> bool {
        // Negative after a restart of the scene, which is not recent.
        let since_s = self.global_nanos.map(|nanos| seconds(nanos, capture_nanos));
        let recent_s = 0.0..self.config.global_period_s;
        // A prediction that a measurement contradicts is no place to search near.
        self.tracker.is_contradicted()
            || !since_s.is_some_and(|since_s| recent_s.contains(&since_s))
    }
}

impl PoseSource for TrackedPose {
    fn begin(&mut self) {
        self.tracker.begin();
        (self.sweeps, self.is_reported) = (0, [false; 2]);
        (self.measured_nanos, self.global_nanos, self.last_place) = (None, None, None);
    }

    /// Ignores the measured pose; uses speed and yaw rate where there are such.
    fn estimate(&mut self, input: &PoseInput<'_>) -> PoseEstimate {
        self.times.clear();
        self.sweeps += 1;
        let predicted = self.tracker.predict(input.capture_nanos, &input.motion);
        self.report_refuted(input.cav);
        let Some(state) = predicted.filter(|_| self.tracker.is_confirmed()) else {
            return self.start(input);
        };
        let place = state.world_from_lidar.translation.vector;
        self.last_place = Some((input.capture_nanos, [place.x, place.y]));
        published(&state)
    }

    fn observe(&mut self, input: &PoseInput<'_>) -> bool {
        let is_measured = self.measured_nanos == Some(input.capture_nanos);
        let state = self.tracker.state();
        let Some(state) = state.filter(|_| !is_measured && self.is_due(input.motion)) else {
            return false;
        };
        let predicted = (!self.is_global_due(input.capture_nanos)).then_some(&state);
        if let Some(localization) = self.measure(input, predicted)
            && !self.correct(input.capture_nanos, &localization)
            && predicted.is_some()
        {
            // The prediction may be wrong: the next measurement does not use it.
            self.global_nanos = None;
        }
        true
    }

    /// Measures the next sweep near the stated pose, not in the whole scene: the place that is found there may be the
    /// wrong one that the person corrects.
    fn start_at(&mut self, stated: &PoseMeasurement) -> bool {
        self.tracker.restart(stated);
        self.global_nanos = Some(stated.capture_nanos);
        true
    }

    fn detector_encoder(&self) -> Option<&str> {
        self.localizer.detector_encoder()
    }

    /// A vehicle that is lost is localized first.
    fn computes_from_sweep(&self) -> bool {
        !self.tracker.is_confirmed()
    }

    fn stages(&self) -> &[StageTiming] {
        &self.times
    }

    fn jumps(&self) -> u64 {
        self.jumps
    }
}

/// Message of a tracked pose. Its confidence is that of the expected squared error (Eq. 6).
fn published(state: &TrackedState) -> PoseEstimate {
    let PlanarCovariance { xx_m2, yy_m2, .. } = state.covariance;
    PoseEstimate::Pose {
        world_from_cav: state.world_from_lidar.into(),
        confidence: 1.0 / (1.0 + xx_m2 + yy_m2),
        covariance: Some(state.covariance),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU64, Ordering};

    use nalgebra::Isometry3;
    use protocol::{PointCloud, Pose};

    use super::*;
    use crate::pgc::driven_area::DrivenArea;
    use crate::pgc::{LocalizerInput, stopwatch};

    /// A vehicle that drives at 10 m/s along x; every sweep holds its number of points.
    #[derive(Debug, Default)]
    struct Road {
        globals: Arc<AtomicU64>,
        nears: Arc<AtomicU64>,
        /// Sweeps from this one on are elsewhere.
        carried_at: usize,
        /// Sweeps without a pose.
        blind: std::ops::Range<usize>,
        driven: Option<DrivenArea>,
    }

    impl Road {
        fn result(&self, cloud: &PointCloud) -> Localization {
            let sweep = cloud.xyzi.len();
            let aside = if sweep >= self.carried_at { 300.0 } else { 0.0 };
            let pose = Pose::from_xyz_yaw([sweep as f64, aside, 2.0], 0.0);
            let none = PoseEstimate::NoPose {
                reason: NoPoseReason::TooFewInliers,
                inlier_count: 3,
            };
            let estimate = if self.blind.contains(&sweep) {
                none
            } else {
                PoseEstimate::new(pose, 0.99)
            };
            Localization::from_estimate(estimate, stopwatch())
        }
    }

    impl Localize for Road {
        fn localize(&mut self, sweep: LocalizerInput<'_>) -> Result<Localization, LocalizerError> {
            let count = match sweep.predicted {
                Some(_) => &self.nears,
                None => &self.globals,
            };
            count.fetch_add(1, Ordering::Relaxed);
            Ok(self.result(sweep.cloud))
        }

        fn driven_area(&self) -> Option<&DrivenArea> {
            self.driven.as_ref()
        }
    }

    /// Poses of sweeps, and the numbers of measurements by the whole localizer and near the prediction, without a yaw rate.
    fn drive(
        road: Road,
        config: TrackedPoseConfig,
        sweeps: usize,
    ) -> (Vec<PoseEstimate>, [u64; 2]) {
        let (globals, nears) = (Arc::clone(&road.globals), Arc::clone(&road.nears));
        let steps = steps(road, config, None).take(sweeps);
        let estimates = steps.map(|(estimate, _)| estimate).collect();
        (
            estimates,
            [
                globals.load(Ordering::Relaxed),
                nears.load(Ordering::Relaxed),
            ],
        )
    }

    /// Each sweep's pose, and whether the sweep was measured afterwards.
    fn steps(
        road: Road,
        config: TrackedPoseConfig,
        yaw_rate_rad_s: Option<f64>,
    ) -> impl Iterator<Item = (PoseEstimate, bool)> {
        let mut source = TrackedPose::new(Box::new(road), config);
        let cav = CavId::new("7").unwrap();
        (0usize..).map(move |sweep| {
            let cloud = PointCloud {
                xyzi: vec![[0.0; 4]; sweep],
            };
            let capture_nanos = sweep as u64 * 100_000_000;
            let motion = EgoMotion {
                speed_mps: Some(10.0),
                yaw_rate_rad_s,
            };
            let input = PoseInput {
                cav: &cav,
                capture_nanos,
                cloud: &cloud,
                levels: None,
                measured: None,
                motion,
            };
            (source.estimate(&input), source.observe(&input))
        })
    }

    fn road() -> Road {
        Road {
            carried_at: usize::MAX,
            ..Road::default()
        }
    }

    fn x_y(estimate: &PoseEstimate) -> [f64; 2] {
        let [x, y, _] = estimate.world_from_cav().unwrap().translation_m;
        [x, y]
    }

    #[test]
    fn without_a_yaw_rate_every_second_sweep_is_measured_and_each_has_a_pose() {
        let (estimates, [globals, nears]) = drive(road(), TrackedPoseConfig::default(), 41);
        for (sweep, estimate) in estimates.iter().enumerate() {
            let [x, y] = x_y(estimate);
            assert!(
                (x - sweep as f64).abs() < 0.2 && y.abs() < 0.1,
                "sweep {sweep}: {x}, {y}"
            );
        }
        // Four seconds: one at the start and one every two seconds. The second sweep is measured as well, since one pose
        // cannot contradict a speed.
        assert_eq!((globals, globals + nears), (3, 22));
        assert!(
            estimates
                .iter()
                .all(|estimate| estimate.covariance().is_some() && estimate.confidence() > 0.9)
        );
    }

    #[test]
    fn vehicles_of_other_phases_measure_other_sweeps() {
        let (_, [globals, nears]) = drive(
            road(),
            TrackedPoseConfig {
                phase: 1,
                ..Default::default()
            },
            41,
        );
        assert_eq!(
            globals + nears,
            21,
            "the first sweep, and then those of odd numbers"
        );
    }

    #[test]
    fn with_a_yaw_rate_every_fourth_sweep_is_measured_and_vehicles_take_turns() {
        for (phase, turn) in (0u32..8).zip(0usize..) {
            let config = TrackedPoseConfig {
                phase,
                ..Default::default()
            };
            let steps = steps(road(), config, Some(0.0)).take(44).enumerate();
            let measured = steps
                .skip(4)
                .filter(|(_, (_, is_measured))| *is_measured)
                .map(|(sweep, _)| sweep);
            let expected: Vec<usize> = (4..44)
                .filter(|sweep| (sweep + turn).is_multiple_of(4))
                .collect();
            assert_eq!(measured.collect::<Vec<_>>(), expected, "phase {phase}");
        }
        let estimates: Vec<_> = steps(road(), TrackedPoseConfig::default(), Some(0.0))
            .take(44)
            .collect();
        // One pose of this localizer says little of the heading.
        for (sweep, (estimate, _)) in estimates.iter().enumerate().skip(5) {
            assert!(
                (x_y(estimate)[0] - sweep as f64).abs() < 0.2 && estimate.confidence() > 0.9,
                "sweep {sweep}"
            );
        }
    }

    #[test]
    fn a_carried_vehicle_is_noticed_at_once_and_found_within_a_second() {
        let (estimates, _) = drive(
            Road {
                carried_at: 20,
                ..road()
            },
            TrackedPoseConfig::default(),
            40,
        );
        assert!(estimates[22].confidence() < 0.01, "{:?}", estimates[22]);
        let found = estimates
            .iter()
            .skip(20)
            .position(|estimate| x_y(estimate)[1] > 299.0)
            .unwrap();
        assert!(found <= 10, "{found} sweeps");
    }

    #[test]
    fn sweeps_without_a_measurement_are_predicted_for_a_while_and_then_have_none() {
        let (estimates, _) = drive(
            Road {
                blind: 20..80,
                ..road()
            },
            TrackedPoseConfig::default(),
            90,
        );
        let without: Vec<usize> = (0..90)
            .filter(|&sweep| estimates[sweep].world_from_cav().is_none())
            .collect();
        let (first, last) = (without[0], without[without.len() - 1]);
        assert!((25..=50).contains(&first) && last == 79, "{first}, {last}");
        let lost = PoseEstimate::NoPose {
            reason: NoPoseReason::TooFewInliers,
            inlier_count: 3,
        };
        assert_eq!(estimates[first], lost);
        let confidence: Vec<f32> = estimates[21..first]
            .iter()
            .map(PoseEstimate::confidence)
            .collect();
        assert!(
            confidence.windows(2).all(|pair| pair[1] < pair[0]),
            "{confidence:?}"
        );
    }

    #[test]
    fn a_prediction_without_a_pose_near_it_is_not_used_for_the_next_measurement() {
        let blind = Road {
            blind: 10..11,
            ..road()
        };
        let (_, counts) = drive(blind, TrackedPoseConfig::default(), 13);
        assert_eq!(counts, [3, 5], "whole in the sweeps 0, 1 and 12");
    }

    #[test]
    fn one_pose_that_no_other_confirms_is_not_followed() {
        let wrong = Road {
            carried_at: 1,
            ..road()
        };
        let (estimates, _) = drive(wrong, TrackedPoseConfig::default(), 10);
        assert!(x_y(&estimates[0])[1].abs() < 0.1, "{:?}", estimates[0]);
        assert!(
            estimates[1..].iter().all(|pose| x_y(pose)[1] > 299.0),
            "{estimates:?}"
        );
        let blind = Road {
            blind: 1..5,
            ..road()
        };
        let (estimates, _) = drive(blind, TrackedPoseConfig::default(), 10);
        let has_pose = estimates.iter().map(|pose| pose.world_from_cav().is_some());
        let without: Vec<usize> = (0..)
            .zip(has_pose)
            .filter(|(_, has)| !has)
            .map(|(sweep, _)| sweep)
            .collect();
        assert_eq!(without, [1, 2, 3, 4]);
    }

    #[test]
    fn a_vehicle_that_is_lost_in_low_coverage_reports_it() {
        let reasons = [-60.0, 30.0].map(|x| {
            let blind = Road {
                blind: 20..80,
                driven: Some(DrivenArea::of(&[[x, 0.0], [x + 30.0, 0.0]])),
                ..road()
            };
            drive(blind, TrackedPoseConfig::default(), 79).0[78]
        });
        let expected = [NoPoseReason::LowCoverage, NoPoseReason::TooFewInliers];
        assert_eq!(
            reasons,
            expected.map(|reason| PoseEstimate::no_pose(reason, 3))
        );
    }

    /// One sweep of a vehicle that drives straight ahead, with a pose that is stated before it.
    fn step(source: &mut TrackedPose, sweep: usize, stated: Option<[f64; 2]>) -> PoseEstimate {
        let cloud = PointCloud {
            xyzi: vec![[0.0; 4]; sweep],
        };
        let capture_nanos = sweep as u64 * 100_000_000;
        let input = PoseInput {
            cav: &CavId::new("7").unwrap(),
            capture_nanos,
            cloud: &cloud,
            levels: None,
            measured: None,
            motion: EgoMotion {
                speed_mps: Some(10.0),
                yaw_rate_rad_s: Some(0.0),
            },
        };
        if let Some([x, y]) = stated {
            assert!(source.start_at(&PoseMeasurement {
                capture_nanos,
                world_from_lidar: Isometry3::translation(x, y, 2.0),
                position_std_m: 0.5,
                yaw_std_rad: 0.1,
            }));
        }
        let estimate = source.estimate(&input);
        source.observe(&input);
        estimate
    }

    #[test]
    fn a_stated_pose_is_where_the_vehicle_is_until_its_sweeps_tell() {
        let mut source = TrackedPose::new(
            Box::new(Road {
                blind: 0..12,
                ..road()
            }),
            TrackedPoseConfig::default(),
        );
        let first = step(&mut source, 9, None);
        assert_eq!(first.world_from_cav(), None, "nothing is known");
        let stated = step(&mut source, 10, Some([10.6, 0.3]));
        assert_eq!(x_y(&stated), [10.6, 0.3]);
        assert!(stated.confidence() < 0.7, "it is no measurement");
        let [x, y] = x_y(&step(&mut source, 11, None));
        assert!((x - 11.6).abs() < 0.1 && (y - 0.3).abs() < 0.1, "{x}, {y}");
        let found = (12..20).map(|sweep| x_y(&step(&mut source, sweep, None)));
        let found: Vec<[f64; 2]> = found.collect();
        let [x, y] = found[7];
        assert!((x - 19.0).abs() < 0.2 && y.abs() < 0.1, "{found:?}");
    }

    #[test]
    fn another_vehicle_begins_without_the_track_of_the_last_one() {
        let mut source = TrackedPose::new(Box::new(road()), TrackedPoseConfig::default());
        for sweep in 0..10 {
            step(&mut source, sweep, None);
        }
        // The road is blind there: any pose would be one of the track.
        source.localizer = Box::new(Road {
            blind: 0..100,
            ..road()
        });
        assert!(
            step(&mut source, 10, None).world_from_cav().is_some(),
            "the same"
        );
        source.begin();
        assert_eq!(step(&mut source, 11, None).world_from_cav(), None);
        assert_eq!((source.sweeps, source.last_place), (1, None));
    }

    #[test]
    fn settings_out_of_range_are_named() {
        let unmeasured = TrackedPoseConfig {
            head: "head".into(),
            measure_every: 0,
            ..Default::default()
        };
        let backwards = TrackedPoseConfig {
            head: "head".into(),
            max_coast_s: -1.0,
            ..Default::default()
        };
        for (config, named) in [
            (unmeasured, "measure_every is 0"),
            (backwards, "max_coast_s"),
        ] {
            let message = config.validate().unwrap_err().to_string();
            assert!(message.contains(named), "{message}");
        }
    }
}
