//! The tables of nuScenes: rows that refer to each other by tokens.
//!
//! Tokens are hashes of the row's identity, so that the same scenes give the same files.

use std::collections::BTreeMap;

use nalgebra::Isometry3;
use protocol::Pose;
use protocol::text::hex;
use serde_json::{Map, Value, json};
use sha2::{Digest, Sha256};

use dataset::frame::{Object, ObjectClass};

/// Bytes of a token: 32 digits.
const TOKEN_BYTES: usize = 16;
/// Tables that readers require, though they are empty.
const EMPTY_TABLES: [&str; 6] = [
    "attribute",
    "visibility",
    "instance",
    "sample_annotation",
    "category",
    "map",
];

/// A sweep that was written.
#[derive(Debug)]
pub(super) struct SweepRecord {
    pub(super) agent: usize,
    /// Path below the root.
    pub(super) file: String,
    pub(super) world_from_lidar: Isometry3<f64>,
    pub(super) world_from_vehicle: Option<Pose>,
}

/// A moment that was written.
#[derive(Debug)]
pub(super) struct SampleRecord {
    pub(super) moment: usize,
    pub(super) micros: u64,
    pub(super) sweeps: Vec<SweepRecord>,
    /// The objects listed by any agent, each with the number of points of all agents in its box.
    pub(super) annotations: Vec<(Object, usize)>,
}

/// A scene whose capture times are written.
#[derive(Debug)]
pub(super) struct SceneTables<'a> {
    pub(super) number: usize,
    pub(super) name: &'a str,
    /// Channel of each agent's LiDAR.
    pub(super) channels: &'a [String],
    /// Further fields of the row of scenes.
    pub(super) fields: Map<String, Value>,
    /// Samples by rising capture time.
    pub(super) samples: &'a [SampleRecord],
}

/// All tables, by name.
#[derive(Debug, Default)]
pub(super) struct TableSet(BTreeMap<&'static str, Vec<Value>>);

impl TableSet {
    /// The rows of a table, which begins empty.
    fn rows(&mut self, table: &'static str) -> &mut Vec<Value> {
        self.0.entry(table).or_default()
    }

    /// Adds a row, unless there is one with its token.
    fn push_once(&mut self, table: &'static str, row: Value) {
        let rows = self.rows(table);
        if !rows.iter().any(|other| other["token"] == row["token"]) {
            rows.push(row);
        }
    }

    /// All tables, empty ones included.
    pub(super) fn into_tables(mut self) -> BTreeMap<&'static str, Vec<Value>> {
        for name in EMPTY_TABLES {
            self.rows(name);
        }
        self.0
    }

    /// Adds the rows of a scene.
    pub(super) fn add(&mut self, scene: SceneTables<'_>) {
        let samples = scene.samples.iter();
        let tokens: Vec<String> = samples
            .map(|sample| scene_token(&scene, "sample", &[&sample.moment.to_string()]))
            .collect();
        self.add_scene(&scene, &tokens);
        let scene_token = scene_token(&scene, "scene", &[]);
        for (sample, (token, prev, next)) in scene.samples.iter().zip(linked(&tokens)) {
            self.rows("sample").push(json!({
                "token": token, "timestamp": sample.micros, "prev": prev, "next": next, "scene_token": scene_token,
            }));
        }
        self.add_sweeps(&scene, &tokens);
        self.add_annotations(&scene, &tokens);
    }

    /// The scene, its log and its map.
    fn add_scene(&mut self, scene: &SceneTables<'_>, sample_tokens: &[String]) {
        let [log, map, token] = ["log", "map", "scene"].map(|kind| scene_token(scene, kind, &[]));
        self.rows("log").push(json!({
            "token": log, "logfile": "", "vehicle": "", "date_captured": "", "location": "",
        }));
        self.rows("map").push(json!({
            "token": map, "log_tokens": [log], "category": "semantic_prior", "filename": "",
        }));
        let mut row = json!({
            "token": token,
            "log_token": log,
            "nbr_samples": scene.samples.len(),
            "first_sample_token": sample_tokens.first().map_or("", String::as_str),
            "last_sample_token": sample_tokens.last().map_or("", String::as_str),
            "name": scene.name,
        });
        if let Some(row) = row.as_object_mut() {
            row.extend(scene.fields.clone());
        }
        self.rows("scene").push(row);
    }

    /// Sensors, their mounts, the sweeps and the poses of the vehicles: a chain of sweeps per channel.
    fn add_sweeps(&mut self, scene: &SceneTables<'_>, sample_tokens: &[String]) {
        for (agent, channel) in scene.channels.iter().enumerate() {
            let samples = scene.samples.iter().zip(sample_tokens);
            let chain = samples.filter_map(|(sample, token)| {
                let mut sweeps = sample.sweeps.iter();
                Some((sample, sweeps.find(|sweep| sweep.agent == agent)?, token))
            });
            let chain: Vec<(&SampleRecord, &SweepRecord, &String)> = chain.collect();
            let Some((_, first, _)) = chain.first() else {
                continue;
            };
            let (mount, vehicle_from_lidar) = self.add_mount(scene, channel, first);
            let moments = chain.iter().map(|(sample, ..)| sample.moment.to_string());
            let tokens =
                moments.map(|moment| scene_token(scene, "sample_data", &[channel, &moment]));
            let tokens: Vec<String> = tokens.collect();
            for ((sample, sweep, sample_token), (token, prev, next)) in
                chain.iter().zip(linked(&tokens))
            {
                // The mount is that of the first sweep, so that one row serves the whole scene.
                let world_from_vehicle: Pose =
                    (sweep.world_from_lidar * vehicle_from_lidar.inverse()).into();
                // One pose for each sweep, so both rows share a token.
                self.rows("ego_pose").push(json!({
                    "token": token, "timestamp": sample.micros,
                    "rotation": world_from_vehicle.rotation_wxyz, "translation": world_from_vehicle.translation_m,
                }));
                self.rows("sample_data").push(json!({
                    "token": token, "sample_token": sample_token, "ego_pose_token": token,
                    "calibrated_sensor_token": mount, "timestamp": sample.micros, "fileformat": "bin",
                    "is_key_frame": true, "height": 0, "width": 0, "filename": sweep.file, "prev": prev, "next": next,
                }));
            }
        }
    }

    /// Adds the row of a sensor on its vehicle; returns the row's token and the pose.
    fn add_mount(
        &mut self,
        scene: &SceneTables<'_>,
        channel: &str,
        first: &SweepRecord,
    ) -> (String, Isometry3<f64>) {
        // A sensor is one row, also if several scenes use it.
        let sensor = token(&["sensor", channel]);
        let row = json!({ "token": sensor, "channel": channel, "modality": "lidar" });
        self.push_once("sensor", row);
        let world_from_vehicle = first.world_from_vehicle.map(|pose| pose.isometry());
        let world_from_vehicle = world_from_vehicle.unwrap_or(first.world_from_lidar);
        let vehicle_from_lidar = world_from_vehicle.inv_mul(&first.world_from_lidar);
        let pose: Pose = vehicle_from_lidar.into();
        let token = scene_token(scene, "calibrated_sensor", &[channel]);
        self.rows("calibrated_sensor").push(json!({
            "token": token, "sensor_token": sensor, "translation": pose.translation_m,
            "rotation": pose.rotation_wxyz, "camera_intrinsic": [],
        }));
        (token, vehicle_from_lidar)
    }

    /// Objects by id, and their boxes at each sample: a chain of boxes per object.
    fn add_annotations(&mut self, scene: &SceneTables<'_>, sample_tokens: &[String]) {
        let mut by_object: BTreeMap<i64, Vec<_>> = BTreeMap::new();
        for (sample, token) in scene.samples.iter().zip(sample_tokens) {
            for (object, lidar_points) in &sample.annotations {
                let chain = by_object.entry(object.id).or_default();
                chain.push((sample, token, object, lidar_points));
            }
        }
        for (id, chain) in &by_object {
            let id = id.to_string();
            let instance = scene_token(scene, "instance", &[&id]);
            let moments = chain.iter().map(|(sample, ..)| sample.moment.to_string());
            let tokens = moments.map(|moment| scene_token(scene, "annotation", &[&id, &moment]));
            let tokens: Vec<String> = tokens.collect();
            // The name in the taxonomy of nuScenes, which counts vans as cars.
            let name = match chain[0].2.class {
                ObjectClass::Car | ObjectClass::Van => "vehicle.car",
                ObjectClass::Truck => "vehicle.truck",
                ObjectClass::Bus => "vehicle.bus.rigid",
                ObjectClass::TwoWheeler => "vehicle.bicycle",
                ObjectClass::Pedestrian => "human.pedestrian.adult",
                ObjectClass::Other => "movable_object.debris",
            };
            let category = token(&["category", name]);
            let row = json!({ "token": category, "name": name, "description": "" });
            self.push_once("category", row);
            self.rows("instance").push(json!({
                "token": instance, "category_token": category, "nbr_annotations": tokens.len(),
                "first_annotation_token": tokens.first(), "last_annotation_token": tokens.last(),
            }));
            for ((_, sample_token, object, lidar_points), (token, prev, next)) in
                chain.iter().zip(linked(&tokens))
            {
                let pose = &object.world_from_object;
                // Sizes of nuScenes are width, length, height.
                let [length, width, height] = object.size_m;
                self.rows("sample_annotation").push(json!({
                    "token": token, "sample_token": sample_token, "instance_token": instance,
                    "visibility_token": "", "attribute_tokens": [],
                    "translation": pose.translation_m, "size": [width, length, height],
                    "rotation": pose.rotation_wxyz, "prev": prev, "next": next,
                    "num_lidar_pts": lidar_points, "num_radar_pts": 0,
                }));
            }
        }
    }
}

/// The tokens before and after each, empty at the ends.
fn linked(tokens: &[String]) -> impl Iterator<Item = (&str, &str, &str)> {
    (0..tokens.len()).map(move |place| {
        let places = [Some(place), place.checked_sub(1), place.checked_add(1)];
        let [token, before, after] = places.map(|place| {
            let token = place.and_then(|place| tokens.get(place));
            token.map_or("", String::as_str)
        });
        (token, before, after)
    })
}

fn scene_token(scene: &SceneTables<'_>, kind: &str, parts: &[&str]) -> String {
    let number = scene.number.to_string();
    token(&[&[kind, &number, scene.name], parts].concat())
}

fn token(parts: &[&str]) -> String {
    let digest = Sha256::digest(parts.join("/"));
    hex(&digest[..TOKEN_BYTES])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn object(id: i64, x: f64) -> Object {
        Object {
            id,
            class: ObjectClass::Van,
            world_from_object: Pose::from_xyz_yaw([x, 0.0, 1.0], 0.5),
            size_m: [4.0, 2.0, 1.5],
            speed_mps: None,
        }
    }

    fn sample(moment: usize, objects: Vec<Object>) -> SampleRecord {
        let sweep = SweepRecord {
            agent: 0,
            file: format!("sweeps/TOP/{moment}.pcd.bin"),
            world_from_lidar: Pose::from_xyz_yaw([moment as f64, 0.0, 2.0], 0.0).isometry(),
            world_from_vehicle: Some(Pose::from_xyz_yaw([moment as f64 + 0.5, 0.0, 0.0], 0.0)),
        };
        let annotations = objects.into_iter().map(|object| (object, 3)).collect();
        SampleRecord {
            moment,
            micros: 100_000 * moment as u64,
            sweeps: vec![sweep],
            annotations,
        }
    }

    /// The row of a table that has this token.
    fn row<'t>(
        tables: &'t BTreeMap<&'static str, Vec<Value>>,
        name: &str,
        token: &Value,
    ) -> &'t Value {
        tables[name]
            .iter()
            .find(|row| row["token"] == *token)
            .unwrap_or_else(|| panic!("{name} {token}"))
    }

    #[test]
    fn rows_refer_to_each_other() {
        let samples = [
            sample(0, vec![object(7, 10.0)]),
            sample(1, vec![object(7, 11.0), object(8, 20.0)]),
            sample(2, vec![]),
        ];
        let channels = ["TOP".to_owned(), "absent".to_owned()];
        let mut tables = TableSet::default();
        tables.add(SceneTables {
            number: 0,
            name: "a",
            channels: &channels,
            fields: Map::new(),
            samples: &samples,
        });
        tables.add(SceneTables {
            number: 1,
            name: "b",
            channels: &channels,
            fields: Map::new(),
            samples: &samples,
        });
        let tables = tables.into_tables();
        for (name, rows) in [
            ("scene", 2),
            ("sample", 6),
            ("sample_data", 6),
            ("ego_pose", 6),
            ("sensor", 1),
            ("calibrated_sensor", 2),
            ("category", 1),
            ("instance", 4),
            ("sample_annotation", 6),
            ("visibility", 0),
        ] {
            assert_eq!(tables[name].len(), rows, "{name}");
        }
        // From the scene along its samples to the second box of the first object.
        let first = row(&tables, "sample", &tables["scene"][0]["first_sample_token"]);
        assert_eq!(first["prev"], "");
        let second = row(&tables, "sample", &first["next"]);
        assert_eq!(
            (second["timestamp"].as_u64(), &second["prev"]),
            (Some(100_000), &first["token"])
        );
        let instance = row(
            &tables,
            "instance",
            &tables["sample_annotation"][0]["instance_token"],
        );
        assert_eq!(instance["nbr_annotations"], 2);
        let last = row(
            &tables,
            "sample_annotation",
            &instance["last_annotation_token"],
        );
        assert_eq!(
            (&last["sample_token"], &last["size"]),
            (&second["token"], &json!([2.0, 4.0, 1.5]))
        );
        assert_eq!(
            row(&tables, "category", &instance["category_token"])["name"],
            "vehicle.car"
        );
        // The LiDAR 0.5 m behind the vehicle's origin and 2 m above.
        let sweep = &tables["sample_data"][1];
        assert_eq!(
            row(&tables, "ego_pose", &sweep["ego_pose_token"])["translation"],
            json!([1.5, 0.0, 0.0])
        );
        let mount = row(
            &tables,
            "calibrated_sensor",
            &sweep["calibrated_sensor_token"],
        );
        assert_eq!(mount["translation"], json!([-0.5, 0.0, 2.0]));
    }
}
