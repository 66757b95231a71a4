//! YAML of the OPV2V family, as text.

use std::fmt::{self, Write as _};

use nalgebra::Vector3;
use protocol::Pose;

use super::{AgentFrame, BoxAnchor, SceneHeader};
use dataset::frame::{Frame, Object};

/// Kilometres per hour in a metre per second.
const KMH_PER_MPS: f64 = 3.6;
/// First number for vehicles that need a new name.
const FIRST_VEHICLE: usize = 1001;

/// A list of numbers below a key.
pub(super) fn write_list(yaml: &mut String, indent: &str, key: &str, list: &[f64]) -> fmt::Result {
    writeln!(yaml, "{indent}{key}:")?;
    // Minus zero would be another text for the same number; `{:?}` keeps a point in whole numbers.
    let mut values = list.iter();
    values.try_for_each(|value| writeln!(yaml, "{indent}- {:?}", value + 0.0))
}

/// An object of the map of vehicles, in the numbers of the file.
pub(super) struct ObjectEntry<'a> {
    pub(super) object: &'a Object,
    /// Roll, yaw, pitch, degrees.
    pub(super) angle_deg: [f64; 3],
    pub(super) location_m: [f64; 3],
    /// Offset from the location to the centre of the box, added without rotation.
    pub(super) center_m: [f64; 3],
    /// Keys and values of one layout only, in alphabetical order after `angle`.
    pub(super) more: Vec<(&'static str, String)>,
}

impl ObjectEntry<'_> {
    /// Writes the entry, with keys in alphabetical order.
    fn write(&self, yaml: &mut String) -> fmt::Result {
        writeln!(yaml, "  {}:", self.object.id)?;
        let half_m = self.object.size_m.map(|size| size / 2.0);
        for (key, list, next) in [
            ("angle", self.angle_deg, "center"),
            ("center", self.center_m, "extent"),
            ("extent", half_m, "location"),
            ("location", self.location_m, "speed"),
        ] {
            write_list(yaml, "    ", key, &list)?;
            let more = self.more.iter();
            let mut between = more.filter(|(more, _)| key < *more && *more < next);
            between.try_for_each(|(key, value)| writeln!(yaml, "    {key}: {value}"))?;
        }
        write_speed(yaml, "    speed", self.object.speed_mps)
    }
}

/// Writes a speed, where it is known.
pub(super) fn write_speed(yaml: &mut String, key: &str, speed_mps: Option<f64>) -> fmt::Result {
    match speed_mps {
        Some(speed_mps) => writeln!(yaml, "{key}: {}", KMH_PER_MPS * speed_mps),
        None => Ok(()),
    }
}

/// The poses of a frame that the right-handed layouts hold, with their keys.
pub(super) fn keyed_poses(frame: &Frame) -> impl Iterator<Item = (&'static str, Pose)> {
    let lidar = frame.world_from_lidar.map(|pose| ("lidar_pose", pose));
    let vehicle = frame.world_from_vehicle.map(|pose| ("true_ego_pos", pose));
    lidar.into_iter().chain(vehicle)
}

/// Writes the objects of a frame, each with the anchor of its box.
pub(super) fn write_vehicles<'a>(
    yaml: &mut String,
    agent: &'a AgentFrame,
    entry: impl Fn(&'a Object, &BoxAnchor) -> ObjectEntry<'a>,
) -> fmt::Result {
    let objects = &agent.frame.objects;
    if objects.is_empty() {
        return writeln!(yaml, "vehicles: {{}}");
    }
    writeln!(yaml, "vehicles:")?;
    let mut anchored = objects.iter().zip(anchors(agent));
    anchored.try_for_each(|(object, anchor)| entry(object, &anchor).write(yaml))
}

/// Reference points of the objects of a frame: from the simulation if known, else the centre of the box's bottom face.
fn anchors(frame: &AgentFrame) -> Vec<BoxAnchor> {
    if let Some(simulated) = &frame.simulated {
        return simulated.anchors.clone();
    }
    let bottoms = frame.frame.objects.iter().map(|object| {
        let pose = object.world_from_object;
        let up = pose.isometry().rotation * Vector3::new(0.0, 0.0, object.size_m[2] / 2.0);
        let location_m = Vector3::from(pose.translation_m) - up;
        BoxAnchor {
            location_m: location_m.into(),
            center_offset_m: up.into(),
        }
    });
    bottoms.collect()
}

/// The folders of a scene's agents. Readers sort them as text, roadside units (negative numbers) last: where the
/// agents' own names are not such numbers, they are numbered.
pub(super) fn agent_folders(scene: &SceneHeader) -> Vec<String> {
    let agents = &scene.agents;
    let own: Vec<String> = agents.iter().map(|agent| agent.id.to_string()).collect();
    if scene.agents.iter().all(|agent| {
        let number = agent.id.as_str().parse::<i64>();
        number.is_ok_and(|number| (number < 0) == agent.is_roadside)
    }) && own.is_sorted_by_key(|name: &String| (name.starts_with('-'), name.clone()))
    {
        return own;
    }
    let (mut vehicles, mut units) = (FIRST_VEHICLE.., 1..);
    let folders = agents.iter().map(|agent| match agent.is_roadside {
        true => format!("-{}", units.next().unwrap_or_default()),
        false => vehicles.next().unwrap_or_default().to_string(),
    });
    folders.collect()
}

#[cfg(test)]
mod tests {
    use dataset::frame::ObjectClass;
    use protocol::{CavId, Pose};

    use super::super::SceneAgent;
    use super::*;

    fn folders(agents: &[(&str, bool)]) -> Vec<String> {
        let agents = agents
            .iter()
            .map(|&(id, is_roadside)| SceneAgent {
                id: CavId::new(id).unwrap(),
                is_roadside,
            })
            .collect();
        agent_folders(&SceneHeader {
            name: "a".into(),
            agents,
            capture_nanos: vec![],
            tick_nanos: 1,
            origin: String::new(),
        })
    }

    #[test]
    fn agents_keep_names_that_readers_take_in_the_same_order() {
        assert_eq!(
            folders(&[("1045", false), ("650", false), ("-1", true)]),
            ["1045", "650", "-1"]
        );
        assert_eq!(
            folders(&[("650", false), ("1045", false)]),
            ["1001", "1002"],
            "the ego would be another one"
        );
        assert_eq!(
            folders(&[("vehicle", false), ("unit", true)]),
            ["1001", "-1"]
        );
        assert_eq!(
            folders(&[("2", false), ("3", true)]),
            ["1001", "-1"],
            "a unit has a negative number"
        );
    }

    #[test]
    fn keys_of_an_object_are_in_alphabetical_order() {
        let more = [("ass_id", "7".to_owned()), ("obj_type", "Car".to_owned())];
        let object = Object {
            id: 7,
            class: ObjectClass::Car,
            world_from_object: Pose::IDENTITY,
            size_m: [4.0, 2.0, 1.5],
            speed_mps: Some(10.0),
        };
        let entry = ObjectEntry {
            object: &object,
            angle_deg: [0.0, 90.0, -0.0],
            location_m: [1.0, 2.5, 0.0],
            center_m: [0.0; 3],
            more: more.into(),
        };
        let mut yaml = String::new();
        entry.write(&mut yaml).unwrap();
        let keys: Vec<&str> = yaml
            .lines()
            .filter_map(|line| line.trim().split_once(':'))
            .map(|(key, _)| key)
            .collect();
        assert_eq!(
            keys,
            [
                "7", "angle", "ass_id", "center", "extent", "location", "obj_type", "speed"
            ]
        );
        assert!(
            yaml.contains("    - 0.0\n    - 90.0\n    - 0.0\n") && yaml.ends_with("speed: 36\n"),
            "{yaml}"
        );
    }
}
