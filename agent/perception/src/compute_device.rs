//! Compute device: the CPU or a CUDA device that networks run on.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use tch::{Cuda, Device, utils};

/// Device that networks compute on.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema, clap::ValueEnum,
)]
#[serde(rename_all = "snake_case")]
pub enum ComputeDevice {
    /// The CPU.
    #[default]
    Cpu,
    /// The first CUDA device.
    Cuda,
}

/// Reason why there is no CUDA device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum NoCuda {
    /// The tensor library has no CUDA kernels.
    #[error("this libtorch is built without CUDA")]
    Library,
    /// The tensor library has CUDA kernels and no device for them.
    #[error("libtorch finds no CUDA device")]
    Device,
}

impl ComputeDevice {
    /// The device of the tensor library; without this check the tensor library panics if there is none.
    ///
    /// # Errors
    /// [`NoCuda`] says what is missing.
    pub fn open(self) -> Result<Device, NoCuda> {
        match self {
            Self::Cpu => Ok(Device::Cpu),
            Self::Cuda => cuda(utils::has_cudart(), Cuda::is_available()),
        }
    }
}

fn cuda(has_kernels: bool, has_device: bool) -> Result<Device, NoCuda> {
    match (has_kernels, has_device) {
        (_, true) => Ok(Device::Cuda(0)),
        (false, false) => Err(NoCuda::Library),
        (true, false) => Err(NoCuda::Device),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_missing_is_named() {
        assert_eq!(ComputeDevice::default().open(), Ok(Device::Cpu));
        assert_eq!(cuda(true, true), Ok(Device::Cuda(0)));
        assert_eq!(
            cuda(false, false).unwrap_err().to_string(),
            "this libtorch is built without CUDA"
        );
        assert_eq!(
            cuda(true, false).unwrap_err().to_string(),
            "libtorch finds no CUDA device"
        );
    }
}
