use protocol::{CavId, Handedness, Pose};

use super::*;
use crate::frame::ObjectClass;

fn frame(cav: &str, x: f64, objects: Vec<Object>) -> Frame {
    Frame {
        world_from_lidar: Some(Pose::from_xyz_yaw([x, 0.0, 2.0], 0.0)),
        objects,
        ..Frame::empty(CavId::new(cav).unwrap(), 0, Handedness::Right)
    }
}

fn car(id: i64, x: f64, y: f64) -> Object {
    Object {
        id,
        class: ObjectClass::Car,
        world_from_object: Pose::from_xyz_yaw([x, y, 1.0], 0.0),
        size_m: [4.0, 2.0, 1.5],
        speed_mps: None,
    }
}

fn truck(id: i64, x: f64) -> Object {
    Object {
        class: ObjectClass::Truck,
        ..car(id, x, 0.0)
    }
}

fn ids(frames: &[Frame], ego: usize, rule: &GroundTruthRule) -> Vec<i64> {
    merged_objects(&frames.iter().collect::<Vec<_>>(), ego, rule)
        .into_iter()
        .map(|(object, _)| object.id)
        .collect()
}

#[test]
fn annotations_merge_by_id_and_the_ego_stays() {
    let frames = [
        frame("1", 0.0, vec![car(7, 20.0, 0.0)]),
        frame("2", 50.0, vec![car(7, 20.0, 0.0), car(1, 0.0, 0.0)]),
    ];
    assert_eq!(ids(&frames, 0, &GroundTruthRule::OPV2V), [7, 1]);
    assert_eq!(ids(&frames[..1], 0, &GroundTruthRule::OPV2V), [7]);
    let seen_by_two = merged_objects(&[&frames[0], &frames[1]], 1, &GroundTruthRule::OPV2V);
    assert_eq!(seen_by_two[0].1.center_m, [-30.0, 0.0, -1.0]);
}

#[test]
fn a_cooperative_annotation_takes_the_place_of_all_others() {
    let mut frames = [
        frame("1", 0.0, vec![car(7, 20.0, 0.0)]),
        frame("2", 90.0, vec![car(8, 30.0, 0.0)]),
    ];
    frames[0].cooperative_objects = Some(vec![car(0, 20.0, 1.0), car(1, 30.0, 1.0)]);
    assert_eq!(ids(&frames, 0, &GroundTruthRule::OPV2V), [0, 1]);
    assert_eq!(
        ids(&frames, 1, &GroundTruthRule::OPV2V),
        [0, 1],
        "out of range, but the truth of the tick"
    );
    assert_eq!(ids(&frames[1..], 0, &GroundTruthRule::OPV2V), [8]);
    let [with_list, other] = annotations(&frames.each_ref())[..] else {
        panic!("one per frame")
    };
    assert_eq!((with_list.len(), other.len()), (2, 0));
}

#[test]
fn agents_out_of_range_do_not_contribute() {
    let frames = [
        frame("1", 0.0, vec![]),
        frame("2", 70.0, vec![car(3, 5.0, 0.0)]),
        frame("3", 70.1, vec![car(4, 5.0, 0.0)]),
    ];
    assert_eq!(ids(&frames, 0, &GroundTruthRule::OPV2V), [3]);
}

#[test]
fn every_corner_must_lie_in_range_border_included() {
    for (x, y, is_inside) in [
        (138.0, 39.0, true),
        (-138.0, -39.0, true),
        (138.1, 0.0, false),
        (0.0, 39.1, false),
    ] {
        let frames = [frame("1", 0.0, vec![car(1, x, y)])];
        let found = ids(&frames, 0, &GroundTruthRule::OPV2V);
        assert_eq!(!found.is_empty(), is_inside, "{x} {y}");
    }
    let mut high = car(1, 0.0, 0.0);
    high.size_m[2] = 4.5;
    assert!(
        ids(&[frame("1", 0.0, vec![high])], 0, &GroundTruthRule::OPV2V).is_empty(),
        "z counts as well"
    );
}

#[test]
fn two_corners_do_for_v2v4real_but_x_and_y_need_all() {
    let rule = GroundTruthRule {
        z_m: [-1.0, 3.0],
        ..GroundTruthRule::V2V4REAL
    };
    assert_eq!(
        ids(&[frame("1", 0.0, vec![car(1, 10.0, 0.0)])], 0, &rule),
        [1],
        "the top face is above -1 m"
    );
    assert!(ids(&[frame("1", 0.0, vec![car(1, 99.0, 0.0)])], 0, &rule).is_empty());
}

#[test]
fn pedestrians_are_no_targets() {
    let walker = Object {
        class: ObjectClass::Pedestrian,
        ..car(1, 5.0, 0.0)
    };
    assert!(ids(&[frame("1", 0.0, vec![walker])], 0, &GroundTruthRule::OPV2V).is_empty());
}

#[test]
fn objects_of_other_classes_are_ignored_at_any_distance() {
    let rule = GroundTruthRule {
        x_m: [-32.0, 32.0],
        classes: "car".parse().unwrap(),
        ..GroundTruthRule::OPV2V
    };
    let frame = frame(
        "1",
        0.0,
        vec![
            car(1, 10.0, 0.0),
            car(2, 31.0, 0.0),
            truck(3, 20.0),
            truck(4, 60.0),
        ],
    );
    let truth = GroundTruth::of_tick(&[&frame], 0, &rule);
    let ids = [&truth.objects, &truth.ignored]
        .map(|boxes| boxes.iter().map(|object| object.id).collect::<Vec<_>>());
    assert_eq!(ids, [vec![1], vec![3, 4]]);
    assert_eq!(truth.area_m, [-32.0, -40.0, 32.0, 40.0]);
}

#[test]
fn an_object_that_counts_for_one_agent_is_not_ignored_for_the_class_of_another() {
    let rule = GroundTruthRule {
        classes: "car".parse().unwrap(),
        ..GroundTruthRule::OPV2V
    };
    let frames = [
        frame("1", 0.0, vec![car(1, 10.0, 0.0), truck(2, 60.0)]),
        frame("2", 5.0, vec![truck(1, 10.5), truck(3, 20.0)]),
    ];
    let truth = GroundTruth::of_tick(&frames.each_ref(), 0, &rule);
    let ids = [&truth.objects, &truth.ignored]
        .map(|boxes| boxes.iter().map(|object| object.id).collect::<Vec<_>>());
    assert_eq!(ids, [vec![1], vec![2, 3]]);
}

#[test]
fn heading_is_right_at_half_a_turn() {
    for yaw in [std::f64::consts::PI, -std::f64::consts::PI, 3.0, -3.0] {
        let object = Object {
            world_from_object: Pose::from_xyz_yaw([0.0; 3], yaw),
            ..car(1, 0.0, 0.0)
        };
        let heading = upright_box(&object, &Isometry3::identity()).heading_rad;
        assert!(
            ((heading - yaw) / 2.0).sin().abs() < 1e-9,
            "{heading} {yaw}"
        );
    }
}

#[test]
fn a_tilt_shortens_the_box_in_the_plane() {
    let tilt = Isometry3::rotation(Vector3::y() * 0.5);
    let object = Object {
        world_from_object: tilt.into(),
        ..car(1, 0.0, 0.0)
    };
    let [l, w, h] = upright_box(&object, &Isometry3::identity()).size_m;
    assert!(
        (l - 4.0 * 0.5f64.cos()).abs() < 1e-12
            && (w - 2.0).abs() < 1e-12
            && (h - 1.5 * 0.5f64.cos()).abs() < 1e-12
    );
}
