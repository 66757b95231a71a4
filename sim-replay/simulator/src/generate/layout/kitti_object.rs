//! KITTI object detection: `training/{velodyne,calib,label_2}`, each sweep of each agent a frame of its own.
//!
//! Boxes are upright in the frame of the LiDAR. There is no image: regions of images are zero.

use std::path::{Path, PathBuf};

use nalgebra::Point3;

use super::boxes::{float_bytes, real_type, upright_in};
use super::disk::{make_folder, make_fresh_folder, write_file, write_origin};
use super::kitti_odometry::camera_from_lidar;
use super::{AgentFrame, Moment, Omissions, SceneHeader, SceneWriter};
use crate::generate::error::SynthError;
use dataset::frame::ObjectClass;

/// The folder of the frames.
const SPLIT: &str = "training";
/// The camera's axes (x right, y down, z forward) in those of the LiDAR, at the same place.
const CALIBRATION: &str = "\
P0: 7.215377e+02 0 6.095593e+02 0 0 7.215377e+02 1.728540e+02 0 0 0 1 0
P1: 7.215377e+02 0 6.095593e+02 0 0 7.215377e+02 1.728540e+02 0 0 0 1 0
P2: 7.215377e+02 0 6.095593e+02 0 0 7.215377e+02 1.728540e+02 0 0 0 1 0
P3: 7.215377e+02 0 6.095593e+02 0 0 7.215377e+02 1.728540e+02 0 0 0 1 0
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0
Tr_imu_to_velo: 1 0 0 0 0 1 0 0 0 0 1 0
";

/// The writer.
#[derive(Debug, Default)]
pub(super) struct KittiObject {
    root: PathBuf,
    /// Number of the next scene's first frame; `None` before the first scene.
    next_frame: Option<usize>,
    first_frame: usize,
    moments: usize,
}

impl KittiObject {
    pub(super) fn new(root: &Path) -> Self {
        Self {
            root: root.to_owned(),
            ..Self::default()
        }
    }

    fn file(&self, folder: &str, number: usize, suffix: &str) -> PathBuf {
        let folder = self.root.join(SPLIT).join(folder);
        folder.join(format!("{number:06}{suffix}"))
    }
}

impl SceneWriter for KittiObject {
    fn begin(&mut self, scene: &SceneHeader) -> Result<(), SynthError> {
        let split = self.root.join(SPLIT);
        if self.next_frame.is_none() {
            make_fresh_folder(&split)?;
            for name in ["velodyne", "calib", "label_2"] {
                make_folder(&split.join(name))?;
            }
        }
        write_origin(&self.root, scene)?;
        self.first_frame = self.next_frame.unwrap_or(0);
        self.moments = scene.capture_nanos.len();
        self.next_frame = Some(self.first_frame + self.moments * scene.agents.len());
        Ok(())
    }

    fn write(&self, moment: &Moment, _: &Omissions) -> Result<usize, SynthError> {
        for frame in &moment.frames {
            // One block of numbers per agent: a number does not depend on which agents are present.
            let number = self.first_frame + frame.agent * self.moments + moment.index;
            let points = float_bytes(frame.frame.points.xyzi.iter().copied());
            write_file(&self.file("velodyne", number, ".bin"), points)?;
            write_file(&self.file("calib", number, ".txt"), CALIBRATION)?;
            write_file(&self.file("label_2", number, ".txt"), labels(frame))?;
        }
        Ok(moment.frames.len())
    }
}

/// The label of each object: type, truncation, occlusion, alpha, image box, sizes, bottom centre, rotation.
fn labels(frame: &AgentFrame) -> String {
    let lines = frame.frame.objects.iter().map(|object| {
        let upright = upright_in(frame, object);
        let ([length, width, height], [x, y, z]) = (upright.size_m, upright.center_m);
        // KITTI gives the middle of the bottom face.
        let bottom = camera_from_lidar() * Point3::new(x, y, z - height / 2.0);
        // The camera's x points to the right of the LiDAR's x.
        let rotation_y_rad = -upright.heading_rad - std::f64::consts::FRAC_PI_2;
        let alpha_rad = rotation_y_rad - bottom.x.atan2(bottom.z);
        let ([x, y, z], kind): ([f64; 3], &str) = (bottom.into(), kind(object.class));
        format!(
            "{kind} 0 0 {alpha_rad} 0 0 0 0 {height} {width} {length} {x} {y} {z} {rotation_y_rad}\n"
        )
    });
    lines.collect()
}

fn kind(class: ObjectClass) -> &'static str {
    match class {
        // KITTI has no buses.
        ObjectClass::Bus => "Tram",
        ObjectClass::TwoWheeler => "Cyclist",
        ObjectClass::Other => "Misc",
        _ => real_type(class),
    }
}
