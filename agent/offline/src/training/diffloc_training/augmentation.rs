//! Augmentation of range images on the device: the sensor turned and moved, with its pose; noise, lost pixels.

use std::f64::consts::TAU;

use tch::{Kind, TchError, Tensor};

use super::images::SweepBatch;
use crate::training::pose_scale::PoseScale;
use localization::baselines::diffloc::{CHANNELS, RangeImageConfig, UNITS};

/// Deviation of the relative error of a range.
const RANGE_NOISE: f64 = 0.002;
/// Largest share of pixels that is lost.
const LOST: f64 = 0.3;
/// Share of sweeps with a hidden sector.
const HIDDEN: f64 = 0.5;
/// Largest width of a hidden sector, as a share of the image.
const SECTOR: f64 = 0.15;
/// Closest return of a moved sensor, metres.
const LEAST_RANGE_M: f64 = 1.0;
/// Unit of the ranges that are compared where several pixels move to the same one, metres.
const DEPTH_UNIT_M: f64 = 0.01;

/// Random changes of a training.
#[derive(Debug, Clone, Copy)]
pub(super) struct Augmentation {
    pub(super) image: RangeImageConfig,
    /// Largest turn of the sensor, in columns.
    pub(super) turn_columns: i64,
    /// Largest shift of the sensor along each horizontal axis, metres.
    pub(super) shift_m: f64,
}

impl Augmentation {
    /// Changes windows of `frames` sweeps each; the sensor of a window is turned and moved alike in all of its sweeps.
    pub(super) fn apply(
        &self,
        windows: &SweepBatch,
        frames: i64,
        scale: &PoseScale,
    ) -> Result<SweepBatch, TchError> {
        let images = windows.images.f_to_kind(Kind::Float)?;
        let (count, device) = (images.size()[0] / frames, images.device());
        let of_sweeps = |of: &Tensor| of.f_repeat_interleave_self_int(frames, 0, count * frames);
        let poses = windows.poses.shallow_clone();
        let mut changed = SweepBatch { images, poses };
        if self.shift_m > 0.0 {
            let share = Tensor::f_rand([count, 2], (Kind::Float, device))? * 2.0 - 1.0;
            changed = self.shifted(&changed, &of_sweeps(&(share * self.shift_m))?, scale)?;
        }
        if self.turn_columns > 0 {
            let most = self.turn_columns;
            let turn = Tensor::f_randint_low(-most, most + 1, [count], (Kind::Int64, device))?;
            changed = self.turned(&changed, &of_sweeps(&turn)?)?;
        }
        Ok(SweepBatch {
            images: spoilt(&changed.images)?,
            poses: changed.poses,
        })
    }

    /// The sweeps of sensors that are moved by `shift_m` `[N, 2]` in their own frames: each pixel moves to where the
    /// new sensor sees its point, the closest counts.
    fn shifted(
        &self,
        sweeps: &SweepBatch,
        shift_m: &Tensor,
        scale: &PoseScale,
    ) -> Result<SweepBatch, TchError> {
        let elevations_deg = self.image.elevations_deg.map(f64::from);
        let [low, high] = elevations_deg.map(f64::to_radians);
        let [rows, columns] = [self.image.rows, self.image.columns].map(|size| size as i64);
        let pixels = rows * columns;
        let flat = sweeps.images.f_flatten(2, 3)?;
        let count = flat.size()[0];
        let axis = |channel: usize| {
            Ok::<_, TchError>(flat.f_select(1, channel as i64)? * f64::from(UNITS[channel]))
        };
        let moved =
            |channel: usize, number: i64| axis(channel)?.f_sub(&shift_m.f_narrow(1, number, 1)?);
        let (x, y, z) = (moved(1, 0)?, moved(2, 1)?, axis(3)?);
        let level = (x.f_square()? + y.f_square()?).f_sqrt()?;
        let range = (level.f_square()? + z.f_square()?).f_sqrt()?;
        let row =
            ((z.f_atan2(&level)?.f_neg()? + high) * (rows as f64 / (high - low))).f_floor()?;
        let column = ((y.f_atan2(&x)? / TAU + 0.5) * columns as f64)
            .f_floor()?
            .f_remainder(columns as f64)?;
        let is_seen = (flat.f_select(1, 0)?.f_gt(0.0)?)
            .f_logical_and(&row.f_ge(0.0)?)?
            .f_logical_and(&row.f_lt(rows as f64)?)?
            .f_logical_and(&range.f_gt(LEAST_RANGE_M)?)?;
        // Points that are not seen go to a pixel behind the last.
        let target = (row * columns as f64 + column).f_to_kind(Kind::Int64)?;
        let whole = (Kind::Int64, flat.device());
        let target = target.f_where_self(&is_seen, &Tensor::f_full([1], pixels, whole)?)?;
        // The pixel that a point comes from, below its range: the least is the closest.
        let source = Tensor::f_arange(pixels, whole)?;
        let depth = (&range / DEPTH_UNIT_M).f_to_kind(Kind::Int64)?;
        let code = depth.f_mul_scalar(pixels)?.f_add(&source)?;
        let empty = i64::MAX / 2;
        let least = Tensor::f_full([count, pixels + 1], empty, whole)?
            .f_internal_scatter_reduce(1, &target, &code, "amin", true)?
            .f_narrow(1, 0, pixels)?;
        let is_filled = least.f_lt(empty)?.f_to_kind(Kind::Float)?.f_unsqueeze(1)?;
        let origin = least.f_remainder(pixels)?.f_unsqueeze(1)?;
        let unit = |value: &Tensor, channel: usize| value.f_div_scalar(f64::from(UNITS[channel]));
        let places = [unit(&range, 0)?, unit(&x, 1)?, unit(&y, 2)?];
        let places = Tensor::f_stack(&places, 1)?;
        let all = Tensor::f_cat(&[places, flat.f_narrow(1, 3, flat.size()[1] - 3)?], 1)?;
        let images = all
            .f_gather(2, &origin.f_expand(all.size(), false)?, false)?
            .f_mul(&is_filled)?;
        // Along the heading, in the world.
        let poses = &sweeps.poses;
        let (cos, sin) = (poses.f_narrow(1, 3, 1)?, poses.f_narrow(1, 4, 1)?);
        let (ahead, left) = (shift_m.f_narrow(1, 0, 1)?, shift_m.f_narrow(1, 1, 1)?);
        let east = (&ahead * &cos - &left * &sin) / scale.scale_m[0];
        let north = (&ahead * &sin + &left * &cos) / scale.scale_m[1];
        let rest = east.f_zeros_like()?.f_expand([count, 3], false)?;
        let poses = poses.f_add(&Tensor::f_cat(&[east, north, rest], 1)?)?;
        Ok(SweepBatch {
            images: images.f_view(sweeps.images.size().as_slice())?,
            poses,
        })
    }

    /// The sweeps of sensors whose points lie `columns` `[N]` further counter-clockwise.
    fn turned(&self, sweeps: &SweepBatch, columns: &Tensor) -> Result<SweepBatch, TchError> {
        let images = &sweeps.images;
        let width = images.size()[3];
        let source = Tensor::f_arange(width, (Kind::Int64, images.device()))?;
        let source = source.f_sub(&columns.f_unsqueeze(1)?)?.f_remainder(width)?;
        let source = source.f_view([-1, 1, 1, width])?;
        let images = images.f_gather(3, &source.f_expand(images.size(), false)?, false)?;
        let angle = columns.f_to_kind(Kind::Float)? * (TAU / width as f64);
        let (cos, sin) = (angle.f_cos()?, angle.f_sin()?);
        let of_image = [&cos, &sin].map(|values| values.view([-1, 1, 1, 1]));
        let [x, y] = rotated(&images, 1, &of_image)?;
        let rest = images.f_narrow(1, 3, images.size()[1] - 3)?;
        let images = Tensor::f_cat(&[images.f_narrow(1, 0, 1)?, x, y, rest], 1)?;
        // The sensor itself has turned the other way.
        let of_pose = [cos.view([-1, 1]), sin.view([-1, 1]).f_neg()?];
        let [cosine, sine] = rotated(&sweeps.poses, 3, &of_pose)?;
        let position = sweeps.poses.f_narrow(1, 0, 3)?;
        let poses = Tensor::f_cat(&[position, cosine, sine], 1)?;
        Ok(SweepBatch { images, poses })
    }
}

/// Channels `first` and the next one, turned about the vertical by an angle of this cosine and sine.
fn rotated(values: &Tensor, first: i64, [cos, sin]: &[Tensor; 2]) -> Result<[Tensor; 2], TchError> {
    let (x, y) = (
        values.f_narrow(1, first, 1)?,
        values.f_narrow(1, first + 1, 1)?,
    );
    Ok([
        x.f_mul(cos)?.f_sub(&y.f_mul(sin)?)?,
        x.f_mul(sin)?.f_add(&y.f_mul(cos)?)?,
    ])
}

/// Images with noise in their ranges, without some pixels and without a sector.
fn spoilt(images: &Tensor) -> Result<Tensor, TchError> {
    let (count, channels, rows, columns) = images.size4()?;
    let on = (Kind::Float, images.device());
    let of_sweeps = || Tensor::f_rand([count, 1, 1, 1], on);
    let kept =
        Tensor::f_rand([count, 1, rows, columns], on)?.f_ge_tensor(&(of_sweeps()? * LOST))?;
    let place = Tensor::f_arange(columns, on)?.f_view([1, 1, 1, -1])?;
    let first = of_sweeps()? * columns as f64;
    let width = of_sweeps()? * (SECTOR * columns as f64);
    let is_hidden = of_sweeps()?.f_lt(HIDDEN)?.f_to_kind(Kind::Float)?;
    let from_first = place.f_sub(&first)?.f_remainder(columns as f64)?;
    let visible = from_first.f_ge_tensor(&(width * is_hidden))?;
    let kept = kept.f_logical_and(&visible)?.f_to_kind(Kind::Float)?;
    let factor = (Tensor::f_randn([count, 1, rows, columns], on)? * RANGE_NOISE + 1.0) * &kept;
    let places = images.f_narrow(1, 0, 4)?.f_mul(&factor)?;
    let rest = images.f_narrow(1, 4, channels - 4)?.f_mul(&kept)?;
    Tensor::f_cat(&[places, rest], 1)
}

/// Share of the seen pixels of each token that show static objects is a half or more: `[N, T]` of 0 or 1.
pub(super) fn static_tokens(images: &Tensor, patch: [i64; 2]) -> Result<Tensor, TchError> {
    let pooled = |values: &Tensor| {
        let means = values.f_avg_pool2d(patch, patch, [0, 0], false, true, None)?;
        means.f_flatten(1, 3)
    };
    let seen = images
        .f_narrow(1, 0, 1)?
        .f_gt(0.0)?
        .f_to_kind(Kind::Float)?;
    let is_static =
        pooled(&images.f_narrow(1, CHANNELS as i64, 1)?)?.f_le_tensor(&(pooled(&seen)? * 0.5))?;
    is_static.f_to_kind(Kind::Float)
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;

    const IMAGE: RangeImageConfig = RangeImageConfig {
        rows: 8,
        columns: 64,
        elevations_deg: [-20.0, 20.0],
    };
    const PLAIN: Augmentation = Augmentation {
        image: IMAGE,
        turn_columns: 0,
        shift_m: 0.0,
    };
    const METRES: PoseScale = PoseScale {
        origin_m: [0.0; 3],
        scale_m: [2.0, 4.0, 1.0],
    };

    /// Points far enough apart that none hides another.
    fn cloud() -> Vec<[f32; 4]> {
        let point = |number: usize| {
            let (azimuth, range) = (number as f32 * 0.41 + 0.03, 12.0 + number as f32);
            [
                range * azimuth.cos(),
                range * azimuth.sin(),
                number as f32 % 5.0 - 2.3,
                0.5 + number as f32 * 0.01,
            ]
        };
        (0..15).map(point).collect()
    }

    /// The sweep of a cloud from a normalised pose; nothing is movable.
    fn sweep(cloud: &[[f32; 4]], pose: [f32; 5]) -> SweepBatch {
        tch::set_num_threads(1);
        let mut values = IMAGE.image(cloud);
        values.extend(vec![0.0; IMAGE.pixels()]);
        let images =
            Tensor::from_slice(&values).view([1, -1, IMAGE.rows as i64, IMAGE.columns as i64]);
        SweepBatch {
            images,
            poses: Tensor::from_slice(&pose).view([1, 5]),
        }
    }

    fn assert_equal(found: &SweepBatch, expected: &SweepBatch) {
        assert!(found.images.allclose(&expected.images, 1e-4, 1e-4, false));
        assert!(
            found.poses.allclose(&expected.poses, 1e-5, 1e-5, false),
            "{} {}",
            found.poses,
            expected.poses
        );
        assert!(
            found
                .images
                .select(1, 0)
                .gt(0.0)
                .sum(Kind::Int64)
                .int64_value(&[])
                >= 15
        );
    }

    #[test]
    fn rolled_columns_are_the_sweep_of_a_turned_sensor() {
        let columns = 11;
        let angle = columns as f32 * std::f32::consts::TAU / IMAGE.columns as f32;
        let (sin, cos) = angle.sin_cos();
        let turned: Vec<_> = cloud()
            .iter()
            .map(|&[x, y, z, i]| [x * cos - y * sin, x * sin + y * cos, z, i])
            .collect();
        let found = PLAIN
            .turned(
                &sweep(&cloud(), [3.0, 4.0, 5.0, 0.0, 1.0]),
                &Tensor::from_slice(&[columns]),
            )
            .unwrap();
        // Its points have moved counter-clockwise, so the sensor has turned clockwise: heading 90 degrees less.
        assert_equal(&found, &sweep(&turned, [3.0, 4.0, 5.0, sin, cos]));
    }

    #[test]
    fn moved_pixels_are_the_sweep_of_a_moved_sensor() {
        let (ahead, left) = (1.5, -0.5);
        let moved: Vec<_> = cloud()
            .iter()
            .map(|&[x, y, z, i]| [x - ahead, y - left, z, i])
            .collect();
        let shift = Tensor::from_slice(&[ahead, left]).view([1, 2]);
        let found = PLAIN
            .shifted(&sweep(&cloud(), [3.0, 4.0, 5.0, 0.0, 1.0]), &shift, &METRES)
            .unwrap();
        // Ahead is north, left is west.
        assert_equal(
            &found,
            &sweep(&moved, [3.0 + 0.5 / 2.0, 4.0 + 1.5 / 4.0, 5.0, 0.0, 1.0]),
        );
    }

    #[test]
    fn the_closest_of_the_points_that_move_to_one_pixel_counts() {
        // On one line of sight only from the new place.
        let (near, far) = ([6.0, 1.0, 0.1, 0.5], [11.0, 1.0, 0.1, 0.9]);
        let shift = Tensor::from_slice(&[0.0f32, 0.97]).view([1, 2]);
        let found = PLAIN
            .shifted(&sweep(&[near, far], [0.0; 5]), &shift, &METRES)
            .unwrap();
        let range = found.images.select(1, 0);
        assert_eq!(range.gt(0.0).sum(Kind::Int64).int64_value(&[]), 1);
        assert!((range.max().double_value(&[]) * 20.0 - 6.0).abs() < 0.01);
    }

    #[test]
    fn a_token_is_static_unless_most_of_its_points_are_movable() {
        let images = Tensor::zeros([1, 6, 2, 8], (Kind::Float, Device::Cpu));
        let _ = images.narrow(1, 0, 1).narrow(3, 0, 6).fill_(1.0);
        let _ = images.narrow(1, 5, 1).narrow(3, 3, 3).fill_(1.0);
        let statics: Vec<f32> =
            Vec::try_from(static_tokens(&images, [2, 2]).unwrap().view([-1])).unwrap();
        assert_eq!(statics, [1.0, 1.0, 0.0, 1.0]);
    }
}
