//! Number format in which networks are computed.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Number format in which networks are computed.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema, clap::ValueEnum,
)]
#[serde(rename_all = "snake_case")]
pub enum InferencePrecision {
    /// Integers of 8 bits where the weights file has scales of activations, 32-bit floating point elsewhere.
    #[default]
    Int8,
    /// 32-bit floating point.
    Float,
}
