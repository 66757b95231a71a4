//! Configuration of a trained network: its scene and the scale of its positions.

use protocol::config::FieldError;
use serde::{Deserialize, Serialize};

use crate::baselines::regressed_pose::require_scale;

/// Configuration of a network of one scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HypLiLocConfig {
    /// Name of the scene.
    pub scene_name: String,
    /// Mean of the training positions, metres in the world.
    pub origin_m: [f64; 3],
    /// Standard deviation of the training positions, metres.
    pub scale_m: [f64; 3],
}

impl HypLiLocConfig {
    /// Checks the numbers.
    ///
    /// # Errors
    /// [`FieldError`] of the first field that is wrong.
    pub fn validate(&self) -> Result<(), FieldError> {
        require_scale(self.origin_m, self.scale_m)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_that_are_no_positions_are_named() {
        let config = HypLiLocConfig {
            scene_name: "town".into(),
            origin_m: [0.0; 3],
            scale_m: [1.0; 3],
        };
        assert!(config.validate().is_ok());
        let message = |config: HypLiLocConfig| config.validate().unwrap_err().to_string();
        let lost = HypLiLocConfig {
            origin_m: [0.0, f64::NAN, 0.0],
            ..config.clone()
        };
        assert!(message(lost).contains("origin_m is [0.0, NaN, 0.0]"));
        let flat = HypLiLocConfig {
            scale_m: [1.0, 0.0, 1.0],
            ..config
        };
        assert!(message(flat).contains("scale_m is [1.0, 0.0, 1.0]"));
    }
}
