//! Held-out sweeps of drives: contiguous pieces, evenly over every drive.
//!
//! Neighbouring sweeps are nearly the same, so that single held-out sweeps between training sweeps would measure memory.
//! A piece is short enough that both its ends have been driven.

use nalgebra::Vector3;

/// Share of the sweeps that are held out.
const SHARE: f64 = 0.12;
/// Largest length of a piece, metres.
const PIECE_M: f64 = 20.0;
/// Most sweeps of a piece.
const PIECE_SWEEPS: usize = 20;
/// Fewest sweeps of which some are held out.
const LEAST_SWEEPS: usize = 4;

/// For each sweep of a drive, whether it is held out. `positions_m`: of the sensor, in the order of time, metres.
pub(super) fn held_out(positions_m: &[Vector3<f64>]) -> Vec<bool> {
    let count = positions_m.len();
    let mut is_held_out = vec![false; count];
    if count < LEAST_SWEEPS {
        return is_held_out;
    }
    // One at least: a share of few sweeps rounds to none.
    let wanted = ((count as f64 * SHARE).round() as usize).max(1);
    // Sweeps of a piece, from the median distance of neighbours.
    let pairs = positions_m.windows(2);
    let steps: Vec<f64> = pairs.map(|pair| (pair[1] - pair[0]).norm()).collect();
    let step_m = support::statistics::median(&steps).unwrap_or(PIECE_M);
    // A vehicle that stands has steps of 0, by which the length would be divided.
    let piece = (PIECE_M / step_m.max(1e-3)) as usize + 1;
    let piece = piece.min(PIECE_SWEEPS).min(wanted);
    let pieces = wanted.div_ceil(piece);
    for number in 0..pieces {
        // Pieces lie around the middles of equal parts, so both ends of a drive are trained on.
        let middle = (2 * number + 1) * count / (2 * pieces);
        let first = middle.saturating_sub(piece / 2);
        let end = (first + piece).min(count);
        is_held_out[first..end].fill(true);
    }
    is_held_out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drive(count: usize, step_m: f64) -> Vec<Vector3<f64>> {
        (0..count)
            .map(|k| Vector3::new(k as f64 * step_m, 0.0, 0.0))
            .collect()
    }

    /// Lengths of the held-out pieces.
    fn pieces(is_held_out: &[bool]) -> Vec<usize> {
        let runs = is_held_out.chunk_by(|a, b| a == b);
        runs.filter(|run| run[0]).map(<[bool]>::len).collect()
    }

    #[test]
    fn pieces_are_contiguous_short_and_a_small_share() {
        for (count, step_m, most) in [(600, 1.0, 20), (600, 8.0, 3), (50, 2.0, 6), (300, 0.0, 20)] {
            let pieces = pieces(&held_out(&drive(count, step_m)));
            let all: usize = pieces.iter().sum();
            assert!(pieces.iter().all(|&piece| piece <= most), "{pieces:?}");
            assert!(
                (0.08..0.2).contains(&(all as f64 / count as f64)),
                "{count} at {step_m} m: {pieces:?}"
            );
        }
    }

    #[test]
    fn few_sweeps_give_one_and_very_few_none() {
        assert_eq!(held_out(&drive(4, 1.0)), [false, false, true, false]);
        assert_eq!(held_out(&drive(3, 1.0)), [false; 3]);
        assert!(held_out(&[]).is_empty());
    }
}
