//! How networks are computed in inference.

use tch::Device;

use crate::int8::InferencePrecision;

/// Device and number format of networks in inference.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Inference {
    /// Device that networks compute on.
    pub device: Device,
    /// Number format in which they are computed.
    pub precision: InferencePrecision,
}

impl Default for Inference {
    /// On the CPU, in integers where the weights allow it.
    fn default() -> Self {
        Self { device: Device::Cpu, precision: InferencePrecision::default() }
    }
}

impl Inference {
    /// On the CPU in floating point.
    pub const FLOAT: Self = Self { device: Device::Cpu, precision: InferencePrecision::Float };
}
