//! Layouts of one vehicle: each agent is a sequence of its own.

use super::{
    Tick, assert_same_boxes, assert_same_points, assert_same_pose, expected, open, ticks, write,
};
use crate::generate::SceneLayout;
use dataset::Layout;

/// The capture times of each agent of each scene, in the order of the sequences.
fn by_agent(ticks: &[Tick]) -> Vec<Vec<Tick>> {
    let alone = |tick: &Tick, agent: usize| Tick {
        poses: vec![tick.poses[agent]],
        clouds: vec![tick.clouds[agent].clone()],
        boxes: Vec::new(),
    };
    let scenes = ticks.chunks(2);
    scenes
        .flat_map(|scene| {
            (0..2).map(move |agent| scene.iter().map(|tick| alone(tick, agent)).collect())
        })
        .collect()
}

/// Sequences as read, with the number of boxes that the summary counts as left out.
fn sequences(layout: SceneLayout, found: Layout) -> (Vec<Vec<Tick>>, Vec<u64>) {
    let folder = tempfile::tempdir().unwrap();
    let summary = write(layout, folder.path());
    let dataset = open(folder.path());
    assert_eq!((dataset.layout, dataset.scenarios.len()), (found, 4));
    for scenario in &dataset.scenarios {
        assert_eq!(scenario.ticks.len(), 2);
        assert_eq!(
            scenario.ticks[1].capture_nanos - scenario.ticks[0].capture_nanos,
            100_000_000
        );
    }
    let boxes = summary.annotations as u64;
    assert_eq!(
        summary.omitted["boxes, which the layout does not have"],
        boxes
    );
    let others = summary
        .omitted
        .into_iter()
        .filter(|(what, _)| !what.starts_with("boxes"))
        .map(|(_, count)| count);
    (
        ticks(&dataset).chunks(2).map(<[Tick]>::to_vec).collect(),
        others.collect(),
    )
}

#[test]
fn oxford_keeps_poses_and_points() {
    let (sequences, others) = sequences(SceneLayout::Oxford, Layout::OXFORD);
    assert!(others.is_empty());
    for (sequence, expected) in sequences.iter().zip(by_agent(&expected())) {
        for (tick, expected) in sequence.iter().zip(&expected) {
            assert_same_pose(&tick.poses[0], &expected.poses[0], SceneLayout::Oxford);
            assert_same_points(&tick.clouds[0], &expected.clouds[0], SceneLayout::Oxford);
        }
    }
}

#[test]
fn nclt_keeps_poses_and_points_to_its_resolution() {
    let (sequences, others) = sequences(SceneLayout::Nclt, Layout::NCLT);
    let expected = by_agent(&expected());
    // 5 mm, 1 of 255 steps, and nothing beyond 100 m behind, to the left and above.
    let has_step = |metres: f32| ((f64::from(metres) + 100.0) / 0.005).round() >= 0.0;
    let fits = |&&[x, y, z, _]: &&[f32; 4]| has_step(x) && has_step(-y) && has_step(-z);
    let outside: usize = expected
        .iter()
        .flatten()
        .map(|tick| tick.clouds[0].iter().filter(|point| !fits(point)).count())
        .sum();
    assert_eq!(others.iter().sum::<u64>(), outside as u64);
    for (tick, expected) in sequences.iter().flatten().zip(expected.iter().flatten()) {
        assert_same_pose(&tick.poses[0], &expected.poses[0], SceneLayout::Nclt);
        let kept: Vec<&[f32; 4]> = expected.clouds[0].iter().filter(fits).collect();
        assert_eq!(tick.clouds[0].len(), kept.len());
        for (point, expected) in tick.clouds[0].iter().zip(kept) {
            assert!(
                (0..3).all(|axis| (point[axis] - expected[axis]).abs() < 0.00252),
                "{point:?} {expected:?}"
            );
            assert!((point[3] - expected[3]).abs() < 0.5 / 255.0 + 1e-6);
        }
    }
}

#[test]
fn kitti_odometry_keeps_motions_and_points() {
    let (sequences, others) = sequences(SceneLayout::KittiOdometry, Layout::KITTI_ODOMETRY);
    assert!(others.is_empty());
    for (sequence, expected) in sequences.iter().zip(by_agent(&expected())) {
        let first = expected[0].poses[0];
        for (tick, expected) in sequence.iter().zip(&expected) {
            let from_first = first.inv_mul(&expected.poses[0]);
            assert_same_pose(&tick.poses[0], &from_first, SceneLayout::KittiOdometry);
            assert_same_points(
                &tick.clouds[0],
                &expected.clouds[0],
                SceneLayout::KittiOdometry,
            );
        }
    }
}

#[test]
fn kitti_object_keeps_the_objects_of_each_agent() {
    let [folder, other] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    write(SceneLayout::KittiObject, folder.path());
    let found = ticks(&open(folder.path()));
    // In the order of the files: scene by scene, agent by agent.
    write(SceneLayout::Opv2v, other.path());
    let mut expected = Vec::new();
    for scenario in &open(other.path()).scenarios {
        for agent in 0..2 {
            let frames =
                (0..2).map(|tick| scenario.load(agent, tick, &Default::default()).unwrap());
            expected.extend(frames.map(|frame| super::tick_of(&[frame])));
        }
    }
    assert_eq!(found.len(), 8);
    for (tick, expected) in found.iter().zip(&expected) {
        assert_same_points(
            &tick.clouds[0],
            &expected.clouds[0],
            SceneLayout::KittiObject,
        );
        assert_same_boxes(&tick.boxes, &expected.boxes, SceneLayout::KittiObject);
    }
}
