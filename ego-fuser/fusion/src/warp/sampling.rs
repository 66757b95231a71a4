//! Sampling: reads maps between their cells in plain floats, equal to `grid_sampler` on the CPU without gradients.
//!
//! The tensor library gathers the four cells around a position anew for every channel. Here a map is transposed first,
//! so that the channels of a cell are contiguous and are read together.

use tch::{Result, Tensor};

use crate::f64_tensor::{self, BLOCK, numbers};

/// A map with the channels of each cell contiguous.
#[derive(Debug)]
pub(super) struct Cells {
    /// `[height * width, channels]`.
    values: Vec<f32>,
    channels: usize,
    height: usize,
    width: usize,
}

/// `embedding_bag` adds rows.
pub(crate) const SUM: i64 = 0;

/// A position on a map: the four cells around it with their weights, which are zero beyond the edges.
#[derive(Clone, Copy)]
struct SampledPlace {
    cells: [usize; 4],
    weights: [f32; 4],
    /// The nearest cell, if it is on the map.
    nearest: Option<usize>,
}

impl Cells {
    /// Of a map `[C, H, W]` that is not empty.
    pub(super) fn of(map: &Tensor) -> Result<Self> {
        let (channels, height, width) = map.size3()?;
        let [channels, height, width] = [channels, height, width].map(|size| size as usize);
        Ok(Self {
            values: f64_tensor::cells(map)?,
            channels,
            height,
            width,
        })
    }

    /// The map `[C, h, w]` sampled bilinearly at `sampling_grid` `[h, w, 2]` (`grid_sampler`'s coordinates), and its validity
    /// `[1, h, w]` by the nearest cell of `valid` `[H, W]`. Zeros beyond the edges, and where cells are invalid.
    pub(super) fn read(&self, valid: &Tensor, sampling_grid: &Tensor) -> Result<(Tensor, Tensor)> {
        let (rows, columns, _) = sampling_grid.size3()?;
        let (valid, sampling_grid) = (numbers(valid)?, numbers(sampling_grid)?);
        let cells = (rows * columns) as usize;
        let (mut read, mut reached) = (vec![0.0; self.channels * cells], vec![0.0; cells]);
        let mut block = vec![0.0; BLOCK * self.channels];
        // Block by block: read cell by cell, then written plane by plane while the block is in the cache.
        for (index, (sampling_grid, reached)) in sampling_grid
            .chunks(2 * BLOCK)
            .zip(reached.chunks_mut(BLOCK))
            .enumerate()
        {
            let places = sampling_grid
                .chunks_exact(2)
                .zip(reached.iter_mut())
                .zip(block.chunks_mut(self.channels));
            places.for_each(|((at, reached), values)| {
                *reached = self.read_at([at[0], at[1]], &valid, values)
            });
            for (channel, plane) in read.chunks_mut(cells).enumerate() {
                let plane = plane[index * BLOCK..].iter_mut().take(reached.len());
                plane
                    .zip(block[channel..].iter().step_by(self.channels))
                    .for_each(|(cell, value)| *cell = *value);
            }
        }
        let read = Tensor::f_from_slice(&read)?.f_view([-1, rows, columns])?;
        let reached = Tensor::f_from_slice(&reached)?.f_view([1, rows, columns])?;
        Ok((read, reached))
    }

    /// The channels at a position, and the validity there.
    #[inline]
    fn read_at(&self, at: [f32; 2], valid: &[f32], values: &mut [f32]) -> f32 {
        let place = place(at, [self.height, self.width]);
        let valid = place.nearest.map_or(0.0, |nearest| valid[nearest]);
        if valid == 0.0 {
            values.fill(0.0);
            return valid;
        }
        let [a, b, c, d] = place
            .cells
            .map(|cell| &self.values[cell * self.channels..][..self.channels]);
        let [of_a, of_b, of_c, of_d] = place.weights.map(|weight| weight * valid);
        for ((((value, a), b), c), d) in values.iter_mut().zip(a).zip(b).zip(c).zip(d) {
            *value = of_a * a + of_b * b + of_c * c + of_d * d;
        }
        valid
    }
}

/// From -1..1 over the whole extent of a map, edges of the outer cells included.
#[inline]
fn place([x, y]: [f32; 2], [height, width]: [usize; 2]) -> SampledPlace {
    let columns = AxisCells::around(along(x, width), width);
    let rows = AxisCells::around(along(y, height), height);
    let ([top, bottom], [left, right]) = (rows.places, columns.places);
    let ([up, down], [before, behind]) = (rows.weights, columns.weights);
    let corners = [(top, left), (top, right), (bottom, left), (bottom, right)];
    let cell = |(row, column): (usize, usize)| row * width + column;
    SampledPlace {
        cells: corners.map(cell),
        weights: [up * before, up * behind, down * before, down * behind],
        nearest: rows.nearest.zip(columns.nearest).map(cell),
    }
}

/// Positions on maps whose channels are contiguous, as weighted sums of their cells: read in one pass, without a copy.
#[derive(Debug, Default)]
pub(crate) struct Samples {
    /// The cells of all sums, one sum after another.
    cells: Vec<i32>,
    weights: Vec<f32>,
    /// Index in `cells` at which each sum begins.
    first: Vec<i32>,
    /// Validity of each position by its nearest cell.
    pub(crate) valid: Vec<f32>,
}

impl Samples {
    /// Adds positions (two numbers each, `grid_sampler`'s coordinates) on a map of `size` whose cells begin at `first`,
    /// each times its share; absent: 1. They are valid as their nearest cell of `valid` `[H * W]`; others are zeros.
    pub(crate) fn add(
        &mut self,
        (first, size): (usize, [usize; 2]),
        valid: &[f32],
        places: &[f32],
        shares: Option<&[f32]>,
    ) {
        self.reserve(places.len() / 2);
        for (position, at) in places.chunks_exact(2).enumerate() {
            let place = place([at[0], at[1]], size);
            let valid = place.nearest.map_or(0.0, |nearest| valid[nearest]);
            let share = valid * shares.map_or(1.0, |shares| shares[position]);
            self.first.push(self.cells.len() as i32);
            self.valid.push(valid);
            for (cell, weight) in place.cells.into_iter().zip(place.weights) {
                // Cells without weight are left out. A sum of no cells is zero.
                if valid * weight != 0.0 {
                    self.cells.push((first + cell) as i32);
                    self.weights.push(weight * share);
                }
            }
        }
    }

    /// Adds all cells from `first` on as they are.
    pub(super) fn add_all(&mut self, first: usize, valid: &[f32]) {
        self.reserve(valid.len());
        for (cell, &valid) in (first..).zip(valid) {
            self.add_cell(Some(cell));
            self.valid.push(valid);
        }
    }

    /// Adds a cell as it is, without validity, or zeros.
    pub(crate) fn add_cell(&mut self, cell: Option<usize>) {
        self.first.push(self.cells.len() as i32);
        self.cells.extend(cell.map(|cell| cell as i32));
        self.weights.extend(cell.map(|_| 1.0));
    }

    fn reserve(&mut self, positions: usize) {
        self.cells.reserve(4 * positions);
        self.weights.reserve(4 * positions);
        self.first.reserve(positions);
        self.valid.reserve(positions);
    }

    /// `[positions, C]` of `cells` `[.., C]`.
    pub(crate) fn read(&self, cells: &Tensor) -> Result<Tensor> {
        let [places, first] = [&self.cells, &self.first].map(|rows| Tensor::f_from_slice(rows));
        let weights = Some(Tensor::f_from_slice(&self.weights)?);
        let (places, first) = (places?, first?);
        Tensor::f_embedding_bag(cells, &places, &first, false, SUM, false, weights, false)
            .map(|(sums, ..)| sums)
    }
}

/// Cells from the first one's centre, of -1..1 over all `size` of them.
fn along(at: f32, size: usize) -> f32 {
    ((at + 1.0) * size as f32 - 1.0) / 2.0
}

/// The two cells around a position along one axis.
struct AxisCells {
    /// Those nearest to them on the map.
    places: [usize; 2],
    /// Zero for one that is not on it.
    weights: [f32; 2],
    /// The nearer, if it is on the map; of two at equal distance the even one.
    nearest: Option<usize>,
}

impl AxisCells {
    #[inline]
    fn around(at: f32, size: usize) -> Self {
        // By hand, since the processor's own rounding is not available on every processor and a call per value would
        // dominate. NaN is a position beyond the edge, not the first cell.
        let at = if at.is_nan() { f32::NEG_INFINITY } else { at };
        let truncated = at as i32;
        let first = truncated.saturating_sub(i32::from(truncated as f32 > at));
        let (second, share) = (first.saturating_add(1), at - first as f32);
        let last = size as i32 - 1;
        let on_map = 0..=last;
        let is_second = share > 0.5 || (share == 0.5 && first & 1 != 0);
        let nearest = if is_second { second } else { first };
        Self {
            // Beyond the edge the weight is zero, and the clamped index can still be read.
            places: [first, second].map(|cell| cell.clamp(0, last) as usize),
            weights: [(first, 1.0 - share), (second, share)]
                .map(|(cell, weight)| if on_map.contains(&cell) { weight } else { 0.0 }),
            nearest: on_map.contains(&nearest).then_some(nearest as usize),
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_place_lies_between_the_cells_around_it(at in -9.0..20.0f32, size in 1..12usize) {
            let AxisCells { places, weights, nearest } = AxisCells::around(at, size);
            let on_map = |cell: f32| (0.0..size as f32).contains(&cell).then_some(cell as usize);
            let around = [at.floor(), at.floor() + 1.0];
            for ((place, weight), cell) in places.into_iter().zip(weights).zip(around) {
                match on_map(cell) {
                    Some(cell) => prop_assert!(place == cell && (weight - (1.0 - (at - cell as f32).abs())).abs() < 1e-5),
                    None => prop_assert!(place < size && weight == 0.0),
                }
            }
            prop_assert_eq!(nearest, on_map(at.round_ties_even()));
        }
    }

    #[test]
    fn half_way_the_even_cell_is_the_nearest_and_what_is_no_place_has_none() {
        assert_eq!(
            [0.5, 1.5, 2.5, -0.5, 3.5].map(|at| AxisCells::around(at, 4).nearest),
            [Some(0), Some(2), Some(2), Some(0), None]
        );
        for at in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 3e9, -3e9] {
            let cells = AxisCells::around(at, 4);
            assert_eq!(cells.nearest, None);
            assert_eq!(cells.weights.map(|weight| weight == 0.0), [true; 2]);
        }
    }
}
