//! Localization by HypLiLoc: from a sweep to a pose.

use protocol::PointCloud;
use support::stage_times::StageTimes;
use tch::{Device, Kind, TchError, Tensor, nn, no_grad};

use super::config::HypLiLocConfig;
use super::network::HypLiLoc;
use super::sweep_input::{InputBatch, SweepInput};
use crate::baselines::regressed_pose::{PoseRegressor, RegressPose};
use crate::pgc::LocalizerError;
use crate::pgc::localization::{REGRESS, VOXELISE};
use perception::tensor_values::values;

/// Shortest heading that is a direction.
const LEAST_HEADING: f32 = 1e-3;

/// A trained network of one scene, output of `agent train hypliloc`.
pub type HypLiLocLocalizer = PoseRegressor<HypLiLoc>;

impl RegressPose for HypLiLoc {
    const KIND: &'static str = "HypLiLoc";
    type Config = HypLiLocConfig;

    fn build(path: &nn::Path<'_>, config: &HypLiLocConfig) -> Result<Self, LocalizerError> {
        config.validate()?;
        Ok(Self::new(path))
    }

    fn scale(config: &HypLiLocConfig) -> [[f64; 3]; 2] {
        [config.origin_m, config.scale_m]
    }

    /// The heading has length 1, or is NaN if it has no direction.
    fn regress(
        &self,
        cloud: &PointCloud,
        device: Device,
        times: &mut StageTimes,
    ) -> Result<Option<[f32; 5]>, TchError> {
        let points_m: Vec<[f32; 3]> = cloud.xyzi.iter().map(|&[x, y, z, _]| [x, y, z]).collect();
        let input = SweepInput::new(&points_m);
        times.lap(VOXELISE);
        let Some(input) = input else {
            return Ok(None);
        };
        let answer = no_grad(|| {
            let batch = InputBatch::new(&[input], device)?;
            let poses = self.forward(&batch, Kind::Float, false)?.fusion;
            values(&Tensor::f_cat(&[poses.position, poses.heading], 1)?)
        })?;
        times.lap(REGRESS);
        Ok(answer.first_chunk().map(|&[x, y, z, cosine, sine]| {
            let length = match cosine.hypot(sine) {
                length if length >= LEAST_HEADING => length,
                _ => f32::NAN,
            };
            [x, y, z, cosine / length, sine / length]
        }))
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::path::{Path, PathBuf};

    use perception::weights::{CONFIG_KEY, KIND_KEY, Precision, save};

    use super::*;
    use crate::baselines::load_baseline;
    use crate::baselines::sgloc::SgLocLocalizer;
    use crate::pgc::pose_solver::PoseSolver;
    use crate::pgc::{Localize, LocalizerInput};
    use protocol::{NoPoseReason, PoseEstimate};
    use tch::nn::VarStore;

    fn config() -> HypLiLocConfig {
        HypLiLocConfig {
            scene_name: "test".into(),
            origin_m: [1000.0, -2000.0, 30.0],
            scale_m: [100.0, 200.0, 1.0],
        }
    }

    /// Writes a network whose last layers answer with `position` and `heading` for any sweep.
    fn write(
        folder: &Path,
        config: &HypLiLocConfig,
        position: [f32; 3],
        heading: [f32; 2],
    ) -> PathBuf {
        tch::set_num_threads(1);
        let variables = VarStore::new(Device::Cpu);
        let _ = HypLiLoc::new(&variables.root());
        let named = variables.variables();
        for (name, bias) in [("position", &position[..]), ("heading", &heading)] {
            let last = format!("heads.fusion.{name}.2");
            no_grad(|| {
                let _ = named[&format!("{last}.weight")].shallow_clone().zero_();
                named[&format!("{last}.bias")]
                    .shallow_clone()
                    .copy_(&Tensor::from_slice(bias));
            });
        }
        let about = BTreeMap::from([
            (
                CONFIG_KEY.to_owned(),
                serde_json::to_string(config).unwrap(),
            ),
            (KIND_KEY.to_owned(), HypLiLocLocalizer::KIND.to_owned()),
        ]);
        let path = folder.join("weights.safetensors");
        save(&path, &variables, &about, Precision::Single).unwrap();
        path
    }

    fn sweep() -> PointCloud {
        let wall = (0..4000).map(|k| [(k % 60) as f32 - 30.0, 9.0, (k / 60) as f32 * 0.1, 0.2]);
        PointCloud {
            xyzi: wall.collect(),
        }
    }

    #[test]
    fn weights_are_read_back_and_answer_in_the_world_frame() {
        let folder = tempfile::tempdir().unwrap();
        let path = write(folder.path(), &config(), [0.5, -0.25, 2.0], [0.0, 0.3]);
        assert_eq!(
            HypLiLocLocalizer::load(&path, Device::Cpu)
                .unwrap()
                .config(),
            &config()
        );
        let mut localizer = load_baseline(&path, Device::Cpu, PoseSolver::default()).unwrap();
        let answer = localizer.localize(LocalizerInput::of(&sweep())).unwrap();
        let pose = answer.estimate.world_from_cav().unwrap();
        let expected = [1050.0, -2050.0, 32.0];
        assert!(
            pose.translation_m
                .iter()
                .zip(expected)
                .all(|(found, wanted)| (found - wanted).abs() < 1e-3)
        );
        assert!((pose.yaw_rad() - std::f64::consts::FRAC_PI_2).abs() < 1e-6);
    }

    #[test]
    fn no_pose_comes_from_too_few_points_or_an_answer_without_direction() {
        let folder = tempfile::tempdir().unwrap();
        let path = write(folder.path(), &config(), [0.0; 3], [0.0; 2]);
        let mut localizer = HypLiLocLocalizer::load(&path, Device::Cpu).unwrap();
        let nan = PointCloud {
            xyzi: vec![[f32::NAN; 4]; 5000],
        };
        let few = PointCloud {
            xyzi: (0..10).map(|k| [3.0 * k as f32, 3.0, 0.5, 0.1]).collect(),
        };
        let none = |reason| PoseEstimate::NoPose {
            reason,
            inlier_count: 0,
        };
        for cloud in [PointCloud::default(), nan, few] {
            assert_eq!(
                localizer
                    .localize(LocalizerInput::of(&cloud))
                    .unwrap()
                    .estimate,
                none(NoPoseReason::TooFewPoints)
            );
        }
        assert_eq!(
            localizer
                .localize(LocalizerInput::of(&sweep()))
                .unwrap()
                .estimate,
            none(NoPoseReason::Failed)
        );
    }

    #[test]
    fn files_of_something_else_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let flat = HypLiLocConfig {
            scale_m: [0.0; 3],
            ..config()
        };
        let path = write(folder.path(), &flat, [0.0; 3], [0.0; 2]);
        let message = HypLiLocLocalizer::load(&path, Device::Cpu)
            .unwrap_err()
            .to_string();
        assert!(message.contains("scale_m is [0.0, 0.0, 0.0]"), "{message}");
        let message = SgLocLocalizer::load(&path, Device::Cpu, PoseSolver::default())
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("\"HypLiLoc\"") && message.contains("\"SGLoc\""),
            "{message}"
        );
        let other = folder.path().join("other.safetensors");
        let about = BTreeMap::from([(KIND_KEY.to_owned(), "scene encoder".to_owned())]);
        save(
            &other,
            &VarStore::new(Device::Cpu),
            &about,
            Precision::Single,
        )
        .unwrap();
        let message = HypLiLocLocalizer::load(&other, Device::Cpu)
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("\"scene encoder\"") && message.contains("\"HypLiLoc\""),
            "{message}"
        );
    }
}
