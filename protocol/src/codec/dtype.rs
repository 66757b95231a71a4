//! How exactly a feature value is written.

use bytemuck::{cast_slice, cast_slice_mut};
use half::f16;
use half::slice::HalfFloatSliceExt;
use serde::{Deserialize, Serialize};

use crate::WireError;

/// Values converted at a time, through a buffer on the stack.
const BLOCK: usize = 1024;
/// Steps of the signed byte scale on either side of zero.
const I8_STEPS: f32 = 127.0;
/// Adding 1.5 * 2^23 to a small number rounds it to an integer (ties to even), which then stands in the low bits. Kept
/// because `f32::round` is a library call on the x86-64 baseline, six times slower for a whole map.
const ROUND: f32 = 12_582_912.0;

/// How a value is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Dtype {
    /// As it is: 4 bytes, exact.
    #[default]
    F32,
    /// Half precision: 2 bytes, relative error at most 2^-11 down to 6e-5, absolute below; at most 65504.
    F16,
    /// A signed byte times its channel's scale (largest absolute value / 127): error at most half a scale.
    I8,
}

impl Dtype {
    /// Bytes of a value.
    #[must_use]
    pub fn size(self) -> u64 {
        match self {
            Self::F32 => 4,
            Self::F16 => 2,
            Self::I8 => 1,
        }
    }
}

/// The scale of each channel of `[C, K]` values; zero where every value is (next to) zero.
pub(super) fn scales(values: &[f32], channels: usize) -> Vec<f32> {
    if values.is_empty() {
        return vec![0.0; channels];
    }
    let scale = |channel: &[f32]| {
        let largest = channel.iter().fold(0f32, |largest, value| largest.max(value.abs()));
        let scale = largest / I8_STEPS;
        // The inverse of a subnormal scale would be infinite.
        if scale.is_normal() { scale } else { 0.0 }
    };
    values.chunks_exact(values.len() / channels).map(scale).collect()
}

/// Appends `[C, K]` finite values; `scales` are those of their channels where the dtype has any.
///
/// # Errors
/// [`WireError::Value`] when a value is beyond the range of half precision.
pub(super) fn append(dtype: Dtype, values: &[f32], scales: &[f32], bytes: &mut Vec<u8>) -> Result<(), WireError> {
    match dtype {
        Dtype::F32 => bytes.extend_from_slice(cast_slice(values)),
        Dtype::F16 => append_f16(values, bytes)?,
        Dtype::I8 if values.is_empty() => {}
        Dtype::I8 => {
            for (channel, scale) in values.chunks_exact(values.len() / scales.len()).zip(scales) {
                let inverse = if *scale == 0.0 { 0.0 } else { scale.recip() };
                bytes.extend(channel.iter().map(|value| (value * inverse + ROUND).to_bits() as u8));
            }
        }
    }
    Ok(())
}

fn append_f16(values: &[f32], bytes: &mut Vec<u8>) -> Result<(), WireError> {
    let max = f32::from(f16::MAX);
    let mut block = [f16::ZERO; BLOCK];
    for (number, chunk) in values.chunks(BLOCK).enumerate() {
        let block = &mut block[..chunk.len()];
        block.convert_from_f32_slice(chunk);
        if let Some(at) = block.iter().position(|half| !half.is_finite()) {
            let (index, value) = (number * BLOCK + at, f64::from(chunk[at]));
            return Err(WireError::Value { what: "feature", index, value, min: (-max).into(), max: max.into() });
        }
        bytes.extend_from_slice(cast_slice(block));
    }
    Ok(())
}

/// Reads `[C, K]` values, `selected` = K; they are finite only if their bytes say so, except that scales are checked.
///
/// # Errors
/// [`WireError::Value`] when a scale is not a finite number of at least zero.
pub(super) fn read(dtype: Dtype, scales: &[u8], bytes: &[u8], selected: usize) -> Result<Vec<f32>, WireError> {
    let count = bytes.len() / dtype.size() as usize;
    let mut values = Vec::with_capacity(count);
    match dtype {
        Dtype::F32 => values.extend(bytes.chunks_exact(4).map(bytemuck::pod_read_unaligned::<f32>)),
        Dtype::F16 => {
            let (mut halves, mut floats) = ([f16::ZERO; BLOCK], [0f32; BLOCK]);
            for chunk in bytes.chunks(2 * BLOCK) {
                // Through the stack, because the bytes lie at any address.
                cast_slice_mut(&mut halves)[..chunk.len()].copy_from_slice(chunk);
                let floats = &mut floats[..chunk.len() / 2];
                halves[..floats.len()].convert_to_f32_slice(floats);
                values.extend_from_slice(floats);
            }
        }
        Dtype::I8 => {
            let scales = read_scales(scales)?;
            if selected > 0 {
                for (channel, scale) in bytes.chunks_exact(selected).zip(scales) {
                    values.extend(channel.iter().map(|byte| f32::from(*byte as i8) * scale));
                }
            }
        }
    }
    Ok(values)
}

fn read_scales(bytes: &[u8]) -> Result<Vec<f32>, WireError> {
    let mut scales = vec![0f32; bytes.len() / 4];
    cast_slice_mut(&mut scales).copy_from_slice(bytes);
    match scales.iter().position(|scale| !(scale.is_finite() && *scale >= 0.0)) {
        None => Ok(scales),
        Some(index) => {
            let value = scales[index].into();
            Err(WireError::Value { what: "channel scale", index, value, min: 0.0, max: f32::MAX.into() })
        }
    }
}
