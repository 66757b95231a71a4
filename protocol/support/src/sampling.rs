//! Sampling: a part of a list, evenly spread over it.

/// At most `count` of the items, evenly spread, the first of them included.
pub fn evenly_spread<T: Clone>(items: &[T], count: usize) -> Vec<T> {
    let kept = count.min(items.len());
    (0..kept)
        .filter_map(|place| items.get(place * items.len() / kept).cloned())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_chosen_items_are_spread_over_the_list() {
        assert_eq!(evenly_spread(&[2, 3, 5, 7, 11, 13], 3), [2, 5, 11]);
        assert_eq!(evenly_spread(&[2, 3], 9), [2, 3]);
        assert!(evenly_spread::<u8>(&[], 3).is_empty() && evenly_spread(&[1], 0).is_empty());
    }
}
