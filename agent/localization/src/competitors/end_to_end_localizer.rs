//! Localization by the competitors: from a sweep to a pose, through the same trait as the localizer.

use std::path::Path;
use std::time::Instant;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use protocol::{NoPoseReason, PointCloud, PoseEstimate};
use tch::nn::VarStore;
use tch::{Device, Kind, Tensor, no_grad};

use super::end_to_end::{EndToEnd, EndToEndConfig, EndToEndKind};
use crate::pgc::error::LocalizerError;
use crate::pgc::localize::{CELLS, Localization, Localize, LocalizerTimes, SceneCoordinates, choose_evenly};
use crate::pgc::pose_solver::{MIN_CELLS, PoseSolver};
use crate::pgc::scene_encoder::SceneFeatures;
use crate::pgc::voxel_batch::VoxelBatch;
use crate::pgc::voxelise::SweepVoxels;
use perception::weights::Weights;

/// Confidence of a pose that is regressed directly: such a network predicts no error.
pub(super) const FULL_CONFIDENCE: f32 = 1.0;

/// A network that was trained end to end on one scene, with the step from its output to a pose.
///
/// Coordinates of cells go through the same solver as the localizer's, all cells with equal weight; there is no pose
/// refinement. The confidence is then the inlier ratio. A directly regressed pose is used unchanged.
#[derive(Debug)]
pub struct EndToEndLocalizer {
    network: EndToEnd,
    solver: PoseSolver,
    device: Device,
    sha256: String,
}

impl EndToEndLocalizer {
    /// Kind of the weights, as in their file.
    pub const KIND: &'static str = "end to end";

    /// Reads the output of `agent train end-to-end`; the file names the target of the regression.
    ///
    /// # Errors
    /// [`LocalizerError`] when the file is missing, truncated or of another kind, or its tensors are not those of its
    /// configuration.
    pub fn load(path: &Path, device: Device) -> Result<Self, LocalizerError> {
        let weights = Weights::load(path)?;
        weights.check_kind(Self::KIND)?;
        let config: EndToEndConfig = weights.config()?;
        let mut variables = VarStore::new(device);
        let network = EndToEnd::new(&variables.root(), &config)?;
        weights.copy_into(&variables)?;
        variables.freeze();
        Ok(Self { network, solver: PoseSolver::default(), device, sha256: weights.sha256().to_owned() })
    }

    /// SHA-256 of the weights.
    #[must_use]
    pub fn sha256(&self) -> &str {
        &self.sha256
    }

    /// Configuration: target of the regression, scene.
    #[must_use]
    pub fn config(&self) -> &EndToEndConfig {
        self.network.config()
    }

    /// Sets another search; a directly regressed pose needs none.
    pub fn set_solver(&mut self, solver: PoseSolver) {
        self.solver = solver;
    }

    fn by_cells(
        &self,
        sweep: &SweepVoxels,
        features: &SceneFeatures,
        mut times: LocalizerTimes,
    ) -> Result<Localization, LocalizerError> {
        let start = Instant::now();
        let chosen = choose_evenly(sweep.cells(), CELLS);
        let rows: Vec<i64> = chosen.iter().map(|&cell| cell as i64).collect();
        let rows = Tensor::f_from_slice(&rows)?.f_to_device(self.device)?;
        let sensor_m: Vec<[f32; 3]> = chosen.iter().map(|&cell| sweep.cells()[cell].centroid_m).collect();
        let places = Tensor::f_from_slice(sensor_m.as_flattened())?.f_view([-1, 3])?.f_to_device(self.device)?;
        let world: Vec<f32> = no_grad(|| {
            let cells = features.cells.f_index_select(0, &rows)?;
            let coordinates = self.network.coordinates(&cells, &places, false)?;
            Vec::try_from(&coordinates.f_reshape([-1])?.f_to_device(Device::Cpu)?)
        })?;
        times.regress = start.elapsed();
        let start = Instant::now();
        let coordinates = SceneCoordinates {
            epsilon_m: vec![0.0; sensor_m.len()],
            sensor_m,
            world_m: world.as_chunks().0.to_vec(),
            origin_m: self.config().origin_m,
        };
        let solved = self.solver.solve(&coordinates);
        times.solve = start.elapsed();
        Ok(Localization::new(&solved, times))
    }

    fn directly(&self, features: &SceneFeatures, mut times: LocalizerTimes) -> Result<Localization, LocalizerError> {
        let start = Instant::now();
        let answer: Vec<f32> = no_grad(|| {
            let (position, heading) = self.network.poses(&features.sweeps)?;
            Vec::try_from(&Tensor::f_cat(&[position, heading], 1)?.f_reshape([-1])?.f_to_device(Device::Cpu)?)
        })?;
        times.regress = start.elapsed();
        Ok(match upright(&answer, self.config().origin_m) {
            Some(pose) => Localization::from_estimate(PoseEstimate::new(pose.into(), FULL_CONFIDENCE), times),
            None => no_pose(NoPoseReason::Failed, times),
        })
    }
}

impl Localize for EndToEndLocalizer {
    fn localize(&mut self, cloud: &PointCloud) -> Result<Localization, LocalizerError> {
        let mut times = LocalizerTimes::default();
        let start = Instant::now();
        let config = self.network.encoder().config();
        let sweep = SweepVoxels::new(cloud.xyzi.iter().map(|&[x, y, z, _]| [x, y, z]), config);
        times.voxelise = start.elapsed();
        if sweep.cells().len() < MIN_CELLS {
            return Ok(no_pose(NoPoseReason::TooFewPoints, times));
        }
        let start = Instant::now();
        let batch = VoxelBatch::new(&[&sweep], config, self.device)?;
        let features = self.network.encoder().encode(&batch, Kind::Float)?;
        times.encode = start.elapsed();
        match self.config().regresses {
            EndToEndKind::SgLoc => self.by_cells(&sweep, &features, times),
            EndToEndKind::Pose => self.directly(&features, times),
        }
    }
}

pub(super) fn no_pose(reason: NoPoseReason, times: LocalizerTimes) -> Localization {
    Localization::from_estimate(PoseEstimate::NoPose { reason, inlier_count: 0 }, times)
}

/// Position relative to the origin, cosine and sine of the heading; `None` if that is no pose.
pub(super) fn upright(answer: &[f32], origin_m: [f64; 3]) -> Option<Isometry3<f64>> {
    let &[x, y, z, cosine, sine] = answer else { return None };
    let [x, y, z, cosine, sine] = [x, y, z, cosine, sine].map(f64::from);
    // Cosine and sine have length 1, unless the network gives no heading.
    let is_pose = [x, y, z].iter().all(|axis| axis.is_finite()) && cosine.hypot(sine) > 0.5;
    is_pose.then(|| {
        let position = Vector3::new(x, y, z) + Vector3::from(origin_m);
        let heading = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), sine.atan2(cosine));
        Isometry3::from_parts(Translation3::from(position), heading)
    })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::path::PathBuf;

    use perception::inference::Inference;

    use super::*;
    use crate::pgc::{Localizer, SceneEncoderConfig};
    use perception::weights::{CONFIG_KEY, KIND_KEY, Precision, save};

    fn config(regresses: EndToEndKind) -> EndToEndConfig {
        let encoder = SceneEncoderConfig {
            voxel_m: 1.0,
            range_m: 40.0,
            widths: vec![4, 8],
            residual_widths: vec![8],
            ..SceneEncoderConfig::lean()
        };
        EndToEndConfig { regresses, scene_name: "test".into(), origin_m: [1000.0, -2000.0, 30.0], encoder }
    }

    /// Writes a network whose last layer outputs `bias` for any sweep.
    fn write(folder: &Path, stated: &EndToEndConfig, built: &EndToEndConfig, bias: &[f32]) -> PathBuf {
        tch::set_num_threads(1);
        let variables = VarStore::new(Device::Cpu);
        EndToEnd::new(&variables.root(), built).unwrap();
        let named = variables.variables();
        let last = match built.regresses {
            EndToEndKind::SgLoc => "regressor.outward",
            EndToEndKind::Pose => "regressor.2",
        };
        no_grad(|| {
            let _ = named[&format!("{last}.weight")].shallow_clone().zero_();
            named[&format!("{last}.bias")].shallow_clone().copy_(&Tensor::from_slice(bias));
        });
        let about = BTreeMap::from([
            (CONFIG_KEY.to_owned(), serde_json::to_string(stated).unwrap()),
            (KIND_KEY.to_owned(), EndToEndLocalizer::KIND.to_owned()),
        ]);
        let path = folder.join("weights.safetensors");
        save(&path, &variables, &about, Precision::Single).unwrap();
        path
    }

    fn answering(regresses: EndToEndKind, bias: &[f32]) -> EndToEndLocalizer {
        let folder = tempfile::tempdir().unwrap();
        let config = config(regresses);
        EndToEndLocalizer::load(&write(folder.path(), &config, &config, bias), Device::Cpu).unwrap()
    }

    fn sweep() -> PointCloud {
        let wall = (0..4000).map(|k| [(k % 60) as f32 - 30.0, 9.0, (k / 60) as f32 * 0.1, 0.2]);
        PointCloud { xyzi: wall.collect() }
    }

    #[test]
    fn a_regressed_pose_is_in_the_world_frame_with_full_confidence() {
        let mut localizer = answering(EndToEndKind::Pose, &[0.5, -0.25, 0.01, 0.0, 3.0]);
        let answer = localizer.localize(&sweep()).unwrap();
        let pose = answer.estimate.world_from_cav().unwrap();
        let expected = [1050.0, -2025.0, 31.0];
        assert!(pose.translation_m.iter().zip(expected).all(|(found, wanted)| (found - wanted).abs() < 1e-3));
        assert!((pose.yaw_rad() - std::f64::consts::FRAC_PI_2).abs() < 1e-6);
        assert_eq!((answer.estimate.confidence(), answer.inlier_count), (1.0, 0));
        assert_eq!(answer.times.solve + answer.times.refine, std::time::Duration::ZERO);
    }

    #[test]
    fn an_output_that_is_no_pose_is_rejected() {
        let failed = PoseEstimate::NoPose { reason: NoPoseReason::Failed, inlier_count: 0 };
        // The first overflows when it becomes metres; the second leaves the heading undefined.
        for bias in [[3e38, 0.0, 0.0, 1.0, 0.0], [0.0; 5]] {
            assert_eq!(answering(EndToEndKind::Pose, &bias).localize(&sweep()).unwrap().estimate, failed);
        }
        let none = answering(EndToEndKind::SgLoc, &[3e38, 0.0, 0.0]).localize(&sweep()).unwrap().estimate;
        assert_eq!(none, PoseEstimate::NoPose { reason: NoPoseReason::TooFewPoints, inlier_count: 0 });
    }

    #[test]
    fn cells_that_are_all_shifted_alike_give_the_pose_of_the_shift() {
        let answer = answering(EndToEndKind::SgLoc, &[0.1, 0.2, 0.03]).localize(&sweep()).unwrap();
        let pose = answer.estimate.world_from_cav().unwrap();
        let off = pose.isometry().translation.vector - Vector3::new(1010.0, -1980.0, 33.0);
        assert!(off.norm() < 1e-2 && pose.yaw_rad().abs() < 1e-4, "{pose:?}");
    }

    #[test]
    fn sweeps_that_show_too_little_have_no_pose() {
        let nan = PointCloud { xyzi: vec![[f32::NAN; 4]; 5000] };
        let few = PointCloud { xyzi: (0..10).map(|k| [3.0 * k as f32, 3.0, 0.5, 0.1]).collect() };
        for (kind, bias) in [(EndToEndKind::SgLoc, &[0.0; 3][..]), (EndToEndKind::Pose, &[0.0, 0.0, 0.0, 1.0, 0.0])] {
            let mut localizer = answering(kind, bias);
            for cloud in [&PointCloud::default(), &nan, &few] {
                let estimate = localizer.localize(cloud).unwrap().estimate;
                assert_eq!(estimate, PoseEstimate::NoPose { reason: NoPoseReason::TooFewPoints, inlier_count: 0 });
            }
        }
    }

    #[test]
    fn files_of_something_else_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let (pose, cells) = (config(EndToEndKind::Pose), config(EndToEndKind::SgLoc));
        let error_text = |path: &Path| EndToEndLocalizer::load(path, Device::Cpu).unwrap_err().to_string();
        let path = write(folder.path(), &pose, &cells, &[0.0; 3]);
        let message = error_text(&path);
        assert!(message.contains("weights.safetensors: tensor \"regressor."), "{message}");
        let wide = SceneEncoderConfig { voxel_m: -1.0, ..pose.encoder.clone() };
        let path = write(folder.path(), &EndToEndConfig { encoder: wide, ..pose.clone() }, &pose, &[0.0; 5]);
        assert!(error_text(&path).contains("voxel_m is -1"), "{}", error_text(&path));
        let path = write(folder.path(), &pose, &pose, &[0.0; 5]);
        let message = Localizer::load(&path, &path, Inference::default()).unwrap_err().to_string();
        assert!(message.contains("\"end to end\"") && message.contains("\"scene encoder\""), "{message}");
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        assert!(error_text(&path).contains("not a complete safetensors file"), "{}", error_text(&path));
        assert!(error_text(&folder.path().join("missing")).contains("missing"));
    }
}
