//! Rank correlation of paired samples, and the limit of a share.

use support::statistics::mean;

/// Spearman's rank correlation of paired samples, equal values sharing their mean rank; `None` when one of them does
/// not vary, or there are fewer than two pairs.
pub fn spearman(a: &[f64], b: &[f64]) -> Option<f64> {
    if a.len() != b.len() || a.len() < 2 {
        return None;
    }
    let [a, b] = [a, b].map(ranks);
    let (mean_a, mean_b) = (mean(&a)?, mean(&b)?);
    let [mut ab, mut aa, mut bb] = [0.0; 3];
    for (a, b) in a.iter().zip(&b) {
        let (a, b) = (a - mean_a, b - mean_b);
        (ab, aa, bb) = (ab + a * b, aa + a * a, bb + b * b);
    }
    (aa > 0.0 && bb > 0.0).then(|| ab / (aa * bb).sqrt())
}

/// Upper 95 % confidence limit of a share of which `count` of `all` were seen (Clopper and Pearson 1934); 1 of none.
pub fn share_limit(count: usize, all: usize) -> f64 {
    if count >= all {
        return 1.0;
    }
    let (mut low, mut high) = (0.0, 1.0);
    // The probability falls as the share grows: bisection, nearly to the precision of a double.
    for _ in 0..50 {
        let share = f64::midpoint(low, high);
        // In logarithms: of many samples the first term is less than the smallest double.
        let (odds, mut term) = ((share / (1.0 - share)).ln(), all as f64 * (-share).ln_1p());
        // Probability of at most `count`, at this share.
        let at_most = (0..count).fold(term.exp(), |sum, seen| {
            // Each binomial term from the one before, without factorials.
            term += ((all - seen) as f64 / (seen + 1) as f64).ln() + odds;
            sum + term.exp()
        });
        match at_most > 0.05 {
            true => low = share,
            false => high = share,
        }
    }
    high
}

/// Ranks from 0; equal values share their mean rank.
fn ranks(values: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|&a, &b| values[a].total_cmp(&values[b]));
    let mut ranks = vec![0.0; values.len()];
    let mut place = 0;
    for equal in order.chunk_by(|&a, &b| values[a] == values[b]) {
        let rank = place as f64 + (equal.len() - 1) as f64 / 2.0;
        equal.iter().for_each(|&index| ranks[index] = rank);
        place += equal.len();
    }
    ranks
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranks_count_and_not_values() {
        let a = [0.1, 0.2, 0.3, 0.9];
        assert_eq!(spearman(&a, &[1.0, 10.0, 11.0, 1e9]), Some(1.0));
        assert_eq!(spearman(&a, &[4.0, 3.0, 2.0, 1.0]), Some(-1.0));
    }

    #[test]
    fn equal_values_share_their_rank() {
        assert_eq!(ranks(&[5.0, 1.0, 5.0, 5.0]), [2.0, 0.0, 2.0, 2.0]);
        // From the definition: ranks 0.5 0.5 2 against 0 1 2.
        let expected = (0.75_f64).sqrt();
        assert!((spearman(&[1.0, 1.0, 2.0], &[1.0, 2.0, 3.0]).unwrap() - expected).abs() < 1e-12);
    }

    #[test]
    fn the_limit_of_a_share_is_that_of_the_tables() {
        // Of none seen, 1 - 0.05^(1/n), about 3 in n; 1 of 10 and 5 of 223 by the tables of Clopper and Pearson.
        for (count, all, limit) in [
            (0, 3000, 0.000_998),
            (0, 10, 0.258_9),
            (1, 10, 0.394_2),
            (5, 223, 0.046_5),
            // Beyond the range of a double without logarithms.
            (1000, 4000, 0.261_5),
            (5000, 100_000, 0.051_15),
        ] {
            let found = share_limit(count, all);
            assert!(
                (found / limit - 1.0).abs() < 0.01,
                "{count} of {all}: {found}"
            );
        }
        assert_eq!((share_limit(0, 0), share_limit(4, 4)), (1.0, 1.0));
    }

    #[test]
    fn constant_samples_have_no_correlation() {
        assert_eq!(spearman(&[1.0, 1.0], &[1.0, 2.0]), None);
        assert_eq!(spearman(&[1.0], &[1.0]), None);
    }
}
