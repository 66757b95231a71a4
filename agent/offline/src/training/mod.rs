//! Training of localizers, in two stages as in LightLoc: an encoder once, over many scenes; then, for every new scene,
//! only a head on the frozen encoder's features.

mod contrast;
mod encoder_training;
mod feature_cache;
mod kmeans;
mod pairs;
mod pose_regression;
mod redundancy;
mod scene_training;
mod scene_validation;
mod sgloc_training;
mod sweep_store;
mod turned_sweep;

pub use contrast::EncoderAccuracy;
pub use encoder_training::{EncoderSummary, EncoderTrainConfig, train_encoder};
pub(crate) use feature_cache::FeatureCache;
pub use feature_cache::SweepAugmentation;
pub(crate) use kmeans::kmeans;
pub use pose_regression::{
    PoseRegressionConfig, PoseRegressionSummary, RegressionAccuracy, train_diffloc, train_hypliloc,
};
pub use redundancy::LeaveOut;
pub(crate) use redundancy::Redundancy;
pub(crate) use scene_training::train_scene_on;
pub use scene_training::{SceneSummary, SceneTrainConfig, train_scene};
pub use scene_validation::SceneAccuracy;
pub use sgloc_training::{SgLocTrainConfig, train_sgloc};
pub(crate) use sweep_store::{SweepList, yaw};
pub(crate) use turned_sweep::{CELLS, thin_and_turn};
