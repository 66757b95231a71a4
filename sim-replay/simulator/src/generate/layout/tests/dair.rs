//! DAIR-V2X-C and V2X-Seq SPD, read according to the description of their files.

use std::path::Path;

use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use protocol::Box3d;
use serde_json::Value;

use super::{Tick, assert_same, expected, from_rows, json, numbers, options, write};
use crate::generate::{SceneLayout, SynthOptions, generate};
use dataset::pcd;

fn transform(value: &Value) -> Isometry3<f64> {
    from_rows(
        &numbers(&value["rotation"]),
        &numbers(&value["translation"]),
    )
}

/// A sweep, with intensities of 0 to 1.
fn sweep(path: &Path) -> Vec<[f32; 4]> {
    let cloud = pcd::decode(&std::fs::read(path).unwrap()).unwrap();
    let most = cloud
        .points
        .xyzi
        .iter()
        .map(|point| point[3])
        .fold(0.0, f32::max);
    assert!(most > 100.0 && most <= 255.0, "{most}");
    cloud
        .points
        .xyzi
        .iter()
        .map(|&[x, y, z, intensity]| [x, y, z, intensity / 255.0])
        .collect()
}

/// The two agents of a pair, by numbers of their frames.
fn agents(root: &Path, vehicle: &str, unit: &str) -> Tick {
    let calibration = |path: String| json(&root.join(path));
    let novatel_from_lidar = calibration(format!(
        "vehicle-side/calib/lidar_to_novatel/{vehicle}.json"
    ));
    let world_from_novatel = calibration(format!(
        "vehicle-side/calib/novatel_to_world/{vehicle}.json"
    ));
    let world_from_unit = calibration(format!(
        "infrastructure-side/calib/virtuallidar_to_world/{unit}.json"
    ));
    let clouds = [
        sweep(&root.join(format!("vehicle-side/velodyne/{vehicle}.pcd"))),
        sweep(&root.join(format!("infrastructure-side/velodyne/{unit}.pcd"))),
    ];
    let vehicle = transform(&world_from_novatel) * transform(&novatel_from_lidar["transform"]);
    Tick {
        poses: vec![vehicle, transform(&world_from_unit)],
        clouds: clouds.to_vec(),
        boxes: Vec::new(),
    }
}

/// The box around 8 corners of the world, in the frame of the ego.
fn around(corners: &[f64], ego_from_world: &Isometry3<f64>) -> Box3d {
    let at = |index: usize| {
        ego_from_world
            * Point3::new(
                corners[3 * index],
                corners[3 * index + 1],
                corners[3 * index + 2],
            )
    };
    let corners: Vec<Point3<f64>> = (0..8).map(at).collect();
    let center = corners
        .iter()
        .map(|corner| corner.coords)
        .sum::<Vector3<f64>>()
        / 8.0;
    let (along, across) = (corners[0] - corners[3], corners[0] - corners[1]);
    let up = corners[4] - corners[0];
    Box3d {
        center_m: center.into(),
        size_m: [along.xy().norm(), across.xy().norm(), up.z],
        heading_rad: along.y.atan2(along.x),
    }
}

/// The box of a label in the frame of the LiDAR.
fn upright(label: &Value) -> Box3d {
    let of = |field: &str, keys: [&str; 3]| keys.map(|key| label[field][key].as_f64().unwrap());
    Box3d {
        center_m: of("3d_location", ["x", "y", "z"]),
        size_m: of("3d_dimensions", ["l", "w", "h"]),
        heading_rad: label["rotation"].as_f64().unwrap(),
    }
}

#[test]
fn dair_keeps_poses_points_and_boxes() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    assert!(write(SceneLayout::Dair, root).omitted.is_empty());
    let pairs = json(&root.join("cooperative/data_info.json"));
    let stem = |path: &Value| path.as_str().unwrap().rsplit_once('/').unwrap().1[..6].to_owned();
    let ticks: Vec<Tick> = pairs
        .as_array()
        .unwrap()
        .iter()
        .map(|pair| {
            let vehicle = stem(&pair["vehicle_pointcloud_path"]);
            let mut tick = agents(
                root,
                &vehicle,
                &stem(&pair["infrastructure_pointcloud_path"]),
            );
            let ego_from_world = tick.poses[0].inverse();
            let labels = json(&root.join(pair["cooperative_label_path"].as_str().unwrap()));
            let labels = labels.as_array().unwrap();
            tick.boxes = labels
                .iter()
                .map(|label| around(&numbers(&label["world_8_points"]), &ego_from_world))
                .collect();
            tick
        })
        .collect();
    assert_same(&ticks, &expected(), SceneLayout::Dair);
    // Two batches of two frames, a tenth of a second apart.
    let rows = json(&root.join("infrastructure-side/data_info.json"));
    let row = |index: usize, key: &str| rows[index][key].as_str().unwrap().to_owned();
    assert_eq!(
        (row(0, "pointcloud_path"), row(3, "batch_id")),
        ("velodyne/500000.pcd".into(), "1".into())
    );
    assert_eq!(
        (row(2, "batch_start_id"), row(2, "batch_end_id")),
        ("500002".into(), "500003".into())
    );
    let micros = |index: usize| row(index, "pointcloud_timestamp").parse::<u64>().unwrap();
    assert_eq!(micros(1) - micros(0), 100_000);
}

#[test]
fn spd_keeps_poses_points_and_boxes_with_track_ids() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write(SceneLayout::V2xseq, root);
    let pairs = json(&root.join("cooperative/data_info.json"));
    let mut tracks = std::collections::BTreeMap::new();
    let ticks: Vec<Tick> = pairs
        .as_array()
        .unwrap()
        .iter()
        .map(|pair| {
            let [vehicle, unit] =
                ["vehicle_frame", "infrastructure_frame"].map(|key| pair[key].as_str().unwrap());
            let mut tick = agents(root, vehicle, unit);
            let labels = json(&root.join(format!("cooperative/label/{vehicle}.json")));
            for label in labels.as_array().unwrap() {
                let track = (
                    pair["vehicle_sequence"].to_string(),
                    label["track_id"].to_string(),
                );
                *tracks.entry(track).or_insert(0) += 1;
                tick.boxes.push(upright(label));
            }
            tick
        })
        .collect();
    assert_same(&ticks, &expected(), SceneLayout::V2xseq);
    assert!(
        tracks.values().all(|count| *count <= 2)
            && tracks.values().filter(|count| **count == 2).count() > 5
    );
}

#[test]
fn both_sides_have_labels_of_their_own() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write(SceneLayout::Dair, root);
    for (side, id) in [
        ("vehicle-side/label/lidar", "000000"),
        ("infrastructure-side/label/virtuallidar", "500000"),
    ] {
        let labels = json(&root.join(format!("{side}/{id}.json")));
        let labels = labels.as_array().unwrap();
        assert!(!labels.is_empty(), "{side}");
        // Labels stand where the sweep of their own side has points.
        let cloud = root.join(format!(
            "{}/velodyne/{id}.pcd",
            side.split('/').next().unwrap()
        ));
        let points = sweep(&cloud);
        let hit = |label: &&Value| {
            let Box3d {
                center_m: [x, y, z],
                size_m,
                heading_rad,
            } = upright(label);
            let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading_rad);
            let pose = Isometry3::from_parts(Point3::new(x, y, z).coords.into(), turn);
            points.iter().any(|&[x, y, z, _]| {
                let local = pose.inverse() * Point3::new(x, y, z).cast::<f64>();
                (0..3).all(|axis| local[axis].abs() < 0.5 * size_m[axis] + 0.5)
            })
        };
        assert_eq!(labels.iter().filter(hit).count(), labels.len(), "{side}");
    }
}

#[test]
fn agents_beyond_two_are_omitted_and_one_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let three = SynthOptions {
        agents: 3..=3,
        scenes: 1,
        ..options(SceneLayout::Dair, folder.path())
    };
    let omitted = generate(&three, &|_| {}).unwrap().omitted;
    assert_eq!(
        omitted["frames of agents beyond one vehicle and one roadside unit"],
        2
    );
    let one = SynthOptions {
        agents: 1..=2,
        ..options(SceneLayout::Dair, &folder.path().join("one"))
    };
    let refused = generate(&one, &|_| {}).unwrap_err().to_string();
    assert!(refused.contains("must be 2 or more"), "{refused}");
    assert!(!folder.path().join("one").exists());
}
