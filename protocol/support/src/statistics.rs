//! Mean and quantiles of samples: the only definition of a percentile in reports.

/// Error of a position below which localization, or an alignment, counts as a success, metres: the limit of the papers.
pub const SUCCESS_M: f64 = 3.0;

/// Share of `tried` attempts with an error below `limit`: those without an error failed. 0 of none.
pub fn share_below(errors: &[f64], limit: f64, tried: usize) -> f64 {
    let near = errors.iter().filter(|error| **error < limit);
    near.count() as f64 / tried.max(1) as f64
}

/// The mean; `None` for an empty sample.
pub fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// The values in ascending order.
pub fn sorted(values: &[f64]) -> Vec<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted
}

/// The quantile `q` (0..=1) of a sample in ascending order, interpolated linearly between the two nearest ranks as by
/// NumPy's default (method 7 of Hyndman and Fan 1996); `None` for an empty sample.
///
/// Every p50, p95 and p99 of a report is computed here. Order statistics that a fitted model takes as its input are not
/// percentiles of a report and keep the rule with which the model was fitted.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a cast from a float saturates"
)]
pub fn quantile(sorted: &[f64], q: f64) -> Option<f64> {
    let last = sorted.len().checked_sub(1)?;
    let rank = q * last as f64;
    let below = (rank.floor() as usize).min(last);
    let above = (below + 1).min(last);
    let (low, high) = (*sorted.get(below)?, *sorted.get(above)?);
    let share = rank - below as f64;
    // The difference of infinite values is undefined.
    Some(if share == 0.0 || low == high {
        low
    } else {
        low + (high - low) * share
    })
}

/// The median of a sample in any order; `None` for an empty one.
pub fn median(values: &[f64]) -> Option<f64> {
    quantile(&sorted(values), 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_numpy() {
        // numpy.quantile([1, 2, 3, 4, 5], [0.5, 0.95]), numpy.quantile([1, 2, 3, 4], [0, 0.5, 1])
        let five = sorted(&[3.0, 1.0, 2.0, 4.0, 5.0]);
        assert_eq!(quantile(&five, 0.5), Some(3.0));
        assert!((quantile(&five, 0.95).unwrap() - 4.8).abs() < 1e-12);
        let four = [1.0, 2.0, 3.0, 4.0];
        assert_eq!(
            [0.0, 0.5, 1.0].map(|q| quantile(&four, q)),
            [Some(1.0), Some(2.5), Some(4.0)]
        );
        assert_eq!((median(&[4.0, 1.0, 3.0]), median(&[])), (Some(3.0), None));
        assert_eq!(
            (quantile(&[], 0.5), mean(&[]), mean(&four)),
            (None, None, Some(2.5))
        );
    }

    #[test]
    fn an_error_at_the_limit_and_an_attempt_without_one_are_no_success() {
        let errors = [0.5, SUCCESS_M, f64::NAN, f64::INFINITY];
        assert_eq!(share_below(&errors, SUCCESS_M, 5), 0.2);
        assert_eq!(share_below(&[], SUCCESS_M, 0), 0.0);
    }

    #[test]
    fn infinite_values_are_allowed() {
        let sample = [1.0, f64::INFINITY, f64::INFINITY];
        assert_eq!(
            [0.0, 0.25, 0.5, 0.75].map(|q| quantile(&sample, q)),
            [
                Some(1.0),
                Some(f64::INFINITY),
                Some(f64::INFINITY),
                Some(f64::INFINITY)
            ]
        );
    }
}
