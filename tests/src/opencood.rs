//! Operations of OpenCOOD that only its golden tensors need: padded samples, and its warp with transforms in pixels, rotation
//! about the pixel (W/2, H/2) and corners aligned.
//!
//! Its matrices map source pixels to destination pixels. The rotation centre is kept as published, although the centre
//! of a map with aligned corners is ((W-1)/2, (H-1)/2); weights trained with it expect it.

use tch::{Kind, TchError, Tensor};

/// `grid_sampler` reads zeros outside of the map.
const PADDING_ZEROS: i64 = 0;

/// Interpolation between cells.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Interpolation {
    /// From the four nearest cells.
    Bilinear,
    /// From the nearest cell.
    Nearest,
}

/// Planar part of metric transforms, translation in pixels: `[..., 4, 4]` to `[..., 2, 3]` `f32`.
///
/// `pixel_m` is the edge of a cell of the map to be warped: voxel size times down-sampling.
///
/// # Errors
/// [`TchError`] when the last two sizes are not 4.
pub fn discretized(matrix: &Tensor, pixel_m: f64) -> Result<Tensor, TchError> {
    let rows = matrix.f_narrow(-2, 0, 2)?;
    let rotation = rows.f_narrow(-1, 0, 2)?;
    let translation = rows.f_narrow(-1, 3, 1)? / pixel_m;
    Tensor::f_cat(&[rotation, translation], -1)?.f_to_kind(Kind::Float)
}

/// The same transforms with the rotation about the pixel (W/2, H/2): `[N, 2, 3]` to `[N, 2, 3]`.
///
/// # Errors
/// [`TchError`] when the shape is another.
pub fn about_centre(matrix: &Tensor, height: i64, width: i64) -> Result<Tensor, TchError> {
    let centre = Tensor::from_slice(&[width as f64 / 2.0, height as f64 / 2.0]).f_view([2, 1])?;
    let centre = centre
        .f_to_kind(matrix.kind())?
        .f_to_device(matrix.device())?;
    let rotation = matrix.f_narrow(-1, 0, 2)?;
    let translation = matrix.f_narrow(-1, 2, 1)? + &centre - rotation.f_matmul(&centre)?;
    Tensor::f_cat(&[rotation, translation], -1)
}

/// Warps `[N, C, H, W]` by source-to-destination pixel transforms `[N, 2, 3]` onto maps of the same size.
///
/// # Errors
/// [`TchError`] when shapes do not fit or a transform cannot be inverted.
pub fn warp_affine(
    source: &Tensor,
    matrix: &Tensor,
    interpolation: Interpolation,
) -> Result<Tensor, TchError> {
    let (batch, channels, height, width) = source.size4()?;
    let theta = normalized(matrix, height, width)?;
    let sampling_grid =
        Tensor::f_affine_grid_generator(&theta, [batch, channels, height, width], true)?;
    let mode = match interpolation {
        Interpolation::Bilinear => 0,
        Interpolation::Nearest => 1,
    };
    source.f_grid_sampler(
        &sampling_grid.f_to_kind(source.kind())?,
        mode,
        PADDING_ZEROS,
        true,
    )
}

/// Destination-to-source matrices `[N, 2, 3]` on coordinates -1..1 with aligned corners, from source-to-destination
/// pixel transforms `[N, 2, 3]`.
///
/// # Errors
/// [`TchError`] when shapes do not fit or a transform cannot be inverted.
pub fn normalized(matrix: &Tensor, height: i64, width: i64) -> Result<Tensor, TchError> {
    let homography = homogeneous(matrix)?;
    let normal = pixel_to_normal(height, width, matrix)?;
    let destination_from_source = normal.f_matmul(&homography.f_matmul(&normal.f_inverse()?)?)?;
    destination_from_source.f_inverse()?.f_narrow(-2, 0, 2)
}

/// Mask of the ego's cells that each agent covers: `[B, L, H, W]`, 1 inside the warped extent of a present agent.
///
/// # Shapes
/// - `correction`: `[B, L, 4, 4]` metric transforms
/// - `present`: `[B, L]`, 1 for agents that exist
///
/// # Errors
/// [`TchError`] when shapes do not fit.
pub fn roi_mask(
    correction: &Tensor,
    present: &Tensor,
    height: i64,
    width: i64,
    pixel_m: f64,
) -> Result<Tensor, TchError> {
    let matrix = about_centre(
        &discretized(correction, pixel_m)?.f_view([-1, 2, 3])?,
        height,
        width,
    )?;
    let extent = rotated_extent(&matrix, height, width)?;
    let (batch, agents) = present.size2()?;
    extent
        .f_view([batch, agents, height, width])?
        .f_mul(&present.f_view([batch, agents, 1, 1])?)
}

/// The warped extent of a full map, by pixel transforms `[N, 2, 3]`: `[N, 1, H, W]` of 0 and 1.
///
/// # Errors
/// [`TchError`] when shapes do not fit.
pub fn rotated_extent(matrix: &Tensor, height: i64, width: i64) -> Result<Tensor, TchError> {
    let ones = Tensor::f_ones(
        [matrix.size3()?.0, 1, height, width],
        (matrix.kind(), matrix.device()),
    )?;
    warp_affine(&ones, matrix, Interpolation::Nearest)
}

/// V2X-ViT's spatial correction: moves every agent but the first of `[B, L, H, W, C]` by its metric transform.
///
/// # Errors
/// [`TchError`] when shapes do not fit.
pub fn spatial_correction(
    features: &Tensor,
    correction: &Tensor,
    pixel_m: f64,
) -> Result<Tensor, TchError> {
    let channels_first = features.f_permute([0, 1, 4, 2, 3])?;
    let (_, agents, channels, height, width) = channels_first.size5()?;
    let others = channels_first.f_narrow(1, 1, agents - 1)?;
    let matrix = discretized(correction, pixel_m)?
        .f_narrow(1, 1, agents - 1)?
        .f_reshape([-1, 2, 3])?;
    let matrix = about_centre(&matrix, height, width)?;
    let moved = warp_affine(
        &others.f_reshape([-1, channels, height, width])?,
        &matrix,
        Interpolation::Bilinear,
    )?;
    let ego = channels_first.f_narrow(1, 0, 1)?;
    Tensor::f_cat(&[ego, moved.f_view_as(&others)?], 1)?.f_permute([0, 1, 3, 4, 2])
}

/// Splits agents of all samples into padded samples: `[sum(agents), ...]` to `[B, longest, ...]` and a mask
/// `[B, longest]`.
///
/// # Errors
/// [`TchError`] when the counts do not add up to the first size, or one is above `longest`.
pub fn regroup(
    features: &Tensor,
    agents: &[i64],
    longest: i64,
) -> Result<(Tensor, Tensor), TchError> {
    let mut samples = Vec::with_capacity(agents.len());
    let mut masks = Vec::with_capacity(agents.len());
    for (sample, &count) in features
        .f_split_with_sizes(agents, 0)?
        .into_iter()
        .zip(agents)
    {
        let mut padding = sample.size();
        padding[0] = longest - count;
        let empty = Tensor::f_zeros(padding, (sample.kind(), sample.device()))?;
        samples.push(Tensor::f_cat(&[sample, empty], 0)?);
        masks.push(Tensor::f_arange(longest, (Kind::Int64, features.device()))?.f_lt(count)?);
    }
    Ok((Tensor::f_stack(&samples, 0)?, Tensor::f_stack(&masks, 0)?))
}

/// `[N, 2, 3]` with the row `0 0 1` appended.
fn homogeneous(matrix: &Tensor) -> Result<Tensor, TchError> {
    let last = Tensor::from_slice(&[0f32, 0.0, 1.0])
        .f_to_kind(matrix.kind())?
        .f_to_device(matrix.device())?;
    let last = last
        .f_view([1, 1, 3])?
        .f_expand([matrix.size3()?.0, 1, 3], false)?;
    Tensor::f_cat(&[matrix, &last], 1)
}

/// From pixels 0..W-1 to -1..1, likewise for rows: `[3, 3]`.
fn pixel_to_normal(height: i64, width: i64, like: &Tensor) -> Result<Tensor, TchError> {
    // The reference divides by a tiny number for maps of one pixel.
    let scale = |size: i64| 2.0 / if size == 1 { 1e-14 } else { (size - 1) as f64 };
    let entries = [
        scale(width),
        0.0,
        -1.0,
        0.0,
        scale(height),
        -1.0,
        0.0,
        0.0,
        1.0,
    ];
    Tensor::from_slice(&entries)
        .f_view([3, 3])?
        .f_to_kind(like.kind())?
        .f_to_device(like.device())
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;

    #[test]
    fn a_metric_shift_moves_whole_pixels() {
        let source = Tensor::arange(60, (Kind::Float, Device::Cpu)).view([1, 1, 6, 10]);
        let matrix = Tensor::eye(4, (Kind::Double, Device::Cpu)).view([1, 4, 4]);
        let _ = matrix.get(0).get(0).get(3).fill_(1.6);
        let pixels = discretized(&matrix, 0.8).unwrap();
        let centred = about_centre(&pixels, 6, 10).unwrap();
        assert!(
            (&centred - &pixels).abs().max().double_value(&[]) < 1e-6,
            "a shift has no centre"
        );
        let moved = warp_affine(&source, &centred, Interpolation::Bilinear).unwrap();
        let expected = source.narrow(3, 0, 8);
        assert!(
            (moved.narrow(3, 2, 8) - expected)
                .abs()
                .max()
                .double_value(&[])
                < 1e-3
        );
        assert!(moved.narrow(3, 0, 2).abs().max().double_value(&[]) < 1e-4);
    }

    #[test]
    fn absent_agents_see_nothing() {
        let identity = Tensor::eye(4, (Kind::Float, Device::Cpu))
            .view([1, 1, 4, 4])
            .repeat([1, 2, 1, 1]);
        let present = Tensor::from_slice(&[1f32, 0.0]).view([1, 2]);
        let mask = roi_mask(&identity, &present, 5, 7, 0.8).unwrap();
        assert_eq!(mask.get(0).get(0).min().double_value(&[]), 1.0);
        assert_eq!(mask.get(0).get(1).max().double_value(&[]), 0.0);
    }

    #[test]
    fn regroup_pads_with_nothing() {
        let features = Tensor::arange(3, (Kind::Float, Device::Cpu)).view([3, 1]) + 1.0;
        let (groups, mask) = regroup(&features, &[2, 1], 3).unwrap();
        assert_eq!(
            Vec::<f32>::try_from(groups.view(-1)).unwrap(),
            [1.0, 2.0, 0.0, 3.0, 0.0, 0.0]
        );
        assert_eq!(
            Vec::<bool>::try_from(mask.view(-1)).unwrap(),
            [true, true, false, true, false, false]
        );
        assert!(regroup(&features, &[2, 2], 3).is_err());
    }
}
