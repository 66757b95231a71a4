//! Tracked pose: the prediction of a pose tracker, published at once; the sweep is measured afterwards.
//!
//! The pose of a sweep is known before anything is computed from it. What the localizer measures in the sweep corrects
//! the poses of later ones. A vehicle that is lost is localized first, as by `pgc`.

use std::path::PathBuf;

use protocol::config::{FieldError, within};
use protocol::{NoPoseReason, PlanarCovariance, PoseEstimate, StageTiming};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use tch::Device;

use super::{PoseInput, PoseSource};
use crate::pgc::{Localization, Localize, Localizer, LocalizerError};
use crate::tracker::{Correction, PoseMeasurement, PoseTracker, TrackedState, TrackerLimits};

/// Networks of PGC and settings of the tracker.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(deny_unknown_fields)]
pub struct TrackedPoseConfig {
    /// Weights of the localizer's scene encoder.
    #[arg(skip)]
    #[serde(default)]
    pub encoder: PathBuf,
    /// Weights of the scene-specific head.
    #[arg(skip)]
    #[serde(default)]
    pub head: PathBuf,
    /// Sweeps from one measurement to the next, 1 to 100 (pose source tracked).
    #[arg(id = "tracking_measure_every", long = "measure-every", value_name = "SWEEPS")]
    #[serde(default = "TrackedPoseConfig::measure_every")]
    pub measure_every: u32,
    /// Number of the first measured sweep: vehicles on one machine take turns (pose source tracked).
    #[arg(id = "tracking_phase", long = "measure-phase", value_name = "SWEEPS")]
    #[serde(default)]
    pub phase: u32,
    /// Longest time between two measurements by the whole localizer, which uses no prediction, seconds (pose source
    /// tracked).
    #[arg(id = "tracking_global_period_s", long = "global-period-s", value_name = "S")]
    #[serde(default = "TrackedPoseConfig::global_period_s")]
    pub global_period_s: f64,
    /// Longest time without an accepted measurement, seconds; then the vehicle is lost (pose source tracked).
    #[arg(id = "tracking_max_coast_s", long = "max-coast-s", value_name = "S")]
    #[serde(default = "TrackedPoseConfig::max_coast_s")]
    pub max_coast_s: f64,
}

impl Default for TrackedPoseConfig {
    /// A measurement in every second sweep, one of the whole localizer every two seconds.
    fn default() -> Self {
        Self {
            encoder: PathBuf::new(),
            head: PathBuf::new(),
            measure_every: Self::measure_every(),
            phase: 0,
            global_period_s: Self::global_period_s(),
            max_coast_s: Self::max_coast_s(),
        }
    }
}

impl TrackedPoseConfig {
    fn measure_every() -> u32 {
        2
    }

    fn global_period_s() -> f64 {
        2.0
    }

    fn max_coast_s() -> f64 {
        3.0
    }

    /// Checks the values; files are not opened.
    ///
    /// # Errors
    /// [`FieldError`] of the first value that is out of range.
    pub fn validate(&self) -> Result<(), FieldError> {
        within("tracked.measure_every", self.measure_every, 1, 100)?;
        within("tracked.global_period_s", self.global_period_s, 0.0, 3600.0)?;
        within("tracked.max_coast_s", self.max_coast_s, 0.0, 60.0)
    }
}

/// Largest standard deviation of a tracked position, metres: the next good measurement is still near the prediction.
const MAX_POSITION_STD_M: f64 = 2.0;

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
    jumps: u64,
    times: Vec<StageTiming>,
}

impl TrackedPose {
    /// Reads the networks, to compute with on `device`.
    ///
    /// # Errors
    /// [`LocalizerError`] names the file and what is wrong with it.
    pub fn load(config: &TrackedPoseConfig, device: Device) -> Result<Self, LocalizerError> {
        let localizer = Localizer::load(&config.encoder, &config.head, device)?;
        Ok(Self::new(Box::new(localizer), config.clone()))
    }

    /// The same with another localizer.
    #[must_use]
    pub fn new(localizer: Box<dyn Localize>, config: TrackedPoseConfig) -> Self {
        let limits = TrackerLimits { max_coast_s: config.max_coast_s, max_position_std_m: MAX_POSITION_STD_M };
        let tracker = PoseTracker::new(limits);
        Self {
            localizer,
            config,
            tracker,
            sweeps: 0,
            measured_nanos: None,
            global_nanos: None,
            jumps: 0,
            times: Vec::new(),
        }
    }

    /// Measures a sweep, near the predicted pose if there is one. `None` if the localizer fails.
    fn measure(&mut self, input: &PoseInput<'_>, predicted: Option<&TrackedState>) -> Option<Localization> {
        self.measured_nanos = Some(input.capture_nanos);
        let measured = match predicted {
            Some(state) => self.localizer.localize_near(input.cloud, &state.world_from_lidar),
            None => {
                self.global_nanos = Some(input.capture_nanos);
                self.localizer.localize(input.cloud)
            }
        };
        match measured {
            Ok(localization) => {
                self.times = localization.times.stages();
                Some(localization)
            }
            Err(error) => {
                tracing::error!(cav = %input.cav, capture_nanos = input.capture_nanos, "no pose: {error}");
                None
            }
        }
    }

    /// Corrects the tracker by the pose of a sweep, if it has one.
    fn correct(&mut self, capture_nanos: u64, localization: &Localization) {
        let published = localization.estimate.world_from_cav();
        let Some(found) = published.and(localization.found.as_ref()) else { return };
        match self.tracker.correct(&PoseMeasurement::new(capture_nanos, found)) {
            Correction::Rejected | Correction::Relocated => self.jumps += 1,
            Correction::Started | Correction::Accepted => {}
        }
    }

    /// Localizes a vehicle that is lost.
    fn start(&mut self, input: &PoseInput<'_>) -> PoseEstimate {
        let Some(localization) = self.measure(input, None) else {
            return PoseEstimate::NoPose { reason: NoPoseReason::Failed, inlier_count: 0 };
        };
        self.correct(input.capture_nanos, &localization);
        match self.tracker.state() {
            Some(state) => published(&state),
            None => localization.estimate,
        }
    }

    /// True if the sweep is one of those that are measured.
    fn is_due(&self) -> bool {
        let turn = self.sweeps + u64::from(self.config.measure_every) - 1;
        let phase = u64::from(self.config.phase);
        self.tracker.needs_measurement() || (turn + phase).is_multiple_of(u64::from(self.config.measure_every))
    }

    /// True if the sweep is measured without the prediction.
    fn is_global_due(&self, capture_nanos: u64) -> bool {
        let since_s = |nanos: u64| (capture_nanos as f64 - nanos as f64) * 1e-9;
        let is_recent = |nanos: u64| (0.0..self.config.global_period_s).contains(&since_s(nanos));
        self.tracker.is_contradicted() || !self.global_nanos.is_some_and(is_recent)
    }
}

impl PoseSource for TrackedPose {
    /// Ignores the measured pose; uses speed and yaw rate where there are such.
    fn estimate(&mut self, input: &PoseInput<'_>) -> PoseEstimate {
        self.times.clear();
        self.sweeps += 1;
        match self.tracker.predict(input.capture_nanos, &input.motion) {
            Some(state) => published(&state),
            None => self.start(input),
        }
    }

    fn observe(&mut self, input: &PoseInput<'_>) -> bool {
        let is_measured = self.measured_nanos == Some(input.capture_nanos);
        let Some(state) = self.tracker.state().filter(|_| !is_measured && self.is_due()) else { return false };
        let predicted = (!self.is_global_due(input.capture_nanos)).then_some(&state);
        if let Some(localization) = self.measure(input, predicted) {
            self.correct(input.capture_nanos, &localization);
        }
        true
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
    use protocol::{CavId, EgoMotion, PointCloud, Pose};

    use super::*;
    use crate::pgc::LocalizerTimes;

    /// A vehicle that drives at 10 m/s along x; every sweep holds its number of points.
    #[derive(Debug, Default)]
    struct Road {
        globals: Arc<AtomicU64>,
        nears: Arc<AtomicU64>,
        /// Sweeps from this one on are elsewhere.
        carried_at: usize,
        /// Sweeps without a pose.
        blind: std::ops::Range<usize>,
    }

    impl Road {
        fn result(&self, cloud: &PointCloud) -> Localization {
            let sweep = cloud.xyzi.len();
            let aside = if sweep >= self.carried_at { 300.0 } else { 0.0 };
            let pose = Pose::from_xyz_yaw([sweep as f64, aside, 2.0], 0.0);
            let none = PoseEstimate::NoPose { reason: NoPoseReason::TooFewInliers, inlier_count: 3 };
            let estimate = if self.blind.contains(&sweep) { none } else { PoseEstimate::new(pose, 0.99) };
            Localization::from_estimate(estimate, LocalizerTimes::default())
        }
    }

    impl Localize for Road {
        fn localize(&mut self, cloud: &PointCloud) -> Result<Localization, LocalizerError> {
            self.globals.fetch_add(1, Ordering::Relaxed);
            Ok(self.result(cloud))
        }

        fn localize_near(&mut self, cloud: &PointCloud, _: &Isometry3<f64>) -> Result<Localization, LocalizerError> {
            self.nears.fetch_add(1, Ordering::Relaxed);
            Ok(self.result(cloud))
        }
    }

    /// Poses of sweeps, and the numbers of measurements by the whole localizer and near the prediction.
    fn drive(road: Road, config: TrackedPoseConfig, sweeps: usize) -> (Vec<PoseEstimate>, [u64; 2]) {
        let (globals, nears) = (Arc::clone(&road.globals), Arc::clone(&road.nears));
        let mut source = TrackedPose::new(Box::new(road), config);
        let cav = CavId::new("7").unwrap();
        let estimates = (0..sweeps).map(|sweep| {
            let cloud = PointCloud { xyzi: vec![[0.0; 4]; sweep] };
            let capture_nanos = sweep as u64 * 100_000_000;
            let motion = EgoMotion { speed_mps: Some(10.0), yaw_rate_rad_s: None };
            let input = PoseInput { cav: &cav, capture_nanos, cloud: &cloud, measured: None, motion };
            let estimate = source.estimate(&input);
            source.observe(&input);
            estimate
        });
        (estimates.collect(), [globals.load(Ordering::Relaxed), nears.load(Ordering::Relaxed)])
    }

    fn road() -> Road {
        Road { carried_at: usize::MAX, ..Road::default() }
    }

    fn x_y(estimate: &PoseEstimate) -> [f64; 2] {
        let [x, y, _] = estimate.world_from_cav().unwrap().translation_m;
        [x, y]
    }

    #[test]
    fn every_second_sweep_is_measured_and_each_has_a_pose() {
        let (estimates, [globals, nears]) = drive(road(), TrackedPoseConfig::default(), 41);
        for (sweep, estimate) in estimates.iter().enumerate() {
            let [x, y] = x_y(estimate);
            assert!((x - sweep as f64).abs() < 0.2 && y.abs() < 0.1, "sweep {sweep}: {x}, {y}");
        }
        // Four seconds: one at the start and one every two seconds.
        assert_eq!((globals, globals + nears), (3, 21));
        assert!(estimates.iter().all(|estimate| estimate.covariance().is_some() && estimate.confidence() > 0.9));
    }

    #[test]
    fn vehicles_of_other_phases_measure_other_sweeps() {
        let (_, [globals, nears]) = drive(road(), TrackedPoseConfig { phase: 1, ..Default::default() }, 41);
        assert_eq!(globals + nears, 21, "the first sweep, and then those of odd numbers");
    }

    #[test]
    fn a_carried_vehicle_is_noticed_at_once_and_found_within_a_second() {
        let (estimates, _) = drive(Road { carried_at: 20, ..road() }, TrackedPoseConfig::default(), 40);
        assert!(estimates[22].confidence() < 0.01, "{:?}", estimates[22]);
        let found = estimates.iter().skip(20).position(|estimate| x_y(estimate)[1] > 299.0).unwrap();
        assert!(found <= 10, "{found} sweeps");
    }

    #[test]
    fn sweeps_without_a_measurement_are_predicted_for_a_while_and_then_have_none() {
        let (estimates, _) = drive(Road { blind: 20..80, ..road() }, TrackedPoseConfig::default(), 90);
        let without: Vec<usize> = (0..90).filter(|&sweep| estimates[sweep].world_from_cav().is_none()).collect();
        let (first, last) = (without[0], without[without.len() - 1]);
        assert!((25..=50).contains(&first) && last == 79, "{first}, {last}");
        let lost = PoseEstimate::NoPose { reason: NoPoseReason::TooFewInliers, inlier_count: 3 };
        assert_eq!(estimates[first], lost);
        let confidence: Vec<f32> = estimates[21..first].iter().map(PoseEstimate::confidence).collect();
        assert!(confidence.windows(2).all(|pair| pair[1] < pair[0]), "{confidence:?}");
    }

    #[test]
    fn settings_out_of_range_are_named() {
        let refused = |config: TrackedPoseConfig| config.validate().unwrap_err().to_string();
        assert!(refused(TrackedPoseConfig { measure_every: 0, ..Default::default() }).contains("measure_every is 0"));
        assert!(refused(TrackedPoseConfig { max_coast_s: -1.0, ..Default::default() }).contains("max_coast_s"));
    }
}
