//! Localization by DiffLoc: from a sweep to a pose.

use protocol::PointCloud;
use support::stage_times::StageTimes;
use tch::{Device, TchError, nn, no_grad};

use super::config::DiffLocConfig;
use super::denoiser::Windows;
use super::network::DiffLoc;
use super::range_image::CHANNELS;
use crate::baselines::regressed_pose::{PoseRegressor, RegressPose};
use crate::pgc::LocalizerError;
use crate::pgc::localization::{ENCODE, REGRESS, VOXELISE};
use crate::pgc::pose_solver::MIN_CELLS;
use perception::tensor_values::{tensor, values};

/// A DiffLoc network of one scene, for single sweeps, output of `agent train diffloc`.
///
/// The denoised pose is used unchanged, with full confidence.
pub type DiffLocLocalizer = PoseRegressor<DiffLoc>;

impl RegressPose for DiffLoc {
    const KIND: &'static str = "DiffLoc";
    type Config = DiffLocConfig;

    fn build(path: &nn::Path<'_>, config: &DiffLocConfig) -> Result<Self, LocalizerError> {
        Self::new(path, config)
    }

    fn scale(config: &DiffLocConfig) -> [[f64; 3]; 2] {
        [config.origin_m, config.scale_m]
    }

    fn regress(
        &self,
        cloud: &PointCloud,
        device: Device,
        times: &mut StageTimes,
    ) -> Result<Option<[f32; 5]>, TchError> {
        let config = self.config().image;
        let image = config.image(&cloud.xyzi);
        times.lap(VOXELISE);
        let ranges = image[..config.pixels()].iter();
        if ranges.filter(|&&range| range > 0.0).count() < MIN_CELLS {
            return Ok(None);
        }
        let [rows, columns] = [config.rows, config.columns].map(|size| size as i64);
        let image = tensor(&image, &[1, CHANNELS as i64, rows, columns], device)?;
        let features = no_grad(|| self.encoder().forward(&image, false))?.features;
        times.lap(ENCODE);
        let found = values(&self.poses(&features.f_unsqueeze(1)?, Windows::Single)?)?;
        times.lap(REGRESS);
        Ok(found.first_chunk().copied())
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::path::{Path, PathBuf};

    use super::*;
    use crate::baselines::diffloc::RangeImageConfig;
    use crate::baselines::load_baseline;
    use crate::pgc::LocalizerInput;
    use crate::pgc::pose_solver::PoseSolver;
    use perception::weights::{CONFIG_KEY, KIND_KEY, Precision, save};
    use protocol::{NoPoseReason, PoseEstimate};
    use tch::Tensor;
    use tch::nn::VarStore;

    fn config() -> DiffLocConfig {
        DiffLocConfig {
            origin_m: [1000.0, -2000.0, 30.0],
            scale_m: [50.0, 20.0, 1.0],
            image: RangeImageConfig {
                rows: 4,
                columns: 16,
                ..RangeImageConfig::default()
            },
            patch: [2, 4],
            stem: [2, 4],
            width: 8,
            heads: 2,
            layers: 2,
            denoiser_width: 12,
            denoiser_layers: 1,
            ..DiffLocConfig::small()
        }
    }

    fn random_network() -> (VarStore, DiffLoc) {
        tch::set_num_threads(1);
        let variables = VarStore::new(Device::Cpu);
        let network = DiffLoc::new(&variables.root(), &config()).unwrap();
        (variables, network)
    }

    fn write(folder: &Path, variables: &VarStore, kind: &str) -> PathBuf {
        let about = BTreeMap::from([
            (
                CONFIG_KEY.to_owned(),
                serde_json::to_string(&config()).unwrap(),
            ),
            (KIND_KEY.to_owned(), kind.to_owned()),
        ]);
        let path = folder.join("weights.safetensors");
        save(&path, variables, &about, Precision::Single).unwrap();
        path
    }

    fn sweep() -> PointCloud {
        let wall = (0..4000).map(|k| {
            [
                9.0 * (k as f32).cos(),
                9.0 * (k as f32).sin(),
                -(k % 30) as f32 * 0.1,
                0.2,
            ]
        });
        PointCloud {
            xyzi: wall.collect(),
        }
    }

    #[test]
    fn a_denoised_pose_is_in_the_world_frame_with_full_confidence() {
        let (variables, _) = random_network();
        let last = variables.variables();
        // A large velocity away from any pose leads to the largest and the least one.
        let bias = Tensor::from_slice(&[-9999.0f32, -9999.0, 9999.0, -9999.0, -9999.0]);
        no_grad(|| {
            let _ = last["denoiser.outward.1.weight"].shallow_clone().zero_();
            last["denoiser.outward.1.bias"].shallow_clone().copy_(&bias);
        });
        let folder = tempfile::tempdir().unwrap();
        let path = write(folder.path(), &variables, DiffLocLocalizer::KIND);
        let mut localizer = load_baseline(&path, Device::Cpu, PoseSolver::default()).unwrap();
        let answer = localizer.localize(LocalizerInput::of(&sweep())).unwrap();
        let pose = answer.estimate.world_from_cav().unwrap();
        let expected = [1200.0, -1920.0, 26.0];
        assert!(
            pose.translation_m
                .iter()
                .zip(expected)
                .all(|(found, wanted)| (found - wanted).abs() < 1e-3)
        );
        assert!((pose.yaw_rad() - std::f64::consts::FRAC_PI_4).abs() < 1e-6);
        assert_eq!(answer.estimate.confidence(), 1.0);
        let few = PointCloud {
            xyzi: sweep().xyzi[..5].to_vec(),
        };
        let none = PoseEstimate::NoPose {
            reason: NoPoseReason::TooFewPoints,
            inlier_count: 0,
        };
        assert_eq!(
            localizer
                .localize(LocalizerInput::of(&few))
                .unwrap()
                .estimate,
            none
        );
    }

    #[test]
    fn a_saved_network_comes_back() {
        let (variables, network) = random_network();
        let folder = tempfile::tempdir().unwrap();
        let loaded = DiffLocLocalizer::load(
            &write(folder.path(), &variables, DiffLocLocalizer::KIND),
            Device::Cpu,
        );
        let loaded = loaded.unwrap();
        assert_eq!(loaded.config(), &config());
        let image = Tensor::from_slice(&config().image.image(&sweep().xyzi)).view([
            1,
            CHANNELS as i64,
            4,
            16,
        ]);
        let poses = |network: &DiffLoc| {
            let features = no_grad(|| network.encoder().forward(&image, false))
                .unwrap()
                .features;
            network
                .poses(&features.unsqueeze(1), Windows::Single)
                .unwrap()
        };
        assert_eq!(poses(&network), poses(&loaded.network));
        assert_eq!(poses(&network).size(), [1, 1, 5]);
    }

    #[test]
    fn files_of_another_kind_and_sizes_that_do_not_fit_are_named() {
        let (variables, _) = random_network();
        let folder = tempfile::tempdir().unwrap();
        let path = write(folder.path(), &variables, "scene encoder");
        for message in [
            DiffLocLocalizer::load(&path, Device::Cpu)
                .unwrap_err()
                .to_string(),
            load_baseline(&path, Device::Cpu, PoseSolver::default())
                .unwrap_err()
                .to_string(),
        ] {
            assert!(
                message.contains("weights.safetensors") && message.contains("scene encoder"),
                "{message}"
            );
        }
        for (wrong, named) in [
            (
                DiffLocConfig {
                    patch: [3, 4],
                    ..config()
                },
                "patch is [3, 4]",
            ),
            (
                DiffLocConfig {
                    patch: [0, 4],
                    ..config()
                },
                "patch is [0, 4]",
            ),
            (
                DiffLocConfig {
                    heads: 3,
                    ..config()
                },
                "width is 8: must be a multiple of the 3 heads",
            ),
            (
                DiffLocConfig {
                    denoiser_width: 13,
                    ..config()
                },
                "denoiser_width is 13: must be a multiple of the 2 heads",
            ),
            (
                DiffLocConfig {
                    scale_m: [0.0; 3],
                    ..config()
                },
                "scale_m is [0.0",
            ),
            (
                DiffLocConfig {
                    layers: 1000,
                    ..config()
                },
                "1000",
            ),
        ] {
            let message = DiffLoc::new(&VarStore::new(Device::Cpu).root(), &wrong)
                .unwrap_err()
                .to_string();
            assert!(message.contains(named), "{message}");
        }
    }
}
