//! Where am I: scene-coordinate regression from one sweep (the paper's PGC, after LightLoc).
//!
//! A sparse encoder describes cells of the sweep; a head that belongs to one town says for each cell where in the world
//! it lies and how far off that may be; a robust solver turns these correspondences into a pose.

pub mod confidence;
mod dense;
mod encoder_config;
mod end_to_end;
mod end_to_end_localizer;
mod error;
pub mod evaluation;
mod feature_norm;
mod head_config;
mod localize;
mod pose_evidence;
mod pose_search;
pub mod pose_solver;
mod pose_std;
mod refiner;
mod scene_encoder;
mod scene_head;
mod second_look;
mod sweep_voxels;
#[cfg(test)]
pub(crate) mod synthetic;
pub mod training;
mod voxel_batch;

pub use encoder_config::{SceneEncoderConfig, VoxelInput};
pub use end_to_end::{EndToEnd, EndToEndConfig, EndToEndKind};
pub use end_to_end_localizer::EndToEndLocalizer;
pub use error::LocalizerError;
pub use head_config::{RefinerConfig, SceneHeadConfig};
pub use localize::{Localization, Localize, Localizer, LocalizerTimes, SceneCoordinates, sigma};
pub use pose_evidence::{PoseEvidence, SecondEvidence};
pub use refiner::Refiner;
pub use scene_encoder::{LocalFeatures, SceneEncoder, SceneFeatures};
pub use scene_head::{Regression, SceneHead};
pub use sweep_voxels::{Cell, SweepVoxels};
pub use voxel_batch::VoxelBatch;
