//! Localization by HypLiLoc: from a sweep to a pose.

use std::path::Path;

use protocol::NoPoseReason;
use tch::nn::VarStore;
use tch::{Device, Kind, TchError, Tensor, no_grad};

use super::config::HypLiLocConfig;
use super::network::HypLiLoc;
use super::sweep_input::{InputBatch, SweepInput};
use crate::baselines::regressed_pose::{localization, no_pose, upright};
use crate::pgc::localization::{REGRESS, VOXELISE};
use crate::pgc::{Localization, Localize, LocalizerError, LocalizerInput, stopwatch};
use perception::tensor_values::values;
use perception::weights::Weights;

/// Shortest heading that is a direction.
const LEAST_HEADING: f32 = 1e-3;

/// A trained network of one scene. Every pose has full confidence: the network predicts no error.
#[derive(Debug)]
pub struct HypLiLocLocalizer {
    network: HypLiLoc,
    config: HypLiLocConfig,
    device: Device,
}

impl HypLiLocLocalizer {
    /// Kind of the weights, as in their file.
    pub const KIND: &'static str = "HypLiLoc";

    /// Reads the output of `agent train hypliloc`.
    ///
    /// # Errors
    /// [`LocalizerError`] when the file is missing, truncated or of another kind, or its tensors are not those of the
    /// network.
    pub fn load(path: &Path, device: Device) -> Result<Self, LocalizerError> {
        let weights = Weights::load(path)?;
        weights.check_kind(Self::KIND)?;
        let config: HypLiLocConfig = weights.config()?;
        config.validate()?;
        let mut variables = VarStore::new(device);
        let network = HypLiLoc::new(&variables.root());
        weights.copy_into(&variables)?;
        variables.freeze();
        Ok(Self {
            network,
            config,
            device,
        })
    }

    /// Configuration: scene, origin and scale of its positions.
    pub fn config(&self) -> &HypLiLocConfig {
        &self.config
    }

    /// Position relative to the origin, metres, cosine and sine of the heading.
    fn regress(&self, input: SweepInput) -> Result<Vec<f32>, TchError> {
        let batch = InputBatch::new(&[input], self.device)?;
        let poses = self.network.forward(&batch, Kind::Float, false)?.fusion;
        let answer = Tensor::f_cat(&[poses.position, poses.heading], 1)?;
        values(&answer)
    }
}

impl Localize for HypLiLocLocalizer {
    fn localize(&mut self, sweep: LocalizerInput<'_>) -> Result<Localization, LocalizerError> {
        let cloud = sweep.cloud;
        let mut times = stopwatch();
        let points_m: Vec<[f32; 3]> = cloud.xyzi.iter().map(|&[x, y, z, _]| [x, y, z]).collect();
        let input = SweepInput::new(&points_m);
        times.lap(VOXELISE);
        let Some(input) = input else {
            return Ok(no_pose(NoPoseReason::TooFewPoints, times));
        };
        let mut answer = no_grad(|| self.regress(input))?;
        times.lap(REGRESS);
        answer
            .iter_mut()
            .zip(self.config.scale_m)
            .for_each(|(axis, scale)| *axis *= scale as f32);
        let has_heading = of_length_one(&mut answer);
        let pose = has_heading.then(|| upright(&answer, self.config.origin_m));
        Ok(localization(pose.flatten(), times))
    }
}

/// Scales the heading after the position to length 1; false if it has no direction.
fn of_length_one(answer: &mut [f32]) -> bool {
    let [.., cosine, sine] = answer else {
        return false;
    };
    let length = cosine.hypot(*sine);
    (*cosine, *sine) = (*cosine / length, *sine / length);
    length >= LEAST_HEADING
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::path::PathBuf;

    use perception::weights::{CONFIG_KEY, KIND_KEY, Precision, save};

    use super::*;
    use crate::baselines::load_baseline;
    use crate::baselines::sgloc::SgLocLocalizer;
    use crate::pgc::pose_solver::PoseSolver;
    use protocol::{PointCloud, PoseEstimate};

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
