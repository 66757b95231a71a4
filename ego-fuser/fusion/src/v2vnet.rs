//! V2VNet (Wang et al., ECCV 2020): a graph neural network whose nodes are vehicles that exchange messages for some
//! rounds.
//!
//! In each round every node gets the maps of all nodes in its own frame, computes a message for each pair with a
//! convolution, takes their mean or maximum, and updates its map with a convolutional GRU. As in OpenCOOD and CoAlign
//! the GRU begins every round with an empty state: its reset gate and all weights on the state have no effect, and are
//! neither multiplied here nor trained.

use perception::model_config::{ConfigError, DetectorConfig};
use perception::tensor_values::tensor;
use protocol::config::{require, within};
use protocol::{BevGrid, Pose};
use serde::{Deserialize, Serialize};
use tch::nn;
use tch::{Device, Kind, TchError, Tensor};

use super::conv_gru::{Conv, ConvGru};
use super::f64_tensor::picked;
use super::maps::reaching;
use super::settings::of_size;
use crate::warp::{BILINEAR, NEAREST, PADDING_ZEROS, cav_from_ego_normalized};
use crate::{AlignedMaps, Fusion, FusionOutput, FusionSettings, MapMetadata, MethodSpec};

/// V2VNet.
pub static METHOD: MethodSpec =
    MethodSpec::of_features::<V2vNetConfig>("feature maps, messages between the vehicles (V2VNet)");

/// Aggregation of a node's messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Aggregation {
    /// Their mean.
    Mean,
    /// Their maximum; out of a map's reach a message is zero.
    Max,
}

/// Sizes of [`V2vNet`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct V2vNetConfig {
    /// Channels of the maps.
    pub channels: i64,
    /// Rounds of messages.
    pub rounds: usize,
    /// Aggregation of messages.
    pub aggregation: Aggregation,
    /// Layers of the GRU; 0: a message is added to the map as it is.
    pub gru_layers: usize,
    /// Edge of the GRU's kernels, cells.
    pub kernel: i64,
}

impl V2vNetConfig {
    /// OpenCOOD's: two rounds, the mean, one layer.
    pub fn full(channels: i64) -> Self {
        Self {
            channels,
            rounds: 2,
            aggregation: Aggregation::Mean,
            gru_layers: 1,
            kernel: 3,
        }
    }

    /// One round: with N vehicles the round before the last costs N times as much as the last, for the messages between
    /// neighbours.
    pub fn lean(channels: i64) -> Self {
        Self {
            rounds: 1,
            ..Self::full(channels)
        }
    }

    /// Checks that a network can be built.
    ///
    /// # Errors
    /// [`ConfigError`] names the field.
    pub fn validate(&self) -> Result<(), ConfigError> {
        within("fusion channels", self.channels, 1, 4096)?;
        within("fusion rounds", self.rounds as i64, 1, 16)?;
        within("fusion gru_layers", self.gru_layers as i64, 0, 8)?;
        within("fusion kernel", self.kernel, 1, 15)?;
        let is_odd = self.kernel % 2 == 1;
        let (field, rule) = ("fusion kernel", "must be odd");
        Ok(require(is_odd, field, self.kernel, rule)?)
    }
}

impl FusionSettings for V2vNetConfig {
    const KIND: &'static str = "v2vnet";

    fn for_detector(detector: &DetectorConfig) -> Self {
        of_size(detector, Self::lean, Self::full)
    }

    fn build(&self, path: &nn::Path<'_>) -> Result<Box<dyn Fusion>, ConfigError> {
        Ok(Box::new(V2vNet::new(path, self)?))
    }
}

/// Message passing between vehicles.
#[derive(Debug)]
pub struct V2vNet {
    config: V2vNetConfig,
    message: Conv,
    gru: ConvGru,
    /// The last layer, per cell.
    mlp: Conv,
}

/// Transforms from every node's map to the frame of one node.
#[derive(Debug)]
pub struct Incoming {
    /// `[N, 2, 3]` from coordinates -1..1 of the receiver to those of each sender.
    pub theta: Tensor,
    /// True if -1 and 1 are the centres of the outer cells, false for their edges.
    pub corners_aligned: bool,
    /// `[N, 1, H, W]`: validity of each sender's messages.
    pub mask: Tensor,
}

impl V2vNet {
    /// Parameters `msg_cnn.*`, `conv_gru.cell_list.<layer>.{conv_gates,conv_can}.*` and `mlp.*` below `path`.
    ///
    /// # Errors
    /// [`ConfigError`] names the field that no network can be built from.
    pub fn new(path: &nn::Path<'_>, config: &V2vNetConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        let channels = config.channels;
        let (io, kernel) = ([2 * channels, channels], config.kernel);
        Ok(Self {
            message: Conv::new(&(path / "msg_cnn"), io, 3),
            gru: ConvGru::new(&(path / "conv_gru"), io, kernel, config.gru_layers),
            mlp: Conv::linear(&(path / "mlp"), [channels, channels]),
            config: config.clone(),
        })
    }

    /// All rounds, and the map `[C, H, W]` of node 0 after them.
    ///
    /// # Shapes
    /// - `maps`: `[N, C, H, W]`, each in the frame of its node
    /// - `incoming`: for node 0 and, with more than one round, for all others
    ///
    /// # Errors
    /// [`TchError`] when shapes do not fit.
    pub fn propagate(&self, maps: &Tensor, incoming: &[Incoming]) -> Result<Tensor, TchError> {
        let mut nodes = maps.shallow_clone();
        let last = self.config.rounds;
        for round in 1..=last {
            // Of the last round only the ego's update is used.
            let receivers = if round == last { 1 } else { incoming.len() };
            nodes = self.round(&nodes, &incoming[..receivers])?;
        }
        self.mlp.apply(&nodes.f_narrow(0, 0, 1)?)?.f_squeeze_dim(0)
    }

    fn round(&self, nodes: &Tensor, incoming: &[Incoming]) -> Result<Tensor, TchError> {
        let channels = self.config.channels;
        let receivers = nodes.f_narrow(0, 0, incoming.len() as i64)?;
        // The convolution over a pair is the sum of one over the sender and one over the receiver, which is the same
        // for all its senders.
        let of_receivers = self.message.part(&receivers, channels, true)?;
        let mut aggregated = Vec::with_capacity(incoming.len());
        for (index, incoming) in incoming.iter().enumerate() {
            let arrived = incoming.warp(nodes)?;
            let of_receiver = of_receivers.f_narrow(0, index as i64, 1)?;
            let messages = (self.message.part(&arrived, 0, false)? + of_receiver) * &incoming.mask;
            aggregated.push(match self.config.aggregation {
                // Over all nodes: one that is out of reach counts as a message of zeros.
                Aggregation::Mean => {
                    messages.f_mean_dim([0i64].as_slice(), true, messages.kind())?
                }
                Aggregation::Max => messages.f_amax([0i64].as_slice(), true)?,
            });
        }
        let aggregated = Tensor::f_cat(&aggregated, 0)?;
        if self.config.gru_layers == 0 {
            return Ok(receivers + aggregated);
        }
        self.gru
            .first_state(&Tensor::f_cat(&[receivers, aggregated], 1)?)
    }
}

impl Incoming {
    fn warp(&self, maps: &Tensor) -> Result<Tensor, TchError> {
        let (theta, corners_aligned) = (self.theta.f_to_kind(maps.kind())?, self.corners_aligned);
        let places = Tensor::f_affine_grid_generator(&theta, maps.size(), corners_aligned)?;
        maps.f_grid_sampler(&places, BILINEAR, PADDING_ZEROS, corners_aligned)
    }

    /// Incoming maps of `receiver` from all, by the poses of their maps; `reach` is given for the ego and computed for
    /// others.
    fn between(
        receiver: usize,
        nodes: &[MapMetadata],
        grid: &BevGrid,
        reach: Option<&Tensor>,
        device: Device,
    ) -> Result<Self, TchError> {
        let receiver_from_ego = nodes[receiver].ego_from_cav.isometry().inverse();
        let entries = nodes.iter().flat_map(|node| {
            let receiver_from_cav = receiver_from_ego * node.ego_from_cav.isometry();
            cav_from_ego_normalized(&Pose::from(receiver_from_cav), grid)
        });
        let theta = tensor(&entries.collect::<Vec<f32>>(), &[-1, 2, 3], device)?;
        let mask = match reach {
            Some(reach) => reach.shallow_clone(),
            None => {
                let [height, width] = [grid.height, grid.width].map(i64::from);
                let size = [nodes.len() as i64, 1, height, width];
                let everywhere = Tensor::f_ones(size, (Kind::Float, theta.device()))?;
                let sampling_grid = Tensor::f_affine_grid_generator(&theta, size, false)?;
                everywhere.f_grid_sampler(&sampling_grid, NEAREST, PADDING_ZEROS, false)?
            }
        };
        Ok(Self {
            theta,
            corners_aligned: false,
            mask,
        })
    }
}

impl Fusion for V2vNet {
    /// Agents whose map does not reach the ego at all are no nodes of the graph. Between two neighbours the complete
    /// map is used, cells that were not sent as zeros.
    fn fuse(&self, aligned: &AlignedMaps) -> Result<FusionOutput, TchError> {
        let warped = &aligned.warped;
        let entries = reaching(&warped.mask, true)?;
        let nodes: Vec<MapMetadata> = entries
            .iter()
            .map(|&entry| aligned.metadata[entry as usize])
            .collect();
        // As received: each node warps them to its own frame.
        let maps = picked(&aligned.received.maps, &entries)?;
        let mask = picked(&warped.mask, &entries)?;
        // With a single round only the ego receives.
        let is_single = self.config.rounds <= 1;
        let receivers = if is_single { 1 } else { nodes.len() };
        let incoming = (0..receivers).map(|receiver| {
            let reach = (receiver == 0).then_some(&mask);
            Incoming::between(receiver, &nodes, &aligned.grid, reach, mask.device())
        });
        let incoming: Vec<Incoming> = incoming.collect::<Result<_, _>>()?;
        Ok(self.propagate(&maps, &incoming)?.into())
    }
}

#[cfg(test)]
mod tests {
    use tch::nn::VarStore;
    use tch::no_grad;

    use super::*;
    use crate::test_data::redraw;

    const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);

    fn network(config: &V2vNetConfig) -> (VarStore, V2vNet) {
        tch::set_num_threads(1);
        let variables = VarStore::new(Device::Cpu);
        let network = V2vNet::new(&variables.root(), config).unwrap();
        redraw(&variables, &["weight", "bias"], 0.3);
        (variables, network)
    }

    #[test]
    fn a_neighbour_of_a_neighbour_has_an_effect_after_two_rounds_only() {
        let grid = BevGrid {
            x_min_m: -12.0,
            y_min_m: -2.0,
            cell_m: 1.0,
            width: 24,
            height: 4,
        };
        let facts: Vec<_> = (0..3)
            .map(|agent| MapMetadata::fresh(agent, Pose::IDENTITY))
            .collect();
        // The third node's map reaches the ego at one cell in a corner, and its features lie elsewhere.
        let mask = Tensor::ones([3, 1, 4, 24], FLOAT);
        let _ = mask.get(2).narrow(2, 1, 23).fill_(0.0);
        for (rounds, has_effect) in [(1, false), (2, true)] {
            let config = V2vNetConfig {
                rounds,
                ..V2vNetConfig::full(4)
            };
            let (_variables, network) = network(&config);
            let [empty, filled] = [0.0, 3.0].map(|third| {
                let own_frame = Tensor::full([3, 4, 4, 24], 0.5, FLOAT);
                let _ = own_frame.get(2).narrow(2, 12, 12).fill_(third);
                let maps = AlignedMaps::newest(&own_frame, &mask, &facts, &grid);
                no_grad(|| network.fuse(&maps)).unwrap().map
            });
            let difference = (empty - filled).abs().max().double_value(&[]);
            assert_eq!(
                difference > 1e-5,
                has_effect,
                "{rounds} rounds: {difference}"
            );
        }
    }

    #[test]
    fn invalid_settings_are_rejected() {
        let variables = VarStore::new(Device::Cpu);
        for config in [
            V2vNetConfig {
                rounds: 0,
                ..V2vNetConfig::full(4)
            },
            V2vNetConfig {
                kernel: 2,
                ..V2vNetConfig::full(4)
            },
            V2vNetConfig::full(0),
        ] {
            assert!(
                V2vNet::new(&variables.root(), &config).is_err(),
                "{config:?}"
            );
        }
    }
}
