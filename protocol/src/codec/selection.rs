//! Selection of the cells of a feature map that are sent: budget, mask, gather and scatter.

use super::Dtype;
use crate::checks::{check_each, check_size};
use crate::{Result, WireError};

/// Checks that there is one finite confidence per cell.
///
/// # Errors
/// [`WireError`] states the first that is not finite, or both counts.
pub(super) fn check_confidence(confidence: &[f32], cells: usize) -> Result<()> {
    check_size("confidence map", confidence.len() as u64, cells as u64)?;
    let bounds = [f32::MIN, f32::MAX];
    check_each("confidence", confidence, bounds, f32::is_finite)
}

/// The cells with the highest confidence that fit into `budget` bytes, among `candidates` (`None`: all cells), in
/// row-major order.
///
/// # Errors
/// [`WireError::Budget`] when the budget cannot hold scales and mask.
pub(super) fn within_budget(
    confidence: &[f32],
    candidates: Option<&[u32]>,
    channels: u32,
    dtype: Dtype,
    budget: u64,
) -> Result<Vec<u32>> {
    let needed = dtype.scale_bytes(channels) + confidence.len().div_ceil(8) as u64;
    let for_cells = budget
        .checked_sub(needed)
        .ok_or(WireError::Budget { budget, needed })?;
    let fitting =
        usize::try_from(for_cells / (u64::from(channels) * dtype.size())).unwrap_or(usize::MAX);
    // A grid has at most 2^32 - 1 cells.
    let all = 0..u32::try_from(confidence.len()).unwrap_or(u32::MAX);
    let candidates = candidates.map_or_else(|| all.collect(), <[u32]>::to_vec);
    Ok(most_confident(confidence, candidates, fitting))
}

/// The `count` most confident cells, in row-major order; ties go to the first.
#[expect(
    clippy::indexing_slicing,
    reason = "cells are positions in the confidence map, whose length was checked"
)]
fn most_confident(confidence: &[f32], mut cells: Vec<u32>, count: usize) -> Vec<u32> {
    if count < cells.len() {
        // In linear time: the order among the selected cells does not matter.
        cells.select_nth_unstable_by(count, |a, b| {
            confidence[*b as usize]
                .total_cmp(&confidence[*a as usize])
                .then(a.cmp(b))
        });
        cells.truncate(count);
        // Back to row-major order, in which the mask and the values are written.
        cells.sort_unstable();
    }
    cells
}

/// `[C, K]` values of the selected cells out of `[C, H W]`.
#[expect(
    clippy::indexing_slicing,
    reason = "the sender's own cells are positions in its map"
)]
pub(super) fn gather(values: &[f32], cells: usize, selected: &[u32]) -> Vec<f32> {
    let mut gathered = Vec::with_capacity(values.len() / cells * selected.len());
    for channel in values.chunks_exact(cells) {
        gathered.extend(selected.iter().map(|cell| channel[*cell as usize]));
    }
    gathered
}

/// Appends the mask of the selected cells.
#[expect(
    clippy::indexing_slicing,
    reason = "the sender's own cells are positions in its map"
)]
pub(super) fn append_mask(bytes: &mut Vec<u8>, cells: usize, selected: &[u32]) {
    let begin = bytes.len();
    bytes.resize(begin + cells.div_ceil(8), 0);
    for cell in selected {
        bytes[begin + *cell as usize / 8] |= 1 << (cell % 8);
    }
}

/// The selected cells in row-major order.
///
/// # Errors
/// [`WireError::Shape`] when the number of cells in the mask differs from the announced one, or a cell is beyond the
/// last.
pub(super) fn read_mask(mask: &[u8], cells: usize, announced: usize) -> Result<Vec<u32>> {
    // Counted before the allocation, which then has the size of what is there.
    let found: u64 = mask.iter().map(|byte| u64::from(byte.count_ones())).sum();
    check_size("cells in the mask", found, announced as u64)?;
    let mut selected = Vec::with_capacity(announced);
    let bytes = mask.iter().zip((0u32..).step_by(8));
    for (byte, first) in bytes.filter(|(byte, _)| **byte != 0) {
        let bits = (0..8u32).filter(|bit| byte & (1 << bit) != 0);
        selected.extend(bits.map(|bit| first + bit));
    }
    match selected.last() {
        // The last byte of the mask may have bits beyond the grid.
        Some(last) if *last as usize >= cells => {
            let (expected, found) = (cells as u64 - 1, (*last).into());
            Err(WireError::shape("last cell in the mask", expected, found))
        }
        _ => Ok(selected),
    }
}

/// The feature map `[C, H, W]` with zeros for cells that were not sent, and the flags of the cells that were.
pub(super) fn scatter(
    values: &[f32],
    channels: usize,
    cells: usize,
    selected: &[u32],
) -> (Vec<f32>, Vec<bool>) {
    let mut map = vec![0f32; channels * cells];
    let mut sent = vec![false; cells];
    for cell in selected {
        if let Some(flag) = sent.get_mut(*cell as usize) {
            *flag = true;
        }
    }
    if !selected.is_empty() {
        let planes = map.chunks_exact_mut(cells);
        for (plane, values) in planes.zip(values.chunks_exact(selected.len())) {
            for (cell, value) in selected.iter().zip(values) {
                if let Some(target) = plane.get_mut(*cell as usize) {
                    *target = *value;
                }
            }
        }
    }
    (map, sent)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_most_confident_win_and_ties_go_to_the_first() {
        let confidence = [0.1, 0.9, 0.5, 0.5, 0.5, 0.0, -0.0];
        for (count, expected) in [
            (0, &[][..]),
            (1, &[1]),
            (3, &[1, 2, 3]),
            (7, &[0, 1, 2, 3, 4, 5, 6]),
        ] {
            let cells = most_confident(&confidence, (0..7).collect(), count);
            assert_eq!(cells, expected);
        }
        assert_eq!(most_confident(&confidence, vec![0, 3, 4], 2), [3, 4]);
    }

    #[test]
    fn the_budget_is_filled_and_kept() {
        let confidence: Vec<f32> = (0..100u8).map(f32::from).collect();
        // Scales 4 * 3, mask 13, then 3 bytes per cell.
        let selected = within_budget(&confidence, None, 3, Dtype::I8, 12 + 13 + 3 * 5 + 2).unwrap();
        assert_eq!(selected, [95, 96, 97, 98, 99]);
        let error = within_budget(&confidence, None, 3, Dtype::I8, 24).unwrap_err();
        assert_eq!(
            error,
            WireError::Budget {
                budget: 24,
                needed: 25
            }
        );
        assert!(check_confidence(&confidence, 100).is_ok());
        assert!(check_confidence(&confidence[1..], 100).is_err());
        assert!(check_confidence(&[f32::NAN; 100], 100).is_err());
    }

    #[test]
    fn a_mask_that_contradicts_the_metadata_is_refused() {
        let mut mask = Vec::new();
        append_mask(&mut mask, 12, &[0, 9, 11]);
        assert_eq!(mask, [0b0000_0001, 0b0000_1010]);
        assert_eq!(read_mask(&mask, 12, 3).unwrap(), [0, 9, 11]);
        assert!(matches!(
            read_mask(&mask, 12, 2),
            Err(WireError::Shape {
                expected: 2,
                found: 3,
                ..
            })
        ));
        assert!(matches!(
            read_mask(&mask, 11, 3),
            Err(WireError::Shape {
                expected: 10,
                found: 11,
                ..
            })
        ));
    }

    #[test]
    fn scatter_undoes_gather() {
        let values: Vec<f32> = (1..=8u8).map(f32::from).collect();
        let gathered = gather(&values, 4, &[1, 3]);
        assert_eq!(gathered, [2.0, 4.0, 6.0, 8.0]);
        let (map, sent) = scatter(&gathered, 2, 4, &[1, 3]);
        assert_eq!(map, [0.0, 2.0, 0.0, 4.0, 0.0, 6.0, 0.0, 8.0]);
        assert_eq!(sent, [false, true, false, true]);
        assert_eq!(scatter(&[], 2, 4, &[]), (vec![0.0; 8], vec![false; 4]));
    }
}
