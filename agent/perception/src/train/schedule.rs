//! Learning-rate schedules: one cycle (Smith), up and down along a cosine; or a held rate that falls at the end.

use std::f64::consts::PI;

/// Share of the training in which the learning rate rises.
const RISE: f64 = 0.1;
/// Initial learning rate, relative to its peak.
const START: f64 = 0.04;
/// Final learning rate, relative to its peak.
const END: f64 = 1e-3;

/// Share of the training after which a held rate falls.
const HELD: f64 = 0.8;
/// Share of the training in which a held rate rises.
const HELD_RISE: f64 = 0.02;

/// Course of the learning rate over a training.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum RateSchedule {
    /// Up in a tenth of the training, then down.
    #[default]
    OneCycle,
    /// At its peak for four fifths of the training, then down.
    HeldRate,
}

impl RateSchedule {
    /// The learning rate with this peak when a share of the training is done, 0..1.
    pub fn rate(self, peak: f64, progress: f64) -> f64 {
        match self {
            Self::OneCycle => one_cycle(peak, progress),
            Self::HeldRate if progress < HELD => peak * (progress / HELD_RISE).clamp(START, 1.0),
            Self::HeldRate => peak * between(1.0, END, ((progress - HELD) / (1.0 - HELD)).min(1.0)),
        }
    }
}

/// The learning rate of one cycle up to `peak` when a share of the training is done, 0..1.
pub fn one_cycle(peak: f64, progress: f64) -> f64 {
    let progress = progress.clamp(0.0, 1.0);
    peak * if progress < RISE {
        between(START, 1.0, progress / RISE)
    } else {
        between(1.0, END, (progress - RISE) / (1.0 - RISE))
    }
}

/// From one number to another along half a cosine.
fn between(from: f64, to: f64, share: f64) -> f64 {
    to + (from - to) * (1.0 + (PI * share).cos()) / 2.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rises_to_the_peak_and_falls_to_almost_nothing() {
        for (progress, expected) in [
            (0.0, 8e-5),
            (RISE, 2e-3),
            (1.0, 2e-6),
            (7.0, one_cycle(2e-3, 1.0)),
        ] {
            let rate = one_cycle(2e-3, progress);
            assert!((rate - expected).abs() < 1e-12, "{progress}: {rate}");
        }
        let falling = (2..=20).map(|step| one_cycle(2e-3, f64::from(step) / 20.0));
        assert!(falling.is_sorted_by(|a, b| a > b));
    }

    #[test]
    fn a_held_rate_stays_at_the_peak_for_four_fifths() {
        let [first, risen, held, falling, end, beyond] = [0.0, 0.1, 0.79, 0.9, 1.0, 2.0]
            .map(|progress| RateSchedule::HeldRate.rate(2e-3, progress));
        assert_eq!((first, risen, held), (8e-5, 2e-3, 2e-3));
        assert!((falling - 1e-3).abs() < 1e-5);
        assert!((end - 2e-6).abs() < 1e-12 && beyond == end);
    }
}
