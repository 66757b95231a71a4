//! Warp: resamples a neighbour's BEV feature map onto the BEV grid of the ego.
//!
//! Only x, y and yaw of a pose are used: feature maps have no height. Each public reference code has its own
//! convention. [`coalign`] has that of CoAlign, for networks that fuse at every level. All other weights run on the warp
//! of this module, wherever they were trained.

pub mod coalign;
mod sampling;

use perception::tensor_values::tensor;
use protocol::{BevGrid, Pose};
use tch::{Kind, TchError, Tensor};

use self::sampling::Cells;
pub(crate) use self::sampling::{SUM, Samples};
use crate::f64_tensor::{are_numbers, as_batch};

/// `grid_sampler` reads zeros outside of the map.
pub(crate) const PADDING_ZEROS: i64 = 0;
/// `grid_sampler` interpolates bilinearly between the four nearest cells.
pub(crate) const BILINEAR: i64 = 0;
/// `grid_sampler` takes the nearest cell.
pub(crate) const NEAREST: i64 = 1;

/// Error of warping maps onto the ego's grid.
#[derive(Debug, thiserror::Error)]
pub enum WarpError {
    /// The maps are not on this grid.
    #[error("features of shape {found:?} are not on a grid of {height} rows and {width} columns")]
    Shape {
        /// Shape of the tensor.
        found: Vec<i64>,
        /// Rows of the grid.
        height: u32,
        /// Columns of the grid.
        width: u32,
    },
    /// Not one pose per map.
    #[error("{maps} maps but {poses} poses")]
    PoseCount {
        /// Number of maps.
        maps: i64,
        /// Number of poses.
        poses: usize,
    },
    /// The tensor library reported an error.
    #[error("warp: {0}")]
    Torch(#[from] TchError),
}

/// Feature maps on the ego's grid.
#[derive(Debug)]
pub struct WarpedMaps {
    /// `[N, C, H, W]`, zero wherever the mask is.
    pub features: Tensor,
    /// `[N, 1, H, W]` of the same kind: 1 where the ego's cell centre lies on a cell that the CAV
    /// sent, else 0.
    pub mask: Tensor,
}

impl WarpedMaps {
    pub(crate) fn new(features: Tensor, mask: Tensor) -> Self {
        Self { features, mask }
    }

    /// Number of maps.
    pub(crate) fn count(&self) -> Result<i64, TchError> {
        Ok(self.features.size4()?.0)
    }

    /// Features and mask after the same change.
    pub(crate) fn each(
        &self,
        change: impl Fn(&Tensor) -> Result<Tensor, TchError>,
    ) -> Result<Self, TchError> {
        Ok(Self::new(change(&self.features)?, change(&self.mask)?))
    }

    /// The entries from `first` up to `end`.
    pub(crate) fn only(&self, first: i64, end: i64) -> Result<Self, TchError> {
        self.each(|maps| maps.f_narrow(0, first, end - first))
    }
}

/// Resamples BEV features of CAVs onto the ego's grid, bilinearly between cell centres.
///
/// Both maps lie on `grid`, each in the LiDAR frame of its vehicle. At the identity transform (the ego itself) the
/// features are returned unchanged, bit for bit.
///
/// # Shapes
/// - `features`: `[N, C, H, W]`; row grows with y, column with x
/// - `sent`: `[N, 1, H, W]`, 1 for cells that a CAV sent and 0 for those it left out; absent: all were sent
/// - `ego_from_cav`: N poses
///
/// # Frames and units
/// `ego_from_cav` transforms points of the CAV's LiDAR frame to the ego's: metres, x forward, y left. x, y and yaw are
/// used.
///
/// # Errors
/// [`WarpError`] when the features do not lie on `grid` or their number is not that of the poses.
pub fn warp_to_ego(
    features: &Tensor,
    sent: Option<&Tensor>,
    ego_from_cav: &[Pose],
    grid: &BevGrid,
) -> Result<WarpedMaps, WarpError> {
    check(features, ego_from_cav, grid)?;
    let (maps, _, height, width) = features.size4()?;
    let sent = match sent {
        Some(sent) => sent.f_view([maps, 1, height, width])?,
        None => Tensor::f_ones([1, 1, height, width], (Kind::Float, features.device()))?
            .f_expand([maps, 1, height, width], false)?,
    };
    let affine: Vec<_> = ego_from_cav
        .iter()
        .map(|pose| cav_from_ego_normalized(pose, grid))
        .collect();
    if affine.iter().all(|&affine| affine == UNMOVED) {
        let mask = sent.f_to_kind(features.kind())?;
        return Ok(WarpedMaps::new(features.shallow_clone(), mask));
    }
    let warped = (0..).zip(affine).map(|(index, affine)| {
        let map = features.f_narrow(0, index, 1)?;
        let sent = sent.f_narrow(0, index, 1)?;
        if affine == UNMOVED {
            return Ok((map, sent.f_to_kind(features.kind())?));
        }
        let shape = [1, height, width, 2];
        let sampling_grid = tensor(&places(affine, grid), &shape, features.device())?;
        read(&map, &sent, &sampling_grid)
    });
    let (moved, masks): (Vec<_>, Vec<_>) = warped.collect::<Result<_, TchError>>()?;
    let [features, mask] = [moved, masks].map(|maps| Tensor::f_cat(&maps, 0));
    Ok(WarpedMaps::new(features?, mask?))
}

/// [`warp_to_ego`] of maps `[N, C, H, W]` whose channels of each cell are contiguous, as in the result, each with its
/// sent cells `[H * W]`.
pub(crate) fn warp_cells(
    maps: &Tensor,
    sent: &[&[f32]],
    ego_from_cav: &[Pose],
    grid: &BevGrid,
) -> Result<WarpedMaps, WarpError> {
    let (count, channels, height, width) = maps.size4()?;
    let size = [grid.height, grid.width].map(|cells| cells as usize);
    let mut samples = Samples::default();
    for ((map, sent), pose) in sent.iter().enumerate().zip(ego_from_cav) {
        let first = map * size[0] * size[1];
        let affine = cav_from_ego_normalized(pose, grid);
        match affine == UNMOVED {
            true => samples.add_all(first, sent),
            false => samples.add((first, size), sent, &places(affine, grid), None),
        }
    }
    let cells = maps.f_permute([0, 2, 3, 1])?.f_reshape([-1, channels])?;
    let features = samples
        .read(&cells)?
        .f_view([count, height, width, channels])?;
    let mask = Tensor::f_from_slice(&samples.valid)?.f_view([count, 1, height, width])?;
    Ok(WarpedMaps::new(features.f_permute([0, 3, 1, 2])?, mask))
}

/// Checks that maps `[N, C, H, W]` lie on `grid`, one for each pose.
///
/// # Errors
/// [`WarpError`] states both sizes or counts.
pub(crate) fn check(maps: &Tensor, ego_from_cav: &[Pose], grid: &BevGrid) -> Result<(), WarpError> {
    let (found, poses) = (maps.size(), ego_from_cav.len());
    let &BevGrid { height, width, .. } = grid;
    match found[..] {
        [maps, _, rows, columns] if [rows, columns] == [height, width].map(i64::from) => {
            if maps != poses as i64 {
                return Err(WarpError::PoseCount { maps, poses });
            }
            Ok(())
        }
        _ => Err(WarpError::Shape {
            found,
            height,
            width,
        }),
    }
}

/// Positions of a grid's cells under an affine map of normalised coordinates, for `grid_sampler`: two floats for each.
fn places(affine: [f32; 6], grid: &BevGrid) -> Vec<f32> {
    let [rows, columns] = [grid.height, grid.width].map(|count| count as usize);
    let mut places = Vec::with_capacity(2 * rows * columns);
    for row in 0..rows {
        (0..columns)
            .for_each(|column| places.extend_from_slice(&place_of([row, column], affine, grid)));
    }
    places
}

/// The same of one cell, by row and column.
fn place_of(
    [row, column]: [usize; 2],
    [xx, xy, x0, yx, yy, y0]: [f32; 6],
    grid: &BevGrid,
) -> [f32; 2] {
    // Centre of a cell, -1 and 1 being the edges of the outer cells.
    let [x, y] = [(column, grid.width), (row, grid.height)]
        .map(|(cell, count)| (2 * cell + 1) as f32 / count as f32 - 1.0);
    [xx * x + xy * y + x0, yx * x + yy * y + y0]
}

/// Positions of some cells of the ego's grid, by row and column, on a map of the same `grid`, in `grid_sampler`'s
/// coordinates, two for each.
pub(crate) fn places_of(cells: &[[usize; 2]], ego_from_cav: &Pose, grid: &BevGrid) -> Vec<f32> {
    let affine = cav_from_ego_normalized(ego_from_cav, grid);
    cells
        .iter()
        .flat_map(|&cell| place_of(cell, affine, grid))
        .collect()
}

/// A map `[1, C, H, W]` and the mask of its sent cells `[1, 1, H, W]`, sampled at `sampling_grid` `[1, h, w, 2]`.
fn read(map: &Tensor, sent: &Tensor, sampling_grid: &Tensor) -> Result<(Tensor, Tensor), TchError> {
    if !are_numbers(map) {
        return read_by_tensors(map, sent, sampling_grid);
    }
    let cells = Cells::of(&map.f_squeeze_dim(0)?)?;
    let sent = sent.f_squeeze_dim(0)?.f_squeeze_dim(0)?;
    let (map, mask) = cells.read(&sent, &sampling_grid.f_squeeze_dim(0)?)?;
    Ok((as_batch(&map)?, mask.f_unsqueeze(0)?))
}

/// [`read`] on any device, in any precision, with gradients.
fn read_by_tensors(
    map: &Tensor,
    sent: &Tensor,
    sampling_grid: &Tensor,
) -> Result<(Tensor, Tensor), TchError> {
    let mask = sent
        .f_grid_sampler(sampling_grid, NEAREST, PADDING_ZEROS, false)?
        .f_to_kind(map.kind())?;
    // `grid_sampler` needs positions of the kind of the values that it reads.
    let sampling_grid = sampling_grid.f_to_kind(map.kind())?;
    let map = map.f_grid_sampler(&sampling_grid, BILINEAR, PADDING_ZEROS, false)? * &mask;
    Ok((map, mask))
}

/// The identity.
const UNMOVED: [f32; 6] = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0];

/// Rows of the affine map from normalised ego coordinates (-1..1 over the whole extent of the grid, edges of the outer
/// cells included) to normalised CAV coordinates: `[xx, xy, x0, yx, yy, y0]`.
pub fn cav_from_ego_normalized(ego_from_cav: &Pose, grid: &BevGrid) -> [f32; 6] {
    let (sin, cos) = ego_from_cav.yaw_rad().sin_cos();
    let [ego_x, ego_y, _] = ego_from_cav.translation_m;
    let half_x = grid.cell_m * f64::from(grid.width) / 2.0;
    let half_y = grid.cell_m * f64::from(grid.height) / 2.0;
    let (middle_x, middle_y) = (grid.x_min_m + half_x, grid.y_min_m + half_y);
    // p_cav = R^T (p_ego - t), with p_ego = middle + half * normalised, then back to normalised.
    let (from_x, from_y) = (middle_x - ego_x, middle_y - ego_y);
    let x0 = (cos * from_x + sin * from_y - middle_x) / half_x;
    let y0 = (-sin * from_x + cos * from_y - middle_y) / half_y;
    let (xy, yx) = (sin * half_y / half_x, -sin * half_x / half_y);
    [cos, xy, x0, yx, cos, y0].map(|value| value as f32)
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use proptest::prelude::*;
    use tch::Device;

    use super::*;
    use crate::test_data::uniform;

    const GRID: BevGrid = BevGrid {
        x_min_m: -8.0,
        y_min_m: -4.0,
        cell_m: 0.5,
        width: 32,
        height: 16,
    };

    fn one_hot(row: i64, column: i64) -> Tensor {
        let map = Tensor::zeros([1, 1, 16, 32], (Kind::Float, Device::Cpu));
        let _ = map.get(0).get(0).get(row).get(column).fill_(1.0);
        map
    }

    fn at(map: &Tensor, row: i64, column: i64) -> f64 {
        map.double_value(&[0, 0, row, column])
    }

    #[test]
    fn the_ego_passes_through_bit_for_bit() {
        let features = Tensor::randn([2, 3, 16, 32], (Kind::Float, Device::Cpu));
        let shifted = Pose::from_xyz_yaw([1.0, 0.0, 0.0], 0.1);
        let height_only = Pose::from_xyz_yaw([0.0, 0.0, 0.4], 0.0);
        let warped = warp_to_ego(&features, None, &[height_only, shifted], &GRID).unwrap();
        assert_eq!(warped.features.get(0), features.get(0));
        assert_ne!(warped.features.get(1), features.get(1));
        assert_eq!(warped.mask.get(0).min().double_value(&[]), 1.0);
    }

    #[test]
    fn a_shift_of_whole_cells_moves_cells() {
        // The CAV is 2 m ahead of the ego: a feature at its own x is four columns further for the ego.
        let pose = Pose::from_xyz_yaw([2.0, -1.0, 0.3], 0.0);
        let warped = warp_to_ego(&one_hot(6, 10), None, &[pose], &GRID).unwrap();
        assert!((at(&warped.features, 4, 14) - 1.0).abs() < 1e-4);
        assert!((warped.features.sum(Kind::Float).double_value(&[]) - 1.0).abs() < 1e-3);
        // Its map does not reach the ego's first four columns, nor the last two rows.
        assert_eq!(at(&warped.mask, 5, 3), 0.0);
        assert_eq!(at(&warped.mask, 5, 4), 1.0);
        assert_eq!(at(&warped.mask, 13, 10), 1.0);
        assert_eq!(at(&warped.mask, 14, 10), 0.0);
    }

    #[test]
    fn a_quarter_turn_takes_forward_to_left() {
        // Cell centre (x, y) = (2.25, 0.75) of a CAV turned left by 90 degrees lies at (-0.75, 2.25) of the ego.
        let turned = Pose::from_xyz_yaw([0.0, 0.0, 0.0], FRAC_PI_2);
        let warped = warp_to_ego(&one_hot(9, 20), None, &[turned], &GRID).unwrap();
        assert!((at(&warped.features, 12, 14) - 1.0).abs() < 1e-4);
    }

    #[test]
    fn the_order_of_numbers_in_memory_changes_none_of_them() {
        let maps = uniform(5, &[2, 3, 16, 32]);
        let poses = [Pose::IDENTITY, Pose::from_xyz_yaw([1.3, -0.4, 0.0], 0.2)];
        let planes = warp_to_ego(&maps, None, &poses, &GRID).unwrap();
        let cells = maps
            .permute([0, 2, 3, 1])
            .contiguous()
            .permute([0, 3, 1, 2]);
        let sent = [1.0; 16 * 32];
        let cells = warp_cells(&cells, &[&sent[..]; 2], &poses, &GRID).unwrap();
        assert_eq!(planes.features.get(0), cells.features.get(0));
        assert!(planes.features.allclose(&cells.features, 0.0, 1e-6, false));
        assert_eq!(planes.mask, cells.mask);
    }

    proptest! {
        #[test]
        fn numbers_and_tensors_read_the_same(
            x_m in -12.0..12.0f64, y_m in -6.0..6.0f64, yaw in -4.0..4.0f64, seed in 0..1000u64, channels in 1..6i64,
        ) {
            let map = uniform(seed, &[1, channels, 16, 32]);
            let sent = uniform(seed + 1, &[1, 1, 16, 32]).gt(0.3).to_kind(Kind::Float);
            let affine = cav_from_ego_normalized(&Pose::from_xyz_yaw([x_m, y_m, 0.0], yaw), &GRID);
            let places = places(affine, &GRID);
            let sampling_grid = tensor(&places, &[1, 16, 32, 2], Device::Cpu).unwrap();
            let theta = Tensor::from_slice(&affine).view([1, 2, 3]);
            let apart = &sampling_grid - Tensor::affine_grid_generator(&theta, [1, 1, 16, 32], false);
            prop_assert!(apart.abs().max().double_value(&[]) < 1e-4);
            let (numbers, reached) = read(&map, &sent, &sampling_grid).unwrap();
            let (tensors, mask) = read_by_tensors(&map, &sent, &sampling_grid).unwrap();
            prop_assert_eq!(numbers.size(), tensors.size());
            // At a position between two cells either may be the nearest.
            let differ = (&reached - mask).abs();
            prop_assert!(differ.sum(Kind::Float).double_value(&[]) <= 2.0);
            let apart = (numbers - tensors).abs() * differ.eq(0.0);
            prop_assert!(apart.max().double_value(&[]) < 1e-4);
        }
    }

    #[test]
    fn half_a_cell_shares_between_two() {
        let warped = warp_to_ego(
            &one_hot(8, 16),
            None,
            &[Pose::from_xyz_yaw([0.25, 0.0, 0.0], 0.0)],
            &GRID,
        )
        .unwrap();
        assert!((at(&warped.features, 8, 16) - 0.5).abs() < 1e-4);
        assert!((at(&warped.features, 8, 17) - 0.5).abs() < 1e-4);
    }

    #[test]
    fn two_half_turns_give_the_map_back() {
        let features = Tensor::randn([1, 2, 16, 32], (Kind::Float, Device::Cpu));
        let turn = [Pose::from_xyz_yaw([0.0, 0.0, 0.0], PI)];
        let once = warp_to_ego(&features, None, &turn, &GRID).unwrap().features;
        let twice = warp_to_ego(&once, None, &turn, &GRID).unwrap().features;
        assert!((twice - features).abs().max().double_value(&[]) < 1e-3);
    }

    #[test]
    fn a_neighbour_out_of_reach_leaves_nothing() {
        let features = Tensor::ones([1, 2, 16, 32], (Kind::Float, Device::Cpu));
        let warped = warp_to_ego(
            &features,
            None,
            &[Pose::from_xyz_yaw([500.0, 0.0, 0.0], 1.0)],
            &GRID,
        )
        .unwrap();
        assert_eq!(warped.features.abs().max().double_value(&[]), 0.0);
        assert_eq!(warped.mask.max().double_value(&[]), 0.0);
    }

    #[test]
    fn maps_of_another_grid_are_rejected() {
        let features = Tensor::zeros([1, 2, 16, 31], (Kind::Float, Device::Cpu));
        let error = warp_to_ego(&features, None, &[Pose::IDENTITY], &GRID)
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("[1, 2, 16, 31]") && error.contains("16 rows and 32 columns"),
            "{error}"
        );
        let features = Tensor::zeros([2, 2, 16, 32], (Kind::Float, Device::Cpu));
        assert!(matches!(
            warp_to_ego(&features, None, &[Pose::IDENTITY], &GRID),
            Err(WarpError::PoseCount { .. })
        ));
    }
}
