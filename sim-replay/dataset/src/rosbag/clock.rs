//! Clock of a topic: the longest part of a bag within which its stamps increase.

/// A part of the messages of a topic.
#[derive(Debug)]
pub(super) struct SteadyPart {
    /// Indices of the messages that belong together, with increasing stamps.
    pub(super) kept: Vec<usize>,
    /// Number of single messages whose stamp is not between those of their neighbours.
    pub(super) strays: usize,
    /// Number of messages of other parts, before or after the clock was set back.
    pub(super) of_other_parts: usize,
    /// Index of the message before and of that after it which belong to other parts.
    pub(super) bounds: (Option<usize>, Option<usize>),
}

/// The longest part of messages with these stamps, in the order in which they were recorded.
///
/// Where a clock was set back, or a bag holds two runs, the same stamps occur twice: parts before and after are kept apart,
/// so that sweeps of one never meet poses of another.
pub(super) fn longest_steady(stamps: &[u64]) -> SteadyPart {
    let (mut parts, mut strays) = (vec![Vec::new()], 0);
    for (index, stamp) in stamps.iter().enumerate() {
        let Some(part) = parts.last_mut() else { break };
        let before = part.last().and_then(|&last: &usize| stamps.get(last));
        let before = before.copied();
        let two_before = part.len().checked_sub(2).and_then(|place| part.get(place));
        let two_before = two_before.and_then(|&place| stamps.get(place));
        let next = stamps.get(index + 1).copied();
        if before.is_none_or(|before| *stamp > before) {
            part.push(index);
        } else if two_before.is_some_and(|two_before| stamp > two_before) {
            // The one before it was ahead of its time.
            strays += 1;
            part.pop();
            part.push(index);
        } else if next.is_some_and(|next| Some(next) <= before) {
            // Two in a row that are not later: the clock was set back, and a part begins.
            parts.push(vec![index]);
        } else {
            strays += 1;
        }
    }
    let total: usize = parts.iter().map(Vec::len).sum();
    // `max_by_key` takes the last of equals: reversed, that is the first part.
    let lens = parts.iter().map(Vec::len).enumerate().rev();
    let longest = lens.max_by_key(|(_, len)| *len).map_or(0, |(part, _)| part);
    let before = longest.checked_sub(1).and_then(|part| parts.get(part));
    let after = longest.checked_add(1).and_then(|part| parts.get(part));
    let bounds = (
        before.and_then(|part| part.last()).copied(),
        after.and_then(|part| part.first()).copied(),
    );
    let kept = parts.swap_remove(longest);
    SteadyPart {
        of_other_parts: total - kept.len(),
        kept,
        strays,
        bounds,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(stamps: &[u64]) -> (Vec<u64>, usize, usize) {
        let part = longest_steady(stamps);
        let kept = part.kept.iter().map(|&index| stamps[index]).collect();
        (kept, part.strays, part.of_other_parts)
    }

    #[test]
    fn single_messages_out_of_order_are_strays() {
        assert_eq!(of(&[]), (vec![], 0, 0));
        assert_eq!(of(&[1, 2, 3]), (vec![1, 2, 3], 0, 0));
        assert_eq!(of(&[1, 2, 2, 3]), (vec![1, 2, 3], 1, 0));
        assert_eq!(of(&[5, 6, 1, 7]), (vec![5, 6, 7], 1, 0), "behind its time");
        assert_eq!(
            of(&[5, 6, 99, 7, 8]),
            (vec![5, 6, 7, 8], 1, 0),
            "ahead of its time"
        );
        assert_eq!(of(&[5, 6, 7, 1]), (vec![5, 6, 7], 1, 0), "the last");
    }

    #[test]
    fn a_clock_that_was_set_back_parts_the_messages() {
        assert_eq!(of(&[10, 11, 12, 5, 6, 7, 8]), (vec![5, 6, 7, 8], 0, 3));
        let stamps = [10, 11, 12, 13, 11, 12, 13, 14];
        assert_eq!(of(&stamps), (vec![10, 11, 12, 13], 0, 4), "never a mixture");
        assert_eq!(longest_steady(&stamps).bounds, (None, Some(4)));
        assert_eq!(
            longest_steady(&[9, 10, 5, 6, 7, 1, 2]).bounds,
            (Some(1), Some(5))
        );
        assert_eq!(
            of(&[99, 5, 6, 7]),
            (vec![5, 6, 7], 0, 1),
            "the first was ahead"
        );
    }
}
