use proptest::prelude::*;
use protocol::Box3d;

use super::*;
use crate::frame::ObjectClass;
use crate::ground_truth::TrueBox;

fn car(x: f64) -> Box3d {
    Box3d {
        center_m: [x, 0.0, 0.0],
        size_m: [4.0, 2.0, 1.5],
        heading_rad: 0.0,
    }
}

fn found(x: f64, score: f32) -> Detection {
    Detection {
        box3d: car(x),
        score,
        source: None,
    }
}

#[test]
fn matches_are_those_that_are_counted() {
    let detections = [
        found(0.3, 0.4),
        found(0.1, 0.9),
        found(30.0, 0.8),
        found(10.0, 0.2),
    ];
    let objects = GroundTruth::of_boxes([car(10.0), car(0.0)]);
    let mut scorer = Scorer::new(&[0.5]);
    let wrong = Verdict::FalsePositive;
    assert_eq!(
        scorer.add(&detections, &objects),
        [[wrong, Verdict::Match(1), wrong, Verdict::Match(0)]]
    );
    assert_eq!(
        scorer.tallies[0]
            .matched
            .iter()
            .filter(|matched| matched.is_true)
            .count(),
        2
    );
}

#[test]
fn perfect_boxes_have_ap_one() {
    let mut scorer = Scorer::default();
    scorer.add(
        &[found(0.0, 0.9), found(10.0, 0.8)],
        &GroundTruth::of_boxes([car(10.0), car(0.0)]),
    );
    for ordering in [Ordering::Global, Ordering::Frame] {
        assert_eq!(scorer.average_precisions(ordering), [Some(1.0); 3]);
    }
}

#[test]
fn a_second_box_on_one_object_is_false() {
    let mut scorer = Scorer::new(&[0.5]);
    scorer.add(
        &[found(0.1, 0.8), found(0.0, 0.9)],
        &GroundTruth::of_boxes([car(0.0)]),
    );
    let is_true: Vec<bool> = scorer.tallies[0]
        .matched
        .iter()
        .map(|entry| entry.is_true)
        .collect();
    assert_eq!(is_true, [true, false]);
}

#[test]
fn the_loser_of_the_best_object_may_still_find_another() {
    let mut scorer = Scorer::new(&[0.3]);
    // Both detections overlap the first object most; the second takes the other one.
    scorer.add(
        &[found(0.0, 0.9), found(0.6, 0.8)],
        &GroundTruth::of_boxes([car(0.2), car(2.0)]),
    );
    assert!(scorer.tallies[0].matched.iter().all(|entry| entry.is_true));
}

#[test]
fn frames_without_detections_still_count_their_objects() {
    let mut scorer = Scorer::new(&[0.5]);
    scorer.add(&[found(0.0, 0.9)], &GroundTruth::of_boxes([car(0.0)]));
    scorer.add(&[], &GroundTruth::of_boxes([car(0.0)]));
    assert_eq!(scorer.average_precisions(Ordering::Global), [Some(0.5)]);
}

#[test]
fn orderings_differ_where_a_bad_frame_comes_first() {
    let mut scorer = Scorer::new(&[0.5]);
    scorer.add(&[found(50.0, 0.2)], &GroundTruth::of_boxes([]));
    scorer.add(&[found(0.0, 0.9)], &GroundTruth::of_boxes([car(0.0)]));
    assert_eq!(scorer.average_precisions(Ordering::Global), [Some(1.0)]);
    assert_eq!(scorer.average_precisions(Ordering::Frame), [Some(0.5)]);
}

#[test]
fn without_objects_ap_is_unknown() {
    let mut scorer = Scorer::default();
    assert_eq!(scorer.average_precisions(Ordering::Global), [None; 3]);
    scorer.add(&[found(0.0, 0.9)], &GroundTruth::of_boxes([]));
    assert_eq!(scorer.average_precisions(Ordering::Global), [None; 3]);
}

proptest! {
    #[test]
    fn ap_lies_between_zero_and_one_and_reading_changes_nothing(
        offsets in prop::collection::vec((-30.0..30.0f64, 0.0..1.0f32), 0..20),
        objects in prop::collection::vec(-30.0..30.0f64, 0..10),
    ) {
        let mut scorer = Scorer::default();
        let detections: Vec<_> = offsets.iter().map(|&(x, score)| found(x, score)).collect();
        let objects: Vec<Box3d> = objects.into_iter().map(car).collect();
        scorer.add(&detections, &GroundTruth::of_boxes(objects.clone()));
        for ordering in [Ordering::Global, Ordering::Frame] {
            let first = scorer.average_precisions(ordering);
            prop_assert!(first.iter().flatten().all(|ap| (0.0..=1.0).contains(ap)));
            prop_assert!(first.iter().all(|ap| ap.is_none() == objects.is_empty()));
            prop_assert_eq!(&first, &scorer.average_precisions(ordering));
            prop_assert!(first.windows(2).all(|pair| pair[0] >= pair[1] || objects.len() > 1));
        }
    }
}

fn true_boxes(class: ObjectClass, places: &[f64]) -> Vec<TrueBox> {
    (0..)
        .zip(places)
        .map(|(id, x)| TrueBox {
            id,
            class,
            box3d: car(*x),
        })
        .collect()
}

/// Cars from -32 to 32 m; trucks do not count.
fn narrow(cars: &[f64], trucks: &[f64]) -> GroundTruth {
    GroundTruth {
        objects: true_boxes(ObjectClass::Car, cars),
        ignored: true_boxes(ObjectClass::Truck, trucks),
        area_m: [-32.0, -32.0, 32.0, 32.0],
    }
}

#[test]
fn detections_with_a_corner_beyond_the_range_count_neither_way() {
    let mut scorer = Scorer::new(&[0.5]);
    // Corners at 30.0 and 34.0 m; at exactly 32.0 m; beyond.
    let verdicts = scorer.add(
        &[
            found(32.0, 0.9),
            found(30.0, 0.8),
            found(60.0, 0.95),
            found(-10.0, 0.7),
        ],
        &narrow(&[30.0], &[]),
    );
    let expected = [
        Verdict::Ignored,
        Verdict::Match(0),
        Verdict::Ignored,
        Verdict::FalsePositive,
    ];
    assert_eq!(verdicts, [expected]);
    assert_eq!(scorer.average_precisions(Ordering::Global), [Some(1.0)]);
}

#[test]
fn detections_on_objects_of_other_classes_count_neither_way_from_the_same_overlap_on() {
    let mut scorer = Scorer::new(&[0.5, 0.7]);
    // Overlaps with the truck: 1.0, again, and 0.6.
    let verdicts = scorer.add(
        &[
            found(10.0, 0.9),
            found(10.0, 0.8),
            found(11.0, 0.7),
            found(0.0, 0.6),
        ],
        &narrow(&[0.0], &[10.0]),
    );
    let [ignored, wrong, right] = [Verdict::Ignored, Verdict::FalsePositive, Verdict::Match(0)];
    assert_eq!(verdicts[0], [ignored, ignored, ignored, right]);
    assert_eq!(verdicts[1], [ignored, ignored, wrong, right]);
}

#[test]
fn an_object_that_counts_is_matched_before_one_that_does_not() {
    let mut scorer = Scorer::new(&[0.5]);
    let verdicts = scorer.add(&[found(0.0, 0.9)], &narrow(&[0.5], &[0.0]));
    assert_eq!(verdicts, [[Verdict::Match(0)]]);
}

fn distance_along_x(a: &Box3d, b: &Box3d) -> f64 {
    (a.center_m[0] - b.center_m[0]).abs()
}

/// True if the intervals of x of two cars have an IoU of at least a half.
fn overlap_along_x(a: &Box3d, b: &Box3d) -> bool {
    let common = (4.0 - distance_along_x(a, b)).max(0.0);
    common / (8.0 - common) >= 0.5
}

/// The largest precision from a rank on: `judged` has the score and 1 for a hit or 0, the highest score first.
fn precision_from(judged: &[(f32, f64)], rank: usize) -> f64 {
    (rank..=judged.len())
        .map(|count| judged[..count].iter().map(|(_, hit)| hit).sum::<f64>() / count as f64)
        .fold(0.0, f64::max)
}

/// AP of one part of the objects, computed frame by frame with intervals instead of polygons: `is_in` selects objects
/// by distance and class, `is_near` false positives by distance.
fn plain_average_precision(
    frames: &[(Vec<Detection>, GroundTruth)],
    is_in: impl Fn(f64, ObjectClass) -> bool,
    is_near: impl Fn(f64) -> bool,
) -> f64 {
    let (mut judged, mut objects) = (Vec::new(), 0);
    for (found, truth) in frames {
        let (wanted, others): (Vec<&TrueBox>, Vec<&TrueBox>) = truth
            .objects
            .iter()
            .partition(|one| is_in(one.box3d.center_m[0].abs(), one.class));
        let mut open: Vec<&Box3d> = wanted.iter().map(|one| &one.box3d).collect();
        objects += open.len();
        let mut found = found.clone();
        found.sort_by(|a, b| b.score.total_cmp(&a.score));
        for one in found
            .iter()
            .filter(|one| one.box3d.center_m[0].abs() + 2.0 <= 80.0)
        {
            let best = open.iter().copied().min_by(|a, b| {
                distance_along_x(a, &one.box3d).total_cmp(&distance_along_x(b, &one.box3d))
            });
            match best.filter(|best| overlap_along_x(best, &one.box3d)) {
                Some(best) => {
                    open.retain(|other| *other != best);
                    judged.push((one.score, 1.0));
                }
                None if others
                    .iter()
                    .any(|other| overlap_along_x(&other.box3d, &one.box3d)) => {}
                None if is_near(one.box3d.center_m[0].abs()) => judged.push((one.score, 0.0)),
                None => {}
            }
        }
    }
    judged.sort_by(|a, b| b.0.total_cmp(&a.0));
    let hits = (1..=judged.len()).filter(|rank| judged[rank - 1].1 > 0.0);
    let precisions = hits.map(|rank| precision_from(&judged, rank));
    precisions.sum::<f64>() / objects as f64
}

/// A car every 7 m with an error that grows, every third a van; a box on nothing every 11 m.
fn shifted_frame(index: u32) -> (Vec<Detection>, GroundTruth) {
    let shift = f64::from(index);
    let objects: Vec<TrueBox> = (0..12)
        .map(|id| TrueBox {
            id,
            class: if id % 3 == 0 {
                ObjectClass::Van
            } else {
                ObjectClass::Car
            },
            box3d: car(7.0 * id as f64 - shift),
        })
        .collect();
    let on_objects = objects.iter().map(|one| {
        let x = one.box3d.center_m[0];
        found(
            x + 0.015 * x.abs(),
            0.9 - 0.01 * (x.abs() as f32) + 0.003 * index as f32,
        )
    });
    let on_nothing = (0..6).map(|k| found(-11.0 * f64::from(k) - 9.0, 0.85 - 0.1 * k as f32));
    let found = on_objects.chain(on_nothing).collect();
    let truth = GroundTruth {
        objects,
        ignored: vec![],
        area_m: [-80.0, -80.0, 80.0, 80.0],
    };
    (found, truth)
}

#[test]
fn ap_by_distance_and_by_class_is_that_of_a_plain_computation() {
    let frames: Vec<(Vec<Detection>, GroundTruth)> = (0..3).map(shifted_frame).collect();
    let mut scorer = Scorer::new(&[0.5]).with_breakdowns();
    for (found, truth) in &frames {
        scorer.add(found, truth);
    }
    for (part, tallies) in &scorer.parts {
        let expected = match *part {
            Breakdown::Distance([from, to]) => {
                let is_near = |x: f64| (from..to).contains(&x);
                plain_average_precision(&frames, |x, _| is_near(x), is_near)
            }
            Breakdown::Class(class) => {
                plain_average_precision(&frames, |_, of| of == class, |_| true)
            }
        };
        let ap = tallies[0].curve(Ordering::Global).average_precision;
        assert_eq!(ap.is_some(), tallies[0].objects > 0, "{part}");
        assert!(
            ap.is_none_or(|ap| (ap - expected).abs() < 1e-9 && ap > 0.05 && ap < 1.0),
            "{part}: {ap:?}, {expected}"
        );
    }
}
