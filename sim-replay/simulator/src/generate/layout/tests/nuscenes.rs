//! V2X-Sim and Open MARS, read according to the description of nuScenes' tables.

use std::collections::HashMap;
use std::path::Path;

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use serde_json::Value;

use super::{Tick, assert_same, expected, floats, json, numbers, object, write};
use crate::generate::SceneLayout;
use dataset::ground_truth::upright_box;

/// Rows by table and token.
struct Tables(HashMap<&'static str, HashMap<String, Value>>);

impl Tables {
    fn read(folder: &Path) -> Self {
        let names = [
            "sample",
            "sample_data",
            "calibrated_sensor",
            "ego_pose",
            "sensor",
            "sample_annotation",
            "instance",
        ];
        let table = |name: &'static str| {
            let Value::Array(rows) = json(&folder.join(format!("{name}.json"))) else {
                panic!("{name}")
            };
            (
                name,
                rows.into_iter()
                    .map(|row| (text(&row["token"]).to_owned(), row))
                    .collect(),
            )
        };
        Self(names.into_iter().map(table).collect())
    }

    fn row(&self, table: &str, token: &Value) -> &Value {
        &self.0[table][text(token)]
    }

    fn of<'a>(
        &'a self,
        table: &str,
        key: &'a str,
        token: &'a Value,
    ) -> impl Iterator<Item = &'a Value> {
        self.0[table].values().filter(move |row| row[key] == *token)
    }
}

fn text(value: &Value) -> &str {
    value
        .as_str()
        .unwrap_or_else(|| panic!("{value} is no text"))
}

/// Translation and quaternion w, x, y, z.
fn pose(row: &Value) -> Isometry3<f64> {
    let (t, q) = (numbers(&row["translation"]), numbers(&row["rotation"]));
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(q[0], q[1], q[2], q[3]));
    Isometry3::from_parts(Translation3::new(t[0], t[1], t[2]), rotation)
}

/// The samples of all scenes; agents in the order of `channels`, intensities by `scale`.
fn ticks(
    root: &Path,
    version: &str,
    channels: impl Fn(&Value) -> Vec<String>,
    scale: f32,
) -> Vec<Tick> {
    let tables = Tables::read(&root.join(version));
    let Value::Array(scenes) = json(&root.join(version).join("scene.json")) else {
        panic!("scenes")
    };
    let mut ticks = Vec::new();
    for scene in &scenes {
        let mut token = &scene["first_sample_token"];
        let mut count = 0;
        while !text(token).is_empty() {
            let sample = tables.row("sample", token);
            ticks.push(tick(&tables, root, token, &channels(scene), scale));
            token = &sample["next"];
            count += 1;
        }
        assert_eq!(scene["nbr_samples"], count);
    }
    ticks
}

fn tick(tables: &Tables, root: &Path, sample: &Value, channels: &[String], scale: f32) -> Tick {
    let mut tick = Tick::default();
    for channel in channels {
        let of_channel = |row: &&Value| {
            let mount = tables.row("calibrated_sensor", &row["calibrated_sensor_token"]);
            text(&tables.row("sensor", &mount["sensor_token"])["channel"]) == channel
        };
        let sweep = tables
            .of("sample_data", "sample_token", sample)
            .find(of_channel)
            .unwrap();
        let mount = tables.row("calibrated_sensor", &sweep["calibrated_sensor_token"]);
        tick.poses
            .push(pose(tables.row("ego_pose", &sweep["ego_pose_token"])) * pose(mount));
        let rows = floats::<5>(&root.join(text(&sweep["filename"])));
        assert!(
            rows.iter()
                .all(|row| row[4].fract() == 0.0 && (0.0..64.0).contains(&row[4])),
            "rings"
        );
        tick.clouds.push(
            rows.iter()
                .map(|&[x, y, z, intensity, _]| [x, y, z, intensity / scale])
                .collect(),
        );
    }
    let ego_from_world = tick.poses[0].inverse();
    for row in tables.of("sample_annotation", "sample_token", sample) {
        let [width, length, height] = numbers(&row["size"])[..] else {
            panic!("three sizes")
        };
        assert!(
            tables.row("instance", &row["instance_token"])["nbr_annotations"].as_u64() > Some(0)
        );
        tick.boxes.push(upright_box(
            &object(0, pose(row), [length, width, height]),
            &ego_from_world,
        ));
    }
    tick
}

#[test]
fn v2xsim_keeps_poses_points_and_boxes() {
    let folder = tempfile::tempdir().unwrap();
    assert!(write(SceneLayout::V2xsim, folder.path()).omitted.is_empty());
    assert!(
        folder
            .path()
            .join("sweeps/LIDAR_TOP_id_2/scene_1_000001.pcd.bin")
            .is_file()
    );
    let channels = |_: &Value| vec!["LIDAR_TOP_id_1".to_owned(), "LIDAR_TOP_id_2".to_owned()];
    assert_same(
        &ticks(folder.path(), "v1.0-mini", channels, 1.0),
        &expected(),
        SceneLayout::V2xsim,
    );
}

#[test]
fn mars_keeps_poses_points_and_boxes() {
    let folder = tempfile::tempdir().unwrap();
    write(SceneLayout::Mars, folder.path());
    let channels = |scene: &Value| {
        let vehicles = scene["vehicle_list"].as_array().unwrap();
        vehicles
            .iter()
            .map(|vehicle| format!("LIDAR_FRONT_CENTER_{}", text(vehicle)))
            .collect()
    };
    assert_same(
        &ticks(folder.path(), "v1.0", channels, 255.0),
        &expected(),
        SceneLayout::Mars,
    );
}
