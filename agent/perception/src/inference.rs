//! Inference: device and number format of networks.

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

impl Inference {
    /// On the CPU in floating point.
    pub const FLOAT: Self = Self {
        device: Device::Cpu,
        precision: InferencePrecision::Float,
    };

    /// On a device, in a number format; integers are for the CPU only.
    pub fn new(device: Device, precision: InferencePrecision) -> Self {
        let precision = match device {
            Device::Cpu => precision,
            _ => InferencePrecision::Float,
        };
        Self { device, precision }
    }
}

impl Default for Inference {
    /// On the CPU, in integers where the weights allow it.
    fn default() -> Self {
        Self::new(Device::Cpu, InferencePrecision::default())
    }
}
