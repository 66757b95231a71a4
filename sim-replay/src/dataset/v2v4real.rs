//! Frames of V2V4Real.
//!
//! The folders are OPV2V's. Different are: right-handed axes, pose matrices (pickled NumPy arrays; nested lists and
//! six numbers are read too), objects in the frame of the agent's own LiDAR, and ids that associate objects across
//! agents.

use std::path::PathBuf;

use nalgebra::{Matrix4, RowVector4};
use protocol::{CavId, Handedness, Pose};

use super::agent_folders::ScenarioFolder;
use super::numpy_tags::{self, NumpyArray};
use super::opv2v::{object_entries, object_id, object_pose, object_size, speed_mps};
use super::yaml::{self, Field};
use super::{FrameSource, ReadError, Tick, points};
use crate::carla_pose::CarlaPose;
use crate::frame::{Frame, Object, ObjectClass};
use crate::pcd::PcdCloud;

/// Objects without partner get this times the agent's id added, so that ids of two agents do not meet.
const UNMATCHED_STEP: i64 = 100;

/// A scenario of V2V4Real.
#[derive(Debug)]
pub(super) struct V2v4Real(pub(super) ScenarioFolder);

impl FrameSource for V2v4Real {
    fn frame(&self, agent: &CavId, tick: &Tick) -> Result<Frame, ReadError> {
        let path = self.0.yaml(agent, &tick.stem);
        let node = yaml::read(&path)?;
        frame_without_points(agent, tick, &Field::root(&path, &node))
    }

    fn points(&self, agent: &CavId, tick: &Tick, variant: Option<&str>) -> Result<PcdCloud, ReadError> {
        points::read_pcd(&self.points_path(agent, tick, variant))
    }

    fn points_path(&self, agent: &CavId, tick: &Tick, variant: Option<&str>) -> PathBuf {
        self.0.pcd(agent, &tick.stem, variant)
    }
}

fn frame_without_points(agent: &CavId, tick: &Tick, root: &Field<'_>) -> Result<Frame, ReadError> {
    let world_from_lidar = pose(&root.required("lidar_pose")?)?;
    let optional_pose = |key| root.optional(key)?.map(|field| pose(&field)).transpose();
    Ok(Frame {
        world_from_lidar: Some(world_from_lidar),
        world_from_vehicle: optional_pose("true_ego_pos")?,
        gnss_world_from_vehicle: optional_pose("predicted_ego_pos")?,
        speed_mps: root.optional("ego_speed")?.map(|speed| number_or_scalar(&speed)).transpose()?,
        objects: objects(agent, root, &world_from_lidar)?,
        ..Frame::empty(agent.clone(), tick.capture_nanos, Handedness::Right)
    })
}

fn number_or_scalar(field: &Field<'_>) -> Result<f64, ReadError> {
    if numpy_tags::is_python(field) { Ok(numpy_tags::scalar(field)? / 3.6) } else { speed_mps(field) }
}

/// A pose in whichever of the three forms it is written.
fn pose(field: &Field<'_>) -> Result<Pose, ReadError> {
    let array = if numpy_tags::is_python(field) { numpy_tags::array(field)? } else { nested_list(field)? };
    match array.shape[..] {
        [4, 4] => rigid(&Matrix4::from_row_slice(&array.values), field),
        // The reference's formula for six numbers, in the right-handed axes of this dataset: nothing is mirrored.
        [6] => {
            let values = std::array::from_fn::<f64, 6, _>(|index| array.values[index]);
            rigid(&CarlaPose::from(values).left_handed_matrix(), field)
        }
        ref shape => Err(field.error(format!("shape {shape:?}, expected a 4x4 matrix or 6 numbers"))),
    }
}

fn nested_list(field: &Field<'_>) -> Result<NumpyArray, ReadError> {
    let rows = field.items()?;
    if rows.len() == 4 {
        let rows: Vec<[f64; 4]> = rows.iter().map(Field::numbers::<4>).collect::<Result<_, _>>()?;
        return Ok(NumpyArray { shape: vec![4, 4], values: rows.concat() });
    }
    if rows.len() == 6 {
        return Ok(NumpyArray { shape: vec![6], values: field.numbers::<6>()?.to_vec() });
    }
    Err(field.error(format!("a list of {}, expected 4 rows of a matrix or 6 numbers", rows.len())))
}

fn rigid(matrix: &Matrix4<f64>, field: &Field<'_>) -> Result<Pose, ReadError> {
    let mut matrix = *matrix;
    let last = RowVector4::new(0.0, 0.0, 0.0, 1.0);
    // Inverting and multiplying matrices leaves rounding in the last row.
    if (matrix.row(3) - last).amax() < 1e-8 {
        matrix.set_row(3, &last);
    }
    Pose::from_matrix(&matrix).map_err(|error| field.error(error.to_string()))
}

fn objects(agent: &CavId, root: &Field<'_>, world_from_lidar: &Pose) -> Result<Vec<Object>, ReadError> {
    object_entries(root)?
        .into_iter()
        .map(|(key, field)| {
            let lidar_from_object = rigid(&object_pose(&field)?.left_handed_matrix(), &field)?;
            Ok(Object {
                id: associated_id(agent, object_id(key, &field)?, &field)?,
                class: class(&field)?,
                world_from_object: (world_from_lidar.isometry() * lidar_from_object.isometry()).into(),
                size_m: object_size(&field)?,
                speed_mps: field.optional("speed")?.map(|speed| number_or_scalar(&speed)).transpose()?,
            })
        })
        .collect()
}

/// `ass_id` is the id that both agents share; -1 says that only this agent has the object.
fn associated_id(agent: &CavId, object_id: i64, field: &Field<'_>) -> Result<i64, ReadError> {
    match field.optional("ass_id")?.map(|id| id.integer()).transpose()? {
        None => Ok(object_id),
        Some(-1) => {
            // Folder names are integers, or the scenario would not have been found.
            let agent = agent.as_str().parse::<i64>().unwrap_or(0);
            Ok(object_id.saturating_add(UNMATCHED_STEP.saturating_mul(agent)))
        }
        Some(shared) => Ok(shared),
    }
}

fn class(field: &Field<'_>) -> Result<ObjectClass, ReadError> {
    let Some(kind) = field.optional("obj_type")? else { return Ok(ObjectClass::Car) };
    Ok(match kind.text()? {
        "Car" => ObjectClass::Car,
        "Van" => ObjectClass::Van,
        "Truck" | "ConcreteTruck" => ObjectClass::Truck,
        "Bus" => ObjectClass::Bus,
        "Pedestrian" => ObjectClass::Pedestrian,
        "ScooterRider" | "BicycleRider" | "Scooter" => ObjectClass::TwoWheeler,
        _ => ObjectClass::Other,
    })
}
