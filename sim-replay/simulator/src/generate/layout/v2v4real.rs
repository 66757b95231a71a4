//! V2V4Real: the folders of OPV2V, right-handed. Poses are 4x4 matrices that PyYAML pickled from NumPy, objects stand
//! in the frame of the agent's own LiDAR, and `ass_id` is the id that agents share.

use std::fmt::Write as _;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use protocol::Pose;

use super::AgentFrame;
use super::agent_folders::TickFiles;
use super::boxes::real_type;
use super::yaml_text::{ObjectEntry, keyed_poses, write_speed, write_vehicles};
use crate::generate::error::SynthError;
use dataset::carla_pose::CarlaPose;

use dataset::pcd::{self, Encoding, IntensityField};

/// A pickled 4x4 matrix up to its numbers; anchors are numbered, as PyYAML numbers them.
const MATRIX_HEAD: &str = "!!python/object/apply:numpy.core.multiarray._reconstruct
  args:
  - !!python/name:numpy.ndarray ''
  - !!python/tuple
    - 0
  - !!binary |
    Yg==
  state: !!python/tuple
  - 1
  - !!python/tuple
    - 4
    - 4
  - !!python/object/apply:numpy.dtype
    args:
    - f8
    - false
    - true
    state: !!python/tuple
    - 3
    - <
    - null
    - null
    - null
    - -1
    - -1
    - 0
  - false
  - !!binary |
";
/// Characters in a line of base64, as PyYAML breaks them.
const BASE64_LINE: usize = 76;

pub(super) fn write_files(files: &TickFiles<'_>, frame: &AgentFrame) -> Result<(), SynthError> {
    let points = &frame.frame.points;
    let points = pcd::encode(points, Encoding::Binary, IntensityField::Intensity);
    files.write(".pcd", points)?;
    files.write_yaml(frame, |yaml| write_frame(yaml, frame))
}

fn write_frame(yaml: &mut String, agent: &AgentFrame) -> std::fmt::Result {
    let frame = &agent.frame;
    write_speed(yaml, "ego_speed", frame.speed_mps)?;
    for (key, pose) in keyed_poses(frame) {
        writeln!(yaml, "{key}: {}", pickled_matrix(&pose))?;
    }
    let lidar_from_world = agent.world_from_lidar().inverse();
    write_vehicles(yaml, agent, |object, _| {
        let lidar_from_object: Pose =
            (lidar_from_world * object.world_from_object.isometry()).into();
        ObjectEntry {
            object,
            angle_deg: CarlaPose::from_right_handed(&lidar_from_object).roll_yaw_pitch_deg,
            location_m: lidar_from_object.translation_m,
            // The location already is the centre of the box.
            center_m: [0.0; 3],
            more: vec![
                ("ass_id", object.id.to_string()),
                ("obj_type", real_type(object.class).to_owned()),
            ],
        }
    })
}

/// The value of a key: the matrix with every bit of its numbers.
fn pickled_matrix(pose: &Pose) -> String {
    // NumPy keeps rows together.
    let numbers = pose.matrix_rows().into_iter().flatten();
    let bytes: Vec<u8> = numbers.flat_map(f64::to_le_bytes).collect();
    let digits = STANDARD.encode(bytes);
    let lines = digits.as_bytes().chunks(BASE64_LINE);
    let lines = lines.map(|line| format!("    {}", String::from_utf8_lossy(line)));
    MATRIX_HEAD.to_owned() + &lines.collect::<Vec<_>>().join("\n")
}
