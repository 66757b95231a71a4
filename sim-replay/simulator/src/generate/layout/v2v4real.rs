//! V2V4Real: the folders of OPV2V, right-handed. Poses are 4x4 matrices that PyYAML pickled from NumPy, objects stand
//! in the frame of the agent's own LiDAR, and `ass_id` is the id that agents share.

use std::fmt::Write as _;
use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use protocol::Pose;

use super::agent_folders::{AgentFolderWriter, AgentFolders};
use super::boxes::real_type;
use super::disk::write_file;
use super::yaml_text::{KMH_PER_MPS, ObjectEntry};
use super::{AgentFrame, Moment};
use crate::generate::error::SynthError;
use dataset::carla_pose::CarlaPose;
use dataset::frame::Object;
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

pub(super) fn writer(root: &Path) -> AgentFolderWriter {
    AgentFolderWriter::new(root, write_files)
}

fn write_files(
    folders: &AgentFolders,
    moment: &Moment,
    frame: &AgentFrame,
) -> Result<(), SynthError> {
    let points = pcd::encode(
        &frame.frame.points,
        Encoding::Binary,
        IntensityField::Intensity,
    );
    write_file(&folders.file(moment, frame, ".pcd"), points)?;
    let mut yaml = String::with_capacity(2048 + 400 * frame.frame.objects.len());
    write_frame(&mut yaml, frame).expect("writing to a String cannot fail");
    write_file(&folders.file(moment, frame, ".yaml"), yaml)
}

fn write_frame(yaml: &mut String, agent: &AgentFrame) -> std::fmt::Result {
    let frame = &agent.frame;
    if let Some(speed_mps) = frame.speed_mps {
        writeln!(yaml, "ego_speed: {}", KMH_PER_MPS * speed_mps)?;
    }
    for (key, pose) in [
        ("lidar_pose", frame.world_from_lidar),
        ("true_ego_pos", frame.world_from_vehicle),
    ] {
        if let Some(pose) = pose {
            writeln!(yaml, "{key}: {}", pickled_matrix(&pose))?;
        }
    }
    if frame.objects.is_empty() {
        return writeln!(yaml, "vehicles: {{}}");
    }
    writeln!(yaml, "vehicles:")?;
    let lidar_from_world = agent.world_from_lidar().inverse();
    frame.objects.iter().try_for_each(|object| {
        let lidar_from_object = (lidar_from_world * object.world_from_object.isometry()).into();
        write_object(yaml, object, &lidar_from_object)
    })
}

fn write_object(yaml: &mut String, object: &Object, lidar_from_object: &Pose) -> std::fmt::Result {
    let more = [
        ("ass_id", object.id.to_string()),
        ("obj_type", real_type(object.class).to_owned()),
    ];
    let entry = ObjectEntry {
        id: object.id,
        angle_deg: CarlaPose::from_right_handed(lidar_from_object).roll_yaw_pitch_deg,
        location_m: lidar_from_object.translation_m,
        center_m: [0.0; 3],
        size_m: object.size_m,
        speed_mps: object.speed_mps,
        more: &more,
    };
    entry.write(yaml)
}

/// The value of a key: the matrix with every bit of its numbers.
fn pickled_matrix(pose: &Pose) -> String {
    let matrix = pose.isometry().to_homogeneous();
    // nalgebra keeps columns together, NumPy rows.
    let bytes: Vec<u8> = matrix
        .transpose()
        .iter()
        .flat_map(|value| value.to_le_bytes())
        .collect();
    let mut text = MATRIX_HEAD.to_owned();
    let digits = STANDARD.encode(bytes);
    let mut rest = digits.as_str();
    while !rest.is_empty() {
        let (line, after) = rest.split_at(rest.len().min(BASE64_LINE));
        let end = if after.is_empty() { "" } else { "\n" };
        let _ = write!(text, "    {line}{end}");
        rest = after;
    }
    text
}
