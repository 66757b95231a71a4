use std::fs;

use std::path::Path;

use super::super::yaml::numpy_tags::tests::{pickled_array, pickled_scalar};
use super::*;
use crate::frame::ObjectClass;
use crate::pcd::{self, Encoding, IntensityField};
use crate::{Layout, LoadOptions, Scenario};

const YAML: &str = "RSU: false
ego_speed: 36
lidar_pose: [10, 20, 2, 0, 90, 1e-06]
true_ego_pos: [10, 20.5, 0.1, 0, 90, 0]
predicted_ego_pos: [10.5, 20.0, 0.1, 0, -270.5, 0]
plan_trajectory: []
camera0: {cords: [0, 0, 0, 0, 0, 0]}
vehicles:
  4335:
    angle: [0, 90, 0]
    center: [0.5, 0, 0.7]
    extent: [2, 1, 0.75]
    location: [10, 30, 0]
    speed: 18
    bp_id: vehicle.audi.tt
    color: 1, 2, 3
";

/// Writes one frame.
pub(crate) fn write_frame(root: &Path, name: &str, yaml: &str, points: &[[f32; 4]]) {
    let yaml_path = root.join(format!("{name}.yaml"));
    fs::create_dir_all(yaml_path.parent().unwrap()).unwrap();
    fs::write(yaml_path, yaml).unwrap();
    write_points(root, name, points);
}

fn write_points(root: &Path, name: &str, points: &[[f32; 4]]) {
    let cloud = protocol::PointCloud {
        xyzi: points.to_vec(),
    };
    let bytes = pcd::encode(&cloud, Encoding::Binary, IntensityField::Intensity);
    fs::write(root.join(format!("{name}.pcd")), bytes).unwrap();
}

fn opened(root: &Path) -> Scenario {
    let mut dataset = crate::open(root).unwrap();
    assert!(dataset.problems.is_empty(), "{:?}", dataset.problems);
    dataset.scenarios.swap_remove(0)
}

fn load_with(from: &str, to: &str) -> Result<Frame, String> {
    let dir = tempfile::tempdir().unwrap();
    let yaml = YAML.replace(from, to);
    assert_ne!(yaml, YAML);
    write_frame(dir.path(), "1/000070", &yaml, &[[1.0, 2.0, 3.0, 0.5]]);
    let root = dir.path().to_string_lossy();
    let loaded = opened(dir.path()).load(0, 0, &LoadOptions::default());
    let mut frame = loaded.map_err(|error| error.to_string().replace(&*root, ""))?;
    frame
        .problems
        .iter_mut()
        .for_each(|problem| problem.message = problem.message.replace(&*root, ""));
    Ok(frame)
}

#[test]
fn a_frame_is_mirrored_as_a_whole() {
    let dir = tempfile::tempdir().unwrap();
    write_frame(dir.path(), "1/000070", YAML, &[[1.0, 2.0, 3.0, 0.5]]);
    let scenario = opened(dir.path());
    assert_eq!(
        (scenario.layout, scenario.source_handedness),
        (Layout::OPV2V, Handedness::Left)
    );
    let frame = scenario.load(0, 0, &LoadOptions::default()).unwrap();
    assert_eq!(frame.points.xyzi, [[1.0, -2.0, 3.0, 0.5]]);
    let lidar = frame.world_from_lidar.unwrap();
    assert_eq!(lidar.translation_m, [10.0, -20.0, 2.0]);
    assert!(
        (lidar.yaw_rad().to_degrees() + 90.0).abs() < 1e-9,
        "to the right is negative"
    );
    assert_eq!(frame.speed_mps, Some(10.0));
    let car = &frame.objects[0];
    assert_eq!(
        (car.id, car.size_m, car.speed_mps),
        (4335, [4.0, 2.0, 1.5], Some(5.0))
    );
    // `center` is added without rotation, though the car is rotated.
    assert_eq!(car.world_from_object.translation_m, [10.5, -30.0, 0.7]);
    let ahead = lidar.isometry().inverse() * car.world_from_object.isometry();
    assert!(
        (ahead.translation.vector.x - 10.0).abs() < 1e-6
            && (ahead.translation.vector.y - 0.5).abs() < 1e-6
    );
    let gnss = frame.gnss_world_from_lidar().unwrap();
    assert!(
        (gnss.yaw_rad() - lidar.yaw_rad()).to_degrees().abs() - 0.5 < 1e-3,
        "another branch of the yaw"
    );
}

#[test]
fn variants_and_radar_are_read_on_demand() {
    let dir = tempfile::tempdir().unwrap();
    write_frame(dir.path(), "1/000070", YAML, &[[1.0, 2.0, 3.0, 0.5]]);
    write_points(dir.path(), "1/000070_fog_0.060", &[[4.0, 5.0, 6.0, 0.5]]);
    write_points(dir.path(), "1/000070_radar", &[[7.0, 8.0, 9.0, 0.25]]);
    let scenario = opened(dir.path());
    let load = |options: &LoadOptions| scenario.load(0, 0, options).unwrap();
    assert_eq!(load(&LoadOptions::default()).radar, None);
    let with_radar = load(&LoadOptions {
        radar: true,
        points: false,
        ..Default::default()
    });
    assert_eq!(with_radar.radar.unwrap().xyzi, [[7.0, -8.0, 9.0, 0.25]]);
    assert!(with_radar.points.is_empty());
    let fog = LoadOptions {
        lidar_variant: Some("fog_0.060".into()),
        ..Default::default()
    };
    assert_eq!(load(&fog).points.xyzi, [[4.0, -5.0, 6.0, 0.5]]);
    let rain = LoadOptions {
        lidar_variant: Some("rain".into()),
        ..Default::default()
    };
    let error = scenario.load(0, 0, &rain).unwrap_err().to_string();
    assert!(
        error.contains("LiDAR variant rain does not exist (there are [\"fog_0.060\"])"),
        "{error}"
    );
    let error = scenario
        .load(1, 0, &LoadOptions::default())
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("agent 1 does not exist (there are 1, counted from 0)"),
        "{error}"
    );
}

#[test]
fn a_pose_of_the_lidar_that_cannot_be_right_leaves_no_frame() {
    let pose = "lidar_pose: [10, 20, 2, 0, 90, 1e-06]";
    for (to, expected) in [
        (
            "lidar_pose: [10, 20, 2]",
            ":3: lidar_pose: a list of 3, expected 6 numbers or a 4x4 matrix",
        ),
        (
            "lidar_pose: [.inf, 20, 2, 0, 90, 0]",
            ":3: lidar_pose.0: inf, expected a finite number",
        ),
        (
            "lidar_pose: [1e8, 20, 2, 0, 90, 0]",
            ":3: lidar_pose: pose component 100000000 is not a finite number within 1e7",
        ),
    ] {
        assert_eq!(
            load_with(pose, to).unwrap_err(),
            format!("/1/000070.yaml{expected}")
        );
    }
}

#[test]
fn a_part_that_cannot_be_right_is_left_out_and_named() {
    let left_out = ": the object is left out";
    for (from, to, expected) in [
        (
            "extent: [2, 1, 0.75]",
            "extent: [2, -1, 0.75]",
            ":12: vehicles.4335.extent: [2.0, -1.0, 0.75] m, expected half sizes above 0 and up to 50 m",
        ),
        (
            "extent: [2, 1, 0.75]",
            "extent: [2, 0.3, 250]",
            ":12: vehicles.4335.extent: [2.0, 0.3, 250.0] m, expected half sizes above 0 and up to 50 m",
        ),
        (
            "extent: [2, 1, 0.75]",
            "extent: [0, 0, 0]",
            ":12: vehicles.4335.extent: [0.0, 0.0, 0.0] m, expected half sizes above 0 and up to 50 m",
        ),
        (
            "extent: [2, 1, 0.75]",
            "extent: [2, .inf, 1]",
            ":12: vehicles.4335.extent.1: inf, expected a finite number",
        ),
        (
            "extent: [2, 1, 0.75]",
            "extent: [2, 1, .nan]",
            ":12: vehicles.4335.extent.2: NaN, expected a finite number",
        ),
        (
            "extent: [2, 1, 0.75]",
            "extent: 2",
            ":12: vehicles.4335.extent: 2, expected a list of 3 numbers",
        ),
        (
            "    extent: [2, 1, 0.75]\n",
            "",
            ":10: vehicles.4335.extent: missing",
        ),
        (
            "    location: [10, 30, 0]\n",
            "",
            ":10: vehicles.4335.location: missing",
        ),
        (
            "    angle: [0, 90, 0]\n",
            "",
            ":10: vehicles.4335.angle: missing",
        ),
        (
            "angle: [0, 90, 0]",
            "angle: [0, 1e300, 0]",
            ":10: vehicles.4335.angle: [0.0, 1e300, 0.0], expected angles in degrees",
        ),
        (
            "angle: [0, 90, 0]",
            "angle: [90, 0, 0]",
            ":10: vehicles.4335.angle: [90.0, 0.0, 0.0], expected roll and pitch within 45 degrees",
        ),
        (
            "location: [10, 30, 0]",
            "location: [1e30, 30, 0]",
            ":10: vehicles.4335: pose component",
        ),
        (
            "center: [0.5, 0, 0.7]",
            "center: here",
            ":11: vehicles.4335.center: the text \"here\", expected a list of 3 numbers",
        ),
        (
            "  4335:\n",
            "  car:\n",
            ":10: vehicles.car: \"car\" is no object id, expected an integer",
        ),
        (
            "  4335:\n",
            "  7.5:\n",
            ":10: vehicles.7.5: \"7.5\" is no object id, expected an integer",
        ),
        (
            "  4335:\n",
            "  7: [1, 2]\n  8: ~\n  4335:\n",
            ":9: vehicles.7: a list of 2, expected a map",
        ),
        (
            "  4335:\n",
            "  4335: {}\n  4335:\n",
            ":9: vehicles.4335: listed again below",
        ),
    ] {
        let frame = load_with(from, to).unwrap();
        let first = &frame.problems[0];
        assert!(
            first
                .message
                .starts_with(&format!("/1/000070.yaml{expected}")),
            "{}",
            first.message
        );
        assert!(
            first.message.ends_with(left_out) && first.line.is_some() && first.field.is_some(),
            "{first:?}"
        );
        // Points and the other objects stay.
        let others = usize::from(to.contains("\n  4335:"));
        assert_eq!(
            (frame.points.len(), frame.objects.len()),
            (1, others),
            "{to}"
        );
    }
}

#[test]
fn an_invalid_list_of_objects_is_left_out_as_a_whole() {
    for (to, expected) in [
        (
            "cars:",
            ":1: vehicles: missing: the list of objects is left out",
        ),
        (
            "vehicles: [{location: [1, 2, 3]}]\nrest:",
            ":8: vehicles: a list of 1, expected a map of objects by id: the list of objects is left out",
        ),
        (
            "vehicles: 7\nrest:",
            ":8: vehicles: 7, expected a map of objects by id: the list of objects is left out",
        ),
    ] {
        let frame = load_with("vehicles:", to).unwrap();
        assert_eq!(
            frame.problems[0].message,
            format!("/1/000070.yaml{expected}")
        );
        assert_eq!(
            (
                frame.points.len(),
                frame.objects.len(),
                frame.problems.len()
            ),
            (1, 0, 1)
        );
    }
    let frame = load_with("vehicles:", "vehicles: []\nrest:").unwrap();
    assert!(frame.objects.is_empty() && frame.problems.is_empty());
}

#[test]
fn other_fields_are_left_out_one_by_one() {
    let frame = load_with("true_ego_pos: [10,", "true_ego_pos: [x,").unwrap();
    assert_eq!(
        (
            frame.world_from_vehicle,
            frame.objects.len(),
            frame.problems.len()
        ),
        (None, 1, 1)
    );
    assert!(frame.problems[0].message.ends_with("the field is left out"));
    for (from, to) in [
        ("speed: 18", "speed: .nan"),
        ("speed: 18", "speed: 1e9"),
        ("speed: 18", "speed: [1, x]"),
    ] {
        let frame = load_with(from, to).unwrap();
        assert_eq!(
            (
                frame.objects.len(),
                frame.objects[0].speed_mps,
                frame.problems.len()
            ),
            (1, None, 1),
            "{to}"
        );
        assert_eq!(
            frame.problems[0].field.as_deref(),
            Some("vehicles.4335.speed")
        );
    }
}

#[test]
fn a_vehicle_measures_its_motion() {
    let imu = "imu: {heading_deg: 90, speed_mps: 9.5, yaw_rate_degps: -18}\nlidar_pose:";
    let frame = load_with("lidar_pose:", imu).unwrap();
    assert_eq!(
        frame.speed_mps,
        Some(9.5),
        "a measurement rather than the ego_speed"
    );
    assert!(
        (frame.yaw_rate_rad_s.unwrap() - 18f64.to_radians()).abs() < 1e-12,
        "to the right is negative"
    );
    for (field, value) in [
        ("yaw_rate_degps", ".nan"),
        ("yaw_rate_degps", "1200"),
        ("speed_mps", "-201"),
        ("speed_mps", "fast"),
    ] {
        let frame = load_with(
            "lidar_pose:",
            &format!("imu: {{{field}: {value}}}\nlidar_pose:"),
        )
        .unwrap();
        let message = &frame.problems[0].message;
        let stated =
            message.contains("000070.yaml:3: imu.") && message.ends_with("the field is left out");
        assert!(
            stated
                && message
                    .to_lowercase()
                    .contains(value.trim_start_matches('.')),
            "{message}"
        );
        assert_eq!(frame.problems[0].field, Some(format!("imu.{field}")));
        assert_eq!(
            (frame.speed_mps, frame.yaw_rate_rad_s, frame.problems.len()),
            (Some(10.0), None, 1)
        );
    }
    let frame = load_with("ego_speed: 36", "ego_speed: 800").unwrap();
    assert_eq!(
        (frame.speed_mps, frame.problems.len()),
        (None, 1),
        "222 m/s"
    );
    // Other sensors are other fields.
    let frame = load_with("lidar_pose:", "imu: {gyroscope: [0, 0, 1]}\nlidar_pose:").unwrap();
    assert_eq!((frame.yaw_rate_rad_s, frame.problems.len()), (None, 0));
}

#[test]
fn types_are_read_by_whatever_key() {
    for key in ["obj_type", "object_type", "class", "type"] {
        let frame = load_with("speed: 18", &format!("speed: 18\n    {key}: Pedestrian")).unwrap();
        assert_eq!(
            (frame.objects[0].class, frame.problems.len()),
            (ObjectClass::Pedestrian, 0),
            "{key}"
        );
    }
    for (kind, found) in [
        ("Ufo", "class: the text \"Ufo\" is an unknown type"),
        ("5", "class: 5 is an unknown type"),
    ] {
        let frame = load_with("speed: 18", &format!("speed: 18\n    class: {kind}")).unwrap();
        assert_eq!(frame.objects[0].class, ObjectClass::Other);
        let message = &frame.problems[0].message;
        assert!(
            message.contains(found) && !message.contains(".yaml"),
            "{message}"
        );
    }
}

#[test]
fn coordinates_of_utm_are_places_like_others() {
    let frame = load_with(
        "[10, 20, 2, 0, 90, 1e-06]",
        "[692000.5, 9999999, 2, 0, 90, 0]",
    )
    .unwrap();
    assert_eq!(
        frame.world_from_lidar.unwrap().translation_m,
        [692_000.5, -9_999_999.0, 2.0]
    );
    let frame = load_with("location: [10, 30, 0]", "location: [692000, 5335000, 500]").unwrap();
    assert_eq!((frame.objects.len(), frame.problems.len()), (1, 0));
}

fn pickled_triple(values: [f64; 3]) -> String {
    pickled_array(&[3], &values, "      ")
}

#[test]
fn a_pickled_pose_of_six_numbers_is_opv2v() {
    let pickled = pickled_array(&[6], &[10.0, 20.0, 2.0, 0.0, 90.0, 1e-6], "  ");
    let id = pickled_scalar("i8", "<", &4335i64.to_le_bytes());
    let plain = load_with("RSU: false", "RSU: true").unwrap();
    for (from, to) in [
        (
            "lidar_pose: [10, 20, 2, 0, 90, 1e-06]\n",
            format!("lidar_pose: {pickled}"),
        ),
        (
            "angle: [0, 90, 0]\n",
            format!("angle: {}", pickled_triple([0.0, 90.0, 0.0])),
        ),
        (
            "location: [10, 30, 0]\n",
            format!("location: {}", pickled_triple([10.0, 30.0, 0.0])),
        ),
        (
            "extent: [2, 1, 0.75]\n",
            format!("extent: {}", pickled_triple([2.0, 1.0, 0.75])),
        ),
        (
            "speed: 18\n",
            format!(
                "speed: {}\n",
                pickled_scalar("f4", ">", &18f32.to_be_bytes())
            ),
        ),
        ("  4335:\n", format!("  ? {id}\n  :\n")),
        ("true_ego_pos:", "true_ego_pose:".into()),
    ] {
        let frame = load_with(from, &to).unwrap();
        assert_eq!(frame, plain, "{to}");
    }
}

#[test]
fn a_matrix_beside_six_numbers_is_named() {
    let dir = tempfile::tempdir().unwrap();
    write_frame(dir.path(), "1/000070", YAML, &[]);
    let matrix = "lidar_pose: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]";
    let other = YAML.replace("lidar_pose: [10, 20, 2, 0, 90, 1e-06]", matrix);
    write_frame(dir.path(), "2/000070", &other, &[]);
    let scenario = opened(dir.path());
    assert_eq!(scenario.layout, Layout::OPV2V);
    let error = scenario
        .load(1, 0, &LoadOptions::default())
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("2/000070.yaml:3: lidar_pose: a 4x4 matrix as in V2V4Real"),
        "{error}"
    );
}

#[test]
fn agents_may_have_names() {
    let dir = tempfile::tempdir().unwrap();
    for agent in ["car1", "car2", "Car 3"] {
        write_frame(dir.path(), &format!("scene/{agent}/000070"), YAML, &[]);
    }
    let dataset = crate::open(dir.path()).unwrap();
    let agents: Vec<&str> = dataset.scenarios[0]
        .agents
        .iter()
        .map(CavId::as_str)
        .collect();
    assert_eq!((agents, dataset.problems.len()), (vec!["car1", "car2"], 1));
    let problem = dataset.problems[0].to_string();
    assert!(
        problem.contains("Car 3: it holds frames, but its name is no agent's: CAV id \"Car 3\""),
        "{problem}"
    );
    let dir = tempfile::tempdir().unwrap();
    write_frame(dir.path(), "scene/Car 3/000070", YAML, &[]);
    let error = crate::open(dir.path()).unwrap_err().to_string();
    assert!(error.contains("its name is no agent's"), "{error}");
}

#[test]
fn copies_of_agents_and_loose_frames_are_no_agents() {
    let dir = tempfile::tempdir().unwrap();
    for frame in ["scene/650/000070", "scene/650_old/000070", "scene/000070"] {
        write_frame(dir.path(), frame, YAML, &[]);
    }
    let dataset = crate::open(dir.path()).unwrap();
    assert_eq!(
        (
            dataset.scenarios[0].name.as_str(),
            dataset.scenarios[0].agents.len()
        ),
        ("scene", 1)
    );
    let problem = dataset.problems[0].to_string();
    assert!(
        problem.contains("650_old: it holds frames, but its name is no agent's: no number"),
        "{problem}"
    );
}

fn link_to_nothing(path: &Path) {
    std::os::unix::fs::symlink("/nowhere", path).unwrap();
}

#[test]
fn dangling_links_cost_only_their_targets() {
    let dir = tempfile::tempdir().unwrap();
    write_frame(dir.path(), "scene/1/000070", YAML, &[]);
    write_frame(dir.path(), "scene/1/000072", YAML, &[]);
    link_to_nothing(&dir.path().join("scene/1/000070_camera0.png"));
    link_to_nothing(&dir.path().join("beside"));
    assert_eq!(opened(dir.path()).ticks.len(), 2);
    fs::remove_file(dir.path().join("scene/1/000072.pcd")).unwrap();
    link_to_nothing(&dir.path().join("scene/1/000072.pcd"));
    let dataset = crate::open(dir.path()).unwrap();
    assert_eq!(
        (dataset.scenarios[0].ticks.len(), dataset.problems.len()),
        (1, 1)
    );
    assert!(
        dataset.problems[0]
            .to_string()
            .ends_with("000072.pcd: does not exist beside 000072.yaml: the frame is left out")
    );
}

#[test]
fn bare_floats_beside_yaml_are_v2x_real_and_nothing_is_mirrored() {
    let dir = tempfile::tempdir().unwrap();
    for agent in ["1", "2", "-1"] {
        fs::create_dir_all(dir.path().join(agent)).unwrap();
        for stem in ["000000", "000001"] {
            fs::write(dir.path().join(format!("{agent}/{stem}.yaml")), YAML).unwrap();
            let points = [[1.0f32, 2.0, 3.0, 0.5], [4.0, 5.0, 6.0, 0.25]].concat();
            let bytes: Vec<u8> = points
                .iter()
                .flat_map(|value| value.to_le_bytes())
                .collect();
            fs::write(dir.path().join(format!("{agent}/{stem}.bin")), bytes).unwrap();
        }
    }
    let scenario = opened(dir.path());
    assert_eq!(
        (scenario.layout, scenario.source_handedness),
        (Layout::V2XREAL, Handedness::Right)
    );
    assert_eq!(
        (
            scenario.ticks.len(),
            scenario.agents.last().unwrap().as_str()
        ),
        (2, "-1")
    );
    let frame = scenario.load(2, 1, &LoadOptions::default()).unwrap();
    assert_eq!(
        frame.points.xyzi,
        [[1.0, 2.0, 3.0, 0.5], [4.0, 5.0, 6.0, 0.25]]
    );
    let lidar = frame.world_from_lidar.unwrap();
    assert_eq!(lidar.translation_m, [10.0, 20.0, 2.0]);
    assert!((lidar.yaw_rad().to_degrees() - 90.0).abs() < 1e-9);
    assert_eq!(
        frame.objects[0].world_from_object.translation_m,
        [10.5, 30.0, 0.7],
        "in the world, not in the LiDAR"
    );
}

#[test]
fn relatives_of_the_format_are_understood() {
    let dir = tempfile::tempdir().unwrap();
    let yaml = YAML
        .replace("vehicles:", "objects:")
        .replace("speed: 18", "speed: [10.8, 0, 14.4]");
    write_frame(dir.path(), "1/000070", &yaml, &[[1.0, 2.0, 3.0, 0.5]]);
    let frame = opened(dir.path())
        .load(0, 0, &LoadOptions::default())
        .unwrap();
    assert!((frame.objects[0].speed_mps.unwrap() - 5.0).abs() < 1e-12);
    let (head, _) = YAML.split_once("  4335").unwrap();
    for empty in ["vehicles: {}\n", "vehicles:\n"] {
        write_frame(
            dir.path(),
            "1/000070",
            &head.replace("vehicles:\n", empty),
            &[[1.0, 2.0, 3.0, 0.5]],
        );
        assert!(
            opened(dir.path())
                .load(0, 0, &LoadOptions::default())
                .unwrap()
                .objects
                .is_empty()
        );
    }
}

#[test]
fn a_file_cut_at_any_length_never_panics() {
    let dir = tempfile::tempdir().unwrap();
    write_frame(dir.path(), "1/000070", YAML, &[]);
    let scenario = opened(dir.path());
    for length in 0..YAML.len() {
        fs::write(dir.path().join("1/000070.yaml"), &YAML[..length]).unwrap();
        let _ = scenario.load(0, 0, &LoadOptions::default());
    }
}
