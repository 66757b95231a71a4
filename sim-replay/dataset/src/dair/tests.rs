use std::fs;

use proptest::prelude::*;
use protocol::PointCloud;
use serde_json::{Value, json};

use super::labels::LabelList;
use super::*;
use crate::LoadOptions;
use crate::frame::ObjectClass;
use crate::ground_truth::{GroundTruthRule, merged_objects};
use crate::pcd::{self, Encoding, IntensityField};

const T0_MICROS: u64 = 1_626_155_000_000_000;
const RULE: GroundTruthRule = GroundTruthRule {
    x_m: [-102.4, 102.4],
    y_m: [-51.2, 51.2],
    z_m: [-4.5, 2.5],
    comm_range_m: 100.0,
    ..GroundTruthRule::OPV2V
};

/// A data set of two pairs: vehicle frames 000010 and 000011, frames 000500 and 000501 of the unit, 100 ms apart.
///
/// The vehicle stands at (100, 200, 20) facing the world's y axis, its LiDAR 1.8 m above; the unit's LiDAR is at (130,
/// 200, 24) by its file, and 1.5 m farther in x and 0.5 m less in y by the pair's offset.
struct DataSet {
    dir: tempfile::TempDir,
    root: PathBuf,
}

impl DataSet {
    fn new(kind: Kind) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let set = Self {
            root: dir.path().join("cooperative-vehicle-infrastructure"),
            dir,
        };
        // Not in the order of time, unlike the index.
        set.write(
            "cooperative/data_info.json",
            &json!([set.pair(kind, 1), set.pair(kind, 0)]),
        );
        set.write(
            "vehicle-side/data_info.json",
            &json!([0, 1, 2].map(vehicle_capture)),
        );
        (0..2).for_each(|number| set.write_frames(kind, number));
        set
    }

    fn pair(&self, kind: Kind, number: u64) -> Value {
        let [vehicle, unit] = [
            format!("{:06}", 10 + number),
            format!("{:06}", 500 + number),
        ];
        let offset = json!({"delta_x": "1.5", "delta_y": -0.5});
        match kind {
            Kind::Dair => json!({
                "vehicle_image_path": format!("vehicle-side/image/{vehicle}.jpg"),
                "vehicle_pointcloud_path": format!("vehicle-side/velodyne/{vehicle}.pcd"),
                "infrastructure_image_path": format!("infrastructure-side/image/{unit}.jpg"),
                "infrastructure_pointcloud_path": format!("infrastructure-side/velodyne/{unit}.pcd"),
                "cooperative_label_path": format!("cooperative/label_world/{vehicle}.json"),
                "system_error_offset": offset,
            }),
            Kind::V2xSeq => json!({
                "vehicle_frame": vehicle, "infrastructure_frame": unit, "vehicle_sequence": "0003",
                "infrastructure_sequence": "0003", "system_error_offset": offset,
            }),
        }
    }

    fn write_frames(&self, kind: Kind, number: u64) {
        let [vehicle, unit] = [
            format!("{:06}", 10 + number),
            format!("{:06}", 500 + number),
        ];
        for (side, id, x) in [("vehicle", &vehicle, 1.0), ("infrastructure", &unit, 7.0)] {
            let cloud = PointCloud {
                xyzi: vec![[x, 2.0, -1.0, 51.0], [3.0, 4.0, -1.0, 255.0]],
            };
            let bytes = pcd::encode(&cloud, Encoding::Binary, IntensityField::Intensity);
            self.write_bytes(&format!("{side}-side/velodyne/{id}.pcd"), &bytes);
        }
        let unturned = json!([[1, 0, 0], [0, 1, 0], [0, 0, 1]]);
        self.write(
            &format!("vehicle-side/calib/lidar_to_novatel/{vehicle}.json"),
            &json!({"transform": {"rotation": unturned, "translation": [[0], [0], ["1.8"]]}}),
        );
        self.write(
            &format!("vehicle-side/calib/novatel_to_world/{vehicle}.json"),
            // Not exactly a rotation, as published ones.
            &json!({"rotation": [[0, -1.001, 0], [1.001, 0, 0], [0, 0, 1.001]], "translation": [[100], [200], [20]]}),
        );
        self.write(
            &format!("infrastructure-side/calib/virtuallidar_to_world/{unit}.json"),
            &json!({
                "rotation": unturned, "translation": [[130], [200], [24]],
                "relative_error": {"delta_x": 9.0, "delta_y": ""},
            }),
        );
        self.write(
            &format!("vehicle-side/label/lidar/{vehicle}.json"),
            &json!([label("Car", [10.0, 1.0, -1.0], 0.1)]),
        );
        // The vehicle's car seen from (131.5, 199.5, 24), and a truck of its own.
        let turned = 0.1 + std::f64::consts::FRAC_PI_2;
        let seen = json!([
            label("Car", [-32.5, 10.5, -3.2], turned),
            label("Truck", [10.0, 0.0, -2.0], 0.0)
        ]);
        self.write(
            &format!("infrastructure-side/label/virtuallidar/{unit}.json"),
            &seen,
        );
        match kind {
            Kind::Dair => self.write(
                &format!("cooperative/label_world/{vehicle}.json"),
                &json!([world_label()]),
            ),
            Kind::V2xSeq => {
                let mut car = label("Car", [30.0, 0.0, -0.8], 0.0);
                car["track_id"] = json!("004242");
                self.write(
                    &format!("cooperative/label/{vehicle}.json"),
                    &json!([car, label("Cyclist", [5.0, 5.0, -1.0], 0.0)]),
                );
            }
        }
    }

    fn write(&self, name: &str, value: &Value) {
        self.write_bytes(name, value.to_string().as_bytes());
    }

    fn write_bytes(&self, name: &str, bytes: &[u8]) {
        let path = self.root.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
    }

    fn remove(&self, name: &str) {
        fs::remove_file(self.root.join(name)).unwrap();
    }

    fn open(&self) -> Dataset {
        crate::open(&self.root).unwrap()
    }

    /// Messages below the root.
    fn shown(&self, messages: impl IntoIterator<Item = impl ToString>) -> Vec<String> {
        let root = format!("{}/", self.root.display());
        messages
            .into_iter()
            .map(|message| message.to_string().replace(&root, ""))
            .collect()
    }

    /// Problems of a frame.
    fn problems_of(&self, agent: usize) -> (Frame, Vec<String>) {
        let frame = self.open().scenarios[0]
            .load(agent, 0, &LoadOptions::default())
            .unwrap();
        let problems = self.shown(frame.problems.iter().map(|problem| &problem.message));
        (frame, problems)
    }
}

fn vehicle_capture(number: u64) -> Value {
    let frame = format!("{:06}", 10 + number);
    json!({
        "pointcloud_path": format!("velodyne/{frame}.pcd"), "frame_id": frame,
        "pointcloud_timestamp": (T0_MICROS + 100_000 * number).to_string(),
        "batch_id": "7", "sequence_id": "0003",
    })
}

fn label(kind: &str, [x, y, z]: [f64; 3], rotation: f64) -> Value {
    json!({
        "type": kind, "occluded_state": 0, "3d_dimensions": {"h": 1.5, "w": 1.9, "l": 4.4},
        // Text, as in labels that were made from images.
        "3d_location": {"x": x.to_string(), "y": y, "z": z}, "rotation": rotation.to_string(),
    })
}

/// A van of 4 x 2 x 1.5 m at (100, 230, 21) that faces y.
fn world_label() -> Value {
    let corners = [20.25, 21.75].map(|z: f64| {
        [
            [99.0, 232.0, z],
            [101.0, 232.0, z],
            [101.0, 228.0, z],
            [99.0, 228.0, z],
        ]
    });
    json!({"type": "Van", "world_8_points": corners.concat()})
}

fn close(found: [f64; 3], expected: [f64; 3]) -> bool {
    found
        .iter()
        .zip(expected)
        .all(|(found, expected)| (found - expected).abs() < 1e-9)
}

fn frames(scenario: &Scenario, tick: usize) -> Vec<Frame> {
    (0..2)
        .map(|agent| scenario.load(agent, tick, &LoadOptions::default()).unwrap())
        .collect()
}

#[test]
fn a_pair_is_a_tick_with_the_poses_of_both_sides() {
    let set = DataSet::new(Kind::Dair);
    let dataset = set.open();
    assert_eq!((dataset.layout, dataset.problems.len()), (Layout::DAIR, 0));
    let scenario = &dataset.scenarios[0];
    assert_eq!(
        (dataset.scenarios.len(), scenario.name.as_str()),
        (1, "batch_7")
    );
    assert_eq!(
        scenario
            .agents
            .iter()
            .map(CavId::as_str)
            .collect::<Vec<_>>(),
        ["vehicle", "infrastructure"]
    );
    assert_eq!(scenario.roadside_units, [scenario.agents[1].clone()]);
    let ticks: Vec<_> = scenario
        .ticks
        .iter()
        .map(|tick| (tick.stem.as_str(), tick.capture_nanos))
        .collect();
    assert_eq!(
        ticks,
        [("000010", 0), ("000011", 100_000_000)],
        "frame 000012 has no partner"
    );
    let [vehicle, unit] = &frames(scenario, 1)[..] else {
        panic!("two agents")
    };
    assert!(close(
        vehicle.world_from_lidar.unwrap().translation_m,
        [100.0, 200.0, 21.8]
    ));
    assert!((vehicle.world_from_lidar.unwrap().yaw_rad().to_degrees() - 90.0).abs() < 1e-9);
    assert!(close(
        vehicle.world_from_vehicle.unwrap().translation_m,
        [100.0, 200.0, 20.0]
    ));
    assert!(
        close(
            unit.world_from_lidar.unwrap().translation_m,
            [131.5, 199.5, 24.0]
        ),
        "the offset of the pair"
    );
    assert_eq!(
        (vehicle.capture_nanos, unit.capture_nanos),
        (100_000_000, 100_000_000)
    );
    assert_eq!(
        vehicle.points.xyzi,
        [[1.0, 2.0, -1.0, 0.2], [3.0, 4.0, -1.0, 1.0]]
    );
    assert_eq!(unit.points.xyzi[0][0], 7.0);
}

#[test]
fn cooperative_labels_are_the_ground_truth_of_a_pair() {
    let set = DataSet::new(Kind::Dair);
    let frames = frames(&set.open().scenarios[0], 0);
    for present in [frames.iter().collect::<Vec<_>>(), vec![&frames[0]]] {
        let merged = merged_objects(&present, 0, &RULE);
        let [(object, van)] = &merged[..] else {
            panic!("{merged:?}")
        };
        // 30 m ahead of the LiDAR, 0.8 m below it.
        assert!(
            object.id == 0
                && close(van.center_m, [30.0, 0.0, -0.8])
                && close(van.size_m, [4.0, 2.0, 1.5]),
            "{van:?}"
        );
        assert!(van.heading_rad.abs() < 1e-9);
    }
    assert_eq!(
        frames[0].cooperative_objects.as_ref().unwrap()[0].class,
        ObjectClass::Van
    );
    assert_eq!(
        (frames[0].objects.len(), frames[1].objects.len()),
        (1, 2),
        "each side has its own list as well"
    );
}

#[test]
fn without_cooperative_labels_both_sides_count_and_common_objects_once() {
    let set = DataSet::new(Kind::Dair);
    set.write_bytes(
        "cooperative/label_world/000010.json",
        b"[{\"type\": \"Van\",",
    );
    let (vehicle, problems) = set.problems_of(0);
    assert_eq!(problems.len(), 1);
    assert!(
        problems[0].starts_with("cooperative/label_world/000010.json:1: no sound JSON: EOF"),
        "{problems:?}"
    );
    assert_eq!(
        (vehicle.points.len(), vehicle.cooperative_objects.as_ref()),
        (2, None),
        "the frame is still read"
    );
    let (unit, _) = set.problems_of(1);
    let merged = merged_objects(&[&vehicle, &unit], 0, &RULE);
    let [(car, car_box), (truck, truck_box)] = &merged[..] else {
        panic!("{merged:?}")
    };
    assert_eq!(
        (car.id, truck.id),
        (LabelList::Vehicle.id(0), LabelList::Infrastructure.id(1))
    );
    assert!(close(car_box.center_m, [10.0, 1.0, -1.0]) && (car_box.heading_rad - 0.1).abs() < 1e-9);
    // The truck is at (141.5, 199.5, 22) in the world.
    assert!(
        close(truck_box.center_m, [-0.5, -41.5, 0.2]),
        "{truck_box:?}"
    );
    let seen_by_unit = merged_objects(&[&unit], 0, &RULE);
    assert!(
        close(seen_by_unit[0].1.center_m, [-32.5, 10.5, -3.2]),
        "{seen_by_unit:?}"
    );
}

#[test]
fn an_empty_cooperative_list_is_none_where_a_side_lists_objects() {
    let set = DataSet::new(Kind::Dair);
    set.write("cooperative/label_world/000010.json", &json!([]));
    let (vehicle, problems) = set.problems_of(0);
    assert_eq!(
        problems,
        [
            "cooperative/label_world/000010.json: no object, but the two sides list some: their lists are merged instead"
        ]
    );
    assert_eq!(vehicle.cooperative_objects, None);
    for side in [
        "vehicle-side/label/lidar/000010.json",
        "infrastructure-side/label/virtuallidar/000500.json",
    ] {
        set.write(side, &json!([]));
    }
    let (vehicle, problems) = set.problems_of(0);
    assert!(problems.is_empty(), "{problems:?}");
    assert_eq!(vehicle.cooperative_objects, Some(vec![]), "an empty road");
}

#[test]
fn sequences_have_track_ids_and_their_offset_in_the_frame_of_the_vehicle() {
    let set = DataSet::new(Kind::V2xSeq);
    let dataset = set.open();
    assert_eq!(
        (dataset.layout, dataset.problems.len()),
        (Layout::V2XSEQ, 0)
    );
    let scenario = &dataset.scenarios[0];
    assert_eq!(
        (scenario.name.as_str(), scenario.ticks.len()),
        ("sequence_0003", 2)
    );
    let frames = frames(scenario, 1);
    // (0, -30, 2.2) in the LiDAR frame of the vehicle, and the offset (1.5, -0.5) there: (30.5, 1.5) in the world.
    assert!(close(
        frames[1].world_from_lidar.unwrap().translation_m,
        [130.5, 201.5, 24.0]
    ));
    let frames_of_tick: Vec<&Frame> = frames.iter().collect();
    let merged = merged_objects(&frames_of_tick, 0, &RULE);
    let [(object, car)] = &merged[..] else {
        panic!("cyclists are no vehicles: {merged:?}")
    };
    assert_eq!(object.id, 4242);
    assert!(close(car.center_m, [30.0, 0.0, -0.8]) && close(car.size_m, [4.4, 1.9, 1.5]));
    assert_eq!(
        frames[0].cooperative_objects.as_ref().unwrap()[1].class,
        ObjectClass::TwoWheeler
    );
}

#[test]
fn missing_files_are_absent_and_reported() {
    let set = DataSet::new(Kind::Dair);
    set.remove("infrastructure-side/velodyne/000500.pcd");
    set.remove("vehicle-side/calib/novatel_to_world/000011.json");
    set.remove("vehicle-side/label/lidar/000010.json");
    let dataset = set.open();
    let expected = [
        "infrastructure-side/velodyne/000500.pcd: does not exist: infrastructure is absent at 000010",
        "vehicle-side/calib/novatel_to_world/000011.json: does not exist: vehicle is absent at 000011",
    ];
    assert_eq!(set.shown(&dataset.problems), expected);
    let scenario = &dataset.scenarios[0];
    assert_eq!(
        (
            scenario.ticks.len(),
            scenario.is_present(0, 0),
            scenario.is_present(1, 0)
        ),
        (1, true, false)
    );
    assert!(
        scenario
            .load(1, 0, &LoadOptions::default())
            .unwrap_err()
            .is_absent()
    );
    let (frame, problems) = set.problems_of(0);
    assert!(
        problems[0].starts_with("vehicle-side/label/lidar/000010.json: No such file"),
        "{problems:?}"
    );
    assert_eq!(
        (
            frame.objects.len(),
            frame.cooperative_objects.unwrap().len()
        ),
        (0, 1)
    );
}

#[test]
fn labels_that_cannot_be_right_are_left_out_one_by_one() {
    let set = DataSet::new(Kind::Dair);
    let mut flat = label("Car", [5.0, 0.0, 0.0], 0.0);
    flat["3d_dimensions"]["h"] = json!(0);
    let mut huge = label("Bus", [5.0, 0.0, 0.0], 0.0);
    huge["3d_dimensions"]["l"] = json!(1e6);
    let mut nowhere = label("Car", [5.0, 0.0, 0.0], 0.0);
    nowhere["3d_location"]["y"] = json!("left");
    let turned = label("Car", [5.0, 0.0, 0.0], 178.5);
    set.write(
        "vehicle-side/label/lidar/000010.json",
        &json!([
            flat,
            huge,
            nowhere,
            turned,
            label("Spaceship", [1.0, 2.0, 0.0], 0.0),
            3
        ]),
    );
    let mut crumpled = world_label();
    crumpled["world_8_points"][0] = json!([50.0, 232.0, 20.25]);
    let mut cut = world_label();
    cut["world_8_points"].as_array_mut().unwrap().pop();
    set.write(
        "cooperative/label_world/000010.json",
        &json!([crumpled, cut, world_label()]),
    );
    let (frame, problems) = set.problems_of(0);
    let own = "vehicle-side/label/lidar/000010.json: ";
    assert_eq!(
        problems[..5],
        [
            format!("{own}1.3d_dimensions: [1000000.0, 1.9, 1.5] are no sizes in metres, expected up to 200: the object is left out"),
            format!("{own}2.3d_location.y: the text \"left\", expected a finite number: the object is left out"),
            format!("{own}3.rotation: 178.5 rad, expected -2 pi to 2 pi: degrees?: the object is left out"),
            "vehicle-side/label/lidar: type: \"Spaceship\" is an unknown type of object: it counts as other, not as a vehicle".into(),
            format!("{own}5: 3, expected a map: the object is left out"),
        ]
    );
    let cooperative = "cooperative/label_world/000010.json: ";
    assert!(
        problems[5].starts_with(&format!("{cooperative}0.world_8_points: no box: cosines")),
        "{problems:?}"
    );
    assert_eq!(
        problems[6],
        format!("{cooperative}1.world_8_points: 21 numbers, expected 24: the object is left out")
    );
    assert_eq!(frame.objects[0].class, ObjectClass::Other);
    assert_eq!(
        (
            frame.objects.len(),
            frame.cooperative_objects.unwrap()[0].id
        ),
        (1, 2)
    );
}

#[test]
fn objects_without_a_track_have_numbers_above_all_tracks() {
    let set = DataSet::new(Kind::V2xSeq);
    let tracked = |x: f64, track: u64| {
        let mut car = label("Car", [x, 0.0, -1.0], 0.0);
        car["track_id"] = json!(track);
        car
    };
    let untracked = label("Car", [30.0, 0.0, -1.0], 0.0);
    set.write(
        "cooperative/label/000010.json",
        &json!([
            tracked(10.0, 1),
            untracked,
            tracked(20.0, 7),
            tracked(40.0, 7)
        ]),
    );
    let (frame, problems) = set.problems_of(0);
    let objects = frame.cooperative_objects.unwrap();
    let ids: Vec<i64> = objects.iter().map(|object| object.id).collect();
    assert_eq!(ids, [1, 9, 7]);
    let [problem] = &problems[..] else {
        panic!("{problems:?}")
    };
    assert!(
        problem.starts_with("cooperative/label/000010.json: object 7: at ")
            && problem.contains(", with the id or the box of object 7 at ")
            && problem.ends_with(": the object is left out"),
        "{problem}"
    );
}

#[test]
fn either_order_of_corners_is_the_same_box() {
    let set = DataSet::new(Kind::Dair);
    let mut mirrored = world_label();
    for (a, b) in [(0, 1), (2, 3), (4, 5), (6, 7)] {
        mirrored["world_8_points"]
            .as_array_mut()
            .unwrap()
            .swap(a, b);
    }
    let [a, b] = [mirrored, world_label()].map(|label| {
        set.write("cooperative/label_world/000010.json", &json!([label]));
        set.problems_of(0).0.cooperative_objects.unwrap()[0].world_from_object
    });
    assert!(close(a.translation_m, b.translation_m) && (a.yaw_rad() - b.yaw_rad()).abs() < 1e-9);
    assert!((a.yaw_rad().to_degrees() - 90.0).abs() < 1e-9);
}

#[test]
fn calibrations_that_are_none_are_named() {
    let set = DataSet::new(Kind::Dair);
    let name = "infrastructure-side/calib/virtuallidar_to_world/000500.json";
    for (calibration, expected) in [
        (
            json!({"rotation": [[1, 0, 0], [0, -1, 0], [0, 0, 1]], "translation": [1, 2, 3]}),
            "no rotation: off orthonormal by 0.000, determinant -1.000, expected at most 0.05 and 1",
        ),
        (json!({"rotation": [1, 2, 3]}), "3 numbers, expected 9"),
        (json!({}), "missing"),
    ] {
        set.write(name, &calibration);
        let error = set.open().scenarios[0]
            .load(1, 0, &LoadOptions::default())
            .unwrap_err();
        assert_eq!(
            set.shown([error]),
            [format!("{name}: rotation: {expected}")]
        );
    }
}

#[test]
fn the_offset_of_the_calibration_counts_where_the_pair_has_none() {
    let set = DataSet::new(Kind::Dair);
    let mut pair = set.pair(Kind::Dair, 0);
    pair.as_object_mut().unwrap().remove("system_error_offset");
    set.write("cooperative/data_info.json", &json!([pair]));
    let unit = set.problems_of(1).0;
    assert!(close(
        unit.world_from_lidar.unwrap().translation_m,
        [139.0, 200.0, 24.0]
    ));
}

#[test]
fn it_is_found_from_its_root_and_from_above_and_parts_point_to_it() {
    let set = DataSet::new(Kind::Dair);
    let above = crate::open(set.dir.path()).unwrap();
    assert_eq!(
        above.scenarios[0].name,
        "cooperative-vehicle-infrastructure/batch_7"
    );
    let renamed = set.dir.path().join("any name");
    fs::rename(&set.root, &renamed).unwrap();
    assert_eq!(crate::open(&renamed).unwrap().layout, Layout::DAIR);
    let error = crate::open(&renamed.join("vehicle-side"))
        .unwrap_err()
        .to_string();
    assert!(
        error.ends_with(&format!(
            "this is a part of a DAIR-V2X data set: open {}",
            renamed.display()
        )),
        "{error}"
    );
}

#[test]
fn pairs_that_cannot_be_used_are_left_out() {
    let set = DataSet::new(Kind::Dair);
    let mut elsewhere = set.pair(Kind::Dair, 1);
    elsewhere["vehicle_pointcloud_path"] = json!("vehicle-side/velodyne/...pcd");
    let mut unknown = set.pair(Kind::Dair, 1);
    unknown["vehicle_pointcloud_path"] = json!("vehicle-side/velodyne/000099.pcd");
    let first = set.pair(Kind::Dair, 0);
    set.write(
        "cooperative/data_info.json",
        &json!([first, elsewhere, first, unknown, {}]),
    );
    let dataset = set.open();
    let index = "cooperative/data_info.json: ";
    assert_eq!(
        set.shown(&dataset.problems),
        [
            format!(
                "{index}1.vehicle_pointcloud_path: \"..\" is no id of a frame: expected up to 64 letters, digits, _ and -"
            ),
            format!("{index}2: vehicle frame 000010 is in a pair already"),
            format!("{index}4.vehicle_pointcloud_path: missing"),
            "vehicle-side/data_info.json: no time stamp of vehicle frame 000099: the pair is left out"
                .into(),
        ]
    );
    assert_eq!(dataset.scenarios[0].ticks.len(), 1);
    set.write("cooperative/data_info.json", &json!([]));
    let error = set.shown([crate::open(&set.root).unwrap_err()]).remove(0);
    assert_eq!(
        error,
        format!(
            "{index}lists no pair of frames of vehicle and roadside unit that can be read (DAIR-V2X)"
        )
    );
}

#[test]
fn pairs_of_two_times_are_left_out() {
    let set = DataSet::new(Kind::Dair);
    let capture = |frame: &str, micros: u64| {
        json!({
            "pointcloud_path": format!("velodyne/{frame}.pcd"),
            "pointcloud_timestamp": micros.to_string(),
        })
    };
    let of_unit = |times: [u64; 2]| {
        let [first, second] = times;
        let captures = json!([capture("000500", first), capture("000501", second)]);
        set.write("infrastructure-side/data_info.json", &captures);
        let dataset = set.open();
        (
            dataset.scenarios[0].ticks.len(),
            set.shown(&dataset.problems),
        )
    };
    let expected = "cooperative/data_info.json: vehicle frame 000011 at 1626155000.100 s with frame 000501 of the unit \
                    at 1626155001.100 s, expected at most 0.2 s apart: the pair is left out";
    assert_eq!(
        of_unit([T0_MICROS + 30_000, T0_MICROS + 1_100_000]),
        (1, vec![expected.to_owned()])
    );
    // Each with the frame of the unit before it.
    let expected = "cooperative/data_info.json: the frames of a pair are 0.100 s apart in the median, expected less than \
                    0.075 s: pairs one frame off, or clocks that differ";
    assert_eq!(
        of_unit([T0_MICROS - 100_000, T0_MICROS]),
        (2, vec![expected.to_owned()])
    );
    for sound in [
        [T0_MICROS + 30_000, T0_MICROS + 60_000],
        // A clock of its own.
        [7_000_000, 7_100_000],
    ] {
        assert_eq!(of_unit(sound), (2, vec![]));
    }
}

#[test]
fn without_time_stamps_frames_are_evenly_spaced() {
    let set = DataSet::new(Kind::Dair);
    set.write("vehicle-side/data_info.json", &json!([]));
    let dataset = set.open();
    let scenario = &dataset.scenarios[0];
    let times: Vec<u64> = scenario
        .ticks
        .iter()
        .map(|tick| tick.capture_nanos)
        .collect();
    assert_eq!(
        (scenario.name.as_str(), times),
        ("batch", vec![0, 100_000_000])
    );
    assert_eq!(
        scenario.ticks[0].stem, "000011",
        "in the order of the pairs"
    );
    assert!(
        set.shown(&dataset.problems)[0].starts_with("vehicle-side/data_info.json: no time stamps")
    );
}

/// All files of the data set that are JSON.
const JSON_FILES: [&str; 8] = [
    "cooperative/data_info.json",
    "vehicle-side/data_info.json",
    "vehicle-side/calib/lidar_to_novatel/000010.json",
    "vehicle-side/calib/novatel_to_world/000010.json",
    "infrastructure-side/calib/virtuallidar_to_world/000500.json",
    "vehicle-side/label/lidar/000010.json",
    "infrastructure-side/label/virtuallidar/000500.json",
    "cooperative/label_world/000010.json",
];

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn damaged_files_never_panic(file in 0..JSON_FILES.len(), at in 0.0..1.0f64, bytes in prop::collection::vec(any::<u8>(), 0..4)) {
        let set = DataSet::new(Kind::Dair);
        let path = set.root.join(JSON_FILES[file]);
        let mut text = fs::read(&path).unwrap();
        let start = (text.len() as f64 * at) as usize;
        let end = (start + bytes.len().max(1)).min(text.len());
        text.splice(start..end, bytes);
        fs::write(&path, text).unwrap();
        for scenario in crate::open(&set.root).map(|dataset| dataset.scenarios).unwrap_or_default() {
            for (agent, tick) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                let _ = scenario.load(agent, tick, &LoadOptions::default());
            }
        }
    }
}
