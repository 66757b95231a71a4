//! OPV2V, V2XSet, V2X-R: a folder per agent, a YAML and a PCD per frame, with radar and copies of the sweep beside it.
//!
//! The world of the files is CARLA's: left-handed, degrees, half extents. This is the only writer that mirrors.

use std::fmt::{Debug, Write as _};

use dataset::camera_files::body_from_optical;
use protocol::{Camera, PointCloud, Pose};

use super::agent_folders::TickFiles;
use super::boxes::real_type;
use super::yaml_text::{ObjectEntry, write_list, write_speed, write_vehicles};
use super::{AgentFrame, BoxAnchor};
use crate::generate::error::SynthError;
use crate::generate::positioning::Fix;
use dataset::carla_pose::{CarlaPose, mirrored_point};
use dataset::frame::{Object, ObjectClass};
use dataset::pcd::{self, Encoding, IntensityField};

pub(super) fn write_files(files: &TickFiles<'_>, frame: &AgentFrame) -> Result<(), SynthError> {
    let points = pcd_of(&frame.frame.points.xyzi, IntensityField::Intensity);
    files.write(".pcd", points)?;
    for copy in &frame.variants {
        let bytes = pcd_of(&copy.points, IntensityField::RedAndLabel(&copy.labels));
        files.write(&format!("_{}.pcd", copy.name), bytes)?;
    }
    if let Some(radar) = &frame.frame.radar {
        files.write("_radar.pcd", pcd_of(&radar.xyzi, IntensityField::Red))?;
    }
    for (number, Camera { metadata, image }) in &frame.frame.cameras {
        let ending = metadata.format.name();
        files.write(&format!("_camera{number}.{ending}"), image)?;
    }
    files.write_yaml(frame, |yaml| write_frame(yaml, frame, files.is_roadside))
}

fn pcd_of(points: &[[f32; 4]], intensity: IntensityField<'_>) -> Vec<u8> {
    let mirrored = points.iter().map(|&[x, y, z, fourth]| [x, -y, z, fourth]);
    let xyzi = mirrored.collect();
    pcd::encode(&PointCloud { xyzi }, Encoding::Binary, intensity)
}

fn write_frame(yaml: &mut String, agent: &AgentFrame, is_roadside: bool) -> std::fmt::Result {
    let frame = &agent.frame;
    writeln!(yaml, "RSU: {is_roadside}")?;
    for (number, camera) in &frame.cameras {
        write_camera(yaml, *number, camera, frame.world_from_lidar.as_ref())?;
    }
    write_speed(yaml, "ego_speed", frame.speed_mps)?;
    match (&agent.simulated, frame.motion().yaw_rate_rad_s) {
        (Some(simulated), _) => write_receivers(yaml, &simulated.fix)?,
        // Of the motion of a recorded frame, `ego_speed` alone holds the speed.
        (None, Some(rate)) => writeln!(yaml, "imu:\n  yaw_rate_degps: {}", -rate.to_degrees())?,
        (None, None) => {}
    }
    let poses = [
        ("lidar_pose", frame.world_from_lidar),
        ("predicted_ego_pos", frame.gnss_world_from_vehicle),
        ("true_ego_pos", frame.world_from_vehicle),
    ];
    for (key, pose) in poses {
        let Some(pose) = pose else { continue };
        let numbers: [f64; 6] = CarlaPose::from_pose(&pose).into();
        write_list(yaml, "", key, &numbers)?;
        // Keys of the file are in alphabetical order, and this one comes next.
        if key == "lidar_pose" {
            writeln!(yaml, "plan_trajectory: []")?;
        }
    }
    write_vehicles(yaml, agent, entry)
}

/// Calibration of a camera: its pose in the world, `extrinsic` from the LiDAR to the camera, both left-handed with x
/// ahead, and `intrinsic`.
fn write_camera(
    yaml: &mut String,
    number: u8,
    camera: &Camera,
    world_from_lidar: Option<&Pose>,
) -> std::fmt::Result {
    let metadata = &camera.metadata;
    let (Some(pinhole), Some(lidar_from_camera), Some(world_from_lidar)) = (
        metadata.pinhole,
        metadata.lidar_from_camera,
        world_from_lidar,
    ) else {
        return Ok(());
    };
    let lidar_from_body = lidar_from_camera.isometry() * body_from_optical().inverse();
    let world_from_body = (world_from_lidar.isometry() * lidar_from_body).into();
    let world_from_body = CarlaPose::from_pose(&world_from_body);
    let [world_from_body_left, world_from_lidar_left] =
        [&world_from_body, &CarlaPose::from_pose(world_from_lidar)]
            .map(CarlaPose::left_handed_matrix);
    // camera_from_lidar, in left-handed axes.
    let extrinsic = world_from_body_left.try_inverse().unwrap_or_default() * world_from_lidar_left;
    writeln!(yaml, "camera{number}:")?;
    let cords: [f64; 6] = world_from_body.into();
    write_list(yaml, "  ", "cords", &cords)?;
    // nalgebra's arrays are columns.
    let rows: [[f64; 4]; 4] = extrinsic.transpose().into();
    write_rows(yaml, "extrinsic", &rows)?;
    let first = [pinhole.fx_px, 0.0, pinhole.cx_px];
    let second = [0.0, pinhole.fy_px, pinhole.cy_px];
    write_rows(yaml, "intrinsic", &[first, second, [0.0, 0.0, 1.0]])
}

fn write_rows(yaml: &mut String, key: &str, rows: &[impl Debug]) -> std::fmt::Result {
    writeln!(yaml, "  {key}:")?;
    let mut rows = rows.iter();
    rows.try_for_each(|row| writeln!(yaml, "  - {row:?}"))
}

fn write_receivers(yaml: &mut String, fix: &Fix) -> std::fmt::Result {
    let [latitude, longitude, altitude] = fix.geodetic();
    writeln!(
        yaml,
        "gnss:\n  altitude: {altitude}\n  latitude: {latitude}\n  longitude: {longitude}"
    )?;
    // Left-handed like everything in these files.
    let heading = -fix.heading_rad.to_degrees();
    let rate = -fix.yaw_rate_radps.to_degrees();
    writeln!(
        yaml,
        "imu:\n  heading_deg: {heading}\n  speed_mps: {}\n  yaw_rate_degps: {rate}",
        fix.speed_mps
    )
}

fn entry<'a>(object: &'a Object, anchor: &BoxAnchor) -> ObjectEntry<'a> {
    let mut more = vec![("class", object.class.name().to_owned())];
    // Objects that are not vehicles must not count as vehicles.
    if let ObjectClass::TwoWheeler | ObjectClass::Pedestrian | ObjectClass::Other = object.class {
        more.push(("obj_type", real_type(object.class).to_owned()));
    }
    ObjectEntry {
        object,
        angle_deg: CarlaPose::from_pose(&object.world_from_object).roll_yaw_pitch_deg,
        // Readers add the offset of the centre without rotating it, so it is rotated here.
        location_m: mirrored_point(anchor.location_m),
        center_m: mirrored_point(anchor.center_offset_m),
        more,
    }
}
