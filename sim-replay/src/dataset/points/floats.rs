//! Sweeps of little-endian `f32`, point after point: `x y z intensity`, or a fifth number behind these.
//!
//! Nothing in such a file tells how many numbers a point has. The first sweeps of an agent do: read by the right number,
//! neighbouring points resemble each other, no intensity is negative, and the fifth number mostly is a laser's.

use super::plausibility::TINY;
use crate::pcd::{IntensityKind, IntensityOrigin, PcdCloud};

/// Fewer points than this tell nothing.
const LEAST_POINTS: usize = 8;
/// Numbers of a sample that are looked at.
const MOST_NUMBERS: usize = 200_000;
/// Largest share of points with a number that no sensor writes.
const IMPOSSIBLE_SHARE: f64 = 0.05;
/// Number beyond which nothing is a coordinate or an intensity.
const LARGEST: f32 = 1e7;
/// Least share of whole numbers from 0 to 255 in a column of lasers.
const LASER_SHARE: f64 = 0.99;

/// Numbers per point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum FloatForm {
    /// x, y, z, intensity.
    Four,
    /// x, y, z, intensity, and the laser's number or whatever else.
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

    /// Decides by samples, of which each has a vote. Without any that tells it: four.
    pub(super) fn of(samples: &[Vec<u8>]) -> Result<Self, String> {
        let votes: Vec<Result<Self, String>> = samples.iter().filter_map(|bytes| Self::of_sample(bytes)).collect();
        let count = |form| votes.iter().filter(|vote| **vote == Ok(form)).count();
        match (count(Self::Four), count(Self::Five)) {
            (0, 0) => votes.into_iter().next().unwrap_or(Ok(Self::Four)),
            (four, five) if five > four => Ok(Self::Five),
            _ => Ok(Self::Four),
        }
    }

    /// `None` where the sample is empty or cut off, and says nothing.
    fn of_sample(bytes: &[u8]) -> Option<Result<Self, String>> {
        let fits = |form: &Self| bytes.len().is_multiple_of(4 * form.numbers());
        let mut forms: Vec<Self> = [Self::Four, Self::Five].into_iter().filter(fits).collect();
        if bytes.is_empty() || forms.is_empty() {
            return None;
        }
        let (numbers, _) = bytes.as_chunks::<4>();
        let numbers: Vec<f32> = numbers.iter().take(MOST_NUMBERS).map(|&bytes| f32::from_le_bytes(bytes)).collect();
        if numbers.len() < LEAST_POINTS * 4 {
            return Some(Ok(forms[0]));
        }
        if let [Self::Four, Self::Five] = forms[..]
            && Self::Five.is_likelier(&numbers)
        {
            forms.reverse();
        }
        let found = forms.iter().find(|form| form.fault(&numbers).is_none());
        let fault =
            |form: &Self| format!("{} floats per point: {}", form.numbers(), form.fault(&numbers).unwrap_or_default());
        Some(found.copied().ok_or_else(|| {
            let faults: Vec<String> = forms.iter().map(fault).collect();
            format!("no sweep of x y z intensity or x y z intensity ring as f32: with {}", faults.join("; with "))
        }))
    }

    /// Whether five numbers explain a sample of which both are possible better than four.
    fn is_likelier(self, numbers: &[f32]) -> bool {
        let is_laser = |number: f32| (0.0..=255.0).contains(&number) && number.fract() == 0.0;
        let fifth = || numbers.chunks_exact(5).map(|point| point[4]);
        let lasers = fifth().filter(|&number| is_laser(number)).count() as f64 / (numbers.len() / 5) as f64;
        let all_whole = numbers.iter().all(|number| number.fract() == 0.0);
        if lasers >= LASER_SHARE && !all_whole {
            return true;
        }
        unlikeness(numbers, 5) < unlikeness(numbers, 4)
    }

    /// What no sensor writes, if it is in more than a few points.
    fn fault(self, numbers: &[f32]) -> Option<String> {
        let points = numbers.chunks_exact(self.numbers());
        let all = points.len().max(1) as f64;
        let impossible = |number: f32| number.abs() > LARGEST || (number != 0.0 && number.abs() < TINY);
        let count = |is_wrong: &dyn Fn(&[f32]) -> bool| points.clone().filter(|point| is_wrong(point)).count() as f64;
        let absurd = count(&|point| point.iter().any(|&number| impossible(number))) / all;
        let negative = count(&|point| point[3] < 0.0) / all;
        let percent = |share: f64| format!("{:.1} %", 100.0 * share);
        if absurd > IMPOSSIBLE_SHARE {
            return Some(format!(
                "{} of the points have a number beyond 1e7 or below 1e-30, usual is none",
                percent(absurd)
            ));
        }
        let fault = || format!("{} of the intensities are negative, usual is none", percent(negative));
        (negative > IMPOSSIBLE_SHARE).then(fault)
    }

    /// Takes the points out of a file of whole points.
    pub(super) fn points(self, bytes: &[u8]) -> PcdCloud {
        let (numbers, _) = bytes.as_chunks::<4>();
        let points = numbers.chunks_exact(self.numbers());
        let points = points.map(|point| [0, 1, 2, 3].map(|index| f32::from_le_bytes(point[index]))).collect();
        let intensity = Some(IntensityOrigin::stored("4th float", IntensityKind::Number));
        PcdCloud { intensity, form: self.name(), ..PcdCloud::of_finite(points, Vec::new()) }
    }
}

/// How little each number resembles the one `step` later. Logarithms, so that no column outweighs the others.
fn unlikeness(numbers: &[f32], step: usize) -> f64 {
    let log = |number: f32| f64::from(number.abs().ln_1p().copysign(number));
    let pairs = numbers.iter().zip(&numbers[step..]);
    let sum: f64 = pairs.map(|(&a, &b)| (log(a) - log(b)).abs()).filter(|difference| difference.is_finite()).sum();
    sum / (numbers.len() - step) as f64
}
