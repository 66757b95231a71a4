//! What a scene head is built from.

use serde::{Deserialize, Serialize};

/// The head of one town.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneHeadConfig {
    /// Name of the town, for model cards and messages.
    pub town: String,
    /// SHA-256 of the encoder file whose features it was trained on.
    pub encoder_sha256: String,
    /// Channels of a cell.
    pub cell_channels: i64,
    /// Channels of a sweep.
    pub sweep_channels: i64,
    /// Clusters of sensor positions that sweeps are classified into.
    pub classes: i64,
    /// Clusters of world coordinates that a cell is placed among.
    pub centres: i64,
    /// Channels inside.
    pub width: i64,
    /// Residual blocks of three layers.
    pub blocks: usize,
    /// Middle of the training positions, metres in the world: coordinates are relative to it.
    pub origin_m: [f64; 3],
    /// Cells of a sweep that are regressed at most.
    pub max_cells: usize,
}

impl SceneHeadConfig {
    /// Checks that a network can be built.
    ///
    /// # Errors
    /// Says which field is wrong and what stood there.
    pub fn validate(&self) -> Result<(), String> {
        let sizes = [
            ("cell_channels", self.cell_channels),
            ("sweep_channels", self.sweep_channels),
            ("classes", self.classes),
            ("centres", self.centres),
            ("width", self.width),
            ("blocks", self.blocks as i64),
            ("max_cells", self.max_cells as i64),
        ];
        match sizes.into_iter().find(|(_, size)| !(1..=16_384).contains(size)) {
            Some((name, size)) => Err(format!("{name} is {size}, must be 1 to 16384")),
            None if self.origin_m.iter().any(|axis| !axis.is_finite()) => {
                Err(format!("origin_m is {:?}, must be finite", self.origin_m))
            }
            None => Ok(()),
        }
    }
}
