//! V2X-Real and V2XPnP: the folders of OPV2V with `.bin` sweeps, right-handed; objects in the world, with their type.

use super::AgentFrame;
use super::agent_folders::TickFiles;
use super::boxes::{float_bytes, real_type};
use super::yaml_text::{ObjectEntry, keyed_poses, write_list, write_speed, write_vehicles};
use crate::generate::error::SynthError;
use dataset::carla_pose::CarlaPose;

pub(super) fn write_files(files: &TickFiles<'_>, frame: &AgentFrame) -> Result<(), SynthError> {
    let points = float_bytes(frame.frame.points.xyzi.iter().copied());
    files.write(".bin", points)?;
    files.write_yaml(frame, |yaml| write_frame(yaml, frame))
}

fn write_frame(yaml: &mut String, agent: &AgentFrame) -> std::fmt::Result {
    let frame = &agent.frame;
    write_speed(yaml, "ego_speed", frame.speed_mps)?;
    for (key, pose) in keyed_poses(frame) {
        let numbers: [f64; 6] = CarlaPose::from_right_handed(&pose).into();
        write_list(yaml, "", key, &numbers)?;
    }
    write_vehicles(yaml, agent, |object, anchor| ObjectEntry {
        object,
        angle_deg: CarlaPose::from_right_handed(&object.world_from_object).roll_yaw_pitch_deg,
        location_m: anchor.location_m,
        center_m: anchor.center_offset_m,
        more: vec![("obj_type", real_type(object.class).to_owned())],
    })
}
