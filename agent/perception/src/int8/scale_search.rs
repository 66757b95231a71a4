//! Search for the scales of activations.

use std::collections::BTreeMap;

use tch::{Kind, TchError, Tensor};

use super::activation_scales::ActivationScales;
use super::scale::{MAX_ACTIVATION, Quantisation, Scale};

/// Exponents that are tried.
const EXPONENTS: std::ops::RangeInclusive<i8> = -14..=4;

/// Squared error of every scale for each activation that was observed.
#[derive(Debug, Default)]
pub struct ScaleSearch {
    activations: BTreeMap<String, Observed>,
}

/// Errors of the scales for one activation, summed over what was observed.
#[derive(Debug, Default)]
struct Observed {
    /// Of values that are never negative, by exponent.
    unsigned: BTreeMap<i8, f64>,
    /// Of values around zero, with a zero point in the middle.
    centred: BTreeMap<i8, f64>,
    is_negative: bool,
}

/// Zero point of activations that may be negative.
const MIDDLE: u8 = 128;

impl ScaleSearch {
    /// Adds values of an activation.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn observe(&mut self, name: &str, values: &Tensor) -> Result<(), TchError> {
        let observed = self.activations.entry(name.to_owned()).or_default();
        observed.is_negative |= values.f_min()?.f_double_value(&[])? < 0.0;
        let largest = values.f_abs()?.f_max()?.f_double_value(&[])?;
        let power = power(values)?;
        let count = values.numel() as f64;
        for exponent in EXPONENTS {
            let scale = Scale::of_exponent(exponent);
            // Infinite where all values are 0: any scale has the error 0 then.
            let reach = scale.step() * f64::from(MAX_ACTIVATION) / largest;
            // Both are summed up: the first negative value may come with a later sweep.
            let sums = [(0, &mut observed.unsigned), (MIDDLE, &mut observed.centred)];
            for (zero_point, errors) in sums {
                *errors.entry(exponent).or_default() += match reach {
                    ..0.03 => power,
                    // Measured where the best scale can be. Finer steps clamp nearly all; coarser ones err evenly.
                    0.03..4.0 => squared_error(values, Quantisation { scale, zero_point })?,
                    // Rounding to steps of width s errs evenly by up to s / 2: s^2 / 12 in the mean square.
                    _ => power.min(count * scale.step().powi(2) / 12.0),
                };
            }
        }
        Ok(())
    }

    /// Adds the activations of another search, which has other names.
    pub fn merge(&mut self, other: Self) {
        self.activations.extend(other.activations);
    }

    /// The scales with the smallest squared errors.
    pub fn scales(&self) -> ActivationScales {
        let chosen = self.activations.iter().map(|(name, observed)| {
            let (errors, zero_point) = match observed.is_negative {
                true => (&observed.centred, MIDDLE),
                false => (&observed.unsigned, 0),
            };
            let best = errors.iter().min_by(|(_, a), (_, b)| a.total_cmp(b));
            let scale = Scale::of_exponent(best.map_or(0, |(&exponent, _)| exponent));
            (name.clone(), Quantisation { scale, zero_point })
        });
        ActivationScales(chosen.collect())
    }
}

fn squared_error(values: &Tensor, quantisation: Quantisation) -> Result<f64, TchError> {
    let back = quantisation.dequantise(&quantisation.quantise(values)?)?;
    power(&back.f_sub(values)?)
}

/// Sum of the squares of values.
fn power(values: &Tensor) -> Result<f64, TchError> {
    let squares = values.f_square()?;
    squares.f_sum(Kind::Double)?.f_double_value(&[])
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;

    #[test]
    fn scales_follow_the_values_and_rare_large_ones_are_clamped() {
        tch::manual_seed(1);
        let mut search = ScaleSearch::default();
        let even = Tensor::rand([100_000], (Kind::Float, Device::Cpu));
        let outlier = even.copy();
        let _ = outlier.get(0).fill_(3.0);
        for (name, values) in [
            ("even", &even),
            ("outlier", &outlier),
            ("signed", &(&even - 0.5)),
        ] {
            search.observe(name, values).unwrap();
        }
        let scales = search.scales();
        for (name, exponent, zero_point) in
            [("even", -8, 0), ("outlier", -7, 0), ("signed", -8, MIDDLE)]
        {
            let scale = Scale::of_exponent(exponent);
            let expected = Quantisation { scale, zero_point };
            assert_eq!(scales.get(name).unwrap(), expected, "{name}");
        }
    }
}
