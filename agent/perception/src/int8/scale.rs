//! Scale of quantised values: a power of two.

use serde::{Deserialize, Serialize};
use tch::{Kind, TchError, Tensor};

/// Largest quantised activation.
pub(super) const MAX_ACTIVATION: f32 = 255.0;

/// 1.5 times 2 to the power of 23: `f32` of this magnitude are whole numbers.
const WHOLE: f32 = 12_582_912.0;

/// Value of one quantisation step: 2 to the power of the exponent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Scale {
    /// Exponent of two.
    pub exponent: i8,
}

impl Scale {
    /// The scale `2^exponent`.
    pub const fn of_exponent(exponent: i8) -> Self {
        Self { exponent }
    }

    /// The smallest scale with which `levels` steps reach `magnitude`, that is positive and finite.
    pub(super) fn reaching(magnitude: f64, levels: f64) -> Self {
        let exponent = (magnitude / levels).log2().ceil();
        Self::of_exponent(exponent.clamp(f64::from(i8::MIN), f64::from(i8::MAX)) as i8)
    }

    /// Value of one step.
    pub fn step(self) -> f64 {
        f64::from(self.exponent).exp2()
    }

    /// The next smaller scale.
    pub(super) fn finer(self) -> Self {
        Self::of_exponent(self.exponent.saturating_sub(1))
    }
}

/// Meaning of `u8` values: `step * (value - zero_point)`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Quantisation {
    /// Step.
    pub scale: Scale,
    /// The `u8` value of zero; 0 for values that are never negative.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub zero_point: u8,
}

fn is_zero(value: &u8) -> bool {
    *value == 0
}

impl Quantisation {
    /// Nearest quantised values, `u8`, in the memory order of `x`; values out of range become the nearest in range.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn quantise(&self, x: &Tensor) -> Result<Tensor, TchError> {
        // The reciprocal of a power of two is exact.
        let mut steps = x.f_mul_scalar(self.scale.step().recip())?.f_round_()?;
        if self.zero_point != 0 {
            steps = steps.f_add_scalar_(i64::from(self.zero_point))?;
        }
        let steps = steps.f_clamp_(0, i64::from(u8::MAX))?;
        steps.f_to_kind(Kind::Uint8)
    }

    /// Quantises plain values as [`Self::quantise`] does, one into each place of `steps`.
    pub fn quantise_values(&self, values: &[f32], steps: &mut [u8]) {
        let (factor, zero) = (self.scale.step().recip() as f32, f32::from(self.zero_point));
        for (step, value) in steps.iter_mut().zip(values) {
            // A sum with this number is rounded to a whole one, half to even; rounding by the processor needs SSE 4.1.
            // The clamp keeps the sum in the range in which `f32` are whole numbers.
            let rounded = (value * factor).clamp(-256.0, 256.0) + WHOLE - WHOLE;
            let place = (rounded + zero).clamp(0.0, MAX_ACTIVATION) + WHOLE;
            // The whole number is in the lowest bits of the sum.
            *step = place.to_bits() as u8;
        }
    }

    /// Values of quantised ones, `f32`.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn dequantise(&self, steps: &Tensor) -> Result<Tensor, TchError> {
        let mut centred = steps
            .f_to_kind(Kind::Float)?
            .f_sub_scalar_(i64::from(self.zero_point))?;
        centred.f_mul_scalar_(self.scale.step())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_rounded_to_the_nearest_step_and_clamped() {
        let quantisation = Quantisation {
            scale: Scale::of_exponent(-2),
            zero_point: 10,
        };
        let values = [-9.0_f32, -2.5, 0.0, 0.125, 0.126, 1.0, 61.25, 99.0];
        let expected = [0_u8, 0, 10, 10, 11, 14, 255, 255];
        let found = quantisation.quantise(&Tensor::from_slice(&values)).unwrap();
        assert_eq!(Vec::<u8>::try_from(&found).unwrap(), expected);
        let mut steps = [7; 8];
        quantisation.quantise_values(&values, &mut steps);
        assert_eq!(steps, expected);
        let back = Vec::<f32>::try_from(quantisation.dequantise(&found).unwrap()).unwrap();
        assert_eq!(back, [-2.5, -2.5, 0.0, 0.0, 0.25, 1.0, 61.25, 61.25]);
    }

    #[test]
    fn plain_values_are_quantised_as_tensors_are() {
        for (exponent, zero_point) in [(-6, 0), (-3, 101), (2, 255)] {
            let quantisation = Quantisation {
                scale: Scale::of_exponent(exponent),
                zero_point,
            };
            let step = quantisation.scale.step() as f32;
            let near_halves = (-1200..1200).flat_map(|half| {
                let value = half as f32 * 0.5 * step;
                [value.next_down(), value, value.next_up()]
            });
            let extremes = [
                f32::MIN,
                f32::MAX,
                f32::INFINITY,
                f32::NEG_INFINITY,
                0.0,
                -0.0,
            ];
            let values: Vec<f32> = near_halves.chain(extremes).collect();
            let expected = quantisation.quantise(&Tensor::from_slice(&values)).unwrap();
            let mut steps = vec![0; values.len()];
            quantisation.quantise_values(&values, &mut steps);
            assert_eq!(
                steps,
                Vec::<u8>::try_from(&expected).unwrap(),
                "{quantisation:?}"
            );
        }
    }

    #[test]
    fn the_smallest_scale_that_reaches_a_magnitude() {
        for (magnitude, exponent) in [(63.0, 0), (63.1, 1), (31.5, -1), (0.5, -6)] {
            assert_eq!(
                Scale::reaching(magnitude, 63.0),
                Scale::of_exponent(exponent),
                "{magnitude}"
            );
        }
    }
}
