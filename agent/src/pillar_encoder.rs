//! The pillar feature network: ten numbers per point to one feature vector per pillar.

use tch::{Tensor, nn};

use crate::convolution::Norm;
use crate::pillar_batch::{POINT_FEATURES, PillarBatch};

/// One layer: linear without bias, batch norm, ReLU, maximum over the points of the pillar.
///
/// The reference works on pillars padded with zero rows. Here only real points are computed. In inference the result
/// is the same: a zero row gives `relu(norm(0))`, which is the floor of every pillar that has a free slot.
/// In training the batch statistics are taken over the real points and one zero row, not over millions of zero rows;
/// running statistics therefore differ from those of the reference, while a trained file means the same to both.
#[derive(Debug)]
pub struct PillarEncoder {
    linear: Tensor,
    norm: Norm,
}

impl PillarEncoder {
    /// Parameters `pfn_layers.0.linear.weight` and `pfn_layers.0.norm.*` under `path`.
    #[must_use]
    pub fn new(path: &nn::Path<'_>, channels: i64) -> Self {
        let layer = path / "pfn_layers" / "0";
        let shape = [channels, POINT_FEATURES as i64];
        let linear = (&layer / "linear").var("weight", &shape, nn::init::DEFAULT_KAIMING_UNIFORM);
        Self { linear, norm: Norm::new(&(&layer / "norm"), channels) }
    }

    /// Features of every pillar: `[M, C]`.
    #[must_use]
    pub fn forward(&self, batch: &PillarBatch, train: bool) -> Tensor {
        let points = batch.points();
        let zero_row = batch.features.new_zeros([1, POINT_FEATURES as i64], (batch.features.kind(), batch.device()));
        let rows = Tensor::cat(&[&batch.features, &zero_row], 0).matmul(&self.linear.tr());
        let rows = self.norm.forward(&rows, train).relu();
        let best = segment_max(&rows.narrow(0, 0, points), &batch.counts);
        let floor = rows.narrow(0, points, 1);
        best.maximum(&floor).where_self(&batch.partial, &best)
    }

    /// The linear layer with the running statistics folded in: weight `[C, 10]`, bias `[C]`.
    #[must_use]
    pub fn folded(&self) -> (Tensor, Tensor) {
        let (scale, shift) = self.norm.scale_shift();
        ((&self.linear * scale.unsqueeze(1)).detach(), shift.detach())
    }
}

/// Maximum over runs of rows: `[P, C]` and `[M]` run lengths, each at least 1, to `[M, C]`.
fn segment_max(rows: &Tensor, lengths: &Tensor) -> Tensor {
    let absent = None::<&Tensor>;
    Tensor::segment_reduce(&rows.contiguous(), "max", Some(lengths), absent, absent, 0, false, f64::NEG_INFINITY)
}
