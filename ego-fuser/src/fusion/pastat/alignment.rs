//! FSA, Feature Spatial Alignment: how far a neighbour's map lies beside the ego's, and the map moved there.

use protocol::{BevGrid, Pose};
use tch::nn::{self, Init, Module};
use tch::{Kind, TchError, Tensor};

use super::config::FsaConfig;
use super::correlation::{PARTS, correlate, peaks, shifts};
use super::entries::Maps;
use super::search::offsets;
use crate::numbers::pointwise;
use crate::warp::{BILINEAR, NEAREST, PADDING_ZEROS};

/// Keeps the weight of a map that fits nowhere from being divided by.
const EPSILON: f64 = 1e-6;
/// How sharply the best shift stands out before it is trained: correlations lie between -1 and 1.
const SHARPNESS: f64 = 20.0;
/// Numbers that tell how much a pose is trusted.
pub(super) const TRUST: i64 = 3;
/// What is added to the lever arm of a turn, metres.
const ARM_M: f64 = 5.0;

/// The area of a padded map, metres.
#[derive(Debug, Clone, Copy)]
pub(super) struct Area {
    middle_m: [f64; 2],
    half_m: [f64; 2],
    cell_m: f64,
    /// Cells of the ego's lattice along each edge of a cell.
    cells: i64,
    /// Cells are compared with those of the ego up to so many cells away.
    radius: i64,
}

impl Area {
    /// The area of `height` x `width` cells that begin where `grid` begins; maps are compared up to `radius` cells away.
    pub(super) fn new(grid: &BevGrid, [height, width]: [i64; 2], radius: i64) -> Self {
        let half_m = [width as f64 * grid.cell_m / 2.0, height as f64 * grid.cell_m / 2.0];
        Self {
            middle_m: [grid.x_min_m + half_m[0], grid.y_min_m + half_m[1]],
            half_m,
            cell_m: grid.cell_m,
            cells: 1,
            radius,
        }
    }

    /// The same with cells of `cells` by `cells`, compared up to about as many metres away.
    pub(super) fn with_cells_of(self, cells: i64) -> Self {
        let (cell_m, radius) = (self.cell_m * cells as f64, (self.radius + cells - 1) / cells);
        Self { cell_m, cells: self.cells * cells, radius, ..self }
    }

    /// Edge of a cell, metres.
    pub(super) fn cell_m(&self) -> f64 {
        self.cell_m
    }

    /// Cells of the ego's lattice along each edge of a cell.
    pub(super) fn cells(&self) -> i64 {
        self.cells
    }

    /// `[PARTS^2, 2]`: the middles of the parts that maps are compared by, metres from the middle of the area.
    fn middles_of_parts(&self) -> Result<Tensor, TchError> {
        let along = |part: i64, half_m: f64| (((2 * part + 1) as f64 / PARTS as f64 - 1.0) * half_m) as f32;
        let [half_x, half_y] = self.half_m;
        let middles: Vec<f32> = (0..PARTS)
            .flat_map(|row| (0..PARTS).flat_map(move |column| [along(column, half_x), along(row, half_y)]))
            .collect();
        Tensor::f_from_slice(&middles)?.f_view([-1, 2])
    }
}

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

/// What the comparison of `K` maps with the ego's has found.
#[derive(Debug)]
pub(super) struct Found {
    /// `[K, 3]`: shift along x and y in metres, turn in radians.
    pub(super) deltas: Tensor,
    /// `[K, D]`: how well each map fits, as a token. A map that fits nowhere is of a sender that is not where it says.
    pub(super) fit: Tensor,
}

impl Found {
    /// What several comparisons have found, one after another.
    pub(super) fn all(found: &[Self]) -> Result<Self, TchError> {
        let cat = |of: fn(&Self) -> &Tensor| Tensor::f_cat(&found.iter().map(of).collect::<Vec<_>>(), 0);
        Ok(Self { deltas: cat(|found| &found.deltas)?, fit: cat(|found| &found.fit)? })
    }
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
    /// # Shapes
    /// - `ego`, `others`: what is [looked at](Self::looked_at) of 1 and `K` maps, on the lattice of `area`
    /// - `trust`: `[K, 3]`, the confidence embedding, the confidence itself and the ego's; zeros: nothing is known
    /// - `ego_from_cav`: `K` poses of the maps' senders
    pub(super) fn compare(
        &self,
        ego: &Maps,
        others: &Maps,
        trust: &Tensor,
        ego_from_cav: &[Pose],
        area: &Area,
    ) -> Result<Found, TchError> {
        let (own, mut shown) = (self.shown(ego)?, self.shown(others)?);
        let far = self.config.search.map(|search| offsets([&own, &shown], area, search)).transpose()?;
        if let Some(far) = &far {
            shown = shifted(&shown, others, far, ego_from_cav, area)?;
        }
        let found = correlate([&own, &shown], area.radius, PARTS)?;
        let device = others.features.device();
        let shifts = (shifts(area.radius)? * area.cell_m).f_to_device(device)?;
        let sharpness = self.sharpness.f_exp()?;
        let parts = peaks(&found.parts, &sharpness, &shifts)?;
        let whole = peaks(&found.whole, &sharpness, &shifts)?;
        let [fit, fit_whole] = [&found.parts, &found.whole].map(|found| found.f_amax([-1_i64].as_slice(), false));
        let (fit, fit_whole) = (fit?, fit_whole?);
        let weight = fit.f_relu()?.f_square()? * &found.energy;
        let senders = senders(ego_from_cav, area)?.f_to_device(device)?;
        let senders = match &far {
            Some(far) => senders + far,
            None => senders,
        };
        let motion = rigid_motion(&parts, &weight, &senders, area)?;
        let by_entry = |parts: Tensor| parts.f_transpose(0, 1)?.f_reshape([ego_from_cav.len() as i64, -1]);
        let motion_in = motion.shallow_clone();
        let inputs =
            [by_entry(parts)?, by_entry(fit)?, whole, fit_whole.f_unsqueeze(1)?, motion_in, trust.shallow_clone()];
        let hidden = self.hidden.forward(&Tensor::f_cat(&inputs, 1)?).f_relu()?;
        let learnt = self.delta.forward(&hidden);
        let FsaConfig { max_shift_m, max_turn_rad, .. } = self.config;
        let bounds = Tensor::f_from_slice(&[max_shift_m as f32, max_shift_m as f32, max_turn_rad as f32])?;
        let bounds = bounds.f_to_device(device)?;
        let raw = learnt.f_narrow(1, 0, 3)? + motion / &bounds * learnt.f_narrow(1, 3, 3)?;
        let near = raw.f_tanh()? * bounds;
        let deltas = match far {
            Some(far) => near + far.f_constant_pad_nd([0, 1])?,
            None => near,
        };
        Ok(Found { deltas, fit: self.fit.forward(&hidden) })
    }

    /// What is compared, `[N, M, H, W]`: zero in the mean of what a map shows, so that empty road fits nothing.
    fn shown(&self, Maps { features, mask }: &Maps) -> Result<Tensor, TchError> {
        let shown = self.matching[1].forward(&features.f_relu()?);
        let over_map = |tensor: &Tensor| tensor.f_sum_dim_intlist([2_i64, 3].as_slice(), true, None);
        let mean = over_map(&(&shown * mask))? / over_map(mask)?.f_clamp_min(1.0)?;
        Ok((shown - mean) * mask)
    }
}

/// What is compared of maps, moved by `offsets` `[K, 2]`, metres.
fn shifted(
    shown: &Tensor,
    maps: &Maps,
    offsets: &Tensor,
    ego_from_cav: &[Pose],
    area: &Area,
) -> Result<Tensor, TchError> {
    if offsets.f_count_nonzero(None::<i64>)?.f_int64_value(&[])? == 0 {
        return Ok(shown.shallow_clone());
    }
    let (.., height, width) = shown.size4()?;
    let places = lattice(&offsets.f_constant_pad_nd([0, 1])?, ego_from_cav, area, [height, width])?;
    let (moved, valid) = resample(shown, &maps.mask, &places)?;
    moved.f_mul(&valid)
}

/// The motion that fits the shifts of the parts best, `[N, 3]`: a shift, metres, after a small turn about the sender, radians.
///
/// # Shapes
/// - `parts`: `[PARTS^2, N, 2]` shifts, metres
/// - `weight`: `[PARTS^2, N]` how sure each of them is
/// - `senders`: `[N, 2]`, see [`senders`]
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

/// Where senders are, metres from the middle of the area, `[N, 2]`.
fn senders(ego_from_cav: &[Pose], area: &Area) -> Result<Tensor, TchError> {
    let from_middle = |pose: &Pose| [0, 1].map(|axis| (pose.translation_m[axis] - area.middle_m[axis]) as f32);
    let senders: Vec<f32> = ego_from_cav.iter().flat_map(from_middle).collect();
    Tensor::f_from_slice(&senders)?.f_view([-1, 2])
}

/// Where the cells of the ego's lattice lie on maps that are moved by `deltas`, for `grid_sampler`: `[N, H, W, 2]`.
///
/// A map is turned about the place of the vehicle that made it and then shifted, both in the ego's frame, so that an
/// error of its pose's heading is one number and not three.
pub(super) fn lattice(deltas: &Tensor, ego_from_cav: &[Pose], area: &Area, size: [i64; 2]) -> Result<Tensor, TchError> {
    let maps = ego_from_cav.len() as i64;
    let [half_x, half_y] = area.half_m;
    let along = |axis: usize| {
        let offsets: Vec<f32> =
            ego_from_cav.iter().map(|pose| (area.middle_m[axis] - pose.translation_m[axis]) as f32).collect();
        Tensor::f_from_slice(&offsets)?.f_to_device(deltas.device())
    };
    // p_map = v + R^T (p_ego - v - d), with v the vehicle's place and d the shift; then p = middle + half * normalised.
    let (middle_x, middle_y) = (along(0)?, along(1)?);
    let theta = deltas.f_select(1, 2)?;
    let (cos, sin) = (theta.f_cos()?, theta.f_sin()?);
    let from_x = &middle_x - deltas.f_select(1, 0)?;
    let from_y = &middle_y - deltas.f_select(1, 1)?;
    let x0 = (&cos * &from_x + &sin * &from_y - middle_x) / half_x;
    let y0 = (&cos * &from_y - &sin * &from_x - middle_y) / half_y;
    let affine = [&cos, &(&sin * (half_y / half_x)), &x0, &(&sin * (-half_x / half_y)), &cos, &y0];
    let affine = Tensor::f_stack(&affine, 1)?.f_view([maps, 2, 3])?;
    Tensor::f_affine_grid_generator(&affine, [maps, 1, size[0], size[1]], false)
}

/// Where a vehicle was by a `delta`, see [`lattice`].
pub(super) fn moved(ego_from_cav: &Pose, delta: &[f64]) -> Pose {
    let [x, y, z] = ego_from_cav.translation_m;
    Pose::from_xyz_yaw([x + delta[0], y + delta[1], z], ego_from_cav.yaw_rad() + delta[2])
}

/// Maps `[N, C, H, W]` and what is valid of them `[N, 1, H, W]`, read at `lattice`. Nothing is valid beyond their edges; maps
/// are not zero where nothing is valid.
pub(super) fn resample(maps: &Tensor, valid: &Tensor, lattice: &Tensor) -> Result<(Tensor, Tensor), TchError> {
    let valid = valid.f_grid_sampler(&lattice.f_detach()?, NEAREST, PADDING_ZEROS, false)?.f_to_kind(Kind::Float)?;
    Ok((maps.f_grid_sampler(lattice, BILINEAR, PADDING_ZEROS, false)?, valid))
}

#[cfg(test)]
mod tests {
    use tch::Device;
    use tch::nn::VarStore;

    use super::*;
    use crate::made_up::{redraw, uniform};
    use crate::warp::warp_to_ego;

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

    fn map_moved(maps: &Tensor, delta: [f32; 3], ego_from_cav: Pose) -> Tensor {
        let deltas = Tensor::from_slice(&delta).view([1, 3]);
        let lattice = lattice(&deltas, &[ego_from_cav], &area(), [16, 32]).unwrap();
        resample(maps, &Tensor::ones([1, 1, 16, 32], FLOAT), &lattice).unwrap().0
    }

    #[test]
    fn untrained_it_moves_nothing_and_gradients_reach_it() {
        let variables = VarStore::new(Device::Cpu);
        let fsa = SpatialAlignment::new(&variables.root(), [4, 6], &near());
        let poses = [Pose::from_xyz_yaw([3.0, 1.0, 0.0], 0.3), Pose::IDENTITY];
        let look = |maps: &Maps| fsa.looked_at(maps).unwrap();
        let found = fsa
            .compare(&look(&random(1)), &look(&random(2)), &Tensor::ones([2, TRUST], FLOAT), &poses, &area())
            .unwrap();
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
    fn a_delta_moves_a_map_as_a_pose_would() {
        let maps = Tensor::randn([1, 2, 16, 32], FLOAT);
        // A vehicle at the ego's own place: turning about it and then shifting is a pose.
        let by_pose = warp_to_ego(&maps, None, &[Pose::from_xyz_yaw([1.0, -0.5, 0.0], 0.1)], &GRID).unwrap();
        let by_delta = map_moved(&maps, [1.0, -0.5, 0.1], Pose::IDENTITY);
        let inside = |map: &Tensor| map.narrow(2, 4, 8).narrow(3, 8, 16);
        assert!(inside(&by_delta).allclose(&inside(&by_pose.features), 1e-3, 1e-3, false));
    }

    #[test]
    fn a_turn_is_about_the_vehicle_that_made_the_map() {
        let map = Tensor::zeros([1, 1, 16, 32], FLOAT);
        // The cell of the vehicle itself, at (3.25, 1.25), stays where it is; one beside it does not.
        let _ = map.get(0).get(0).get(10).get(22).fill_(1.0);
        let vehicle = Pose::from_xyz_yaw([3.25, 1.25, 0.0], 0.7);
        assert!((map_moved(&map, [0.0, 0.0, 0.5], vehicle).double_value(&[0, 0, 10, 22]) - 1.0).abs() < 1e-3);
        let _ = map.get(0).get(0).get(10).get(28).fill_(1.0);
        assert!(map_moved(&map, [0.0, 0.0, 0.5], vehicle).double_value(&[0, 0, 10, 28]) < 0.1);
    }

    #[test]
    fn the_shift_is_bounded_whatever_is_learnt() {
        let variables = VarStore::new(Device::Cpu);
        let config = near();
        let fsa = SpatialAlignment::new(&variables.root(), [4, 6], &config);
        let _ = tch::no_grad(|| variables.variables()["delta.bias"].shallow_clone().fill_(1e6));
        let trust = Tensor::ones([1, TRUST], FLOAT);
        let look = |maps: &Maps| fsa.looked_at(maps).unwrap();
        let deltas =
            fsa.compare(&look(&random(1)), &look(&random(1)), &trust, &[Pose::IDENTITY], &area()).unwrap().deltas;
        let found = Vec::<f32>::try_from(deltas.view(-1)).unwrap();
        assert!((found[0] - 3.0).abs() < 1e-6 && (f64::from(found[2]) - config.max_turn_rad).abs() < 1e-6);
    }

    #[test]
    fn a_map_that_is_far_off_comes_back_and_then_fits_as_well_as_any() {
        let grid = BevGrid { x_min_m: -24.0, y_min_m: -16.0, cell_m: 0.5, width: 96, height: 64 };
        let (area, trust) = (Area::new(&grid, [64, 96], 4), Tensor::ones([2, TRUST], FLOAT));
        let variables = VarStore::new(Device::Cpu);
        let fsa = SpatialAlignment::new(&variables.root(), [4, 6], &FsaConfig::default());
        redraw(&variables, &["matching"], 0.3);
        let features = uniform(5, &[1, 4, 64, 96]).gt(0.99).to_kind(Kind::Float);
        let far = features.roll([-16, 12], [2, 3]);
        let with_mask = |features: Tensor| {
            let (maps, _, height, width) = features.size4().unwrap();
            Maps { features, mask: Tensor::ones([maps, 1, height, width], FLOAT) }
        };
        let others = with_mask(Tensor::cat(&[&features, &far], 0));
        let poses = [Pose::IDENTITY, Pose::from_xyz_yaw([3.0, 1.0, 0.0], 0.3)];
        let look = |maps: &Maps| fsa.looked_at(maps).unwrap();
        let deltas = fsa.compare(&look(&with_mask(features)), &look(&others), &trust, &poses, &area).unwrap().deltas;
        let found = Vec::<f32>::try_from(deltas.view(-1)).unwrap();
        assert_eq!(found, [0.0, 0.0, 0.0, -6.0, 8.0, 0.0]);
    }

    #[test]
    fn shifts_of_parts_make_the_motion_that_a_wrong_pose_needs() {
        let sender = Pose::from_xyz_yaw([3.0, -1.0, 0.0], 0.4);
        let (turn, shift) = (0.02_f64, [0.7, -0.3]);
        let middles = area().middles_of_parts().unwrap();
        // Each part moves by the shift, and by the turn about the sender.
        let parts: Vec<f32> = (0..PARTS * PARTS)
            .flat_map(|part| {
                let [x, y] = [0, 1].map(|axis| {
                    middles.double_value(&[part, axis]) + area().middle_m[axis as usize]
                        - sender.translation_m[axis as usize]
                });
                [(shift[0] - turn * y) as f32, (shift[1] + turn * x) as f32]
            })
            .collect();
        let parts = Tensor::from_slice(&parts).view([-1, 1, 2]);
        let wide = Area { cell_m: 0.5, ..area() };
        let motion =
            rigid_motion(&parts, &Tensor::ones([PARTS * PARTS, 1], FLOAT), &senders(&[sender], &wide).unwrap(), &wide)
                .unwrap();
        let [dx, dy, theta] = [0, 1, 2].map(|index| motion.double_value(&[0, index]));
        // The turn comes out smaller by the arm that is added, and the shift by what that turn moves the sender.
        assert!(theta > 0.4 * turn && theta <= turn, "{theta}");
        assert!((dx - shift[0]).abs() < 0.05 && (dy - shift[1]).abs() < 0.05, "{dx} {dy}");
    }
}
