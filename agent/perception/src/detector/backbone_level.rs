//! Level of a detector's backbone: a feature map before it is up-sampled and reduced.

use tch::{Kind, TchError, Tensor};

use crate::int8::Quantisation;

/// Distance of the cells that tell if a level is saturated; as a prime number it is no divisor of a usual width.
const JUDGED_EVERY: i64 = 7;

/// One level for one sweep.
#[derive(Debug)]
pub struct BackboneLevel {
    /// `[1, C, H, W]`, single precision or quantised.
    pub(super) values: Tensor,
    quantisation: Option<Quantisation>,
}

impl BackboneLevel {
    /// A level of quantised values; without a quantisation in single precision.
    pub(super) fn new(values: Tensor, quantisation: Option<Quantisation>) -> Self {
        Self {
            values,
            quantisation,
        }
    }

    /// Channels, height and width.
    pub fn shape(&self) -> [i64; 3] {
        let size = self.values.size();
        [size[1], size[2], size[3]]
    }

    /// True if it was computed in 8-bit integers.
    pub fn is_quantised(&self) -> bool {
        self.quantisation.is_some()
    }

    /// True if most of its values above zero are the largest that 8 bits hold: a scale of its network is far too small.
    /// Some of the cells tell as much as all of them.
    pub(super) fn is_saturated(&self) -> Result<bool, TchError> {
        if !self.is_quantised() {
            return Ok(false);
        }
        let values = self.by_cell()?.f_slice(0, None, None, JUDGED_EVERY)?;
        let largest = values.f_eq(i64::from(u8::MAX))?;
        let largest = largest.f_count_nonzero(None::<i64>)?.f_int64_value(&[])?;
        let above_zero = values.f_count_nonzero(None::<i64>)?.f_int64_value(&[])?;
        Ok(2 * largest > above_zero)
    }

    /// `[N, C]` `f32`: the features of some cells `[N]`, numbered row by row, `y * W + x`.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn of_cells(&self, cells: &Tensor) -> Result<Tensor, TchError> {
        self.in_single_precision(&self.by_cell()?.f_index_select(0, cells)?)
    }

    /// `[1, C, H, W]` `f32`: the whole map.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn map(&self) -> Result<Tensor, TchError> {
        self.in_single_precision(&self.values)
    }

    /// `[H * W, C]`: a view if channels are innermost in memory.
    fn by_cell(&self) -> Result<Tensor, TchError> {
        let channels = self.values.size()[1];
        let cells = self.values.f_permute([0, 2, 3, 1])?;
        cells.f_reshape([-1, channels])
    }

    fn in_single_precision(&self, values: &Tensor) -> Result<Tensor, TchError> {
        match self.quantisation {
            Some(quantisation) => quantisation.dequantise(values),
            None => values.f_to_kind(Kind::Float),
        }
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;
    use crate::int8::Scale;

    #[test]
    fn a_level_of_which_most_values_are_clamped_is_saturated() {
        let map = Tensor::arange(32, (Kind::Float, Device::Cpu)).view([1, 2, 4, 4]);
        // The largest level is 31.9, 15.9 (which clamps 16 of the 31 values above zero), 8.0, 0.06.
        for (exponent, is_saturated) in [(-3, false), (-4, true), (-5, true), (-12, true)] {
            let quantisation = Quantisation {
                scale: Scale::of_exponent(exponent),
                zero_point: 0,
            };
            let values = quantisation.quantise(&map).unwrap();
            let level = BackboneLevel::new(values, Some(quantisation));
            assert_eq!(level.is_saturated().unwrap(), is_saturated, "{exponent}");
        }
    }

    #[test]
    fn cells_have_the_features_of_their_place_in_both_formats() {
        let map = Tensor::arange(2 * 3 * 4, (Kind::Float, Device::Cpu)).view([1, 2, 3, 4]);
        let quantisation = Quantisation {
            scale: Scale::of_exponent(-1),
            zero_point: 4,
        };
        let values = quantisation.quantise(&map).unwrap();
        let quantised = BackboneLevel::new(values, Some(quantisation));
        let cells = Tensor::from_slice(&[5_i64, 0]);
        for level in [BackboneLevel::new(map.shallow_clone(), None), quantised] {
            let expected = Tensor::from_slice2(&[[5.0_f32, 17.0], [0.0, 12.0]]);
            assert_eq!(level.of_cells(&cells).unwrap(), expected);
            assert_eq!(
                (level.map().unwrap(), level.shape()),
                (map.shallow_clone(), [2, 3, 4])
            );
        }
    }
}
