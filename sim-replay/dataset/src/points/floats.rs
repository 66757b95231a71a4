//! Sweeps of little-endian `f32`, point after point: `x y z intensity`, or a fifth number after these.
//!
//! Such a file does not record the number of floats per point. Its columns do, in any order of the points: with the
//! right number each column holds one quantity, with a wrong one it mixes several, and its entropy is larger.

use super::plausibility::TINY;
use crate::pcd::{IntensityKind, IntensityOrigin, PcdCloud};

/// Least number of floats of a sample.
const LEAST_NUMBERS: usize = 100;
/// Largest number of floats of a sample that are used.
const MOST_NUMBERS: usize = 20_000;
/// Largest share of implausible numbers.
const ABSURD_SHARE: f64 = 0.05;
/// Largest plausible coordinate or intensity.
const LARGEST: f32 = 1e7;
/// Unsupported numbers of floats per point that are detected.
const OTHER_NUMBERS: [usize; 8] = [3, 6, 7, 8, 9, 10, 12, 16];
/// Least number of points of a sample with one of them.
const LEAST_OTHER_POINTS: usize = 20;
/// Entropy per column, nats, by which the right number of floats per point is below a wrong one. Lasers that fire in
/// turn make up to 0.22 between a number and its multiples; a wrong number makes 0.4 to 1.3.
const MUCH_LESS: f64 = 0.3;
/// Entropies that differ by less are equal: the smallest number of floats per point is the right one.
const EQUAL: f64 = 0.15;

/// Numbers per point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum FloatForm {
    /// x, y, z, intensity.
    Four = 4,
    /// x, y, z, intensity, and the laser index or another value.
    Five = 5,
}

impl FloatForm {
    /// Numbers per point.
    pub(super) fn numbers(self) -> usize {
        self as usize
    }

    fn name(self) -> &'static str {
        match self {
            Self::Four => "4 floats per point: x y z intensity",
            Self::Five => "5 floats per point: x y z intensity ring",
        }
    }

    /// Majority vote of the samples; without one, the form whose points fill the first sample, or four.
    ///
    /// # Errors
    /// If no sample has either form, with the fault of the first.
    pub(super) fn of(samples: &[Vec<u8>]) -> Result<Self, String> {
        let votes = samples.iter().filter_map(|bytes| Self::of_sample(bytes));
        let votes: Vec<Result<Self, String>> = votes.collect();
        let counts = [Self::Four, Self::Five]
            .map(|form| votes.iter().filter(|vote| **vote == Ok(form)).count());
        match counts {
            [0, 0] => votes.into_iter().next().unwrap_or_else(|| {
                let fitting = [Self::Four, Self::Five].into_iter().find(|form| {
                    (samples.first())
                        .is_some_and(|bytes| bytes.len().is_multiple_of(4 * form.numbers()))
                });
                Ok(fitting.unwrap_or(Self::Four))
            }),
            [four, five] if five > four => Ok(Self::Five),
            _ => Ok(Self::Four),
        }
    }

    /// The form of one sweep by its content; `None` if it has too few numbers to tell.
    fn of_sample(bytes: &[u8]) -> Option<Result<Self, String>> {
        let numbers: Vec<f32> = (bytes.as_chunks::<4>().0.iter())
            .take(MOST_NUMBERS)
            .map(|&bytes| f32::from_le_bytes(bytes))
            .collect();
        if numbers.len() < LEAST_NUMBERS {
            return None;
        }
        if let Some(fault) = absurd(&numbers) {
            return Some(Err(format!(
                "no sweep of x y z intensity or x y z intensity ring as f32: {fault}"
            )));
        }
        let [four, five] =
            [Self::Four, Self::Five].map(|form| column_entropy(&numbers, form.numbers()));
        let (form, entropy) = match five < four {
            true => (Self::Five, five),
            false => (Self::Four, four),
        };
        let others: Vec<(usize, f64)> = OTHER_NUMBERS
            .into_iter()
            // With few points the entropy of a wide form is small by chance.
            .filter(|step| numbers.len() >= LEAST_OTHER_POINTS * step)
            .map(|step| (step, column_entropy(&numbers, step)))
            .collect();
        // Multiples of the right number are as good as it: the first within `EQUAL` of the best is right.
        let least = others
            .iter()
            .fold(entropy - MUCH_LESS, |least, other| least.min(other.1));
        let mut right = (others.iter())
            .filter(|(_, other)| *other < entropy - MUCH_LESS && *other <= least + EQUAL);
        Some(match right.next() {
            Some((step, _)) => Err(format!(
                "it looks like {step} floats per point, expected 4 (x y z intensity) or 5 (and the laser's number)"
            )),
            None => Ok(form),
        })
    }

    /// Extracts the points of a file of this form.
    ///
    /// # Errors
    /// If the content has another form, or the file ends within a point.
    pub(super) fn decode(self, bytes: &[u8]) -> Result<PcdCloud, String> {
        // Each file is checked against its content: one of another form would give scattered points.
        let own = Self::of_sample(bytes).transpose()?;
        if let Some(own) = own.filter(|own| *own != self) {
            return Err(format!(
                "it looks like {} floats per point, the first sweeps of this agent have {}",
                own.numbers(),
                self.numbers()
            ));
        }
        super::check_whole_points(bytes.len(), 4 * self.numbers())?;
        let points = (bytes.as_chunks::<4>().0)
            .chunks_exact(self.numbers())
            .filter_map(|point| Some(point.first_chunk()?.map(f32::from_le_bytes)))
            .collect();
        let origin = IntensityOrigin::stored("4th float", IntensityKind::Number);
        Ok(PcdCloud::of_points(points, Some(origin), self.name()))
    }
}

/// Description of implausible numbers, if there are more than a few.
fn absurd(numbers: &[f32]) -> Option<String> {
    let absurd = numbers
        .iter()
        .filter(|&&number| number.abs() > LARGEST || (number != 0.0 && number.abs() < TINY));
    let share = absurd.count() as f64 / numbers.len() as f64;
    let percent = 100.0 * share;
    (share > ABSURD_SHARE).then(|| {
        format!("{percent:.1} % of the numbers are beyond 1e7 or below 1e-30, usual is none")
    })
}

/// Mean entropy of the columns of points of `step` numbers, nats, by sign and octave of each number. Corrected for the
/// size of the sample (Miller and Madow).
fn column_entropy(numbers: &[f32], step: usize) -> f64 {
    let points = (numbers.len() / step) as f64;
    let entropies = (0..step).map(|column| {
        // Sign and exponent of a float are its upper 9 bits.
        let mut counts = [0_u32; 1 << 9];
        for number in numbers
            .chunks_exact(step)
            .filter_map(|point| point.get(column))
        {
            let bin = (number.to_bits() >> 23) as usize;
            if let Some(count) = counts.get_mut(bin) {
                *count += 1;
            }
        }
        let shares = counts.into_iter().filter(|&count| count > 0);
        let shares: Vec<f64> = shares.map(|count| f64::from(count) / points).collect();
        let entropy: f64 = shares.iter().map(|share| -share * share.ln()).sum();
        // The correction is (occupied bins - 1) / 2n: a small sample underestimates the entropy.
        entropy + (shares.len() - 1) as f64 / (2.0 * points)
    });
    entropies.sum::<f64>() / step as f64
}
