//! Rounding: floats to integers, with defined results outside the range.

/// The nearest integer; 0 for negative values and for NaN, the largest integer for values beyond it.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a cast from a float saturates"
)]
pub fn to_u64(value: f64) -> u64 {
    value.round() as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_outside_the_range_saturate() {
        let values = [1.4, 1.5, -3.0, f64::NAN, f64::INFINITY];
        assert_eq!(values.map(to_u64), [1, 2, 0, 0, u64::MAX]);
    }
}
