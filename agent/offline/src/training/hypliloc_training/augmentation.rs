//! Augmentation on the device: any heading, noise, points and cells left out.

use std::f64::consts::TAU;

use tch::{Kind, TchError, Tensor};

use super::examples::Truth;
use localization::competitors::hypliloc::{COLUMNS, InputBatch, roll_columns};

/// Standard deviation of points and ranges, metres.
const JITTER_M: f64 = 0.05;
/// Largest share of a sweep's points and cells that is left out.
const MAX_DROPPED: f64 = 0.3;

/// Turns each sweep about the vertical by a random whole number of columns of the image, which its heading follows,
/// moves points and ranges a little, and leaves some out.
pub(super) fn augment((batch, truth): (InputBatch, Truth)) -> Result<(InputBatch, Truth), TchError> {
    let (sweeps, device) = (batch.len(), batch.points_m.device());
    let columns = Tensor::f_randint(COLUMNS, [sweeps], (Kind::Int64, device))?;
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
    let groups = batch.groups.without(&dropped(&points_m.f_select(2, 0)?)?)?;
    let is_seen = ranges_m.f_gt(0.0)?.f_logical_and(&dropped(&ranges_m)?.f_logical_not()?)?;
    let ranges_m = (&ranges_m + ranges_m.f_randn_like()? * JITTER_M) * is_seen;
    // A sensor that is turned to the right sees all points turned to the left.
    let heading = turned(&truth.heading, &-turn)?;
    Ok((InputBatch { points_m, ranges_m, groups }, Truth { position: truth.position, heading }))
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
