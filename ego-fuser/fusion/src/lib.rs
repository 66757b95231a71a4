//! Fusion methods: several BEV feature maps on the ego's grid in, one feature map out. "Map" means BEV feature map in
//! this crate.
//!
//! A method is one file here: its settings ([`FusionSettings`]), its module ([`Fusion`]) and its [`MethodSpec`], which
//! is one line of the table in [`crate::method`].
//!
//! ```
//! use fusion::{AlignedMaps, Fusion, MapMetadata, MaxFusion};
//! use protocol::{BevGrid, Pose};
//! use tch::{Device, Kind, Tensor};
//!
//! # fn main() -> Result<(), tch::TchError> {
//! // Maps `[N, C, H, W]` of the ego and one neighbour, on the ego's grid.
//! let grid = BevGrid { x_min_m: -2.0, y_min_m: -2.0, cell_m: 1.0, width: 4, height: 4 };
//! let features = Tensor::rand([2, 8, 4, 4], (Kind::Float, Device::Cpu));
//! let mask = Tensor::ones([2, 1, 4, 4], (Kind::Float, Device::Cpu));
//! let metadata = [0, 1].map(|agent| MapMetadata::fresh(agent, Pose::from_xyz_yaw([0.0; 3], 0.0)));
//! let fused = MaxFusion.fuse(&AlignedMaps::newest(&features, &mask, &metadata, &grid))?;
//! assert_eq!(fused.map.size(), [8, 4, 4]);
//! # Ok(())
//! # }
//! ```
//!
//! A new method, step by step: `deploy/docs/tutorials/fusion-method.md`.

pub mod attention;
mod block_order;
pub mod box_input;
pub(crate) mod channel_mixing;
pub(crate) mod classes;
pub mod coalign;
pub mod cobevt;
mod conv_gru;
pub mod disconet;
pub mod ermvp;
pub mod f64_tensor;
pub(crate) mod full_resolution;
pub mod history;
mod interface;
pub mod layers;
pub mod maps;
pub mod max;
pub mod method;
pub mod model;
pub mod own;
mod padding;
mod partition;
pub mod pastat;
pub mod planar_fit;
pub mod planar_pose;
pub mod points;
pub mod pose_graph;
mod script;
pub mod settings;
pub mod spec;
pub mod swap_fusion;
pub mod targets;
#[cfg(test)]
pub(crate) mod test_data;
pub(crate) mod traf_align;
pub mod v2vnet;
pub mod v2xvit;
mod vector_loops;
pub mod warp;
pub mod where2comm;

pub use attention::AttentionFusion;
pub use block_order::BlockOrder;
pub use interface::{Fusion, FusionOutput};
pub use maps::{AlignedMaps, EarlierMaps, MapMetadata, ReceivedMaps};
pub use max::MaxFusion;
pub use method::Method;
pub use settings::{FUSION_KEY, FusionConfig, FusionSettings, HistorySpec, Requirements};
pub use spec::{Exchange, FusionSpec, MethodSpec};

/// The tutorial of a new method, compiled and run.
#[cfg(doctest)]
#[doc = include_str!("../../../deploy/docs/tutorials/fusion-method.md")]
mod tutorial {}
