//! Times in files: their unit, which the list as a whole decides.

use std::ops::{Range, RangeInclusive};
use std::path::Path;

use strum::IntoEnumIterator;
use support::{rounding, statistics};

use super::ReadError;

/// Times since an epoch, seconds: of the years 2001 to 2286.
pub(super) const EPOCH_S: Range<f64> = 1e9..1e10;
/// Largest median step of these, seconds.
const MOST_EPOCH_STEP_S: f64 = 3600.0;
/// Median steps of the times of a LiDAR, seconds: from 200 Hz to rare key frames.
const LIDAR_STEP_S: RangeInclusive<f64> = 0.005..=5.0;
/// Largest median step of other times, seconds.
const MOST_STEP_S: f64 = 60.0;
/// Digits and range of the numbers of a date with a time of day.
const DATE: [(usize, RangeInclusive<u16>); 6] = [
    (4, 1970..=2285),
    (2, 1..=12),
    (2, 1..=31),
    (2, 0..=23),
    (2, 0..=59),
    (2, 0..=60),
];

/// Unit of a time.
#[derive(Debug, Clone, Copy, PartialEq, strum::EnumIter)]
pub(super) enum Unit {
    Seconds,
    Milliseconds,
    Microseconds,
    Nanoseconds,
}

impl Unit {
    fn seconds(self) -> f64 {
        match self {
            Self::Seconds => 1.0,
            Self::Milliseconds => 1e-3,
            Self::Microseconds => 1e-6,
            Self::Nanoseconds => 1e-9,
        }
    }

    /// The unit of times from 0 in their order: by their size if they count from an epoch, else the first in which their
    /// median step is that of a LiDAR, else the first in which it is a minute at most.
    pub(super) fn of(times: &[f64]) -> Option<Self> {
        let step = median_step(times);
        let least = times.iter().copied().fold(f64::INFINITY, f64::min);
        let most = times.iter().copied().fold(0.0, f64::max);
        let fits = |unit: &Self, most_step_s: f64| {
            most * unit.seconds() < EPOCH_S.end && step * unit.seconds() <= most_step_s
        };
        let since_epoch =
            |unit: &Self| least * unit.seconds() >= EPOCH_S.start && fits(unit, MOST_EPOCH_STEP_S);
        let of_lidar = |unit: &Self| {
            step * unit.seconds() >= *LIDAR_STEP_S.start() && fits(unit, *LIDAR_STEP_S.end())
        };
        (Self::iter().find(since_epoch))
            .or_else(|| Self::iter().find(of_lidar))
            .or_else(|| Self::iter().find(|unit| fits(unit, MOST_STEP_S)))
    }

    /// The unit of the times of a file, as [`Self::of`]; microseconds if none fits. An unusual step is a problem.
    pub(super) fn of_file(path: &Path, times: &[f64], problems: &mut Vec<ReadError>) -> Self {
        let unit = Self::of(times).unwrap_or(Self::Microseconds);
        let nanos: Vec<u64> = times.iter().map(|time| unit.nanos(*time)).collect();
        problems.extend(step_problem(path, &nanos));
        unit
    }

    /// A time from 0 in this unit as whole microseconds.
    pub(super) fn micros(self, time: f64) -> u64 {
        rounding::to_u64(time * (self.seconds() * 1e6))
    }

    /// The same as nanoseconds. Doubles keep times since 1970 to a quarter of a microsecond.
    pub(super) fn nanos(self, time: f64) -> u64 {
        rounding::to_u64(time * (self.seconds() * 1e9))
    }
}

/// The problem that times, nanoseconds, are beyond all years; or, where they count from a start, that they do not
/// follow one another as those of a LiDAR do, or jump as the digits of a clock (`101559.9`, `101600.0`) do after every
/// minute.
pub(super) fn step_problem(path: &Path, nanos: &[u64]) -> Option<ReadError> {
    let times_s: Vec<f64> = nanos.iter().map(|nanos| *nanos as f64 * 1e-9).collect();
    let (first, last) = (times_s.first()?, times_s.last()?);
    let step_s = median_step(&times_s);
    let mut steps = times_s.array_windows();
    let is_clock = times_s.iter().all(|time| time % 100.0 < 60.0)
        && steps.any(|[a, b]| b % 100.0 < a % 100.0 && (40.0..=45.0).contains(&(b - a)));
    let is_usual = step_s == 0.0 || LIDAR_STEP_S.contains(&step_s);
    let is_doubtful = *first < EPOCH_S.start && (is_clock || !is_usual);
    (is_doubtful || *last >= EPOCH_S.end).then(|| {
        let reason = format!(
            "taken as times from {first:.3} s to {last:.3} s with a median step of {step_s:.6} s, expected 0.005 to 5 s \
             and no digits of a date or a clock: their unit is doubtful"
        );
        ReadError::malformed(path, reason)
    })
}

/// The problem that names are dates with a time of day, `2021-08-22-21-41-24`, which nothing reads as times.
pub(super) fn date_problem(path: &Path, stems: &[&str]) -> Option<ReadError> {
    let (first, last) = (stems.first()?, stems.last()?);
    (first != last && stems.iter().all(|stem| is_date(stem))).then(|| {
        let reason = format!(
            "names from {first} to {last} are dates, which are not read as times: frames count as evenly spaced"
        );
        ReadError::malformed(path, reason)
    })
}

/// True for a name whose numbers are year, month, day, hour, minute and second, and no count after them.
fn is_date(stem: &str) -> bool {
    let numbers = stem.split(|letter: char| !letter.is_ascii_digit());
    let numbers: Vec<&str> = numbers.filter(|number| !number.is_empty()).collect();
    let mut parts = numbers.iter().zip(&DATE);
    numbers.len() == DATE.len()
        && parts.all(|(number, (digits, range))| {
            let number = number
                .parse::<u16>()
                .ok()
                .filter(|_| number.len() == *digits);
            number.is_some_and(|number| range.contains(&number))
        })
}

/// The median of the steps that are not 0: neither a pause in the drive nor equal times decide. 0 without any.
fn median_step(times: &[f64]) -> f64 {
    let steps = times.array_windows();
    let steps = steps.map(|[time, next]| (next - time).abs());
    let steps: Vec<f64> = steps.filter(|step| *step > 0.0).collect();
    statistics::median(&steps).unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn micros_of_file(times: &[f64]) -> Vec<u64> {
        let mut problems = Vec::new();
        let unit = Unit::of_file(Path::new("a"), times, &mut problems);
        assert_eq!(problems.len(), 0, "{problems:?}");
        times.iter().map(|&time| unit.micros(time)).collect()
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

    #[test]
    fn times_since_an_epoch_have_the_unit_of_their_size() {
        for (unit, per_second) in Unit::iter().zip([1.0, 1e3, 1e6, 1e9]) {
            for step_s in [0.0001, 0.1, 9.0, 1000.0] {
                let times = [1.6e9, 1.6e9 + step_s].map(|time| time * per_second);
                assert_eq!(Unit::of(&times), Some(unit), "{step_s} s");
            }
        }
    }

    #[test]
    fn times_since_a_start_have_the_unit_in_which_a_lidar_has_their_step() {
        for (unit, per_second) in Unit::iter().zip([1.0, 1e3, 1e6, 1e9]) {
            // A clock that started hours ago, 20 Hz, 10 Hz, key frames every two seconds.
            for (start_s, step_s) in [(0.0, 0.05), (0.0, 0.1), (0.0, 2.0), (5000.0, 0.05)] {
                let times = [0.0, 1.0, 2.0].map(|step| (start_s + step * step_s) * per_second);
                assert_eq!(Unit::of(&times), Some(unit), "{start_s} s, {step_s} s");
            }
        }
    }

    #[test]
    fn digits_of_a_date_or_a_clock_are_no_times() {
        let found = |times: &[f64]| {
            let mut problems = Vec::new();
            let unit = Unit::of_file(Path::new("a"), times, &mut problems);
            let nanos: Vec<u64> = times.iter().map(|time| unit.nanos(*time)).collect();
            assert!(nanos.is_sorted_by(|a, b| a < b), "{nanos:?}");
            problems.len()
        };
        // 2023-04-12 10:15:59.5: every time was the largest one.
        assert_eq!(
            found(&[20_230_412_101_559_500.0, 20_230_412_101_559_600.0]),
            1
        );
        // All of 20 digits are the largest time.
        assert!(step_problem(Path::new("a"), &[u64::MAX; 2]).is_some());
        assert_eq!(found(&[101_559.8, 101_559.9, 101_600.0, 101_600.1]), 1);
        assert_eq!(found(&[101_559.8, 101_559.9, 101_560.0, 101_560.1]), 0);
        assert_eq!(found(&[101_599.8, 101_599.9, 101_600.0, 101_600.1]), 0);
    }

    #[test]
    fn names_that_are_dates_are_named() {
        let found = |stems: &[&str]| {
            let problem = date_problem(Path::new("a"), stems);
            problem.map(|problem| problem.to_string())
        };
        let expected = "a: names from 2021-08-22-21-41-59 to 2021-08-22-21-42-00 are dates, which are not read as times: \
                        frames count as evenly spaced";
        let dates = ["2021-08-22-21-41-59", "2021-08-22-21-42-00"];
        assert_eq!(found(&dates).as_deref(), Some(expected));
        for stems in [
            ["2021-08-22-21-41-24_1", "2021-08-22-21-41-24_2"],
            ["2021-08-22-21-41-24", "2021-08-22-21-41-24"],
            ["2021-08-22-21-41-59", "2021-08-22-21-41-61"],
            ["000068", "000070"],
        ] {
            assert_eq!(found(&stems), None, "{stems:?}");
        }
    }

    #[test]
    fn a_step_that_no_lidar_has_is_a_problem() {
        let mut problems = Vec::new();
        let unit = Unit::of_file(Path::new("a"), &[0.0, 0.001, 0.002], &mut problems);
        let shown: Vec<String> = problems.iter().map(ToString::to_string).collect();
        let expected = "a: taken as times from 0.000 s to 0.002 s with a median step of 0.001000 s, expected 0.005 to 5 s \
                        and no digits of a date or a clock: their unit is doubtful";
        assert_eq!((unit, shown), (Unit::Seconds, vec![expected.to_owned()]));
    }
}
