//! Spherical image: the nearest range in each direction, and its channels.

use std::f64::consts::TAU;

use tch::{Device, Kind, TchError, Tensor};

/// Rows, from the highest elevation to the lowest.
pub const ROWS: i64 = 32;
/// Columns, azimuth from -180 to 180 degrees.
pub const COLUMNS: i64 = 360;
/// Highest elevation, degrees: LiDARs of vehicles look down for the most part.
const HIGHEST_DEG: f32 = 2.5;
/// Lowest elevation, degrees.
const LOWEST_DEG: f32 = -25.5;
/// Unit of the channels, metres.
const SCALE_M: f64 = 20.0;
/// Channels of the image: x, y, z and range.
pub(super) const CHANNELS: i64 = 4;

/// `[ROWS * COLUMNS]` ranges, metres; 0 where no point is. Points farther than `range_m` are left out, those above or
/// below the image too.
pub(super) fn range_image(points_m: &[[f32; 3]], range_m: f32) -> Vec<f32> {
    let (rows, columns) = (ROWS as usize, COLUMNS as usize);
    let mut image = vec![f32::INFINITY; rows * columns];
    for &[x, y, z] in points_m {
        let in_plane = x.hypot(y);
        let range = in_plane.hypot(z);
        let row = (HIGHEST_DEG - z.atan2(in_plane).to_degrees()) / (HIGHEST_DEG - LOWEST_DEG)
            * rows as f32;
        // False for NaN too.
        let is_inside = range > 0.0 && range <= range_m && row >= 0.0 && row < rows as f32;
        if is_inside {
            let column = (y.atan2(x).to_degrees() + 180.0) / 360.0 * columns as f32;
            let cell = &mut image[row as usize * columns + column as usize % columns];
            *cell = cell.min(range);
        }
    }
    image
        .into_iter()
        .map(|range| if range.is_finite() { range } else { 0.0 })
        .collect()
}

/// `[S, 4, ROWS, COLUMNS]` x, y, z and range in units of 20 m, from ranges `[S, ROWS, COLUMNS]`, metres.
pub(super) fn channels(ranges_m: &Tensor) -> Result<Tensor, TchError> {
    let ranges = ranges_m.f_to_kind(Kind::Float)?.f_unsqueeze(1)? / SCALE_M;
    ranges.f_mul(&directions(ranges_m.device())?)
}

/// `[1, 4, ROWS, COLUMNS]`: direction of each cell, and 1.
fn directions(device: Device) -> Result<Tensor, TchError> {
    let middle = |count: i64| {
        Tensor::f_arange(count, (Kind::Float, device)).map(|index| (index + 0.5) / count as f64)
    };
    let elevation = (middle(ROWS)? * f64::from(LOWEST_DEG - HIGHEST_DEG) + f64::from(HIGHEST_DEG))
        .f_deg2rad()?;
    let azimuth = middle(COLUMNS)? * TAU - TAU / 2.0;
    let (elevation, azimuth) = (elevation.f_unsqueeze(1)?, azimuth.f_unsqueeze(0)?);
    let in_plane = elevation.f_cos()?;
    let all = [
        &in_plane * azimuth.f_cos()?,
        &in_plane * azimuth.f_sin()?,
        elevation.f_sin()?.f_expand([ROWS, COLUMNS], false)?,
        Tensor::f_ones([ROWS, COLUMNS], (Kind::Float, device))?,
    ];
    Tensor::f_stack(&all, 0)?.f_unsqueeze(0)
}

/// Turns images `[S, ROWS, COLUMNS]` about the vertical by `columns` `[S]` whole columns, each of 360 / [`COLUMNS`]
/// degrees, as [`COLUMNS`] positive ones turn all points once to the left.
///
/// # Errors
/// Those of the tensor library.
pub fn roll_columns(ranges_m: &Tensor, columns: &Tensor) -> Result<Tensor, TchError> {
    let own = Tensor::f_arange(COLUMNS, (Kind::Int64, ranges_m.device()))?.f_unsqueeze(0)?;
    let source = (own - columns.f_unsqueeze(1)?).f_remainder(COLUMNS)?;
    let source = source.f_unsqueeze(1)?.f_expand([-1, ROWS, -1], false)?;
    ranges_m.f_gather(2, &source, false)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud() -> Vec<[f32; 3]> {
        // In the middle of columns, so that rounding turns none into the next one.
        let point = |k: i32| {
            let (azimuth, range) = ((37.0 * k as f32 + 0.5).to_radians(), 5.0 + k as f32);
            [range * azimuth.cos(), range * azimuth.sin(), -0.1 * range]
        };
        (0..40).map(point).collect()
    }

    fn tensor(image: &[f32]) -> Tensor {
        Tensor::from_slice(image).view([1, ROWS, COLUMNS])
    }

    #[test]
    fn the_nearest_point_of_a_direction_is_seen() {
        let ahead = [[30.0, 0.01, 0.0], [10.0, 0.01, 0.0], [20.0, 0.01, 0.0]];
        let unseen = [
            [0.0, 0.0, 0.0],
            [200.0, 0.0, 0.0],
            [1.0, 0.0, 5.0],
            [1.0, 0.0, -5.0],
            [f32::NAN, 0.0, 0.0],
        ];
        let image = range_image(&[&ahead[..], &unseen].concat(), 100.0);
        let seen: Vec<(usize, f32)> = image
            .iter()
            .copied()
            .enumerate()
            .filter(|&(_, range)| range > 0.0)
            .collect();
        let (row, column) = (2, COLUMNS as usize / 2);
        assert_eq!(seen.len(), 1, "{seen:?}");
        assert!(
            seen[0].0 == row * COLUMNS as usize + column && (seen[0].1 - 10.0).abs() < 1e-4,
            "{seen:?}"
        );
    }

    #[test]
    fn channels_are_the_coordinates_of_the_points() {
        let points = cloud();
        let channels = channels(&tensor(&range_image(&points, 100.0))).unwrap();
        let seen = channels.select(1, 3).gt(0.0).nonzero();
        assert_eq!(seen.size()[0], points.len() as i64);
        for [x, y, z] in points {
            let wanted = Tensor::from_slice(&[x, y, z]).view([1, 3, 1, 1]) / SCALE_M;
            let off = (channels.narrow(1, 0, 3) - wanted)
                .square()
                .sum_dim_intlist(1, false, Kind::Float);
            // Half a cell of 1 by 0.9 degrees at 44 m.
            assert!(off.min().double_value(&[]).sqrt() * SCALE_M < 0.6);
        }
    }

    #[test]
    fn a_roll_is_a_rotation_of_the_points() {
        let points = cloud();
        let image = tensor(&range_image(&points, 100.0));
        for columns in [0, 1, 90, 123, 359] {
            let (sine, cosine) = (columns as f32).to_radians().sin_cos();
            let turned = points
                .iter()
                .map(|[x, y, z]| [cosine * x - sine * y, sine * x + cosine * y, *z]);
            let turned: Vec<[f32; 3]> = turned.collect();
            let wanted = tensor(&range_image(&turned, 100.0));
            let rolled = roll_columns(&image, &Tensor::from_slice(&[columns])).unwrap();
            assert!(rolled.allclose(&wanted, 1e-4, 1e-4, false), "{columns}");
        }
    }
}
