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
    /// Reads the networks, to compute with on the CPU.
    ///
    /// # Errors
    /// [`LocalizerError`] names the file and what is wrong with it.
    pub fn load(config: &TrackedPoseConfig) -> Result<Self, LocalizerError> {
        let localizer = Localizer::load(&config.encoder, &config.head, Device::Cpu)?;
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
        self.tracker.is_contradicted() || (turn + phase).is_multiple_of(u64::from(self.config.measure_every))
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

    fn observe(&mut self, input: &PoseInput<'_>) {
        self.times.clear();
        let is_measured = self.measured_nanos == Some(input.capture_nanos);
        let Some(state) = self.tracker.state().filter(|_| !is_measured && self.is_due()) else { return };
        let predicted = (!self.is_global_due(input.capture_nanos)).then_some(&state);
        if let Some(localization) = self.measure(input, predicted) {
            self.correct(input.capture_nanos, &localization);
        }
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
