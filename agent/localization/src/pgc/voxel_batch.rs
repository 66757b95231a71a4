//! Batch of sweeps as the tensors of one forward pass.

use std::ops::Range;

use perception::tensor_values::tensor;
use tch::{Device, Tensor};

use super::encoder_config::SceneEncoderConfig;
use super::voxelise::{SweepVoxels, plane_edge};
use perception::sparse::{GatherIndex, Rulebook};

/// One or more sweeps, their rows one after another. Sweeps do not influence each other.
#[derive(Debug)]
pub struct VoxelBatch {
    pub(super) input: Tensor,
    pub(super) first: GatherIndex,
    pub(super) down: Vec<GatherIndex>,
    pub(super) fine: Option<GatherIndex>,
    pub(super) coarse: GatherIndex,
    /// `[cells]` of rows of the last level.
    pub(super) coarse_of_cell: Tensor,
    /// `[rows of the last level]`: index into the planes of all sweeps.
    pub(super) columns: Tensor,
    /// Edge of a plane, cells of the last level.
    pub(super) plane_edge: i64,
    /// Rows of the last level by sweep.
    pub(super) coarse_rows: Vec<Range<i64>>,
    /// Rows of the cells by sweep.
    pub cell_rows: Vec<Range<i64>>,
}

impl VoxelBatch {
    /// Builds the batch.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn new(
        sweeps: &[&SweepVoxels],
        config: &SceneEncoderConfig,
        device: Device,
    ) -> tch::Result<Self> {
        let input: Vec<f32> = sweeps
            .iter()
            .flat_map(|sweep| &sweep.input)
            .copied()
            .collect();
        let down = (0..config.levels() - 1)
            .map(|level| Rulebook::stacked(sweeps.iter().map(|sweep| &sweep.down[level]), device))
            .collect::<Result<_, _>>()?;
        let fine = sweeps.iter().filter_map(|sweep| sweep.fine.as_ref());
        let fine = config.fine_cells.then(|| Rulebook::stacked(fine, device));
        let edge = i64::from(plane_edge(config));
        let coarse_rows = ranges(sweeps.iter().map(|sweep| sweep.columns.len()));
        let planes = (0..sweeps.len() as i64).map(|sweep| sweep * edge * edge);
        let columns = sweeps.iter().map(|sweep| sweep.columns.as_slice());
        let starts = coarse_rows.iter().map(|rows| rows.start);
        let rows = sweeps.iter().map(|sweep| sweep.coarse_of_cell.as_slice());
        Ok(Self {
            input: tensor(&input, &[-1, config.input.channels()], device)?,
            first: Rulebook::stacked(sweeps.iter().map(|sweep| &sweep.first), device)?,
            down,
            fine: fine.transpose()?,
            coarse: Rulebook::stacked(sweeps.iter().map(|sweep| &sweep.coarse), device)?,
            coarse_of_cell: shifted(rows.zip(starts), device)?,
            columns: shifted(columns.zip(planes), device)?,
            plane_edge: edge,
            coarse_rows,
            cell_rows: ranges(sweeps.iter().map(|sweep| sweep.cells.len())),
        })
    }
}

/// Rows of sweeps one after another, which have so many each.
pub(super) fn ranges(counts: impl Iterator<Item = usize>) -> Vec<Range<i64>> {
    let mut end = 0;
    let ranges = counts.map(|count| {
        let start = end;
        end += count as i64;
        start..end
    });
    ranges.collect()
}

/// Rows of sweeps one after another, those of each plus its shift.
fn shifted<'a>(
    sweeps: impl Iterator<Item = (&'a [u32], i64)>,
    device: Device,
) -> tch::Result<Tensor> {
    let rows = sweeps.flat_map(|(rows, shift)| rows.iter().map(move |&row| shift + i64::from(row)));
    tensor(&rows.collect::<Vec<_>>(), &[-1], device)
}
