//! Correlation of a neighbour's feature map with the ego's at every shift, part by part of the BEV grid.

use tch::{Kind, TchError, Tensor};

/// Parts of the grid along each edge: enough to distinguish a rotation from a shift.
pub(crate) const PARTS: i64 = 4;
/// Prevents division by the norm of an empty part.
const EPSILON: f64 = 1e-6;

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
pub(crate) fn shifts(radius: i64) -> Result<Tensor, TchError> {
    let steps = || -radius..=radius;
    let all: Vec<f32> = steps().flat_map(|row| steps().flat_map(move |column| [column as f32, row as f32])).collect();
    Tensor::f_from_slice(&all)?.f_view([-1, 2])
}

/// The ego's map at every shift, part by part: computed once for all comparisons.
#[derive(Debug)]
pub(crate) struct Shifted {
    /// `[parts^2, K, M * H/parts * W/parts]`.
    maps: Tensor,
    /// `[parts^2]`: sums of the squares of the unshifted map.
    squares: Tensor,
    parts: i64,
}

impl Shifted {
    /// `ego` `[1, M, H, W]`, `H` and `W` multiples of `parts`, moved by up to `radius` cells, in `parts` parts along
    /// each edge. No gradient flows into it: the same layers learn from the other map.
    pub(crate) fn new(ego: &Tensor, radius: i64, parts: i64) -> Result<Self, TchError> {
        let (_, channels, height, width) = ego.size4()?;
        let (rows, columns, edge) = (height / parts, width / parts, 2 * radius + 1);
        let around = ego.f_detach()?.f_constant_pad_nd([radius; 4])?.f_squeeze_dim(0)?;
        // [M, edge, edge, H, W]: the map at each shift, without a copy until all is sorted by part.
        let maps = around.f_unfold(1, height, 1)?.f_unfold(2, width, 1)?;
        let maps = maps
            .f_view([channels, edge, edge, parts, rows, parts, columns].as_slice())?
            .f_permute([3, 5, 1, 2, 0, 4, 6])?
            .f_reshape([parts * parts, edge * edge, channels * rows * columns])?;
        let still = maps.f_select(1, edge * edge / 2)?;
        let squares = still.f_square()?.f_sum_dim_intlist([1_i64].as_slice(), false, None)?;
        Ok(Self { maps, squares, parts })
    }

    /// Compares it with the maps of `others`, `[N, M, H, W]`.
    pub(crate) fn correlate(&self, others: &Tensor) -> Result<Correlation, TchError> {
        let (count, channels, height, width) = others.size4()?;
        let parts = self.parts;
        let others = others
            .f_reshape([count, channels, parts, height / parts, parts, width / parts])?
            .f_permute([2, 4, 0, 1, 3, 5])?
            .f_reshape([parts * parts, count, -1])?;
        let products = others.f_matmul(&self.maps.f_transpose(1, 2)?)?;
        let theirs = others.f_square()?.f_sum_dim_intlist([2_i64].as_slice(), false, None)?;
        let over_parts = |tensor: &Tensor| tensor.f_sum_dim_intlist([0_i64].as_slice(), false, None);
        let length = |square: Tensor| square.f_add_scalar(EPSILON)?.f_sqrt();
        let energy = length(self.squares.f_unsqueeze(1)? * &theirs)?;
        let whole_energy = length(self.squares.f_sum(None::<Kind>)? * over_parts(&theirs)?)?;
        Ok(Correlation {
            parts: &products / energy.f_unsqueeze(2)?,
            whole: over_parts(&products)? / whole_energy.f_unsqueeze(1)?,
            energy,
        })
    }
}

/// The shift at which correlations `[.., K]` are highest, `[.., 2]`, as a mean weighted by
/// `exp(sharpness * correlation)`.
pub(crate) fn peaks(correlation: &Tensor, sharpness: &Tensor, shifts: &Tensor) -> Result<Tensor, TchError> {
    (correlation * sharpness).f_softmax(-1, None)?.f_matmul(shifts)
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;

    #[test]
    fn a_moved_map_fits_where_it_was_moved_from() {
        tch::manual_seed(3);
        let ego = Tensor::randn([1, 3, 16, 24], (Kind::Float, Device::Cpu));
        // Two cells further along x, one back along y.
        let other = ego.roll([-1, 2], [2, 3]);
        let found = Shifted::new(&ego, 3, PARTS).unwrap().correlate(&other).unwrap();
        let shifts = shifts(3).unwrap();
        let whole = peaks(&found.whole, &Tensor::from(60f32), &shifts).unwrap();
        let parts = peaks(&found.parts, &Tensor::from(60f32), &shifts).unwrap();
        let near = |found: &Tensor, place: &[i64]| {
            let at = |axis: i64| found.double_value(&[place, &[axis]].concat());
            (at(0) + 2.0).abs() < 0.05 && (at(1) - 1.0).abs() < 0.05
        };
        assert!(near(&whole, &[0]), "{whole}");
        // Part 5 lies inside, where nothing wraps around the edges.
        assert!(near(&parts, &[5, 0]), "{parts}");
        assert!(found.parts.abs().max().double_value(&[]) < 1.5);
    }

    #[test]
    fn where_nothing_is_to_be_seen_nothing_fits() {
        let options = (Kind::Float, Device::Cpu);
        let [ego, others] = [1, 2].map(|maps| Tensor::zeros([maps, 2, 8, 8], options));
        let found = Shifted::new(&ego, 2, PARTS).unwrap().correlate(&others).unwrap();
        assert_eq!(found.parts.abs().max().double_value(&[]), 0.0);
        assert_eq!(found.whole.size(), [2, 25]);
    }
}
