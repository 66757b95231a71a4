//! Sizes of TraF-Align.

use perception::model_config::ConfigError;
use protocol::config::{require, within};
use serde::{Deserialize, Serialize};

/// Sizes of [`TrafAlign`](super::TrafAlign).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct TrafAlignConfig {
    /// Channels of the maps.
    pub channels: i64,
    /// Cells along each edge of a token.
    pub patch: i64,
    /// Channels of a token.
    pub dim: i64,
    /// Heads of the attention.
    pub heads: i64,
    /// Edge of the square of points that a token attends to; each point is moved by an offset.
    pub kernel: i64,
    /// Layers of attention, all along the same points.
    pub layers: usize,
    /// Channels of the trajectory field.
    pub field: i64,
    /// Time steps wanted of every agent.
    pub frames: usize,
    /// Time from one step to the next, seconds.
    pub frame_secs: f64,
}

impl TrafAlignConfig {
    /// Sized for one core and live traffic.
    pub(crate) fn lean(channels: i64) -> Self {
        Self {
            channels,
            patch: 2,
            dim: 32,
            heads: 2,
            kernel: 3,
            layers: 1,
            field: 3,
            frames: 3,
            frame_secs: 0.1,
        }
    }

    /// About the published sizes.
    pub(crate) fn full(channels: i64) -> Self {
        Self {
            patch: 1,
            dim: channels,
            heads: 4,
            layers: 2,
            frames: 4,
            ..Self::lean(channels)
        }
    }

    /// Checks that a network can be built.
    ///
    /// # Errors
    /// [`ConfigError`] names the field.
    pub(crate) fn validate(&self) -> Result<(), ConfigError> {
        within("fusion channels", self.channels, 1, 4096)?;
        within("fusion patch", self.patch, 1, 8)?;
        within("fusion dim", self.dim, 2, 4096)?;
        within("fusion heads", self.heads, 1, 64)?;
        let is_divisor = self.dim % self.heads == 0;
        require(is_divisor, "fusion heads", self.heads, "must divide dim")?;
        within("fusion kernel", self.kernel, 1, 9)?;
        within("fusion layers", self.layers as i64, 1, 16)?;
        within("fusion field", self.field, 1, 64)?;
        within("fusion frames", self.frames as i64, 1, 16)?;
        Ok(within("fusion frame_secs", self.frame_secs, 1e-3, 60.0)?)
    }
}
