//! Number formats of feature values: `f32`, `f16` and scaled `i8`.

use bytemuck::{cast_slice, cast_slice_mut, pod_read_unaligned};
use half::f16;
use half::slice::HalfFloatSliceExt;
use serde::{Deserialize, Serialize};

use crate::Result;
use crate::checks::check_each;

/// Values converted at a time, through a buffer on the stack.
const BLOCK: usize = 1024;
/// Steps of the signed byte scale on either side of zero.
const I8_STEPS: f32 = 127.0;
/// Adding 1.5 * 2^23 to a small number rounds it to an integer (ties to even), which is then in the low bits. Kept
/// because `f32::round` is a library call on the x86-64 baseline, six times slower for a whole feature map.
const ROUND: f32 = 12_582_912.0;

/// Number format of feature values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[cfg_attr(feature = "config", derive(clap::ValueEnum, schemars::JsonSchema))]
pub enum Dtype {
    /// Single precision: 4 bytes, exact.
    #[default]
    F32,
    /// Half precision: 2 bytes, relative error at most 2^-11 down to 6e-5, absolute below; at most 65504.
    F16,
    /// A signed byte times its channel's scale (largest absolute value / 127): error at most half a scale.
    I8,
}

impl Dtype {
    /// Bytes of a value.
    pub fn size(self) -> u64 {
        match self {
            Self::F32 => 4,
            Self::F16 => 2,
            Self::I8 => 1,
        }
    }

    /// Bytes of the scales of so many channels.
    pub(super) fn scale_bytes(self, channels: u32) -> u64 {
        match self {
            Self::F32 | Self::F16 => 0,
            Self::I8 => 4 * u64::from(channels),
        }
    }
}

/// The scale of each channel of `[C, K]` values; zero where every value is zero or close to it.
pub(super) fn scales(values: &[f32], channels: usize) -> Vec<f32> {
    if values.is_empty() {
        return vec![0.0; channels];
    }
    let channels = values.chunks_exact(values.len() / channels);
    let scales = channels.map(|channel| {
        // Without the sign, bit patterns have the order of the numbers, and integers have a vectorised maximum.
        let largest = channel.iter().fold(0i32, |largest, value| {
            largest.max(value.abs().to_bits() as i32)
        });
        let largest = f32::from_bits(largest.cast_unsigned());
        let scale = largest / I8_STEPS;
        // The inverse of a subnormal scale would be infinite.
        if scale.is_normal() { scale } else { 0.0 }
    });
    scales.collect()
}

/// Appends `[C, K]` finite values; `scales` are those of their channels if the dtype has any.
///
/// # Errors
/// [`crate::WireError::Value`] when a value is beyond the range of half precision.
#[expect(
    clippy::cast_possible_truncation,
    reason = "the low byte of a sum with ROUND is the rounded value"
)]
pub(super) fn append(
    dtype: Dtype,
    values: &[f32],
    scales: &[f32],
    bytes: &mut Vec<u8>,
) -> Result<()> {
    match dtype {
        Dtype::F32 => bytes.extend_from_slice(cast_slice(values)),
        Dtype::F16 => append_f16(values, bytes)?,
        Dtype::I8 if values.is_empty() => {}
        Dtype::I8 => {
            for (channel, scale) in values.chunks_exact(values.len() / scales.len()).zip(scales) {
                let inverse = if *scale == 0.0 { 0.0 } else { scale.recip() };
                let rounded = channel.iter().map(|value| value * inverse + ROUND);
                bytes.extend(rounded.map(|sum| sum.to_bits() as u8));
            }
        }
    }
    Ok(())
}

#[expect(clippy::indexing_slicing, reason = "a chunk has at most BLOCK values")]
fn append_f16(values: &[f32], bytes: &mut Vec<u8>) -> Result<()> {
    let max = f32::from(f16::MAX);
    let mut block = [f16::ZERO; BLOCK];
    for chunk in values.chunks(BLOCK) {
        let block = &mut block[..chunk.len()];
        block.convert_from_f32_slice(chunk);
        // Searched only if there is one: the search does not vectorise.
        let finite = block
            .iter()
            .fold(true, |finite, half| finite & half.is_finite());
        if !finite {
            check_each("feature", values, [-max, max], |value| {
                f16::from_f32(value).is_finite()
            })?;
        }
        bytes.extend_from_slice(cast_slice(block.reinterpret_cast()));
    }
    Ok(())
}

/// Reads `[C, K]` values, `selected` = K. Values are not checked to be finite here, scales are.
///
/// # Errors
/// [`crate::WireError::Value`] when a scale is not a finite number of at least zero.
#[expect(
    clippy::indexing_slicing,
    reason = "a chunk has at most 2 * BLOCK bytes"
)]
pub(super) fn read(dtype: Dtype, scales: &[u8], bytes: &[u8], selected: usize) -> Result<Vec<f32>> {
    let mut values =
        Vec::with_capacity(usize::try_from(bytes.len() as u64 / dtype.size()).unwrap_or_default());
    match dtype {
        Dtype::F32 => values.extend(bytes.chunks_exact(4).map(pod_read_unaligned::<f32>)),
        Dtype::F16 => {
            let (mut halves, mut floats) = ([f16::ZERO; BLOCK], [0f32; BLOCK]);
            for chunk in bytes.chunks(2 * BLOCK) {
                // Through the stack, because the bytes may be unaligned.
                cast_slice_mut(halves.reinterpret_cast_mut())[..chunk.len()].copy_from_slice(chunk);
                let floats = &mut floats[..chunk.len() / 2];
                halves[..floats.len()].convert_to_f32_slice(floats);
                values.extend_from_slice(floats);
            }
        }
        Dtype::I8 => {
            let mut factors = vec![0f32; scales.len() / 4];
            cast_slice_mut(&mut factors).copy_from_slice(scales);
            check_each("channel scale", &factors, [0.0, f32::MAX], |scale| {
                scale.is_finite() && scale >= 0.0
            })?;
            if selected > 0 {
                for (channel, scale) in bytes.chunks_exact(selected).zip(factors) {
                    values.extend(channel.iter().map(|byte| f32::from(*byte as i8) * scale));
                }
            }
        }
    }
    Ok(values)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::WireError;

    fn round_trip(dtype: Dtype, values: &[f32], channels: usize) -> Result<Vec<f32>, WireError> {
        let scales = if dtype == Dtype::I8 {
            scales(values, channels)
        } else {
            Vec::new()
        };
        let mut bytes = Vec::new();
        append(dtype, values, &scales, &mut bytes)?;
        assert_eq!(bytes.len() as u64, values.len() as u64 * dtype.size());
        read(dtype, cast_slice(&scales), &bytes, values.len() / channels)
    }

    proptest! {
        #[test]
        fn f32_is_exact(values in prop::collection::vec(-1e6f32..1e6, 0..3000)) {
            prop_assert_eq!(round_trip(Dtype::F32, &values, 1).unwrap(), values);
        }

        #[test]
        fn f16_keeps_eleven_bits(values in prop::collection::vec(prop_oneof![-65504f32..65504.0, -1f32..1.0, -1e-5f32..1e-5], 0..3000)) {
            for (value, back) in values.iter().zip(round_trip(Dtype::F16, &values, 1).unwrap()) {
                // Half a unit in the last place; below the smallest normal number the spacing stays at 2^-24.
                let bound = (value.abs() * 2f32.powi(-11)).max(2f32.powi(-25));
                prop_assert!((value - back).abs() <= bound, "{value} came back as {back}");
            }
        }

        #[test]
        fn i8_is_off_by_half_a_scale(values in prop::collection::vec(-1e6f32..1e6, 4..3000), shrink in 0f32..1.0) {
            let mut values = values[..values.len() / 4 * 4].to_vec();
            let in_channel = values.len() / 4;
            values[..in_channel].iter_mut().for_each(|value| *value *= shrink * 1e-3);
            let back = round_trip(Dtype::I8, &values, 4).unwrap();
            for (channel, (values, back)) in values.chunks(in_channel).zip(back.chunks(in_channel)).enumerate() {
                let largest = values.iter().fold(0f32, |largest, value| largest.max(value.abs()));
                // One millionth more for the rounding of scale and inverse.
                let bound = largest / 127.0 * 0.5 + largest * 1e-6;
                for (value, back) in values.iter().zip(back) {
                    prop_assert!((value - back).abs() <= bound, "channel {channel}: {value} came back as {back}");
                }
            }
        }
    }

    #[test]
    fn i8_keeps_zero_and_the_largest() {
        let back = round_trip(
            Dtype::I8,
            &[0.0, -12.7, 12.7, 6.35, 0.0, 0.0, 0.0, 1e-44],
            2,
        )
        .unwrap();
        assert_eq!(back[0], 0.0);
        assert!((back[1] + 12.7).abs() < 1e-5 && (back[2] - 12.7).abs() < 1e-5);
        assert_eq!(back[4..], [0.0; 4]);
    }

    #[test]
    fn f16_refuses_what_it_cannot_hold() {
        let mut values = vec![1.0; 2000];
        values[1500] = -65520.0;
        let error = round_trip(Dtype::F16, &values, 1).unwrap_err();
        assert!(
            matches!(error, WireError::Value { index: 1500, .. }),
            "{error}"
        );
    }

    #[test]
    fn scales_that_are_no_scales_are_refused() {
        for scale in [f32::NAN, f32::INFINITY, -1.0] {
            let error = read(Dtype::I8, &scale.to_le_bytes(), &[1, 2], 2).unwrap_err();
            assert!(
                matches!(
                    error,
                    WireError::Value {
                        what: "channel scale",
                        ..
                    }
                ),
                "{error}"
            );
        }
    }
}
