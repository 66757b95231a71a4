//! Area of feature maps, and resampling of maps that are moved on it.

use protocol::{BevGrid, Pose};
use tch::{Kind, TchError, Tensor};

use super::correlation::PARTS;
use crate::planar_pose::planar;
use crate::warp::{BILINEAR, NEAREST, PADDING_ZEROS};

/// The area of a padded map, metres.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Area {
    middle_m: [f64; 2],
    half_m: [f64; 2],
    /// Rows and columns.
    size: [i64; 2],
    /// Edge of a cell, metres.
    pub(crate) cell_m: f64,
    /// Cells of the ego's grid along each edge of a cell.
    pub(crate) cells: i64,
    /// Largest offset between compared cells, cells.
    pub(crate) radius: i64,
}

impl Area {
    /// The area of `height` x `width` cells that begin where `grid` begins; maps are compared up to `radius` cells
    /// away.
    pub(crate) fn new(grid: &BevGrid, [height, width]: [i64; 2], radius: i64) -> Self {
        let half_m = [width, height].map(|cells| cells as f64 * grid.cell_m / 2.0);
        Self {
            middle_m: [grid.x_min_m + half_m[0], grid.y_min_m + half_m[1]],
            half_m,
            size: [height, width],
            cell_m: grid.cell_m,
            cells: 1,
            radius,
        }
    }

    /// The same with cells of `cells` by `cells`, compared up to about as many metres away.
    pub(crate) fn with_cells_of(self, cells: i64) -> Self {
        Self {
            size: self.size.map(|count| count / cells),
            cell_m: self.cell_m * cells as f64,
            cells: self.cells * cells,
            // Rounded up: larger cells do not shorten the range.
            radius: (self.radius + cells - 1) / cells,
            ..self
        }
    }

    /// Positions of vehicles, metres from the centre of the area, `[N, 2]`.
    pub(crate) fn places_of(&self, ego_from_cav: &[Pose]) -> Result<Tensor, TchError> {
        let places = ego_from_cav.iter().flat_map(|pose| {
            [0, 1].map(|axis| (pose.translation_m[axis] - self.middle_m[axis]) as f32)
        });
        Tensor::f_from_slice(&places.collect::<Vec<f32>>())?.f_view([-1, 2])
    }

    /// `[PARTS^2, 2]`: centres of the compared parts, metres from the centre of the area.
    pub(crate) fn middles_of_parts(&self) -> Result<Tensor, TchError> {
        let [half_x, half_y] = self.half_m;
        let middles = (0..PARTS * PARTS).flat_map(|part| {
            let (row, column) = (part / PARTS, part % PARTS);
            [(column, half_x), (row, half_y)].map(|(part, half_m)| {
                (((2 * part + 1) as f64 / PARTS as f64 - 1.0) * half_m) as f32
            })
        });
        Tensor::f_from_slice(&middles.collect::<Vec<f32>>())?.f_view([-1, 2])
    }
}

/// Positions of the ego's cells on maps that are moved by `deltas` `[N, 3]`, for `grid_sampler`: `[N, H, W, 2]`.
///
/// A map is rotated about the position of its sender and then shifted, both in the ego's frame, so that an error of its
/// pose's heading affects one number and not three.
pub(crate) fn sampling_grid(
    deltas: &Tensor,
    ego_from_cav: &[Pose],
    area: &Area,
    size: [i64; 2],
) -> Result<Tensor, TchError> {
    let senders = planar_poses(ego_from_cav)?
        .f_to_device(deltas.device())?
        .f_narrow(1, 0, 2)?;
    // p_map = v + R^T (p_ego - v - d), with v the sender's position and d the shift.
    let moved = senders.f_constant_pad_nd([0, 1])? + deltas;
    places(&moved, &senders, [area, area], size)
}

/// Positions of the ego's cells, on the grid of `area`, on maps in the frames of their senders, on `own`, given offsets
/// `deltas` `[N, 3]` of the senders from their reported poses: `[N, H, W, 2]`.
pub(crate) fn own_sampling_grid(
    deltas: &Tensor,
    ego_from_cav: &[Pose],
    [area, own]: [&Area; 2],
) -> Result<Tensor, TchError> {
    let moved = planar_poses(ego_from_cav)?.f_to_device(deltas.device())? + deltas;
    // p_cav = R^T (p_ego - v - d).
    let origin = moved.f_narrow(1, 0, 2)?.f_zeros_like()?;
    places(&moved, &origin, [area, own], area.size)
}

/// `[N, 3]`: x and y, metres, and yaw, radians.
fn planar_poses(ego_from_cav: &[Pose]) -> Result<Tensor, TchError> {
    let values = ego_from_cav.iter().flat_map(planar);
    Tensor::f_from_slice(&values.collect::<Vec<f32>>())?.f_view([-1, 3])
}

/// Positions of the cells of a grid over `area` on grids over `on`, given the position and rotation on `area`,
/// `[N, 3]`, of the point that is at `origin` `[N, 2]` on those: `[N, H, W, 2]`.
fn places(
    pose: &Tensor,
    origin: &Tensor,
    [area, on]: [&Area; 2],
    size: [i64; 2],
) -> Result<Tensor, TchError> {
    let yaw = pose.f_select(1, 2)?;
    let (cos, sin) = (yaw.f_cos()?, yaw.f_sin()?);
    let ([half_x, half_y], [on_x, on_y]) = (area.half_m, on.half_m);
    let from_x = area.middle_m[0] - pose.f_select(1, 0)?;
    let from_y = area.middle_m[1] - pose.f_select(1, 1)?;
    let at_x = origin.f_select(1, 0)? - on.middle_m[0];
    let at_y = origin.f_select(1, 1)? - on.middle_m[1];
    // R^T (p - pose) + origin, with p and the result scaled to -1..1 over their areas.
    let x0 = (&cos * &from_x + &sin * &from_y + at_x) / on_x;
    let y0 = (&cos * &from_y - &sin * &from_x + at_y) / on_y;
    let (xx, xy) = (&cos * (half_x / on_x), &sin * (half_y / on_x));
    let (yx, yy) = (&sin * (-half_x / on_y), &cos * (half_y / on_y));
    let affine = Tensor::f_stack(&[xx, xy, x0, yx, yy, y0], 1)?.f_view([-1, 2, 3])?;
    Tensor::f_affine_grid_generator(&affine, [pose.size2()?.0, 1, size[0], size[1]], false)
}

/// Maps `[N, C, H, W]` and their validity `[N, 1, H, W]`, sampled at `sampling_grid`. Cells beyond their edges are
/// invalid; the values of invalid cells are not zero.
pub(crate) fn resample(
    maps: &Tensor,
    valid: &Tensor,
    sampling_grid: &Tensor,
) -> Result<(Tensor, Tensor), TchError> {
    // Validity is a step function of the position and has no gradient.
    let valid = valid
        .f_grid_sampler(&sampling_grid.f_detach()?, NEAREST, PADDING_ZEROS, false)?
        .f_to_kind(Kind::Float)?;
    let maps = maps.f_grid_sampler(sampling_grid, BILINEAR, PADDING_ZEROS, false)?;
    Ok((maps, valid))
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;
    use crate::planar_pose::moved;
    use crate::test_data::uniform;
    use crate::warp::warp_to_ego;

    const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);
    const GRID: BevGrid = BevGrid {
        x_min_m: -8.0,
        y_min_m: -4.0,
        cell_m: 0.5,
        width: 32,
        height: 16,
    };

    fn area() -> Area {
        Area::new(&GRID, [16, 32], 4)
    }

    fn map_moved(maps: &Tensor, delta: [f32; 3], ego_from_cav: Pose) -> Tensor {
        let deltas = Tensor::from_slice(&delta).view([1, 3]);
        let sampling_grid = sampling_grid(&deltas, &[ego_from_cav], &area(), [16, 32]).unwrap();
        resample(maps, &Tensor::ones([1, 1, 16, 32], FLOAT), &sampling_grid)
            .unwrap()
            .0
    }

    #[test]
    fn a_delta_moves_a_map_as_a_pose_would() {
        let maps = Tensor::randn([1, 2, 16, 32], FLOAT);
        // A vehicle at the ego's own position: rotation about it and then a shift is a pose.
        let by_pose = warp_to_ego(
            &maps,
            None,
            &[Pose::from_xyz_yaw([1.0, -0.5, 0.0], 0.1)],
            &GRID,
        )
        .unwrap();
        let by_delta = map_moved(&maps, [1.0, -0.5, 0.1], Pose::IDENTITY);
        let [by_delta, by_pose] =
            [&by_delta, &by_pose.features].map(|map| map.narrow(2, 4, 8).narrow(3, 8, 16));
        assert!(by_delta.allclose(&by_pose, 1e-3, 1e-3, false));
    }

    #[test]
    fn a_map_sampled_as_received_equals_one_warped_by_the_right_pose() {
        let maps = uniform(3, &[1, 2, 16, 32]);
        let (pose, delta) = (Pose::from_xyz_yaw([2.3, -1.2, 0.0], 0.7), [0.8, -0.3, 0.1]);
        let by_pose = warp_to_ego(&maps, None, &[moved(&pose, delta)], &GRID).unwrap();
        let deltas = Tensor::from_slice(&delta).to_kind(Kind::Float).view([1, 3]);
        // Padded rows and columns contain the ego's cells, and more.
        let padded = Area::new(&GRID, [20, 40], 4);
        let places = own_sampling_grid(&deltas, &[pose], [&padded, &area()]).unwrap();
        let (read, valid) = resample(&maps, &Tensor::ones([1, 1, 16, 32], FLOAT), &places).unwrap();
        let [own_cells, own_mask] =
            [&(read * &valid), &valid].map(|map| map.narrow(2, 0, 16).narrow(3, 0, 32));
        let error = (own_cells - by_pose.features).abs().mean(Kind::Float);
        assert!(error.double_value(&[]) < 1e-3);
        assert_eq!(own_mask, by_pose.mask);
        assert!(
            valid.sum(Kind::Float).double_value(&[])
                > by_pose.mask.sum(Kind::Float).double_value(&[])
        );
    }

    #[test]
    fn a_turn_is_about_the_vehicle_that_made_the_map() {
        let map = Tensor::zeros([1, 1, 16, 32], FLOAT);
        // The cell of the vehicle itself, at (3.25, 1.25), stays where it is; one beside it does not.
        let _ = map.get(0).get(0).get(10).get(22).fill_(1.0);
        let vehicle = Pose::from_xyz_yaw([3.25, 1.25, 0.0], 0.7);
        assert!(
            (map_moved(&map, [0.0, 0.0, 0.5], vehicle).double_value(&[0, 0, 10, 22]) - 1.0).abs()
                < 1e-3
        );
        let _ = map.get(0).get(0).get(10).get(28).fill_(1.0);
        assert!(map_moved(&map, [0.0, 0.0, 0.5], vehicle).double_value(&[0, 0, 10, 28]) < 0.1);
    }
}
