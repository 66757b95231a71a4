use std::fs;

use proptest::prelude::*;
use protocol::{PointCloud, Pose};
use serde_json::{Value, json};

use super::*;
use crate::LoadOptions;
use crate::ground_truth::{GroundTruthRule, merged_objects};
use crate::pcd::{Encoding, IntensityField, encode};
use crate::points::tests::turn;

const RULE: GroundTruthRule = GroundTruthRule {
    x_m: [-32.0, 32.0],
    y_m: [-32.0, 32.0],
    z_m: [-4.0, 2.0],
    comm_range_m: 70.0,
    ..GroundTruthRule::OPV2V
};
const T0_MICROS: u64 = 1_696_454_482_883_182;

/// A LiDAR of the set: its channel, its vehicle's position and heading, its mount's heading, and its points.
struct Rig {
    channel: &'static str,
    position_m: [f64; 3],
    heading_degrees: f64,
    mount_degrees: f64,
    points: Vec<[f32; 5]>,
}

/// A data set of one scene with two samples 200 ms apart, and the annotations of both.
struct DataSet {
    dir: tempfile::TempDir,
    version: &'static str,
}

impl DataSet {
    fn new(version: &'static str, rigs: &[Rig], annotations: &[(&str, Value)]) -> Self {
        let set = Self {
            dir: tempfile::tempdir().unwrap(),
            version,
        };
        let mut sensors: Vec<Value> = (rigs.iter().enumerate())
            .map(|(index, rig)| {
                let token = format!("sensor{index}");
                json!({"token": token, "channel": rig.channel, "modality": "lidar"})
            })
            .collect();
        sensors.push(json!({"token": "camera", "channel": "CAM_FRONT", "modality": "camera"}));
        set.table("sensor", json!(sensors));
        let mut mounts: Vec<Value> = (rigs.iter().enumerate())
            .map(|(index, rig)| {
                json!({
                    "token": format!("mount{index}"), "sensor_token": format!("sensor{index}"), "camera_intrinsic": [],
                    "translation": [0.5, 0, 2], "rotation": quaternion(rig.mount_degrees),
                })
            })
            .collect();
        mounts.push(json!({"token": "mount_camera", "sensor_token": "camera", "translation": [], "rotation": []}));
        set.table("calibrated_sensor", json!(mounts));
        set.table(
            "scene",
            json!([{"token": "scene", "name": "scene_5", "vehicle_list": ["mike", "maisy"]}]),
        );
        // Not in the order of time.
        let samples = [1_u64, 0].map(|number| {
            json!({
                "token": number.to_string(), "scene_token": "scene",
                "timestamp": T0_MICROS + 200_000 * number,
            })
        });
        set.table("sample", json!(samples));
        let (mut data, mut poses) = (Vec::new(), Vec::new());
        for number in 0..2 {
            for (index, rig) in rigs.iter().enumerate() {
                let pose = format!("pose{number}_{index}");
                let file = format!("sweeps/{}/scene_5_{number:06}.pcd.bin", rig.channel);
                set.write(
                    &file,
                    &rig.points
                        .iter()
                        .flatten()
                        .flat_map(|value| value.to_le_bytes())
                        .collect::<Vec<u8>>(),
                );
                data.push(json!({
                    "token": pose, "sample_token": number.to_string(), "ego_pose_token": pose, "is_key_frame": true,
                    "calibrated_sensor_token": format!("mount{index}"), "filename": file, "timestamp": 0,
                }));
                poses.push(json!({
                    "token": pose, "translation": rig.position_m, "rotation": quaternion(rig.heading_degrees), "timestamp": 0,
                }));
            }
            data.push(json!({"token": "c", "calibrated_sensor_token": "mount_camera", "is_key_frame": true}));
            // A sweep between two samples, and a pose that is not needed.
            data.push(
                json!({"token": "s", "calibrated_sensor_token": "mount0", "is_key_frame": false}),
            );
            poses.push(json!({"token": "c"}));
        }
        set.table("sample_data", json!(data));
        set.table("ego_pose", json!(poses));
        set.annotate(annotations);
        set
    }

    fn annotate(&self, annotations: &[(&str, Value)]) {
        let names = annotations
            .iter()
            .map(|(name, _)| json!({"token": format!("c_{name}"), "name": name}));
        self.table("category", json!(names.collect::<Vec<_>>()));
        let instances = annotations.iter().enumerate();
        let instances = instances
            .map(|(index, (name, _))| json!({"token": format!("i{index}"), "category_token": format!("c_{name}")}));
        self.table("instance", json!(instances.collect::<Vec<_>>()));
        let mut rows = Vec::new();
        for sample in ["0", "1"] {
            for (index, (_, place)) in annotations.iter().enumerate() {
                let mut row = place.clone();
                row["sample_token"] = json!(sample);
                row["instance_token"] = json!(format!("i{index}"));
                rows.push(row);
            }
        }
        self.table("sample_annotation", json!(rows));
    }

    fn table(&self, name: &str, rows: Value) {
        self.write(
            &format!("{}/{name}.json", self.version),
            rows.to_string().as_bytes(),
        );
    }

    /// The rows of a table that was written.
    fn rows(&self, name: &str) -> Vec<Value> {
        let path = self.dir.path().join(self.version);
        let text = fs::read(path.join(format!("{name}.json"))).unwrap();
        serde_json::from_slice(&text).unwrap()
    }

    /// Adds a third sample, 200 ms after the second, with a sweep of the second LiDAR in `file`.
    fn add_sample(&self, file: &str) {
        let mut samples = self.rows("sample");
        samples
            .push(json!({"token": "2", "scene_token": "scene", "timestamp": T0_MICROS + 400_000}));
        self.table("sample", json!(samples));
        let mut data = self.rows("sample_data");
        data.push(json!({
            "token": "third", "sample_token": "2", "ego_pose_token": "pose1_1", "is_key_frame": true,
            "calibrated_sensor_token": "mount1", "filename": file, "timestamp": 0,
        }));
        self.table("sample_data", json!(data));
    }

    fn write(&self, name: &str, bytes: &[u8]) {
        let path = self.dir.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
    }

    fn open(&self) -> Dataset {
        crate::open(self.dir.path()).unwrap()
    }

    /// The error of opening.
    fn refusal(&self) -> String {
        let error = crate::open(self.dir.path()).unwrap_err().to_string();
        error.replace(&format!("{}/", self.dir.path().display()), "")
    }

    fn problems(&self, dataset: &Dataset) -> Vec<String> {
        let root = format!("{}/", self.dir.path().display());
        dataset
            .problems
            .iter()
            .map(|problem| problem.to_string().replace(&root, ""))
            .collect()
    }
}

fn quaternion(degrees: f64) -> [f64; 4] {
    // The negative one is the same rotation; Open MARS has it.
    Pose::from_xyz_yaw([0.0; 3], degrees.to_radians())
        .rotation_wxyz
        .map(|part| -part)
}

fn place(translation_m: [f64; 3], size_wlh: [f64; 3], degrees: f64) -> Value {
    json!({"translation": translation_m, "size": size_wlh, "rotation": quaternion(degrees)})
}

/// A LiDAR that faces as its vehicle.
fn aligned_rig(
    channel: &'static str,
    position_m: [f64; 3],
    heading_degrees: f64,
    points: Vec<[f32; 5]>,
) -> Rig {
    Rig {
        channel,
        position_m,
        heading_degrees,
        mount_degrees: 0.0,
        points,
    }
}

/// Vehicle 1 at (10, 20) faces y, vehicle 2 at (10, 50) faces x, the unit's LiDAR is at (0.5, 0, 2).
fn v2x_sim() -> DataSet {
    DataSet::new(
        "v1.0-mini",
        &[
            aligned_rig(
                "LIDAR_TOP_id_0",
                [0.0; 3],
                0.0,
                vec![[30.0, 0.0, -1.0, 0.1, 3.0]],
            ),
            // On the car, on its own roof, on the pedestrian.
            aligned_rig(
                "LIDAR_TOP_id_1",
                [10.0, 20.0, 0.0],
                90.0,
                vec![
                    [19.5, 0.5, -1.25, 0.5, 7.0],
                    [0.2, 0.0, -0.6, 0.2, 1.0],
                    [4.5, 0.0, -1.0, 0.3, 2.0],
                ],
            ),
            // On the motorcycle.
            aligned_rig(
                "LIDAR_TOP_id_2",
                [10.0, 50.0, 0.0],
                0.0,
                vec![[9.5, 0.0, -1.2, 0.5, 7.0]],
            ),
        ],
        &[
            (
                "vehicle.audi.tt",
                place([10.0, 40.0, 0.75], [2.0, 4.0, 1.5], 90.0),
            ),
            (
                "vehicle.car",
                place([10.0, 20.0, 0.75], [2.0, 4.0, 1.5], 90.0),
            ),
            (
                "human.pedestrian.adult",
                place([10.0, 25.0, 0.9], [0.6, 0.6, 1.8], 0.0),
            ),
            (
                "vehicle.narrow.one",
                place([20.0, 50.0, 0.8], [0.8, 2.0, 1.6], 0.0),
            ),
            // Not hit by any sweep.
            (
                "vehicle.truck",
                place([-5.0, 20.0, 1.5], [2.5, 8.0, 3.0], 0.0),
            ),
        ],
    )
}

fn close(found: [f64; 3], expected: [f64; 3]) -> bool {
    found
        .iter()
        .zip(expected)
        .all(|(found, expected)| (found - expected).abs() < 1e-9)
}

fn load(scenario: &Scenario, tick: usize) -> Vec<Frame> {
    scenario
        .present_agents(tick)
        .map(|agent| scenario.load(agent, tick, &LoadOptions::default()).unwrap())
        .collect()
}

#[test]
fn v2x_sim_has_numbered_vehicles_and_a_roadside_unit() {
    let dataset = v2x_sim().open();
    assert_eq!(
        (dataset.layout, dataset.problems.len()),
        (Layout::V2XSIM, 0),
        "{:?}",
        dataset.problems
    );
    let scenario = &dataset.scenarios[0];
    assert_eq!(scenario.name, "v1.0-mini/scene_5");
    assert_eq!(
        scenario
            .agents
            .iter()
            .map(CavId::as_str)
            .collect::<Vec<_>>(),
        ["1", "2", "0"]
    );
    assert_eq!(scenario.roadside_units, [scenario.agents[2].clone()]);
}

#[test]
fn samples_are_ticks_with_poses_and_five_floats_per_point() {
    let set = v2x_sim();
    let scenario = &set.open().scenarios[0];
    let ticks: Vec<_> = scenario
        .ticks
        .iter()
        .map(|tick| (tick.stem.as_str(), tick.capture_nanos))
        .collect();
    assert_eq!(
        ticks,
        [("scene_5_000000", 0), ("scene_5_000001", 200_000_000)]
    );
    let frames = load(scenario, 1);
    let ego = frames[0].world_from_lidar.unwrap();
    assert!(
        close(ego.translation_m, [10.0, 20.5, 2.0])
            && (ego.yaw_rad().to_degrees() - 90.0).abs() < 1e-9
    );
    assert!(close(
        frames[0].world_from_vehicle.unwrap().translation_m,
        [10.0, 20.0, 0.0]
    ));
    assert!(close(
        frames[1].world_from_lidar.unwrap().translation_m,
        [10.5, 50.0, 2.0]
    ));
    assert_eq!(
        frames[0].points.xyzi[..2],
        [[19.5, 0.5, -1.25, 0.5], [0.2, 0.0, -0.6, 0.2]]
    );
    assert_eq!(frames[0].capture_nanos, 200_000_000);
}

/// The file of a sweep of vehicle 1.
fn sweep_file(sample: usize) -> String {
    format!("sweeps/LIDAR_TOP_id_1/scene_5_{sample:06}.pcd.bin")
}

#[test]
fn sweeps_of_four_floats_per_point_are_read_as_such() {
    let set = v2x_sim();
    let four = turn(400, |index| vec![(index % 101) as f32 / 100.0]);
    for sample in 0..2 {
        set.write(&sweep_file(sample), &four);
    }
    let dataset = set.open();
    let cloud = dataset.scenarios[0].load_points(0, 1, None).unwrap();
    assert_eq!(
        (cloud.form, cloud.points.len()),
        ("4 floats per point: x y z intensity", 400)
    );
    assert_eq!(cloud.points.xyzi[50][3], 0.5);
}

#[test]
fn sweeps_may_be_pcd_files() {
    let set = v2x_sim();
    let xyzi = vec![[4.0, 1.0, -1.0, 0.5], [6.0, -2.0, 0.5, 0.25]];
    let cloud = PointCloud { xyzi };
    let file = encode(&cloud, Encoding::Binary, IntensityField::Intensity);
    let mut data = set.rows("sample_data");
    for row in &mut data {
        let name = row["filename"].as_str().map(str::to_owned);
        if let Some(name) = name.as_deref().and_then(|name| name.strip_suffix(".bin")) {
            set.write(name, &file);
            row["filename"] = json!(name);
        }
    }
    set.table("sample_data", json!(data));
    let dataset = set.open();
    assert!(dataset.problems.is_empty(), "{:?}", dataset.problems);
    assert_eq!(dataset.scenarios[0].ticks[1].stem, "scene_5_000001");
    for frame in load(&dataset.scenarios[0], 1) {
        assert_eq!(frame.points, cloud, "{}", frame.cav);
    }
}

#[test]
fn a_sweep_of_four_floats_among_those_of_five_is_refused() {
    let set = v2x_sim();
    set.add_sample(&sweep_file(2));
    let five = turn(400, |index| vec![0.5, (index % 32) as f32]);
    let four = turn(400, |_| vec![0.5]);
    for (sample, bytes) in [&five, &four, &five].into_iter().enumerate() {
        set.write(&sweep_file(sample), bytes);
    }
    let dataset = set.open();
    let read = |tick| dataset.scenarios[0].load_points(0, tick, None);
    for tick in [0, 2] {
        assert_eq!(read(tick).unwrap().points.len(), 400, "{tick}");
    }
    let message = read(1).unwrap_err().to_string();
    let expected = format!(
        "{}: it looks like 4 floats per point, the first sweeps of this agent have 5",
        sweep_file(1)
    );
    assert!(message.ends_with(&expected), "{message}");
}

fn listed(frame: &Frame) -> Vec<(i64, ObjectClass)> {
    frame
        .objects
        .iter()
        .map(|object| (object.id, object.class))
        .collect()
}

#[test]
fn agents_list_what_their_sweeps_hit_but_not_themselves() {
    let set = v2x_sim();
    let frames = load(&set.open().scenarios[0], 0);
    assert_eq!(
        listed(&frames[0]),
        [(0, ObjectClass::Car), (2, ObjectClass::Pedestrian)]
    );
    assert_eq!(
        listed(&frames[1]),
        [(3, ObjectClass::TwoWheeler)],
        "narrower than 1.5 m"
    );
    assert!(listed(&frames[2]).is_empty());
    let frames: Vec<&Frame> = frames.iter().collect();
    let merged = merged_objects(&frames, 0, &RULE);
    let [(Object { id: 0, .. }, car)] = &merged[..] else {
        panic!("{merged:?}")
    };
    assert!(
        close(car.center_m, [19.5, 0.0, -1.25]) && close(car.size_m, [4.0, 2.0, 1.5]),
        "{car:?}"
    );
    assert!(car.heading_rad.abs() < 1e-9);
}

#[test]
fn a_missing_sweep_is_an_absent_agent_and_the_egos_a_missing_tick() {
    let set = v2x_sim();
    fs::remove_file(
        set.dir
            .path()
            .join("sweeps/LIDAR_TOP_id_2/scene_5_000000.pcd.bin"),
    )
    .unwrap();
    fs::remove_file(
        set.dir
            .path()
            .join("sweeps/LIDAR_TOP_id_1/scene_5_000001.pcd.bin"),
    )
    .unwrap();
    let dataset = set.open();
    assert_eq!(
        set.problems(&dataset),
        [
            "sweeps/LIDAR_TOP_id_2/scene_5_000000.pcd.bin: does not exist: agent 2 is absent at scene_5_000000",
            "sweeps/LIDAR_TOP_id_1/scene_5_000001.pcd.bin: does not exist: agent 1 is absent at scene_5_000001",
        ]
    );
    let scenario = &dataset.scenarios[0];
    assert_eq!(
        (
            scenario.ticks.len(),
            scenario.present_agents(0).collect::<Vec<_>>()
        ),
        (1, vec![0, 2])
    );
}

#[test]
fn mars_names_its_vehicles_and_has_no_annotations() {
    let rigs = [
        ("LIDAR_FRONT_CENTER_maisy", 20.0),
        ("LIDAR_FRONT_CENTER_mike", -146.0),
    ]
    .map(|(channel, x)| Rig {
        channel,
        position_m: [x, 0.0, 0.0],
        heading_degrees: 180.0,
        mount_degrees: -2.0,
        points: vec![[3.0, -6.0, -1.5, 9.0, 4.0], [5.0, -8.0, -0.3, 204.0, 53.0]],
    });
    let set = DataSet::new("v1.0", &rigs, &[]);
    let dataset = set.open();
    assert_eq!(
        (dataset.layout, dataset.problems.len()),
        (Layout::MARS, 0),
        "{:?}",
        dataset.problems
    );
    let scenario = &dataset.scenarios[0];
    assert_eq!(
        scenario
            .agents
            .iter()
            .map(CavId::as_str)
            .collect::<Vec<_>>(),
        ["mike", "maisy"],
        "as the scene lists them"
    );
    assert!(scenario.roadside_units.is_empty());
    let frames = load(scenario, 0);
    let pose = frames[0].world_from_lidar.unwrap();
    assert!(
        close(pose.translation_m, [-146.5, 0.0, 2.0])
            && (pose.yaw_rad().to_degrees() - 178.0).abs() < 1e-9
    );
    assert_eq!(
        (frames[0].points.xyzi[1], frames[0].objects.len()),
        ([5.0, -8.0, -0.3, 0.8], 0),
        "intensities to 255"
    );
    // Releases without the tables of annotations open as well.
    for table in ["sample_annotation", "instance", "category"] {
        fs::remove_file(set.dir.path().join(format!("v1.0/{table}.json"))).unwrap();
    }
    assert!(set.open().problems.is_empty());
}

#[test]
fn nuscenes_is_turned_so_that_x_points_ahead() {
    let rig = Rig {
        channel: "LIDAR_TOP",
        position_m: [100.0, 200.0, 0.0],
        heading_degrees: 0.0,
        mount_degrees: -90.0,
        // 10 m ahead of the LiDAR: its y.
        points: vec![[1.0, 10.0, -1.25, 0.5, 7.0]],
    };
    let set = DataSet::new(
        "v1.0-mini",
        &[rig],
        &[(
            "vehicle.bus.rigid",
            place([110.5, 199.0, 1.5], [3.0, 12.0, 3.0], 0.0),
        )],
    );
    let dataset = set.open();
    assert_eq!(
        (dataset.layout, dataset.scenarios[0].agents[0].as_str()),
        (Layout::NUSCENES, "0")
    );
    let frame = &load(&dataset.scenarios[0], 0)[0];
    assert_eq!(frame.points.xyzi, [[10.0, -1.0, -1.25, 0.5]]);
    assert!(frame.world_from_lidar.unwrap().yaw_rad().abs() < 1e-9);
    let merged = merged_objects(&[frame], 0, &RULE);
    assert!(
        close(merged[0].1.center_m, [10.0, -1.0, -0.5]),
        "{merged:?}"
    );
}

#[test]
fn rows_that_cannot_be_used_are_left_out_one_by_one() {
    let set = v2x_sim();
    let mut rows = set.rows("sample_annotation");
    rows[0]["size"] = json!([2.0, 4.0, -1.5]);
    rows[1]["instance_token"] = json!("nobody");
    rows[2]["rotation"] = json!([1.0, 1.0, 0.0, 0.0]);
    set.table("sample_annotation", json!(rows));
    let mut data = set.rows("sample_data");
    data[1]["filename"] = json!("../elsewhere.pcd.bin");
    set.table("sample_data", json!(data));
    let dataset = set.open();
    let table = "v1.0-mini/sample_annotation.json: ";
    assert_eq!(
        set.problems(&dataset),
        [
            "v1.0-mini/sample_data.json: 1.filename: \"../elsewhere.pcd.bin\", expected a path below the data set"
                .into(),
            format!("{table}0.size: [2.0, 4.0, -1.5] are no sizes in metres, expected up to 200"),
            format!("{table}1.instance_token: no row of instance.json has this token"),
            format!("{table}2: quaternion of length 1.414, expected 1"),
        ]
    );
    assert_eq!(
        dataset.scenarios[0].ticks.len(),
        1,
        "the ego has no sweep at the first sample"
    );
}

#[test]
fn an_instance_that_a_sample_lists_twice_is_left_out_once() {
    let set = v2x_sim();
    let mut rows = set.rows("sample_annotation");
    let mut again = rows[0].clone();
    again["translation"][0] = json!(-60.0);
    rows.push(again);
    set.table("sample_annotation", json!(rows));
    let dataset = set.open();
    let [first, second] = [0, 1].map(|tick| load(&dataset.scenarios[0], tick).remove(0));
    let [problem] = &first.problems[..] else {
        panic!("{:?}", first.problems)
    };
    assert!(
        problem.message.ends_with(
            "v1.0-mini/sample_annotation.json: object 0: at [-60.00, 40.00, 0.75] m, with the id or the box of object \
             0 at [10.00, 40.00, 0.75] m: the object is left out"
        ),
        "{problem}"
    );
    assert!(second.problems.is_empty());
    assert_eq!(first.objects, second.objects, "the first one stays");
}

#[test]
fn of_several_sweeps_of_a_sample_the_nearest_in_time_is_used() {
    let set = v2x_sim();
    let mut data = set.rows("sample_data");
    for row in data.iter_mut().filter(|row| !row["sample_token"].is_null()) {
        let number: u64 = row["sample_token"].as_str().unwrap().parse().unwrap();
        row["timestamp"] = json!(T0_MICROS + 200_000 * number);
    }
    // Another sweep of vehicle 1 at the second sample, 50 ms after it, with a pose of its own.
    let mut later = data.last().unwrap().clone();
    later["token"] = json!("later");
    for (key, value) in [
        ("sample_token", json!("1")),
        ("ego_pose_token", json!("later")),
        ("calibrated_sensor_token", json!("mount1")),
        ("filename", json!("sweeps/later.pcd.bin")),
        ("timestamp", json!(T0_MICROS + 250_000)),
        ("is_key_frame", Value::Null),
    ] {
        later[key] = value;
    }
    data.push(later);
    set.table("sample_data", json!(data));
    let mut poses = set.rows("ego_pose");
    let mut own = poses[0].clone();
    own["token"] = json!("later");
    for place in [0, poses.len()] {
        poses.insert(place, own.clone());
        set.table("ego_pose", json!(poses));
        poses.remove(place);
        let dataset = set.open();
        assert_eq!(
            set.problems(&dataset),
            [
                "v1.0-mini/sample_data.json: 1 sweeps of a sample and LiDAR that have one nearer in time: left out"
            ]
        );
        let path = dataset.scenarios[0].points_path(0, 1, None).unwrap();
        assert!(
            path.ends_with("LIDAR_TOP_id_1/scene_5_000001.pcd.bin"),
            "{}",
            path.display()
        );
    }
}

#[test]
fn a_byte_order_mark_before_a_table_is_skipped() {
    let set = v2x_sim();
    let rows = json!(set.rows("sample"));
    let text = format!("\u{feff}{rows}");
    set.write("v1.0-mini/sample.json", text.as_bytes());
    let dataset = set.open();
    assert_eq!(set.problems(&dataset), Vec::<String>::new());
    assert_eq!(dataset.scenarios[0].ticks.len(), 2);
}

#[test]
fn whole_milliseconds_are_no_microseconds() {
    let set = v2x_sim();
    let mut samples = set.rows("sample");
    for row in &mut samples {
        row["timestamp"] = json!(row["timestamp"].as_u64().unwrap() / 1000);
    }
    set.table("sample", json!(samples));
    let ticks = &set.open().scenarios[0].ticks;
    assert_eq!(ticks[1].capture_nanos, 200_000_000);
}

#[test]
fn a_time_stamp_that_is_no_number_is_quoted() {
    let set = v2x_sim();
    let mut samples = set.rows("sample");
    samples[1]["timestamp"] = json!("yesterday");
    set.table("sample", json!(samples));
    let dataset = set.open();
    assert_eq!(
        set.problems(&dataset)[0],
        "v1.0-mini/sample.json: 1.timestamp: the text \"yesterday\", expected a finite number"
    );
    assert_eq!(
        dataset.scenarios[0].ticks.len(),
        1,
        "the other sample is used"
    );
}

#[test]
fn unknown_categories_are_no_vehicles_and_reported() {
    let set = v2x_sim();
    set.annotate(&[(
        "spaceship",
        place([10.0, 40.0, 0.75], [2.0, 4.0, 1.5], 90.0),
    )]);
    let dataset = set.open();
    let expected = "v1.0-mini/category.json: 0.name: \"spaceship\" is an unknown type of object: it counts as other, not as a vehicle";
    assert_eq!(set.problems(&dataset), [expected]);
    assert_eq!(
        load(&dataset.scenarios[0], 0)[0].objects[0].class,
        ObjectClass::Other
    );
}

#[test]
fn tables_that_are_no_data_set_are_reported() {
    let set = v2x_sim();
    set.table(
        "sensor",
        json!([{"token": "sensor0", "channel": "LIDAR_FRONT_LEFT", "modality": "lidar"}]),
    );
    let message = set.refusal();
    assert!(
        message.contains("no row of calibrated_sensor.json")
            || message.contains("LIDAR_FRONT_LEFT"),
        "{message}"
    );
    fs::remove_file(set.dir.path().join("v1.0-mini/scene.json")).unwrap();
    let message = set.refusal();
    assert!(
        message.starts_with("v1.0-mini/scene.json: No such file"),
        "{message}"
    );
}

#[test]
fn the_folder_of_the_tables_opens_as_well_and_versions_are_distinguished() {
    let set = v2x_sim();
    let own = crate::open(&set.dir.path().join("v1.0-mini")).unwrap();
    assert_eq!(
        (own.scenarios[0].name.as_str(), own.scenarios[0].ticks.len()),
        ("v1.0-mini/scene_5", 2)
    );
    let copy = set.dir.path().join("v1.0-test");
    fs::create_dir(&copy).unwrap();
    for entry in fs::read_dir(set.dir.path().join("v1.0-mini")).unwrap() {
        let path = entry.unwrap().path();
        fs::copy(&path, copy.join(path.file_name().unwrap())).unwrap();
    }
    let names = || {
        let scenarios = set.open().scenarios.into_iter();
        scenarios
            .map(|scenario| scenario.name)
            .collect::<Vec<String>>()
    };
    assert_eq!(names(), ["v1.0-mini/scene_5"]);
    let first = "sweeps/LIDAR_TOP_id_1/scene_5_000000.pcd.bin";
    assert_eq!(
        set.problems(&set.open()),
        [format!(
            "{first}: first sweep of scene v1.0-mini/scene_5: scene v1.0-test/scene_5, too, is left out"
        )]
    );
    // A scene with sweeps of its own is another one.
    std::os::unix::fs::symlink("sweeps", set.dir.path().join("others")).unwrap();
    let data = copy.join("sample_data.json");
    let text = fs::read_to_string(&data).unwrap();
    fs::write(data, text.replace("sweeps/", "others/")).unwrap();
    assert_eq!(names(), ["v1.0-mini/scene_5", "v1.0-test/scene_5"]);
}

#[test]
fn sweeps_of_one_name_in_folders_of_their_own_are_ticks_of_their_own() {
    let set = v2x_sim();
    let mut data = set.rows("sample_data");
    for row in &mut data {
        let Some(file) = row["filename"].as_str().map(str::to_owned) else {
            continue;
        };
        let own = format!("{}/sweep.pcd.bin", file.trim_end_matches(".pcd.bin"));
        set.write(&own, &fs::read(set.dir.path().join(&file)).unwrap());
        row["filename"] = json!(own);
    }
    set.table("sample_data", json!(data));
    let dataset = set.open();
    assert_eq!(set.problems(&dataset), Vec::<String>::new());
    let scenario = &dataset.scenarios[0];
    let stems = scenario.ticks.iter().map(|tick| tick.stem.as_str());
    assert_eq!(stems.collect::<Vec<&str>>(), ["sweep", "sweep_000001"]);
    let files = [0, 1].map(|tick| scenario.points_path(0, tick, None).unwrap());
    assert_ne!(files[0], files[1]);
}

const TABLES: [&str; 9] = [
    "sensor",
    "calibrated_sensor",
    "scene",
    "sample",
    "sample_data",
    "ego_pose",
    "category",
    "instance",
    "sample_annotation",
];

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn damaged_tables_never_panic(table in 0..TABLES.len(), at in 0.0..1.0f64, bytes in prop::collection::vec(any::<u8>(), 0..4)) {
        let set = v2x_sim();
        let path = set.dir.path().join(format!("v1.0-mini/{}.json", TABLES[table]));
        let mut text = fs::read(&path).unwrap();
        let start = (text.len() as f64 * at) as usize;
        let end = (start + bytes.len().max(1)).min(text.len());
        text.splice(start..end, bytes);
        fs::write(&path, text).unwrap();
        for scenario in crate::open(set.dir.path()).map(|dataset| dataset.scenarios).unwrap_or_default() {
            for tick in 0..scenario.ticks.len() {
                for agent in 0..scenario.agents.len() {
                    let _ = scenario.load(agent, tick, &LoadOptions::default());
                }
            }
        }
    }
}

#[test]
fn objects_near_the_lidar_that_no_point_hits_are_counted() {
    let place = |x: f64, y: f64| protocol::Pose::from_xyz_yaw([x, y, 0.0], 0.0);
    // The LiDAR is on the last one.
    let places = [
        place(8.0, 0.0),
        place(0.0, 9.0),
        place(0.0, 30.0),
        place(0.0, 0.0),
    ];
    let objects = places.map(|place| Object::new(0, ObjectClass::Car, place, [4.0, 2.0, 1.5]));
    let points = protocol::PointCloud {
        xyzi: vec![[8.0, 0.5, 0.0, 0.1]],
    };
    let (seen, missed) = annotations::seen(&objects, &points, &nalgebra::Isometry3::identity());
    assert_eq!((seen, missed), (vec![&objects[0]], 1));
}
