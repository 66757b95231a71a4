//! Localization by SGLoc: from a sweep to a pose, through the same trait as PGC.

use std::path::Path;

use perception::tensor_values::{tensor, values};
use perception::weights::Weights;
use protocol::NoPoseReason;
use tch::{Device, Kind, no_grad};

use super::SgLoc;
use crate::pgc::localization::{ENCODE, REGRESS, SOLVE, VOXELISE};
use crate::pgc::pose_refinement::SweepCells;
use crate::pgc::pose_solver::{MIN_CELLS, PoseSolver};
use crate::pgc::{
    Localization, Localize, LocalizerError, LocalizerInput, SceneCoordinates, SceneFeatures,
    SweepVoxels, VoxelBatch, choose_evenly, stopwatch,
};

/// Largest number of cells of a sweep that are regressed. More than of PGC: their coordinates are less accurate.
const CELLS: usize = 1024;

/// Network and solver.
///
/// All cells have equal weight, there is no pose refinement, and the confidence is the inlier ratio.
#[derive(Debug)]
pub struct SgLocLocalizer {
    network: SgLoc,
    solver: PoseSolver,
    device: Device,
}

impl SgLocLocalizer {
    /// Kind of the weights, as in their file.
    pub const KIND: &'static str = "SGLoc";

    /// Reads the output of `agent train sgloc`; `solver` finds the pose.
    ///
    /// # Errors
    /// [`LocalizerError`] when the file is missing, truncated or of another kind, or its tensors are not those of its
    /// configuration.
    pub fn load(path: &Path, device: Device, solver: PoseSolver) -> Result<Self, LocalizerError> {
        Ok(Self {
            network: Weights::load(path)?
                .network(Self::KIND, device, |path, config| SgLoc::new(path, &config))?,
            solver,
            device,
        })
    }

    /// Scene coordinates of up to [`CELLS`] cells of a sweep.
    fn regress(
        &self,
        sweep: &SweepVoxels,
        features: &SceneFeatures,
    ) -> Result<SceneCoordinates, LocalizerError> {
        let chosen = choose_evenly(sweep.cells(), CELLS);
        let SweepCells { features, sensor_m } = SweepCells::pick(sweep.cells(), features, &chosen)?;
        let places = tensor(sensor_m.as_flattened(), &[-1, 3], self.device)?;
        let world = no_grad(|| {
            values(
                &self
                    .network
                    .coordinates(&features, &places, Kind::Float, false)?,
            )
        })?;
        Ok(SceneCoordinates {
            // Weight 1 for every cell (Eq. 6), so that the plain confidence is the inlier ratio.
            epsilon_m: vec![0.0; sensor_m.len()],
            sensor_m,
            world_m: world.as_chunks().0.to_vec(),
            origin_m: self.network.config.origin_m,
        })
    }
}

impl Localize for SgLocLocalizer {
    fn localize(&mut self, sweep: LocalizerInput<'_>) -> Result<Localization, LocalizerError> {
        let cloud = sweep.cloud;
        let mut times = stopwatch();
        let config = self.network.encoder.config();
        let sweep = SweepVoxels::new(cloud.xyzi.iter().map(|&[x, y, z, _]| [x, y, z]), config);
        times.lap(VOXELISE);
        if sweep.cells().len() < MIN_CELLS {
            return Ok(Localization::no_pose(NoPoseReason::TooFewPoints, times));
        }
        let batch = VoxelBatch::new(&[&sweep], config, self.device)?;
        let features = self.network.encoder.encode(&batch, Kind::Float)?;
        times.lap(ENCODE);
        let coordinates = self.regress(&sweep, &features)?;
        times.lap(REGRESS);
        let solved = self.solver.solve(&coordinates);
        times.lap(SOLVE);
        Ok(Localization::new(&solved, times))
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::path::PathBuf;

    use nalgebra::Vector3;
    use perception::inference::Inference;
    use perception::weights::{CONFIG_KEY, KIND_KEY, Precision, save};
    use protocol::PoseEstimate;

    use super::*;
    use crate::baselines::sgloc::SgLocConfig;
    use crate::pgc::{Localizer, SceneEncoderConfig};
    use protocol::PointCloud;
    use tch::Tensor;
    use tch::nn::VarStore;

    fn config() -> SgLocConfig {
        let encoder = SceneEncoderConfig {
            voxel_m: 1.0,
            range_m: 40.0,
            widths: vec![4, 8],
            residual_widths: vec![8],
            ..SceneEncoderConfig::lean()
        };
        SgLocConfig {
            scene_name: "test".into(),
            origin_m: [1000.0, -2000.0, 30.0],
            encoder,
        }
    }

    /// Writes a network whose last layer outputs `bias` for any sweep.
    fn write(folder: &Path, stated: &SgLocConfig, bias: [f32; 3]) -> PathBuf {
        tch::set_num_threads(1);
        let variables = VarStore::new(Device::Cpu);
        SgLoc::new(&variables.root(), &config()).unwrap();
        let named = variables.variables();
        no_grad(|| {
            let _ = named["regressor.outward.weight"].shallow_clone().zero_();
            named["regressor.outward.bias"]
                .shallow_clone()
                .copy_(&Tensor::from_slice(&bias));
        });
        let about = BTreeMap::from([
            (
                CONFIG_KEY.to_owned(),
                serde_json::to_string(stated).unwrap(),
            ),
            (KIND_KEY.to_owned(), SgLocLocalizer::KIND.to_owned()),
        ]);
        let path = folder.join("weights.safetensors");
        save(&path, &variables, &about, Precision::Single).unwrap();
        path
    }

    fn shifting(bias: [f32; 3]) -> SgLocLocalizer {
        let folder = tempfile::tempdir().unwrap();
        let path = write(folder.path(), &config(), bias);
        SgLocLocalizer::load(&path, Device::Cpu, PoseSolver::default()).unwrap()
    }

    fn sweep() -> PointCloud {
        let wall = (0..4000).map(|k| [(k % 60) as f32 - 30.0, 9.0, (k / 60) as f32 * 0.1, 0.2]);
        PointCloud {
            xyzi: wall.collect(),
        }
    }

    const TOO_FEW_POINTS: PoseEstimate = PoseEstimate::NoPose {
        reason: NoPoseReason::TooFewPoints,
        inlier_count: 0,
    };

    #[test]
    fn cells_that_are_all_shifted_alike_give_the_pose_of_the_shift() {
        let answer = shifting([0.1, 0.2, 0.03])
            .localize(LocalizerInput::of(&sweep()))
            .unwrap();
        let pose = answer.estimate.world_from_cav().unwrap();
        let off = pose.isometry().translation.vector - Vector3::new(1010.0, -1980.0, 33.0);
        assert!(off.norm() < 1e-2 && pose.yaw_rad().abs() < 1e-4, "{pose:?}");
    }

    #[test]
    fn sweeps_that_show_too_little_have_no_pose() {
        let nan = PointCloud {
            xyzi: vec![[f32::NAN; 4]; 5000],
        };
        let few = PointCloud {
            xyzi: (0..10).map(|k| [3.0 * k as f32, 3.0, 0.5, 0.1]).collect(),
        };
        let mut localizer = shifting([0.0; 3]);
        for cloud in [&PointCloud::default(), &nan, &few] {
            assert_eq!(
                localizer
                    .localize(LocalizerInput::of(cloud))
                    .unwrap()
                    .estimate,
                TOO_FEW_POINTS
            );
        }
        // Coordinates that overflow are those of no cell.
        assert_eq!(
            shifting([3e38, 0.0, 0.0])
                .localize(LocalizerInput::of(&sweep()))
                .unwrap()
                .estimate,
            TOO_FEW_POINTS
        );
    }

    fn load_error(path: &Path) -> String {
        SgLocLocalizer::load(path, Device::Cpu, PoseSolver::default())
            .unwrap_err()
            .to_string()
    }

    fn config_with(encoder: SceneEncoderConfig) -> SgLocConfig {
        SgLocConfig {
            encoder,
            ..config()
        }
    }

    #[test]
    fn files_of_something_else_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let wider = config_with(SceneEncoderConfig {
            residual_widths: vec![16],
            ..config().encoder
        });
        let path = write(folder.path(), &wider, [0.0; 3]);
        assert!(
            load_error(&path).contains("weights.safetensors: tensor \""),
            "{}",
            load_error(&path)
        );
        let path = write(
            folder.path(),
            &config_with(SceneEncoderConfig {
                voxel_m: -1.0,
                ..config().encoder
            }),
            [0.0; 3],
        );
        assert!(
            load_error(&path).contains("voxel_m is -1"),
            "{}",
            load_error(&path)
        );
        let path = write(folder.path(), &config(), [0.0; 3]);
        let message = Localizer::load(&path, &path, Inference::default())
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("\"SGLoc\"") && message.contains("\"scene encoder\""),
            "{message}"
        );
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        assert!(
            load_error(&path).contains("not a complete safetensors file"),
            "{}",
            load_error(&path)
        );
        assert!(load_error(&folder.path().join("missing")).contains("missing"));
    }
}
