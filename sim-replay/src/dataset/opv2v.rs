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
        world_from_lidar: Some(six_numbers(&root.required("lidar_pose")?)?),
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
        // An empty map may be written as nothing; a key that is not there is an error.
        None if has(key) => Ok(Vec::new()),
        None => root.required(key).map(|_| Vec::new()),
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
