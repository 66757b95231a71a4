//! Choice of cells: those of a sweep that enter a network, evenly over the sweep.

use support::sampling::evenly_spread;

use super::voxelise::SweepCell;

/// Largest share of the chosen cells that may be flat ground, which looks the same everywhere.
const FLAT_SHARE: f64 = 0.25;

/// Up to `count` cells, evenly over the sweep, flat ground no more than its share.
pub(crate) fn choose_evenly(cells: &[SweepCell], count: usize) -> Vec<usize> {
    let (flat, high): (Vec<usize>, Vec<usize>) =
        (0..cells.len()).partition(|&cell| cells[cell].is_flat());
    let mut chosen = evenly_spread(&high, (count as f64 * (1.0 - FLAT_SHARE)) as usize);
    // A share of the chosen cells: a sweep with little but ground must not be localized by its ground.
    let flat_count = chosen.len() as f64 * FLAT_SHARE / (1.0 - FLAT_SHARE);
    chosen.extend(evenly_spread(&flat, flat_count as usize));
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cells(high: usize, flat: usize) -> Vec<SweepCell> {
        let cells = [(2.0, high), (0.1, flat)].map(|(extent_m, count)| {
            let cell = SweepCell {
                extent_m,
                ..SweepCell::default()
            };
            vec![cell; count]
        });
        cells.concat()
    }

    #[test]
    fn ground_is_never_more_than_its_share() {
        for (high, flat, expected) in [
            (1000, 1000, 256),
            (60, 1000, 80),
            (1000, 10, 202),
            (0, 500, 0),
        ] {
            let cells = cells(high, flat);
            let chosen = choose_evenly(&cells, 256);
            let ground = chosen.iter().filter(|&&cell| cells[cell].is_flat()).count();
            assert_eq!(chosen.len(), expected);
            assert!(
                ground as f64 <= FLAT_SHARE * chosen.len() as f64,
                "{ground} of {expected}"
            );
        }
    }
}
