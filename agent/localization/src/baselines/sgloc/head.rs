//! Head: attention between scales, residual layers with batch normalisation, and a shift of each cell's own position.

use tch::{Kind, Tensor, nn};

use crate::baselines::layers::DenseNorm;
use crate::pgc::SceneEncoderConfig;
use crate::pgc::dense::Dense;

/// Channels inside the head.
const WIDTH: i64 = 768;
/// Residual blocks of two layers.
const BLOCKS: usize = 2;
/// Unit of positions in the sensor frame that enter the head, metres.
const POSITION_SCALE_M: f64 = 10.0;
/// Unit of the shift, metres.
const SHIFT_SCALE_M: f64 = 100.0;

/// World coordinates of cells, one hypothesis each.
#[derive(Debug)]
pub(super) struct SgLocHead {
    /// Channels of each scale, from fine cells to the widest surroundings.
    scales: Vec<i64>,
    /// One logit from each scale.
    squeeze: Vec<Dense>,
    inward: DenseNorm,
    blocks: Vec<[DenseNorm; 2]>,
    outward: Dense,
}

impl SgLocHead {
    /// Builds the layers below `path`, for the cells of an encoder.
    pub(super) fn new(path: &nn::Path<'_>, encoder: &SceneEncoderConfig) -> Self {
        let coarse = encoder.coarse_channels();
        let fine = encoder.local_channels() - coarse;
        let surroundings = encoder.context_m.iter().map(|_| coarse);
        let scales = [fine, coarse].into_iter().chain(surroundings);
        let scales: Vec<i64> = scales.filter(|&channels| channels > 0).collect();
        Self {
            squeeze: (scales.iter().enumerate())
                .map(|(scale, &channels)| Dense::new(&(path / "squeeze" / scale), channels, 1, 0.1))
                .collect(),
            inward: DenseNorm::new(&(path / "inward"), [encoder.cell_channels() + 3, WIDTH]),
            scales,
            blocks: (0..BLOCKS)
                .map(|number| {
                    [0, 1].map(|of| DenseNorm::new(&(path / "blocks" / number / of), [WIDTH; 2]))
                })
                .collect(),
            outward: Dense::new(&(path / "outward"), WIDTH, 3, 0.1),
        }
    }

    /// `[N, 3]` world coordinates relative to the origin of the network, metres, of normalised features
    /// `[N, cell_channels]` of cells at `sensor_m` `[N, 3]`, metres in the sensor frame. Computed in the precision of
    /// the features; the last layer in single precision, as its output is added to metres.
    pub(super) fn forward(
        &self,
        cells: &Tensor,
        sensor_m: &Tensor,
        train: bool,
    ) -> tch::Result<Tensor> {
        let mut parts = self.weigh(cells)?;
        parts.push((sensor_m / POSITION_SCALE_M).f_to_kind(cells.kind())?);
        let parts = Tensor::f_cat(&parts, 1)?;
        let mut x = self.inward.forward(&parts, train)?.f_relu()?;
        for [first, second] in &self.blocks {
            let inner = first.forward(&x, train)?.f_relu()?;
            x = (x + second.forward(&inner, train)?).f_relu()?;
        }
        Ok(sensor_m + self.outward.forward(&x.f_to_kind(Kind::Float)?)? * SHIFT_SCALE_M)
    }

    /// The features scale by scale, each weighted by what it and the fine scale say (tri-scale spatial attention).
    fn weigh(&self, cells: &Tensor) -> tch::Result<Vec<Tensor>> {
        let mut parts = Vec::with_capacity(self.scales.len() + 1);
        let (mut first, mut own) = (0, None);
        for (&channels, squeeze) in self.scales.iter().zip(&self.squeeze) {
            let part = cells.f_narrow(1, first, channels)?;
            let logit = squeeze.forward(&part)?;
            let both = match &own {
                Some(own) => logit.f_add(own)?,
                None => logit.shallow_clone(),
            };
            own.get_or_insert(logit);
            parts.push(part * both.f_sigmoid()?);
            first += channels;
        }
        Ok(parts)
    }
}
