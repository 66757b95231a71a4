//! V2X-Real and V2XPnP: the folders of OPV2V with `.bin` sweeps, right-handed; objects in the world, with their type.

use std::fmt::Write as _;
use std::path::Path;

use protocol::Pose;

use super::agent_folders::{AgentFolderWriter, AgentFolders};
use super::boxes::{float_bytes, real_type};
use super::disk::write_file;
use super::yaml_text::{KMH_PER_MPS, ObjectEntry, anchors, write_list};
use super::{AgentFrame, Moment};
use crate::generate::error::SynthError;
use dataset::carla_pose::CarlaPose;

pub(super) fn writer(root: &Path) -> AgentFolderWriter {
    AgentFolderWriter::new(root, write_files)
}

fn write_files(
    folders: &AgentFolders,
    moment: &Moment,
    frame: &AgentFrame,
) -> Result<(), SynthError> {
    let points = float_bytes(frame.frame.points.xyzi.iter().copied());
    write_file(&folders.file(moment, frame, ".bin"), points)?;
    let mut yaml = String::with_capacity(512 + 400 * frame.frame.objects.len());
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
            write_list(yaml, "", key, &six(&pose))?;
        }
    }
    if frame.objects.is_empty() {
        return writeln!(yaml, "vehicles: {{}}");
    }
    writeln!(yaml, "vehicles:")?;
    frame
        .objects
        .iter()
        .zip(anchors(agent))
        .try_for_each(|(object, anchor)| {
            let more = [("obj_type", real_type(object.class).to_owned())];
            let [.., roll, yaw, pitch] = six(&object.world_from_object);
            let entry = ObjectEntry {
                id: object.id,
                angle_deg: [roll, yaw, pitch],
                location_m: anchor.location_m,
                center_m: anchor.center_offset_m,
                size_m: object.size_m,
                speed_mps: object.speed_mps,
                more: &more,
            };
            entry.write(yaml)
        })
}

fn six(pose: &Pose) -> [f64; 6] {
    CarlaPose::from_right_handed(pose).into()
}
