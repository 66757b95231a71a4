//! Scene-coordinate regression: pose and confidence from one sweep (the paper's PGC, after LightLoc).
//!
//! A sparse encoder describes the cells of the sweep; a scene-specific head predicts the world coordinates of each cell
//! and their error; a robust solver turns these correspondences into a pose.

pub mod cell_encoder;
pub mod confidence;
pub(crate) mod dense;
pub(crate) mod encoder_config;
pub(crate) mod error;
pub(crate) mod feature_norm;
pub(crate) mod head_config;
pub mod head_files;
mod int8_block;
mod int8_levels;
mod levelling;
mod localization;
pub(crate) mod localize;
mod pose_evidence;
pub mod pose_refinement;
pub mod pose_search;
pub mod pose_solver;
mod pose_std;
mod refinement_network;
mod residual_group;
pub(crate) mod scene_encoder;
mod scene_parts;
pub(crate) mod scene_regression;
pub mod synthetic;
pub(crate) mod voxel_batch;
pub(crate) mod voxelise;
pub mod wrong_place;

pub use cell_encoder::{CellEncoder, EncodedCells, PreparedSweep, SweepFormat};
pub use encoder_config::{SceneEncoderConfig, VoxelInput};
pub use error::LocalizerError;
pub use head_config::{RefinerConfig, SceneHeadConfig};
pub use localization::{Localization, LocalizerTimes};
pub use localize::{Localize, Localizer, LocalizerInput, SceneCoordinates, sigma};
pub use pose_evidence::{PoseEvidence, RefinementEvidence};
pub use refinement_network::Refiner;
pub use scene_encoder::{LocalFeatures, SceneEncoder, SceneFeatures};
pub use scene_regression::{Regression, SceneHead};
pub use voxel_batch::VoxelBatch;
pub use voxelise::{Cell, SweepVoxels};
