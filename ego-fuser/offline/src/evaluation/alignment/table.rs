//! Totals of an alignment method: the columns of the paper's alignment table, and a few more.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use serde::Serialize;
use support::statistics::{SUCCESS_M, mean, median, share_below};

use super::{PairError, PairOutcome};

/// One method over all pairs.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MethodRow {
    /// Name of the method.
    pub method: String,
    /// Pairs of ego and neighbour, counted at every tick.
    pub pairs: usize,
    /// Mean time per pair, seconds.
    pub time_s: f64,
    /// Mean bytes that a neighbour sends for it.
    pub bytes_mean: f64,
    /// Their logarithm to base 2; `None` where nothing was sent.
    pub log2_bytes: Option<f64>,
    /// Share of all pairs that are right to 3 m, 0..1; a pair without alignment is not.
    pub success_3m: f64,
    /// The same within 1 m.
    pub success_1m: f64,
    /// Mean error of the aligned pairs, metres; `None` where none was aligned.
    pub mean_m: Option<f64>,
    /// Median of the same, metres.
    pub p50_m: Option<f64>,
    /// Mean error of the aligned pairs, degrees.
    pub mean_deg: Option<f64>,
    /// Median of the same, degrees.
    pub p50_deg: Option<f64>,
    /// Share of all pairs that were not aligned, 0..1.
    pub not_aligned: f64,
    /// Pairs that were not aligned, by reason.
    pub reasons: BTreeMap<&'static str, usize>,
}

/// Collects outcomes of one method.
#[derive(Debug, Clone, Default)]
pub struct PairTally {
    seconds: f64,
    bytes: f64,
    errors: Vec<PairError>,
    reasons: BTreeMap<&'static str, usize>,
}

impl PairTally {
    /// Counts one pair.
    pub fn add(&mut self, outcome: &PairOutcome) {
        self.seconds += outcome.time.as_secs_f64();
        self.bytes += outcome.bytes as f64;
        match &outcome.result {
            Ok(error) => self.errors.push(*error),
            Err(why) => *self.reasons.entry(why.reason()).or_default() += 1,
        }
    }

    /// The row; shares of nothing are zero.
    pub fn row(&self, method: &str) -> MethodRow {
        let failed: usize = self.reasons.values().sum();
        let pairs = failed + self.errors.len();
        let divisor = pairs.max(1) as f64;
        let bytes_mean = self.bytes / divisor;
        let metres: Vec<f64> = self.errors.iter().map(|error| error.metres).collect();
        let [success_3m, success_1m] =
            [SUCCESS_M, 1.0].map(|limit_m| share_below(&metres, limit_m, pairs));
        let degrees: Vec<f64> = self.errors.iter().map(|error| error.degrees).collect();
        MethodRow {
            method: method.to_owned(),
            pairs,
            time_s: self.seconds / divisor,
            bytes_mean,
            log2_bytes: (bytes_mean > 0.0).then(|| bytes_mean.log2()),
            success_3m,
            success_1m,
            mean_m: mean(&metres),
            p50_m: median(&metres),
            mean_deg: mean(&degrees),
            p50_deg: median(&degrees),
            not_aligned: failed as f64 / divisor,
            reasons: self.reasons.clone(),
        }
    }
}

/// The rows as a markdown table.
pub fn markdown(rows: &[MethodRow]) -> String {
    let mut text = String::from(
        "| method | time, s | bytes, log2 | under 3 m, % | under 1 m, % | mean / median, m | mean / median, deg | no alignment, % | pairs |\n\
         | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |\n",
    );
    for row in rows {
        let errors = [(row.mean_m, row.p50_m), (row.mean_deg, row.p50_deg)];
        let [metres, degrees] = errors.map(|mean_and_median| match mean_and_median {
            (Some(mean), Some(median)) => format!("{mean:.2} / {median:.2}"),
            _ => "-".to_owned(),
        });
        let bits = (row.log2_bytes).map_or_else(|| "-".to_owned(), |bits| format!("{bits:.2}"));
        // Writing to a string does not fail.
        let _ = writeln!(
            text,
            "| {} | {:.4} | {bits} | {:.2} | {:.2} | {metres} | {degrees} | {:.2} | {} |",
            row.method,
            row.time_s,
            100.0 * row.success_3m,
            100.0 * row.success_1m,
            100.0 * row.not_aligned,
            row.pairs
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::super::NotAligned;
    use super::*;

    fn outcome(result: Result<(f64, f64), NotAligned>) -> PairOutcome {
        let result = result.map(|(metres, degrees)| PairError { metres, degrees });
        PairOutcome {
            method: 0,
            bytes: 64,
            time: Duration::from_millis(20),
            result,
        }
    }

    #[test]
    fn a_pair_without_alignment_is_no_success() {
        let mut tally = PairTally::default();
        for result in [
            Ok((0.5, 1.0)),
            Ok((2.0, 0.2)),
            Ok((30.0, 90.0)),
            Err(NotAligned::NoPose),
        ] {
            tally.add(&outcome(result));
        }
        let row = tally.row("poses");
        assert_eq!(
            (row.pairs, row.success_3m, row.success_1m, row.not_aligned),
            (4, 0.5, 0.25, 0.25)
        );
        assert_eq!(
            (row.p50_m, row.p50_deg, row.log2_bytes),
            (Some(2.0), Some(1.0), Some(6.0))
        );
        assert!(
            (row.mean_m.unwrap() - 32.5 / 3.0).abs() < 1e-12 && (row.time_s - 0.02).abs() < 1e-12
        );
        assert_eq!(row.reasons, BTreeMap::from([("no_pose", 1)]));
        let text = markdown(&[row, PairTally::default().row("nothing")]);
        assert_eq!(text.lines().count(), 4);
        assert!(
            text.contains("| poses | 0.0200 | 6.00 | 50.00 | 25.00 | 10.83 / 2.00 |"),
            "{text}"
        );
        assert!(
            text.contains("| nothing | 0.0000 | - | 0.00 | 0.00 | - | - |"),
            "{text}"
        );
    }
}
