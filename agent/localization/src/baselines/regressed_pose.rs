//! Networks that regress the pose of a sweep directly, as localizers.

use std::fmt::Debug;
use std::path::Path;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use perception::weights::Weights;
use protocol::config::{FieldError, require};
use protocol::{NoPoseReason, PointCloud, PoseEstimate};
use serde::de::DeserializeOwned;
use support::stage_times::StageTimes;
use tch::{Device, TchError, nn};

use crate::pgc::{Localization, Localize, LocalizerError, LocalizerInput, stopwatch};

/// Network that regresses the pose of one sweep.
pub trait RegressPose: Debug + Send + Sized {
    /// Kind of the weights, as in their file.
    const KIND: &'static str;
    /// Configuration, as in the file of the weights.
    type Config: DeserializeOwned + Debug + Send;

    /// Builds the layers below `path`.
    ///
    /// # Errors
    /// [`LocalizerError`] names the field of the configuration that is wrong.
    fn build(path: &nn::Path<'_>, config: &Self::Config) -> Result<Self, LocalizerError>;

    /// Origin of positions in the world and their unit, both metres.
    fn scale(config: &Self::Config) -> [[f64; 3]; 2];

    /// Position in units from the origin, cosine and sine of the heading; `None` for a sweep that shows too little.
    ///
    /// # Errors
    /// Those of the tensor library.
    fn regress(
        &self,
        cloud: &PointCloud,
        device: Device,
        times: &mut StageTimes,
    ) -> Result<Option<[f32; 5]>, TchError>;
}

/// A trained network of one scene. Every pose has full confidence: the network predicts no error.
#[derive(Debug)]
pub struct PoseRegressor<N: RegressPose> {
    pub(super) network: N,
    config: N::Config,
    device: Device,
}

impl<N: RegressPose> PoseRegressor<N> {
    /// Kind of the weights, as in their file.
    pub const KIND: &'static str = N::KIND;

    /// Reads the output of a training.
    ///
    /// # Errors
    /// [`LocalizerError`] when the file is missing, truncated or of another kind, or its tensors are not those of its
    /// configuration.
    pub fn load(path: &Path, device: Device) -> Result<Self, LocalizerError> {
        let build = |path: &nn::Path<'_>, config| Ok((N::build(path, &config)?, config));
        let (network, config) =
            Weights::load(path)?.network::<_, _, LocalizerError>(N::KIND, device, build)?;
        Ok(Self {
            network,
            config,
            device,
        })
    }

    /// Configuration: scene, origin and scale of its positions.
    pub fn config(&self) -> &N::Config {
        &self.config
    }
}

impl<N: RegressPose> Localize for PoseRegressor<N> {
    fn localize(&mut self, sweep: LocalizerInput<'_>) -> Result<Localization, LocalizerError> {
        let mut times = stopwatch();
        let found = self.network.regress(sweep.cloud, self.device, &mut times)?;
        let Some([x, y, z, cosine, sine]) = found else {
            return Ok(no_pose(NoPoseReason::TooFewPoints, times));
        };
        let [origin_m, scale_m] = N::scale(&self.config);
        let [x, y, z] = [(x, 0), (y, 1), (z, 2)].map(|(of, axis)| of * scale_m[axis] as f32);
        let pose = upright([x, y, z, cosine, sine], origin_m);
        Ok(localization(pose, times))
    }
}

/// The pose with full confidence; none if it is not finite or has no heading.
pub(super) fn localization(pose: Option<Isometry3<f64>>, times: StageTimes) -> Localization {
    match pose {
        Some(pose) => Localization::from_estimate(PoseEstimate::new(pose.into(), 1.0), times),
        None => no_pose(NoPoseReason::Failed, times),
    }
}

pub(super) fn no_pose(reason: NoPoseReason, times: StageTimes) -> Localization {
    let inlier_count = 0;
    let none = PoseEstimate::NoPose {
        reason,
        inlier_count,
    };
    Localization::from_estimate(none, times)
}

/// Position relative to the origin, cosine and sine of the heading; `None` if that is no pose.
fn upright(answer: [f32; 5], origin_m: [f64; 3]) -> Option<Isometry3<f64>> {
    let [x, y, z, cosine, sine] = answer.map(f64::from);
    // Cosine and sine have length 1, unless the network gives no heading.
    let is_pose = [x, y, z].iter().all(|axis| axis.is_finite()) && cosine.hypot(sine) > 0.5;
    is_pose.then(|| {
        let position = Vector3::new(x, y, z) + Vector3::from(origin_m);
        let heading = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), sine.atan2(cosine));
        Isometry3::from_parts(Translation3::from(position), heading)
    })
}

/// Refuses positions without a finite origin or a scale above 0.
pub(super) fn require_scale(origin_m: [f64; 3], scale_m: [f64; 3]) -> Result<(), FieldError> {
    let is_place = origin_m.iter().all(|axis| axis.is_finite());
    require(is_place, "origin_m", origin_m, "must be finite")?;
    let is_scale = scale_m.iter().all(|axis| axis.is_finite() && *axis > 0.0);
    require(is_scale, "scale_m", scale_m, "must be above 0")
}
