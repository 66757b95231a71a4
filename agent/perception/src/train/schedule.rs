//! Learning-rate schedule: one cycle (Smith), up and down along a cosine.

use std::f64::consts::PI;

/// Share of the training in which the learning rate rises.
const RISE: f64 = 0.1;
/// Initial learning rate, relative to its peak.
const START: f64 = 0.04;
/// Final learning rate, relative to its peak.
const END: f64 = 1e-3;

/// The learning rate of one cycle up to `peak` when a share of the training is done, 0..1.
pub fn one_cycle(peak: f64, progress: f64) -> f64 {
    let progress = progress.clamp(0.0, 1.0);
    let between =
        |from: f64, to: f64, share: f64| to + (from - to) * (1.0 + (PI * share).cos()) / 2.0;
    peak * if progress < RISE {
        between(START, 1.0, progress / RISE)
    } else {
        between(1.0, END, (progress - RISE) / (1.0 - RISE))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rises_to_the_peak_and_falls_to_almost_nothing() {
        let at = |share: f64| one_cycle(2e-3, share);
        assert!((at(0.0) - 8e-5).abs() < 1e-12);
        assert!((at(RISE) - 2e-3).abs() < 1e-12);
        assert!((at(1.0) - 2e-6).abs() < 1e-12);
        assert!((at(7.0) - at(1.0)).abs() < 1e-12);
        let falling: Vec<f64> = (2..=20).map(|step| at(f64::from(step) / 20.0)).collect();
        assert!(falling.is_sorted_by(|a, b| a > b));
    }
}
