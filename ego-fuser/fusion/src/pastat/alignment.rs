//! FSA, Feature Spatial Alignment: how far a neighbour's map lies beside the ego's, and the map moved there.

use protocol::Pose;
use tch::nn::{self, Init, Module};
use tch::{Kind, TchError, Tensor};

use super::area::{Area, lattice, resample};
use super::config::FsaConfig;
use super::correlation::{PARTS, Shifted, peaks, shifts};
use super::entries::Maps;
use super::pairs::{Found, Pairs, picked, rows_where};
use super::search::offsets;
use crate::f64_tensor::pointwise;

/// Keeps the weight of a map that fits nowhere from being divided by.
const EPSILON: f64 = 1e-6;
/// How sharply the best shift stands out before it is trained: correlations lie between -1 and 1.
const SHARPNESS: f64 = 20.0;
/// Numbers that tell how much a pose is trusted.
pub(super) const TRUST: i64 = 3;
/// What is added to the lever arm of a turn, metres.
const ARM_M: f64 = 5.0;
/// A map belongs far from where its pose puts it when its correlation with the ego's, compared as closely at both places, is
/// higher there by more than this.
const MARGIN: f64 = 0.05;
/// A map that was moved further than this, about half a cell of `lean`'s lattice, is compared again where it lies then.
const AGAIN_M: f64 = 0.45;

/// Predicts `(dx, dy, theta)` of every neighbour's map from what it shows and what the ego shows, and how much its pose
/// is trusted: convolutions make both comparable, the shifts at which they fit best, part by part of the lattice, go
/// through fully connected layers.
#[derive(Debug)]
pub(super) struct SpatialAlignment {
    config: FsaConfig,
    matching: [nn::Conv2D; 2],
    /// How sharply the best shift stands out, its logarithm.
    sharpness: Tensor,
    hidden: nn::Linear,
    /// What is added to the motion that fits the parts' shifts, and how much of that motion is taken.
    delta: nn::Linear,
    /// What the map's tokens are told of how well it fits.
    fit: nn::Linear,
}

impl SpatialAlignment {
    /// Moves nothing and tells tokens of `dim` channels nothing before it is trained.
    pub(super) fn new(path: &nn::Path<'_>, [channels, dim]: [i64; 2], config: &FsaConfig) -> Self {
        let FsaConfig { matching, hidden, .. } = *config;
        let still = nn::LinearConfig { ws_init: Init::Const(0.0), bs_init: Some(Init::Const(0.0)), bias: true };
        let around = nn::ConvConfig { padding: 1, ..Default::default() };
        // Of each part the shift along x and y and how well it fits; the same of the whole; the motion; the trust.
        let inputs = 3 * (PARTS * PARTS + 1) + 3 + TRUST;
        Self {
            matching: [
                nn::conv2d(path / "matching0", channels, matching, 1, nn::ConvConfig::default()),
                nn::conv2d(path / "matching1", matching, matching, 3, around),
            ],
            sharpness: path.var("sharpness", &[], Init::Const(SHARPNESS.ln())),
            hidden: nn::linear(path / "hidden", inputs, hidden, nn::LinearConfig::default()),
            delta: nn::linear(path / "delta", hidden, 6, still),
            fit: nn::linear(path / "fit", hidden, dim, still),
            config: config.clone(),
        }
    }

    /// Cells are compared up to so many cells away.
    pub(super) fn radius(&self) -> i64 {
        self.config.radius
    }

    /// What is compared of maps: few channels.
    pub(super) fn looked_at(&self, Maps { features, mask }: &Maps) -> Result<Maps, TchError> {
        Ok(Maps { features: pointwise(&self.matching[0], features)?, mask: mask.shallow_clone() })
    }

    /// Compares `K` maps with the ego's.
    ///
    /// Unless it is to `train` it looks twice: what fits better far away is compared there as closely as where its pose puts
    /// it, and what was moved is compared once more where it lies then. Training goes by the first look, and searches shifts
    /// alone.
    ///
    /// # Shapes
    /// - `ego`, `others`: what is [looked at](Self::looked_at) of 1 and `K` maps, on the lattice of `area`
    /// - `trust`: `[K, 3]`, the confidence embedding, the confidence itself and the ego's; zeros: nothing is known
    /// - `ego_from_cav`: `K` poses of the maps' senders
    pub(super) fn compare(
        &self,
        [ego, others]: [&Maps; 2],
        trust: &Tensor,
        ego_from_cav: &[Pose],
        area: &Area,
        train: bool,
    ) -> Result<Found, TchError> {
        let (own, shown) = (self.shown(ego)?, self.shown(others)?);
        let nowhere = Tensor::f_zeros([ego_from_cav.len() as i64, 3], (Kind::Float, own.device()))?;
        let far = match self.config.search {
            Some(search) => offsets([&own, &shown], ego_from_cav, area, search, train)?,
            None => nowhere.shallow_clone(),
        };
        let own = Shifted::new(&own, area.radius(), PARTS)?;
        let (mask, trust, ego_from_cav) = (others.mask.shallow_clone(), trust.shallow_clone(), ego_from_cav.to_vec());
        let pairs = Pairs { own: &own, shown, mask, trust, ego_from_cav };
        if train {
            return self.compare_near(&pairs, &far, area);
        }
        let near = self.compare_near(&pairs, &nowhere, area)?;
        let found = self.compare_there(&pairs, near, &far, area)?;
        self.compare_again(&pairs, found, area)
    }

    /// What was found `near` where poses put maps, or what is found around `far` `[K, 3]`, metres and radians in the ego's
    /// frame, where that fits better.
    fn compare_there(&self, pairs: &Pairs<'_>, near: Found, far: &Tensor, area: &Area) -> Result<Found, TchError> {
        let rows = rows_where(&far.f_count_nonzero_dim_intlist([1_i64].as_slice())?)?;
        if rows.is_empty() {
            return Ok(near);
        }
        let there = self.compare_near(&pairs.only(&rows)?, &picked(far, &rows)?, area)?;
        let better = rows_where(&there.alike.f_gt_tensor(&picked(&near.alike, &rows)?.f_add_scalar(MARGIN)?)?)?;
        let rows: Vec<i64> = better.iter().map(|&row| rows[row as usize]).collect();
        near.with(&rows, &there.only(&better)?)
    }

    /// What was `found`, of maps that were moved by some distance where they lie then.
    fn compare_again(&self, pairs: &Pairs<'_>, found: Found, area: &Area) -> Result<Found, TchError> {
        let square = found.deltas.f_narrow(1, 0, 2)?.f_square()?.f_sum_dim_intlist([1_i64].as_slice(), false, None)?;
        let rows = rows_where(&square.f_gt(AGAIN_M * AGAIN_M)?)?;
        if rows.is_empty() {
            return Ok(found);
        }
        let again = self.compare_near(&pairs.only(&rows)?, &picked(&found.deltas, &rows)?, area)?;
        found.with(&rows, &again)
    }

    /// Compares maps where `deltas` `[K, 3]`, metres and radians in the ego's frame, put them; what is found is added to
    /// those.
    fn compare_near(&self, pairs: &Pairs<'_>, deltas: &Tensor, area: &Area) -> Result<Found, TchError> {
        let Pairs { own, trust, ego_from_cav, .. } = pairs;
        let device = deltas.device();
        let found = own.correlate(&moved(pairs, deltas, area)?)?;
        let shifts = (shifts(area.radius())? * area.cell_m()).f_to_device(device)?;
        let sharpness = self.sharpness.f_exp()?;
        let parts = peaks(&found.parts, &sharpness, &shifts)?;
        let whole = peaks(&found.whole, &sharpness, &shifts)?;
        let [fit, alike] = [&found.parts, &found.whole].map(|found| found.f_amax([-1_i64].as_slice(), false));
        let (fit, alike) = (fit?, alike?);
        let weight = fit.f_relu()?.f_square()? * &found.energy;
        let senders = area.places_of(ego_from_cav)?.f_to_device(device)? + deltas.f_narrow(1, 0, 2)?;
        let motion = rigid_motion(&parts, &weight, &senders, area)?;
        let by_entry = |parts: Tensor| parts.f_transpose(0, 1)?.f_reshape([ego_from_cav.len() as i64, -1]);
        let inputs = [
            by_entry(parts)?,
            by_entry(fit)?,
            whole,
            alike.f_unsqueeze(1)?,
            motion.shallow_clone(),
            trust.shallow_clone(),
        ];
        let hidden = self.hidden.forward(&Tensor::f_cat(&inputs, 1)?).f_relu()?;
        let near = self.bounded(&self.delta.forward(&hidden), motion)?;
        Ok(Found { deltas: near + deltas, fit: self.fit.forward(&hidden), alike })
    }

    /// `[K, 3]`: what is `learnt` `[K, 6]`, to be added and the share of the `motion` `[K, 3]`, within bounds.
    fn bounded(&self, learnt: &Tensor, motion: Tensor) -> Result<Tensor, TchError> {
        let FsaConfig { max_shift_m, max_turn_rad, .. } = self.config;
        let bounds = Tensor::f_from_slice(&[max_shift_m as f32, max_shift_m as f32, max_turn_rad as f32])?;
        let bounds = bounds.f_to_device(motion.device())?;
        let raw = learnt.f_narrow(1, 0, 3)? + motion / &bounds * learnt.f_narrow(1, 3, 3)?;
        Ok(raw.f_tanh()? * bounds)
    }

    /// What is compared, `[N, M, H, W]`: zero in the mean of what a map shows, so that empty road fits nothing.
    fn shown(&self, Maps { features, mask }: &Maps) -> Result<Tensor, TchError> {
        let shown = self.matching[1].forward(&features.f_relu()?);
        let over_map = |tensor: &Tensor| tensor.f_sum_dim_intlist([2_i64, 3].as_slice(), true, None);
        let mean = over_map(&(&shown * mask))? / over_map(mask)?.f_clamp_min(1.0)?;
        Ok((shown - mean) * mask)
    }
}

/// What is compared of others, moved by `deltas` `[K, 3]`.
fn moved(
    Pairs { shown, mask, ego_from_cav, .. }: &Pairs<'_>,
    deltas: &Tensor,
    area: &Area,
) -> Result<Tensor, TchError> {
    if deltas.f_count_nonzero(None::<i64>)?.f_int64_value(&[])? == 0 {
        return Ok(shown.shallow_clone());
    }
    let (.., height, width) = shown.size4()?;
    let places = lattice(deltas, ego_from_cav, area, [height, width])?;
    let (moved, valid) = resample(shown, mask, &places)?;
    moved.f_mul(&valid)
}

/// The motion that fits the shifts of the parts best, `[N, 3]`: a shift, metres, after a small turn about the sender, radians.
///
/// # Shapes
/// - `parts`: `[PARTS^2, N, 2]` shifts, metres
/// - `weight`: `[PARTS^2, N]` how sure each of them is
/// - `senders`: `[N, 2]`, where the maps' senders are, metres from the middle of `area`
fn rigid_motion(parts: &Tensor, weight: &Tensor, senders: &Tensor, area: &Area) -> Result<Tensor, TchError> {
    let over_parts = |tensor: &Tensor| tensor.f_sum_dim_intlist([0_i64].as_slice(), false, None);
    let share = weight / over_parts(weight)?.f_add_scalar(EPSILON)?;
    let share = share.f_unsqueeze(2)?;
    // Middles of the parts, from the middle of the lattice.
    let middles = area.middles_of_parts()?.f_to_device(parts.device())?.f_unsqueeze(1)?;
    let (mean, middle) = (over_parts(&(parts * &share))?, over_parts(&(&middles * &share))?);
    let (shift, arm) = (parts - mean.f_unsqueeze(0)?, &middles - middle.f_unsqueeze(0)?);
    let column = |tensor: &Tensor, axis: i64| tensor.f_narrow(2, axis, 1);
    let turning = column(&arm, 0)? * column(&shift, 1)? - column(&arm, 1)? * column(&shift, 0)?;
    let inertia = over_parts(&(arm.f_square()?.f_sum_dim_intlist([2_i64].as_slice(), true, None)? * &share))?;
    // A single part says nothing of a turn: a few metres keep that from being divided by.
    let turn = over_parts(&(turning * &share))? / inertia.f_add_scalar(ARM_M * ARM_M)?;
    let to_sender = senders - middle;
    // The middle of what was seen moves by `mean`; a turn moves the sender beside it.
    let across = Tensor::f_cat(&[-(to_sender.f_narrow(1, 1, 1)?), to_sender.f_narrow(1, 0, 1)?], 1)?;
    Tensor::f_cat(&[mean + across * &turn, turn], 1)
}

#[cfg(test)]
mod tests {
    use protocol::BevGrid;
    use tch::nn::VarStore;
    use tch::{Device, no_grad};

    use super::super::config::SearchConfig;
    use super::*;
    use crate::test_data::{redraw, uniform};

    const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);
    const GRID: BevGrid = BevGrid { x_min_m: -8.0, y_min_m: -4.0, cell_m: 0.5, width: 32, height: 16 };

    fn area() -> Area {
        Area::new(&GRID, [16, 32], 4)
    }

    /// Without the search, in which maps without a meaning fit anywhere.
    fn near() -> FsaConfig {
        FsaConfig { search: None, ..FsaConfig::default() }
    }

    fn random(maps: i64) -> Maps {
        Maps { features: Tensor::randn([maps, 4, 16, 32], FLOAT), mask: Tensor::ones([maps, 1, 16, 32], FLOAT) }
    }

    #[test]
    fn untrained_it_moves_nothing_and_gradients_reach_it() {
        let variables = VarStore::new(Device::Cpu);
        let fsa = SpatialAlignment::new(&variables.root(), [4, 6], &near());
        let poses = [Pose::from_xyz_yaw([3.0, 1.0, 0.0], 0.3), Pose::IDENTITY];
        let look = |maps: &Maps| fsa.looked_at(maps).unwrap();
        let maps = [&look(&random(1)), &look(&random(2))];
        let found = fsa.compare(maps, &Tensor::ones([2, TRUST], FLOAT), &poses, &area(), true).unwrap();
        assert_eq!(found.fit, Tensor::zeros([2, 6], FLOAT));
        let deltas = found.deltas;
        assert_eq!(deltas, Tensor::zeros([2, 3], FLOAT));
        let maps = Tensor::randn([2, 4, 16, 32], FLOAT);
        let lattice = lattice(&deltas, &poses, &area(), [16, 32]).unwrap();
        let (same, valid) = resample(&maps, &Tensor::ones([2, 1, 16, 32], FLOAT), &lattice).unwrap();
        assert!(same.allclose(&maps, 1e-4, 1e-4, false));
        assert_eq!(valid.min().double_value(&[]), 1.0);
        (same * Tensor::randn([2, 4, 16, 32], FLOAT)).sum(Kind::Float).backward();
        let gradient = variables.variables()["delta.weight"].grad();
        assert!(gradient.abs().max().double_value(&[]) > 0.0);
    }

    #[test]
    fn the_shift_is_bounded_whatever_is_learnt() {
        let variables = VarStore::new(Device::Cpu);
        let config = near();
        let fsa = SpatialAlignment::new(&variables.root(), [4, 6], &config);
        let _ = tch::no_grad(|| variables.variables()["delta.bias"].shallow_clone().fill_(1e6));
        let trust = Tensor::ones([1, TRUST], FLOAT);
        let look = |maps: &Maps| fsa.looked_at(maps).unwrap();
        let deltas = fsa
            .compare([&look(&random(1)), &look(&random(1))], &trust, &[Pose::IDENTITY], &area(), true)
            .unwrap()
            .deltas;
        let found = Vec::<f32>::try_from(deltas.view(-1)).unwrap();
        assert!((found[0] - 3.0).abs() < 1e-6 && (f64::from(found[2]) - config.max_turn_rad).abs() < 1e-6);
    }

    /// What FSA with some search does to maps: the ego's; the same twelve cells too far along x and sixteen back along y; and
    /// somebody else's.
    fn far_off(search: SearchConfig, train: bool) -> Vec<f32> {
        let grid = BevGrid { x_min_m: -24.0, y_min_m: -16.0, cell_m: 0.5, width: 96, height: 64 };
        let (area, trust) = (Area::new(&grid, [64, 96], 4), Tensor::ones([3, TRUST], FLOAT));
        let variables = VarStore::new(Device::Cpu);
        let config = FsaConfig { search: Some(search), ..FsaConfig::default() };
        let fsa = SpatialAlignment::new(&variables.root(), [4, 6], &config);
        redraw(&variables, &["matching"], 0.3);
        let map = |seed| uniform(seed, &[1, 4, 64, 96]).gt(0.99).to_kind(Kind::Float);
        let with_mask = |features: Tensor| {
            let (maps, _, height, width) = features.size4().unwrap();
            Maps { features, mask: Tensor::ones([maps, 1, height, width], FLOAT) }
        };
        let others = with_mask(Tensor::cat(&[&map(5), &map(5).roll([-16, 12], [2, 3]), &map(6)], 0));
        let poses = [Pose::IDENTITY, Pose::from_xyz_yaw([3.0, 1.0, 0.0], 0.3), Pose::IDENTITY];
        let compared = || {
            let [ego, others] = [&with_mask(map(5)), &others].map(|maps| fsa.looked_at(maps).unwrap());
            fsa.compare([&ego, &others], &trust, &poses, &area, train).unwrap().deltas
        };
        Vec::try_from(no_grad(compared).view(-1)).unwrap()
    }

    #[test]
    fn a_map_that_is_far_off_comes_back_and_others_stay() {
        let search = SearchConfig { cells: 4, radius: 9, margin: 0.3 };
        let back = [0.0, 0.0, 0.0, -6.0, 8.0, 0.0, 0.0, 0.0, 0.0];
        assert_eq!(far_off(search, true), back);
        assert_eq!(far_off(search, false), back);
        // Beyond what is searched it is not found.
        assert_eq!(far_off(SearchConfig { radius: 1, ..search }, false), [0.0; 9]);
    }

    #[test]
    fn once_trained_it_compares_closely_what_a_margin_would_have_left() {
        let search = SearchConfig { cells: 4, radius: 9, margin: 2.0 };
        assert_eq!(far_off(search, true), [0.0; 9]);
        assert_eq!(far_off(search, false), [0.0, 0.0, 0.0, -6.0, 8.0, 0.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn a_second_look_takes_away_what_the_first_has_left() {
        let variables = VarStore::new(Device::Cpu);
        let fsa = SpatialAlignment::new(&variables.root(), [4, 6], &near());
        redraw(&variables, &["matching"], 0.3);
        // A part of the motion that is seen is taken.
        let _ = no_grad(|| variables.variables()["delta.bias"].narrow(0, 3, 3).fill_(0.6));
        let map = uniform(5, &[1, 4, 16, 32]).gt(0.97).to_kind(Kind::Float);
        let maps = [map.shallow_clone(), map.roll([3], [3])]
            .map(|features| fsa.looked_at(&Maps { mask: features.ones_like().narrow(1, 0, 1), features }).unwrap());
        let shift_x_m = |train| {
            let found =
                fsa.compare([&maps[0], &maps[1]], &Tensor::ones([1, TRUST], FLOAT), &[Pose::IDENTITY], &area(), train);
            found.unwrap().deltas.double_value(&[0, 0])
        };
        let (first, both) = (shift_x_m(true), shift_x_m(false));
        assert!(first < -AGAIN_M, "{first}");
        assert!((both + 1.5).abs() < 0.7 * (first + 1.5).abs(), "{first} {both}");
    }

    #[test]
    fn shifts_of_parts_make_the_motion_that_a_wrong_pose_needs() {
        let sender = Pose::from_xyz_yaw([3.0, -1.0, 0.0], 0.4);
        let (turn, shift) = (0.02_f64, [0.7, -0.3]);
        let (middles, senders) = (area().middles_of_parts().unwrap(), area().places_of(&[sender]).unwrap());
        // Each part moves by the shift, and by the turn about the sender.
        let parts: Vec<f32> = (0..PARTS * PARTS)
            .flat_map(|part| {
                let [x, y] = [0, 1].map(|axis| middles.double_value(&[part, axis]) - senders.double_value(&[0, axis]));
                [(shift[0] - turn * y) as f32, (shift[1] + turn * x) as f32]
            })
            .collect();
        let parts = Tensor::from_slice(&parts).view([-1, 1, 2]);
        let motion = rigid_motion(&parts, &Tensor::ones([PARTS * PARTS, 1], FLOAT), &senders, &area()).unwrap();
        let [dx, dy, theta] = [0, 1, 2].map(|index| motion.double_value(&[0, index]));
        // The turn comes out smaller by the arm that is added, and the shift by what that turn moves the sender.
        assert!(theta > 0.4 * turn && theta <= turn, "{theta}");
        assert!((dx - shift[0]).abs() < 0.05 && (dy - shift[1]).abs() < 0.05, "{dx} {dy}");
    }
}
