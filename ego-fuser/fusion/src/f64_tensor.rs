//! Tensor conversion: tensors as slices of floats, for loops whose memory order the tensor library does not offer.

use std::cmp::Ordering;

use tch::{Device, Kind, TchError, Tensor, nn};

/// Memory order of feature maps `[N, C, H, W]`; the values are the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Order {
    /// A channel after another.
    Planes,
    /// A cell after another.
    Cells,
}

/// Cells that are transposed together; their data fit into a core's L1 cache.
pub(crate) const BLOCK: usize = 16;

/// Values of a float tensor, row-major.
pub(crate) fn numbers(tensor: &Tensor) -> Result<Vec<f32>, TchError> {
    Vec::try_from(tensor.f_reshape(-1)?)
}

/// Indices of the highest numbers in ascending order: as many as are not below `least`, rounded up to a multiple of
/// `step`, but at most a `share` of all, and at least one.
pub(crate) fn largest(numbers: &[f32], share: f64, least: f32, step: usize) -> Vec<usize> {
    // NaN is not below anything, so it counts.
    let above = numbers
        .iter()
        .filter(|number| number.partial_cmp(&&least) != Some(Ordering::Less))
        .count();
    let most = (numbers.len() as f64 * share).ceil() as usize;
    let likely = above.next_multiple_of(step);
    let wanted = most.min(likely).clamp(1, numbers.len());
    let mut order: Vec<usize> = (0..numbers.len()).collect();
    order.sort_by(|a, b| numbers[*b].total_cmp(&numbers[*a]));
    order.truncate(wanted);
    order.sort_unstable();
    order
}

/// True if loops over plain floats may replace the tensor library's operations.
pub(crate) fn are_numbers(tensor: &Tensor) -> bool {
    tensor.device() == Device::Cpu
        && tensor.kind() == Kind::Float
        && tensor.numel() > 0
        && !tensor.requires_grad()
}

/// Values of a float map `[C, H, W]`, cell by cell: `[H * W, C]`.
pub(crate) fn cells(map: &Tensor) -> Result<Vec<f32>, TchError> {
    let (channels, height, width) = map.size3()?;
    let cell_after_cell = map.f_permute([1, 2, 0])?;
    if cell_after_cell.is_contiguous() {
        return numbers(&cell_after_cell);
    }
    let [channels, count] = [channels, height * width].map(|size| size as usize);
    let planes = numbers(map)?;
    let mut values = vec![0.0; planes.len()];
    for (block, values) in values.chunks_mut(BLOCK * channels).enumerate() {
        for (channel, plane) in planes.chunks(count).enumerate() {
            let cells = plane[block * BLOCK..]
                .iter()
                .zip(values[channel..].iter_mut().step_by(channels));
            cells.for_each(|(cell, value)| *value = *cell);
        }
    }
    Ok(values)
}

/// `[1, C, H, W]` of a map `[C, H, W]` with the channels of a cell contiguous in memory (channels last), the fastest
/// layout for convolutions over few channels; the layout is unchanged where gradients flow.
pub(crate) fn by_cell(map: &Tensor) -> Result<Tensor, TchError> {
    if !are_numbers(map) {
        return map.f_unsqueeze(0);
    }
    let (channels, height, width) = map.size3()?;
    Tensor::f_from_slice(&cells(map)?)?
        .f_view([1, height, width, channels])?
        .f_permute([0, 3, 1, 2])
}

/// A 1x1 convolution of maps `[N, C, H, W]` in their memory order: with channels last it is one matrix product.
pub(crate) fn pointwise(convolution: &nn::Conv2D, maps: &Tensor) -> Result<Tensor, TchError> {
    let cells = maps.f_permute([0, 2, 3, 1])?;
    let (weight, bias) = (&convolution.ws, convolution.bs.as_ref());
    if !cells.is_contiguous() || maps.is_contiguous() {
        return maps.f_conv2d(weight, bias, [1, 1], [0, 0], [1, 1], 1);
    }
    cells
        .f_linear(&weight.f_flatten(1, 3)?, bias)?
        .f_permute([0, 3, 1, 2])
}

/// Some rows of a tensor.
pub(crate) fn picked(tensor: &Tensor, rows: &[i64]) -> Result<Tensor, TchError> {
    let rows = Tensor::f_from_slice(rows)?.f_to_device(tensor.device())?;
    tensor.f_index_select(0, &rows)
}

/// The sum over the first dimension.
pub(crate) fn sum_over_first(tensor: &Tensor) -> Result<Tensor, TchError> {
    tensor.f_sum_dim_intlist([0_i64].as_slice(), false, None)
}

/// The tensors one after another along the first dimension; a single one is not copied.
pub fn one_after_another(tensors: &[Tensor]) -> Result<Tensor, TchError> {
    match tensors {
        [only] => Ok(only.shallow_clone()),
        tensors => Tensor::f_cat(tensors, 0),
    }
}

/// Column and row of each cell of a square relative to that in its middle, up to `radius` away, row by row.
pub(crate) fn offsets_around(radius: i64) -> Vec<i64> {
    let side = -radius..=radius;
    side.clone()
        .flat_map(|row| side.clone().flat_map(move |column| [column, row]))
        .collect()
}

/// Maps of the size of `maps` `[N, C, H, W]` in a memory order, not filled.
pub(crate) fn with_order(maps: &Tensor, order: Order) -> Result<Tensor, TchError> {
    let (count, channels, height, width) = maps.size4()?;
    let options = (maps.kind(), maps.device());
    match order {
        Order::Planes => Tensor::f_empty([count, channels, height, width], options),
        Order::Cells => {
            Tensor::f_empty([count, height, width, channels], options)?.f_permute([0, 3, 1, 2])
        }
    }
}

/// `[1, C, H, W]` of a map `[C, H, W]` in its memory order, such that convolutions use that order.
pub fn as_batch(map: &Tensor) -> Result<Tensor, TchError> {
    // By way of [H, W, C]: a dimension in front of [C, H, W] gets the stride C, which hides its memory order.
    map.f_permute([1, 2, 0])?
        .f_unsqueeze(0)?
        .f_permute([0, 3, 1, 2])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_data::uniform;

    #[test]
    fn a_convolution_of_cells_is_the_same_in_either_order() {
        let variables = nn::VarStore::new(Device::Cpu);
        let convolution = nn::conv2d(variables.root(), 5, 3, 1, nn::ConvConfig::default());
        let map = uniform(3, &[5, 6, 7]);
        let [planes, cells] = [map.unsqueeze(0), by_cell(&map).unwrap()];
        let [planes, cells] = [planes, cells].map(|maps| pointwise(&convolution, &maps).unwrap());
        assert!(planes.allclose(&cells, 1e-6, 1e-6, false));
        assert!(cells.allclose(
            &by_cell(&map).unwrap().apply(&convolution),
            1e-5,
            1e-5,
            false
        ));
    }

    #[test]
    fn a_map_by_cell_is_the_same_map_in_another_order() {
        let map = uniform(3, &[5, 6, 7]);
        let by_cell = by_cell(&map).unwrap();
        assert_eq!(by_cell, map.unsqueeze(0));
        assert_eq!(by_cell.stride()[1..], [1, 7 * 5, 5]);
        assert_eq!(
            as_batch(&by_cell.squeeze_dim(0)).unwrap().stride(),
            [6 * 7 * 5, 1, 7 * 5, 5]
        );
        assert_eq!(as_batch(&map).unwrap(), map.unsqueeze(0));
    }
}
