//! Sparse encoder: features of places, independent of the scene.

use std::path::Path;

use tch::nn::{self, Init, VarStore};
use tch::{Device, Kind, TchError, Tensor, no_grad};

use super::encoder_config::SceneEncoderConfig;
use super::error::LocalizerError;
use super::voxel_batch::VoxelBatch;
use perception::sparse::{GatherIndex, SparseConv};
use perception::weights::Weights;

/// Output of the encoder for some sweeps.
#[derive(Debug)]
pub struct SceneFeatures {
    /// `[cells, cell_channels]`.
    pub cells: Tensor,
    /// `[sweeps, sweep_channels]`: mean and maximum over the coarse cells.
    pub sweeps: Tensor,
}

/// Features of cells before their surroundings are added.
#[derive(Debug)]
pub struct LocalFeatures {
    /// `[cells, local_channels]`.
    pub cells: Tensor,
    /// `[coarse cells, coarse_channels]`.
    pub coarse: Tensor,
}

/// Sparse convolutions, LightLoc's layout: one at stride 1, some at stride 2, residual groups; ReLU, bias, no norm.
#[derive(Debug)]
pub struct SceneEncoder {
    config: SceneEncoderConfig,
    first: SparseConv,
    down: Vec<SparseConv>,
    fine: Option<ResidualGroup>,
    coarse: Vec<ResidualGroup>,
}

impl SceneEncoder {
    /// Kind of the weights, as in their file.
    pub const KIND: &'static str = "scene encoder";

    /// Builds the layers below `path`.
    ///
    /// # Errors
    /// [`LocalizerError::Config`] names the field that is wrong.
    pub fn new(path: &nn::Path<'_>, config: &SceneEncoderConfig) -> Result<Self, LocalizerError> {
        config.validate().map_err(LocalizerError::Config)?;
        let widths = &config.widths;
        let level = |level: usize| path / "levels" / level;
        let first = SparseConv::new(&level(0), config.input.channels(), widths[0]);
        let down = (1..widths.len()).map(|to| SparseConv::new(&level(to), widths[to - 1], widths[to])).collect();
        let before_last = widths[widths.len() - 2];
        let fine = config.fine_cells.then(|| ResidualGroup::new(&(path / "fine"), before_last, before_last));
        let mut coarse = Vec::new();
        let mut channels = widths[widths.len() - 1];
        for (group, &width) in config.residual_widths.iter().enumerate() {
            coarse.push(ResidualGroup::new(&(path / "residual" / group), channels, width));
            channels = width;
        }
        Ok(Self { config: config.clone(), first, down, fine, coarse })
    }

    /// Reads an encoder from a weights file that contains its configuration, frozen. Returns the file's SHA-256 beside
    /// it.
    ///
    /// # Errors
    /// [`LocalizerError`] when the file is missing, truncated or of another kind.
    pub fn load(path: &Path, device: Device) -> Result<(Self, String), LocalizerError> {
        let weights = Weights::load(path)?;
        weights.check_kind(Self::KIND)?;
        let config: SceneEncoderConfig = weights.config()?;
        let mut network = VarStore::new(device);
        let encoder = Self::new(&network.root(), &config)?;
        weights.copy_into(&network)?;
        network.freeze();
        Ok((encoder, weights.sha256().to_owned()))
    }

    /// Configuration that it was built from.
    #[must_use]
    pub fn config(&self) -> &SceneEncoderConfig {
        &self.config
    }

    /// Features of cells and coarse cells, computed in `kind`. Differentiable.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn local(&self, batch: &VoxelBatch, kind: Kind) -> Result<LocalFeatures, TchError> {
        let mut x = self.first.forward(&batch.input.to_kind(kind), &batch.first)?.f_relu()?;
        let mut fine = None;
        for (level, conv) in self.down.iter().enumerate() {
            if level + 1 == self.down.len()
                && let (Some(group), Some(index)) = (&self.fine, &batch.fine)
            {
                fine = Some(group.forward(&x, index)?);
            }
            x = conv.forward(&x, &batch.down[level])?.f_relu()?;
        }
        for group in &self.coarse {
            x = group.forward(&x, &batch.coarse)?;
        }
        let spread = rows(&x, &batch.coarse_of_cell)?;
        let cells = match fine {
            Some(fine) => Tensor::f_cat(&[fine, spread], 1)?,
            None => spread,
        };
        Ok(LocalFeatures { cells, coarse: x })
    }

    /// Features of cells with their surroundings, and of the sweeps.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn complete(&self, local: &LocalFeatures, batch: &VoxelBatch) -> Result<SceneFeatures, TchError> {
        let mut parts = vec![local.cells.shallow_clone()];
        if !self.config.context_m.is_empty() {
            let plane = Plane::new(&local.coarse, batch)?;
            for edge_m in &self.config.context_m {
                // Odd, so that the cell is in the centre.
                let window = 2 * (edge_m / self.config.coarse_cell_m() / 2.0).round() as i64 + 1;
                let context = rows(&plane.mean_over(window)?, &batch.columns)?;
                parts.push(rows(&context.to_kind(local.cells.kind()), &batch.coarse_of_cell)?);
            }
        }
        let sweep = |rows: &std::ops::Range<i64>| {
            let own = local.coarse.f_narrow(0, rows.start, rows.end - rows.start)?.f_to_kind(Kind::Float)?;
            if own.size()[0] == 0 {
                return own.f_new_zeros([2 * own.size()[1]], (Kind::Float, own.device()));
            }
            Tensor::f_cat(&[own.f_mean_dim(0_i64, false, Kind::Float)?, own.f_amax([0_i64], false)?], 0)
        };
        let sweeps: Vec<Tensor> = batch.coarse_rows.iter().map(sweep).collect::<Result<_, _>>()?;
        Ok(SceneFeatures { cells: Tensor::f_cat(&parts, 1)?, sweeps: Tensor::f_stack(&sweeps, 0)? })
    }

    /// Both steps without gradients.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn encode(&self, batch: &VoxelBatch, kind: Kind) -> Result<SceneFeatures, TchError> {
        no_grad(|| self.complete(&self.local(batch, kind)?, batch))
    }
}

/// Rows of `x` by index; its gradient is fast because the index is expanded, not written out.
fn rows(x: &Tensor, index: &Tensor) -> Result<Tensor, TchError> {
    x.f_gather(0, &index.f_unsqueeze(1)?.f_expand([-1, x.size()[1]], false)?, false)
}

/// Two 3x3x3 convolutions with a 1x1 one between them, and a skip connection.
#[derive(Debug)]
struct ResidualGroup {
    inward: SparseConv,
    middle: Tensor,
    middle_bias: Tensor,
    outward: SparseConv,
    skip: Option<Tensor>,
}

impl ResidualGroup {
    fn new(path: &nn::Path<'_>, inputs: i64, outputs: i64) -> Self {
        let pointwise = |name: &str, from: i64| {
            let stdev = (2.0 / from as f64).sqrt();
            (path / name).var("weight", &[from, outputs], Init::Randn { mean: 0.0, stdev })
        };
        Self {
            inward: SparseConv::new(&(path / "inward"), inputs, outputs),
            middle: pointwise("middle", outputs),
            middle_bias: (path / "middle").var("bias", &[outputs], Init::Const(0.0)),
            outward: SparseConv::new(&(path / "outward"), outputs, outputs),
            skip: (inputs != outputs).then(|| pointwise("skip", inputs)),
        }
    }

    fn forward(&self, x: &Tensor, index: &GatherIndex) -> Result<Tensor, TchError> {
        let kind = x.kind();
        let inner = self.inward.forward(x, index)?.f_relu()?;
        let inner = self.middle_bias.to_kind(kind).f_addmm(&inner, &self.middle.to_kind(kind))?.f_relu()?;
        let inner = self.outward.forward(&inner, index)?;
        match &self.skip {
            Some(skip) => (inner + x.f_matmul(&skip.to_kind(kind))?).f_relu(),
            None => (inner + x).f_relu(),
        }
    }
}

/// Coarse features summed over height into the plane of each sweep.
struct Plane {
    /// `[sweeps, channels, edge, edge]`.
    sum: Tensor,
    /// `[sweeps, 1, edge, edge]`: number of coarse cells above one another.
    count: Tensor,
}

impl Plane {
    fn new(coarse: &Tensor, batch: &VoxelBatch) -> Result<Self, TchError> {
        let (sweeps, edge) = (batch.sweeps(), batch.plane_edge);
        let spread = |values: &Tensor| {
            let channels = values.size()[1];
            let empty = values.f_new_zeros([sweeps * edge * edge, channels], (Kind::Float, values.device()))?;
            let index = batch.columns.f_unsqueeze(1)?.f_expand([-1, channels], false)?;
            empty.f_scatter_add(0, &index, values)?.f_view([sweeps, edge, edge, channels])?.f_permute([0, 3, 1, 2])
        };
        let coarse = coarse.f_to_kind(Kind::Float)?;
        let ones = coarse.f_new_ones([coarse.size()[0], 1], (Kind::Float, coarse.device()))?;
        Ok(Self { sum: spread(&coarse)?, count: spread(&ones)? })
    }

    /// `[sweeps * edge * edge, channels]`: mean over the coarse cells in a square window.
    fn mean_over(&self, window: i64) -> Result<Tensor, TchError> {
        let pooled =
            |values: &Tensor| values.f_avg_pool2d([window; 2], [1; 2], [window / 2; 2], false, true, None::<i64>);
        let mean = pooled(&self.sum)? / pooled(&self.count)?.f_clamp_min(1e-6)?;
        let channels = mean.size()[1];
        mean.f_permute([0, 2, 3, 1])?.f_reshape([-1, channels])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pgc::voxelise::SweepVoxels;

    fn sweep(shift: f32) -> Vec<[f32; 3]> {
        let wall = (0..3000).map(move |k| [(k % 60) as f32 * 0.3 - 9.0, 6.0 + shift, (k / 60) as f32 * 0.1 - 2.0]);
        wall.chain((0..400).map(|k| [(k % 20) as f32 - 10.0, (k / 20) as f32 - 10.0, -1.9])).collect()
    }

    fn encoder(config: &SceneEncoderConfig) -> (VarStore, SceneEncoder) {
        tch::set_num_threads(1);
        tch::manual_seed(4);
        let network = VarStore::new(Device::Cpu);
        let encoder = SceneEncoder::new(&network.root(), config).unwrap();
        (network, encoder)
    }

    #[test]
    fn shapes_are_those_of_the_configuration_and_sweeps_stay_apart() {
        for config in [SceneEncoderConfig::lean(), SceneEncoderConfig::full(0.125)] {
            let (_network, encoder) = encoder(&config);
            let (a, b) = (SweepVoxels::new(sweep(0.0), &config), SweepVoxels::new(sweep(3.0), &config));
            let both = VoxelBatch::new(&[&a, &b], &config, Device::Cpu).unwrap();
            let features = encoder.encode(&both, Kind::Float).unwrap();
            assert_eq!(features.cells.size(), [(a.cells().len() + b.cells().len()) as i64, config.cell_channels()]);
            assert_eq!(features.sweeps.size(), [2, config.sweep_channels()]);
            let alone = VoxelBatch::new(&[&b], &config, Device::Cpu).unwrap();
            let alone = encoder.encode(&alone, Kind::Float).unwrap();
            let rows = both.cell_rows(1);
            let same = features.cells.narrow(0, rows.start, rows.end - rows.start);
            assert!(same.allclose(&alone.cells, 1e-4, 1e-4, false));
            assert!(features.sweeps.get(1).allclose(&alone.sweeps.get(0), 1e-4, 1e-4, false));
        }
    }

    #[test]
    fn features_do_not_change_when_the_world_moves_by_whole_coarse_cells() {
        let config = SceneEncoderConfig { context_m: vec![], ..SceneEncoderConfig::lean() };
        let (_network, encoder) = encoder(&config);
        let here = SweepVoxels::new(sweep(0.0), &config);
        let there = SweepVoxels::new(sweep(0.0).into_iter().map(|[x, y, z]| [x + 8.0, y - 4.0, z]), &config);
        let encode = |sweep| encoder.encode(&VoxelBatch::new(&[sweep], &config, Device::Cpu).unwrap(), Kind::Float);
        let (here, there) = (encode(&here).unwrap(), encode(&there).unwrap());
        assert!(here.cells.allclose(&there.cells, 1e-3, 1e-3, false));
    }

    #[test]
    fn an_empty_sweep_gives_no_cells_and_zeros() {
        let config = SceneEncoderConfig::lean();
        let (_network, encoder) = encoder(&config);
        let empty = SweepVoxels::new([], &config);
        let batch = VoxelBatch::new(&[&empty], &config, Device::Cpu).unwrap();
        let features = encoder.encode(&batch, Kind::Float).unwrap();
        assert_eq!(features.cells.size()[0], 0);
        assert_eq!(f64::try_from(features.sweeps.abs().max()).unwrap(), 0.0);
    }

    #[test]
    fn a_gradient_reaches_every_parameter() {
        let config = SceneEncoderConfig::lean();
        let (network, encoder) = encoder(&config);
        let sweep = SweepVoxels::new(sweep(0.0), &config);
        let batch = VoxelBatch::new(&[&sweep], &config, Device::Cpu).unwrap();
        encoder.local(&batch, Kind::BFloat16).unwrap().cells.square().mean(Kind::Float).backward();
        for (name, parameter) in network.variables() {
            assert!(parameter.grad().defined() && parameter.grad().abs().max().double_value(&[]) > 0.0, "{name}");
        }
    }
}
