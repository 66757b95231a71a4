//! Sparse 3-D convolution in 8-bit integers.

use tch::{Kind, Result, TchError, Tensor};

use super::rulebook::{GatherIndex, KERNEL_VOLUME};
use crate::int8::{Int8Linear, LayerFormat};

/// Bytes of the values by which rows are gathered.
const WORD_BYTES: i64 = 4;

/// A 3x3x3 convolution over sites of `u8` features that are never negative.
#[derive(Debug)]
pub struct Int8SparseConv(Int8Linear);

impl Int8SparseConv {
    /// Quantises a weight `[27 * C_in, C_out]` with bias `[C_out]`.
    pub(super) fn new(weight: &Tensor, bias: &Tensor, format: LayerFormat) -> Result<Self> {
        let inputs = weight.size2()?.0 / KERNEL_VOLUME as i64;
        if inputs % WORD_BYTES != 0 {
            return Err(TchError::Shape(format!(
                "{inputs} input channels, must be a multiple of {WORD_BYTES}"
            )));
        }
        Ok(Self(Int8Linear::new(weight, Some(bias), format)?))
    }

    /// `[N_in, C_in]`, `u8`, to `[N_out, C_out]`.
    ///
    /// # Errors
    /// Those of the tensor library, for example when the rows are not those of the rulebook.
    pub fn forward(&self, x: &Tensor, index: &GatherIndex) -> Result<Tensor> {
        let channels = x.size2()?.1;
        // The library gathers rows of floats many times faster than rows of bytes; nothing is computed with them here.
        // The zeros of missing neighbours are the quantised zero, as features are never negative.
        let words = index.gather(&x.f_view_dtype(Kind::Float)?)?;
        let columns = words.f_view_dtype(Kind::Uint8)?;
        let columns = columns.f_view([-1, KERNEL_VOLUME as i64 * channels])?;
        self.0.forward(&columns)
    }
}
