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
mod tracked;

use std::path::{Path, PathBuf};

use perception::detector::BackboneLevel;
use perception::inference::Inference;
use perception::weights::FileError;
use protocol::config::{FieldError, within};
use protocol::{CavId, EgoMotion, NoPoseReason, PointCloud, Pose, PoseEstimate, StageTiming};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use error_table::{ErrorTable, TableRow};
pub use localized::{BaselinePoseConfig, LocalizedPose, PgcConfig};
pub use noise::PlanarError;
pub use noisy::NoisyPose;
pub(crate) use pose_table::CachedPose;
pub use pose_table::{CachedPoseConfig, PoseRow, PoseTable};
pub use tracked::{TrackedPose, TrackedPoseConfig};

use crate::pgc::head_files::{encoder_or_named, head_file, is_name};
use crate::pgc::{LocalizerError, LocalizerInput};
use crate::tracker::PoseMeasurement;

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
    /// Input of a localizer.
    pub(crate) fn sweep(&self) -> LocalizerInput<'a> {
        LocalizerInput {
            cloud: self.cloud,
            levels: self.levels,
            predicted: None,
        }
    }
}

/// Source of an agent's pose.
pub trait PoseSource: std::fmt::Debug + Send {
    /// The pose of one sweep with its confidence, or the reason why there is none.
    fn estimate(&mut self, input: &PoseInput<'_>) -> PoseEstimate;

    /// Second step of a sweep, after its pose and its feature map were published: measures for later sweeps. True if
    /// the sweep was measured.
    fn observe(&mut self, input: &PoseInput<'_>) -> bool {
        let _ = input;
        false
    }

    /// Starts anew at a pose that is stated, not measured. False of sources that follow no vehicle.
    fn start_at(&mut self, stated: &PoseMeasurement) -> bool {
        let _ = stated;
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

/// Returns the measured pose unchanged, with full confidence.
#[derive(Debug, Clone, Copy, Default)]
pub struct RecordedPose;

impl PoseSource for RecordedPose {
    fn estimate(&mut self, input: &PoseInput<'_>) -> PoseEstimate {
        match input.measured {
            Some(pose) => PoseEstimate::new(*pose, 1.0),
            None => NO_SOURCE,
        }
    }
}

/// Result if there is no measured pose.
pub const NO_SOURCE: PoseEstimate = PoseEstimate::NoPose {
    reason: NoPoseReason::NoSource,
    inlier_count: 0,
};

/// A pose source and its settings.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum PoseSourceConfig {
    /// The measured pose.
    #[default]
    Recorded,
    /// The measured pose with an error.
    Noisy(NoisyPoseConfig),
    /// Estimated from the sweep alone, by PGC.
    Pgc(PgcConfig),
    /// Estimated by PGC and followed from sweep to sweep.
    Tracked(TrackedPoseConfig),
    /// Estimated from the sweep alone, by a baseline of the paper: SGLoc, DiffLoc or HypLiLoc.
    Baseline(BaselinePoseConfig),
    /// Read from a table that `agent localize` wrote.
    Cached(CachedPoseConfig),
}

/// Error that is added to the measured pose.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(default, deny_unknown_fields)]
pub struct NoisyPoseConfig {
    /// Correlation of the errors of successive frames (pose source noisy).
    #[arg(
        id = "noise_mode",
        long = "noise-mode",
        value_name = "MODE",
        value_enum
    )]
    pub mode: NoiseMode,
    /// Standard deviation of x, y and z, metres (pose source noisy).
    #[arg(
        id = "noise_position_std_m",
        long = "noise-position-std-m",
        value_name = "M"
    )]
    pub position_std_m: f64,
    /// Standard deviation of yaw, degrees (pose source noisy).
    #[arg(
        id = "noise_heading_std_deg",
        long = "noise-heading-std-deg",
        value_name = "DEG"
    )]
    pub heading_std_deg: f64,
    /// Seed of the errors (pose source noisy).
    #[arg(id = "noise_seed", long = "noise-seed", value_name = "SEED")]
    pub seed: u64,
    /// Time between two draws of the modes that depend on time, seconds (pose source noisy).
    #[arg(id = "noise_step_s", long = "noise-step-s", value_name = "S")]
    pub step_s: f64,
    /// Time after which an autoregressive error has decayed to 1/e, seconds (pose source noisy).
    #[arg(id = "noise_decay_s", long = "noise-decay-s", value_name = "S")]
    pub decay_s: f64,
    /// Table of errors for the replayed mode, as `agent eval --error-table` writes it (pose source noisy).
    #[arg(id = "noise_table", long = "noise-table", value_name = "FILE")]
    pub table: Option<PathBuf>,
}

impl Default for NoisyPoseConfig {
    /// OpenCOOD's standard deviations, 0.2 m and 0.2 degrees, and its seed, 25; drawn anew for every agent and frame.
    fn default() -> Self {
        Self {
            mode: NoiseMode::Independent,
            position_std_m: 0.2,
            heading_std_deg: 0.2,
            seed: 25,
            step_s: 0.1,
            decay_s: 5.0,
            table: None,
        }
    }
}

impl NoisyPoseConfig {
    /// Checks the values.
    ///
    /// # Errors
    /// [`FieldError`] of the first value that is out of range.
    pub fn validate(&self) -> Result<(), FieldError> {
        within("noisy.position_std_m", self.position_std_m, 0.0, 1e3)?;
        within("noisy.heading_std_deg", self.heading_std_deg, 0.0, 360.0)?;
        within("noisy.step_s", self.step_s, 1e-3, 1e3)?;
        // The upper bound keeps the sum over past innovations short: seven decay times.
        within("noisy.decay_s", self.decay_s, 0.0, 1e3 * self.step_s)?;
        match (self.mode, &self.table) {
            (NoiseMode::Replayed, None) => Err(FieldError::new(
                "noisy.table",
                "absent",
                "must name the table of errors (--noise-table)",
            )),
            (mode, Some(_)) if mode != NoiseMode::Replayed => Err(FieldError::new(
                "noisy.mode",
                { clap::ValueEnum::to_possible_value(&mode) }
                    .map_or(String::new(), |mode| mode.get_name().into()),
                "must be replayed where a table of errors is given (noisy.table, --noise-table)",
            )),
            _ => Ok(()),
        }
    }
}

/// Kinds of pose error.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema, clap::ValueEnum,
)]
#[serde(rename_all = "snake_case")]
pub enum NoiseMode {
    /// One offset for all neighbours and frames, as in OpenCOOD's code, which resets its seed at every call. The ego has
    /// no error, there as in every run and evaluation here; an agent that is started alone has the offset.
    Fixed,
    /// Drawn anew for every agent and frame.
    #[default]
    Independent,
    /// First-order autoregressive per agent, as the error of a filter.
    Autoregressive,
    /// Measured errors of a pose generator, from a table.
    Replayed,
}

impl NoiseMode {
    /// True if the ego's pose has no error, as in OpenCOOD's code: with one offset on all vehicles the relative poses
    /// would hardly change.
    #[must_use]
    pub fn spares_ego(self) -> bool {
        self == Self::Fixed
    }
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
    /// Name in files and on command lines.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Recorded => "recorded",
            Self::Noisy(_) => "noisy",
            Self::Pgc(_) => "pgc",
            Self::Tracked(_) => "tracked",
            Self::Baseline(_) => "baseline",
            Self::Cached(_) => "cached",
        }
    }

    /// The same for one scenario of many: only tables of poses differ between scenarios.
    pub fn for_scenario(&self, name: &str) -> Self {
        match self {
            Self::Cached(config) => Self::Cached(CachedPoseConfig {
                scenario: Some(name.to_owned()),
                ..config.clone()
            }),
            other => other.clone(),
        }
    }

    /// The same for one vehicle of several on one machine: those that are tracked measure in turn.
    #[must_use]
    pub fn with_turn(self, turn: u32) -> Self {
        match self {
            Self::Tracked(config) => Self::Tracked(TrackedPoseConfig {
                phase: config.phase.saturating_add(turn),
                ..config
            }),
            other => other,
        }
    }

    /// The same with every sweep measured, to time a few of them.
    #[must_use]
    pub fn measuring_every_sweep(self) -> Self {
        match self {
            Self::Tracked(config) => Self::Tracked(TrackedPoseConfig {
                measure_every: 1,
                ..config
            }),
            other => other,
        }
    }

    /// Sweeps from one that is measured after its pose was published to the next, for a vehicle with this motion.
    pub fn measuring_interval(&self, motion: &EgoMotion) -> u32 {
        match self {
            Self::Tracked(config) => config.interval(motion),
            _ => 1,
        }
    }

    /// Checks the values; files are not opened.
    ///
    /// # Errors
    /// [`FieldError`] of the first value that is out of range, or of a file that is not named.
    pub fn validate(&self) -> Result<(), FieldError> {
        let named = |field: &str, option: &str, file: &Path| {
            if !file.as_os_str().is_empty() {
                return Ok(());
            }
            Err(FieldError::new(
                format!("{}.{field}", self.name()),
                "empty",
                format!("must name a file ({option})"),
            ))
        };
        match self {
            Self::Recorded => Ok(()),
            Self::Noisy(noise) => noise.validate(),
            Self::Pgc(pgc) => named("head", "--head", &pgc.head),
            Self::Tracked(tracked) => {
                named("head", "--head", &tracked.head)?;
                tracked.validate()
            }
            Self::Baseline(network) => named("weights", "--baseline", &network.weights),
            Self::Cached(table) => named("file", "--poses", &table.file),
        }
    }

    /// The same with the file of its head where it has the name of a released one, and with the encoder that the head
    /// names where it has none.
    ///
    /// # Errors
    /// [`FileError`] when there is no such head, or no file is its encoder.
    pub fn with_networks(mut self) -> Result<Self, FileError> {
        let networks = match &mut self {
            Self::Pgc(pgc) => Some((&mut pgc.encoder, &mut pgc.head)),
            Self::Tracked(tracked) => Some((&mut tracked.encoder, &mut tracked.head)),
            Self::Recorded | Self::Noisy(_) | Self::Baseline(_) | Self::Cached(_) => None,
        };
        // A head that is not given is refused by the check of the values.
        if let Some((encoder, head)) = networks.filter(|(_, head)| !head.as_os_str().is_empty()) {
            *head = head_file(head)?;
            let given = Some(encoder.as_path()).filter(|file| !file.as_os_str().is_empty());
            *encoder = encoder_or_named(given, head)?;
        }
        Ok(self)
    }

    /// The same with the paths of its files changed. The name of a released head is no path.
    #[must_use]
    pub fn map_files(mut self, change: impl Fn(&Path) -> PathBuf) -> Self {
        let files: Vec<&mut PathBuf> = match &mut self {
            Self::Recorded => vec![],
            Self::Noisy(noisy) => noisy.table.iter_mut().collect(),
            Self::Pgc(pgc) => vec![&mut pgc.encoder, &mut pgc.head],
            Self::Tracked(tracked) => vec![&mut tracked.encoder, &mut tracked.head],
            Self::Baseline(network) => vec![&mut network.weights],
            Self::Cached(cached) => vec![&mut cached.file],
        };
        for file in files {
            let changed = change(file);
            let is_path = changed.exists() || !is_name(file);
            if is_path && !file.as_os_str().is_empty() {
                *file = changed;
            }
        }
        self
    }

    /// Files that the source reads.
    pub fn files(&self) -> Vec<&Path> {
        match self {
            Self::Recorded => vec![],
            Self::Noisy(noisy) => noisy.table.iter().map(PathBuf::as_path).collect(),
            Self::Pgc(pgc) => vec![&pgc.encoder, &pgc.head],
            Self::Tracked(tracked) => vec![&tracked.encoder, &tracked.head],
            Self::Baseline(network) => vec![&network.weights],
            Self::Cached(cached) => vec![&cached.file],
        }
    }

    /// True if poses are estimated from the sweep's points.
    pub fn looks_at_sweeps(&self) -> bool {
        matches!(self, Self::Pgc(_) | Self::Tracked(_) | Self::Baseline(_))
    }

    /// Sets the source up and reads its files; networks compute by `inference`.
    ///
    /// # Errors
    /// [`PoseSourceError`] names the field or the file.
    pub fn build(&self, inference: Inference) -> Result<Box<dyn PoseSource>, PoseSourceError> {
        self.validate()?;
        Ok(match self {
            Self::Recorded => Box::new(RecordedPose),
            Self::Noisy(config) => Box::new(NoisyPose::new(config)?),
            Self::Pgc(config) => Box::new(LocalizedPose::pgc(config, inference)?),
            Self::Tracked(config) => Box::new(TrackedPose::load(config, inference)?),
            Self::Baseline(config) => Box::new(LocalizedPose::baseline(config, inference)?),
            Self::Cached(config) => Box::new(CachedPose::new(config)?),
        })
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
