//! FSA, Feature Spatial Alignment: how far a neighbour's map lies beside the ego's, and the map moved there.

use protocol::{BevGrid, Pose};
use tch::nn::{self, Init, Module};
use tch::{Kind, TchError, Tensor};

use super::config::FsaConfig;
use crate::warp::{BILINEAR, NEAREST, PADDING_ZEROS};

/// Rows and columns that the last convolution is pooled to: enough to tell a turn from a shift.
const POOLED: i64 = 4;
/// Keeps the length of an empty token from being divided by.
const EPSILON: f64 = 1e-6;

/// The area of a padded map, metres.
#[derive(Debug, Clone, Copy)]
pub(super) struct Area {
    middle_m: [f64; 2],
    half_m: [f64; 2],
}

impl Area {
    /// The area of `height` x `width` cells that begin where `grid` begins.
    pub(super) fn new(grid: &BevGrid, [height, width]: [i64; 2]) -> Self {
        let half_m = [width as f64 * grid.cell_m / 2.0, height as f64 * grid.cell_m / 2.0];
        Self { middle_m: [grid.x_min_m + half_m[0], grid.y_min_m + half_m[1]], half_m }
    }
}

/// Predicts `(dx, dy, theta)` of every neighbour's map from what it shows and what the ego shows, and how much its pose
/// is trusted. The detection loss alone teaches it.
#[derive(Debug)]
pub(super) struct SpatialAlignment {
    config: FsaConfig,
    matching: nn::Linear,
    convolutions: [nn::Conv2D; 3],
    hidden: nn::Linear,
    delta: nn::Linear,
}

impl SpatialAlignment {
    /// Moves nothing before it is trained.
    pub(super) fn new(path: &nn::Path<'_>, dim: i64, config: &FsaConfig) -> Self {
        let FsaConfig { matching, radius, channels, .. } = *config;
        let inputs = (2 * radius + 1).pow(2) + 2 * matching + 1;
        let stride = |name: &str, from, to, stride| {
            nn::conv2d(path / name, from, to, 3, nn::ConvConfig { stride, padding: 1, ..Default::default() })
        };
        let still = nn::LinearConfig { ws_init: Init::Const(0.0), bs_init: Some(Init::Const(0.0)), bias: true };
        Self {
            matching: nn::linear(path / "matching", dim, matching, nn::LinearConfig::default()),
            convolutions: [
                stride("conv0", inputs, channels, 2),
                stride("conv1", channels, channels, 2),
                stride("conv2", channels, 2 * channels, 1),
            ],
            hidden: nn::linear(path / "hidden", 2 * channels * POOLED * POOLED, 64, nn::LinearConfig::default()),
            delta: nn::linear(path / "delta", 64, 3, still),
            config: config.clone(),
        }
    }

    /// `[N - 1, 3]`: shift along x and y in metres, turn in radians, of every entry but the first.
    ///
    /// # Shapes
    /// - `tokens`: `[N, h, w, D]`, the ego's newest map first
    /// - `valid`: `[N, h, w]`, 1 where a token shows something
    /// - `shares`: `[N]`, the confidence embedding
    pub(super) fn deltas(&self, tokens: &Tensor, valid: &Tensor, shares: &Tensor) -> Result<Tensor, TchError> {
        let (entries, height, width, _) = tokens.size4()?;
        let matching = self.matching.forward(tokens).f_permute([0, 3, 1, 2])?;
        let valid = valid.f_unsqueeze(1)?;
        let length = matching.f_square()?.f_sum_dim_intlist([1_i64].as_slice(), true, None)?.f_add_scalar(EPSILON)?;
        let matching = (matching * length.f_rsqrt()? * &valid).f_contiguous()?;
        let (ego, others) = (matching.f_narrow(0, 0, 1)?, matching.f_narrow(0, 1, entries - 1)?);
        let share = shares.f_narrow(0, 1, entries - 1)?.f_view([-1, 1, 1, 1])?;
        let mut inputs = self.likeness(&ego, &others)?;
        inputs.push(ego.f_expand([entries - 1, -1, -1, -1], false)?);
        inputs.push(others);
        inputs.push(share.f_expand([entries - 1, 1, height, width], false)? * valid.f_narrow(0, 1, entries - 1)?);
        let mut map = Tensor::f_cat(&inputs, 1)?;
        for convolution in &self.convolutions {
            map = convolution.forward(&map).f_relu()?;
        }
        let pooled = map.f_adaptive_avg_pool2d([POOLED, POOLED])?.f_flatten(1, -1)?;
        let FsaConfig { max_shift_m, max_turn_rad, .. } = self.config;
        let bounds = Tensor::f_from_slice(&[max_shift_m as f32, max_shift_m as f32, max_turn_rad as f32])?;
        let raw = self.delta.forward(&self.hidden.forward(&pooled).f_relu()?);
        Ok(raw.f_tanh()? * bounds.f_to_device(tokens.device())?)
    }

    /// How alike the tokens of others are to the ego's some tokens away: `[N - 1, 1, h, w]` for every such step.
    fn likeness(&self, ego: &Tensor, others: &Tensor) -> Result<Vec<Tensor>, TchError> {
        let (_, _, height, width) = ego.size4()?;
        let radius = self.config.radius;
        let around = ego.f_constant_pad_nd([radius; 4])?;
        let mut likeness = Vec::new();
        for row in 0..=2 * radius {
            for column in 0..=2 * radius {
                let moved = around.f_narrow(2, row, height)?.f_narrow(3, column, width)?;
                likeness.push((others * moved).f_sum_dim_intlist([1_i64].as_slice(), true, None)?);
            }
        }
        Ok(likeness)
    }
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

/// Maps `[N, C, H, W]` and what is valid of them `[N, 1, H, W]`, read at `lattice`; nothing is valid beyond their edges.
pub(super) fn resample(maps: &Tensor, valid: &Tensor, lattice: &Tensor) -> Result<(Tensor, Tensor), TchError> {
    let valid = valid.f_grid_sampler(&lattice.f_detach()?, NEAREST, PADDING_ZEROS, false)?.f_to_kind(Kind::Float)?;
    Ok((maps.f_grid_sampler(lattice, BILINEAR, PADDING_ZEROS, false)? * &valid, valid))
}

#[cfg(test)]
mod tests {
    use tch::Device;
    use tch::nn::VarStore;

    use super::*;
    use crate::warp::warp_to_ego;

    const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);
    const GRID: BevGrid = BevGrid { x_min_m: -8.0, y_min_m: -4.0, cell_m: 0.5, width: 32, height: 16 };

    fn area() -> Area {
        Area::new(&GRID, [16, 32])
    }

    fn moved(maps: &Tensor, delta: [f32; 3], ego_from_cav: Pose) -> Tensor {
        let deltas = Tensor::from_slice(&delta).view([1, 3]);
        let lattice = lattice(&deltas, &[ego_from_cav], &area(), [16, 32]).unwrap();
        resample(maps, &Tensor::ones([1, 1, 16, 32], FLOAT), &lattice).unwrap().0
    }

    #[test]
    fn untrained_it_moves_nothing_and_gradients_reach_it() {
        let variables = VarStore::new(Device::Cpu);
        let fsa = SpatialAlignment::new(&variables.root(), 8, &FsaConfig::default());
        let tokens = Tensor::randn([3, 16, 32, 8], FLOAT);
        let valid = Tensor::ones([3, 16, 32], FLOAT);
        let deltas = fsa.deltas(&tokens, &valid, &Tensor::from_slice(&[0.5f32, 0.25, 0.25])).unwrap();
        assert_eq!(deltas, Tensor::zeros([2, 3], FLOAT));
        let maps = Tensor::randn([2, 4, 16, 32], FLOAT);
        let poses = [Pose::from_xyz_yaw([3.0, 1.0, 0.0], 0.3), Pose::IDENTITY];
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
        let by_delta = moved(&maps, [1.0, -0.5, 0.1], Pose::IDENTITY);
        let inside = |map: &Tensor| map.narrow(2, 4, 8).narrow(3, 8, 16);
        assert!(inside(&by_delta).allclose(&inside(&by_pose.features), 1e-3, 1e-3, false));
    }

    #[test]
    fn a_turn_is_about_the_vehicle_that_made_the_map() {
        let map = Tensor::zeros([1, 1, 16, 32], FLOAT);
        // The cell of the vehicle itself, at (3.25, 1.25), stays where it is; one beside it does not.
        let _ = map.get(0).get(0).get(10).get(22).fill_(1.0);
        let vehicle = Pose::from_xyz_yaw([3.25, 1.25, 0.0], 0.7);
        assert!((moved(&map, [0.0, 0.0, 0.5], vehicle).double_value(&[0, 0, 10, 22]) - 1.0).abs() < 1e-3);
        let _ = map.get(0).get(0).get(10).get(28).fill_(1.0);
        assert!(moved(&map, [0.0, 0.0, 0.5], vehicle).double_value(&[0, 0, 10, 28]) < 0.1);
    }

    #[test]
    fn the_shift_is_bounded_whatever_is_learnt() {
        let variables = VarStore::new(Device::Cpu);
        let config = FsaConfig::default();
        let fsa = SpatialAlignment::new(&variables.root(), 8, &config);
        let _ = tch::no_grad(|| variables.variables()["delta.bias"].shallow_clone().fill_(1e6));
        let shares = Tensor::from_slice(&[0.5f32, 0.5]);
        let deltas = fsa.deltas(&Tensor::randn([2, 8, 8, 8], FLOAT), &Tensor::ones([2, 8, 8], FLOAT), &shares).unwrap();
        let found = Vec::<f32>::try_from(deltas.view(-1)).unwrap();
        assert!((found[0] - 3.0).abs() < 1e-6 && (f64::from(found[2]) - config.max_turn_rad).abs() < 1e-6);
    }
}
