//! The warp of CoAlign: normalised destination-to-source matrices, pixel edges rather than centres at -1 and 1.
//!
//! The pairwise matrix `P[i, j]` takes points of agent i to the frame of agent j, and is used as it is for the
//! destination-to-source map: `normalized[b, i, j]` brings the features of agent j into the frame of agent i.

use tch::{Kind, Result, Tensor};

use super::{BILINEAR, PADDING_ZEROS};

/// Normalised planar part of metric transforms: `[..., 4, 4]` to `[..., 2, 3]`.
///
/// `pixel_m` is the edge of a cell of the map to be warped, `height` and `width` its size in cells.
///
/// # Errors
/// [`tch::TchError`] when the last two sizes are not 4.
pub fn normalized(pairwise: &Tensor, height: i64, width: i64, pixel_m: f64) -> Result<Tensor> {
    let (height, width) = (height as f64, width as f64);
    // Terms across axes by the ratio of the edges, translations from metres to half edges of the map.
    let (xy, yx) = (height / width, width / height);
    let [x0, y0] = [width, height].map(|edge| 2.0 / (pixel_m * edge));
    let scale = [1.0, xy, x0, yx, 1.0, y0];
    let scale = Tensor::from_slice(&scale)
        .f_view([2, 3])?
        .f_to_kind(pairwise.kind())?
        .f_to_device(pairwise.device())?;
    let rows = pairwise.f_narrow(-2, 0, 2)?;
    // Columns of x, y and the translation: height is left out.
    let planar = Tensor::f_cat(&[rows.f_narrow(-1, 0, 2)?, rows.f_narrow(-1, 3, 1)?], -1)?;
    planar.f_mul(&scale)
}

/// Warps `[N, C, H, W]` by normalised destination-to-source matrices `[N, 2, 3]`, bilinearly, zeros outside.
///
/// # Errors
/// [`tch::TchError`] when shapes do not fit.
pub fn warp_affine(source: &Tensor, matrix: &Tensor) -> Result<Tensor> {
    let sampling_grid =
        Tensor::f_affine_grid_generator(&matrix.f_to_kind(Kind::Float)?, source.size(), false)?;
    let sampling_grid = sampling_grid.f_to_kind(source.kind())?;
    source.f_grid_sampler(&sampling_grid, BILINEAR, PADDING_ZEROS, false)
}

#[cfg(test)]
mod tests {
    use protocol::{BevGrid, Pose};
    use tch::Device;

    use super::*;
    use crate::warp::warp_to_ego;

    #[test]
    fn on_a_centred_grid_it_equals_the_warp_of_this_module() {
        let grid = BevGrid {
            x_min_m: -8.0,
            y_min_m: -4.0,
            cell_m: 0.5,
            width: 32,
            height: 16,
        };
        let ego_from_cav = Pose::from_xyz_yaw([1.3, -0.6, 0.0], 0.4);
        let cav_from_ego = ego_from_cav.isometry().inverse().to_homogeneous();
        let cav_from_ego = Tensor::from_slice(cav_from_ego.transpose().as_slice()).view([1, 4, 4]);
        let features = Tensor::randn([1, 3, 16, 32], (Kind::Float, Device::Cpu));
        let theirs =
            warp_affine(&features, &normalized(&cav_from_ego, 16, 32, 0.5).unwrap()).unwrap();
        let ours = warp_to_ego(&features, None, &[ego_from_cav], &grid).unwrap();
        assert!(
            (ours.features - theirs * ours.mask)
                .abs()
                .max()
                .double_value(&[])
                < 1e-5
        );
    }
}
