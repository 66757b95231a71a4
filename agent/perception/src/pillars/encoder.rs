//! Pillar feature network: from ten values per point to one feature vector per pillar.

use tch::{Tensor, nn};

use crate::layers::convolution::Norm;
use crate::pillars::batch::{POINT_FEATURES, PillarBatch};

/// One layer: linear without bias, batch norm, ReLU, maximum over the points of the pillar.
///
/// The reference computes pillars padded with zero rows. Here only real points are computed. In inference the result
/// is the same: a zero row gives `relu(norm(0))`, which is the lower bound of every pillar that has a free slot.
/// In training the batch statistics are taken over the real points and one zero row, not over millions of zero rows;
/// running statistics therefore differ from those of the reference, while a trained file is equivalent in both.
#[derive(Debug)]
pub struct PillarEncoder {
    pub(crate) linear: Tensor,
    norm: Norm,
}

impl PillarEncoder {
    /// Parameters `pfn_layers.0.linear.weight` and `pfn_layers.0.norm.*` under `path`.
    pub fn new(path: &nn::Path<'_>, channels: i64) -> Self {
        let layer = path / "pfn_layers" / "0";
        let shape = [channels, POINT_FEATURES as i64];
        let linear = (&layer / "linear").var("weight", &shape, nn::init::DEFAULT_KAIMING_UNIFORM);
        let norm = Norm::new(&(&layer / "norm"), channels);
        Self { linear, norm }
    }

    /// Features of every pillar: `[M, C]`.
    pub fn forward(&self, batch: &PillarBatch, train: bool) -> Tensor {
        let points = batch.points();
        // It passes through the same layer and becomes the floor of pillars with a free slot.
        let features = &batch.features;
        let like = (features.kind(), features.device());
        let zero_row = features.new_zeros([1, POINT_FEATURES as i64], like);
        let rows = Tensor::cat(&[features, &zero_row], 0).matmul(&self.linear.tr());
        let rows = self.norm.forward(&rows, train).relu();
        let best = segment_max(&rows.narrow(0, 0, points), &batch.counts);
        let floor = rows.narrow(0, points, 1);
        best.maximum(&floor).where_self(&batch.partial, &best)
    }

    /// The linear layer with the running statistics folded in: weight `[C, 10]`, bias `[C]`.
    pub fn folded(&self) -> (Tensor, Tensor) {
        let (scale, shift) = self.norm.scale_shift();
        ((&self.linear * scale.unsqueeze(1)).detach(), shift.detach())
    }
}

/// Maximum over runs of rows: `[P, C]` and `[M]` run lengths, each at least 1, to `[M, C]`.
fn segment_max(rows: &Tensor, lengths: &Tensor) -> Tensor {
    let (rows, lengths, absent) = (rows.contiguous(), Some(lengths), None::<&Tensor>);
    let initial = f64::NEG_INFINITY;
    Tensor::segment_reduce(&rows, "max", lengths, absent, absent, 0, false, initial)
}

#[cfg(test)]
mod tests {
    use tch::nn::VarStore;
    use tch::{Device, Kind};

    use super::*;
    use crate::model_config::DetectorConfig;
    use crate::pillars::batch::PillarGrid;
    use crate::pillars::voxels::{Pillars, Voxeliser};

    /// Pillars with one to five points, some of them full.
    fn pillars(config: &DetectorConfig) -> Pillars {
        let points: Vec<[f32; 4]> = (0..40)
            .flat_map(|cell| {
                let [x, y] = [(cell % 8) as f32 * 0.8 - 3.0, (cell / 8) as f32 * 0.8 - 1.8];
                (0..=cell % 5).map(move |k| {
                    [
                        x + 0.03 * k as f32,
                        y - 0.02 * k as f32,
                        -0.3 * k as f32,
                        0.1 * k as f32,
                    ]
                })
            })
            .collect();
        Voxeliser::for_detector(config).voxelise(&points)
    }

    /// The reference's computation: every slot goes through the layer, empty ones as zeros.
    fn padded(encoder: &PillarEncoder, batch: &PillarBatch, slots: i64) -> Tensor {
        let mut rows = Vec::new();
        let mut first = 0;
        for count in Vec::<i64>::try_from(&batch.counts).unwrap() {
            let points = batch.features.narrow(0, first, count);
            rows.push(points.constant_pad_nd([0, 0, 0, slots - count]));
            first += count;
        }
        let rows = Tensor::stack(&rows, 0);
        let flat = rows
            .view([-1, POINT_FEATURES as i64])
            .matmul(&encoder.linear.tr());
        let normed = encoder.norm.forward(&flat, false).relu();
        normed.view([-1, slots, normed.size()[1]]).amax([1], false)
    }

    #[test]
    fn packed_points_give_the_values_and_gradients_of_padded_ones() {
        let config = DetectorConfig {
            max_points_per_pillar: 5,
            ..DetectorConfig::lean()
        };
        tch::set_num_threads(1);
        tch::manual_seed(1);
        let network = VarStore::new(Device::Cpu);
        let encoder = PillarEncoder::new(&network.root(), 16);
        let _ = tch::no_grad(|| encoder.norm.bias.shallow_clone().uniform_(-0.5, 0.5));
        let batch = PillarBatch::new(&[&pillars(&config)], &PillarGrid::new(&config));
        assert_eq!(batch.counts.max().int64_value(&[]), 5);
        let weights = Tensor::randn([batch.counts.size()[0], 16], (Kind::Float, Device::Cpu));
        let mut results = Vec::new();
        for output in [encoder.forward(&batch, false), padded(&encoder, &batch, 5)] {
            let loss = (&output * &weights).sum(Kind::Float);
            let inputs = [&encoder.linear, &encoder.norm.bias];
            let gradients = Tensor::run_backward(&[loss], &inputs, false, false);
            results.push((output, gradients));
        }
        assert!(results[0].0.allclose(&results[1].0, 1e-5, 1e-5, false));
        for (packed, padded) in results[0].1.iter().zip(&results[1].1) {
            assert!(
                packed.allclose(padded, 1e-4, 1e-4, false),
                "{packed} {padded}"
            );
        }
    }
}
