//! Multi-scale network: from pillars to heads, with fusion at every level.

use std::path::Path;

use perception::layers::head::HeadOutput;
use perception::model_config::{ConfigError, DetectorConfig};
use perception::pillars::batch::PillarBatch;
use perception::pillars::point_pillars::PointPillars;
use perception::weights::Weights;
use protocol::config::require;
use serde::{Deserialize, Serialize};
use tch::nn::VarStore;
use tch::{Device, Kind, TchError, Tensor};

use super::fuse::{MapAlignment, fuse_levels, resized};
use fusion::FUSION_KEY;
use fusion::model::ModelError;
use fusion::where2comm::{CommunicationConfig, MapAggregation, SparseCommunication};

/// Kind of the weights files of these networks.
pub const MULTI_SCALE_KIND: &str = "multi_scale_detector";

/// Agents that leave cells out, where agents select cells.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Senders {
    /// All but the ego, as in OpenCOOD.
    #[default]
    Neighbours,
    /// Every second agent of a sample, the first being the ego: as in Where2comm's own code, which was written for
    /// pairs.
    EverySecond,
}

/// Configuration of a network besides its detector, stored as JSON beside its weights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MultiScaleConfig {
    /// Operation that fuses the features of a cell.
    pub aggregation: MapAggregation,
    /// Selection of the cells that agents send; absent: all.
    #[serde(default)]
    pub communication: Option<CommunicationConfig>,
    /// Agents that leave cells out.
    #[serde(default)]
    pub senders: Senders,
    /// True if it was trained on clouds in the frame of the ego, so that maps are not warped.
    #[serde(default)]
    pub one_frame: bool,
}

/// A detector that fuses the maps of several agents at every level of its backbone, for inference.
#[derive(Debug)]
pub struct MultiScaleNetwork {
    /// Every variable, by the names of the weights file.
    pub variables: VarStore,
    /// Its configuration besides the detector.
    pub config: MultiScaleConfig,
    /// The detector.
    pub network: PointPillars,
    communication: Option<SparseCommunication>,
}

/// Output of a network for samples.
#[derive(Debug)]
pub struct MultiScaleOutput {
    /// Scores and offsets, `[samples, ...]`.
    pub heads: HeadOutput,
    /// Share of their cells that agents send, the ego's own counted as if it sent; 1 where all do.
    pub rate: f64,
    /// Bytes that each agent has to send: the map of its first level in `f32`, from which the others follow; where it
    /// leaves cells out, those that it sends and a mask of them.
    pub sent_bytes: Vec<u64>,
}

impl MultiScaleNetwork {
    /// A network with random parameters: those of [`PointPillars`] and, where agents select cells,
    /// `fusion_net.naive_communication.*`.
    ///
    /// # Errors
    /// [`ConfigError`] when none can be built.
    pub fn new(
        detector: &DetectorConfig,
        config: &MultiScaleConfig,
        device: Device,
    ) -> Result<Self, ConfigError> {
        let ratio = detector.compress_ratio;
        let rule = "must be absent where levels are fused";
        require(ratio.is_none(), "compress_ratio", ratio, rule)?;
        let variables = VarStore::new(device);
        let network = PointPillars::new(&variables.root(), detector)?;
        let path = variables.root() / "fusion_net" / "naive_communication";
        let communication = config.communication.as_ref();
        let communication = communication.map(|config| SparseCommunication::new(&path, config));
        Ok(Self {
            variables,
            config: config.clone(),
            network,
            communication: communication.transpose()?,
        })
    }

    /// Reads a weights file whose metadata hold the configurations of detector (`config`) and fusion (`fusion`).
    ///
    /// # Errors
    /// [`ModelError`] names the file and what does not fit.
    pub fn load(path: &Path, device: Device) -> Result<Self, ModelError> {
        let weights = Weights::load(path)?;
        weights.check_kind(MULTI_SCALE_KIND)?;
        let detector = weights.config()?;
        let model = Self::new(&detector, &weights.metadata_json(FUSION_KEY)?, device)?;
        weights.copy_into(&model.variables)?;
        Ok(model)
    }

    /// From the pillars of all agents to scores and offsets of every sample.
    ///
    /// # Errors
    /// [`TchError`] when the samples do not add up to the sweeps.
    pub fn forward(
        &self,
        pillars: &PillarBatch,
        samples: &[MapAlignment],
    ) -> Result<MultiScaleOutput, TchError> {
        let network = &self.network;
        let encoded = network.encoder.forward(pillars, false);
        let canvas = pillars.scatter(&encoded, &network.pillar_grid);
        let (sent, rate) = match &self.communication {
            Some(communication) => {
                // Which cells an agent sends depends on the scores of its own map.
                let alone = network.heads(&network.features_of_canvas(&canvas, false))?;
                let masks = communication.masks(&alone.scores)?;
                // The share of cells that is sent, averaged over samples as the reference does.
                let counts: Vec<i64> = samples.iter().map(|sample| sample.agents).collect();
                let shares = masks.f_split_with_sizes(&counts, 0)?;
                let shares = shares.iter();
                let means = shares.map(|sample| sample.mean(Kind::Double).double_value(&[]));
                let rate = means.sum::<f64>() / samples.len().max(1) as f64;
                (Some(self.without_the_exempt(&masks, samples)?), rate)
            }
            None => (None, 1.0),
        };
        let sent_bytes = self.sent_bytes(sent.as_ref(), samples)?;
        let (aggregation, sent) = (self.config.aggregation, sent.as_ref());
        let fused = fuse_levels(&network.backbone, &canvas, samples, aggregation, sent)?;
        Ok(MultiScaleOutput {
            heads: network.heads(&network.shrink.forward(&fused, false))?,
            rate,
            sent_bytes,
        })
    }

    /// Bytes of the first level's map of each agent.
    fn sent_bytes(
        &self,
        sent: Option<&Tensor>,
        samples: &[MapAlignment],
    ) -> Result<Vec<u64>, TchError> {
        let (pillar_grid, config) = (&self.network.pillar_grid, &self.network.config);
        let stride = config.layer_strides[0];
        // A strided convolution with padding rounds up.
        let [height, width] = [pillar_grid.height, pillar_grid.width]
            .map(|extent| (extent as u64).div_ceil(stride.unsigned_abs()));
        let (cells, cell_bytes) = (height * width, 4 * config.num_filters[0].unsigned_abs());
        let agents = samples.iter().map(|sample| sample.agents).sum::<i64>();
        let Some(sent) = sent else {
            return Ok(vec![cells * cell_bytes; agents.unsigned_abs() as usize]);
        };
        // Interpolation spreads a sent cell over its neighbours: all with a part of it are sent.
        let selected = resized(sent, [height as i64, width as i64])?.f_gt(0.0)?;
        let selected = selected.f_sum_dim_intlist([1i64, 2, 3].as_slice(), false, Kind::Int64)?;
        let selected: Vec<i64> = Vec::try_from(&selected)?;
        let bytes = selected
            .into_iter()
            .map(|selected| match selected.unsigned_abs() {
                all if all == cells => cells * cell_bytes,
                selected => cells.div_ceil(8) + selected * cell_bytes,
            });
        Ok(bytes.collect())
    }

    /// The masks with ones everywhere for agents that send all cells.
    fn without_the_exempt(
        &self,
        masks: &Tensor,
        samples: &[MapAlignment],
    ) -> Result<Tensor, TchError> {
        let sends_all = samples.iter().flat_map(|sample| {
            (0..sample.agents).map(|agent| match self.config.senders {
                Senders::Neighbours => f32::from(agent == 0),
                Senders::EverySecond => f32::from(agent % 2 == 0),
            })
        });
        let sends_all = Tensor::f_from_slice(&sends_all.collect::<Vec<f32>>())?
            .f_view([-1, 1, 1, 1])?
            .f_to_device(masks.device())?;
        masks.f_maximum(&sends_all)
    }
}
