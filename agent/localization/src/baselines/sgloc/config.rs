//! Configuration of the network.

use serde::{Deserialize, Serialize};

use crate::pgc::SceneEncoderConfig;

/// Configuration of an SGLoc network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SgLocConfig {
    /// Name of the scene.
    pub scene_name: String,
    /// Centre of the training positions, metres in the world.
    pub origin_m: [f64; 3],
    /// The encoder.
    pub encoder: SceneEncoderConfig,
}
