//! Precision of convolutions without gradients.

use tch::{Device, Kind, TchError, Tensor, nn};

use crate::f64_tensor::are_numbers;

/// A size-preserving convolution in the precision of `maps`; its parameters are unchanged.
pub(super) fn convolve(convolution: &nn::Conv2D, maps: &Tensor) -> Result<Tensor, TchError> {
    let weight = convolution.ws.f_to_kind(maps.kind())?;
    let bias = convolution.bs.as_ref().map(|bias| bias.f_to_kind(maps.kind())).transpose()?;
    let around = convolution.ws.size4()?.3 / 2;
    maps.f_conv2d(&weight, bias.as_ref(), [1, 1], [around, around], [1, 1], 1)
}

/// The fastest sufficient precision for the device of `maps`; their own where a gradient flows.
pub(super) fn fastest_of(maps: &Tensor) -> Kind {
    if are_numbers(maps) { fastest(maps.device()) } else { maps.kind() }
}

/// The fastest sufficient precision of convolutions.
pub(super) fn fastest(device: Device) -> Kind {
    if device == Device::Cpu && multiplies_bfloat16() { Kind::BFloat16 } else { Kind::Float }
}

#[cfg(target_arch = "x86_64")]
fn multiplies_bfloat16() -> bool {
    std::arch::is_x86_feature_detected!("avx512bf16")
}

#[cfg(not(target_arch = "x86_64"))]
fn multiplies_bfloat16() -> bool {
    false
}
