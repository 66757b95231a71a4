//! Cooperative model: the whole network of a method, encoder to head, for training and for the ego's half of inference.

mod stage;

use std::collections::BTreeMap;
use std::path::Path;

use perception::boxes::anchors::Anchors;
use perception::boxes::decode::{DecodeError, decode};
use perception::boxes::postprocess::{PostprocessConfig, detections};
use perception::boxes::refinement::{self, BoxRefinement};
use perception::compute_precision::ComputePrecision;
use perception::detector::DetectorError;
use perception::layers::head::HeadOutput;
use perception::model_config::{ConfigError, DetectorConfig, YAxis};
use perception::pillars::batch::PillarBatch;
use perception::pillars::point_pillars::PointPillars;
use perception::tensor_values::values;
use perception::weights::{CONFIG_KEY, FileError, METHOD_KEY, Weights};
use protocol::Detection;
use protocol::config::require;
use tch::nn::VarStore;
use tch::{Device, Kind, TchError, Tensor};

use crate::box_input::{self, PlacedBox};
use crate::method::{Method, UnknownMethod};
use crate::own::OwnConfig;
use crate::targets::TargetAssigner;
use crate::warp::WarpError;
use crate::where2comm::most_confident;
use crate::{FUSION_KEY, FusionConfig, FusionOutput, MapMetadata, ReceivedMaps, channel_mixing};

pub use stage::FusionStage;
use stage::{FUSION_PREFIX, stored_config};

/// Error of building, loading or running a model.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// No network can be built from the configuration.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The weights do not fit.
    #[error(transparent)]
    Weights(#[from] FileError),
    /// The weights name a method that is not known.
    #[error(transparent)]
    Method(#[from] UnknownMethod),
    /// Feature maps do not fit the BEV grid.
    #[error(transparent)]
    Warp(#[from] WarpError),
    /// A frame cannot be computed.
    #[error(transparent)]
    Detector(#[from] DetectorError),
    /// The tensor library reported an error.
    #[error("model: {0}")]
    Torch(#[from] TchError),
    /// The head's output does not fit the anchors.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// Numbers of metadata entries and views differ.
    #[error("{views} views encoded, but the samples have metadata of {described}")]
    ViewCount {
        /// Feature maps.
        views: i64,
        /// Metadata entries over all samples.
        described: usize,
    },
}

impl ModelError {
    /// True if one frame cannot be computed, and others may be, see [`DetectorError::is_of_frame`].
    pub fn is_of_frame(&self) -> bool {
        matches!(self, Self::Detector(error) if error.is_of_frame())
    }
}

/// Output of a model for a batch.
#[derive(Debug)]
pub struct CooperativeOutput {
    /// Scores and boxes of every anchor.
    pub head: HeadOutput,
    /// For each sample the corrections of its maps by the fusion, see [`FusionOutput::corrections`].
    pub corrections: Vec<Option<Tensor>>,
}

/// Encoder, fusion and head of one method under one set of variables.
#[derive(Debug)]
pub struct CooperativeModel {
    /// Method that it was built for.
    pub method: Method,
    /// Every variable, by the names of the weights file.
    pub variables: VarStore,
    /// The encoder and head.
    pub network: PointPillars,
    anchors: Anchors,
    /// The fusion stage.
    pub fusion: FusionStage,
    /// Refinement of the boxes that a vehicle sends, if it has one.
    pub refinement: Option<BoxRefinement>,
}

impl CooperativeModel {
    /// Builds a model with random parameters (`tch::manual_seed` makes them repeatable).
    ///
    /// # Errors
    /// [`ModelError::Config`] when no network can be built from `config`.
    pub fn new(
        config: &DetectorConfig,
        method: Method,
        device: Device,
    ) -> Result<Self, ModelError> {
        Self::with_fusion(config, method, &method.default_fusion(config), device)
    }

    /// The same with a fusion of another size.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn with_fusion(
        config: &DetectorConfig,
        method: Method,
        fusion: &FusionConfig,
        device: Device,
    ) -> Result<Self, ModelError> {
        // Samples and targets are right-handed; a mirrored network cannot be trained.
        let is_left = config.y_axis == YAxis::Left;
        let rule = "must be left to train";
        require(is_left, "y_axis", config.y_axis, rule).map_err(ConfigError::from)?;
        let variables = VarStore::new(device);
        let network = PointPillars::new(&variables.root(), config)?;
        let fusion = FusionStage::new(&variables.root(), fusion, method, config)?;
        Ok(Self {
            method,
            network,
            variables,
            anchors: Anchors::for_detector(config),
            fusion,
            refinement: None,
        })
    }

    /// Builds the model of a weights file; `method` overrides the one that the file names.
    ///
    /// # Errors
    /// [`ModelError`] when the file is missing, names no known method or does not fit its own configuration.
    pub fn load(path: &Path, method: Option<Method>, device: Device) -> Result<Self, ModelError> {
        Self::from_weights(&Weights::load(path)?, method, None, device)
    }

    /// The same from a file already read, with another fusion than it names.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn from_weights(
        weights: &Weights,
        method: Option<Method>,
        fusion: Option<&FusionConfig>,
        device: Device,
    ) -> Result<Self, ModelError> {
        let method = Method::of_weights(weights, method)?;
        let config = weights.detector_config()?;
        let fusion = match fusion {
            Some(fusion) => fusion.clone(),
            None => stored_config(weights, method, &config)?,
        };
        let mut model = Self::with_fusion(&config, method, &fusion, device)?;
        // Variables must exist before weights are copied into them.
        if box_input::is_in(weights) {
            model.add_box_input();
        }
        if refinement::is_in(weights) {
            model.add_refinement();
        }
        // A single-vehicle network becomes a cooperative one whose fusion is untrained.
        weights.copy_some_into(&model.variables, |name| {
            let is_fusion = name == channel_mixing::WEIGHT || name.starts_with(FUSION_PREFIX);
            !is_fusion || weights.contains(name)
        })?;
        Ok(model)
    }

    fn add_box_input(&mut self) {
        let root = self.variables.root();
        self.fusion.add_box_input(&root, &self.network.config);
    }

    fn add_refinement(&mut self) {
        let root = self.variables.root();
        self.refinement = Some(BoxRefinement::new(&root, &self.network.config));
    }

    /// Freezes everything but the box input and the refinement of boxes, which are made if there are none.
    ///
    /// # Errors
    /// [`TchError`] from the tensor library.
    pub fn train_box_input_only(&mut self) -> Result<(), TchError> {
        if !self.fusion.reads_boxes() {
            self.add_box_input();
        }
        if self.refinement.is_none() {
            self.add_refinement();
        }
        for (name, variable) in self.variables.variables() {
            let is_trained =
                [box_input::PREFIX, refinement::PREFIX].map(|prefix| name.starts_with(prefix));
            let _ = variable.f_set_requires_grad(is_trained.contains(&true))?;
        }
        Ok(())
    }

    /// Metadata for the header of its weights file: configuration, method and fusion.
    pub fn about(&self) -> BTreeMap<String, String> {
        let config = serde_json::to_string(&self.network.config).expect("a configuration is JSON");
        let fusion = self.fusion.config().to_json();
        let method = self.method.name().to_owned();
        [
            (CONFIG_KEY, config),
            (METHOD_KEY, method),
            (FUSION_KEY, fusion),
        ]
        .map(|(key, value)| (key.to_owned(), value))
        .into()
    }

    /// Configuration of the detector.
    pub fn config(&self) -> &DetectorConfig {
        &self.network.config
    }

    /// Sets the precision of the convolutions.
    pub fn set_precision(&mut self, precision: ComputePrecision) {
        self.network.compute = precision.kind();
    }

    /// Device of the variables.
    pub fn device(&self) -> Device {
        self.variables.device()
    }

    /// The forward pass of a training step: all views are encoded together, then fused sample by sample.
    ///
    /// `facts` are the metadata of each sample's views, ego first; `pillars` has the views in the same order.
    ///
    /// # Errors
    /// [`ModelError`] when the numbers of facts and views differ.
    pub fn forward(
        &self,
        pillars: &PillarBatch,
        facts: &[Vec<MapMetadata>],
        train: bool,
    ) -> Result<CooperativeOutput, ModelError> {
        let features = self.network.features(pillars, train);
        let features = self.network.through_compressor(&features, train);
        self.fuse_and_detect(&features, facts, train)
    }

    /// Second half of the forward pass, from the maps of all views `[sum(views), C, H, W]` on, each in its own frame.
    ///
    /// # Errors
    /// [`ModelError`] when the numbers of facts and views differ.
    pub fn fuse_and_detect(
        &self,
        features: &Tensor,
        facts: &[Vec<MapMetadata>],
        train: bool,
    ) -> Result<CooperativeOutput, ModelError> {
        let described: usize = facts.iter().map(Vec::len).sum();
        let views = features.size4()?.0;
        if views != described as i64 {
            return Err(ModelError::ViewCount { views, described });
        }
        // One view per sample and no fusion: the views already are the batch of the head.
        if self.fusion.config().settings::<OwnConfig>().is_some() && described == facts.len() {
            return Ok(CooperativeOutput {
                head: self.network.heads(features)?,
                corrections: facts.iter().map(|_| None).collect(),
            });
        }
        let (mut fused, mut corrections) = (Vec::new(), Vec::new());
        let mut first = 0;
        for facts in facts {
            let maps = features.f_narrow(0, first, facts.len() as i64)?;
            first += facts.len() as i64;
            let output = self.fuse(maps, facts, train)?;
            fused.push(output.map);
            corrections.push(output.corrections);
        }
        Ok(CooperativeOutput {
            head: self.network.heads(&Tensor::f_stack(&fused, 0)?)?,
            corrections,
        })
    }

    /// The fused map of one sample's maps `[N, C, H, W]`, each in its own frame.
    fn fuse(
        &self,
        maps: Tensor,
        facts: &[MapMetadata],
        train: bool,
    ) -> Result<FusionOutput, ModelError> {
        let sent = self.sent(&maps, train)?;
        let mut aligned = self.fusion.align(&ReceivedMaps::new(maps, sent), facts)?;
        aligned.is_training = train;
        Ok(self.fusion.fuse(&aligned)?)
    }

    /// Output for samples of maps `[N, C, H, W]`, their metadata and boxes of neighbours without a map: the method runs
    /// as in inference, gradients flow through the box input only.
    ///
    /// # Errors
    /// [`ModelError`] when maps or metadata do not fit.
    pub fn detect_with_boxes(
        &self,
        samples: &[(Tensor, Vec<MapMetadata>, Vec<PlacedBox>)],
    ) -> Result<HeadOutput, ModelError> {
        let heads = samples.iter().map(|(maps, facts, boxes)| {
            let (fused, head) = tch::no_grad(|| {
                let fused = self.fuse(maps.shallow_clone(), facts, false)?;
                let fused = fused.map.f_unsqueeze(0)?;
                let head = self.network.heads(&fused)?;
                Ok::<_, ModelError>((fused, head))
            })?;
            Ok(self.fusion.with_boxes(&fused, head, boxes)?)
        });
        let heads = heads.collect::<Result<Vec<HeadOutput>, ModelError>>()?;
        let scores: Vec<&Tensor> = heads.iter().map(|head| &head.scores).collect();
        let offsets: Vec<&Tensor> = heads.iter().map(|head| &head.offsets).collect();
        Ok(HeadOutput {
            scores: Tensor::f_cat(&scores, 0)?,
            offsets: Tensor::f_cat(&offsets, 0)?,
        })
    }

    /// Mask of the cells of maps `[N, C, H, W]` that agents would have sent, for a method in which they select: in
    /// training a random share of the most confident cells, so that every threshold is learnt. The ego keeps all of its
    /// own.
    fn sent(&self, features: &Tensor, train: bool) -> Result<Option<Tensor>, TchError> {
        let selects = train && self.fusion.requirements.partial_maps_in_training;
        if !selects || features.size4()?.0 < 2 {
            return Ok(None);
        }
        tch::no_grad(|| {
            let confidence = self.network.heads(features)?.confidence().f_unsqueeze(1)?;
            let share = Tensor::f_rand([1], (Kind::Float, Device::Cpu))?.double_value(&[0]);
            let sent = most_confident(&confidence, share)?;
            let _ = sent.f_get(0)?.f_fill_(1.0)?;
            Ok(Some(sent))
        })
    }

    /// Boxes of every sample of a head's output, post-processed by `limits`.
    ///
    /// # Errors
    /// [`ModelError::Decode`] when the output does not fit the anchors.
    pub fn detections(
        &self,
        output: &HeadOutput,
        limits: &PostprocessConfig,
    ) -> Result<Vec<Vec<Detection>>, ModelError> {
        let samples = (0..output.scores.size4()?.0).map(|sample| {
            let [scores, offsets] =
                [&output.scores, &output.offsets].map(|map| values(&map.f_get(sample)?));
            let decoded = decode(&scores?, &offsets?, &self.anchors, limits.score_threshold)?;
            Ok(detections(&decoded, limits))
        });
        samples.collect()
    }

    /// Post-processing limits of this network: boxes lie completely over its area.
    pub fn limits(&self) -> PostprocessConfig {
        PostprocessConfig::for_detector(self.config())
    }

    /// The assigner of a frame's targets to the anchors of the head.
    pub fn assigner(&self) -> TargetAssigner {
        TargetAssigner::new(self.anchors.clone())
    }
}
