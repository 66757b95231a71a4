//! Padding: cells around a feature map, so that windows of any size cover it completely.

use tch::{TchError, Tensor};

use crate::warp::WarpedMaps;

/// Rows below and columns right of a map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Padding {
    height: i64,
    width: i64,
    below: i64,
    right: i64,
}

impl Padding {
    /// Padding of maps `[N, C, H, W]` to multiples of `edge`.
    pub(super) fn to_multiples(maps: &Tensor, edge: i64) -> Result<Self, TchError> {
        let (_, _, height, width) = maps.size4()?;
        let [below, right] = [height, width].map(|length| (edge - length % edge) % edge);
        Ok(Self {
            height,
            width,
            below,
            right,
        })
    }

    /// True if no padding is needed.
    pub(super) fn is_empty(self) -> bool {
        (self.below, self.right) == (0, 0)
    }

    /// Rows and columns including the padding.
    pub(super) fn size(self) -> [i64; 2] {
        [self.height + self.below, self.width + self.right]
    }

    /// `[N, C, H, W]` with zeros around, and `slots` maps of zeros more.
    pub(super) fn maps(self, maps: &Tensor, slots: i64) -> Result<Tensor, TchError> {
        if self.is_empty() && slots == 0 {
            return Ok(maps.shallow_clone());
        }
        // Before and after, from the last dimension to the first: columns, rows, channels, maps.
        maps.f_constant_pad_nd([0, self.right, 0, self.below, 0, 0, 0, slots])
    }

    /// Maps with rows below and columns to the right that reach nothing, so that both counts are multiples of `cells`.
    pub(super) fn to_multiples_of(cells: i64, maps: &WarpedMaps) -> Result<WarpedMaps, TchError> {
        maps.each(|tensor| Self::to_multiples(tensor, cells)?.maps(tensor, 0))
    }

    /// [`Self::maps`] for a mask `[N, 1, H, W]`: padded cells are invalid for neighbours and valid for the ego, as
    /// attention needs at least one valid token.
    pub(super) fn mask(self, mask: &Tensor, slots: i64) -> Result<Tensor, TchError> {
        if self.is_empty() && slots == 0 {
            return Ok(mask.shallow_clone());
        }
        let neighbours = mask.f_narrow(0, 1, mask.size4()?.0 - 1)?;
        let ego = mask
            .f_narrow(0, 0, 1)?
            .f_pad([0, self.right, 0, self.below], "constant", 1.0)?;
        Tensor::f_cat(&[ego, self.maps(&neighbours, slots)?], 0)
    }

    /// `[C, H, W]` of a padded map.
    pub(super) fn crop(self, map: &Tensor) -> Result<Tensor, TchError> {
        if self.is_empty() {
            return Ok(map.shallow_clone());
        }
        map.f_narrow(1, 0, self.height)?
            .f_narrow(2, 0, self.width)?
            .f_contiguous()
    }
}

#[cfg(test)]
mod tests {
    use tch::{Device, Kind};

    use super::*;

    #[test]
    fn padding_is_valid_for_the_ego_only_and_is_cropped() {
        let maps = Tensor::ones([2, 3, 5, 8], (Kind::Float, Device::Cpu));
        let padding = Padding::to_multiples(&maps, 4).unwrap();
        assert_eq!(padding.size(), [8, 8]);
        let padded = padding.maps(&maps, 1).unwrap();
        assert_eq!(padded.size(), [3, 3, 8, 8]);
        assert_eq!(padding.crop(&padded.get(1)).unwrap(), maps.get(1));
        let mask = padding.mask(&maps.narrow(1, 0, 1), 1).unwrap();
        let seen: Vec<f64> = (0..3)
            .map(|slot| mask.get(slot).sum(Kind::Float).double_value(&[]))
            .collect();
        assert_eq!(seen, [64.0, 40.0, 0.0]);
        assert!(Padding::to_multiples(&maps, 1).unwrap().is_empty());
    }
}
