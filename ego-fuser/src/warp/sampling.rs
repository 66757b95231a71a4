//! Maps read between their cells, in numbers: what `grid_sampler` does with floats on the CPU where no gradient is wanted.
//!
//! The tensor library collects the four cells around a place anew for every channel. Here a map is transposed first, so that
//! the channels of a cell lie together and are read in one go.

use tch::{TchError, Tensor};

use crate::numbers::{self, BLOCK, numbers};

/// A map with the channels of each cell together.
pub(crate) struct Cells {
    /// `[height * width, channels]`.
    values: Vec<f32>,
    channels: usize,
    height: usize,
    width: usize,
}

/// How the numbers of what is read lie in memory; they are the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Order {
    /// A channel after another.
    Planes,
    /// A cell after another.
    Cells,
}

/// A place on a map: the four cells around it with their weights, none beyond the edges.
#[derive(Clone, Copy)]
struct Place {
    cells: [usize; 4],
    weights: [f32; 4],
    /// The nearest cell, where that is on the map.
    nearest: Option<usize>,
}

impl Cells {
    /// Of a map `[C, H, W]` that is not empty.
    pub(crate) fn of(map: &Tensor) -> Result<Self, TchError> {
        let (channels, height, width) = map.size3()?;
        let [channels, height, width] = [channels, height, width].map(|size| size as usize);
        Ok(Self { values: numbers::cells(map)?, channels, height, width })
    }

    /// The map `[C, h, w]` read bilinearly at `lattice` `[h, w, 2]` (`grid_sampler`'s coordinates), and what is valid there
    /// `[1, h, w]` by the nearest cell of `valid` `[H, W]`. Zeros beyond the edges, and where nothing is valid.
    pub(super) fn read(&self, valid: &Tensor, lattice: &Tensor, order: Order) -> Result<(Tensor, Tensor), TchError> {
        let (rows, columns, _) = lattice.size3()?;
        let (valid, lattice) = (numbers(valid)?, numbers(lattice)?);
        let cells = (rows * columns) as usize;
        let (mut read, mut reached) = (vec![0.0; self.channels * cells], vec![0.0; cells]);
        if order == Order::Cells {
            let places = lattice.chunks_exact(2).zip(&mut reached).zip(read.chunks_mut(self.channels));
            places.for_each(|((at, reached), values)| *reached = self.read_at([at[0], at[1]], &valid, values));
            let read = Tensor::f_from_slice(&read)?.f_view([rows, columns, -1])?.f_permute([2, 0, 1])?;
            return Ok((read, Tensor::f_from_slice(&reached)?.f_view([1, rows, columns])?));
        }
        let mut block = vec![0.0; BLOCK * self.channels];
        for (index, (lattice, reached)) in lattice.chunks(2 * BLOCK).zip(reached.chunks_mut(BLOCK)).enumerate() {
            let places = lattice.chunks_exact(2).zip(reached.iter_mut()).zip(block.chunks_mut(self.channels));
            places.for_each(|((at, reached), values)| *reached = self.read_at([at[0], at[1]], &valid, values));
            for (channel, plane) in read.chunks_mut(cells).enumerate() {
                let plane = plane[index * BLOCK..].iter_mut().take(reached.len());
                plane.zip(block[channel..].iter().step_by(self.channels)).for_each(|(cell, value)| *cell = *value);
            }
        }
        let read = Tensor::f_from_slice(&read)?.f_view([-1, rows, columns])?;
        Ok((read, Tensor::f_from_slice(&reached)?.f_view([1, rows, columns])?))
    }

    /// Raises `strongest` `[h * w, C]` to what the map shows at `lattice` `[h, w, 2]`, times `shares` `[h, w]`, where
    /// that is more, and where the nearest cell of `valid` `[H, W]` says that it shows something.
    pub(crate) fn raise(&self, strongest: &mut [f32], [valid, lattice, shares]: [&Tensor; 3]) -> Result<(), TchError> {
        let (valid, lattice, shares) = (numbers(valid)?, numbers(lattice)?, numbers(shares)?);
        let mut shown = vec![0.0; self.channels];
        for ((strongest, at), share) in
            strongest.chunks_exact_mut(self.channels).zip(lattice.chunks_exact(2)).zip(shares)
        {
            if self.read_at([at[0], at[1]], &valid, &mut shown) != 0.0 {
                strongest.iter_mut().zip(&shown).for_each(|(most, shown)| *most = most.max(share * shown));
            }
        }
        Ok(())
    }

    /// The channels at a place, and what is valid there.
    fn read_at(&self, at: [f32; 2], valid: &[f32], values: &mut [f32]) -> f32 {
        let place = self.place(at);
        let valid = place.nearest.map_or(0.0, |nearest| valid[nearest]);
        self.read_cell(&place, valid, values);
        valid
    }

    fn read_cell(&self, place: &Place, valid: f32, values: &mut [f32]) {
        values.fill(0.0);
        for (cell, weight) in place.cells.iter().zip(place.weights) {
            let weight = weight * valid;
            if weight != 0.0 {
                let shown = &self.values[cell * self.channels..][..self.channels];
                values.iter_mut().zip(shown).for_each(|(value, shown)| *value += weight * shown);
            }
        }
    }

    /// From -1..1 over the whole extent of the map, edges of the outer cells included.
    fn place(&self, [x, y]: [f32; 2]) -> Place {
        let along = |at: f32, size: usize| ((at + 1.0) * size as f32 - 1.0) / 2.0;
        let (x, y) = (along(x, self.width), along(y, self.height));
        let (column, row) = (x.floor(), y.floor());
        let (right, below) = (x - column, y - row);
        let corner = |down: f32, across: f32, weight: f32| match self.cell(row + down, column + across) {
            Some(cell) => (cell, weight),
            None => (0, 0.0),
        };
        let corners = [
            corner(0.0, 0.0, (1.0 - below) * (1.0 - right)),
            corner(0.0, 1.0, (1.0 - below) * right),
            corner(1.0, 0.0, below * (1.0 - right)),
            corner(1.0, 1.0, below * right),
        ];
        let nearest = self.cell(y.round_ties_even(), x.round_ties_even());
        Place { cells: corners.map(|(cell, _)| cell), weights: corners.map(|(_, weight)| weight), nearest }
    }

    fn cell(&self, row: f32, column: f32) -> Option<usize> {
        let is_on_map = row >= 0.0 && row < self.height as f32 && column >= 0.0 && column < self.width as f32;
        is_on_map.then(|| row as usize * self.width + column as usize)
    }
}
