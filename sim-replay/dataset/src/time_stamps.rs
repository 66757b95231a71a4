//! Time stamps in tables: microseconds, unless the numbers of a file show another unit.

use support::rounding;

/// Above this, stamps count nanoseconds: as microseconds they would be beyond the year 5000.
const LEAST_NANOS: f64 = 1e17;
/// Stamps with fractions below this count milliseconds: as microseconds they would be before 1974.
const MOST_MILLIS: f64 = 1e14;
/// Stamps with fractions below this count seconds.
const MOST_SECONDS: f64 = 1e11;

/// Microseconds in one unit of the stamps of a file, which are finite. All of them decide: one may be whole by chance.
pub(super) fn micros_per_unit(stamps: impl IntoIterator<Item = f64>) -> f64 {
    let (mut largest, mut has_fractions) = (0.0_f64, false);
    for stamp in stamps {
        largest = largest.max(stamp);
        has_fractions |= stamp.fract() != 0.0;
    }
    match largest {
        largest if largest > LEAST_NANOS => 1e-3,
        largest if has_fractions && largest < MOST_SECONDS => 1e6,
        largest if has_fractions && largest < MOST_MILLIS => 1e3,
        // Whole stamps are microseconds however small, as those of a clock that starts at 0.
        _ => 1.0,
    }
}

/// A stamp from 0 as whole microseconds.
pub(super) fn micros(stamp: f64, micros_per_unit: f64) -> u64 {
    rounding::to_u64(stamp * micros_per_unit)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn micros_of_file(stamps: &[f64]) -> Vec<u64> {
        let unit = micros_per_unit(stamps.iter().copied());
        stamps.iter().map(|&stamp| micros(stamp, unit)).collect()
    }

    #[test]
    fn the_numbers_of_a_file_determine_the_unit() {
        assert_eq!(
            micros_of_file(&[1_532_402_927_647_951.0]),
            [1_532_402_927_647_951]
        );
        assert_eq!(
            micros_of_file(&[1_557_858_039_302_414.8]),
            [1_557_858_039_302_415]
        );
        assert_eq!(
            micros_of_file(&[1.673_069_019_066_784e18]),
            [1_673_069_019_066_784]
        );
        assert_eq!(
            micros_of_file(&[1_673_069_019.0, 1_673_069_019.25]),
            [1_673_069_019_000_000, 1_673_069_019_250_000]
        );
        assert_eq!(
            micros_of_file(&[1_673_069_019_066.5]),
            [1_673_069_019_066_500]
        );
        assert_eq!(micros_of_file(&[0.0, 0.1]), [0, 100_000]);
        assert_eq!(micros_of_file(&[0.0, 100_000.0]), [0, 100_000]);
    }
}
