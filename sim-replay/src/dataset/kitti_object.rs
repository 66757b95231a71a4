//! KITTI object detection: single frames with boxes, `{training,testing}/{velodyne,calib,label_2}`.
//!
//! The frames have nothing to do with each other, and no pose: each is its own world, with the LiDAR at its origin.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, UnitQuaternion};
use protocol::{CavId, Handedness, Pose};

use super::kitti_text::{self, Calibration};
use super::points::{SweepStorage, Sweeps};
use super::{FrameSource, Layout, OpenOptions, ReadError, Scenario, Tick, files, single_vehicle};
use crate::frame::{Frame, Object, ObjectClass};
use crate::pcd::PcdCloud;

/// Numbers behind the type in a line of labels; detections have a score as well.
const LABEL_NUMBERS: usize = 14;

/// A split.
#[derive(Debug)]
struct Split {
    dir: PathBuf,
    has_labels: bool,
    sweeps: Sweeps,
}

/// Whether a folder is a split.
pub(super) fn is_split(dir: &Path) -> bool {
    dir.join("velodyne").is_dir() && dir.join("calib").is_dir()
}

/// Opens a split.
pub(super) fn open(root: &Path, dir: &Path, options: &OpenOptions) -> Result<Scenario, ReadError> {
    let velodyne = dir.join("velodyne");
    let listing = files::list(&velodyne)?;
    let stems = files::stems(&listing.files, ".bin");
    let times = (0u64..).map(|index| options.period_nanos.saturating_mul(index));
    let tick = |(stem, capture_nanos): (&str, u64)| Tick { stem: stem.to_owned(), capture_nanos };
    let ticks: Vec<Tick> = stems.into_iter().zip(times).map(tick).collect();
    let files = ticks.iter().map(|tick| velodyne.join(format!("{}.bin", tick.stem)));
    let sweeps = Sweeps::of_single_vehicle(SweepStorage::ByName, files, options);
    let source = Split { dir: dir.to_owned(), has_labels: dir.join("label_2").is_dir(), sweeps };
    Ok(single_vehicle(files::name_below(root, dir), Layout::KittiObject, ticks, Arc::new(source)))
}

impl FrameSource for Split {
    fn frame(&self, agent: &CavId, tick: &Tick) -> Result<Frame, ReadError> {
        let mut frame = Frame::empty(agent.clone(), tick.capture_nanos, Handedness::Right);
        frame.world_from_lidar = Some(Pose::IDENTITY);
        if self.has_labels {
            let calibration = Calibration::read(&self.dir.join("calib").join(format!("{}.txt", tick.stem)))?;
            let rectified = calibration.rotation("R0_rect")?.isometry();
            let camera_from_lidar = rectified * calibration.transform("Tr_velo_to_cam")?.isometry();
            frame.objects = objects(&self.labels(tick), &camera_from_lidar.inverse())?;
        }
        Ok(frame)
    }

    fn points(&self, agent: &CavId, tick: &Tick, variant: Option<&str>) -> Result<PcdCloud, ReadError> {
        self.sweeps.read(agent, &self.points_path(agent, tick, variant))
    }

    fn annotation_path(&self, _agent: &CavId, tick: &Tick) -> Option<PathBuf> {
        self.has_labels.then(|| self.labels(tick))
    }

    fn points_path(&self, _agent: &CavId, tick: &Tick, _variant: Option<&str>) -> PathBuf {
        self.dir.join("velodyne").join(format!("{}.bin", tick.stem))
    }
}

impl Split {
    fn labels(&self, tick: &Tick) -> PathBuf {
        self.dir.join("label_2").join(format!("{}.txt", tick.stem))
    }
}

/// The labelled objects in the LiDAR frame. `DontCare` regions have no box and are left out.
fn objects(path: &Path, lidar_from_camera: &Isometry3<f64>) -> Result<Vec<Object>, ReadError> {
    let mut objects = Vec::new();
    for (line, text) in kitti_text::lines(path)? {
        let (kind, numbers) = text.trim().split_once(' ').unwrap_or((text.trim(), ""));
        if kind == "DontCare" {
            continue;
        }
        let count = numbers.split_ascii_whitespace().count();
        // A score may follow.
        let numbers = if count == LABEL_NUMBERS + 1 {
            numbers.trim().rsplit_once(' ').map_or(numbers, |(n, _)| n)
        } else {
            numbers
        };
        let values: [f64; LABEL_NUMBERS] = kitti_text::numbers(path, line, Some(kind), numbers)?;
        let [.., height, width, length, x, y, z, rotation_y] = values;
        let size_m = [length, width, height];
        if size_m.iter().any(|size| !(0.0..=200.0).contains(size)) {
            return Err(kitti_text::malformed(path, line, Some(kind), format!("{size_m:?} are no sizes in metres")));
        }
        let camera_from_object = camera_from_object([x, y, z], height, rotation_y);
        let pose: Pose = (lidar_from_camera * camera_from_object).into();
        pose.validate().map_err(|error| kitti_text::malformed(path, line, Some(kind), error.to_string()))?;
        let id = objects.len() as i64;
        objects.push(Object { id, class: class(kind), world_from_object: pose, size_m, speed_mps: None });
    }
    Ok(objects)
}

/// The label's place is the middle of the bottom face in the camera frame (x right, y down, z forward); `rotation_y`
/// turns the length from x towards -z.
fn camera_from_object(bottom: [f64; 3], height: f64, rotation_y: f64) -> Isometry3<f64> {
    let (sin, cos) = rotation_y.sin_cos();
    // Columns: where the object's length, left side and top point.
    let rotation = Matrix3::new(cos, sin, 0.0, 0.0, 0.0, -1.0, -sin, cos, 0.0);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    let [x, y, z] = bottom;
    Isometry3::from_parts(Point3::new(x, y - height / 2.0, z).coords.into(), rotation)
}

fn class(kind: &str) -> ObjectClass {
    match kind {
        "Car" => ObjectClass::Car,
        "Van" => ObjectClass::Van,
        "Truck" => ObjectClass::Truck,
        "Tram" => ObjectClass::Bus,
        "Cyclist" => ObjectClass::TwoWheeler,
        "Pedestrian" | "Person_sitting" => ObjectClass::Pedestrian,
        _ => ObjectClass::Other,
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::dataset::{self, LoadOptions};

    fn build(label: &str) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        for (name, text) in [
            ("training/velodyne/000000.bin", ""),
            (
                "training/calib/000000.txt",
                "R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.1 1 0 0 -0.3\n",
            ),
            ("training/label_2/000000.txt", label),
        ] {
            let path = dir.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        dir
    }

    #[test]
    fn labels_become_boxes_in_the_lidar_frame() {
        let line = "Car 0.00 0 -1.57 0 0 0 0 1.5 1.6 4.0 2.0 1.7 9.7 -1.5707963267948966";
        let dir = build(&format!("{line}\nDontCare -1 -1 -10 0 0 0 0 -1 -1 -1 -1000 -1000 -1000 -10\n{line} 0.9\n"));
        let dataset = dataset::open(dir.path()).unwrap();
        assert_eq!((dataset.layout, dataset.scenarios[0].name.as_str()), (Layout::KittiObject, "training"));
        let frame = dataset.scenarios[0].load(0, 0, &LoadOptions::default()).unwrap();
        assert_eq!(frame.objects.len(), 2);
        let car = &frame.objects[0];
        let [x, y, z] = car.world_from_object.translation_m;
        // 10 m ahead, 2 m to the right, its middle 0.85 m below the LiDAR.
        assert!((x - 10.0).abs() < 1e-9 && (y + 2.0).abs() < 1e-9 && (z + 1.05).abs() < 1e-9, "{x} {y} {z}");
        assert_eq!(car.size_m, [4.0, 1.6, 1.5]);
        // A quarter turn from the camera's x towards -z... of the camera points along the LiDAR's x.
        assert!(car.world_from_object.yaw_rad().abs() < 1e-9);
        let up = car.world_from_object.isometry() * nalgebra::Vector3::z();
        assert!((up.z - 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_bad_label_names_line_and_field() {
        let dir = build("Car 0 0 0 0 0 0 0 1.5 1.6 4.0 2.0 1.7 9.7 0\nVan 0 0 0\n");
        let error = dataset::open(dir.path()).unwrap().scenarios[0].load(0, 0, &LoadOptions::default()).unwrap_err();
        assert_eq!((error.line(), error.field()), (Some(2), Some("Van")));
        assert!(error.to_string().ends_with("3 numbers, expected 14"), "{error}");
    }
}
