//! Pose source that adds an error to the measured pose.

use std::path::PathBuf;

use clap::ValueEnum;
use perception::inference::Inference;
use protocol::config::{FieldError, within};
use protocol::{CavId, NoPoseReason, Pose, PoseEstimate};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use support::random::scenario_seed;

use super::error_table::ErrorTable;
use super::noise;
use super::settings::{PoseBasis, PoseSettings};
use super::{NO_SOURCE, PoseInput, PoseSource, PoseSourceError, no_pose};

/// Error that is added to the measured pose.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(default, deny_unknown_fields)]
pub struct NoisyPoseConfig {
    /// Correlation of the errors of successive frames (pose source noisy).
    #[arg(id = "noise_mode", long = "noise-mode", value_name = "MODE")]
    #[arg(value_enum)]
    pub mode: NoiseMode,
    /// Standard deviation of x, y and z, metres (pose source noisy).
    #[arg(id = "noise_position_std_m", long = "noise-position-std-m")]
    #[arg(value_name = "M")]
    pub position_std_m: f64,
    /// Standard deviation of yaw, degrees (pose source noisy).
    #[arg(id = "noise_heading_std_deg", long = "noise-heading-std-deg")]
    #[arg(value_name = "DEG")]
    pub heading_std_deg: f64,
    /// Seed of the errors, from which every scenario of a run derives its own (pose source noisy).
    #[arg(id = "noise_seed", long = "noise-seed", value_name = "SEED")]
    pub seed: u64,
    /// Time between two autoregressive or replayed errors, seconds (pose source noisy).
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

impl PoseSettings for NoisyPoseConfig {
    fn basis(&self) -> PoseBasis {
        PoseBasis::MeasuredPose
    }

    fn build(&self, _: Inference) -> Result<Box<dyn PoseSource>, PoseSourceError> {
        Ok(Box::new(NoisyPose::new(self)?))
    }

    fn validate(&self) -> Result<(), FieldError> {
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
                mode.name(),
                "must be replayed where a table of errors is given (noisy.table, --noise-table)",
            )),
            _ => Ok(()),
        }
    }

    fn files(&mut self) -> Vec<&mut PathBuf> {
        self.table.iter_mut().collect()
    }

    fn option_prefix() -> &'static str {
        "noise"
    }

    fn has_use_for(&self, option: &str) -> bool {
        match option {
            "noise_position_std_m" | "noise_heading_std_deg" => self.mode != NoiseMode::Replayed,
            "noise_step_s" => !matches!(self.mode, NoiseMode::Fixed | NoiseMode::Independent),
            "noise_decay_s" => self.mode == NoiseMode::Autoregressive,
            // A table that is not replayed is refused with the other values.
            _ => true,
        }
    }

    fn set_scenario(&mut self, name: &str) {
        // OpenCOOD takes the same seed in every scenario.
        if self.mode != NoiseMode::Fixed {
            self.seed = scenario_seed(self.seed, name);
        }
    }

    fn mode(&self) -> Option<String> {
        Some(format!("noise mode {}", self.mode.name()))
    }

    fn spares_ego(&self) -> bool {
        self.mode.spares_ego()
    }
}

/// Kinds of pose error.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema, ValueEnum,
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
    /// Its name in scenarios and options.
    pub fn name(self) -> String {
        self.to_possible_value()
            .map_or_else(String::new, |mode| mode.get_name().into())
    }

    /// True if the ego's pose has no error, as in OpenCOOD's code: with one offset on all vehicles the relative poses
    /// would hardly change.
    pub fn spares_ego(self) -> bool {
        self == Self::Fixed
    }
}

/// The measured pose with an error of one of four kinds.
///
/// The error depends on seed, scenario, vehicle and capture time alone, so a live run and an offline one get the same
/// poses, and so does a run that lost frames. A vehicle that is started alone belongs to no scenario. The confidence of a
/// drawn error is `1 / (1 + e^2)` of its length in metres, as in Eq. 6 of the paper and in its experiments on recorded
/// data; a replayed error has a confidence of its own.
#[derive(Debug, Clone)]
pub struct NoisyPose {
    config: NoisyPoseConfig,
    /// Errors that are replayed in place of drawn ones.
    table: Option<ErrorTable>,
}

impl NoisyPose {
    /// Sets the errors up; `replayed` reads its table.
    ///
    /// # Errors
    /// [`PoseSourceError`] names the field or the file.
    pub fn new(config: &NoisyPoseConfig) -> Result<Self, PoseSourceError> {
        config.validate()?;
        // Checked above: there is a table where errors are replayed, and only there.
        let table = config.table.as_deref().map(ErrorTable::read);
        Ok(Self {
            table: table.transpose()?,
            config: config.clone(),
        })
    }

    /// The pose of a vehicle at a capture time when the true one is `pose`.
    pub fn disturbed(&self, cav: &CavId, capture_nanos: u64, pose: &Pose) -> PoseEstimate {
        // To the nearest step: capture times that jitter about a step keep their place in the sequence.
        let step_nanos = self.config.step_s * 1e9;
        let step = (capture_nanos as f64 / step_nanos).round() as u64;
        if let Some(table) = &self.table {
            // Vehicles start at different rows of the table, so that their errors differ.
            let key = noise::key(self.config.seed, cav);
            let first_row = u64::from_le_bytes(std::array::from_fn(|byte| key[byte]));
            return match table.row(first_row, step) {
                Some((error, confidence)) => {
                    PoseEstimate::new(error.added_in_vehicle(pose), confidence)
                }
                None => no_pose(NoPoseReason::TooFewInliers),
            };
        }
        let error = match self.config.mode {
            NoiseMode::Fixed => self.config.fixed(),
            NoiseMode::Autoregressive => {
                // Correlation of an error with that of the previous step.
                let rho = if self.config.decay_s > 0.0 {
                    (-self.config.step_s / self.config.decay_s).exp()
                } else {
                    0.0
                };
                self.config.autoregressive(cav, step, rho)
            }
            // Replayed errors are those of the table.
            NoiseMode::Independent | NoiseMode::Replayed => {
                self.config.independent(cav, capture_nanos)
            }
        };
        // Eq. 6: `sigma = 1 / (1 + epsilon^2)`, epsilon in metres.
        let confidence = 1.0 / (1.0 + error.distance_m().powi(2));
        PoseEstimate::new(error.added_in_world(pose), confidence as f32)
    }
}

impl PoseSource for NoisyPose {
    fn estimate(&mut self, input: &PoseInput<'_>) -> PoseEstimate {
        match input.measured {
            Some(pose) => self.disturbed(input.cav, input.capture_nanos, pose),
            None => NO_SOURCE,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TRUE_POSE: Pose = Pose {
        translation_m: [100.0, -50.0, 2.0],
        rotation_wxyz: [1.0, 0.0, 0.0, 0.0],
    };

    fn source(mode: NoiseMode) -> NoisyPose {
        NoisyPose::new(&NoisyPoseConfig {
            mode,
            position_std_m: 1.0,
            ..NoisyPoseConfig::default()
        })
        .unwrap()
    }

    fn cav(name: &str) -> CavId {
        CavId::new(name).unwrap()
    }

    fn disturbed(mode: NoiseMode, name: &str, seconds: u64) -> PoseEstimate {
        source(mode).disturbed(&cav(name), seconds * 1_000_000_000, &TRUE_POSE)
    }

    #[test]
    fn modes_differ_in_what_the_error_depends_on() {
        let fixed = disturbed(NoiseMode::Fixed, "a", 1);
        assert_eq!(fixed, disturbed(NoiseMode::Fixed, "b", 2));
        for mode in [NoiseMode::Independent, NoiseMode::Autoregressive] {
            let first = disturbed(mode, "a", 1);
            assert_eq!(first, disturbed(mode, "a", 1), "{mode:?}");
            assert_ne!(first, disturbed(mode, "a", 2), "{mode:?}");
            assert_ne!(first, disturbed(mode, "b", 1), "{mode:?}");
        }
    }

    #[test]
    fn independent_errors_are_of_one_frame_at_any_rate() {
        // 20 Hz: two frames in a step of 0.1 s.
        let errors = [0, 50, 100].map(|ms| {
            let capture_nanos = ms * 1_000_000;
            source(NoiseMode::Independent).disturbed(&cav("a"), capture_nanos, &TRUE_POSE)
        });
        assert!(errors[0] != errors[1] && errors[1] != errors[2]);
    }

    #[test]
    fn each_scenario_has_errors_of_its_own_but_for_the_fixed_one() {
        for mode in NoiseMode::value_variants() {
            let [one, again, other] = ["one", "one", "two"].map(|name| {
                let mut config = source(NoiseMode::Fixed).config;
                config.mode = *mode;
                config.set_scenario(name);
                config.seed
            });
            assert_eq!(one, again, "{mode:?}");
            assert_eq!(one == other, *mode == NoiseMode::Fixed, "{mode:?}");
        }
    }

    #[test]
    fn a_large_error_has_a_low_confidence() {
        for step in 0..20 {
            let PoseEstimate::Pose {
                world_from_cav,
                confidence,
                ..
            } = source(NoiseMode::Independent).disturbed(&cav("a"), step * 100_000_000, &TRUE_POSE)
            else {
                panic!("a measured pose gives a pose")
            };
            let off = TRUE_POSE
                .from_world(&world_from_cav)
                .isometry()
                .translation
                .vector
                .norm();
            assert!((f64::from(confidence) - 1.0 / (1.0 + off * off)).abs() < 1e-6);
        }
    }

    #[test]
    fn replayed_errors_come_from_the_table_and_may_be_none() {
        let folder = tempfile::tempdir().unwrap();
        let table = folder.path().join("errors.csv");
        std::fs::write(
            &table,
            "x_m,y_m,z_m,yaw_deg,confidence\n0.5,0,0,0,0.8\nno_pose\n",
        )
        .unwrap();
        let config = NoisyPoseConfig {
            mode: NoiseMode::Replayed,
            table: Some(table),
            ..NoisyPoseConfig::default()
        };
        let source = NoisyPose::new(&config).unwrap();
        let estimates: Vec<_> = (0..2)
            .map(|k| source.disturbed(&cav("a"), k * 100_000_000, &TRUE_POSE))
            .collect();
        assert_eq!(
            estimates
                .iter()
                .filter(|estimate| estimate.world_from_cav().is_none())
                .count(),
            1
        );
        let pose = estimates
            .iter()
            .find_map(PoseEstimate::world_from_cav)
            .unwrap();
        assert!((pose.translation_m[0] - 100.5).abs() < 1e-9);
        let config = NoisyPoseConfig {
            table: None,
            ..config
        };
        let message = NoisyPose::new(&config).unwrap_err().to_string();
        assert!(message.contains("noisy.table is absent"), "{message}");
    }

    #[test]
    fn invalid_numbers_are_named() {
        let config = NoisyPoseConfig {
            position_std_m: f64::NAN,
            ..NoisyPoseConfig::default()
        };
        let message = NoisyPose::new(&config).unwrap_err().to_string();
        assert!(message.contains("position_std_m is NaN"), "{message}");
        let config = NoisyPoseConfig {
            step_s: 0.0,
            ..NoisyPoseConfig::default()
        };
        assert!(
            NoisyPose::new(&config)
                .unwrap_err()
                .to_string()
                .contains("step_s is 0")
        );
    }
}
