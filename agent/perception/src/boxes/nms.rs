//! Non-maximum suppression of rotated boxes.

use protocol::rotated_iou::Polygon;

/// Indices of the boxes that are kept, by descending score.
///
/// Boxes are kept by descending score, equal ones in their order; each kept box removes those after it whose footprint
/// overlaps it with an IoU above `threshold`. Only the `max_candidates` best are considered, as in the reference.
///
/// # Panics
/// When the numbers of scores and boxes differ: an error of the caller, not of the data.
pub fn rotated_nms(
    boxes: &[Polygon],
    scores: &[f32],
    threshold: f64,
    max_candidates: usize,
) -> Vec<usize> {
    assert_eq!(boxes.len(), scores.len(), "one score per box");
    let mut order: Vec<usize> = (0..boxes.len()).collect();
    order.sort_by(|&a, &b| scores[b].total_cmp(&scores[a]));
    order.truncate(max_candidates);
    // A box is removed when a kept one suppresses it: the same result as striking out, without a table of pairs.
    let mut kept: Vec<usize> = Vec::new();
    for candidate in order {
        let polygon = &boxes[candidate];
        let mut better = kept.iter().map(|&better| &boxes[better]);
        if !better.any(|better| better.overlaps_more_than(polygon, threshold)) {
            kept.push(candidate);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(x: f64) -> Polygon {
        Polygon::new([[x, 0.0], [x + 2.0, 0.0], [x + 2.0, 2.0], [x, 2.0]])
    }

    #[test]
    fn the_best_of_a_cluster_is_kept() {
        let boxes = [square(0.0), square(0.5), square(10.0)];
        assert_eq!(rotated_nms(&boxes, &[0.5, 0.9, 0.7], 0.15, 1000), [1, 2]);
    }

    #[test]
    fn a_suppressed_box_suppresses_nothing() {
        // 0 overlaps 1, 1 overlaps 2, 0 does not reach 2.
        let boxes = [square(0.0), square(1.0), square(2.0)];
        assert_eq!(rotated_nms(&boxes, &[0.9, 0.8, 0.7], 0.15, 1000), [0, 2]);
    }

    #[test]
    fn only_the_best_candidates_are_considered() {
        let boxes = [square(0.0), square(10.0), square(20.0)];
        assert_eq!(rotated_nms(&boxes, &[0.1, 0.3, 0.2], 0.15, 2), [1, 2]);
        assert!(rotated_nms(&[], &[], 0.15, 2).is_empty());
    }
}
