use std::fs;

use protocol::PointCloud;

use super::*;
use crate::OpenOptions;
use crate::frame::{Object, ObjectClass};

const HEAD: &str = "FIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nWIDTH 20\nDATA ascii\n";

/// Findings in a scene of one agent with 20 boxes around the sensor in each of 60 frames, of which `empty` hold no
/// point.
fn scene_findings(
    dir: &Path,
    empty: usize,
    intensity: f32,
    rule: Option<&GroundTruthRule>,
) -> Vec<String> {
    let folder = dir.join("scene/1");
    fs::create_dir_all(&folder).unwrap();
    let cars: String = (0..20)
        .map(|id| {
            let x = if id < empty { 900 } else { 10 };
            format!(
                "  {id}: {{location: [{x}, {}, 0], angle: [0, 0, 0], extent: [1, 1, 1]}}\n",
                4 * id
            )
        })
        .collect();
    let yaml = format!("lidar_pose: [0, 0, 0, 0, 0, 0]\nvehicles:\n{cars}");
    let points: String = (0..20)
        .map(|id| format!("10 {} 0 {}\n", 4 * id, intensity * id as f32))
        .collect();
    for frame in 0..60 {
        fs::write(folder.join(format!("{frame:06}.yaml")), &yaml).unwrap();
        fs::write(
            folder.join(format!("{frame:06}.pcd")),
            format!("{HEAD}{points}"),
        )
        .unwrap();
    }
    messages(dir, rule)
}

fn messages(dir: &Path, rule: Option<&GroundTruthRule>) -> Vec<String> {
    let dataset = crate::open_with(dir, &OpenOptions::default()).unwrap();
    sampled(&dataset.scenarios, IntensityScale::AUTO, rule)
        .into_iter()
        .map(|finding| finding.message)
        .collect()
}

#[test]
fn a_sample_has_the_findings_of_the_whole() {
    let dir = tempfile::tempdir().unwrap();
    assert!(scene_findings(dir.path(), 10, 0.05, None).is_empty());
    let found = scene_findings(dir.path(), 11, -1.0, None);
    assert_eq!(found.len(), 2, "{found:?}");
    assert!(
        found[0].starts_with("scene: agent 1: 440 of 800 boxes (55 %) hold none of its points"),
        "{found:?}"
    );
    assert!(
        found[1].contains("sweeps of agent 1: 760 of 800 intensities are below 0"),
        "{found:?}"
    );
}

#[test]
fn mirrored_points_are_named() {
    // The only error is the sign of one axis.
    let findings = |signs: [f64; 2]| {
        let pose = |x: f64, y: f64| protocol::Pose::from_xyz_yaw([x, y, 0.0], 0.3);
        let frame = Frame {
            world_from_lidar: Some(pose(0.0, 0.0)),
            objects: (0..30)
                .map(|id| {
                    let pose = pose(f64::from(id), 4.0 * f64::from(id));
                    Object::new(i64::from(id), ObjectClass::Car, pose, [1.0; 3])
                })
                .collect(),
            ..Frame::empty(CavId::new("1").unwrap(), 0, protocol::Handedness::Right)
        };
        let from_world = pose(0.0, 0.0).isometry().inverse();
        let points = frame.objects.iter().map(|object| {
            let place = from_world * nalgebra::Point3::from(object.world_from_object.translation_m);
            [
                (signs[0] * place.x) as f32,
                (signs[1] * place.y) as f32,
                0.0,
                0.5,
            ]
        });
        let points = protocol::PointCloud {
            xyzi: points.collect(),
        };
        let counts = boxes::without_points(&frame, &pose(0.0, 0.0), &points);
        let found = boxes::empty("scene", &CavId::new("1").unwrap(), (30, counts));
        found.map(|finding| finding.message)
    };
    assert_eq!(findings([1.0, 1.0]), None);
    for (signs, axis) in [([1.0, -1.0], "y"), ([-1.0, 1.0], "x")] {
        let found = findings(signs).unwrap();
        let part =
            format!("hold none of its points, but only 0 once {axis} of the points is negated");
        assert!(found.contains(&part), "{found}");
    }
    let agent = CavId::new("1").unwrap();
    let found = |counts| boxes::empty("scene", &agent, (100, counts));
    for counts in [[19, 0, 0], [40, 14, 20], [30, 30, 30]] {
        assert_eq!(found(counts), None, "{counts:?}");
    }
    assert!(found([42, 14, 20]).is_some());
}

#[test]
fn cooperative_labels_of_another_world_are_named() {
    let list = |offset_m: f64| -> Vec<Object> {
        let place = |id: i64| protocol::Pose::from_xyz_yaw([offset_m, 9.0 * id as f64, 0.0], 0.0);
        let cars = (0..25).map(|id| Object::new(id, ObjectClass::Car, place(id), [4.5, 1.8, 1.5]));
        cars.collect()
    };
    let agent = CavId::new("vehicle").unwrap();
    let finding = |cooperative_objects| {
        let frame = Frame {
            objects: list(0.0),
            cooperative_objects,
            ..Frame::empty(agent.clone(), 0, protocol::Handedness::Right)
        };
        let ticks = FramesOfTicks::from([(0, vec![&frame])]);
        boxes::unlike_cooperative("scene", &agent, &ticks).map(|finding| finding.message)
    };
    assert_eq!(finding(None), None);
    assert_eq!(finding(Some(list(1.0))), None);
    let mut one_is_listed = list(2.0);
    one_is_listed.extend(list(0.0).into_iter().take(9));
    assert_eq!(finding(Some(one_is_listed)), None);
    let found = finding(Some(list(2.0))).unwrap();
    let start = "scene: agent vehicle: 0 of 25 vehicles that it lists are within 1.5 m of one in the cooperative";
    assert!(found.starts_with(start), "{found}");
}

#[test]
fn intensities_far_below_one_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let found = scene_findings(dir.path(), 0, 0.0002, None);
    assert_eq!(found.len(), 1, "{found:?}");
    let part = "the largest of 800 intensities is 3.80e-3 (field intensity divided by 1), expected 0.02 to 1";
    assert!(found[0].contains(part), "{found:?}");
    assert!(scene_findings(dir.path(), 0, 0.002, None).is_empty());
}

/// Findings about the fit of boxes in six frames of ten cars of 4.4 x 2 m that drive some metres from each to the next,
/// with points on their sides. The boxes are turned, multiplied, and those of some frames later.
fn fit_findings(yaw_deg: f64, scale: f64, [late, step_m]: [f64; 2]) -> Vec<String> {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("scene/1");
    fs::create_dir_all(&folder).unwrap();
    let place = |car: usize, frame: f64| {
        let (row, column) = ((car / 5) as f64, (car % 5) as f64);
        [8.0 * column - 16.0 + step_m * frame, 8.0 * row + 6.0]
    };
    for frame in 0..6 {
        let cars = (0..10).map(|car| {
            let [x, y] = place(car, f64::from(frame) + late);
            let (extent, speed) = ([2.2, 1.0, 0.8].map(|half| scale * half), 36.0 * step_m);
            let place = format!("location: [{x}, {y}, 0], angle: [0, {yaw_deg}, 0]");
            format!("  {car}: {{{place}, extent: {extent:?}, speed: {speed}}}\n")
        });
        let yaml = format!(
            "lidar_pose: [0, 0, 0, 0, 0, 0]\nvehicles:\n{}",
            cars.collect::<String>()
        );
        let points = (0..10 * 17).map(|k| {
            let ([x, y], part) = (place(k / 17, f64::from(frame)), (k % 17) as f64 / 8.0 - 1.0);
            let (dx, dy) = (2.2 * part, part);
            let sides = [(dx, 1.0), (dx, -1.0), (2.2, dy), (-2.2, dy)];
            let lines = sides.map(|(dx, dy)| format!("{} {} 0.2 0.{}\n", x + dx, y + dy, k % 9));
            lines.concat()
        });
        let cloud = HEAD.replace("WIDTH 20", "WIDTH 680") + &points.collect::<String>();
        fs::write(folder.join(format!("{frame:06}.yaml")), yaml).unwrap();
        fs::write(folder.join(format!("{frame:06}.pcd")), cloud).unwrap();
    }
    let mut found = messages(dir.path(), None);
    found.retain(|message| message.contains("the points fit"));
    found
}

#[test]
fn boxes_that_a_change_fits_better_to_the_points_are_named() {
    assert_eq!(fit_findings(0.0, 1.0, [0.0, 1.5]), Vec::<String>::new());
    assert_eq!(fit_findings(180.0, 1.0, [0.0, 1.5]), Vec::<String>::new());
    // Points may be as old as their sweep.
    assert_eq!(fit_findings(0.0, 1.0, [0.5, 2.4]), Vec::<String>::new());
    for (found, name) in [
        (fit_findings(90.0, 1.0, [0.0, 1.5]), "turned by 90 degrees"),
        (fit_findings(0.0, 0.5, [0.0, 1.5]), "twice as large"),
        (fit_findings(0.0, 1.0, [1.0, 1.5]), "of the frame before"),
    ] {
        let start =
            format!("scene: agent 1: the points fit boxes {name} better: 1.00 of the structure");
        assert!(
            found.len() == 1 && found[0].starts_with(&start),
            "{name}: {found:?}"
        );
    }
}

#[test]
fn boxes_that_no_change_fits_to_the_points_are_named() {
    let fault = |share: f64, boxes: usize| {
        let labels = vec![share; boxes];
        fit::fault(&fit::Comparisons::from([(
            "half as large",
            [labels, vec![share; 19]],
        )]))
    };
    assert_eq!(fault(0.5, 40), None);
    assert_eq!(fault(0.4, 39), None);
    let found = fault(0.4, 40).unwrap();
    assert!(
        found.starts_with("0.40 of the structure near 40 boxes is inside"),
        "{found}"
    );
}

#[test]
fn a_change_that_mends_the_fewer_boxes_is_no_fault_of_the_list() {
    let fault = |labels: Vec<f64>| {
        let trial = vec![0.9; 50];
        fit::fault(&fit::Comparisons::from([("1.2 m ahead", [labels, trial])]))
    };
    assert_eq!(fault([vec![1.0; 30], vec![0.2; 20]].concat()), None);
    assert!(fault(vec![0.6; 50]).is_some());
}

#[test]
fn objects_near_the_sensor_that_no_point_hits_count_as_boxes_without_points() {
    let frame = Frame {
        world_from_lidar: Some(protocol::Pose::IDENTITY),
        missed_objects: 7,
        ..Frame::empty(CavId::new("1").unwrap(), 0, protocol::Handedness::Right)
    };
    let findings = FrameFindings::of(Some(frame), Some(&PcdCloud::default()));
    assert_eq!((findings.placed_boxes, findings.empty_boxes), (7, [7; 3]));
    assert_eq!(findings.boxes_without_points, 0, "they are not listed");
}

/// Problem of a sweep of a street that is 8 m wide and 60 m long, between walls of 6 m, whose axes are in this order.
fn axes_finding(order: [usize; 3]) -> Option<String> {
    let points = (0..3000).map(|k| {
        let (along, around) = ((k % 60) as f32 - 30.0, (k / 60) as f32 * 0.4);
        let [side, up] = match around {
            ..6.0 => [-4.0, around],
            6.0..14.0 => [around - 10.0, 0.0],
            _ => [4.0, (around - 14.0).min(6.0)],
        };
        let point = [along, side, up - 1.9];
        [point[order[0]], point[order[1]], point[order[2]], 0.1]
    });
    let cloud = PcdCloud {
        points: PointCloud {
            xyzi: points.collect(),
        },
        ..PcdCloud::default()
    };
    let sweep = SweepFindings::of(&cloud);
    let found = of_clouds(Path::new("clouds"), &[&sweep], IntensityScale::AUTO);
    let mut found = found.into_iter().map(|problem| problem.to_string());
    found.find(|problem| problem.contains("must point up"))
}

#[test]
fn axes_of_a_camera_are_named() {
    assert_eq!(axes_finding([0, 1, 2]), None);
    assert_eq!(axes_finding([1, 0, 2]), None);
    let found = axes_finding([1, 2, 0]).unwrap();
    assert!(found.contains("47.2 m along z"), "{found}");
}

#[test]
fn a_sample_without_ground_truth_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let rule = Some(&GroundTruthRule::V2V4REAL);
    assert_eq!(
        scene_findings(dir.path(), 0, 0.05, rule),
        Vec::<String>::new()
    );
    let found = scene_findings(dir.path(), 20, 0.05, rule);
    assert_eq!(found.len(), 2, "{found:?}");
    assert!(
        found[1].starts_with(
            "scene: ground truth 0 for every ego in 40 of 60 ticks, though agents list 800 objects"
        ),
        "{found:?}"
    );
    assert_eq!(
        scene_findings(dir.path(), 20, 0.05, None).len(),
        1,
        "nobody asks for ground truth"
    );
}

/// The finding about 20 objects of a class and a size.
fn form_finding(class: ObjectClass, size_m: [f64; 3]) -> Option<String> {
    let pose = protocol::Pose::from_xyz_yaw([0.0; 3], 0.0);
    let objects: Vec<Object> = (0..20)
        .map(|id| Object::new(id, class, pose, size_m))
        .collect();
    let agent = CavId::new("1").unwrap();
    let few = boxes::unlike_cars("scene", &agent, objects.iter().skip(1));
    assert_eq!(few, None, "few objects are not judged");
    boxes::unlike_cars("scene", &agent, objects.iter()).map(|finding| finding.message)
}

#[test]
fn cars_that_do_not_have_the_form_of_cars_are_named() {
    use ObjectClass::{Car, Pedestrian, Truck};
    for (class, size_m) in [
        (Car, [4.5, 1.9, 1.5]),
        (Car, [2.2, 1.5, 1.5]),
        (Car, [12.0, 2.6, 3.2]),
        (Car, [0.5, 0.6, 1.8]),
        (Car, [5.9, 2.0, 2.7]),
        (Pedestrian, [1.3, 1.5, 1.8]),
        (Truck, [16.0, 3.4, 4.0]),
    ] {
        assert_eq!(form_finding(class, size_m), None, "{class:?} {size_m:?}");
    }
    for (size_m, part) in [
        (
            [1.9, 4.5, 1.5],
            "scene: agent 1: 20 of 20 cars, first of 1.9 x 4.5 x 1.5 m, are shorter than wide or high",
        ),
        ([1.5, 1.7, 4.2], "shorter than wide or high"),
        ([4.5, 1.5, 1.9], "higher than wide"),
        ([9.0, 3.9, 3.1], "larger than any car"),
    ] {
        let found = form_finding(Car, size_m).unwrap();
        assert!(found.contains(part), "{found}");
    }
}

/// Place of a car along the road, metres: that with number 0 drives.
fn x_m(car: usize, frame: usize) -> f64 {
    let driven = if car == 0 { 2 * frame } else { 0 };
    (10 * car + driven) as f64
}

/// Findings about the lists of agents 1 and 2 in 16 frames, of which the second lists the cars with these ids and
/// places.
fn list_findings(second: impl Fn(usize, usize) -> (usize, f64)) -> Vec<String> {
    let dir = tempfile::tempdir().unwrap();
    let first = |car, frame| (car, x_m(car, frame));
    for (agent, is_first) in [("1", true), ("2", false)] {
        let folder = dir.path().join("scene").join(agent);
        fs::create_dir_all(&folder).unwrap();
        for frame in 0..16 {
            let cars = (0..5).map(|car| {
                let list: &dyn Fn(usize, usize) -> _ = if is_first { &first } else { &second };
                let (id, x) = list(car, frame);
                let place = format!("location: [{x}, {}, 0], angle: [0, 0, 0]", 8 * car);
                format!("  {id}: {{{place}, extent: [2.2, 1, 0.8]}}\n")
            });
            let cars: String = cars.collect();
            let yaml = format!("lidar_pose: [0, 0, 0, 0, 0, 0]\nvehicles:\n{cars}");
            fs::write(folder.join(format!("{frame:06}.yaml")), yaml).unwrap();
            let points: String = (0..20)
                .map(|point| format!("{point} {frame} 0 0.5\n"))
                .collect();
            let cloud = format!("{HEAD}{points}");
            fs::write(folder.join(format!("{frame:06}.pcd")), cloud).unwrap();
        }
    }
    let mut found = messages(dir.path(), None);
    found.retain(|message| message.contains("agents 1 and 2"));
    found
}

#[test]
fn lists_of_two_agents_that_contradict_each_other_are_named() {
    assert_eq!(
        list_findings(|car, frame| (car, x_m(car, frame))),
        Vec::<String>::new()
    );
    // Places that differ a little, an object of two ids, and lists that share nothing are usual.
    let sound = |car: usize, frame| (if car == 4 { 9 } else { car }, x_m(car, frame) - 0.9);
    assert_eq!(list_findings(sound), Vec::<String>::new());
    assert_eq!(
        list_findings(|car, frame| (car + 50, x_m(car, frame) + 500.0)),
        Vec::<String>::new()
    );
    let other_ids = list_findings(|car, frame| (car + 50, x_m(car, frame)));
    assert_eq!(other_ids.len(), 1, "{other_ids:?}");
    let start =
        "scene: agents 1 and 2: 80 of 80 boxes that both list contradict each other, first ";
    assert!(other_ids[0].starts_with(start), "{other_ids:?}");
    let own_numbers = list_findings(|car, frame| ((car + 1) % 5, x_m(car, frame)));
    assert_eq!(own_numbers.len(), 1, "{own_numbers:?}");
    let other_world = list_findings(|car, frame| (car, x_m(car, frame) + 8.5));
    assert!(other_world[0].contains("80 of 80 boxes"), "{other_world:?}");
    let late = list_findings(|car, frame| (car, x_m(car, frame.saturating_sub(3))));
    assert!(late[0].contains("14 of 14 boxes"), "{late:?}");
}
