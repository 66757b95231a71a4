//! Networks that regress the pose of a sweep from the tokens of PGC's encoder, as localizers.

use std::fmt::Debug;
use std::path::Path;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use perception::tensor_values::values;
use perception::weights::{FileError, KIND_KEY, Weights};
use protocol::config::{require, within};
use protocol::{NoPoseReason, PointCloud, PoseEstimate};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use support::stage_times::StageTimes;
use tch::{Device, Kind, Tensor, nn, no_grad};

use super::place_classes::PlaceClasses;
use super::tokens::{TokenProjection, pool};
use crate::pgc::localization::{ENCODE, REGRESS, VOXELISE};
use crate::pgc::pose_solver::MIN_CELLS;
use crate::pgc::{
    Localization, Localize, LocalizerError, LocalizerInput, SceneEncoder, SceneEncoderConfig,
    SweepVoxels, VoxelBatch, stopwatch,
};

/// Configuration of a network of one scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PoseRegressorConfig {
    /// Name of the scene.
    pub scene_name: String,
    /// Mean of the training positions, metres in the world.
    pub origin_m: [f64; 3],
    /// Number of place classes.
    pub classes: i64,
    /// Frozen encoder.
    pub encoder: SceneEncoderConfig,
}

/// Network that regresses poses from tokens.
pub trait RegressPose: Debug + Send + Sized {
    /// Kind of the weights, as in their file.
    const KIND: &'static str;

    /// Builds the layers below `path` for tokens of `channels` and so many place classes.
    ///
    /// # Errors
    /// Those of the tensor library.
    fn build(path: &nn::Path<'_>, channels: i64, classes: i64) -> tch::Result<Self>;

    /// `[N, 5]` positions relative to the origin in metres, cosines and sines of headings, of sweeps with tokens
    /// `[N, TOKENS, channels]`; products are computed in `kind`.
    ///
    /// # Errors
    /// Those of the tensor library.
    fn poses(&self, tokens: &Tensor, places: &PlaceClasses, kind: Kind) -> tch::Result<Tensor>;
}

/// Encoder, tokens, place classes and network of one scene. Every pose has full confidence: no error is predicted.
#[derive(Debug)]
pub struct PoseRegressor<N> {
    /// Encoder of cells, frozen.
    pub encoder: SceneEncoder,
    /// Components of its tokens.
    pub projection: TokenProjection,
    /// Classes of the scene.
    pub places: PlaceClasses,
    /// Network from tokens to poses.
    pub network: N,
    config: PoseRegressorConfig,
    device: Device,
}

impl<N: RegressPose> PoseRegressor<N> {
    /// Kind of the weights, as in their file.
    pub const KIND: &'static str = N::KIND;

    /// Builds all layers below `path`.
    ///
    /// # Errors
    /// [`LocalizerError`] names the field of the configuration that is wrong.
    pub fn new(path: &nn::Path<'_>, config: &PoseRegressorConfig) -> Result<Self, LocalizerError> {
        within("classes", config.classes, 1, 1 << 16)?;
        let is_place = config.origin_m.iter().all(|axis| axis.is_finite());
        require(is_place, "origin_m", config.origin_m, "must be finite")?;
        let encoder = SceneEncoder::new(&(path / "encoder"), &config.encoder)?;
        let projection = TokenProjection::new(&(path / "tokens"), config.encoder.cell_channels());
        Ok(Self {
            places: PlaceClasses::new(&(path / "places"), config.classes),
            network: N::build(&(path / "regressor"), projection.channels(), config.classes)?,
            encoder,
            projection,
            config: config.clone(),
            device: path.device(),
        })
    }

    /// Reads the output of a training.
    ///
    /// # Errors
    /// [`LocalizerError`] when the file is missing, truncated, of another kind or of a network with layers of its own in
    /// place of the encoder, or its tensors are not those of its configuration.
    pub fn load(path: &Path, device: Device) -> Result<Self, LocalizerError> {
        let weights = Weights::load(path)?;
        let is_own = weights.metadata(KIND_KEY) == Some(N::KIND);
        // Without this check the error would be of a missing field and not say what to do.
        if is_own && weights.config::<Value>()?.get("encoder").is_none() {
            let problem = format!(
                "weights of kind {:?} have no encoder: they are of an earlier version, whose network had layers of its \
                 own there; train anew (agent train {})",
                N::KIND,
                N::KIND.to_lowercase()
            );
            return Err(FileError::new(path, problem).into());
        }
        weights.network(N::KIND, device, |path, config| Self::new(path, &config))
    }

    /// Tokens `[TOKENS, channels]` of a sweep; `None` if it shows too little.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn tokens(
        &self,
        cloud: &PointCloud,
        times: &mut StageTimes,
    ) -> tch::Result<Option<Tensor>> {
        let config = self.encoder.config();
        let sweep = SweepVoxels::new(cloud.xyzi.iter().map(|&[x, y, z, _]| [x, y, z]), config);
        times.lap(VOXELISE);
        if sweep.cells().len() < MIN_CELLS {
            return Ok(None);
        }
        let batch = VoxelBatch::new(&[&sweep], config, self.device)?;
        let features = self.encoder.encode(&batch, Kind::Float)?;
        let pooled = pool(sweep.cells(), &features.cells)?;
        let tokens = self.projection.forward(&pooled)?;
        times.lap(ENCODE);
        Ok(Some(tokens))
    }
}

impl<N: RegressPose> Localize for PoseRegressor<N> {
    fn localize(&mut self, sweep: LocalizerInput<'_>) -> Result<Localization, LocalizerError> {
        let mut times = stopwatch();
        let Some(tokens) = self.tokens(sweep.cloud, &mut times)? else {
            return Ok(Localization::no_pose(NoPoseReason::TooFewPoints, times));
        };
        let tokens = tokens.f_unsqueeze(0)?;
        let found = no_grad(|| self.network.poses(&tokens, &self.places, Kind::Float))?;
        let pose = values(&found)?
            .first_chunk()
            .and_then(|&of| upright(of, self.config.origin_m));
        times.lap(REGRESS);
        Ok(localization(pose, times))
    }
}

/// The pose with full confidence; none if it is not finite or has no heading.
pub(super) fn localization(pose: Option<Isometry3<f64>>, times: StageTimes) -> Localization {
    match pose {
        Some(pose) => Localization::from_estimate(PoseEstimate::new(pose.into(), 1.0), times),
        None => Localization::no_pose(NoPoseReason::Failed, times),
    }
}

/// Shortest vector of cosine and sine that is a direction.
const LEAST_HEADING: f64 = 1e-3;

/// Position relative to the origin, cosine and sine of the heading; `None` if that is no pose.
fn upright(answer: [f32; 5], origin_m: [f64; 3]) -> Option<Isometry3<f64>> {
    let [x, y, z, cosine, sine] = answer.map(f64::from);
    let is_pose = [x, y, z].iter().all(|axis| axis.is_finite());
    // Also false of NaN. Only the direction of the vector is used, not its length.
    (is_pose && cosine.hypot(sine) >= LEAST_HEADING).then(|| {
        let position = Vector3::new(x, y, z) + Vector3::from(origin_m);
        let heading = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), sine.atan2(cosine));
        Isometry3::from_parts(Translation3::from(position), heading)
    })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::path::PathBuf;

    use perception::weights::{CONFIG_KEY, Precision, save};
    use tch::nn::VarStore;

    use super::*;
    use crate::baselines::diffloc::DiffLoc;
    use crate::baselines::hypliloc::HypLiLoc;
    use crate::baselines::load_baseline;
    use crate::baselines::sgloc::SgLocLocalizer;
    use crate::pgc::pose_solver::PoseSolver;

    fn config() -> PoseRegressorConfig {
        PoseRegressorConfig {
            scene_name: "test".into(),
            origin_m: [1000.0, -2000.0, 30.0],
            classes: 2,
            encoder: SceneEncoderConfig {
                voxel_m: 1.0,
                range_m: 40.0,
                widths: vec![4, 8],
                residual_widths: vec![8],
                ..SceneEncoderConfig::lean()
            },
        }
    }

    fn write(folder: &Path, variables: &VarStore, config: &str, kind: &str) -> PathBuf {
        let about = [(CONFIG_KEY, config), (KIND_KEY, kind)];
        let about = about.map(|(key, text)| (key.to_owned(), text.to_owned()));
        let path = folder.join("weights.safetensors");
        save(&path, variables, &BTreeMap::from(about), Precision::Single).unwrap();
        path
    }

    /// Writes a network whose classes lie at 50 m; the last layers have these biases.
    fn network<N: RegressPose>(folder: &Path, biases: &[(&str, &[f32])]) -> PathBuf {
        tch::set_num_threads(1);
        let variables = VarStore::new(Device::Cpu);
        let mut network = PoseRegressor::<N>::new(&variables.root(), &config()).unwrap();
        network
            .places
            .set(&[[50.0, -50.0, 0.0, 15.0, 0.0]; 2])
            .unwrap();
        let named = variables.variables();
        for (layer, bias) in biases {
            let [mut weight, mut outputs] = ["weight", "bias"]
                .map(|part| named[&format!("regressor.{layer}.{part}")].shallow_clone());
            no_grad(|| {
                let _ = weight.zero_();
                outputs.copy_(&Tensor::from_slice(bias));
            });
        }
        let config = serde_json::to_string(&config()).unwrap();
        write(folder, &variables, &config, N::KIND)
    }

    fn hypliloc(folder: &Path, position: [f32; 3], heading: [f32; 2]) -> PathBuf {
        let fusion = ["branches.fusion.position.2", "branches.fusion.heading.2"];
        network::<HypLiLoc>(folder, &[(fusion[0], &position), (fusion[1], &heading)])
    }

    fn sweep() -> PointCloud {
        let wall = (0..4000).map(|k| [(k % 60) as f32 - 30.0, 9.0, (k / 60) as f32 * 0.1, 0.2]);
        PointCloud {
            xyzi: wall.collect(),
        }
    }

    fn answer(path: &Path, cloud: &PointCloud) -> PoseEstimate {
        let mut localizer = load_baseline(path, Device::Cpu, PoseSolver::default()).unwrap();
        localizer
            .localize(LocalizerInput::of(cloud))
            .unwrap()
            .estimate
    }

    fn assert_pose(found: &PoseEstimate, position_m: [f64; 3], yaw_rad: f64) {
        let pose = found.world_from_cav().unwrap();
        let axes = pose.translation_m.iter().zip(position_m);
        assert!(
            axes.into_iter()
                .all(|(found, wanted)| (found - wanted).abs() < 1e-2),
            "{pose:?}"
        );
        assert!((pose.yaw_rad() - yaw_rad).abs() < 1e-5, "{pose:?}");
        assert_eq!(found.confidence(), 1.0);
    }

    #[test]
    fn answers_are_relative_to_the_class_in_units_of_10_m() {
        let folder = tempfile::tempdir().unwrap();
        let path = hypliloc(folder.path(), [0.5, -0.25, 0.2], [0.0, 0.3]);
        let right = std::f64::consts::FRAC_PI_2;
        assert_pose(&answer(&path, &sweep()), [1055.0, -2052.5, 32.0], right);
        let loaded = PoseRegressor::<HypLiLoc>::load(&path, Device::Cpu).unwrap();
        assert_eq!(loaded.config, config());
        // A large velocity away from any pose leads to the largest and the least one.
        let bias = [-9999.0, -9999.0, 9999.0, -9999.0, -9999.0];
        let path = network::<DiffLoc>(folder.path(), &[("denoiser.outward.1", &bias)]);
        assert_pose(
            &answer(&path, &sweep()),
            [1090.0, -2010.0, -10.0],
            right / 2.0,
        );
    }

    #[test]
    fn no_pose_comes_from_too_few_points_or_an_answer_without_direction() {
        let folder = tempfile::tempdir().unwrap();
        let path = hypliloc(folder.path(), [0.0; 3], [0.0; 2]);
        let nan = PointCloud {
            xyzi: vec![[f32::NAN; 4]; 5000],
        };
        let few = PointCloud {
            xyzi: (0..10).map(|k| [3.0 * k as f32, 3.0, 0.5, 0.1]).collect(),
        };
        for cloud in [PointCloud::default(), nan, few] {
            assert_eq!(
                answer(&path, &cloud),
                PoseEstimate::no_pose(NoPoseReason::TooFewPoints, 0)
            );
        }
        assert_eq!(
            answer(&path, &sweep()),
            PoseEstimate::no_pose(NoPoseReason::Failed, 0)
        );
    }

    fn load_error(path: &Path) -> String {
        let loaded = load_baseline(path, Device::Cpu, PoseSolver::default());
        loaded.unwrap_err().to_string()
    }

    #[test]
    fn files_of_something_else_and_of_earlier_versions_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let empty = VarStore::new(Device::Cpu);
        let old = r#"{"scene_name":"town1","origin_m":[0.0,0.0,0.0],"scale_m":[9.0,9.0,1.0]}"#;
        for kind in [DiffLoc::KIND, HypLiLoc::KIND] {
            let message = load_error(&write(folder.path(), &empty, old, kind));
            let wanted = format!("weights of kind {kind:?} have no encoder");
            assert!(
                message.contains("weights.safetensors") && message.contains(&wanted),
                "{message}"
            );
        }
        for (wrong, named) in [
            (
                PoseRegressorConfig {
                    classes: 0,
                    ..config()
                },
                "classes is 0",
            ),
            (
                PoseRegressorConfig {
                    origin_m: [f64::MAX * 2.0, 0.0, 0.0],
                    ..config()
                },
                "null",
            ),
        ] {
            let text = serde_json::to_string(&wrong).unwrap();
            let message = load_error(&write(folder.path(), &empty, &text, DiffLoc::KIND));
            assert!(message.contains(named), "{message}");
        }
        let path = hypliloc(folder.path(), [0.0; 3], [0.0; 2]);
        let other = SgLocLocalizer::load(&path, Device::Cpu, PoseSolver::default());
        let message = other.unwrap_err().to_string();
        assert!(
            message.contains("\"HypLiLoc\"") && message.contains("\"SGLoc\""),
            "{message}"
        );
        let path = write(folder.path(), &empty, "{}", "scene encoder");
        let message = PoseRegressor::<DiffLoc>::load(&path, Device::Cpu)
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("\"scene encoder\"") && message.contains("\"DiffLoc\""),
            "{message}"
        );
    }
}
