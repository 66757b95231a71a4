//! Frames of OPV2V, V2XSet, V2X-R, V2VDet and generated scenes.
//!
//! The files are left-handed: points, poses and boxes are mirrored here, all together.

use std::path::{Path, PathBuf};

use protocol::{CavId, Handedness, Pose};

use super::agent_folders::ScenarioFolder;
use super::yaml::{self, Field};
use super::{FrameSource, ReadError, Tick, points};
use crate::carla_pose::CarlaPose;
use crate::frame::{Frame, Object, ObjectClass};
use crate::pcd::PcdCloud;

/// Kilometres per hour in a metre per second.
const KMH_PER_MPS: f64 = 3.6;

/// A scenario of the family.
#[derive(Debug)]
pub(super) struct Opv2v(pub(super) ScenarioFolder);

impl FrameSource for Opv2v {
    fn frame(&self, agent: &CavId, tick: &Tick) -> Result<Frame, ReadError> {
        if self.0.without_yaml.contains(agent) {
            return Ok(Frame::empty(agent.clone(), tick.capture_nanos, Handedness::Left));
        }
        let path = self.0.yaml(agent, &tick.stem);
        let node = yaml::read(&path)?;
        frame_without_points(agent, tick, &Field::root(&path, &node))
    }

    fn points(&self, agent: &CavId, tick: &Tick, variant: Option<&str>) -> Result<PcdCloud, ReadError> {
        mirrored(&self.points_path(agent, tick, variant))
    }

    fn radar(&self, agent: &CavId, tick: &Tick) -> Result<PcdCloud, ReadError> {
        mirrored(&self.0.radar(agent, &tick.stem))
    }

    fn annotation_path(&self, agent: &CavId, tick: &Tick) -> Option<PathBuf> {
        Some(self.0.yaml(agent, &tick.stem)).filter(|_| !self.0.without_yaml.contains(agent))
    }

    fn points_path(&self, agent: &CavId, tick: &Tick, variant: Option<&str>) -> PathBuf {
        self.0.pcd(agent, &tick.stem, variant)
    }
}

/// Reads left-handed points and makes them right-handed.
fn mirrored(path: &Path) -> Result<PcdCloud, ReadError> {
    let mut cloud = points::read_pcd(path)?;
    points::mirror_y(&mut cloud.points);
    Ok(cloud)
}

fn frame_without_points(agent: &CavId, tick: &Tick, root: &Field<'_>) -> Result<Frame, ReadError> {
    let optional_pose = |key| root.optional(key)?.map(|field| six_numbers(&field)).transpose();
    Ok(Frame {
        world_from_lidar: optional_pose("lidar_pose")?,
        world_from_vehicle: optional_pose("true_ego_pos")?,
        gnss_world_from_vehicle: optional_pose("predicted_ego_pos")?,
        speed_mps: root.optional("ego_speed")?.map(|speed| speed_mps(&speed)).transpose()?,
        objects: objects(root)?,
        ..Frame::empty(agent.clone(), tick.capture_nanos, Handedness::Left)
    })
}

/// x, y, z, roll, yaw, pitch in metres and degrees.
fn six_numbers(field: &Field<'_>) -> Result<Pose, ReadError> {
    let pose = CarlaPose::from(field.numbers::<6>()?).to_pose();
    pose.validate().map_err(|error| field.error(error.to_string()))?;
    Ok(pose)
}

/// km/h to m/s. Relatives of the format write a vector; its length is the speed.
pub(super) fn speed_mps(field: &Field<'_>) -> Result<f64, ReadError> {
    let kmh = match field.items() {
        Ok(_) => field.numbers::<3>()?.iter().map(|component| component * component).sum::<f64>().sqrt(),
        Err(_) => field.number()?,
    };
    Ok(kmh / KMH_PER_MPS)
}

fn objects(root: &Field<'_>) -> Result<Vec<Object>, ReadError> {
    object_entries(root)?
        .into_iter()
        .map(|(key, field)| {
            let pose = object_pose(&field)?.to_pose();
            pose.validate().map_err(|error| field.error(error.to_string()))?;
            Ok(Object {
                id: object_id(key, &field)?,
                class: ObjectClass::Car,
                world_from_object: pose,
                size_m: object_size(&field)?,
                speed_mps: field.optional("speed")?.map(|speed| speed_mps(&speed)).transpose()?,
            })
        })
        .collect()
}

/// The map of annotated objects: `vehicles`, or `objects` in relatives of the format.
pub(super) fn object_entries<'a>(root: &Field<'a>) -> Result<Vec<(&'a str, Field<'a>)>, ReadError> {
    let has = |key: &str| root.entries().is_ok_and(|entries| entries.iter().any(|(found, _)| *found == key));
    let key = if !has("vehicles") && has("objects") { "objects" } else { "vehicles" };
    match root.optional(key)? {
        Some(field) => field.entries(),
        // An empty map may be written as nothing, or left out where nobody has annotated anything.
        None => Ok(Vec::new()),
    }
}

pub(super) fn object_id(key: &str, field: &Field<'_>) -> Result<i64, ReadError> {
    key.parse().map_err(|_| field.error(format!("{key:?} is no object id: expected an integer")))
}

/// Where the box's centre is and how it is turned, in the numbers of the file.
pub(super) fn object_pose(field: &Field<'_>) -> Result<CarlaPose, ReadError> {
    let center = field.optional("center")?.map_or(Ok([0.0; 3]), |center| center.numbers::<3>())?;
    let (location, angle) = (field.required("location")?.numbers()?, field.required("angle")?.numbers()?);
    Ok(CarlaPose::of_box(location, angle, center))
}

/// `extent` holds half sizes.
pub(super) fn object_size(field: &Field<'_>) -> Result<[f64; 3], ReadError> {
    let extent = field.required("extent")?;
    let half = extent.numbers::<3>()?;
    if half.iter().any(|half| !(0.0..=100.0).contains(half)) {
        return Err(extent.error(format!("{half:?} are no half sizes in metres")));
    }
    Ok(half.map(|half| 2.0 * half))
}

/// What tells a scenario's layouts apart: the first of its frames that can be read.
pub(super) fn is_v2v4real(path: &Path) -> Result<bool, ReadError> {
    let node = yaml::read(path)?;
    let root = Field::root(path, &node);
    let is_matrix = root.required("lidar_pose")?.numbers::<6>().is_err() && !is_flat_list(&root);
    let has_association = object_entries(&root)
        .is_ok_and(|objects| objects.iter().any(|(_, object)| matches!(object.optional("ass_id"), Ok(Some(_)))));
    Ok(is_matrix || has_association)
}

/// A list of scalars of whatever length is a pose of OPV2V, if a wrong one.
fn is_flat_list(root: &Field<'_>) -> bool {
    let items = root.required("lidar_pose").and_then(|pose| pose.items());
    items.is_ok_and(|items| items.iter().all(|item| item.items().is_err()))
}

#[cfg(test)]
pub(super) mod tests {
    use std::fs;

    use super::*;
    use crate::dataset::{self, Layout, LoadOptions, Scenario};
    use crate::pcd::{self, Encoding, IntensityField};

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
    pub(in crate::dataset) fn write_frame(root: &Path, name: &str, yaml: &str, points: &[[f32; 4]]) {
        let yaml_path = root.join(format!("{name}.yaml"));
        fs::create_dir_all(yaml_path.parent().unwrap()).unwrap();
        fs::write(yaml_path, yaml).unwrap();
        write_points(root, name, points);
    }

    fn write_points(root: &Path, name: &str, points: &[[f32; 4]]) {
        let cloud = protocol::PointCloud { xyzi: points.to_vec() };
        let bytes = pcd::encode(&cloud, Encoding::Binary, IntensityField::Intensity);
        fs::write(root.join(format!("{name}.pcd")), bytes).unwrap();
    }

    fn opened(root: &Path) -> Scenario {
        let mut dataset = dataset::open(root).unwrap();
        assert!(dataset.problems.is_empty(), "{:?}", dataset.problems);
        dataset.scenarios.swap_remove(0)
    }

    fn message_with(from: &str, to: &str) -> String {
        let dir = tempfile::tempdir().unwrap();
        let yaml = YAML.replace(from, to);
        assert_ne!(yaml, YAML);
        write_frame(dir.path(), "1/000070", &yaml, &[]);
        let error = opened(dir.path()).load(0, 0, &LoadOptions::default()).unwrap_err();
        error.to_string().replace(&*dir.path().to_string_lossy(), "")
    }

    #[test]
    fn a_frame_is_mirrored_as_a_whole() {
        let dir = tempfile::tempdir().unwrap();
        write_frame(dir.path(), "1/000070", YAML, &[[1.0, 2.0, 3.0, 0.5]]);
        let scenario = opened(dir.path());
        assert_eq!((scenario.layout, scenario.source_handedness), (Layout::Opv2v, Handedness::Left));
        let frame = scenario.load(0, 0, &LoadOptions::default()).unwrap();
        assert_eq!(frame.points.xyzi, [[1.0, -2.0, 3.0, 0.5]]);
        let lidar = frame.world_from_lidar.unwrap();
        assert_eq!(lidar.translation_m, [10.0, -20.0, 2.0]);
        assert!((lidar.yaw_rad().to_degrees() + 90.0).abs() < 1e-9, "to the right is negative");
        assert_eq!(frame.speed_mps, Some(10.0));
        let car = &frame.objects[0];
        assert_eq!((car.id, car.size_m, car.speed_mps), (4335, [4.0, 2.0, 1.5], Some(5.0)));
        // `center` is added without being turned, though the car is.
        assert_eq!(car.world_from_object.translation_m, [10.5, -30.0, 0.7]);
        let ahead = lidar.isometry().inverse() * car.world_from_object.isometry();
        assert!((ahead.translation.vector.x - 10.0).abs() < 1e-6 && (ahead.translation.vector.y - 0.5).abs() < 1e-6);
        let gnss = frame.gnss_world_from_lidar().unwrap();
        assert!((gnss.yaw_rad() - lidar.yaw_rad()).to_degrees().abs() - 0.5 < 1e-3, "another branch of the yaw");
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
        let with_radar = load(&LoadOptions { radar: true, points: false, ..Default::default() });
        assert_eq!(with_radar.radar.unwrap().xyzi, [[7.0, -8.0, 9.0, 0.25]]);
        assert!(with_radar.points.is_empty());
        let fog = LoadOptions { lidar_variant: Some("fog_0.060".into()), ..Default::default() };
        assert_eq!(load(&fog).points.xyzi, [[4.0, -5.0, 6.0, 0.5]]);
        let rain = LoadOptions { lidar_variant: Some("rain".into()), ..Default::default() };
        let error = scenario.load(0, 0, &rain).unwrap_err().to_string();
        assert!(error.contains("LiDAR variant rain does not exist (there are [\"fog_0.060\"])"), "{error}");
        let error = scenario.load(1, 0, &LoadOptions::default()).unwrap_err().to_string();
        assert!(error.contains("agent 1 does not exist (there are 1, counted from 0)"), "{error}");
    }

    #[test]
    fn what_is_wrong_names_file_line_and_field() {
        let cases = [
            (
                "lidar_pose: [10, 20, 2, 0, 90, 1e-06]",
                "lidar_pose: [10, 20, 2]",
                ":3: lidar_pose: a list of 3, expected 6 numbers",
            ),
            ("lidar_pose: [10,", "lidar_pose: [.inf,", ":3: lidar_pose.0: inf, expected a finite number"),
            (
                "extent: [2, 1, 0.75]",
                "extent: [2, -1, 0.75]",
                ":12: vehicles.4335.extent: [2.0, -1.0, 0.75] are no half sizes in metres",
            ),
            ("    location: [10, 30, 0]\n", "", ":10: vehicles.4335.location: missing"),
            ("  4335:", "  car:", ":10: vehicles.car: \"car\" is no object id: expected an integer"),
        ];
        for (from, to, expected) in cases {
            assert_eq!(message_with(from, to), format!("/1/000070.yaml{expected}"));
        }
    }

    #[test]
    fn relatives_of_the_format_are_understood() {
        let dir = tempfile::tempdir().unwrap();
        let yaml = YAML.replace("vehicles:", "objects:").replace("speed: 18", "speed: [10.8, 0, 14.4]");
        write_frame(dir.path(), "1/000070", &yaml, &[]);
        let frame = opened(dir.path()).load(0, 0, &LoadOptions::default()).unwrap();
        assert!((frame.objects[0].speed_mps.unwrap() - 5.0).abs() < 1e-12);
        let (head, _) = YAML.split_once("  4335").unwrap();
        for empty in ["vehicles: {}\n", "vehicles:\n"] {
            write_frame(dir.path(), "1/000070", &head.replace("vehicles:\n", empty), &[]);
            assert!(opened(dir.path()).load(0, 0, &LoadOptions::default()).unwrap().objects.is_empty());
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
}
