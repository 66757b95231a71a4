//! The whole network of a method, encoder to head, for training and for the ego's half of inference.

use std::collections::BTreeMap;
use std::path::Path;

use agent::anchors::Anchors;
use agent::decode::{DecodeError, decode};
use agent::head::HeadOutput;
use agent::model_config::{ConfigError, DetectorConfig};
use agent::pillar_batch::PillarBatch;
use agent::point_pillars::PointPillars;
use agent::postprocess::{AgentBoxes, PostprocessConfig, postprocess};
use agent::training::ComputePrecision;
use agent::weights::{CONFIG_KEY, Weights, WeightsError};
use nalgebra::Isometry3;
use protocol::{Box3d, Detection, Pose};
use tch::nn::VarStore;
use tch::{Device, Kind, TchError, Tensor};

use crate::fusion::{self, AlignedViews, Fusion, Steering, steering};
use crate::method::{Exchange, Method, UnknownMethod};
use crate::targets::{LatticeError, TargetAssigner, TargetRule};
use crate::warp::{WarpError, warp_to_ego};

/// Metadata key of the method that weights were trained with.
pub const METHOD_KEY: &str = "method";

/// Detections below this score are not decoded.
pub const SCORE_THRESHOLD: f32 = 0.1;

/// Why a model cannot be built, loaded or run.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// No network can be built from the configuration.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The weights do not fit.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The weights name a method that is not known.
    #[error(transparent)]
    Method(#[from] UnknownMethod),
    /// Maps do not fit the lattice.
    #[error(transparent)]
    Warp(#[from] WarpError),
    /// The tensor library refused.
    #[error("model: {0}")]
    Torch(#[from] TchError),
    /// The head's output does not fit the anchors.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// Poses and views do not add up.
    #[error("{views} views encoded, but the samples name {poses}")]
    ViewCount {
        /// Feature maps.
        views: i64,
        /// Poses over all samples.
        poses: usize,
    },
}

/// Encoder, fusion and head of one method under one set of variables.
#[derive(Debug)]
pub struct CooperativeModel {
    /// Which method it was built for.
    pub method: Method,
    /// Every variable, by the names of the weights file.
    pub variables: VarStore,
    network: PointPillars,
    anchors: Anchors,
    fusion: Box<dyn Fusion>,
    steering: Option<Steering>,
}

impl CooperativeModel {
    /// Builds a model with random parameters (`tch::manual_seed` makes them repeatable).
    ///
    /// # Errors
    /// [`ModelError::Config`] when no network can be built from `config`.
    pub fn new(config: &DetectorConfig, method: Method, device: Device) -> Result<Self, ModelError> {
        let variables = VarStore::new(device);
        let network = PointPillars::new(&variables.root(), config)?;
        let shares_maps = method.exchange() == Exchange::Features;
        let steering = shares_maps.then(|| Steering::new(&variables.root(), config.feature_channels()));
        let anchors = Anchors::for_detector(config);
        Ok(Self { method, network, variables, anchors, fusion: fusion::build(method), steering })
    }

    /// Builds the model of a weights file; `method` overrides the one that the file names.
    ///
    /// # Errors
    /// [`ModelError`] when the file is missing, names no known method or does not fit its own configuration.
    pub fn load(path: &Path, method: Option<Method>, device: Device) -> Result<Self, ModelError> {
        let weights = Weights::load(path)?;
        let method = match (method, weights.metadata(METHOD_KEY)) {
            (Some(method), _) => method,
            (None, Some(name)) => name.parse()?,
            (None, None) => Method::None,
        };
        let model = Self::new(&weights.config()?, method, device)?;
        // A network that was trained alone becomes a cooperative one whose steering has everything to learn.
        weights.copy_some_into(&model.variables, |name| name != steering::WEIGHT || weights.contains(name))?;
        Ok(model)
    }

    /// What the header of its weights says of it: configuration and method.
    #[must_use]
    pub fn about(&self) -> BTreeMap<String, String> {
        let config = serde_json::to_string(&self.network.config).expect("a configuration is JSON");
        BTreeMap::from([(CONFIG_KEY.to_owned(), config), (METHOD_KEY.to_owned(), self.method.name().to_owned())])
    }

    /// The numbers it was built from.
    #[must_use]
    pub fn config(&self) -> &DetectorConfig {
        &self.network.config
    }

    /// The encoder and head.
    #[must_use]
    pub fn network(&self) -> &PointPillars {
        &self.network
    }

    /// In which numbers the convolutions compute from now on.
    pub fn set_precision(&mut self, precision: ComputePrecision) {
        self.network.compute = precision.kind();
    }

    /// Where the variables are.
    #[must_use]
    pub fn device(&self) -> Device {
        self.variables.device()
    }

    /// The forward pass of a training step: all views are encoded together, then fused sample by sample.
    ///
    /// `ego_from_cav` holds the poses of each sample's views, ego first; views lie in `pillars` in the same order.
    ///
    /// # Errors
    /// [`ModelError`] when poses and views do not add up.
    pub fn forward(
        &self,
        pillars: &PillarBatch,
        ego_from_cav: &[Vec<Pose>],
        train: bool,
    ) -> Result<HeadOutput, ModelError> {
        let features = self.network.features(pillars, train);
        let features = self.network.through_compressor(&features, train);
        let poses: usize = ego_from_cav.iter().map(Vec::len).sum();
        let views = features.size4()?.0;
        if views != poses as i64 {
            return Err(ModelError::ViewCount { views, poses });
        }
        if ego_from_cav.iter().all(|sample| sample.len() == 1) {
            return Ok(self.network.heads(&features)?);
        }
        let mut fused = Vec::with_capacity(ego_from_cav.len());
        let mut first = 0;
        for poses in ego_from_cav {
            let views = features.f_narrow(0, first, poses.len() as i64)?;
            first += poses.len() as i64;
            let (confidence, age_secs) = (vec![1.0; poses.len()], vec![0.0; poses.len()]);
            fused.push(self.fuse(&views, poses, &confidence, &age_secs)?);
        }
        Ok(self.network.heads(&Tensor::f_stack(&fused, 0)?)?)
    }

    /// Fuses the maps of one sample, each `[C, H, W]` in its own frame, into `[C, H, W]` in the frame of the first.
    ///
    /// # Errors
    /// [`ModelError::Warp`] when the maps do not lie on the lattice of this model.
    pub fn fuse(
        &self,
        features: &Tensor,
        ego_from_cav: &[Pose],
        confidence: &[f64],
        age_secs: &[f64],
    ) -> Result<Tensor, ModelError> {
        let features = match &self.steering {
            Some(steering) => &steering.turn(features, ego_from_cav)?,
            None => features,
        };
        let warped = warp_to_ego(features, None, ego_from_cav, &self.network.config.feature_grid())?;
        let views = AlignedViews { features: &warped.features, mask: &warped.mask, confidence, age_secs };
        Ok(self.fusion.fuse(&views)?)
    }

    /// Boxes of every sample of a head's output, cleaned up by `limits`.
    ///
    /// # Errors
    /// [`ModelError::Decode`] when the output does not fit the anchors.
    pub fn detections(
        &self,
        output: &HeadOutput,
        limits: &PostprocessConfig,
    ) -> Result<Vec<Vec<Detection>>, ModelError> {
        let samples = output.scores.size4()?.0;
        (0..samples)
            .map(|sample| {
                let scores = flat(&output.scores, sample)?;
                let decoded = decode(&scores, &flat(&output.offsets, sample)?, &self.anchors, limits.score_threshold)?;
                let boxes = AgentBoxes { boxes: &decoded, output_from_agent: Isometry3::identity() };
                Ok(postprocess(&[boxes], limits).iter().map(|candidate| candidate.detection(None)).collect())
            })
            .collect()
    }

    /// The limits of the clean-up that go with this network: boxes lie wholly over its area.
    #[must_use]
    pub fn limits(&self) -> PostprocessConfig {
        PostprocessConfig { score_threshold: SCORE_THRESHOLD, ..PostprocessConfig::for_detector(self.config()) }
    }

    /// What finds the targets of a frame among the anchors of the head.
    ///
    /// # Errors
    /// [`LatticeError`] when the configuration has no anchors.
    pub fn assigner(&self) -> Result<TargetAssigner, LatticeError> {
        let anchors = &self.anchors;
        let boxes = (0..anchors.len()).map(|index| {
            let [x, y, z, h, w, l, yaw] = anchors.get(index);
            Box3d { center_m: [x, y, z], size_m: [l, w, h], heading_rad: yaw }
        });
        let shape = [anchors.y_m.len(), anchors.x_m.len(), anchors.yaws_rad.len()];
        TargetAssigner::new(boxes.collect(), shape, TargetRule::default())
    }
}

/// The values of one sample of a map, row-major.
fn flat(map: &Tensor, sample: i64) -> Result<Vec<f32>, TchError> {
    Vec::try_from(map.f_get(sample)?.f_to_device(Device::Cpu)?.f_to_kind(Kind::Float)?.f_reshape([-1])?)
}
