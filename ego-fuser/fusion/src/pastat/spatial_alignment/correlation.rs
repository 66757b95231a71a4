//! Correlation of a neighbour's feature map with the ego's at every shift, part by part of the BEV grid.

use std::cell::OnceCell;

use multiversion::multiversion;
use tch::{Kind, Result, Tensor};

use crate::f64_tensor::{are_numbers, numbers, offsets_around, sum_over_first};
use crate::vector_loops::{LANES, add_products};

/// Parts of the grid along each edge: enough to distinguish a rotation from a shift.
pub(crate) const PARTS: i64 = 4;
/// Prevents division by the norm of an empty part.
const EPSILON: f64 = 1e-6;
/// Up to this number of maps, sums in plain floats are faster than a matrix product with the map at every shift, which
/// has to be written out first.
const FEW_MAPS: i64 = 4;

/// Similarity of maps, by shift.
pub(crate) struct Correlation {
    /// `[parts^2, N, K]`: -1..1, of each part.
    pub parts: Tensor,
    /// `[parts^2, N]`: signal energy in both maps.
    pub energy: Tensor,
    /// `[N, K]`: of the whole grid.
    pub whole: Tensor,
}

/// The shifts in the order of [`Correlation`], `[K, 2]`: cells along x and y from a cell of a neighbour's map to the
/// cell of the ego's that it is compared with.
pub(crate) fn shifts(radius: i64) -> Result<Tensor> {
    Tensor::f_from_slice(&offsets_around(radius))?
        .f_view([-1, 2])?
        .f_to_kind(Kind::Float)
}

/// The ego's map, prepared for comparisons at every shift, part by part.
#[derive(Debug)]
pub(crate) struct Shifted {
    /// `[M, H + 2 radius, W + 2 radius]`: the map with zeros around.
    around: Tensor,
    /// The same in plain floats, where those are possible.
    numbers: Option<Vec<f32>>,
    /// `[parts^2, K, M * H/parts * W/parts]`: the map at every shift, once it is needed.
    maps: OnceCell<Tensor>,
    /// `[parts^2]`: sums of the squares of the unshifted map.
    squares: Tensor,
    radius: i64,
    parts: i64,
}

impl Shifted {
    /// `ego` `[1, M, H, W]`, `H` and `W` multiples of `parts`, moved by up to `radius` cells, in `parts` parts along
    /// each edge. No gradient flows into it: the same layers learn from the other map.
    pub(crate) fn new(ego: &Tensor, radius: i64, parts: i64) -> Result<Self> {
        let ego = ego.f_detach()?;
        let around = ego.f_constant_pad_nd([radius; 4])?.f_squeeze_dim(0)?;
        let numbers = are_numbers(&around).then(|| numbers(&around));
        let squares = sum_by_part(&ego.f_square()?, parts)?.f_squeeze_dim(1)?;
        Ok(Self {
            numbers: numbers.transpose()?,
            around,
            maps: OnceCell::new(),
            squares,
            radius,
            parts,
        })
    }

    /// Compares it with the maps of `others`, `[N, M, H, W]`.
    pub(crate) fn correlate(&self, others: &Tensor) -> Result<Correlation> {
        let products = match &self.numbers {
            Some(own) if are_numbers(others) && others.size4()?.0 <= FEW_MAPS => {
                self.sums(own, others)?
            }
            _ => by_part(others, self.parts)?.f_matmul(&self.maps()?.f_transpose(1, 2)?)?,
        };
        let theirs = sum_by_part(&others.f_square()?, self.parts)?;
        // Normalised by the ego's unshifted map: what a shift moves across the edges of a part is neglected.
        let energy = self.squares.f_unsqueeze(1)? * &theirs;
        let energy = energy.f_add_scalar(EPSILON)?.f_sqrt()?;
        let whole_energy = self.squares.f_sum(None::<Kind>)? * sum_over_first(&theirs)?;
        let whole_energy = whole_energy.f_add_scalar(EPSILON)?.f_sqrt()?;
        Ok(Correlation {
            parts: &products / energy.f_unsqueeze(2)?,
            whole: sum_over_first(&products)? / whole_energy.f_unsqueeze(1)?,
            energy,
        })
    }

    /// `[parts^2, K, M * H/parts * W/parts]`: the map at every shift.
    fn maps(&self) -> Result<&Tensor> {
        if let Some(maps) = self.maps.get() {
            return Ok(maps);
        }
        let (channels, height, width) = self.around.size3()?;
        let [height, width] = [height, width].map(|length| length - 2 * self.radius);
        let (parts, edge) = (self.parts, 2 * self.radius + 1);
        let (rows, columns) = (height / parts, width / parts);
        // [M, edge, edge, H, W]: the map at each shift, without a copy until all is sorted by part.
        let maps = self
            .around
            .f_contiguous()?
            .f_unfold(1, height, 1)?
            .f_unfold(2, width, 1)?;
        let maps = maps
            .f_view([channels, edge, edge, parts, rows, parts, columns].as_slice())?
            .f_permute([3, 5, 1, 2, 0, 4, 6])?
            .f_reshape([parts * parts, edge * edge, channels * rows * columns])?;
        Ok(self.maps.get_or_init(|| maps))
    }

    /// `[parts^2, N, K]`: for each part, map and shift the sum of the products with the ego's map, `own`, in plain
    /// floats.
    fn sums(&self, own: &[f32], others: &Tensor) -> Result<Tensor> {
        let (count, channels, height, width) = others.size4()?;
        let values = numbers(others)?;
        let [channels, height, width, parts, radius] =
            [channels, height, width, self.parts, self.radius].map(|size| size as usize);
        let (rows, columns, edge) = (height / parts, width / parts, 2 * radius + 1);
        let mut sums = vec![[0.0; LANES]; edge * edge];
        let mut all = Vec::new();
        for part in 0..parts * parts {
            let (top, left) = (part / parts * rows, part % parts * columns);
            for map in values.chunks_exact(channels * height * width) {
                sums.fill([0.0; LANES]);
                for (channel, row) in (0..channels)
                    .flat_map(|channel| (top..top + rows).map(move |row| (channel, row)))
                {
                    let shown = &map[(channel * height + row) * width + left..][..columns];
                    // Nothing is there, as beyond the edges of a map.
                    if shown.iter().all(|value| *value == 0.0) {
                        continue;
                    }
                    for (down, sums) in sums.chunks_exact_mut(edge).enumerate() {
                        // `own` has `radius` more rows above, so `down` 0 is the shift by -radius.
                        let row =
                            (channel * (height + 2 * radius) + row + down) * (width + 2 * radius);
                        let own = &own[row + left..][..columns + 2 * radius];
                        add_shifted(sums, shown, own);
                    }
                }
                all.extend(sums.iter().map(|lanes| lanes.iter().sum::<f32>()));
            }
        }
        Tensor::f_from_slice(&all)?.f_view([(parts * parts) as i64, count, (edge * edge) as i64])
    }
}

/// Adds the products of a row with another, `shown.len() - 1 + sums.len()` cells wide, at every shift.
#[multiversion(targets("x86_64+avx2+fma"))]
fn add_shifted(sums: &mut [[f32; LANES]], shown: &[f32], own: &[f32]) {
    for (sum, own) in sums.iter_mut().zip(own.windows(shown.len())) {
        add_products(sum, shown, own);
    }
}

/// `[parts^2, N, M * H/parts * W/parts]` of maps `[N, M, H, W]`.
fn by_part(maps: &Tensor, parts: i64) -> Result<Tensor> {
    let (count, channels, height, width) = maps.size4()?;
    maps.f_reshape([count, channels, parts, height / parts, parts, width / parts])?
        .f_permute([2, 4, 0, 1, 3, 5])?
        .f_reshape([parts * parts, count, -1])
}

/// `[parts^2, N]`: sums of maps `[N, M, H, W]` over each part.
fn sum_by_part(maps: &Tensor, parts: i64) -> Result<Tensor> {
    let (count, channels, height, width) = maps.size4()?;
    let by_part = [count, channels, parts, height / parts, parts, width / parts];
    // Summed where they are: by_part would copy them.
    maps.f_reshape(by_part)?
        .f_sum_dim_intlist([1_i64, 3, 5].as_slice(), false, None)?
        .f_flatten(1, 2)?
        .f_transpose(0, 1)
}

/// The shift at which correlations `[.., K]` are highest, `[.., 2]`, as a mean weighted by
/// `exp(sharpness * correlation)`.
pub(crate) fn peaks(correlation: &Tensor, sharpness: &Tensor, shifts: &Tensor) -> Result<Tensor> {
    (correlation * sharpness)
        .f_softmax(-1, None)?
        .f_matmul(shifts)
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;
    use crate::test_data::uniform;

    #[test]
    fn a_moved_map_fits_where_it_was_moved_from() {
        tch::manual_seed(3);
        let ego = Tensor::randn([1, 3, 16, 24], (Kind::Float, Device::Cpu));
        // Two cells further along x, one back along y.
        let other = ego.roll([-1, 2], [2, 3]);
        let found = Shifted::new(&ego, 3, PARTS)
            .unwrap()
            .correlate(&other)
            .unwrap();
        let shifts = shifts(3).unwrap();
        let whole = peaks(&found.whole, &Tensor::from(60f32), &shifts).unwrap();
        let parts = peaks(&found.parts, &Tensor::from(60f32), &shifts).unwrap();
        // Part 5 lies inside, where nothing wraps around the edges.
        for shift in [whole.get(0), parts.get(5).get(0)] {
            let [x, y] = [0, 1].map(|axis| shift.double_value(&[axis]));
            assert!(
                (x + 2.0).abs() < 0.05 && (y - 1.0).abs() < 0.05,
                "{whole} {parts}"
            );
        }
        assert!(found.parts.abs().max().double_value(&[]) < 1.5);
    }

    #[test]
    fn numbers_and_tensors_find_the_same() {
        let (ego, others) = (
            uniform(1, &[1, 3, 16, 24]),
            uniform(2, &[2, 3, 16, 24]) - 0.4,
        );
        for parts in [1, PARTS] {
            let shifted = Shifted::new(&ego, 2, parts).unwrap();
            let numbers = shifted.correlate(&others).unwrap();
            let tensors = shifted
                .correlate(&others.copy().set_requires_grad(true))
                .unwrap();
            assert_eq!(numbers.parts.size(), [parts * parts, 2, 25]);
            assert!(numbers.parts.allclose(&tensors.parts, 1e-5, 1e-6, false));
            assert!(numbers.whole.allclose(&tensors.whole, 1e-5, 1e-6, false));
        }
    }

    #[test]
    fn where_nothing_is_to_be_seen_nothing_fits() {
        let options = (Kind::Float, Device::Cpu);
        let [ego, others] = [1, 2].map(|maps| Tensor::zeros([maps, 2, 8, 8], options));
        let found = Shifted::new(&ego, 2, PARTS)
            .unwrap()
            .correlate(&others)
            .unwrap();
        assert_eq!(found.parts.abs().max().double_value(&[]), 0.0);
        assert_eq!(found.whole.size(), [2, 25]);
    }
}
