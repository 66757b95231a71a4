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
use super::points::Sweeps;
use super::yaml::{self, Field};
use super::{FrameSource, ReadError, Tick};
use crate::carla_pose::CarlaPose;
use crate::frame::{Frame, Object, ObjectClass};
use crate::pcd::PcdCloud;

/// Objects without partner get this times the agent's id added, so that ids of two agents do not meet.
const UNMATCHED_STEP: i64 = 100;

/// A scenario of V2V4Real.
#[derive(Debug)]
pub(super) struct V2v4Real(pub(super) ScenarioFolder, pub(super) Sweeps);

impl FrameSource for V2v4Real {
    fn frame(&self, agent: &CavId, tick: &Tick) -> Result<Frame, ReadError> {
        let path = self.0.yaml(agent, &tick.stem);
        let node = yaml::read(&path)?;
        frame_without_points(agent, tick, &Field::root(&path, &node))
    }

    fn points(&self, agent: &CavId, tick: &Tick, variant: Option<&str>) -> Result<PcdCloud, ReadError> {
        self.1.read(agent, &self.points_path(agent, tick, variant))
    }

    fn annotation_path(&self, agent: &CavId, tick: &Tick) -> Option<PathBuf> {
        Some(self.0.yaml(agent, &tick.stem))
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
    if numpy_tags::is_python(field.node()) { Ok(numpy_tags::scalar(field)? / 3.6) } else { speed_mps(field) }
}

/// A pose in whichever of the three forms it is written.
fn pose(field: &Field<'_>) -> Result<Pose, ReadError> {
    let array = if numpy_tags::is_python(field.node()) { numpy_tags::array(field)? } else { nested_list(field)? };
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

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::super::numpy_tags::tests::pickled_matrix;
    use super::super::opv2v::tests::write_frame;
    use crate::dataset::{self, Layout, LoadOptions, ReadError};
    use crate::frame::{Frame, ObjectClass};
    use crate::ground_truth::{GroundTruthRule, merge};

    /// 30 m ahead, half a turn.
    const PARTNER: [f64; 16] = [-1.0, 0.0, 0.0, 30.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    const EGO: [f64; 16] = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];

    fn object(id: i64, x: f64, y: f64, keys: &str) -> String {
        format!(
            "  {id}:\n    angle: [0, 90, 0]\n    center: [0, 0, 0]\n    extent: [2, 1, 0.75]\n    location: [{x}, {y}, -1]\n{keys}"
        )
    }

    fn write(root: &Path, agent: &str, pose: &str, objects: &str) {
        let yaml = format!("{pose}true_ego_pos: [0, 0, 0, 0, 0, 0]\nego_speed: 3.6\nvehicles:\n{objects}");
        write_frame(root, &format!("{agent}/000000"), &yaml, &[[1.0, 2.0, 3.0, 0.5]]);
    }

    fn load(root: &Path, agent: usize) -> Result<Frame, ReadError> {
        let dataset = dataset::open(root).unwrap();
        assert_eq!(dataset.layout, Layout::V2v4Real);
        dataset.scenarios[0].load(agent, 0, &LoadOptions::default())
    }

    #[test]
    fn objects_of_both_agents_meet_in_the_world() {
        let dir = tempfile::tempdir().unwrap();
        let matched = "    ass_id: 5\n    obj_type: Truck\n";
        let walker = object(9, 3.0, 0.0, "    ass_id: 9\n    obj_type: Pedestrian\n");
        write(dir.path(), "0", &pickled_matrix(&EGO), &(object(1, 10.0, 4.0, matched) + &walker));
        let lonely = object(7, 25.0, 0.0, "    ass_id: -1\n");
        write(dir.path(), "1", &pickled_matrix(&PARTNER), &(object(2, 20.0, -4.0, matched) + &lonely));
        let (ego, partner) = (load(dir.path(), 0).unwrap(), load(dir.path(), 1).unwrap());
        assert_eq!(ego.points.xyzi, [[1.0, 2.0, 3.0, 0.5]], "nothing is mirrored");
        assert_eq!(ego.speed_mps, Some(1.0));
        assert_eq!(ego.objects[0].class, ObjectClass::Truck);
        let place = |frame: &Frame| frame.objects[0].world_from_object.translation_m;
        for (a, b) in place(&ego).iter().zip(place(&partner)) {
            assert!((a - b).abs() < 1e-9, "the same truck: {:?} {:?}", place(&ego), place(&partner));
        }
        // Without partner: object id + 100 * agent id. The pedestrian does not count.
        let ids: Vec<i64> =
            merge(&[&ego, &partner], 0, &GroundTruthRule::V2V4REAL).into_iter().map(|(id, _)| id).collect();
        assert_eq!(ids, [5, 107]);
        let heading = ego.objects[0].world_from_object.yaw_rad().to_degrees();
        assert!((heading - 90.0).abs() < 1e-9, "right-handed as it stands: {heading}");
    }

    #[test]
    fn nested_lists_and_six_numbers_are_poses_too() {
        let dir = tempfile::tempdir().unwrap();
        let object = object(1, 10.0, 4.0, "    ass_id: 1\n");
        for pose in [
            "lidar_pose: [[-1, 0, 0, 30], [0, -1, 0, 0], [0, 0, 1, 0], [0, 0, 1e-17, 1]]\n",
            "lidar_pose: [30, 0, 0, 0, 180, 0]\n",
        ] {
            write(dir.path(), "0", pose, &object);
            let [x, y, z] = load(dir.path(), 0).unwrap().objects[0].world_from_object.translation_m;
            assert!((x - 20.0).abs() < 1e-9 && (y + 4.0).abs() < 1e-9 && (z + 1.0).abs() < 1e-9, "{x} {y} {z}");
        }
    }

    #[test]
    fn what_is_no_pose_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let mut scaled = PARTNER;
        scaled[0] = -1.1;
        for (pose, expected) in [
            (pickled_matrix(&scaled), "000000.yaml:2: lidar_pose: pose matrix is not a rotation"),
            (
                "lidar_pose: [[1, 0], [0, 1]]\n".into(),
                "lidar_pose: a list of 2, expected 4 rows of a matrix or 6 numbers",
            ),
            (pickled_matrix(&EGO).replace("_reconstruct", "evil"), "is none of those that are known"),
        ] {
            write(dir.path(), "0", &pose, &object(1, 10.0, 4.0, ""));
            let error = load(dir.path(), 0).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
    }
}
