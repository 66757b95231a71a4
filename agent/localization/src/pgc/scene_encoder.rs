//! Sparse encoder: features of places, independent of the scene.

use std::path::Path;

use tch::{Device, Kind, Tensor, nn, no_grad};

use super::encoder_config::SceneEncoderConfig;
use super::error::LocalizerError;
use super::int8_levels::Int8Levels;
use super::residual_group::{OnActivation, ResidualGroup};
use super::voxel_batch::VoxelBatch;
use perception::int8::{ActivationScales, LayerFormat, QuantiseError, ScaleSearch};
use perception::sparse::{SparseConv, rows};
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
    int8: Option<Int8Levels>,
}

impl SceneEncoder {
    /// Kind of the weights, as in their file.
    pub const KIND: &'static str = "scene encoder";

    /// Builds the layers below `path`.
    ///
    /// # Errors
    /// [`LocalizerError::Config`] names the field that is wrong.
    pub fn new(path: &nn::Path<'_>, config: &SceneEncoderConfig) -> Result<Self, LocalizerError> {
        config.validate()?;
        let widths = &config.widths;
        let levels = path / "levels";
        let first = SparseConv::new(&(&levels / 0), config.input.channels(), widths[0]);
        let down = (1..widths.len())
            .map(|to| SparseConv::new(&(&levels / to), widths[to - 1], widths[to]))
            .collect();
        let (before_last, fine) = (widths[widths.len() - 2], path / "fine");
        let fine = config
            .fine_cells
            .then(|| ResidualGroup::new(&fine, before_last, before_last));
        let mut coarse = Vec::new();
        let mut channels = widths[widths.len() - 1];
        for (group, &width) in config.residual_widths.iter().enumerate() {
            let path = path / "residual" / group;
            coarse.push(ResidualGroup::new(&path, channels, width));
            channels = width;
        }
        Ok(Self {
            config: config.clone(),
            first,
            down,
            fine,
            coarse,
            int8: None,
        })
    }

    /// Reads an encoder from a weights file that contains its configuration, frozen.
    ///
    /// # Errors
    /// [`LocalizerError`] when the file is missing, truncated or of another kind.
    pub fn load(path: &Path, device: Device) -> Result<Self, LocalizerError> {
        Self::from_weights(&Weights::load(path)?, device)
    }

    /// The encoder of a file already read, frozen.
    pub(super) fn from_weights(weights: &Weights, device: Device) -> Result<Self, LocalizerError> {
        weights.network(Self::KIND, device, |path, config| Self::new(path, &config))
    }

    /// Configuration that it was built from.
    pub fn config(&self) -> &SceneEncoderConfig {
        &self.config
    }

    /// Features of cells and coarse cells, computed in `kind`. Differentiable.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn local(&self, batch: &VoxelBatch, kind: Kind) -> tch::Result<LocalFeatures> {
        self.local_with(batch, kind, &mut |_, _| Ok(()))
    }

    /// Adds the activations that [`Self::quantise`] needs scales of.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn observe(&self, batch: &VoxelBatch, search: &mut ScaleSearch) -> tch::Result<()> {
        no_grad(|| {
            self.local_with(batch, Kind::Float, &mut |name, values| {
                search.observe(name, values)
            })
            .map(drop)
        })
    }

    fn local_with(
        &self,
        batch: &VoxelBatch,
        kind: Kind,
        on_activation: &mut OnActivation<'_>,
    ) -> tch::Result<LocalFeatures> {
        let input = batch.input.to_kind(kind);
        let mut x = self.first.forward(&input, &batch.first)?.f_relu()?;
        on_activation(&level_activation(0), &x)?;
        let mut fine = None;
        for (level, conv) in self.down.iter().enumerate() {
            // The fine group takes the input of the last convolution, the level before the last.
            if level + 1 == self.down.len()
                && let (Some(group), Some(index)) = (&self.fine, &batch.fine)
            {
                fine = Some(group.forward(&x, index, FINE, on_activation)?);
            }
            x = conv.forward(&x, &batch.down[level])?.f_relu()?;
            on_activation(&level_activation(level + 1), &x)?;
        }
        for (number, group) in self.coarse.iter().enumerate() {
            x = group.forward(&x, &batch.coarse, &coarse_activation(number), on_activation)?;
            on_activation(&coarse_activation(number), &x)?;
        }
        LocalFeatures::new(fine, x, batch)
    }

    /// Computes in integers from here on, in [`Self::encode`].
    ///
    /// # Errors
    /// [`QuantiseError`] names the activation whose scale is missing.
    pub fn quantise(&mut self, scales: &ActivationScales) -> Result<(), QuantiseError> {
        let first = scales.get(&level_activation(0))?;
        let (mut input, mut before) = (first, first);
        let mut down = Vec::with_capacity(self.down.len());
        for (level, conv) in self.down.iter().enumerate() {
            let output = scales.get(&level_activation(level + 1))?;
            down.push(conv.int8(LayerFormat::hidden(input, output))?);
            (before, input) = (input, output);
        }
        let fine = self
            .fine
            .as_ref()
            .map(|group| group.int8(before, FINE, scales));
        let fine = fine.transpose()?;
        let last = input;
        let mut coarse = Vec::with_capacity(self.coarse.len());
        for (number, group) in self.coarse.iter().enumerate() {
            let name = coarse_activation(number);
            coarse.push((group.int8(input, &name, scales)?, input));
            input = scales.get(&name)?;
        }
        self.int8 = Some(Int8Levels {
            first,
            down,
            fine,
            coarse,
            last,
        });
        Ok(())
    }

    /// Features of cells with their surroundings, and of the sweeps.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn complete(
        &self,
        local: &LocalFeatures,
        batch: &VoxelBatch,
    ) -> tch::Result<SceneFeatures> {
        let mut parts = vec![local.cells.shallow_clone()];
        if !self.config.context_m.is_empty() {
            let plane = CoarsePlane::new(&local.coarse, batch)?;
            for edge_m in &self.config.context_m {
                // Odd, so that the cell is in the centre.
                let window = 2 * (edge_m / self.config.coarse_cell_m() / 2.0).round() as i64 + 1;
                let context = rows(&plane.mean_over(window)?, &batch.columns)?;
                let context = context.to_kind(local.cells.kind());
                parts.push(rows(&context, &batch.coarse_of_cell)?);
            }
        }
        let sweeps = batch.coarse_rows.iter().map(|rows| {
            let own = local
                .coarse
                .f_narrow(0, rows.start, rows.end - rows.start)?;
            let own = own.f_to_kind(Kind::Float)?;
            // The mean of no rows is NaN, and their maximum an error.
            if own.size()[0] == 0 {
                return own.f_new_zeros([2 * own.size()[1]], (Kind::Float, own.device()));
            }
            let mean = own.f_mean_dim(0_i64, false, Kind::Float)?;
            Tensor::f_cat(&[mean, own.f_amax([0_i64], false)?], 0)
        });
        let sweeps: Vec<Tensor> = sweeps.collect::<Result<_, _>>()?;
        Ok(SceneFeatures {
            cells: Tensor::f_cat(&parts, 1)?,
            sweeps: Tensor::f_stack(&sweeps, 0)?,
        })
    }

    /// Both steps without gradients; in integers once [quantised](Self::quantise), otherwise in `kind`.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn encode(&self, batch: &VoxelBatch, kind: Kind) -> tch::Result<SceneFeatures> {
        no_grad(|| {
            let local = match &self.int8 {
                Some(levels) => {
                    let first = self.first.forward(&batch.input, &batch.first)?.f_relu_()?;
                    let (fine, coarse) = levels.forward(&first, batch)?;
                    LocalFeatures::new(fine, coarse, batch)?
                }
                None => self.local(batch, kind)?,
            };
            self.complete(&local, batch)
        })
    }
}

impl LocalFeatures {
    fn new(fine: Option<Tensor>, coarse: Tensor, batch: &VoxelBatch) -> tch::Result<Self> {
        let spread = rows(&coarse, &batch.coarse_of_cell)?;
        let cells = match fine {
            Some(fine) => Tensor::f_cat(&[fine, spread], 1)?,
            None => spread,
        };
        Ok(Self { cells, coarse })
    }
}

/// Name of the fine group among the activations.
const FINE: &str = "encoder.fine";

fn level_activation(level: usize) -> String {
    format!("encoder.levels.{level}")
}

fn coarse_activation(group: usize) -> String {
    format!("encoder.residual.{group}")
}

/// Coarse features summed over height into the plane of each sweep.
struct CoarsePlane {
    /// `[sweeps, channels, edge, edge]`.
    sum: Tensor,
    /// `[sweeps, 1, edge, edge]`: number of coarse cells above one another.
    count: Tensor,
}

impl CoarsePlane {
    fn new(coarse: &Tensor, batch: &VoxelBatch) -> tch::Result<Self> {
        let coarse = coarse.f_to_kind(Kind::Float)?;
        let ones = coarse.f_new_ones([coarse.size()[0], 1], (Kind::Float, coarse.device()))?;
        Ok(Self {
            sum: Self::sum_of(&coarse, batch)?,
            count: Self::sum_of(&ones, batch)?,
        })
    }

    /// `[sweeps, channels, edge, edge]` of values of coarse cells `[N, channels]`.
    fn sum_of(values: &Tensor, batch: &VoxelBatch) -> tch::Result<Tensor> {
        let (sweeps, edge) = (batch.cell_rows.len() as i64, batch.plane_edge);
        let channels = values.size()[1];
        let float = (Kind::Float, values.device());
        let empty = values.f_new_zeros([sweeps * edge * edge, channels], float)?;
        let index = batch.columns.f_unsqueeze(1)?;
        empty
            .f_scatter_add(0, &index.f_expand([-1, channels], false)?, values)?
            .f_view([sweeps, edge, edge, channels])?
            .f_permute([0, 3, 1, 2])
    }

    /// `[sweeps * edge * edge, channels]`: mean over the coarse cells in a square window.
    fn mean_over(&self, window: i64) -> tch::Result<Tensor> {
        // Sums over counts: the area of the window, with the padding, cancels. Empty windows are 0 / 1e-6.
        let sum = mean_over(&self.sum, [window; 2], true)?;
        let mean = sum / mean_over(&self.count, [window; 2], true)?.f_clamp_min(1e-6)?;
        let channels = mean.size()[1];
        mean.f_permute([0, 2, 3, 1])?.f_reshape([-1, channels])
    }
}

/// Mean of maps `[N, C, H, W]` over a window of an odd height and width around each cell, padded with zeros or, without
/// `counts_padding`, as far as it is on the map.
pub(super) fn mean_over(
    maps: &Tensor,
    [height, width]: [i64; 2],
    counts_padding: bool,
) -> tch::Result<Tensor> {
    let mut means = maps.shallow_clone();
    // One row after one column of the window: a fraction of the additions.
    for size in [[height, 1], [1, width]] {
        let padding = size.map(|edge| edge / 2);
        means = means.f_avg_pool2d(size, [1; 2], padding, false, counts_padding, None::<i64>)?;
    }
    Ok(means)
}

#[cfg(test)]
mod tests {
    use tch::nn::VarStore;

    use super::*;
    use crate::pgc::voxelise::SweepVoxels;

    fn sweep(shift: f32) -> Vec<[f32; 3]> {
        let wall = (0..3000).map(move |k| {
            [
                (k % 60) as f32 * 0.3 - 9.0,
                6.0 + shift,
                (k / 60) as f32 * 0.1 - 2.0,
            ]
        });
        wall.chain((0..400).map(|k| [(k % 20) as f32 - 10.0, (k / 20) as f32 - 10.0, -1.9]))
            .collect()
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
            let (a, b) = (
                SweepVoxels::new(sweep(0.0), &config),
                SweepVoxels::new(sweep(3.0), &config),
            );
            let both = VoxelBatch::new(&[&a, &b], &config, Device::Cpu).unwrap();
            let features = encoder.encode(&both, Kind::Float).unwrap();
            assert_eq!(
                features.cells.size(),
                [
                    (a.cells().len() + b.cells().len()) as i64,
                    config.cell_channels()
                ]
            );
            assert_eq!(features.sweeps.size(), [2, config.sweep_channels()]);
            let alone = VoxelBatch::new(&[&b], &config, Device::Cpu).unwrap();
            let alone = encoder.encode(&alone, Kind::Float).unwrap();
            let rows = &both.cell_rows[1];
            let same = features.cells.narrow(0, rows.start, rows.end - rows.start);
            assert!(same.allclose(&alone.cells, 1e-4, 1e-4, false));
            assert!(
                features
                    .sweeps
                    .get(1)
                    .allclose(&alone.sweeps.get(0), 1e-4, 1e-4, false)
            );
        }
    }

    #[test]
    fn features_do_not_change_when_the_world_moves_by_whole_coarse_cells() {
        let config = SceneEncoderConfig {
            context_m: vec![],
            ..SceneEncoderConfig::lean()
        };
        let (_network, encoder) = encoder(&config);
        let here = SweepVoxels::new(sweep(0.0), &config);
        let there = SweepVoxels::new(
            sweep(0.0)
                .into_iter()
                .map(|[x, y, z]| [x + 8.0, y - 4.0, z]),
            &config,
        );
        let [here, there] = [&here, &there].map(|sweep| {
            let batch = VoxelBatch::new(&[sweep], &config, Device::Cpu).unwrap();
            encoder.encode(&batch, Kind::Float).unwrap()
        });
        assert!(here.cells.allclose(&there.cells, 1e-3, 1e-3, false));
    }

    #[test]
    fn integers_change_the_features_little() {
        for config in [SceneEncoderConfig::lean(), SceneEncoderConfig::full(0.125)] {
            let (_network, mut encoder) = encoder(&config);
            let sweep = SweepVoxels::new(sweep(0.0), &config);
            let batch = VoxelBatch::new(&[&sweep], &config, Device::Cpu).unwrap();
            let expected = encoder.encode(&batch, Kind::Float).unwrap();
            let mut search = ScaleSearch::default();
            encoder.observe(&batch, &mut search).unwrap();
            no_grad(|| encoder.quantise(&search.scales())).unwrap();
            let found = encoder.encode(&batch, Kind::Float).unwrap();
            for (found, expected) in [
                (found.cells, expected.cells),
                (found.sweeps, expected.sweeps),
            ] {
                let error = (&found - &expected)
                    .square()
                    .mean(Kind::Float)
                    .sqrt()
                    .double_value(&[]);
                assert!(
                    error > 0.0 && error < 0.1 * expected.std(true).double_value(&[]),
                    "{error}"
                );
            }
        }
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
        encoder
            .local(&batch, Kind::BFloat16)
            .unwrap()
            .cells
            .square()
            .mean(Kind::Float)
            .backward();
        for (name, parameter) in network.variables() {
            assert!(
                parameter.grad().defined() && parameter.grad().abs().max().double_value(&[]) > 0.0,
                "{name}"
            );
        }
    }
}
