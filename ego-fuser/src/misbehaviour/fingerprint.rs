//! Fingerprint: enough values of a message to recognise a copy, and to compare it with the next one of its sender.

/// Values of a whole map that are compared, spread over it.
const VALUES: usize = 4096;
/// Values of each cell that are compared where not all cells were sent; their channels differ from cell to cell.
const VALUES_OF_CELL: usize = 4;
/// Fewest cells with which maps are compared where not all were sent. On scenes of seeds 1000, 1001 and 1003 maps of one
/// vehicle 0.2 s apart have a similarity of 0.88 or more in so many common cells, as whole ones have; in 100 down to 0.86.
const ENOUGH_CELLS: usize = 200;
/// Fewest values of whole messages that are compared: two vehicles that detect a single box may well agree.
const ENOUGH_VALUES: usize = 9;
/// Whole messages with a higher similarity are the same one. Two vehicles reach 0.92 at most.
const COPY: f64 = 0.98;
/// The same where not all cells were sent. Two vehicles reach 0.97 in their common cells, in which most have a vehicle; a
/// copy has 0.999 even in another number format.
const COPY_OF_CELLS: f64 = 0.995;
/// Successive selections with fewer common cells than this multiple of what chance gives are unrelated. On those scenes
/// the sender moves by up to 1.3 m between two maps, and honest selections share at least 4 times as many cells as by chance.
const CHANCE: f64 = 2.0;
/// They have less than this share in common, too: chance is no measure for selections of most cells.
const SHARED: f64 = 0.15;

/// Values of a message; where it is a map, differences to the map of an empty world.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Fingerprint {
    /// Values that are spread over the whole message.
    spread: Vec<f32>,
    /// Of a map, values of each cell; `None` for cells that were not sent.
    cells: Vec<Option<[f32; VALUES_OF_CELL]>>,
    /// True for a map of which not all cells were sent.
    is_partial: bool,
}

impl Fingerprint {
    /// Of a message without cells.
    pub(super) fn of_values(spread: Vec<f32>) -> Self {
        Self {
            spread,
            ..Self::default()
        }
    }

    /// Of a map `[C, H, W]` with this number of `cells`, of which those in `sent` were received; all where absent. `empty` is
    /// the map of an empty world, of the same size.
    pub(super) fn of_map(map: &[f32], empty: &[f32], cells: usize, sent: Option<&[bool]>) -> Self {
        let compared = map.iter().zip(empty);
        let compared: Vec<f32> = compared.map(|(value, nothing)| value - nothing).collect();
        let step = (compared.len() / VALUES).max(1);
        let channels = (compared.len() / cells.max(1)).max(1);
        let of_cell = |cell: usize| -> [f32; VALUES_OF_CELL] {
            std::array::from_fn(|part| {
                let channel = (cell + part * channels / VALUES_OF_CELL) % channels;
                compared[channel * cells + cell]
            })
        };
        let is_sent = |cell: usize| sent.is_none_or(|sent| sent[cell]);
        let of_sent = |cell: usize| is_sent(cell).then(|| of_cell(cell));
        Self {
            spread: compared.iter().copied().step_by(step).collect(),
            cells: (0..cells).map(of_sent).collect(),
            is_partial: sent.is_some(),
        }
    }

    /// Cosine similarity with another message, -1..1, 1 for copies: where one is a partial map, of the cells that both
    /// sent. `None` where there is too little for a comparison.
    pub(super) fn likeness(&self, other: &Self) -> Option<f64> {
        if !self.is_partial && !other.is_partial {
            let is_enough = self.spread.len() >= ENOUGH_VALUES;
            return is_enough.then(|| cosine_similarity(&self.spread, &other.spread));
        }
        let (one, other) = self.common(other);
        let is_enough = one.len() >= ENOUGH_CELLS;
        is_enough.then(|| cosine_similarity(one.as_flattened(), other.as_flattened()))
    }

    /// True if the messages are the same one.
    pub(super) fn is_copy_of(&self, other: &Self) -> bool {
        let likeness = self.likeness(other).unwrap_or(0.0);
        likeness > [COPY, COPY_OF_CELLS][usize::from(self.is_partial || other.is_partial)]
    }

    /// True if two selections of cells have no more in common than chance gives, although they are of one vehicle that
    /// hardly moved.
    pub(super) fn is_unrelated(&self, other: &Self) -> bool {
        let [ours, theirs] = [self, other].map(|one| one.cells.iter().flatten().count());
        let fewer = ours.min(theirs);
        let by_chance = ours as f64 * theirs as f64 / self.cells.len().max(1) as f64;
        let limit = (CHANCE * by_chance).min(SHARED * fewer as f64);
        fewer >= ENOUGH_CELLS && (self.common(other).0.len() as f64) < limit
    }

    /// Values of the cells that both sent.
    fn common(&self, other: &Self) -> (Vec<[f32; VALUES_OF_CELL]>, Vec<[f32; VALUES_OF_CELL]>) {
        let both = self.cells.iter().zip(&other.cells);
        both.filter_map(|(one, other)| Some(((*one)?, (*other)?)))
            .unzip()
    }
}

/// Cosine similarity of two lists of values, -1..1; 0 where they differ in length.
fn cosine_similarity(one: &[f32], other: &[f32]) -> f64 {
    if one.len() != other.len() || one.is_empty() {
        return 0.0;
    }
    dot(one, other) / (dot(one, one) * dot(other, other)).sqrt().max(1e-12)
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    let products = a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b));
    products.sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    const CHANNELS: usize = 8;
    const CELLS: usize = 6000;

    /// Values of a map that differ with `phase`.
    fn map(phase: f32) -> Vec<f32> {
        (0..CHANNELS * CELLS)
            .map(|index| (index as f32 * 0.37 * (1.0 + phase)).sin())
            .collect()
    }

    /// Fingerprint of a map of which these cells were sent; the others are zero, as a receiver has them.
    fn sent(phase: f32, is_sent: impl Fn(usize) -> bool) -> Fingerprint {
        let sent: Vec<bool> = (0..CELLS).map(is_sent).collect();
        let mut map = map(phase);
        for (index, value) in map.iter_mut().enumerate() {
            if !sent[index % CELLS] {
                *value = 0.0;
            }
        }
        Fingerprint::of_map(&map, &[3.0; CHANNELS * CELLS], CELLS, Some(&sent))
    }

    #[test]
    fn partial_maps_are_compared_in_the_cells_that_both_sent() {
        let one = sent(0.0, |cell| cell < 300);
        let most = sent(0.0, |cell| (60..360).contains(&cell));
        assert!(one.is_copy_of(&one) && one.is_copy_of(&most));
        let other = sent(0.4, |cell| (60..360).contains(&cell));
        let likeness = one.likeness(&other).unwrap();
        assert!(
            !one.is_copy_of(&other) && likeness < 0.98,
            "two vehicles: {likeness}"
        );
        let elsewhere = sent(0.0, |cell| (250..550).contains(&cell));
        assert_eq!(one.likeness(&elsewhere), None, "50 common cells");
        let whole = Fingerprint::of_map(&map(0.0), &[3.0; CHANNELS * CELLS], CELLS, None);
        assert!(one.is_copy_of(&whole), "part of a whole map");
        assert!(whole.is_copy_of(&whole) && !whole.is_unrelated(&whole));
        assert_eq!(one.likeness(&Fingerprint::of_values(vec![0.5; 9])), None);
    }

    #[test]
    fn selections_of_chance_are_unrelated_and_those_of_one_vehicle_are_not() {
        let one = sent(0.0, |cell| cell < 300);
        for (first, is_unrelated) in [(60, false), (230, false), (299, true), (300, true)] {
            let next = sent(0.0, |cell| (first..first + 300).contains(&cell));
            assert_eq!(one.is_unrelated(&next), is_unrelated, "from {first}");
        }
        let most = sent(0.0, |cell| cell >= 50);
        assert!(!one.is_unrelated(&most) && !most.is_unrelated(&one));
        let few = sent(0.0, |cell| (5000..5099).contains(&cell));
        assert!(!one.is_unrelated(&few), "too few for a judgement");
    }

    #[test]
    fn copies_are_alike_and_others_are_not() {
        let one: Vec<f32> = (0..100).map(|step| (step as f32 * 0.37).sin()).collect();
        let other: Vec<f32> = (0..100).map(|step| (step as f32 * 0.91).cos()).collect();
        assert!(
            cosine_similarity(&one, &one) > 0.9999 && cosine_similarity(&one, &other).abs() < 0.5
        );
        assert_eq!(
            (
                cosine_similarity(&one, &one[1..]),
                cosine_similarity(&[], &[])
            ),
            (0.0, 0.0)
        );
    }
}
