//! Decreasing functions from data: isotonic regression by pooling adjacent violators (Barlow et al. 1972).

use protocol::config::{FieldError, require};
use serde::{Deserialize, Serialize};

/// Relative tolerance of the order of knots that are equal up to rounding.
const ROUNDING: f64 = 1e-9;

/// Decreasing function: linear between its knots, approaching 0 and 1 beyond them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct MonotoneMap {
    /// x ascending and value; values in 0..=1, never increasing.
    knots: Vec<(f64, f64)>,
}

impl MonotoneMap {
    /// Function from knots with ascending x and non-increasing values, 0..=1.
    pub fn falling(knots: Vec<(f64, f64)>) -> Self {
        Self { knots }
    }

    /// Fits a decreasing function to samples of x and value, in groups of neighbours: about `groups` of them, each of
    /// at least `smallest` samples.
    pub fn fit(mut samples: Vec<(f64, f64)>, groups: usize, smallest: usize) -> Self {
        samples.sort_by(|a, b| a.0.total_cmp(&b.0));
        let count = samples.len();
        // Too few samples for a group of the smallest size are one group all the same.
        let size = (count / groups.max(1)).max(smallest).min(count).max(1);
        let mut pools: Vec<Pool> = Vec::new();
        let (whole, rest) = samples.split_at(count - count % size);
        for (index, group) in whole.chunks(size).enumerate() {
            // The remainder joins the last group: alone it would be a group of too few samples.
            let is_last = (index + 1) * size == whole.len();
            let mut pool = Pool::of(group);
            if is_last {
                pool = pool.with(&Pool::of(rest));
            }
            // A pool whose value is above that of the one before it violates the order: the two become one.
            while let Some(before) = pools.last()
                && before.mean() < pool.mean()
            {
                pool = before.with(&pool);
                pools.pop();
            }
            pools.push(pool);
        }
        let knots = pools.iter().map(|pool| (pool.x / pool.count, pool.mean()));
        Self::falling(knots.collect())
    }

    /// Checks that x increases and values decrease from knot to knot, as in a fit up to rounding.
    ///
    /// # Errors
    /// [`FieldError`] with the knots that are wrong.
    pub(super) fn check(&self) -> Result<(), FieldError> {
        for knot @ (x, y) in &self.knots {
            let is_knot = x.is_finite() && (0.0..=1.0).contains(y);
            require(is_knot, "a knot of sigma", knot, "must have 0 to 1")?;
        }
        for pair in self.knots.windows(2) {
            let ((x0, y0), (x1, y1)) = (pair[0], pair[1]);
            let is_in_order = x1 >= x0 - ROUNDING * (1.0 + x0.abs()) && y1 <= y0 + ROUNDING;
            let rule = "x must rise and values fall";
            require(is_in_order, "two knots of sigma", pair, rule)?;
        }
        Ok(())
    }

    /// Value at `x`; 0.5 for a function without knots, 0 if `x` is NaN.
    pub fn at(&self, x: f64) -> f64 {
        if x.is_nan() {
            return 0.0;
        }
        let (Some(&first), Some(&last)) = (self.knots.first(), self.knots.last()) else {
            return 0.5;
        };
        if x <= first.0 {
            return 1.0 - (1.0 - first.1) * (x - first.0).exp();
        }
        if x >= last.0 {
            return last.1 * (last.0 - x).exp();
        }
        // x0 <= x < x1: knots of equal x are no division by zero.
        let above = self.knots.partition_point(|knot| knot.0 <= x);
        let ((x0, y0), (x1, y1)) = (self.knots[above - 1], self.knots[above]);
        y0 + (y1 - y0) * (x - x0) / (x1 - x0)
    }
}

/// Samples that share one value.
#[derive(Debug, Clone, Copy)]
struct Pool {
    x: f64,
    value: f64,
    count: f64,
}

impl Pool {
    fn of(samples: &[(f64, f64)]) -> Self {
        Self {
            x: samples.iter().map(|sample| sample.0).sum(),
            value: samples.iter().map(|sample| sample.1).sum(),
            count: samples.len() as f64,
        }
    }

    fn with(&self, other: &Self) -> Self {
        Self {
            x: self.x + other.x,
            value: self.value + other.value,
            count: self.count + other.count,
        }
    }

    fn mean(&self) -> f64 {
        self.value / self.count
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn it_never_increases_and_stays_within_bounds(
            samples in prop::collection::vec((-5.0..5.0_f64, 0.0..=1.0_f64), 0..80),
            a in -9.0..9.0_f64, b in -9.0..9.0_f64,
        ) {
            let map = MonotoneMap::fit(samples, 8, 3);
            prop_assert_eq!(map.check(), Ok(()));
            prop_assert!(map.at(a.min(b)) >= map.at(a.max(b)) - 1e-12);
            prop_assert!((0.0..=1.0).contains(&map.at(a)));
        }
    }

    #[test]
    fn violators_are_pooled() {
        let samples = [(0.0, 0.9), (1.0, 0.2), (2.0, 0.6), (3.0, 0.1)];
        let map = MonotoneMap::fit(samples.to_vec(), 4, 1);
        assert_eq!(map.knots, [(0.0, 0.9), (1.5, 0.4), (3.0, 0.1)]);
        assert!((map.at(0.75) - 0.65).abs() < 1e-12);
    }

    #[test]
    fn beyond_the_data_it_keeps_decreasing() {
        let map = MonotoneMap::falling(vec![(0.0, 0.8), (1.0, 0.1)]);
        assert!(map.at(-1.0) > 0.8 && map.at(-9.0) < 1.0 && map.at(2.0) < 0.1 && map.at(9.0) > 0.0);
        assert_eq!(MonotoneMap::fit(Vec::new(), 4, 1).at(3.0), 0.5);
    }

    #[test]
    fn nan_has_no_confidence() {
        let map = MonotoneMap::falling(vec![(0.0, 0.8), (1.0, 0.1)]);
        assert_eq!(
            (
                map.at(f64::NAN),
                map.at(f64::INFINITY),
                map.at(f64::NEG_INFINITY)
            ),
            (0.0, 0.0, 1.0)
        );
    }
}
