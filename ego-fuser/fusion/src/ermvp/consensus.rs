//! Consensus alignment: estimates the motion that aligns a neighbour's feature map with the ego's by commonly observed
//! cells.

use perception::tensor_values::tensor;
use tch::nn::{self, Init};
use tch::{Kind, TchError, Tensor};

use crate::f64_tensor::{offsets_around, sum_over_first};
use crate::layers::Linear;
use crate::warp::{BILINEAR, NEAREST, PADDING_ZEROS};

/// Channels by which cells are compared.
const KEYS: i64 = 32;
/// Total weight below which a neighbour shares nothing with the ego.
const TOO_LITTLE: f64 = 1e-6;

/// Estimates a small rigid motion from a few cells that both vehicles score as worth sending.
///
/// Each of these cells is matched in a window around its position in the ego's feature map. The mean position over that
/// search window, weighted by similarity, gives one correspondence; the motion is the weighted least-squares fit of all
/// (the planar case has a closed form). A cell that is similar everywhere matches at its own position, so it pulls
/// towards no correction. Everything is differentiable and trained by the detection loss.
#[derive(Debug)]
pub(super) struct FeatureConsensus {
    key: Linear,
    /// `[]` logarithm of the sharpness of the similarity weights.
    sharpness: Tensor,
    /// `[]` share of the fitted motion that is applied, before the sigmoid.
    trust: Tensor,
    cells: i64,
    reach: i64,
}

/// A planar motion of a feature map about its centre, in cells: `ego = rotation * map + shift`.
#[derive(Debug)]
pub(super) struct MapMotion {
    /// `[]` radians.
    angle: Tensor,
    /// `[2]` columns, rows.
    shift: Tensor,
}

impl FeatureConsensus {
    /// Variables `key`, `sharpness` and `trust` below `path`; compares `cells` cells within `reach` cells to each side.
    pub(super) fn new(path: &nn::Path<'_>, channels: i64, cells: i64, reach: i64) -> Self {
        Self {
            key: Linear::new(&(path / "key"), channels, KEYS, true),
            sharpness: path.var("sharpness", &[], Init::Const(20f64.ln())),
            trust: path.var("trust", &[], Init::Const(0.0)),
            cells,
            reach,
        }
    }

    /// The motion that moves a neighbour's feature map `[H, W, C]` onto the ego's; `None` where they share no cell.
    ///
    /// `weight` `[H, W]` is the weight of a cell for both, 0 where the neighbour has none.
    pub(super) fn motion(
        &self,
        ego: &Tensor,
        other: &Tensor,
        weight: &Tensor,
    ) -> Result<Option<MapMotion>, TchError> {
        let (height, width, channels) = ego.size3()?;
        let count = self.cells.min(height * width);
        // Step: the cells that count most for both. Their choice has no gradient, their weights have.
        let weight = weight.f_view([-1])?;
        let (_, best) = weight.f_detach()?.f_topk(count, 0, true, false)?;
        let weight = weight.f_index_select(0, &best)?;
        if weight.f_sum(Kind::Float)?.f_double_value(&[])? < TOO_LITTLE {
            return Ok(None);
        }
        // Step: the same search window around each of these cells, in the map of the ego.
        let offsets = tensor(&offsets_around(self.reach), &[-1, 2], ego.device())?;
        let rows = best.f_divide_scalar_mode(width, "floor")?;
        let columns = best.f_remainder(width)?;
        // Beyond the edge the nearest cell is used: a few cells of a window hardly matter.
        let [near_columns, near_rows] =
            [(0, &columns, width), (1, &rows, height)].map(|(axis, at, length)| {
                let offset = offsets.f_select(1, axis)?.f_unsqueeze(0)?;
                at.f_unsqueeze(1)?.f_add(&offset)?.f_clamp(0, length - 1)
            });
        let places = near_rows? * width + near_columns?;
        let candidates = ego
            .f_reshape([-1, channels])?
            .f_index_select(0, &places.f_view([-1])?)?;
        let candidates = self.keys(&candidates)?.f_view([count, -1, KEYS])?;
        let asked = other.f_reshape([-1, channels])?.f_index_select(0, &best)?;
        let asked = self.keys(&asked)?;
        let similarity = candidates.f_bmm(&asked.f_unsqueeze(2)?)?.f_squeeze_dim(2)?;
        let share = similarity
            .f_mul(&self.sharpness.f_exp()?)?
            .f_softmax(1, None::<Kind>)?;
        // Step: mean offset within the window, weighted by similarity, is the correspondence of a cell.
        let moved = share.f_matmul(&offsets.f_to_kind(ego.kind())?)?;
        // Positions count from the centre of the map, in cells, columns first.
        let middle = Tensor::from_slice(&[(width - 1) as f32 / 2.0, (height - 1) as f32 / 2.0])
            .f_to_device(ego.device())?;
        let from = Tensor::f_stack(&[columns, rows], 1)?.f_to_kind(ego.kind())? - middle;
        // A cell with one clear match counts more than one that is similar everywhere.
        let certain = share.f_amax([1i64].as_slice(), false)?;
        Ok(Some(self.fit(&from, &moved, &(weight * certain))?))
    }

    /// Keys of cells, of unit length, which makes the similarity a cosine.
    fn keys(&self, cells: &Tensor) -> Result<Tensor, TchError> {
        let key = self.key.forward(cells)?;
        // The constant keeps keys of zeros finite.
        let norm = key
            .f_square()?
            .f_sum_dim_intlist([-1i64].as_slice(), true, None::<Kind>)?
            + 1e-6;
        key.f_div(&norm.f_sqrt()?)
    }

    /// The motion of points `from` `[K, 2]` by `moved`, scaled by the learnt share.
    fn fit(&self, from: &Tensor, moved: &Tensor, weight: &Tensor) -> Result<MapMotion, TchError> {
        let weight = weight
            .f_div(&(weight.f_sum(Kind::Float)? + TOO_LITTLE))?
            .f_unsqueeze(1)?;
        let [centre, step] = [from, moved].map(|x| sum_over_first(&(x * &weight)));
        let (centre, step) = (centre?, step?);
        let (one, other) = (from - &centre, from + moved - &centre - &step);
        // Step: planar least squares in closed form, by the sums of cross products and of dot products.
        let [x, y] = [one.f_select(1, 0)?, one.f_select(1, 1)?];
        let [to_x, to_y] = [other.f_select(1, 0)?, other.f_select(1, 1)?];
        let flat = weight.f_squeeze_dim(1)?;
        let sine = ((&x * &to_y - &y * &to_x) * &flat).f_sum(Kind::Float)?;
        // Regularised the more, the less the points spread: a rotation needs a lever arm.
        let cosine = ((&x * &to_x + &y * &to_y) * &flat).f_sum(Kind::Float)? + 1.0;
        let trust = self.trust.f_sigmoid()?;
        let angle = sine.f_atan2(&cosine)? * &trust;
        let turned = rotated(&angle, &centre)?;
        // About the weighted centre c of the cells: R (p - c) + c + step, with R c in `turned`.
        let shift = &centre + step * trust - turned;
        Ok(MapMotion { angle, shift })
    }
}

impl MapMotion {
    /// A feature map `[H, W, C]` moved by this motion, zeros outside, and the mask `[H, W]` moved with it.
    pub(super) fn apply(&self, map: &Tensor, mask: &Tensor) -> Result<(Tensor, Tensor), TchError> {
        let (height, width, channels) = map.size3()?;
        // From the ego's cells back to the map's: the transposed rotation after the shift is subtracted.
        let back = -&self.angle;
        let from = -rotated(&back, &self.shift)?;
        let (sine, cosine) = (back.f_sin()?, back.f_cos()?);
        let (rows, columns) = (height as f64, width as f64);
        // Coordinates are -1..1 along each edge, so a term across axes is scaled by the ratio of the edges.
        let entries = [
            cosine.shallow_clone(),
            -&sine * (rows / columns),
            from.f_get(0)? * (2.0 / columns),
            sine * (columns / rows),
            cosine,
            from.f_get(1)? * (2.0 / rows),
        ];
        let theta = Tensor::f_stack(&entries, 0)?.f_view([1, 2, 3])?;
        let sampling_grid =
            Tensor::f_affine_grid_generator(&theta, [1, channels, height, width], false)?;
        let maps = map.f_permute([2, 0, 1])?.f_unsqueeze(0)?;
        let maps = maps.f_grid_sampler(&sampling_grid, BILINEAR, PADDING_ZEROS, false)?;
        // The nearest cell, so that the mask stays 0 or 1.
        let mask = mask.f_view([1, 1, height, width])?;
        let mask = mask
            .f_grid_sampler(&sampling_grid.f_detach()?, NEAREST, PADDING_ZEROS, false)?
            .f_view([height, width])?;
        let moved = maps.f_squeeze_dim(0)?.f_permute([1, 2, 0])? * mask.f_unsqueeze(2)?;
        Ok((moved.f_contiguous()?, mask))
    }
}

/// A point `[2]` rotated by an angle.
fn rotated(angle: &Tensor, point: &Tensor) -> Result<Tensor, TchError> {
    let (sine, cosine) = (angle.f_sin()?, angle.f_cos()?);
    let (x, y) = (point.f_get(0)?, point.f_get(1)?);
    Tensor::f_stack(&[&cosine * &x - &sine * &y, sine * x + cosine * y], 0)
}

#[cfg(test)]
mod tests {
    use tch::Device;
    use tch::nn::VarStore;

    use super::*;

    fn trusting() -> (VarStore, FeatureConsensus) {
        tch::manual_seed(3);
        let variables = VarStore::new(Device::Cpu);
        let consensus = FeatureConsensus::new(&variables.root(), 16, 64, 3);
        let _ = tch::no_grad(|| consensus.trust.shallow_clone().fill_(20.0));
        let _ = tch::no_grad(|| consensus.sharpness.shallow_clone().fill_(4.0));
        (variables, consensus)
    }

    /// The cells of a map `[24, 32, ..]` away from its edges.
    fn inner(map: &Tensor) -> Tensor {
        map.narrow(0, 6, 12).narrow(1, 6, 20)
    }

    fn inner_error(map: &Tensor, expected: &Tensor) -> f64 {
        let error = inner(map) - inner(expected);
        error.abs().mean(Kind::Float).double_value(&[])
    }

    #[test]
    fn an_offset_of_two_cells_is_corrected() {
        let (_variables, consensus) = trusting();
        let ego = Tensor::randn([24, 32, 16], (Kind::Float, Device::Cpu));
        // A feature of the ego at a column is two columns further and one row up in the neighbour's map.
        let other = ego.roll([2i64, -1].as_slice(), [1i64, 0].as_slice());
        let weight = Tensor::zeros([24, 32], (Kind::Float, Device::Cpu));
        let _ = inner(&weight).fill_(1.0);
        let motion = consensus.motion(&ego, &other, &weight).unwrap().unwrap();
        assert!(
            (motion.shift.double_value(&[0]) + 2.0).abs() < 0.1,
            "{:?}",
            motion.shift
        );
        assert!(
            (motion.shift.double_value(&[1]) - 1.0).abs() < 0.1,
            "{:?}",
            motion.shift
        );
        assert!(motion.angle.double_value(&[]).abs() < 0.01);
        let (moved, mask) = motion.apply(&other, &weight.ones_like()).unwrap();
        let [after, before] = [&moved, &other].map(|map| inner_error(map, &ego));
        assert!(after < 0.2 * before, "{after} of {before}");
        assert_eq!(
            mask.double_value(&[10, 31]),
            0.0,
            "nothing comes from beyond the edge"
        );
    }

    #[test]
    fn a_known_motion_is_fitted_and_applied_the_same_way() {
        let (_variables, consensus) = trusting();
        let (angle, shift) = (0.05f64, [1.5f64, -0.7]);
        let from = Tensor::rand([50, 2], (Kind::Float, Device::Cpu)) * 40.0 - 20.0;
        let (sine, cosine) = angle.sin_cos();
        let turn = Tensor::from_slice(&[cosine as f32, sine as f32, -sine as f32, cosine as f32])
            .view([2, 2]);
        let to = from.matmul(&turn) + Tensor::from_slice(&shift.map(|value| value as f32));
        let motion = consensus
            .fit(
                &from,
                &(to - &from),
                &Tensor::ones([50], (Kind::Float, Device::Cpu)),
            )
            .unwrap();
        assert!(
            (motion.angle.double_value(&[]) - angle).abs() < 2e-3,
            "{:?}",
            motion.angle
        );
        // A feature map with one bright cell: it must land at the moved position.
        let map = Tensor::zeros([41, 41, 1], (Kind::Float, Device::Cpu));
        let _ = map.get(20 + 4).get(20 + 10).fill_(1.0);
        let (moved, _) = motion
            .apply(&map, &Tensor::ones([41, 41], (Kind::Float, Device::Cpu)))
            .unwrap();
        let expected = [
            cosine * 10.0 - sine * 4.0 + shift[0],
            sine * 10.0 + cosine * 4.0 + shift[1],
        ];
        let found = moved.argmax(None::<i64>, false).int64_value(&[]);
        let found = [(found % 41 - 20) as f64, (found / 41 - 20) as f64];
        assert!(
            (found[0] - expected[0]).abs() < 0.8 && (found[1] - expected[1]).abs() < 0.8,
            "{found:?} {expected:?}"
        );
    }

    #[test]
    fn vehicles_that_share_nothing_are_left_where_they_are() {
        let (_variables, consensus) = trusting();
        let map = Tensor::randn([8, 8, 16], (Kind::Float, Device::Cpu));
        let nothing = Tensor::zeros([8, 8], (Kind::Float, Device::Cpu));
        assert!(consensus.motion(&map, &map, &nothing).unwrap().is_none());
    }
}
