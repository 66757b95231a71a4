//! Selection of the cells in which earlier maps are blended in.

use tch::{Kind, Result, Tensor};

use crate::f64_tensor::{largest, numbers};

/// A cell and its eight neighbours.
pub(super) const AROUND: i64 = 9;
/// Margin around a patch, cells, whose likelihood counts as the patch's own: one cell gives the presence of a vehicle,
/// others its outline.
const MARGIN_CELLS: i64 = 2;

/// The cells of a few patches, patch by patch and row by row, and their neighbours.
#[derive(Debug)]
pub(super) struct BlendedCells {
    /// `K`: their patches, counted row by row.
    pub(super) patches: Vec<i64>,
    /// `P`: the cells of those, counted row by row.
    pub(super) cells: Vec<i64>,
    /// `R`: row and column of these cells and of their neighbours, each once, in the order of the grid.
    pub(super) near: Vec<[usize; 2]>,
    /// `P * 9`: for each cell the indices in `near` of the cells around it, row by row; `R` for cells beyond the edge.
    pub(super) around: Vec<i64>,
}

impl BlendedCells {
    /// Up to a `share` of all patches of `patch` cells along each edge, at least one: those with the highest likelihood
    /// of a vehicle in or close to them by `likely` `[1, 1, H, W]`, and `least`. H and W are multiples of `patch`.
    pub(super) fn most_likely(likely: &Tensor, patch: i64, share: f64, least: f32) -> Result<Self> {
        let (_, _, height, width) = likely.size4()?;
        let (window, margin) = ([patch + 2 * MARGIN_CELLS; 2], [MARGIN_CELLS; 2]);
        let by_patch = likely.f_max_pool2d(window, [patch; 2], margin, [1, 1], false)?;
        let by_patch = numbers(&by_patch.f_to_kind(Kind::Float)?)?;
        let chosen = largest(&by_patch, share, least, 1);
        let size = [height, width].map(|cells| cells as usize);
        Ok(Self::of(&chosen, patch as usize, size))
    }

    fn of(patches: &[usize], patch: usize, size: [usize; 2]) -> Self {
        let [height, width] = size;
        let cells = patches.iter().flat_map(|index| {
            let across = width / patch;
            let (row, column) = (index / across * patch, index % across * patch);
            (row..row + patch)
                .flat_map(move |row| (column..column + patch).map(move |column| [row, column]))
        });
        let cells: Vec<[usize; 2]> = cells.collect();
        // First marked, then numbered in the order of the grid, so that shared neighbours are read once.
        let mut place = vec![None; height * width];
        for cell in cells.iter().flat_map(|&cell| beside(cell, size)).flatten() {
            place[cell] = Some(0);
        }
        let mut near = Vec::new();
        for (cell, place) in place.iter_mut().enumerate() {
            if let Some(place) = place {
                *place = near.len() as i64;
                near.push([cell / width, cell % width]);
            }
        }
        let around = cells.iter().flat_map(|&cell| beside(cell, size));
        let around = around.map(|cell| cell.and_then(|cell| place[cell]));
        Self {
            patches: patches.iter().map(|&patch| patch as i64).collect(),
            around: around
                .map(|place| place.unwrap_or(near.len() as i64))
                .collect(),
            cells: cells
                .iter()
                .map(|[row, column]| (row * width + column) as i64)
                .collect(),
            near,
        }
    }
}

/// The nine cells in and around one of a map of a size, counted row by row; `None` beyond the edge.
fn beside([row, column]: [usize; 2], [height, width]: [usize; 2]) -> [Option<usize>; 9] {
    std::array::from_fn(|place| {
        // Row by row from the cell above and to the left, hence one less.
        let row = (row + place / 3).checked_sub(1)?;
        let column = (column + place % 3).checked_sub(1)?;
        (row < height && column < width).then_some(row * width + column)
    })
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;

    #[test]
    fn patches_around_what_is_likely_are_chosen() {
        let likely = Tensor::zeros([1, 1, 16, 24], (Kind::Float, Device::Cpu));
        let _ = likely.get(0).get(0).get(7).get(11).fill_(1.0);
        // Four cells along each edge: within two cells of it lie the patches in rows 1 and 2, columns 2 and 3.
        let all = f32::NEG_INFINITY;
        let selection = BlendedCells::most_likely(&likely, 4, 4.0 / 24.0, all).unwrap();
        assert_eq!(selection.patches, [8, 9, 14, 15]);
        assert_eq!(
            (selection.cells.len(), selection.around.len()),
            (64, 64 * 9)
        );
        assert_eq!(
            &selection.cells[..6],
            [
                4 * 24 + 8,
                4 * 24 + 9,
                4 * 24 + 10,
                4 * 24 + 11,
                5 * 24 + 8,
                5 * 24 + 9
            ]
        );
        // One cell more on each side.
        assert_eq!(selection.near.len(), 100);
        assert_eq!((selection.near[0], selection.near[99]), ([3, 7], [12, 16]));
        assert_eq!(selection.around[..9], [0, 1, 2, 10, 11, 12, 20, 21, 22]);
    }

    #[test]
    fn beyond_the_edges_is_nothing() {
        let selection = BlendedCells::of(&[0, 5], 2, [4, 6]);
        assert_eq!(selection.near.len(), 3 * 3 + 3 * 3);
        let beyond = selection.near.len() as i64;
        assert_eq!(
            selection.around[..9],
            [beyond, beyond, beyond, beyond, 0, 1, beyond, 3, 4]
        );
        assert_eq!(
            selection.around[7 * 9..],
            [13, 14, beyond, 16, 17, beyond, beyond, beyond, beyond]
        );
    }

    #[test]
    fn there_is_always_one_and_never_more_than_all() {
        let likely = Tensor::full([1, 1, 4, 4], f64::NAN, (Kind::Float, Device::Cpu));
        for (share, count) in [(0.0, 1), (0.3, 2), (1.0, 4), (9.0, 4), (f64::NAN, 1)] {
            assert_eq!(
                BlendedCells::most_likely(&likely, 2, share, f32::NEG_INFINITY)
                    .unwrap()
                    .patches
                    .len(),
                count
            );
        }
    }
}
