//! Detector for inference: from one sweep to the transmitted feature map and boxes.

mod backbone_level;
mod encoder;
mod error;
mod int8_backbone;
mod output;

use std::path::Path;

use protocol::message::ModelHash;
use protocol::{BevFeatures, BevGrid, DecodedFeatures, Detection, PointCloud};
use support::stage_times::StageTimes;
use tch::nn::VarStore;
use tch::{Device, Kind, Tensor};

pub use backbone_level::BackboneLevel;
pub use error::DetectorError;
pub(crate) use error::Result;
pub use output::{EncoderOutput, Heads, check_values};

use encoder::BevEncoder;
use output::check_boxes;

use crate::boxes::anchors::Anchors;
use crate::boxes::decode::{Decoded, decode};
use crate::boxes::refinement::{self, BoxRefinement};
use crate::crop::Crop;
use crate::int8::{ActivationScales, QuantiseError, ScaleSearch};
use crate::layers::head::{DetectionHead, HeadOutput};
use crate::layers::shrink::Compressor;
use crate::model_config::{DetectorConfig, YAxis};
use crate::pillars::point_pillars::PointPillars;
use crate::pillars::voxels::{Pillars, Voxeliser};
use crate::tensor_values::{tensor, values};
use crate::weights::Weights;

/// A trained PointPillars network in its fastest form, for one sweep at a time.
///
/// Crop, voxels and the features of pillars are computed on the CPU in plain floats, and so are decoding and suppression
/// of boxes; convolutions and heads run on [`Self::device`]. Feature maps stay there; messages and [`Heads`] are copied
/// from it. CUDA computes asynchronously: the time of its convolutions is part of the copy of their result.
///
/// The same sweep gives the same bits in any process, as long as the number of torch threads is the same
/// (`tch::set_num_threads`; live and offline runs use 1).
#[derive(Debug)]
pub struct Detector {
    config: DetectorConfig,
    /// Of its weights file; empty if it was not read from one.
    sha256: String,
    encoder_sha256: String,
    device: Device,
    crop: Crop,
    voxeliser: Voxeliser,
    encoder: BevEncoder,
    compressor: Option<Compressor>,
    head: DetectionHead,
    /// Second stage for boxes that are sent, where the weights have it.
    refinement: Option<BoxRefinement>,
    anchors: Anchors,
    cropped: Vec<[f32; 4]>,
}

impl Detector {
    /// Reads a weights file, configuration included, to compute on `device`.
    ///
    /// # Errors
    /// [`DetectorError`] names the file, the tensor and both shapes.
    pub fn load(path: &Path, device: Device) -> Result<Self> {
        let weights = Weights::load(path)?;
        Self::from_weights(&weights, &weights.detector_config()?, device)
    }

    /// Builds the detector that `config` describes from a file already read; on the CPU in integers if it has
    /// scales of activations.
    ///
    /// # Errors
    /// See [`Self::load`].
    pub fn from_weights(
        weights: &Weights,
        config: &DetectorConfig,
        device: Device,
    ) -> Result<Self> {
        let network = VarStore::new(device);
        let pillars = PointPillars::new(&network.root(), config)?;
        let refinement =
            refinement::is_in(weights).then(|| BoxRefinement::new(&network.root(), config));
        // When all networks are built: it fills every variable that exists.
        weights.copy_into(&network)?;
        let (sha256, encoder_sha256) = (weights.sha256().to_owned(), encoder_sha256(weights));
        let detector = Self {
            sha256,
            encoder_sha256,
            refinement,
            ..Self::from_network(pillars)
        };
        // The integer operators are for the CPU: elsewhere the scales are ignored.
        match weights.activation_scales()? {
            Some(scales) if device == Device::Cpu => {
                let quantised = detector.quantised(&scales);
                Ok(quantised.map_err(|error| weights.quantise_error(error))?)
            }
            _ => Ok(detector),
        }
    }

    /// The same in 8-bit integers; its feature maps are in floating point.
    ///
    /// # Errors
    /// [`QuantiseError`] names the activation whose scale is missing.
    pub fn quantised(self, scales: &ActivationScales) -> Result<Self, QuantiseError> {
        let encoder = self.encoder.quantised(scales)?;
        Ok(Self { encoder, ..self })
    }

    /// Uses a network, trained or not, on its device; its norms are folded into the convolutions.
    pub fn from_network(network: PointPillars) -> Self {
        tch::no_grad(|| Self {
            sha256: String::new(),
            encoder_sha256: String::new(),
            device: network.device(),
            crop: Crop::for_detector(&network.config),
            voxeliser: Voxeliser::for_detector(&network.config),
            encoder: BevEncoder::new(&network),
            compressor: network.compressor.as_ref().map(Compressor::folded),
            anchors: Anchors::for_detector(&network.config),
            head: network.head,
            refinement: None,
            config: network.config,
            cropped: Vec::new(),
        })
    }

    /// Configuration that it was built from.
    pub fn config(&self) -> &DetectorConfig {
        &self.config
    }

    /// Device of its feature maps.
    pub fn device(&self) -> Device {
        self.device
    }

    /// True if it computes in 8-bit integers.
    pub fn is_quantised(&self) -> bool {
        self.encoder.is_quantised()
    }

    /// [`encoder_sha256`] of its weights file; empty if it was not read from one.
    pub fn encoder_sha256(&self) -> &str {
        &self.encoder_sha256
    }

    /// Hash of the weights for the wire, where it identifies compatible feature maps; all zeros if it was not read from
    /// a file.
    pub fn model_hash(&self) -> ModelHash {
        self.sha256.parse().unwrap_or(ModelHash([0; 32]))
    }

    /// BEV grid of its feature maps.
    pub fn grid(&self) -> BevGrid {
        self.config.feature_grid()
    }

    /// Channels, height and width of its feature maps, as they are fused.
    pub fn map_shape(&self) -> [i64; 3] {
        let grid = self.grid();
        let [height, width] = [grid.height, grid.width].map(i64::from);
        [self.config.feature_channels(), height, width]
    }

    /// Channels, height and width as transmitted: with a compressor, of the code.
    pub fn sent_shape(&self) -> [i64; 3] {
        let [_, height, width] = self.map_shape();
        [self.config.sent_channels(), height, width]
    }

    /// Channels of the feature map that the code represents, if there is a compressor: [`BevFeatures::code_of`] of its
    /// messages.
    pub fn code_of(&self) -> Option<u32> {
        self.compressor.as_ref()?;
        u32::try_from(self.config.feature_channels()).ok()
    }

    /// Encodes one sweep.
    ///
    /// Points outside the area, on the vehicle's own body or not finite are ignored; a sweep without any other gives
    /// the feature map of an empty scene.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn encode(&mut self, cloud: &PointCloud) -> Result<EncoderOutput> {
        self.encode_within(self.crop, cloud)
    }

    /// Encodes the points of several vehicles in one frame, for early fusion.
    ///
    /// Nothing is removed around the origin: other vehicles measure the vehicle there, and it is to be detected. Each
    /// sweep's own body must have been removed in its own frame, see [`Crop::without_own_body`].
    ///
    /// # Errors
    /// As [`Self::encode_sweep`].
    pub fn encode_merged(&mut self, cloud: &PointCloud) -> Result<EncoderOutput> {
        let encoded = self.encode_within(self.crop.range_only(), cloud)?;
        self.checked_sweep(encoded, cloud)
    }

    /// [`Self::encode`] of a sweep that is evaluated: it must have points in the area, and its map valid values.
    ///
    /// # Errors
    /// [`DetectorError::NoPoints`], [`DetectorError::Values`], [`DetectorError::Saturated`]; those of the tensor library.
    pub fn encode_sweep(&mut self, cloud: &PointCloud) -> Result<EncoderOutput> {
        let encoded = self.encode(cloud)?;
        self.checked_sweep(encoded, cloud)
    }

    fn checked_sweep(&self, encoded: EncoderOutput, cloud: &PointCloud) -> Result<EncoderOutput> {
        // The map of an empty sweep is valid and would pass for an empty road.
        if encoded.points == 0 {
            let (points, area_m) = (cloud.len(), self.config.lidar_range_m);
            return Err(DetectorError::NoPoints { points, area_m });
        }
        check_values("the feature map of the sweep", &encoded.features)?;
        // A scale that is far too small leaves the map finite, and wrong.
        for (level, values) in encoded.levels.iter().enumerate() {
            if values.is_saturated()? {
                return Err(DetectorError::Saturated(level));
            }
        }
        Ok(encoded)
    }

    /// Crop of its input.
    pub fn crop(&self) -> &Crop {
        &self.crop
    }

    /// Adds the activations of a sweep to a search for their scales.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn observe(&mut self, cloud: &PointCloud, search: &mut ScaleSearch) -> Result<()> {
        let pillars = self.pillars(self.crop, cloud);
        let canvas = self.encoder.scatter(&pillars)?;
        Ok(tch::no_grad(|| self.encoder.observe(&canvas, search))?)
    }

    /// Pillars of a cropped sweep in the network's frame.
    fn pillars(&mut self, crop: Crop, cloud: &PointCloud) -> Pillars {
        self.cropped.clear();
        crop.keep(&cloud.xyzi, &mut self.cropped);
        // After the crop, which is in the vehicle's frame.
        if self.config.y_axis == YAxis::Right {
            for point in &mut self.cropped {
                point[1] = -point[1];
            }
        }
        self.voxeliser.voxelise(&self.cropped)
    }

    fn encode_within(&mut self, crop: Crop, cloud: &PointCloud) -> Result<EncoderOutput> {
        let mut times = StageTimes::start();
        let pillars = self.pillars(crop, cloud);
        times.lap("voxelise");
        let canvas = self.encoder.scatter(&pillars)?;
        times.lap("pillars");
        let (features, levels) = tch::no_grad(|| {
            let levels = self.encoder.levels(&canvas)?;
            Ok::<_, DetectorError>((self.encoder.features(&levels)?, levels))
        })?;
        times.lap("backbone");
        Ok(EncoderOutput {
            features,
            levels,
            points: self.cropped.len(),
            pillars: pillars.len(),
            times: times.into_timings(),
        })
    }

    /// The transmitted form of an encoded feature map `[1, C, H, W]`: the compressor's code `[1, C / ratio, H, W]`; the
    /// feature map itself if the configuration has no compressor.
    ///
    /// # Errors
    /// [`DetectorError::Shape`] if there is a compressor and the feature map is not of this detector.
    pub fn compressed(&self, features: &Tensor) -> Result<Tensor> {
        let Some(compressor) = &self.compressor else {
            return Ok(features.shallow_clone());
        };
        let map = one_map(features, self.map_shape())?;
        let code = tch::no_grad(|| compressor.encode(&map, false).f_contiguous());
        Ok(code?)
    }

    /// Input of head and fusion, `[1, C, H, W]`, from a transmitted tensor.
    ///
    /// # Errors
    /// [`DetectorError::Shape`] if there is a compressor and the tensor is not a code of this detector.
    pub fn decompressed(&self, sent: &Tensor) -> Result<Tensor> {
        let Some(compressor) = &self.compressor else {
            return Ok(sent.shallow_clone());
        };
        let code = one_map(sent, self.sent_shape())?;
        let map = tch::no_grad(|| compressor.decode(&code, false).f_contiguous());
        Ok(map?)
    }

    /// An encoded feature map `[1, C, H, W]` after the compressor: compressed and expanded again.
    ///
    /// Feature maps are encoded and stored without it: a caller that uses one that was not transmitted applies this
    /// once.
    ///
    /// # Errors
    /// As [`Self::compressed`].
    pub fn through_compressor(&self, features: &Tensor) -> Result<Tensor> {
        self.decompressed(&self.compressed(features)?)
    }

    /// The feature map `[1, C, H, W]` of a message, expanded if it is a code, and zero where nothing was sent.
    ///
    /// # Errors
    /// [`DetectorError::Shape`] if it is not of this detector; the caller checks its BEV grid.
    pub fn received(&self, message: &DecodedFeatures) -> Result<Tensor> {
        let (sent, values) = (&message.sent, &message.features.values);
        let (channels, grid) = (message.features.channels, message.features.grid);
        let [expected, height, width] = self.sent_shape();
        let found = [channels, grid.height, grid.width].map(i64::from);
        if found != self.sent_shape() || values.len() as i64 != expected * height * width {
            let what = "feature map of a message";
            return Err(DetectorError::Shape(what, found.into(), self.sent_shape()));
        }
        let code = tensor(values, &[1, expected, height, width], self.device)?;
        let decompressed = self.decompressed(&code)?;
        let (Some(sent), Some(_)) = (sent, &self.compressor) else {
            return Ok(decompressed);
        };
        // The expansion spreads the sent cells to their neighbours, and the bias everywhere.
        let sent = tensor(sent, &[1, 1, height, width], self.device)?;
        Ok(decompressed.f_mul(&sent.f_to_kind(Kind::Float)?)?)
    }

    /// Scores, offsets and confidence of a feature map `[1, C, H, W]` or `[C, H, W]`, own or fused.
    ///
    /// # Errors
    /// [`DetectorError::Shape`] if the feature map is not of this detector; [`DetectorError::Values`] if an output is
    /// not valid.
    pub fn heads(&self, features: &Tensor) -> Result<Heads> {
        Heads::new(&self.head_output(features)?)
    }

    /// Scores and offsets of such a map as tensors, not checked.
    ///
    /// # Errors
    /// [`DetectorError::Shape`] if the feature map is not of this detector.
    pub fn head_output(&self, features: &Tensor) -> Result<HeadOutput> {
        let map = checked(features, self.map_shape())?;
        Ok(tch::no_grad(|| self.head.forward_one(&map))?)
    }

    /// Boxes above a score, in the frame of the feature map's vehicle, not yet suppressed.
    ///
    /// # Errors
    /// [`DetectorError::Decode`] if the heads are of another detector, [`DetectorError::Values`] or
    /// [`DetectorError::Box`] if a box is one that a message refuses, or is farther away than 10 km.
    pub fn boxes(&self, heads: &Heads, score_threshold: f32) -> Result<Vec<Decoded>> {
        let (scores, offsets) = (&heads.scores, &heads.offsets);
        let mut boxes = decode(scores, offsets, &self.anchors, score_threshold)?;
        check_boxes(&boxes)?;
        if self.config.y_axis == YAxis::Right {
            for found in &mut boxes {
                found.box3d = found.box3d.mirrored_y();
            }
        }
        Ok(boxes)
    }

    /// Detections of a feature map `[1, C, H, W]` of one vehicle, refined where the weights have a refinement, by
    /// descending score.
    ///
    /// # Errors
    /// [`DetectorError::Shape`] if the feature map is not of this detector.
    pub fn refined(&self, map: &Tensor, detections: Vec<Detection>) -> Result<Vec<Detection>> {
        let Some(refinement) = &self.refinement else {
            return Ok(detections);
        };
        Ok(refinement.refined(&checked(map, self.map_shape())?, detections)?)
    }

    /// Message of a feature map in its transmitted form, see [`Self::compressed`].
    ///
    /// # Errors
    /// [`DetectorError::Shape`] if the tensor is not of this detector.
    pub fn to_message(&self, sent: &Tensor) -> Result<BevFeatures> {
        self.bev_features(sent, self.sent_shape(), self.code_of())
    }

    /// An encoded feature map `[1, C, H, W]` in its stored form, before the compressor.
    ///
    /// # Errors
    /// [`DetectorError::Shape`] if the tensor is not a feature map of this detector.
    pub fn to_kept(&self, features: &Tensor) -> Result<BevFeatures> {
        self.bev_features(features, self.map_shape(), None)
    }

    fn bev_features(
        &self,
        map: &Tensor,
        shape: [i64; 3],
        code_of: Option<u32>,
    ) -> Result<BevFeatures> {
        Ok(BevFeatures {
            grid: self.grid(),
            channels: shape[0] as u32,
            code_of,
            values: values(&one_map(map, shape)?)?,
        })
    }
}

/// SHA-256 of the encoder in a detector's weights, pillars and backbone: the same for methods that share it.
pub fn encoder_sha256(weights: &Weights) -> String {
    weights.sha256_of(|name| name.starts_with("pillar_vfe.") || name.starts_with("backbone."))
}

/// A feature map `[1, C, H, W]` or `[C, H, W]` of the expected shape as `[1, C, H, W]`, channel by channel in memory.
fn one_map(features: &Tensor, expected: [i64; 3]) -> Result<Tensor> {
    // One memory layout, or the same values would give other last bits.
    Ok(checked(features, expected)?.f_contiguous()?)
}

/// The same in its own memory order.
fn checked(features: &Tensor, expected: [i64; 3]) -> Result<Tensor> {
    let found = features.size();
    if found == expected {
        return Ok(features.f_unsqueeze(0)?);
    }
    if found.split_first() != Some((&1, expected.as_slice())) {
        return Err(DetectorError::Shape("feature map", found, expected));
    }
    Ok(features.shallow_clone())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::int8::{InferencePrecision, SCALES_KEY};
    use crate::pillars::batch::PillarBatch;
    use crate::weights::{self, CONFIG_KEY, Precision};

    fn config() -> DetectorConfig {
        DetectorConfig {
            lidar_range_m: [-12.8, -6.4, -3.0, 12.8, 6.4, 1.0],
            ..DetectorConfig::lean()
        }
    }

    /// A network with running statistics that are not those of a new one, so that folding has something to do.
    fn network() -> (VarStore, PointPillars) {
        network_of(&config())
    }

    fn network_of(config: &DetectorConfig) -> (VarStore, PointPillars) {
        tch::set_num_threads(1);
        tch::manual_seed(5);
        let network = VarStore::new(Device::Cpu);
        let pillars = PointPillars::new(&network.root(), config).unwrap();
        for (name, mut variable) in network.variables() {
            if name.contains("running_var") {
                let _ = tch::no_grad(|| variable.uniform_(0.3, 1.5));
            } else if variable.dim() == 1 {
                let _ = tch::no_grad(|| variable.uniform_(-0.2, 0.8));
            }
        }
        (network, pillars)
    }

    fn cloud() -> PointCloud {
        let points = (0..4000).map(|k| {
            [
                (k % 89) as f32 * 0.3 - 13.0,
                (k % 53) as f32 * 0.25 - 6.5,
                -1.0,
                0.4,
            ]
        });
        PointCloud {
            xyzi: points.collect(),
        }
    }

    #[test]
    fn integers_change_its_feature_maps_little() {
        let (store, pillars) = network();
        let (mut float, cloud) = (Detector::from_network(pillars), cloud());
        let expected = float.encode(&cloud).unwrap().features;
        let mut search = ScaleSearch::default();
        float.observe(&cloud, &mut search).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("w.safetensors");
        let scales = serde_json::to_string(&search.scales()).unwrap();
        let config = serde_json::to_string(&config()).unwrap();
        let metadata: BTreeMap<_, _> = [(CONFIG_KEY, config), (SCALES_KEY, scales)]
            .map(|(key, value)| (key.to_owned(), value))
            .into();
        weights::save(&path, &store, &metadata, Precision::Single).unwrap();
        let found = Detector::load(&path, Device::Cpu)
            .unwrap()
            .encode(&cloud)
            .unwrap()
            .features;
        let error = (&found - &expected)
            .square()
            .mean(Kind::Float)
            .sqrt()
            .double_value(&[]);
        assert!(found.is_contiguous() && error > 0.0, "{error}");
        assert!(
            error < 0.06 * expected.std(true).double_value(&[]),
            "{error}"
        );
        let weights = Weights::load(&path)
            .unwrap()
            .with_precision(InferencePrecision::Float);
        let mut again =
            Detector::from_weights(&weights, &weights.config().unwrap(), Device::Cpu).unwrap();
        assert!(again.encode(&cloud).unwrap().features.equal(&expected));
    }

    /// Scales of the activations of a sweep, halved so many times.
    fn scales_of(detector: &mut Detector, cloud: &PointCloud, halvings: i64) -> ActivationScales {
        let mut search = ScaleSearch::default();
        detector.observe(cloud, &mut search).unwrap();
        let mut scales = serde_json::to_value(search.scales()).unwrap();
        for quantisation in scales.as_object_mut().unwrap().values_mut() {
            let exponent = quantisation["scale"].as_i64().unwrap();
            quantisation["scale"] = (exponent - halvings).into();
        }
        serde_json::from_value(scales).unwrap()
    }

    /// A sweep that is encoded with its own scales, halved so many times.
    fn encoded_in_integers(halvings: i64) -> Result<EncoderOutput> {
        let (_store, pillars) = network();
        let mut detector = Detector::from_network(pillars);
        let scales = scales_of(&mut detector, &cloud(), halvings);
        let mut quantised = detector.quantised(&scales).unwrap();
        assert!(quantised.is_quantised());
        quantised.encode_sweep(&cloud())
    }

    #[test]
    fn a_sweep_that_far_too_small_scales_clamp_is_an_error_of_its_frame() {
        assert!(encoded_in_integers(0).is_ok());
        let error = encoded_in_integers(10).unwrap_err();
        assert!(
            matches!(error, DetectorError::Saturated(0)) && error.is_of_frame(),
            "{error:?}"
        );
        let message = error.to_string();
        assert!(
            message.contains("level 0 of the backbone exceed 8 bits"),
            "{message}"
        );
    }

    #[test]
    fn a_missing_scale_is_named_with_its_file() {
        let (store, _) = network();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("w.safetensors");
        let config = serde_json::to_string(&config()).unwrap();
        let metadata: BTreeMap<_, _> = [(CONFIG_KEY, config), (SCALES_KEY, "{}".to_owned())]
            .map(|(key, value)| (key.to_owned(), value))
            .into();
        weights::save(&path, &store, &metadata, Precision::Single).unwrap();
        let message = Detector::load(&path, Device::Cpu).unwrap_err().to_string();
        assert!(
            message.contains("w.safetensors") && message.contains("pillar_vfe.canvas"),
            "{message}"
        );
    }

    #[test]
    fn it_computes_the_same_as_the_trained_network() {
        let (_store, pillars) = network();
        let cloud = cloud();
        let mut cropped = Vec::new();
        Crop::for_detector(&config()).keep(&cloud.xyzi, &mut cropped);
        let sweep = Voxeliser::for_detector(&config()).voxelise(&cropped);
        let batch = PillarBatch::new(&[&sweep], &pillars.pillar_grid);
        let (expected, scores) = tch::no_grad(|| {
            let features = pillars.features(&batch, false);
            let scores = pillars.heads(&features).unwrap().scores;
            (features, scores)
        });
        let mut detector = Detector::from_network(pillars);
        let encoded = detector.encode(&cloud).unwrap();
        assert_eq!(
            (encoded.points, encoded.pillars),
            (cropped.len(), sweep.len())
        );
        assert!(encoded.features.allclose(&expected, 1e-4, 1e-4, false));
        let heads = detector.heads(&encoded.features).unwrap();
        let close =
            Tensor::from_slice(&heads.scores).allclose(&scores.reshape([-1]), 1e-4, 1e-4, false);
        assert!(
            close
                && heads
                    .confidence
                    .iter()
                    .all(|value| (0.0..=1.0).contains(value))
        );
    }

    #[test]
    fn the_compressor_gives_the_same_as_in_training() {
        let (_store, pillars) = network_of(&DetectorConfig {
            compress_ratio: Some(4),
            ..config()
        });
        let mut cropped = Vec::new();
        Crop::for_detector(&config()).keep(&cloud().xyzi, &mut cropped);
        let sweep = Voxeliser::for_detector(&config()).voxelise(&cropped);
        let batch = PillarBatch::new(&[&sweep], &pillars.pillar_grid);
        let expected =
            tch::no_grad(|| pillars.through_compressor(&pillars.features(&batch, false), false));
        let mut detector = Detector::from_network(pillars);
        let encoded = detector.encode(&cloud()).unwrap().features;
        let left = detector.through_compressor(&encoded).unwrap();
        assert!(
            left.allclose(&expected, 1e-4, 1e-4, false)
                && !left.allclose(&encoded, 1e-2, 1e-2, false)
        );
        let other = Tensor::zeros([1, 64, 8, 8], (Kind::Float, Device::Cpu));
        assert!(matches!(
            detector.through_compressor(&other),
            Err(DetectorError::Shape(..))
        ));
        let plain = Detector::from_network(network().1);
        assert!(
            plain.through_compressor(&encoded).unwrap().equal(&encoded),
            "there is no compressor"
        );
        assert_eq!(
            (plain.sent_shape(), plain.code_of()),
            (plain.map_shape(), None)
        );
    }

    #[test]
    fn the_transmitted_code_expands_to_the_same_bits() {
        let (_store, pillars) = network_of(&DetectorConfig {
            compress_ratio: Some(16),
            ..config()
        });
        let mut detector = Detector::from_network(pillars);
        let encoded = detector.encode(&cloud()).unwrap().features;
        let features = detector
            .to_message(&detector.compressed(&encoded).unwrap())
            .unwrap();
        let cells = detector.grid().cells();
        assert_eq!(
            (features.channels, features.code_of, features.values.len()),
            (4, Some(64), 4 * cells)
        );
        let whole = detector.through_compressor(&encoded).unwrap();
        let mut message = DecodedFeatures {
            features,
            sent: None,
        };
        assert!(detector.received(&message).unwrap().equal(&whole));
        message.sent = Some((0..cells).map(|cell| cell < cells / 2).collect());
        let half = detector.received(&message).unwrap();
        let values: Vec<f32> = Vec::try_from(half.view([-1])).unwrap();
        assert!(
            values
                .chunks(cells)
                .all(|channel| channel[cells / 2..].iter().all(|value| *value == 0.0))
        );
        assert_eq!(
            &values[..10],
            &Vec::<f32>::try_from(whole.view([-1])).unwrap()[..10]
        );
        let map = DecodedFeatures {
            features: detector.to_kept(&encoded).unwrap(),
            sent: None,
        };
        let message = detector.received(&map).unwrap_err().to_string();
        assert!(
            message.contains("[64, 16, 32]") && message.contains("[4, 16, 32]"),
            "{message}"
        );
        assert!(detector.to_message(&encoded).is_err());
    }

    #[test]
    fn the_same_sweep_gives_the_same_bits_whatever_came_before() {
        let (_store, pillars) = network();
        let mut detector = Detector::from_network(pillars);
        let first = detector.encode(&cloud()).unwrap().features;
        let nothing = detector.encode(&PointCloud::default()).unwrap();
        assert_eq!((nothing.points, nothing.pillars), (0, 0));
        let odd = PointCloud {
            xyzi: vec![[f32::NAN; 4], [5.0, f32::INFINITY, 0.0, 0.0]],
        };
        assert!(
            detector
                .encode(&odd)
                .unwrap()
                .features
                .equal(&nothing.features)
        );
        assert!(detector.encode(&cloud()).unwrap().features.equal(&first));
        let message = detector.to_message(&first).unwrap();
        let [channels, height, width] = detector.map_shape();
        let back = Tensor::from_slice(&message.values).view([channels, height, width]);
        assert_eq!(
            detector.heads(&back).unwrap(),
            detector.heads(&first).unwrap()
        );
    }

    #[test]
    fn a_network_of_a_mirrored_frame_gets_the_mirrored_cloud() {
        let (store, pillars) = network();
        let _ = tch::no_grad(|| {
            store.variables()["cls_head.bias"]
                .shallow_clone()
                .fill_(0.5)
        });
        let mut plain = Detector::from_network(pillars);
        let (mirrored_store, mut pillars) = network();
        for (name, mut variable) in mirrored_store.variables() {
            tch::no_grad(|| variable.copy_(&store.variables()[&name]));
        }
        pillars.config.y_axis = YAxis::Right;
        let mut mirrored = Detector::from_network(pillars);
        let flipped = cloud().xyzi.into_iter().map(|[x, y, z, i]| [x, -y, z, i]);
        let flipped = PointCloud {
            xyzi: flipped.collect(),
        };
        let (there, here) = (
            plain.encode(&cloud()).unwrap(),
            mirrored.encode(&flipped).unwrap(),
        );
        assert!(there.features.equal(&here.features));
        let [theirs, ours] =
            [(&plain, &there.features), (&mirrored, &here.features)].map(|(detector, features)| {
                let heads = detector.heads(features).unwrap();
                detector.boxes(&heads, 0.3).unwrap()
            });
        assert!(!theirs.is_empty() && theirs.len() == ours.len());
        for (theirs, ours) in theirs.iter().zip(&ours) {
            assert_eq!(theirs.box3d.center_m[1], -ours.box3d.center_m[1]);
            assert_eq!(theirs.box3d.heading_rad, -ours.box3d.heading_rad);
            assert_eq!(theirs.box3d.center_m[0], ours.box3d.center_m[0]);
        }
    }

    #[test]
    fn loading_from_its_file_is_bit_exact() {
        let (store, pillars) = network();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lean.safetensors");
        let metadata: BTreeMap<_, _> = [(
            CONFIG_KEY.to_owned(),
            serde_json::to_string(&config()).unwrap(),
        )]
        .into();
        let sha256 = weights::save(&path, &store, &metadata, Precision::Single).unwrap();
        let mut loaded = Detector::load(&path, Device::Cpu).unwrap();
        assert_eq!((&loaded.sha256, loaded.config()), (&sha256, &config()));
        let mut original = Detector::from_network(pillars);
        assert!(
            loaded
                .encode(&cloud())
                .unwrap()
                .features
                .equal(&original.encode(&cloud()).unwrap().features)
        );
    }

    #[test]
    fn maps_of_other_detectors_are_rejected_with_both_shapes() {
        let (_store, pillars) = network();
        let detector = Detector::from_network(pillars);
        let other = Tensor::zeros([1, 64, 8, 8], (Kind::Float, Device::Cpu));
        let message = detector.heads(&other).unwrap_err().to_string();
        assert!(
            message.contains("[1, 64, 8, 8]") && message.contains("[64, 16, 32]"),
            "{message}"
        );
        assert!(detector.to_message(&other).is_err());
    }
}
