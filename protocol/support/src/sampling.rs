//! Sampling: a part of a list, evenly spread over it, or each item once.

/// At most `count` of the items, evenly spread, the first of them included.
pub fn evenly_spread<T: Clone>(items: &[T], count: usize) -> Vec<T> {
    let kept = count.min(items.len());
    (0..kept)
        .filter_map(|place| items.get(place * items.len() / kept).cloned())
        .collect()
}

/// The items in their order, of equal ones the first.
pub fn distinct<T: PartialEq>(items: impl IntoIterator<Item = T>) -> Vec<T> {
    let mut kept = Vec::new();
    for item in items {
        if !kept.contains(&item) {
            kept.push(item);
        }
    }
    kept
}

/// The first item that equals one before it.
pub fn repeated<T: PartialEq>(items: &[T]) -> Option<&T> {
    let mut places = items.iter().enumerate();
    let found = places.find(|(place, item)| items.iter().take(*place).any(|one| one == *item));
    found.map(|(_, item)| item)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_item_is_repeated_where_it_stands_a_second_time() {
        assert_eq!(repeated(&[3, 1, 2, 1, 3]), Some(&1));
        assert_eq!(repeated(&[3, 1, 2]), None);
    }

    #[test]
    fn distinct_items_stay_in_their_order() {
        assert_eq!(distinct([3, 1, 3, 2, 1]), [3, 1, 2]);
    }

    #[test]
    fn the_chosen_items_are_spread_over_the_list() {
        assert_eq!(evenly_spread(&[2, 3, 5, 7, 11, 13], 3), [2, 5, 11]);
        assert_eq!(evenly_spread(&[2, 3], 9), [2, 3]);
        assert!(evenly_spread::<u8>(&[], 3).is_empty() && evenly_spread(&[1], 0).is_empty());
    }
}
