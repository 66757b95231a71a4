//! Confidence gate: selects the cells around which a vehicle is likely (Where2comm, Hu et al., NeurIPS 2022).

use std::fmt::Display;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::checks::check_within;
#[cfg(feature = "config")]
use crate::config::FieldError;
use crate::{BevGrid, WireError};

/// Widest kernel of the smoothing, cells.
const MAX_KERNEL: u32 = 63;

/// Sends the cells whose smoothed confidence is above a threshold.
///
/// The sender decides without other agents, before anything is transmitted: a sender that detects nothing sends
/// nothing.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[cfg_attr(feature = "config", derive(schemars::JsonSchema))]
pub struct ConfidenceGate {
    /// Smoothed confidence that a cell must exceed. Below zero every cell passes.
    pub threshold: f32,
    /// Smoothing of the confidence before the threshold; absent or `null`: no smoothing.
    pub smoothing: Option<Smoothing>,
}

/// A Gaussian window over the BEV grid, zeros outside of it.
///
/// As in the published code its weights are `exp(-(x^2 + y^2) / (2 sigma^2)) / (2 pi sigma)`: their sum is about
/// `sigma`, not one, so a threshold is valid for one sigma only.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[cfg_attr(feature = "config", derive(schemars::JsonSchema))]
pub struct Smoothing {
    /// Edge of the window, cells; odd.
    pub kernel: u32,
    /// Standard deviation, cells.
    pub sigma: f32,
}

impl Default for ConfidenceGate {
    /// The published threshold and smoothing: 0.01 after 5 x 5 cells with a sigma of one.
    fn default() -> Self {
        Self {
            threshold: 0.01,
            smoothing: Some(Smoothing {
                kernel: 5,
                sigma: 1.0,
            }),
        }
    }
}

impl FromStr for ConfidenceGate {
    type Err = String;

    /// `THRESHOLD`, with the published smoothing; `THRESHOLD,CELLS,SIGMA`; or `THRESHOLD,none`.
    fn from_str(text: &str) -> Result<Self, String> {
        let (threshold, smoothing) = text
            .split_once(',')
            .map_or((text, None), |(first, rest)| (first, Some(rest)));
        let threshold = number("threshold", threshold)?;
        let smoothing = match smoothing {
            None => Self::default().smoothing,
            Some("none") => None,
            Some(window) => {
                let (kernel, sigma) = window
                    .split_once(',')
                    .ok_or_else(|| format!("{window:?} is not CELLS,SIGMA or none"))?;
                let (kernel, sigma) = (number("window", kernel)?, number("sigma", sigma)?);
                Some(Smoothing { kernel, sigma })
            }
        };
        Ok(Self {
            threshold,
            smoothing,
        })
    }
}

fn number<T: FromStr<Err: Display>>(name: &str, text: &str) -> Result<T, String> {
    let number: Result<T, _> = text.trim().parse();
    number.map_err(|error| format!("{name} {text:?}: {error}"))
}

impl ConfidenceGate {
    /// Checks that a confidence can pass: a window smooths a confidence of 1 everywhere to the sum of its weights.
    ///
    /// # Errors
    /// [`FieldError`] for a threshold that no cell exceeds, and for a window that cannot be used.
    #[cfg(feature = "config")]
    pub fn validate(&self) -> Result<(), FieldError> {
        let weights = match self.smoothing {
            Some(smoothing) => smoothing.weights().map_err(|error| {
                let window = format!("{},{}", smoothing.kernel, smoothing.sigma);
                FieldError::new("codec.gate.smoothing", window, error.to_string())
            })?,
            None => vec![1.0],
        };
        // The sum over the square window is the square of the sum over one dimension.
        let highest = weights.iter().sum::<f32>().powi(2);
        if self.threshold < highest {
            return Ok(());
        }
        let rule =
            format!("must be below {highest:.3}, the highest confidence, for any cell to be sent");
        let field = "codec.gate.threshold";
        Err(FieldError::new(field, self.threshold, rule))
    }

    /// The cells that pass, in row-major order; `confidence` is `[H, W]` on `grid`, one finite value per cell.
    ///
    /// # Errors
    /// [`WireError::Value`] when the window has an even width, is too wide, or its sigma is not positive.
    pub(super) fn cells(&self, confidence: &[f32], grid: &BevGrid) -> Result<Vec<u32>, WireError> {
        let smoothed = self.smoothing.map(|window| window.smooth(confidence, grid));
        let smoothed = smoothed.transpose()?;
        let values = smoothed.as_deref().unwrap_or(confidence);
        let passing = (0u32..)
            .zip(values)
            .filter(|(_, value)| **value > self.threshold);
        Ok(passing.map(|(cell, _)| cell).collect())
    }
}

impl Smoothing {
    #[expect(
        clippy::indexing_slicing,
        reason = "the window of a row is cut at the first and the last row"
    )]
    fn smooth(&self, values: &[f32], grid: &BevGrid) -> Result<Vec<f32>, WireError> {
        let weights = self.weights()?;
        let width = grid.width as usize;
        // Step 1 of the separable window: along rows.
        let mut along_rows = vec![0f32; values.len()];
        let rows = values.chunks_exact(width);
        for (row, smoothed) in rows.zip(along_rows.chunks_exact_mut(width)) {
            convolve(row, &weights, smoothed);
        }
        // Step 2: along columns, a row at a time, so that memory is read in order.
        let mut smoothed = vec![0f32; values.len()];
        let half = weights.len() / 2;
        let height = values.len() / width;
        for (row, target) in smoothed.chunks_exact_mut(width).enumerate() {
            let first = row.saturating_sub(half);
            for source in first..(row + half + 1).min(height) {
                let weight = weights[source + half - row];
                let values = &along_rows[source * width..][..width];
                for (target, value) in target.iter_mut().zip(values) {
                    *target += weight * value;
                }
            }
        }
        Ok(smoothed)
    }

    /// One dimension of the separable window.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "weights are rounded to f32"
    )]
    fn weights(&self) -> Result<Vec<f32>, WireError> {
        let Self { kernel, sigma } = *self;
        if kernel % 2 == 0 || kernel > MAX_KERNEL {
            return Err(WireError::Value {
                what: "odd kernel of the confidence gate",
                index: 0,
                value: f64::from(kernel),
                min: 1e-3,
                max: f64::from(MAX_KERNEL),
            });
        }
        let (half, sigma) = (f64::from(kernel / 2), f64::from(sigma));
        check_within("sigma of the confidence gate", sigma, 1e-3, 1e3)?;
        // Its square is the published factor 1 / (2 pi sigma).
        let scale = 1.0 / (std::f64::consts::TAU * sigma).sqrt();
        let weights = (0..kernel)
            .map(|cell| scale * (-(f64::from(cell) - half).powi(2) / (2.0 * sigma * sigma)).exp());
        Ok(weights.map(|weight| weight as f32).collect())
    }
}

/// Convolution of `values` with `weights`, zeros outside.
#[expect(
    clippy::indexing_slicing,
    reason = "the window of a cell is cut at both ends of the row"
)]
fn convolve(values: &[f32], weights: &[f32], smoothed: &mut [f32]) {
    let half = weights.len() / 2;
    for (cell, smoothed) in smoothed.iter_mut().enumerate() {
        let first = cell.saturating_sub(half);
        let window = &values[first..(cell + half + 1).min(values.len())];
        *smoothed = window
            .iter()
            .zip(&weights[first + half - cell..])
            .map(|(value, weight)| value * weight)
            .sum();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GRID: BevGrid = BevGrid {
        x_min_m: 0.0,
        y_min_m: 0.0,
        cell_m: 1.0,
        width: 6,
        height: 5,
    };

    #[test]
    fn smoothing_is_the_convolution_by_definition() {
        let values: Vec<f32> = (0..30u8)
            .map(|cell| f32::from(cell * 37 % 30) / 30.0)
            .collect();
        let smoothing = Smoothing {
            kernel: 5,
            sigma: 1.3,
        };
        let smoothed = smoothing.smooth(&values, &GRID).unwrap();
        for (row, column) in (0..5i32).flat_map(|row| (0..6i32).map(move |column| (row, column))) {
            let mut expected = 0.0;
            for (dy, dx) in (-2..=2).flat_map(|dy| (-2..=2).map(move |dx| (dy, dx))) {
                if (0..5).contains(&(row + dy)) && (0..6).contains(&(column + dx)) {
                    let weight = (-f64::from(dx * dx + dy * dy) / (2.0 * 1.69)).exp()
                        / (std::f64::consts::TAU * 1.3);
                    expected += weight * f64::from(values[((row + dy) * 6 + column + dx) as usize]);
                }
            }
            let found = f64::from(smoothed[(row * 6 + column) as usize]);
            assert!(
                (found - expected).abs() < 1e-6,
                "{row} {column}: {found} {expected}"
            );
        }
    }

    #[test]
    fn a_confident_cell_selects_its_surroundings() {
        let mut confidence = [0f32; 30];
        confidence[14] = 0.9;
        let unsmoothed = ConfidenceGate {
            threshold: 0.01,
            smoothing: None,
        };
        assert_eq!(unsmoothed.cells(&confidence, &GRID).unwrap(), [14]);
        let published = ConfidenceGate::default().cells(&confidence, &GRID).unwrap();
        assert!(
            published.contains(&13) && published.contains(&8) && published.len() > 9,
            "{published:?}"
        );
        let nothing = ConfidenceGate {
            threshold: 1.0,
            ..unsmoothed
        };
        assert!(nothing.cells(&confidence, &GRID).unwrap().is_empty());
        let everything = ConfidenceGate {
            threshold: -1.0,
            ..unsmoothed
        };
        assert_eq!(everything.cells(&confidence, &GRID).unwrap().len(), 30);
    }

    #[test]
    fn a_gate_is_read_from_a_threshold_and_a_window() {
        assert_eq!("0.01".parse(), Ok(ConfidenceGate::default()));
        assert_eq!(
            "0.1,none".parse(),
            Ok(ConfidenceGate {
                threshold: 0.1,
                smoothing: None
            })
        );
        let everywhere: ConfidenceGate = "-1,3,0.5".parse().unwrap();
        assert_eq!(
            everywhere.smoothing,
            Some(Smoothing {
                kernel: 3,
                sigma: 0.5
            })
        );
        for (text, part) in [
            ("much", "threshold \"much\""),
            ("0.1,3", "\"3\""),
            ("0.1,x,1", "window \"x\""),
        ] {
            let message = text.parse::<ConfidenceGate>().unwrap_err();
            assert!(message.contains(part), "{text}: {message}");
        }
    }

    #[test]
    fn even_windows_are_refused() {
        for smoothing in [(4, 1.0), (0, 1.0), (65, 1.0), (5, 0.0), (5, f32::NAN)] {
            let smoothing = Smoothing {
                kernel: smoothing.0,
                sigma: smoothing.1,
            };
            let gate = ConfidenceGate {
                threshold: 0.1,
                smoothing: Some(smoothing),
            };
            assert!(
                matches!(gate.cells(&[0.0; 30], &GRID), Err(WireError::Value { .. })),
                "{smoothing:?}"
            );
        }
    }
}
