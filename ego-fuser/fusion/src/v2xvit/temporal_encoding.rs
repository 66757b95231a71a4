//! Temporal encoding of V2X-ViT: an additive encoding of an agent's delay.

use perception::tensor_values::tensor;
use tch::nn::{self, Init};
use tch::{TchError, Tensor};

use crate::f64_tensor::picked;
use crate::layers::Linear;

/// Rows of the table.
const ROWS: i64 = 100;
/// Time between two rows, seconds.
pub(crate) const ROW_SECS: f64 = 0.05;

/// Relative temporal encoding: a table over delays (`emb.emb`) and a linear layer behind it (`emb.lin`).
#[derive(Debug)]
pub struct TemporalEncoding {
    /// `[ROWS, C]`, sines and cosines at the start.
    table: Tensor,
    linear: Linear,
}

impl TemporalEncoding {
    /// For features of `channels`.
    pub fn new(path: &nn::Path<'_>, channels: i64) -> Self {
        let path = path / "emb";
        let mut table = (&path / "emb").var("weight", &[ROWS, channels], Init::Const(0.0));
        tch::no_grad(|| table.copy_(&waves(channels)));
        Self {
            table,
            linear: Linear::new(&(&path / "lin"), channels, channels, true),
        }
    }

    /// The code of each delay, given in rows of the table: `N` of them to `[N, C]`.
    ///
    /// Between rows it is interpolated, so that a true age need not be rounded to a step; delays beyond the table's
    /// ends are clamped.
    ///
    /// # Errors
    /// [`TchError`] of the tensor library.
    pub fn encode(&self, rows: &[f64]) -> Result<Tensor, TchError> {
        let last = (ROWS - 1) as f64;
        // `clamp` passes NaN on, which would spread over the whole code.
        let rows = rows.iter().map(|row| match row.is_nan() {
            true => 0.0,
            false => row.clamp(0.0, last),
        });
        let rows: Vec<f64> = rows.collect();
        let lower: Vec<i64> = rows.iter().map(|row| row.floor() as i64).collect();
        let upper: Vec<i64> = rows.iter().map(|row| row.ceil() as i64).collect();
        let share: Vec<f32> = rows.iter().map(|row| row.fract() as f32).collect();
        let (lower, upper) = (picked(&self.table, &lower)?, picked(&self.table, &upper)?);
        let share = tensor(&share, &[-1, 1], self.table.device())?;
        let codes = lower.f_lerp_tensor(&upper, &share.f_expand_as(&lower)?)?;
        self.linear.forward(&codes)
    }
}

/// Sines in even and cosines in odd channels, slower from pair to pair.
fn waves(channels: i64) -> Tensor {
    let values: Vec<f32> = (0..ROWS * channels)
        .map(|index| {
            let (row, channel) = ((index / channels) as f64, index % channels);
            let rate = 10_000f64.powf(-((channel - channel % 2) as f64) / channels as f64);
            let (sine, cosine) = (row * rate).sin_cos();
            let wave = if channel % 2 == 0 { sine } else { cosine };
            (wave / (channels as f64).sqrt()) as f32
        })
        .collect();
    Tensor::from_slice(&values).view([ROWS, channels])
}

#[cfg(test)]
mod tests {
    use tch::Device;
    use tch::nn::VarStore;

    use super::*;

    #[test]
    fn delays_between_rows_lie_between_their_codes() {
        let variables = VarStore::new(Device::Cpu);
        let encoding = TemporalEncoding::new(&variables.root(), 8);
        let codes = encoding
            .encode(&[2.0, 2.25, 3.0, 1e9, 99.0, -4.0, 0.0])
            .unwrap();
        let expected = codes.get(0) * 0.75 + codes.get(2) * 0.25;
        assert!((codes.get(1) - expected).abs().max().double_value(&[]) < 1e-6);
        assert_eq!(codes.get(3), codes.get(4));
        assert_eq!(codes.get(5), codes.get(6));
        assert_ne!(codes.get(0), codes.get(2));
    }
}
