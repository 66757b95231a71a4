//! Keys of clouds and poses: names, numbers or times. A list as a whole decides which.

use std::str::FromStr;

use support::statistics;

use super::time_stamps::{EPOCH_S, Unit};

/// Least value of a whole number that is a time: nine digits.
const LEAST_WHOLE_TIME: f64 = 1e8;
/// Least number of names for each one that is left out as a stray. Where more differ from the others, the wrong ones
/// cannot be determined.
pub(super) const LEAST_PER_STRAY: usize = 10;
/// Least distance of a stray from the median, in ranges of the other numbers. Times from a start are nearer.
const LEAST_STRAY_RANGES: f64 = 10.0;
/// Digits of nanoseconds.
const NANOS_DIGITS: usize = 9;

/// One key per cloud or pose, in their order.
#[derive(Debug, PartialEq)]
pub(super) enum Keys {
    /// Names of files, or other words.
    Names(Vec<String>),
    /// Numbers of clouds.
    Numbers(Vec<u64>),
    /// Nanoseconds.
    Times(Vec<u64>),
}

impl Keys {
    /// Keys of clouds by the stems of their files: the last number of each name, if all else in the names is equal.
    /// It is a time if it has a fraction or at least nine digits.
    pub(super) fn of_stems(stems: &[&str]) -> Self {
        let keys = numbered(stems).and_then(|numbered| Self::of_numbered(&numbered));
        keys.unwrap_or_else(|| Self::Names(stems.iter().map(|&stem| stem.to_owned()).collect()))
    }

    /// Counts of ticks of a stated length, nanoseconds, however large. `None` where the names are more or less than a
    /// number, and for times since an epoch, which would lie beyond all years.
    pub(super) fn of_ticks(stems: &[&str], tick_nanos: u64) -> Option<Self> {
        let tick_s = tick_nanos as f64 * 1e-9;
        let is_count = |ticks: &u64| *ticks as f64 * tick_s < EPOCH_S.end;
        parsed(&whole_words(stems)?, is_count).map(Self::Numbers)
    }

    fn of_numbered(numbered: &[Numbered<'_>]) -> Option<Self> {
        let stamps = numbered.iter();
        let stamps = stamps.map(|name| stamp_nanos(name.seconds?, name.number));
        if let Some(times) = stamps.collect() {
            return Some(Self::Times(times));
        }
        let words: Vec<&str> = numbered.iter().map(|name| name.number).collect();
        if let Some(numbers) = whole_numbers(&words) {
            return Some(Self::Numbers(numbers));
        }
        let have_fraction = words.iter().any(|word| word.contains('.'));
        Self::of_times(&words, have_fraction.then_some(Unit::Seconds))
    }

    /// Keys of words without a statement of their meaning. `None` for whole numbers that are written with a fraction
    /// (`0.0 1.0 2.0`): programs count poses so where they know no time.
    pub(super) fn of_words(words: &[&str]) -> Option<Self> {
        if let Some(numbers) = whole_numbers(words) {
            return Some(Self::Numbers(numbers));
        }
        let Some(values) = numbers(words) else {
            let names = words.iter().map(|&word| word.to_owned());
            return Some(Self::Names(names.collect()));
        };
        let mut values = values.iter();
        match values.all(|value| value.fract() == 0.0 && *value < LEAST_WHOLE_TIME) {
            true => None,
            false => Self::of_times(words, None),
        }
    }

    /// The number of a cloud, or its place among all.
    pub(super) fn count(&self, index: usize) -> u64 {
        match self {
            Self::Numbers(numbers) => numbers.get(index).copied(),
            Self::Names(_) | Self::Times(_) => None,
        }
        .unwrap_or(index as u64)
    }

    /// True if two keys are the same.
    pub(super) fn are_equal(&self, first: usize, second: usize) -> bool {
        match self {
            Self::Names(names) => names.get(first) == names.get(second),
            Self::Numbers(values) | Self::Times(values) => values.get(first) == values.get(second),
        }
    }

    /// First and last key, for messages.
    pub(super) fn shown(&self) -> String {
        match self {
            Self::Names(names) => ends("names", names),
            Self::Numbers(numbers) => ends("numbers", numbers),
            Self::Times(times) => {
                let seconds = times.iter().map(|nanos| *nanos as f64 * 1e-9);
                let seconds: Vec<String> = seconds.map(|time| format!("{time:.3} s")).collect();
                ends("times", &seconds)
            }
        }
    }

    /// True for names that differ in numbers only, `2021-08-21-17-30-41` and the like: their natural order is that of
    /// the clouds.
    pub(super) fn have_one_form(&self) -> bool {
        match self {
            Self::Names(names) => names.iter().all(|name| {
                let first = names.first().unwrap_or(name);
                name.contains(is_digit) && around_digits(name).eq(around_digits(first))
            }),
            Self::Numbers(_) | Self::Times(_) => true,
        }
    }

    /// Times of words in a unit, or in the one that their size shows; `None` if a word is no time.
    pub(super) fn of_times(words: &[&str], unit: Option<Unit>) -> Option<Self> {
        let values = numbers(words)?;
        let unit = unit.or_else(|| Unit::of(&values))?;
        let nanos = values.iter().map(|value| unit.nanos(*value));
        Some(Self::Times(nanos.collect()))
    }
}

fn ends<T: std::fmt::Display>(kind: &str, keys: &[T]) -> String {
    match (keys.first(), keys.last()) {
        (Some(first), Some(last)) => format!("{kind} {first} to {last}"),
        _ => format!("no {kind}"),
    }
}

/// The text around the numbers of a name.
fn around_digits(name: &str) -> impl Iterator<Item = &str> {
    name.split(is_digit).filter(|text| !text.is_empty())
}

fn is_digit(letter: char) -> bool {
    letter.is_ascii_digit()
}

/// Whole numbers below nine digits; `None` if a word is none.
pub(super) fn whole_numbers(words: &[&str]) -> Option<Vec<u64>> {
    parsed(words, |number: &u64| (*number as f64) < LEAST_WHOLE_TIME)
}

/// Numbers from 0 on; `None` if a word is none.
fn numbers(words: &[&str]) -> Option<Vec<f64>> {
    parsed(words, |number: &f64| number.is_finite() && *number >= 0.0)
}

fn parsed<T: FromStr>(words: &[&str], is_valid: impl Fn(&T) -> bool) -> Option<Vec<T>> {
    let numbers = words.iter().map(|word| word.parse().ok().filter(&is_valid));
    numbers.collect()
}

/// The few stems with a time where the median is a number, or the other way round: one alone would decide what all are.
/// `None` without any.
pub(super) fn strays<'a>(stems: &[&'a str]) -> Option<Vec<&'a str>> {
    let numbers = numbers(&whole_words(stems)?)?;
    let median = statistics::median(&numbers)?;
    let is_time = |number: f64| number >= LEAST_WHOLE_TIME;
    let (others, usual): (Vec<_>, Vec<_>) =
        (stems.iter().zip(numbers)).partition(|(_, number)| is_time(*number) != is_time(median));
    let usual = usual.iter().map(|(_, number)| *number);
    let range = usual.clone().fold(0.0, f64::max) - usual.fold(f64::INFINITY, f64::min);
    let mut distances = others.iter().map(|(_, number)| (number - median).abs());
    let are_few = !others.is_empty() && others.len() * LEAST_PER_STRAY <= stems.len();
    (are_few && distances.all(|distance| distance > LEAST_STRAY_RANGES * range))
        .then(|| others.iter().map(|(stem, _)| **stem).collect())
}

/// The numbers in names that are no seconds with nanoseconds after them.
fn whole_words<'a>(stems: &[&'a str]) -> Option<Vec<&'a str>> {
    let names = numbered(stems)?.into_iter();
    let words = names.map(|name| name.seconds.is_none().then_some(name.number));
    words.collect()
}

/// The numbers of names; `None` for names that differ in more than a number.
fn numbered<'a>(stems: &[&'a str]) -> Option<Vec<Numbered<'a>>> {
    let names = stems.iter().copied().map(Numbered::of);
    let names: Vec<Numbered<'a>> = names.collect::<Option<_>>()?;
    let around = names.first()?.around;
    let are_alike = names.iter().all(|name| name.around == around);
    are_alike.then_some(names)
}

/// A name with a number in it.
struct Numbered<'a> {
    /// The text before and after the number.
    around: (&'a str, &'a str),
    /// The number, possibly with a fraction.
    number: &'a str,
    /// Seconds, where the number is the nanoseconds after them.
    seconds: Option<&'a str>,
}

impl<'a> Numbered<'a> {
    /// The last number of a name: `7` of `scan_7`, `10.5` of `10.5`, seconds and nanoseconds of
    /// `cloud_1583836591_182590976`.
    fn of(stem: &'a str) -> Option<Self> {
        let end = stem.rfind(is_digit)? + 1;
        let (head, after) = stem.split_at_checked(end)?;
        let (before, number) = last_digits(head);
        let fraction_of = before.strip_suffix('.').map(last_digits);
        if let Some((whole, _)) = fraction_of.filter(|(_, digits)| !digits.is_empty()) {
            let number = head.strip_prefix(whole)?;
            return Some(Self {
                around: (whole, after),
                number,
                seconds: None,
            });
        }
        let stamp = before
            .strip_suffix(['_', '-'])
            .map(last_digits)
            .filter(|(_, seconds)| is_epoch(seconds) && number.len() <= NANOS_DIGITS);
        Some(Self {
            around: (stamp.map_or(before, |(before, _)| before), after),
            number,
            seconds: stamp.map(|(_, seconds)| seconds),
        })
    }
}

/// Nanoseconds of whole seconds and the nanoseconds after them.
pub(super) fn stamp_nanos(seconds: &str, nanos: &str) -> Option<u64> {
    let nanos: u64 = nanos.parse().ok().filter(|nanos| *nanos < 1_000_000_000)?;
    let seconds: u64 = seconds.parse().ok()?;
    seconds.checked_mul(1_000_000_000)?.checked_add(nanos)
}

/// A text without the digits at its end, and these.
fn last_digits(text: &str) -> (&str, &str) {
    text.split_at(text.trim_end_matches(is_digit).len())
}

/// True for digits of seconds since 1970: nine or ten places without zeros in front.
fn is_epoch(digits: &str) -> bool {
    (NANOS_DIGITS..=NANOS_DIGITS + 1).contains(&digits.trim_start_matches('0').len())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_names_are_times_with_a_fraction_or_nine_digits() {
        let cases = [
            (vec!["0", "10", "2"], Keys::Numbers(vec![0, 10, 2])),
            (vec!["scan_07", "scan_8"], Keys::Numbers(vec![7, 8])),
            (vec!["frame-1"], Keys::Numbers(vec![1])),
            (vec!["7_lidar"], Keys::Numbers(vec![7])),
            (vec!["0000000123"], Keys::Numbers(vec![123])),
            (
                vec!["10.5", "11"],
                Keys::Times(vec![10_500_000_000, 11_000_000_000]),
            ),
            (
                vec!["1600000000000000"],
                Keys::Times(vec![1_600_000_000_000_000_000]),
            ),
            (
                vec!["cloud_1583836591_182590976", "cloud_1583836592_82590976"],
                Keys::Times(vec![1_583_836_591_182_590_976, 1_583_836_592_082_590_976]),
            ),
            (
                vec!["left_0", "right_0"],
                Keys::Names(vec!["left_0".into(), "right_0".into()]),
            ),
        ];
        for (stems, expected) in cases {
            assert_eq!(Keys::of_stems(&stems), expected, "{stems:?}");
        }
    }

    #[test]
    fn a_few_numbers_of_another_size_are_strays() {
        let strays_of = |usual: [u64; 3], other: &str| {
            let [first, step, count] = usual;
            let usual = (0..count).map(|index| format!("{:06}", first + step * index));
            let stems: Vec<String> = usual.chain([other.to_owned()]).collect();
            let stems: Vec<&str> = stems.iter().map(String::as_str).collect();
            strays(&stems).map(|strays| strays.concat())
        };
        let numbers = [60, 2, 20];
        let times = [1_600_000_000_000, 100, 20];
        for (usual, other) in [
            (numbers, "123456789"),
            (numbers, "99999999999999999999"),
            (times, "000007"),
        ] {
            assert_eq!(strays_of(usual, other).as_deref(), Some(other));
        }
        for (usual, other) in [
            (numbers, "000100"),
            (numbers, "scan_123456789"),
            (times, "1600000009999"),
            // Too few others.
            ([60, 2, 8], "123456789"),
            // Times from 0 on, nanoseconds and microseconds.
            ([100_000_000, 100_000_000, 20], "000000000"),
            ([0, 100_000, 1000], "100000000"),
        ] {
            assert_eq!(strays_of(usual, other), None, "{usual:?} {other}");
        }
    }

    fn times(words: &[&str]) -> Vec<u64> {
        match Keys::of_times(words, None) {
            Some(Keys::Times(times)) => times,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn a_list_of_times_has_one_unit() {
        assert_eq!(times(&["0", "100000000"]), [0, 100_000_000], "nanoseconds");
        assert_eq!(
            times(&["1000", "1001"]),
            [1_000_000_000_000, 1_001_000_000_000]
        );
        assert_eq!(
            times(&["1600000000128", "1600000000228"]),
            [1_600_000_000_128_000_000, 1_600_000_000_228_000_000]
        );
        assert_eq!(Keys::of_words(&["0.0", "1.0", "2.0"]), None, "counted");
        assert_eq!(
            Keys::of_words(&["0.0", "0.1"]),
            Some(Keys::Times(vec![0, 100_000_000]))
        );
    }
}
