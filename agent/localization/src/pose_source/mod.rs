//! Pose sources: the origins of an agent's pose.
//!
//! One trait for every source: the recorded pose, that pose with an error of a chosen kind, and an estimate from the
//! sweep alone. A source without a pose returns the reason; it never substitutes one.

mod error_table;
mod localized;
pub mod motion_gate;
mod noise;
mod noisy;
mod numpy_normals;
mod options;
mod pose_table;
mod recorded;
mod settings;
mod table;
mod tracked;

use std::path::{Path, PathBuf};

use nalgebra::Isometry3;
use perception::detector::BackboneLevel;
use perception::inference::Inference;
use perception::weights::FileError;
use protocol::config::FieldError;
use protocol::{CavId, EgoMotion, NoPoseReason, PointCloud, Pose, PoseEstimate, StageTiming};

pub use error_table::{ErrorTable, TableRow};
pub use localized::{BaselinePoseConfig, LocalizedPose, PgcConfig};
pub use noise::PlanarError;
pub use noisy::{NoiseMode, NoisyPose, NoisyPoseConfig};
pub use pose_table::{CachedPoseConfig, PoseRow, PoseTable};
pub use recorded::RecordedPose;
pub use table::PoseSourceConfig;
pub use tracked::{TrackedPose, TrackedPoseConfig};

use crate::pgc::head_files::{encoder_or_named, head_file, is_name, surfel_map_file};
use crate::pgc::{LocalizerError, LocalizerInput};
use crate::tracker::PoseMeasurement;
use settings::{PoseBasis, PoseSettings};

/// Inputs of a source for one sweep.
#[derive(Debug, Clone, Copy)]
pub struct PoseInput<'a> {
    /// Vehicle.
    pub cav: &'a CavId,
    /// Capture time on the clock of the scene, nanoseconds.
    pub capture_nanos: u64,
    /// The sweep, in the LiDAR frame.
    pub cloud: &'a PointCloud,
    /// Levels of the backbone of the vehicle's detector for it, if they are computed already and are those of
    /// [`PoseSource::detector_encoder`].
    pub levels: Option<&'a [BackboneLevel]>,
    /// `world_from_lidar` as recorded, or as a receiver measured it.
    pub measured: Option<&'a Pose>,
    /// Speed and yaw rate of the vehicle at that time, where its sensors measure them.
    pub motion: EgoMotion,
}

impl<'a> PoseInput<'a> {
    /// Input of a localizer, with the predicted pose if there is one.
    pub(crate) fn sweep(&self, predicted: Option<Isometry3<f64>>) -> LocalizerInput<'a> {
        LocalizerInput {
            cloud: self.cloud,
            levels: self.levels,
            predicted,
        }
    }
}

/// Source of an agent's pose.
pub trait PoseSource: std::fmt::Debug + Send {
    /// Begins another vehicle or another drive: what is known of the last one is forgotten.
    fn begin(&mut self) {}

    /// The pose of one sweep with its confidence, or the reason why there is none.
    fn estimate(&mut self, input: &PoseInput<'_>) -> PoseEstimate;

    /// Second step of a sweep, after its pose and its feature map were published: measures for later sweeps. True if
    /// the sweep was measured.
    fn observe(&mut self, _input: &PoseInput<'_>) -> bool {
        false
    }

    /// Starts anew at a pose that is stated, not measured. False of sources that follow no vehicle.
    fn start_at(&mut self, _stated: &PoseMeasurement) -> bool {
        false
    }

    /// SHA-256 of the encoder of the detector whose levels it takes instead of encoding sweeps itself.
    fn detector_encoder(&self) -> Option<&str> {
        None
    }

    /// True if the next [`Self::estimate`] computes from the sweep, so that it can use levels.
    fn computes_from_sweep(&self) -> bool {
        false
    }

    /// Durations of the stages of the last step, for sources that compute.
    fn stages(&self) -> &[StageTiming] {
        &[]
    }

    /// Number of poses so far that the vehicle cannot have reached from the previous ones.
    fn jumps(&self) -> u64 {
        0
    }
}

/// Result if there is no measured pose.
pub const NO_SOURCE: PoseEstimate = no_pose(NoPoseReason::NoSource);

/// Result without a pose and without inliers.
pub const fn no_pose(reason: NoPoseReason) -> PoseEstimate {
    PoseEstimate::no_pose(reason, 0)
}

/// Error of setting up a pose source.
#[derive(Debug, thiserror::Error)]
pub enum PoseSourceError {
    /// A value is out of range, or a file is not named.
    #[error("pose source: {0}")]
    Value(#[from] FieldError),
    /// A table of errors or poses is not readable.
    #[error(transparent)]
    Table(#[from] FileError),
    /// The networks cannot be used.
    #[error(transparent)]
    Localizer(#[from] LocalizerError),
}

impl PoseSourceConfig {
    fn changed(mut self, change: impl FnOnce(&mut dyn PoseSettings)) -> Self {
        if let Some(settings) = self.settings_mut() {
            change(settings);
        }
        self
    }

    /// The same for one scenario of many: tables of poses and seeds of errors differ between scenarios.
    pub fn for_scenario(&self, name: &str) -> Self {
        self.clone().changed(|settings| settings.set_scenario(name))
    }

    /// The same for one vehicle of several on one machine: those that are tracked measure in turn.
    pub fn with_turn(self, turn: u32) -> Self {
        self.changed(|settings| settings.set_turn(turn))
    }

    /// The same for the ego of a fleet: the recorded pose in place of an error that spares it.
    pub fn for_ego(self) -> Self {
        match self.settings().spares_ego() {
            true => Self::Recorded,
            false => self,
        }
    }

    /// The same with every sweep measured, to time a few of them.
    pub fn measuring_every_sweep(self) -> Self {
        self.changed(|settings| settings.measure_every_sweep())
    }

    /// Sweeps from one that is measured after its pose was published to the next, for a vehicle with this motion.
    pub fn measuring_interval(&self, motion: &EgoMotion) -> u32 {
        self.settings().measuring_interval(motion)
    }

    /// Checks the values; files are not opened.
    ///
    /// # Errors
    /// [`FieldError`] of the first value that is out of range, or of a file that is not named.
    pub fn validate(&self) -> Result<(), FieldError> {
        self.settings().validate()
    }

    /// The same with the file of its head where it has the name of a released one, and with the encoder that the head
    /// names where it has none.
    ///
    /// # Errors
    /// [`FileError`] when there is no such head, or no file is its encoder.
    pub fn with_networks(mut self) -> Result<Self, FileError> {
        let networks = self.settings_mut().and_then(|settings| settings.networks());
        // A head that is not given is refused by the check of the values.
        let given = networks.filter(|([_, head, _], _)| !head.as_os_str().is_empty());
        if let Some(([encoder, head, map], _)) = given {
            *head = head_file(head)?;
            if !map.as_os_str().is_empty() {
                *map = surfel_map_file(map)?;
            }
            let given = Some(encoder.as_path()).filter(|file| !file.as_os_str().is_empty());
            *encoder = encoder_or_named(given, head)?;
        }
        Ok(self)
    }

    /// The scene-specific head of PGC, if the source has one.
    pub fn head(&self) -> Option<PathBuf> {
        let mut source = self.clone();
        let ([_, head, _], _) = source.settings_mut()?.networks()?;
        Some(std::mem::take(head))
    }

    /// The same with the paths of its files changed. The name of a released head is no path.
    pub fn map_files(mut self, change: impl Fn(&Path) -> PathBuf) -> Self {
        let files = self.settings_mut().map(|settings| settings.files());
        for file in files.into_iter().flatten() {
            let changed = change(file);
            // A single word may be a file or a released head: the file wins.
            let is_path = changed.exists() || !is_name(file);
            if is_path && !file.as_os_str().is_empty() {
                *file = changed;
            }
        }
        self
    }

    /// Files that the source reads.
    pub fn files(&self) -> Vec<PathBuf> {
        let mut source = self.clone();
        let files = source.settings_mut().map(|settings| settings.files());
        files.into_iter().flatten().map(std::mem::take).collect()
    }

    /// True if poses are estimated from the sweep's points.
    pub fn looks_at_sweeps(&self) -> bool {
        self.settings().basis() == PoseBasis::Sweep
    }

    /// True if poses are made from measured ones.
    pub fn needs_measured_pose(&self) -> bool {
        self.settings().basis() == PoseBasis::MeasuredPose
    }

    /// Sets the source up and reads its files; networks compute by `inference`.
    ///
    /// # Errors
    /// [`PoseSourceError`] names the field or the file.
    pub fn build(&self, inference: Inference) -> Result<Box<dyn PoseSource>, PoseSourceError> {
        self.validate()?;
        self.settings().build(inference)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_recorded_pose_passes_unchanged_and_a_missing_one_gives_a_reason() {
        let cav = CavId::new("7").unwrap();
        let cloud = PointCloud::default();
        let pose = Pose::from_xyz_yaw([1.0, 2.0, 3.0], 0.4);
        let mut input = PoseInput {
            cav: &cav,
            capture_nanos: 5,
            cloud: &cloud,
            levels: None,
            measured: Some(&pose),
            motion: EgoMotion::default(),
        };
        let mut source = PoseSourceConfig::default()
            .build(Inference::default())
            .unwrap();
        assert_eq!(source.estimate(&input), PoseEstimate::new(pose, 1.0));
        input.measured = None;
        assert_eq!(source.estimate(&input), NO_SOURCE);
    }

    #[test]
    fn a_scenario_file_names_the_source() {
        let config: PoseSourceConfig =
            serde_saphyr::from_str("noisy:\n  mode: autoregressive\n  position_std_m: 0.5\n")
                .unwrap();
        let PoseSourceConfig::Noisy(noisy) = &config else {
            panic!("{config:?}")
        };
        assert_eq!(
            (noisy.mode, noisy.position_std_m, noisy.seed),
            (NoiseMode::Autoregressive, 0.5, 25)
        );
        assert_eq!(
            serde_saphyr::from_str::<PoseSourceConfig>("recorded").unwrap(),
            PoseSourceConfig::Recorded
        );
        assert!(
            serde_saphyr::from_str::<PoseSourceConfig>("noisy:\n  posision_std_m: 0.5\n").is_err()
        );
        let config: PoseSourceConfig =
            serde_saphyr::from_str("pgc:\n  encoder: e.safetensors\n  head: h.safetensors\n")
                .unwrap();
        assert_eq!(config.name(), "pgc");
        let message = config.build(Inference::default()).unwrap_err().to_string();
        assert!(message.starts_with("e.safetensors"), "{message}");
        let config: PoseSourceConfig =
            serde_saphyr::from_str("baseline:\n  weights: w.safetensors\n").unwrap();
        let message = config.build(Inference::default()).unwrap_err().to_string();
        assert!(
            config.name() == "baseline" && message.starts_with("w.safetensors"),
            "{message}"
        );
    }
}
