//! Interface of a fusion: aligned feature maps in, one feature map out.

use std::fmt::Debug;

use perception::int8::{ActivationScales, QuantiseError, ScaleSearch};
use tch::{TchError, Tensor};

use super::maps::AlignedMaps;

/// A way to fuse aligned feature maps.
pub trait Fusion: Debug + Send {
    /// Fuses the maps of one sample.
    ///
    /// # Errors
    /// [`TchError`] when the shapes of features and mask do not fit.
    fn fuse(&self, maps: &AlignedMaps) -> Result<FusionOutput, TchError>;

    /// Adds the activations of one sample that [`Self::quantise`] needs scales of.
    fn observe(&self, _maps: &AlignedMaps, _search: &mut ScaleSearch) -> Result<(), TchError> {
        Ok(())
    }

    /// Computes in 8-bit integers from here on, where it can.
    ///
    /// # Errors
    /// [`QuantiseError`] names the activation whose scale is missing.
    fn quantise(&mut self, _scales: &ActivationScales) -> Result<(), QuantiseError> {
        Ok(())
    }
}

/// Result of a fusion.
#[derive(Debug)]
pub struct FusionOutput {
    /// `[C, H, W]` in the frame of the ego.
    pub map: Tensor,
    /// `[N - 1, 3]`: shift of each entry but the first beyond its pose, those of [`AlignedMaps::earlier`] last: along x
    /// and y of the ego, metres, and about the entry's sender, radians. Absent for methods that use poses as received,
    /// and where there is one entry.
    pub corrections: Option<Tensor>,
}

impl From<Tensor> for FusionOutput {
    fn from(map: Tensor) -> Self {
        Self {
            map,
            corrections: None,
        }
    }
}
