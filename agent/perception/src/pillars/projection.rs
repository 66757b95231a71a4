//! Pillar encoder for inference: plain loops over packed points instead of tensors.

use tch::{Kind, Tensor};

use crate::int8::Quantisation;
use crate::pillars::batch::{POINT_FEATURES, PillarGrid, mean_xyz};
use crate::pillars::encoder::PillarEncoder;
use crate::pillars::voxels::Pillars;

/// Number of channels that are computed together; a few vector registers.
const LANES: usize = 16;

/// The folded pillar encoder.
///
/// The ten inputs of a point are linear in its x, y, z, intensity for a given pillar, and ReLU may be applied after the
/// maximum. Four multiplications per point and channel remain of the reference's ten. Positions are relative to the
/// pillar's centre, so that no precision is lost 100 m away from the sensor.
#[derive(Debug, Clone)]
pub struct PillarProjection {
    /// Channels per pillar `C`.
    pub channels: usize,
    /// `[C / LANES]`: weights of x, y, z (relative to the centre) and intensity, per lane.
    point: Vec<[[f32; LANES]; 4]>,
    /// `[C / LANES]`: weights of the mean's offset from the centre.
    mean: Vec<[[f32; LANES]; 3]>,
    /// `[C / LANES]`: weights of the centre itself.
    center: Vec<[[f32; LANES]; 3]>,
    bias: Vec<[f32; LANES]>,
}

impl PillarProjection {
    /// Projection with the parameters of a trained encoder.
    ///
    /// # Panics
    /// When the parameters are not `f32` on the CPU, which the encoder's constructor rules out.
    pub fn new(encoder: &PillarEncoder) -> Self {
        let (weight, bias) = encoder.folded();
        let channels = weight.size()[0] as usize;
        let [weight, mut bias] = [weight, bias].map(|tensor: Tensor| {
            let tensor = tensor.to_device(tch::Device::Cpu).to_kind(Kind::Float);
            let tensor = tensor.contiguous().view([-1]);
            Vec::<f32>::try_from(&tensor).expect("contiguous f32 values on the CPU")
        });
        // Inputs: 0-2 position, 3 intensity, 4-6 offset from the mean, 7-9 offset from the centre.
        let mut weight = weight.as_chunks::<POINT_FEATURES>().0.to_vec();
        let lanes = channels.next_multiple_of(LANES);
        weight.resize(lanes, [0.0; POINT_FEATURES]);
        bias.resize(lanes, 0.0);
        let blocks = weight.as_chunks::<LANES>().0.iter();
        // x, y, z are in the position and in both offsets, so their three weights add up.
        let point = blocks.clone().map(|block| {
            let [x, y, z] =
                [0, 1, 2].map(|axis| block.map(|row| row[axis] + row[4 + axis] + row[7 + axis]));
            [x, y, z, block.map(|row| row[3])]
        });
        // Point - mean = (point - centre) - (mean - centre): hence the sign.
        let mean = blocks
            .clone()
            .map(|block| [4, 5, 6].map(|input| block.map(|row| -row[input])));
        let center = blocks.map(|block| [0, 1, 2].map(|axis| block.map(|row| row[axis])));
        Self {
            channels,
            point: point.collect(),
            mean: mean.collect(),
            center: center.collect(),
            bias: bias.as_chunks().0.to_vec(),
        }
    }

    /// Writes the features of every pillar to `canvas`, `[H, W, C]` row-major, which the caller has zeroed.
    ///
    /// # Panics
    /// When the canvas is smaller than the pillar grid.
    pub fn scatter(&self, pillars: &Pillars, pillar_grid: &PillarGrid, canvas: &mut [f32]) {
        for (points, coord) in pillars.iter() {
            let cell = pillar_grid.cell(coord) * self.channels;
            let features = &mut canvas[cell..cell + self.channels];
            self.pillar(points, coord, pillar_grid, features);
        }
    }

    /// The same in quantised values.
    ///
    /// # Panics
    /// When the canvas is smaller than the pillar grid.
    pub fn scatter_quantised(
        &self,
        pillars: &Pillars,
        pillar_grid: &PillarGrid,
        quantisation: Quantisation,
        canvas: &mut [u8],
    ) {
        let mut features = vec![0.0; self.channels];
        for (points, coord) in pillars.iter() {
            let cell = pillar_grid.cell(coord) * self.channels;
            self.pillar(points, coord, pillar_grid, &mut features);
            quantisation.quantise_values(&features, &mut canvas[cell..cell + self.channels]);
        }
    }

    fn pillar(
        &self,
        points: &[[f32; 4]],
        coord: [i32; 3],
        pillar_grid: &PillarGrid,
        output: &mut [f32],
    ) {
        let (center, mean) = (pillar_grid.center_m(coord), mean_xyz(points));
        let is_partial = points.len() < pillar_grid.max_points;
        for (block, output) in output.chunks_mut(LANES).enumerate() {
            let mut best = [f32::NEG_INFINITY; LANES];
            let weight = &self.point[block];
            for point in points {
                let [x, y, z] = [0, 1, 2].map(|axis: usize| point[axis] - center[axis]);
                for lane in 0..LANES {
                    let value = x * weight[0][lane]
                        + y * weight[1][lane]
                        + z * weight[2][lane]
                        + point[3] * weight[3][lane];
                    let before = best[lane];
                    best[lane] = if value > before { value } else { before };
                }
            }
            for (lane, output) in output.iter_mut().enumerate() {
                let offsets = (0..3).map(|axis| {
                    self.center[block][axis][lane] * center[axis]
                        + self.mean[block][axis][lane] * (mean[axis] - center[axis])
                });
                let offset: f32 = offsets.sum();
                let bias = self.bias[block][lane];
                let value = best[lane] + offset + bias;
                // An empty slot of the reference is a zero row: it contributes the bias alone.
                let value = if is_partial { value.max(bias) } else { value };
                *output = value.max(0.0);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;
    use tch::nn::VarStore;

    use super::*;
    use crate::model_config::DetectorConfig;
    use crate::pillars::batch::PillarBatch;
    use crate::pillars::voxels::Voxeliser;

    #[test]
    fn it_computes_the_same_as_the_encoder() {
        tch::set_num_threads(1);
        tch::manual_seed(3);
        let config = DetectorConfig {
            max_points_per_pillar: 3,
            pillar_channels: 24,
            ..DetectorConfig::lean()
        };
        let network = VarStore::new(Device::Cpu);
        let encoder = PillarEncoder::new(&network.root(), 24);
        for (name, mut variable) in network.variables() {
            let low = if name.contains("var") { 0.3 } else { -0.5 };
            let _ = tch::no_grad(|| variable.uniform_(low, 0.9));
        }
        let points: Vec<[f32; 4]> = (0..3000)
            .map(|k| {
                [
                    (k % 97) as f32 - 48.0,
                    (k % 71) as f32 - 35.0,
                    (k % 13) as f32 * 0.3 - 3.0,
                    (k % 7) as f32 / 7.0,
                ]
            })
            .collect();
        let pillars = Voxeliser::for_detector(&config).voxelise(&points);
        let pillar_grid = PillarGrid::new(&config);
        let batch = PillarBatch::new(&[&pillars], &pillar_grid);
        let expected =
            tch::no_grad(|| batch.scatter(&encoder.forward(&batch, false), &pillar_grid));
        let mut canvas = vec![0.0; pillar_grid.width * pillar_grid.height * 24];
        PillarProjection::new(&encoder).scatter(&pillars, &pillar_grid, &mut canvas);
        let shape = [1, pillar_grid.height as i64, pillar_grid.width as i64, 24];
        let actual = Tensor::from_slice(&canvas)
            .view(shape)
            .permute([0, 3, 1, 2]);
        assert!(actual.allclose(&expected, 1e-5, 2e-5, false));
    }
}
