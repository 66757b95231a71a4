//! What was seen a moment before, to the cell: earlier maps steady what the newest show.
//!
//! A map errs anew in every sweep: points fall elsewhere, and cells begin elsewhere on a vehicle. Part of that is not there in
//! the mean of several sweeps.

use tch::nn::{self, Init, Module};
use tch::{Kind, TchError, Tensor};

use super::alignment::resample;
use super::entries::Maps;
use super::precision::{convolve, fastest};
use crate::numbers::{are_numbers, numbers};
use crate::warp::Cells;

/// What all agents have shown at one time step before their newest.
#[derive(Debug)]
pub(super) struct Earlier {
    /// 0 for the step before the newest.
    pub(super) step: i64,
    /// One map.
    pub(super) maps: Maps,
}

impl Earlier {
    /// Of the maps `entries` of one time step the strongest at each cell; `places` `[O, H, W, 2]` tell where on all `maps` the
    /// ego's cells lie, for `grid_sampler`; absent: maps lie where they belong.
    pub(super) fn strongest(
        step: i64,
        maps: &Maps,
        places: Option<&Tensor>,
        entries: &[i64],
    ) -> Result<Self, TchError> {
        let Maps { features, mask } = match places {
            Some(places) if are_numbers(&maps.features) && are_numbers(places) => {
                return Ok(Self { step, maps: strongest_of_numbers(maps, places, entries)? });
            }
            Some(places) => {
                let of_step = Maps::picked(&maps.features, &maps.mask, entries)?;
                let entries = Tensor::f_from_slice(entries)?.f_to_device(places.device())?;
                let places = places.f_index_select(0, &entries)?;
                let (features, mask) = resample(&of_step.features, &of_step.mask, &places)?;
                Maps { features, mask }
            }
            None => Maps::picked(&maps.features, &maps.mask, entries)?,
        };
        let over_all = |tensor: &Tensor| tensor.f_amax([0_i64].as_slice(), true);
        let strongest = over_all(&features.f_masked_fill(&mask.f_eq(0.0)?, f64::NEG_INFINITY)?)?;
        let mask = over_all(&mask)?;
        let features = strongest.f_masked_fill(&mask.f_eq(0.0)?, 0.0)?;
        Ok(Self { step, maps: Maps { features, mask } })
    }
}

/// The strongest at each cell of maps that are read at `places`, in one walk over the cells of each.
fn strongest_of_numbers(maps: &Maps, places: &Tensor, entries: &[i64]) -> Result<Maps, TchError> {
    let (_, channels, height, width) = maps.features.size4()?;
    let (each, cells) = (channels as usize, (height * width) as usize);
    let (mut most, mut reached) = (vec![f32::NEG_INFINITY; cells * each], vec![0.0; cells]);
    for &entry in entries {
        let [map, valid, places] = [&maps.features, &maps.mask, places].map(|tensor| tensor.f_get(entry));
        Cells::of(&map?)?.look(&numbers(&valid?)?, &numbers(&places?)?, |cell, shown| {
            let most = &mut most[cell * each..][..each];
            most.iter_mut().zip(shown).for_each(|(most, shown)| *most = most.max(*shown));
            reached[cell] = 1.0;
        });
    }
    let unreached = most.chunks_exact_mut(each).zip(&reached).filter(|(_, reached)| **reached == 0.0);
    unreached.for_each(|(most, _)| most.fill(0.0));
    let features = Tensor::f_from_slice(&most)?.f_view([1, height, width, channels])?.f_permute([0, 3, 1, 2])?;
    Ok(Maps { features, mask: Tensor::f_from_slice(&reached)?.f_view([1, 1, height, width])? })
}

/// Blends earlier maps into the newest, by cell and channel; nothing of them before it is trained.
#[derive(Debug)]
pub(super) struct Recall {
    now: nn::Conv2D,
    past: nn::Conv2D,
    token: nn::Linear,
    /// `[steps, hidden]`.
    step: Tensor,
    gate: nn::Conv2D,
    patch: i64,
}

impl Recall {
    /// For maps of `channels`, tokens of `dim` with `patch` cells along each edge, and `steps` time steps before the newest;
    /// from `hidden` channels it is told how much of an earlier map is taken.
    pub(super) fn new(path: &nn::Path<'_>, [channels, dim, patch, steps]: [i64; 4], hidden: i64) -> Self {
        let around = nn::ConvConfig { padding: 1, ..Default::default() };
        let bare = nn::ConvConfig { bias: false, ..around };
        let neutral = nn::ConvConfig { ws_init: Init::Const(0.0), bs_init: Init::Const(0.0), ..Default::default() };
        Self {
            now: nn::conv2d(path / "now", channels, hidden, 3, around),
            past: nn::conv2d(path / "past", channels, hidden, 3, bare),
            token: nn::linear(path / "token", dim, hidden, nn::LinearConfig { bias: false, ..Default::default() }),
            step: path.var("step", &[steps, hidden], Init::Const(0.0)),
            gate: nn::conv2d(path / "gate", hidden, channels, 1, neutral),
            patch,
        }
    }

    /// `[1, C, H, W]` of the newest `now` of that shape.
    ///
    /// # Shapes
    /// - `past`: maps of the same size
    /// - `ego`: `[1, h, w, D]`, the ego's tokens after the transformer
    pub(super) fn forward(
        &self,
        now: &Tensor,
        past: &[Earlier],
        ego: &Tensor,
        train: bool,
    ) -> Result<Tensor, TchError> {
        if past.is_empty() {
            return Ok(now.shallow_clone());
        }
        let kind = if train { Kind::Float } else { fastest(now.device()) };
        let known = convolve(&self.now, &now.f_to_kind(kind)?)? + self.told(ego)?.f_to_kind(kind)?;
        let blend = |blended: Tensor, earlier: &Earlier| -> Result<Tensor, TchError> {
            let Earlier { step, maps: Maps { features, mask } } = earlier;
            let step = self.step.f_get(*step)?.f_view([1, -1, 1, 1])?.f_to_kind(kind)?;
            let past = convolve(&self.past, &(features * mask).f_to_kind(kind)?)?;
            let gate = convolve(&self.gate, &(&known + step + past).f_relu()?)?.f_tanh()?.f_to_kind(Kind::Float)?;
            // Where nobody has shown anything nothing is blended in.
            blended.f_addcmul(&gate, &(features.f_sub(now)? * mask))
        };
        past.iter().try_fold(now.shallow_clone(), blend)
    }

    /// What the tokens know, on the cells.
    fn told(&self, ego: &Tensor) -> Result<Tensor, TchError> {
        let (_, rows, columns, _) = ego.size4()?;
        let told = self.token.forward(ego).f_permute([0, 3, 1, 2])?;
        told.f_upsample_nearest2d([rows * self.patch, columns * self.patch], None, None)
    }
}

#[cfg(test)]
mod tests {
    use protocol::{BevGrid, Pose};

    use super::super::alignment::{Area, lattice};
    use super::*;
    use crate::made_up::uniform;

    #[test]
    fn numbers_and_tensors_find_the_same_strongest() {
        let grid = BevGrid { x_min_m: -8.0, y_min_m: -4.0, cell_m: 0.5, width: 32, height: 16 };
        let poses = [0.0, 3.0, -2.0].map(|x_m| Pose::from_xyz_yaw([x_m, 1.0, 0.0], 0.1 * x_m));
        let deltas = Tensor::from_slice(&[0.7f32, -0.4, 0.05, -1.3, 0.2, 0.0, 9.0, 9.0, 1.0]).view([3, 3]);
        let places = lattice(&deltas, &poses, &Area::new(&grid, [16, 32], 0), [16, 32]).unwrap();
        let mask = uniform(4, &[3, 1, 16, 32]).gt(0.2).to_kind(Kind::Float);
        let features = (uniform(5, &[3, 4, 16, 32]) - 0.3) * &mask;
        let strongest = |with_gradient: bool| {
            let features = features.copy().set_requires_grad(with_gradient);
            let maps = Maps { features, mask: mask.shallow_clone() };
            Earlier::strongest(0, &maps, Some(&places), &[0, 2]).unwrap().maps
        };
        let (numbers, tensors) = (strongest(false), strongest(true));
        assert!(tensors.features.requires_grad() && !numbers.features.requires_grad());
        // A place between two cells may be nearest to either.
        let apart = |a: &Tensor, b: &Tensor| (a - b).abs().gt(1e-4).sum(Kind::Int64).int64_value(&[]);
        assert!(apart(&numbers.features, &tensors.features) <= 8 && apart(&numbers.mask, &tensors.mask) <= 2);
        assert!(tensors.mask.sum(Kind::Float).double_value(&[]) > 50.0);
    }
}
