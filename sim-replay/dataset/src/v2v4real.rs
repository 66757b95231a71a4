//! Frames of V2V4Real.
//!
//! The folders are OPV2V's. Differences: right-handed axes, pose matrices (pickled NumPy arrays or lists), objects in
//! the frame of the agent's own LiDAR, and ids that associate objects across agents.

use std::path::PathBuf;

use protocol::{CavId, Handedness, Pose};

use super::agent_folders::ScenarioFolder;
use super::annotations::Annotations;
use super::points::Sweeps;
use super::written_pose::{WrittenPose, rigid};
use super::yaml::{self, YamlField};
use super::{FrameSource, Result, Tick, poses};
use crate::frame::Frame;
use crate::pcd::PcdCloud;

/// Objects without partner get this times the agent's id added, so that ids of two agents do not collide.
const UNMATCHED_STEP: i64 = 100;

/// A scenario of V2V4Real.
#[derive(Debug)]
pub(super) struct V2v4Real {
    pub(super) folder: ScenarioFolder,
    pub(super) sweeps: Sweeps,
}

impl FrameSource for V2v4Real {
    fn frame(&self, agent: &CavId, tick: &Tick) -> Result<Frame> {
        let mut frame = Frame::empty(agent.clone(), tick.capture_nanos, Handedness::Right);
        let path = self.folder.yaml(agent, &tick.stem);
        let node = yaml::read(&path)?;
        let root = YamlField::root(&path, &node);
        let world_from_lidar = lidar_pose(&root.required("lidar_pose")?)?;
        frame.world_from_lidar = Some(world_from_lidar);
        let mut annotations = Annotations::new(root);
        frame.objects = annotations.objects(
            |id, field| self.associated_id(agent, id, field),
            |place| {
                let lidar_from_object = Pose::from_matrix(&place.left_handed_matrix())?;
                poses::valid(world_from_lidar.isometry() * lidar_from_object.isometry())
            },
        );
        annotations.add_vehicle(&mut frame, pose);
        frame.problems = annotations.problems;
        Ok(frame)
    }

    fn points(&self, agent: &CavId, tick: &Tick, variant: Option<&str>) -> Result<PcdCloud> {
        self.sweeps
            .read(agent, &self.points_path(agent, tick, variant))
    }

    fn shared_files(&self, agent: &CavId) -> Vec<PathBuf> {
        self.sweeps.samples(agent, [self.folder.tick_length()])
    }

    fn frame_files(&self, agent: &CavId, tick: &Tick) -> Vec<PathBuf> {
        vec![self.folder.yaml(agent, &tick.stem)]
    }

    fn points_path(&self, agent: &CavId, tick: &Tick, variant: Option<&str>) -> PathBuf {
        self.folder.pcd(agent, &tick.stem, variant)
    }
}

impl V2v4Real {
    /// `ass_id` is the id that both agents share; -1 means that only this agent has the object.
    fn associated_id(&self, agent: &CavId, listed_id: i64, field: &YamlField<'_>) -> Result<i64> {
        let associated = field.optional("ass_id")?;
        match associated.map(|id| id.integer()).transpose()? {
            None => Ok(listed_id),
            Some(-1) => {
                // Agents with names count by their index.
                let agent = agent.as_str().parse::<i64>().unwrap_or_else(|_| {
                    let mut agents = self.folder.agents.iter();
                    agents.position(|id| id == agent).unwrap_or(0) as i64
                });
                Ok(listed_id.saturating_add(UNMATCHED_STEP.saturating_mul(agent)))
            }
            Some(shared) => Ok(shared),
        }
    }
}

fn lidar_pose(field: &YamlField<'_>) -> Result<Pose> {
    match WrittenPose::read(field)? {
        WrittenPose::Matrix(matrix) => rigid(&matrix, field),
        WrittenPose::SixNumbers(_) => Err(field.error(
            "6 numbers as in OPV2V, but the scenario's first frame has a lidar_pose of 4x4 numbers as in V2V4Real",
        )),
    }
}

/// A matrix, or six numbers by the reference's formula in the right-handed axes of this data set: nothing is mirrored.
fn pose(field: &YamlField<'_>) -> Result<Pose> {
    match WrittenPose::read(field)? {
        WrittenPose::Matrix(matrix) => rigid(&matrix, field),
        WrittenPose::SixNumbers(place) => rigid(&place.left_handed_matrix(), field),
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::super::opv2v::tests::write_frame;
    use super::super::yaml::numpy_tags::tests::pickled_matrix;
    use crate::frame::{Frame, ObjectClass};
    use crate::ground_truth::{GroundTruthRule, merged_objects};
    use crate::{Layout, LoadOptions, ReadError};

    /// 30 m ahead, half a turn.
    const PARTNER: [f64; 16] = [
        -1.0, 0.0, 0.0, 30.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0,
    ];
    const EGO: [f64; 16] = [
        1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0,
    ];

    fn object(id: i64, x: f64, y: f64, keys: &str) -> String {
        format!(
            "  {id}:\n    angle: [0, 90, 0]\n    center: [0, 0, 0]\n    extent: [2, 1, 0.75]\n    location: [{x}, {y}, -1]\n{keys}"
        )
    }

    fn write(root: &Path, agent: &str, pose: &str, objects: &str) {
        let yaml =
            format!("{pose}true_ego_pos: [0, 0, 0, 0, 0, 0]\nego_speed: 3.6\nvehicles:\n{objects}");
        write_frame(
            root,
            &format!("{agent}/000000"),
            &yaml,
            &[[1.0, 2.0, 3.0, 0.5]],
        );
    }

    fn load(root: &Path, agent: usize) -> Result<Frame, ReadError> {
        let dataset = crate::open(root).unwrap();
        assert_eq!(dataset.layout, Layout::V2V4REAL);
        dataset.scenarios[0].load(agent, 0, &LoadOptions::default())
    }

    #[test]
    fn objects_of_both_agents_meet_in_the_world() {
        let dir = tempfile::tempdir().unwrap();
        let matched = "    ass_id: 5\n    obj_type: Truck\n";
        let walker = object(9, 3.0, 0.0, "    ass_id: 9\n    obj_type: Pedestrian\n");
        write(
            dir.path(),
            "0",
            &pickled_matrix(&EGO),
            &(object(1, 10.0, 4.0, matched) + &walker),
        );
        let lonely = object(7, 25.0, 0.0, "    ass_id: -1\n");
        write(
            dir.path(),
            "1",
            &pickled_matrix(&PARTNER),
            &(object(2, 20.0, -4.0, matched) + &lonely),
        );
        let (ego, partner) = (load(dir.path(), 0).unwrap(), load(dir.path(), 1).unwrap());
        assert_eq!(
            ego.points.xyzi,
            [[1.0, 2.0, 3.0, 0.5]],
            "nothing is mirrored"
        );
        assert_eq!(ego.speed_mps, Some(1.0));
        assert_eq!(ego.objects[0].class, ObjectClass::Truck);
        let places = [&ego, &partner].map(|frame| frame.objects[0].world_from_object.translation_m);
        for (a, b) in places[0].iter().zip(places[1]) {
            assert!((a - b).abs() < 1e-9, "the same truck: {places:?}");
        }
        // Without partner: object id + 100 * agent id. The pedestrian does not count.
        let ids: Vec<i64> = merged_objects(&[&ego, &partner], 0, &GroundTruthRule::V2V4REAL)
            .into_iter()
            .map(|(object, _)| object.id)
            .collect();
        assert_eq!(ids, [5, 107]);
        let heading = ego.objects[0].world_from_object.yaw_rad().to_degrees();
        assert!(
            (heading - 90.0).abs() < 1e-9,
            "right-handed as it stands: {heading}"
        );
    }

    #[test]
    fn nested_lists_and_sixteen_numbers_are_poses_too() {
        let dir = tempfile::tempdir().unwrap();
        let object = object(1, 10.0, 4.0, "    ass_id: 1\n");
        for pose in [
            "lidar_pose: [[-1, 0, 0, 30], [0, -1, 0, 0], [0, 0, 1, 0], [0, 0, 1e-17, 1]]\n",
            "lidar_pose: [-1, 0, 0, 30, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n",
        ] {
            write(dir.path(), "0", pose, &object);
            let [x, y, z] = load(dir.path(), 0).unwrap().objects[0]
                .world_from_object
                .translation_m;
            assert!(
                (x - 20.0).abs() < 1e-9 && (y + 4.0).abs() < 1e-9 && (z + 1.0).abs() < 1e-9,
                "{x} {y} {z}"
            );
        }
    }

    #[test]
    fn an_invalid_pose_is_reported() {
        let dir = tempfile::tempdir().unwrap();
        let sound = pickled_matrix(&EGO);
        write(dir.path(), "0", &sound, "");
        let mut scaled = PARTNER;
        scaled[0] = -1.1;
        for (pose, expected) in [
            (
                pickled_matrix(&scaled),
                "000000.yaml:2: lidar_pose: pose matrix is not a rotation",
            ),
            (
                "lidar_pose: [[1, 0], [0, 1]]\n".into(),
                "lidar_pose: a list of 2, expected 6 numbers or a 4x4 matrix",
            ),
            (
                pickled_matrix(&EGO).replace("_reconstruct", "evil"),
                "is not supported",
            ),
            (
                "lidar_pose: [1, 2, 3, 4, 5, 6]\n".into(),
                "lidar_pose: 6 numbers as in OPV2V, but the scenario's first",
            ),
        ] {
            write(dir.path(), "1", &pose, &object(1, 10.0, 4.0, ""));
            let error = load(dir.path(), 1).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
    }

    #[test]
    fn faults_of_an_object_or_another_pose_cost_no_frame() {
        let dir = tempfile::tempdir().unwrap();
        let objects = object(1, 10.0, 4.0, "    ass_id: one\n")
            + &object(2, 1e9, 0.0, "")
            + &object(3, 5.0, 0.0, "");
        write(
            dir.path(),
            "0",
            &(pickled_matrix(&EGO) + "predicted_ego_pos: [1, 2]\n"),
            &objects,
        );
        let frame = load(dir.path(), 0).unwrap();
        assert_eq!((frame.objects.len(), frame.points.len()), (1, 1));
        let fields: Vec<&str> = frame
            .problems
            .iter()
            .filter_map(|problem| problem.field.as_deref())
            .collect();
        assert_eq!(
            fields,
            ["vehicles.1.ass_id", "vehicles.2", "predicted_ego_pos"]
        );
    }
}
