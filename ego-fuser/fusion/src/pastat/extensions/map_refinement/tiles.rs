//! Tiles of a map: the squares of cells in which it is refined.

use tch::{Kind, TchError, Tensor};

use crate::f64_tensor::{largest, numbers};
use crate::pastat::extensions::LEAST_LIKELY;
use crate::warp::Samples;

/// Edge of a tile, cells.
const EDGE: i64 = 8;
/// Cells around a tile on which two 3x3 convolutions depend.
const MARGIN: i64 = 2;
/// Cells around a tile on which the second depends.
const HIDDEN_MARGIN: i64 = 1;
/// Cells around a tile whose likelihood counts as its own.
const NEAR: i64 = 2;
/// Numbers of tiles are multiples of this: the tensor library generates code for each number.
const STEP: usize = 4;

/// Tiles of a map, by row and column of their first cells.
#[derive(Debug, PartialEq)]
pub(super) struct Tiles {
    first_cells: Vec<[i64; 2]>,
    /// Height and width of the map, multiples of [`EDGE`].
    size: [i64; 2],
}

impl Tiles {
    /// Up to a `share` of all tiles, at least one: those in or near which a vehicle is most likely by `likely`
    /// `[1, 1, H, W]`, and at least [`LEAST_LIKELY`].
    pub(super) fn most_likely(likely: &Tensor, share: f64) -> Result<Self, TchError> {
        let (_, _, height, width) = likely.size4()?;
        // Windows overlap by the margin. The padding of a maximum is minus infinity and never wins.
        let window = EDGE + 2 * NEAR;
        let by_tile = likely.f_max_pool2d([window; 2], [EDGE; 2], [NEAR; 2], [1, 1], false)?;
        let by_tile = numbers(&by_tile.f_to_kind(Kind::Float)?)?;
        let all = Self::all([height, width]).first_cells;
        let chosen = largest(&by_tile, share, LEAST_LIKELY, STEP);
        Ok(Self {
            first_cells: chosen.into_iter().map(|tile| all[tile]).collect(),
            size: [height, width],
        })
    }

    /// All tiles of a map.
    pub(super) fn all(size: [i64; 2]) -> Self {
        let [rows, columns] = size.map(|cells| (0..cells).step_by(EDGE as usize));
        let first_cells = rows
            .flat_map(|row| columns.clone().map(move |column| [row, column]))
            .collect();
        Self { first_cells, size }
    }

    /// True if a map consists of whole tiles.
    pub(super) fn fit(size: [i64; 2]) -> bool {
        size.iter().all(|cells| *cells > 0 && cells % EDGE == 0)
    }

    /// The tiles of a map `[H * W, C]` with the cells around them, channels innermost in memory:
    /// `[K, C, EDGE + 4, EDGE + 4]`; zeros beyond the edges of the map.
    pub(super) fn cut(&self, cells: &Tensor) -> Result<Tensor, TchError> {
        let mut samples = Samples::default();
        self.cells(MARGIN)
            .for_each(|cell| samples.add_cell(cell.map(|cell| cell as usize)));
        let edge = EDGE + 2 * MARGIN;
        let tiles = samples
            .read(cells)?
            .f_view([-1, edge, edge, cells.size2()?.1])?;
        tiles.f_permute([0, 3, 1, 2])
    }

    /// Indices of the cells of all tiles and of so many cells around them; `None` beyond the edges of the map.
    fn cells(&self, margin: i64) -> impl Iterator<Item = Option<i64>> {
        let [height, width] = self.size;
        self.first_cells.iter().flat_map(move |&[row, column]| {
            (row - margin..row + EDGE + margin).flat_map(move |row| {
                let is_row = (0..height).contains(&row);
                (column - margin..column + EDGE + margin).map(move |column| {
                    (is_row && (0..width).contains(&column)).then_some(row * width + column)
                })
            })
        })
    }

    /// `[K, 1, EDGE + 2, EDGE + 2]`, `u8`: 1 on the map and 0 beyond its edges, where the second convolution is padded.
    pub(super) fn hidden_mask(&self) -> Result<Tensor, TchError> {
        let edge = EDGE + 2 * HIDDEN_MARGIN;
        let cells = self.cells(HIDDEN_MARGIN);
        let masks: Vec<u8> = cells.map(|cell| u8::from(cell.is_some())).collect();
        Tensor::f_from_slice(&masks)?.f_view([-1, 1, edge, edge])
    }

    /// Adds `[K, C, EDGE, EDGE]` to the tiles of a map `[1, C, H, W]`.
    pub(super) fn add_to(&self, map: &Tensor, changes: &Tensor) -> Result<(), TchError> {
        for (tile, &[row, column]) in (0..).zip(&self.first_cells) {
            let mut place = map.f_narrow(2, row, EDGE)?.f_narrow(3, column, EDGE)?;
            let _ = place.f_add_(&changes.f_narrow(0, tile, 1)?)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;

    #[test]
    fn tiles_near_what_is_likely_are_chosen() {
        let likely = Tensor::zeros([1, 1, 16, 24], (Kind::Float, Device::Cpu));
        let _ = likely.get(0).get(0).get(7).get(9).fill_(1.0);
        // Row 7 and column 9 are in the first row and second column of tiles and near three others.
        let tiles = Tiles::most_likely(&likely, 4.0 / 6.0).unwrap();
        assert_eq!(tiles.first_cells, [[0, 0], [0, 8], [8, 0], [8, 8]]);
        assert_eq!(
            Tiles::most_likely(&likely, 0.0).unwrap().first_cells.len(),
            1
        );
        assert!(Tiles::fit([16, 24]) && !Tiles::fit([16, 20]) && !Tiles::fit([0, 8]));
    }

    #[test]
    fn what_is_cut_and_added_is_in_its_place() {
        let map = Tensor::arange(16 * 16, (Kind::Float, Device::Cpu)).view([1, 1, 16, 16]);
        let tiles = Tiles::all([16, 16]);
        let sum = &map + 1.0;
        let cut = tiles.cut(&sum.view([-1, 1])).unwrap();
        assert_eq!(cut.size(), [4, 1, 12, 12]);
        assert_eq!(
            (
                cut.double_value(&[0, 0, 1, 1]),
                cut.double_value(&[3, 0, 2, 2])
            ),
            (0.0, 8.0 * 16.0 + 8.0 + 1.0)
        );
        let mask = tiles.hidden_mask().unwrap();
        assert_eq!(
            [
                mask.int64_value(&[0, 0, 0, 5]),
                mask.int64_value(&[0, 0, 9, 9])
            ],
            [0, 1]
        );
        assert_eq!(
            [
                mask.int64_value(&[3, 0, 0, 0]),
                mask.int64_value(&[3, 0, 9, 1])
            ],
            [1, 0]
        );
        tiles
            .add_to(&sum, &cut.narrow(2, 2, 8).narrow(3, 2, 8))
            .unwrap();
        assert_eq!(sum, (&map + 1.0) * 2.0);
    }
}
