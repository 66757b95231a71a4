//! Sweeps of little-endian `f32`, point after point: `x y z intensity`, or a fifth number after these.
//!
//! Such a file does not record the number of floats per point. The first sweeps of an agent determine it: with the
//! right number, neighbouring points resemble each other, and the fifth number mostly is a laser index.

use super::plausibility::TINY;
use crate::pcd::{IntensityKind, IntensityOrigin, PcdCloud};

/// Least number of points of a sample.
const LEAST_POINTS: usize = 8;
/// Largest number of floats of a sample that are used.
const MOST_NUMBERS: usize = 200_000;
/// Largest share of implausible numbers.
const ABSURD_SHARE: f64 = 0.05;
/// Largest plausible coordinate or intensity.
const LARGEST: f32 = 1e7;
/// Least share of whole numbers from 0 to 255 in a column of laser indices.
const LASER_SHARE: f64 = 0.99;
/// Unsupported numbers of floats per point that are detected.
const OTHER_NUMBERS: [usize; 3] = [3, 6, 7];
/// Factor by which these must reduce the difference of neighbours.
const MUCH_LESS: f64 = 0.5;

/// Numbers per point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum FloatForm {
    /// x, y, z, intensity.
    Four,
    /// x, y, z, intensity, and the laser index or another value.
    Five,
}

impl FloatForm {
    /// Numbers per point.
    pub(super) fn numbers(self) -> usize {
        match self {
            Self::Four => 4,
            Self::Five => 5,
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Four => "4 floats per point: x y z intensity",
            Self::Five => "5 floats per point: x y z intensity ring",
        }
    }

    /// Majority vote of the samples; four if none decides.
    pub(super) fn of(samples: &[Vec<u8>]) -> Result<Self, String> {
        let votes: Vec<Result<Self, String>> = samples
            .iter()
            .filter_map(|bytes| Self::of_sample(bytes))
            .collect();
        let count = |form| votes.iter().filter(|vote| **vote == Ok(form)).count();
        match (count(Self::Four), count(Self::Five)) {
            (0, 0) => votes.into_iter().next().unwrap_or(Ok(Self::Four)),
            (four, five) if five > four => Ok(Self::Five),
            _ => Ok(Self::Four),
        }
    }

    /// `None` if the sample is empty or truncated, and decides nothing.
    fn of_sample(bytes: &[u8]) -> Option<Result<Self, String>> {
        let (numbers, rest) = bytes.as_chunks::<4>();
        let fits = |form: &Self| rest.is_empty() && numbers.len().is_multiple_of(form.numbers());
        let forms: Vec<Self> = [Self::Four, Self::Five].into_iter().filter(fits).collect();
        let &first = forms.first().filter(|_| !numbers.is_empty())?;
        let all = numbers.len();
        let numbers: Vec<f32> = numbers
            .iter()
            .take(MOST_NUMBERS)
            .map(|&bytes| f32::from_le_bytes(bytes))
            .collect();
        if numbers.len() < LEAST_POINTS * 4 {
            return Some(Ok(first));
        }
        if let Some(fault) = absurd(&numbers) {
            return Some(Err(format!(
                "no sweep of x y z intensity or x y z intensity ring as f32: {fault}"
            )));
        }
        if forms.contains(&Self::Five) && has_lasers(&numbers) {
            return Some(Ok(Self::Five));
        }
        let unlikeness_of = |form: &Self| unlikeness(&numbers, form.numbers());
        let form = forms
            .into_iter()
            .min_by(|a, b| unlikeness_of(a).total_cmp(&unlikeness_of(b)))
            .unwrap_or(first);
        let is_better = |step: &usize| {
            all.is_multiple_of(*step)
                && unlikeness(&numbers, *step) < MUCH_LESS * unlikeness_of(&form)
        };
        Some(match OTHER_NUMBERS.into_iter().find(is_better) {
            Some(step) => Err(format!(
                "it looks like {step} floats per point, expected 4 (x y z intensity) or 5 (and the laser's number)"
            )),
            None => Ok(form),
        })
    }

    /// Extracts the points of a file of whole points.
    pub(super) fn points(self, bytes: &[u8]) -> PcdCloud {
        let (numbers, _) = bytes.as_chunks::<4>();
        let points = numbers.chunks_exact(self.numbers());
        let points = points
            .filter_map(|point| Some(point.first_chunk()?.map(f32::from_le_bytes)))
            .collect();
        let intensity = Some(IntensityOrigin::stored("4th float", IntensityKind::Number));
        PcdCloud {
            intensity,
            form: self.name(),
            ..PcdCloud::of_finite(points, Vec::new())
        }
    }
}

/// Description of implausible numbers, if there are more than a few.
fn absurd(numbers: &[f32]) -> Option<String> {
    let is_absurd = |number: f32| number.abs() > LARGEST || (number != 0.0 && number.abs() < TINY);
    let share =
        numbers.iter().filter(|&&number| is_absurd(number)).count() as f64 / numbers.len() as f64;
    let fault = || {
        format!(
            "{:.1} % of the numbers are beyond 1e7 or below 1e-30, usual is none",
            100.0 * share
        )
    };
    (share > ABSURD_SHARE).then(fault)
}

/// True if every fifth number is a laser index, and not all numbers could be.
fn has_lasers(numbers: &[f32]) -> bool {
    let is_laser = |number: f32| (0.0..=255.0).contains(&number) && number.fract() == 0.0;
    let lasers = numbers
        .as_chunks()
        .0
        .iter()
        .filter(|[.., laser]: &&[f32; 5]| is_laser(*laser))
        .count();
    lasers as f64 >= LASER_SHARE * (numbers.len() / 5) as f64
        && numbers.iter().any(|number| number.fract() != 0.0)
}

/// Mean difference of each number from the one `step` later. Logarithms, so that no column dominates the others.
fn unlikeness(numbers: &[f32], step: usize) -> f64 {
    let log = |number: f32| f64::from(number.abs().ln_1p().copysign(number));
    let pairs = numbers.iter().zip(numbers.get(step..).unwrap_or_default());
    let sum: f64 = pairs
        .map(|(&a, &b)| (log(a) - log(b)).abs())
        .filter(|difference| difference.is_finite())
        .sum();
    sum / (numbers.len() - step) as f64
}
