//! Pose source that estimates from the sweep alone: no receiver, no recording.

use std::path::{Path, PathBuf};

use perception::inference::Inference;
use protocol::config::{FieldError, within};
use protocol::{NoPoseReason, PoseEstimate, StageTiming};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::motion_gate::{MotionGate, MotionGateConfig};
use super::settings::{PoseSettings, require_file};
use super::{PoseInput, PoseSource, PoseSourceError, no_pose};
use crate::baselines::{LightLoc, load_baseline};
use crate::map_registration::MapRegistration;
use crate::pgc::pose_solver::PoseSolver;
use crate::pgc::{Localize, Localizer, Result};
use crate::place_localizer::place_localizer;

/// Networks of PGC.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(deny_unknown_fields)]
pub struct PgcConfig {
    /// Weights of the encoder: the scene encoder, or a detector whose backbone serves both. Absent: those that the head
    /// names, beside it or released (pose sources pgc and tracked).
    #[arg(long, value_name = "FILE")]
    #[serde(default)]
    pub encoder: PathBuf,
    /// Weights of the scene-specific head: a file, the folder that `agent map` wrote, or a released one, town1 or town4; or
    /// a surfel map in its place, for localization without networks (pose sources pgc and tracked).
    #[arg(long, value_name = "FILE|NAME")]
    pub head: PathBuf,
    /// Surfel map of the place, to which poses are registered, to the millimetre: a file, the folder that `agent map`
    /// wrote, or a released one, town1. Absent: poses are not registered (pose sources pgc and tracked).
    #[arg(id = "surfel_map", long = "surfel-map", value_name = "FILE|NAME")]
    #[serde(default)]
    pub surfel_map: PathBuf,
    /// Least confidence of a pose that is found without a prediction, 0 to 1: others are rejected, beside those that the
    /// head rejects (pose sources pgc and tracked).
    #[arg(id = "min_confidence", long = "min-confidence", value_name = "SHARE")]
    #[serde(default)]
    pub min_confidence: f64,
    /// Leave out what PGC adds to LightLoc: predicted error, refinement and confidence (pose source pgc).
    #[arg(long)]
    #[serde(default)]
    pub lightloc: bool,
    /// Motion limits of the vehicle.
    #[arg(skip)]
    #[serde(default)]
    pub motion_gate: MotionGateConfig,
}

/// A baseline of the paper: SGLoc, DiffLoc or HypLiLoc.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(deny_unknown_fields)]
pub struct BaselinePoseConfig {
    /// Weights of a baseline of `agent train` for the scene: SGLoc, DiffLoc or HypLiLoc (pose source baseline).
    #[arg(id = "baseline", long = "baseline", value_name = "FILE")]
    pub weights: PathBuf,
    /// Motion limits of the vehicle.
    #[arg(skip)]
    #[serde(default)]
    pub motion_gate: MotionGateConfig,
}

/// Localizes every sweep and checks the pose against earlier ones.
#[derive(Debug)]
pub struct LocalizedPose {
    localizer: Box<dyn Localize>,
    motion_gate: MotionGate,
    times: Vec<StageTiming>,
}

impl LocalizedPose {
    /// Reads the networks of PGC.
    ///
    /// # Errors
    /// [`crate::pgc::LocalizerError`] names the file and what is wrong with it.
    pub fn pgc(config: &PgcConfig, inference: Inference) -> Result<Self> {
        let min_confidence = config.min_confidence;
        let files: [&Path; 3] = [&config.encoder, &config.head, &config.surfel_map];
        let localizer = match config.lightloc {
            true => {
                let localizer = Localizer::load(&config.encoder, &config.head, inference)?;
                let solver = PoseSolver {
                    min_confidence,
                    ..PoseSolver::default()
                };
                let localizer = Box::new(LightLoc::new(localizer, solver));
                MapRegistration::of(localizer, &config.surfel_map, min_confidence)?
            }
            false => place_localizer(files, min_confidence, inference, |_| ())?,
        };
        Ok(Self::new(localizer, config.motion_gate.clone()))
    }

    /// The pose of another localizer, behind a motion gate.
    pub fn new(localizer: Box<dyn Localize>, motion_gate: MotionGateConfig) -> Self {
        Self {
            localizer,
            motion_gate: MotionGate::new(motion_gate),
            times: Vec::new(),
        }
    }
}

impl PoseSettings for PgcConfig {
    fn build(&self, inference: Inference) -> Result<Box<dyn PoseSource>, PoseSourceError> {
        Ok(Box::new(LocalizedPose::pgc(self, inference)?))
    }

    fn validate(&self) -> Result<(), FieldError> {
        require_file("pgc.head", "--head", &self.head)?;
        within("pgc.min_confidence", self.min_confidence, 0.0, 1.0)
    }

    fn networks(&mut self) -> Option<([&mut PathBuf; 3], &mut f64)> {
        let files = [&mut self.encoder, &mut self.head, &mut self.surfel_map];
        Some((files, &mut self.min_confidence))
    }
}

impl PoseSettings for BaselinePoseConfig {
    /// A baseline is computed in floating point.
    fn build(&self, inference: Inference) -> Result<Box<dyn PoseSource>, PoseSourceError> {
        let localizer = load_baseline(&self.weights, inference.device, PoseSolver::default())?;
        let source = LocalizedPose::new(localizer, self.motion_gate.clone());
        Ok(Box::new(source))
    }

    fn validate(&self) -> Result<(), FieldError> {
        require_file("baseline.weights", "--baseline", &self.weights)
    }

    fn files(&mut self) -> Vec<&mut PathBuf> {
        vec![&mut self.weights]
    }
}

impl PoseSource for LocalizedPose {
    fn begin(&mut self) {
        self.motion_gate.clear();
    }

    /// Ignores the measured pose.
    fn estimate(&mut self, input: &PoseInput<'_>) -> PoseEstimate {
        self.times.clear();
        let estimate = match self.localizer.localize(input.sweep(None)) {
            Ok(localization) => {
                self.times = localization.times.into_timings();
                localization.estimate
            }
            Err(error) => {
                tracing::error!(cav = %input.cav, capture_nanos = input.capture_nanos, "no pose: {error}");
                return no_pose(NoPoseReason::Failed);
            }
        };
        let Some(world_from_cav) = estimate.world_from_cav() else {
            return estimate;
        };
        // A jump is published, with less confidence: the accepted pose may be the wrong one.
        let pose = world_from_cav.isometry();
        let factor = self.motion_gate.judge(input.capture_nanos, pose);
        PoseEstimate::new(*world_from_cav, estimate.confidence() * factor as f32)
    }

    fn detector_encoder(&self) -> Option<&str> {
        self.localizer.detector_encoder()
    }

    fn computes_from_sweep(&self) -> bool {
        true
    }

    fn stages(&self) -> &[StageTiming] {
        &self.times
    }

    fn jumps(&self) -> u64 {
        self.motion_gate.jumps
    }
}

#[cfg(test)]
mod tests {
    use protocol::{CavId, EgoMotion, PointCloud, Pose};

    use super::*;
    use crate::pgc::test_scene::SyntheticScene;
    use crate::pgc::{Localization, LocalizerError, LocalizerInput, stopwatch};

    fn estimates(source: &mut LocalizedPose, count: u64) -> Vec<PoseEstimate> {
        let cav = CavId::new("7").unwrap();
        let cloud = PointCloud::default();
        // A measured pose far off: it must not matter.
        let measured = Pose::from_xyz_yaw([1.0, 2.0, 3.0], 0.4);
        let estimates = (0..count).map(|step| {
            source.estimate(&PoseInput {
                cav: &cav,
                capture_nanos: step * 100_000_000,
                cloud: &cloud,
                levels: None,
                measured: Some(&measured),
                motion: EgoMotion::default(),
            })
        });
        estimates.collect()
    }

    #[test]
    fn the_pose_comes_from_the_sweep_and_jumps_cost_confidence() {
        let scene = SyntheticScene::default();
        let mut source = LocalizedPose::new(Box::new(scene.clone()), MotionGateConfig::default());
        let found = estimates(&mut source, 2);
        for (seed, estimate) in found.iter().enumerate() {
            let off = scene
                .world_from_sensor(seed as u64)
                .inv_mul(&estimate.world_from_cav().unwrap().isometry());
            assert!(off.translation.vector.norm() < 0.2);
        }
        // Two random places of a scene, a tenth of a second apart.
        assert!(found[1].confidence() < 0.3 * found[0].confidence());
        assert_eq!(source.jumps(), 1);
        assert_eq!(source.stages().len(), 5);
    }

    #[derive(Debug)]
    struct Broken;

    impl Localize for Broken {
        fn localize(&mut self, _: LocalizerInput<'_>) -> Result<Localization, LocalizerError> {
            Err(LocalizerError::Config("broken".into()))
        }
    }

    #[test]
    fn a_localizer_that_fails_gives_no_pose() {
        let none = PoseEstimate::NoPose {
            reason: NoPoseReason::Failed,
            inlier_count: 0,
        };
        assert_eq!(
            estimates(
                &mut LocalizedPose::new(Box::new(Broken), MotionGateConfig::default()),
                1
            ),
            [none]
        );
        assert_eq!(stopwatch().timings().len(), 5);
    }

    #[test]
    fn no_pose_remains_no_pose() {
        let empty = SyntheticScene {
            cells: 0,
            ..SyntheticScene::default()
        };
        let found = estimates(
            &mut LocalizedPose::new(Box::new(empty), MotionGateConfig::default()),
            3,
        );
        assert!(
            found
                .iter()
                .all(|estimate| estimate.world_from_cav().is_none())
        );
    }
}
