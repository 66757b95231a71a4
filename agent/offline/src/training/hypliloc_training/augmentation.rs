//! Augmentation on the device: turned sweeps, noise, points and cells left out.

use std::f64::consts::TAU;

use tch::{Kind, TchError, Tensor};

use super::examples::Examples;
use localization::baselines::hypliloc::{COLUMNS, InputBatch, roll_columns};

/// Standard deviation of points and ranges, metres.
const JITTER_M: f64 = 0.05;
/// Largest share of a sweep's points and cells that is left out.
const MAX_DROPPED: f64 = 0.3;

/// Turns each sweep about the vertical by a random whole number of columns of the image, at most `turn_rad` to either
/// side, which its heading follows; moves points and ranges a little, and leaves some out.
pub(super) fn augment(examples: &Examples, turn_rad: f64) -> Result<Examples, TchError> {
    let batch = &examples.inputs;
    let (sweeps, device) = (batch.len(), batch.points_m.device());
    let most = (turn_rad / TAU * COLUMNS as f64).round() as i64;
    let columns = Tensor::f_randint_low(-most, most + 1, [sweeps], (Kind::Int64, device))?;
    let ranges_m = roll_columns(&batch.ranges_m, &columns)?.f_to_kind(Kind::Float)?;
    let turn = columns.f_to_kind(Kind::Float)? * (TAU / COLUMNS as f64);
    let points_m = turned(&batch.points_m, &turn.f_unsqueeze(1)?)?;
    let points_m = &points_m + points_m.f_randn_like()? * JITTER_M;
    let dropped = |like: &Tensor| {
        let rest = vec![1; like.dim() - 1];
        let shape: Vec<i64> = [sweeps].into_iter().chain(rest).collect();
        let share = Tensor::f_rand(&shape, (Kind::Float, device))? * MAX_DROPPED;
        like.f_rand_like()?.f_lt_tensor(&share)
    };
    let fine = batch.fine_without(&dropped(&points_m.f_select(2, 0)?)?)?;
    let is_kept = dropped(&ranges_m)?.f_logical_not()?;
    let is_seen = ranges_m.f_gt(0.0)?.f_logical_and(&is_kept)?;
    let ranges_m = (&ranges_m + ranges_m.f_randn_like()? * JITTER_M) * is_seen;
    // A sensor that is turned to the right sees all points turned to the left.
    let heading = turned(&examples.poses.f_narrow(1, 3, 2)?, &-turn)?;
    let position = examples.poses.f_narrow(1, 0, 3)?;
    Ok(Examples {
        inputs: InputBatch {
            points_m,
            ranges_m,
            fine,
            coarse: batch.coarse.shallow_clone(),
        },
        poses: Tensor::f_cat(&[position, heading], 1)?,
    })
}

/// Rotates vectors `[.., 2 or 3]` about the vertical by angles `[..]`, radians.
fn turned(vectors: &Tensor, angles_rad: &Tensor) -> Result<Tensor, TchError> {
    let axis = |number: i64| vectors.f_select(-1, number);
    let (x, y) = (axis(0)?, axis(1)?);
    let (cosine, sine) = (angles_rad.f_cos()?, angles_rad.f_sin()?);
    let mut all = vec![&cosine * &x - &sine * &y, sine * x + cosine * y];
    if vectors.size().last() == Some(&3) {
        all.push(axis(2)?);
    }
    Tensor::f_stack(&all, -1)
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;
    use localization::baselines::hypliloc::SweepInput;

    /// A wall of 20 degrees at 40 m, to the front left of the sensor.
    fn wall() -> Vec<[f32; 3]> {
        let point = |k: i32| {
            let azimuth = (30.0 + 0.02 * (k % 1000) as f32).to_radians();
            [
                40.0 * azimuth.cos(),
                40.0 * azimuth.sin(),
                -1.0 - (k / 1000) as f32,
            ]
        };
        (0..8000).map(point).collect()
    }

    fn azimuth_deg(x: f64, y: f64) -> f64 {
        y.atan2(x).to_degrees()
    }

    #[test]
    fn what_a_sweep_shows_stays_where_it_is_in_the_world() {
        tch::set_num_threads(1);
        tch::manual_seed(5);
        let input = SweepInput::new(&wall()).unwrap();
        for _ in 0..8 {
            let batch = InputBatch::new(std::slice::from_ref(&input), Device::Cpu).unwrap();
            let examples = Examples {
                inputs: batch,
                poses: Tensor::from_slice(&[1f32, 2.0, 3.0, 0.0, 1.0]).view([1, 5]),
            };
            let Examples {
                inputs: batch,
                poses,
            } = augment(&examples, TAU / 2.0).unwrap();
            let pair = |of: &Tensor| azimuth_deg(of.double_value(&[0]), of.double_value(&[1]));
            let heading_deg = pair(&poses.view([5]).narrow(0, 3, 2));
            // The wall's middle: 40 degrees to the left of a vehicle that heads north.
            let off = |azimuth_deg: f64| {
                (azimuth_deg + heading_deg - 130.0 + 540.0).rem_euclid(360.0) - 180.0
            };
            let middle = batch.points_m.mean_dim(1_i64, false, Kind::Float).view([3]);
            assert!(
                off(pair(&middle)).abs() < 1.5,
                "{} {heading_deg}",
                pair(&middle)
            );
            let seen = batch
                .ranges_m
                .gt(0.0)
                .nonzero()
                .narrow(1, 2, 1)
                .to_kind(Kind::Float);
            let turn = (seen + 0.5) * (TAU / COLUMNS as f64) - TAU / 2.0;
            let sum = |of: Tensor| of.sum(Kind::Float).double_value(&[]);
            let image_deg = azimuth_deg(sum(turn.cos()), sum(turn.sin()));
            assert!(off(image_deg).abs() < 1.5, "{image_deg} {heading_deg}");
            let kept: Vec<f32> = Vec::try_from(&poses.view([5]).narrow(0, 0, 3)).unwrap();
            assert_eq!(kept, [1.0, 2.0, 3.0]);
        }
    }
}
