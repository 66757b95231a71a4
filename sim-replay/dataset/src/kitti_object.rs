//! KITTI object detection: single frames with boxes, `{training,testing}/{velodyne,calib,label_2}`.
//!
//! The frames are independent and have no pose: each is its own world, with the LiDAR at its origin.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, UnitQuaternion};
use protocol::{CavId, Handedness, Pose};

use super::frame_files::{named_once, usual_stems};
use super::kitti_text::{self, Calibration};
use super::layout::{LayoutReader, LayoutRow};
use super::points::{SweepStorage, Sweeps};
use super::poses::{self, box_angle_rad};
use super::{
    FrameSource, Layout, OpenOptions, Problem, ReadError, Result, Scenario, Tick, classes, files,
    repeats, single_vehicle,
};
use crate::frame::{Frame, Object, ObjectClass};
use crate::pcd::PcdCloud;

/// KITTI object detection.
pub(crate) static KITTI_OBJECT: LayoutRow = LayoutRow {
    key: "kitti_object",
    name: "KITTI object",
    data_sets: "KITTI object detection",
    files: "velodyne/<frame>.bin and calib/<frame>.txt (a folder)",
    protocol: "opv2v",
    reader: Some(LayoutReader::Sequence(is_split, open)),
};

/// Numbers after the type in a line of labels; detections have a score as well.
const LABEL_NUMBERS: usize = 14;
/// Separators of the fields of a line of labels.
const BLANKS: [char; 2] = [' ', '\t'];
/// Largest size of an object, metres.
const MAX_SIZE_M: f64 = 100.0;

/// A split.
#[derive(Debug)]
struct Split {
    dir: PathBuf,
    has_labels: bool,
    sweeps: Sweeps,
}

/// True for a folder with sweeps and a folder of calibrations. DAIR-V2X has the same folders, with PCD files.
fn is_split(dir: &Path) -> bool {
    dir.join("calib").is_dir() && files::holds(&dir.join("velodyne"), ".bin")
}

/// Opens a split.
fn open(dir: &Path, options: &OpenOptions, problems: &mut Vec<ReadError>) -> Result<Scenario> {
    let velodyne = dir.join("velodyne");
    let listing = files::list(&velodyne)?;
    let stems = files::stems(&listing.files, ".bin").collect();
    let (stems, strays) = usual_stems(stems, ".bin");
    problems.extend(named_once(&velodyne, &strays));
    let times = (0u64..).map(|index| options.period_nanos.saturating_mul(index));
    let ticks = stems.into_iter().zip(times);
    let ticks: Vec<Tick> = ticks.map(|(stem, nanos)| Tick::new(stem, nanos)).collect();
    let files = ticks
        .iter()
        .map(|tick| velodyne.join(format!("{}.bin", tick.stem)));
    let sweeps = Sweeps::of_single_vehicle(SweepStorage::ByName, files, options);
    let source = Arc::new(Split {
        dir: dir.to_owned(),
        has_labels: dir.join("label_2").is_dir(),
        sweeps,
    });
    Ok(single_vehicle(Layout::KITTI_OBJECT, ticks, source))
}

impl FrameSource for Split {
    fn frame(&self, agent: &CavId, tick: &Tick) -> Result<Frame> {
        let mut frame = Frame::empty(agent.clone(), tick.capture_nanos, Handedness::Right);
        frame.world_from_lidar = Some(Pose::IDENTITY);
        if self.has_labels {
            let calibration = Calibration::read(&self.file("calib", tick, "txt"))?;
            let rectified = calibration.rotation("R0_rect")?.isometry();
            // Labels are in the frame of the rectified camera: R0_rect follows Tr_velo_to_cam.
            let camera_from_lidar = rectified * calibration.transform("Tr_velo_to_cam")?.isometry();
            let labels = self.file("label_2", tick, "txt");
            (frame.objects, frame.problems) = objects(&labels, &camera_from_lidar.inverse())?;
        }
        Ok(frame)
    }

    fn points(&self, agent: &CavId, tick: &Tick, variant: Option<&str>) -> Result<PcdCloud> {
        self.sweeps
            .read(agent, &self.points_path(agent, tick, variant))
    }

    fn shared_files(&self, agent: &CavId) -> Vec<PathBuf> {
        self.sweeps.samples(agent, [])
    }

    fn frame_files(&self, _agent: &CavId, tick: &Tick) -> Vec<PathBuf> {
        let folders = ["calib", "label_2"].into_iter();
        let folders = folders.filter(|_| self.has_labels);
        let files = folders.map(|folder| self.file(folder, tick, "txt"));
        files.collect()
    }

    fn points_path(&self, _agent: &CavId, tick: &Tick, _variant: Option<&str>) -> PathBuf {
        self.file("velodyne", tick, "bin")
    }
}

impl Split {
    fn file(&self, folder: &str, tick: &Tick, ending: &str) -> PathBuf {
        let name = format!("{}.{ending}", tick.stem);
        self.dir.join(folder).join(name)
    }
}

/// The labelled objects in the LiDAR frame, and the faults of those left out. `DontCare` regions have no box and are
/// not counted.
fn objects(path: &Path, lidar_from_camera: &Isometry3<f64>) -> Result<(Vec<Object>, Vec<Problem>)> {
    let (mut objects, mut problems) = (Vec::new(), Vec::new());
    for (line, text) in kitti_text::lines(path)? {
        let (kind, numbers) = text.trim().split_once(BLANKS).unwrap_or((text.trim(), ""));
        if kind == "DontCare" {
            continue;
        }
        let id = objects.len() as i64;
        match object((path, line), kind, numbers, id, lidar_from_camera) {
            Ok(object) => {
                problems.extend(classes::unknown_label(path, kind));
                objects.push(object);
            }
            Err(error) => problems.push(Problem::left_out("object", error)),
        }
    }
    repeats::leave_out(path, &mut objects, &mut problems);
    Ok((objects, problems))
}

fn object(
    (path, line): (&Path, u64),
    kind: &str,
    numbers: &str,
    id: i64,
    lidar_from_camera: &Isometry3<f64>,
) -> Result<Object> {
    // The first word of an arbitrary file may be long.
    let field: String = kind.chars().take(40).collect();
    let count = numbers.split_ascii_whitespace().count();
    // A score may follow.
    let has_score = count == LABEL_NUMBERS + 1;
    let without_score = numbers.trim().rsplit_once(BLANKS).filter(|_| has_score);
    let numbers = without_score.map_or(numbers, |(numbers, _)| numbers);
    let values: [f64; LABEL_NUMBERS] = kitti_text::numbers(path, line, Some(&field), numbers)?;
    // KITTI has height, width, length. Sizes here are length, width, height.
    let [.., height, width, length, x, y, z, rotation_y] = values;
    let fault = |reason: String| kitti_text::malformed(path, line, Some(&field), reason);
    let rotation_y = box_angle_rad(rotation_y);
    let rotation_y = rotation_y.map_err(|reason| fault(format!("rotation_y: {reason}")))?;
    let size_m = [length, width, height];
    if size_m.iter().any(|&size| size <= 0.0 || size > MAX_SIZE_M) {
        return Err(fault(format!(
            "{size_m:?} m, expected sizes above 0 and up to {MAX_SIZE_M} m"
        )));
    }
    let class = classes::of_name(kind).unwrap_or(ObjectClass::Other);
    let camera_from_object = camera_from_object([x, y, z], height, rotation_y);
    let world_from_object = poses::valid(lidar_from_camera * camera_from_object);
    let world_from_object = world_from_object.map_err(|error| fault(error.to_string()))?;
    Ok(Object::new(id, class, world_from_object, size_m))
}

/// The label's position is the centre of the bottom face in the camera frame (x right, y down, z forward); `rotation_y`
/// turns the length from x towards -z.
fn camera_from_object(bottom: [f64; 3], height: f64, rotation_y: f64) -> Isometry3<f64> {
    let (sin, cos) = rotation_y.sin_cos();
    // Columns: directions of the object's length, left side and top.
    let rotation = Matrix3::new(cos, sin, 0.0, 0.0, 0.0, -1.0, -sin, cos, 0.0);
    let rotation =
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    let [x, y, z] = bottom;
    // y points down: the centre is above the bottom face by half the height.
    Isometry3::from_parts(Point3::new(x, y - height / 2.0, z).coords.into(), rotation)
}

#[cfg(test)]
mod tests {
    use std::fs;

    /// Four floats of letters: one point at about 12 m.
    const ONE_POINT: &str = "AAAAAAAAAAAAAAAA";

    use super::*;
    use crate::LoadOptions;

    fn build(label: &str) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        for (name, text) in [
            ("training/velodyne/000000.bin", ONE_POINT),
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
        let dir = build(&format!(
            "{line}\nDontCare -1 -1 -10 0 0 0 0 -1 -1 -1 -1000 -1000 -1000 -10\n{} 0.9\n",
            line.replace(" 9.7 ", "\t19.7\t").replace("Car ", "Car\t")
        ));
        let dataset = crate::open(dir.path()).unwrap();
        assert_eq!(
            (dataset.layout, dataset.scenarios[0].name.as_str()),
            (Layout::KITTI_OBJECT, "training")
        );
        let frame = dataset.scenarios[0]
            .load(0, 0, &LoadOptions::default())
            .unwrap();
        assert_eq!(frame.objects.len(), 2);
        let car = &frame.objects[0];
        let [x, y, z] = car.world_from_object.translation_m;
        // 10 m ahead, 2 m to the right, its middle 0.85 m below the LiDAR.
        assert!(
            (x - 10.0).abs() < 1e-9 && (y + 2.0).abs() < 1e-9 && (z + 1.05).abs() < 1e-9,
            "{x} {y} {z}"
        );
        assert_eq!(car.size_m, [4.0, 1.6, 1.5]);
        // A quarter turn from the camera's x towards -z... of the camera points along the LiDAR's x.
        assert!(car.world_from_object.yaw_rad().abs() < 1e-9);
        let up = car.world_from_object.isometry() * nalgebra::Vector3::z();
        assert!((up.z - 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_bad_label_loses_only_its_object_and_gives_line_and_field() {
        let sound = "Car 0 0 0 0 0 0 0 1.5 1.6 4.0 2.0 1.7 9.7 0\n";
        for (bad, field, expected) in [
            (
                "Van 0 0 0",
                "Van",
                "3 numbers, expected 14: the object is left out",
            ),
            (
                "Car 0 0 0 0 0 0 0 1.5 nan 4.0 2.0 1.7 9.7 0",
                "Car",
                "\"nan\" is no finite number: the object is left out",
            ),
            (
                "Car 0 0 0 0 0 0 0 1.5 0 4.0 2.0 1.7 9.7 0",
                "Car",
                "expected sizes above 0 and up to 100 m: the object is left out",
            ),
            (
                "Car 0 0 0 0 0 0 0 1.5 1.6 4.0 2.0 1e9 9.7 0",
                "Car",
                "within 1e7: the object is left out",
            ),
            (
                "Car 0 0 0 0 0 0 0 1.5 1.6 4.0 2.0 1.7 9.7 -90",
                "Car",
                "rotation_y: -90 rad, expected -2 pi to 2 pi: degrees?: the object is left out",
            ),
            (
                "\u{fffd}\u{1}",
                "\u{fffd}\u{1}",
                "0 numbers, expected 14: the object is left out",
            ),
        ] {
            let other = sound.replace(" 9.7 ", " 19.7 ");
            let dir = build(&format!("{sound}{bad}\n{other}"));
            let frame = crate::open(dir.path()).unwrap().scenarios[0]
                .load(0, 0, &LoadOptions::default())
                .unwrap();
            assert_eq!((frame.objects.len(), frame.problems.len()), (2, 1), "{bad}");
            let problem = &frame.problems[0];
            assert_eq!(
                (problem.line, problem.field.as_deref()),
                (Some(2), Some(field))
            );
            assert!(problem.message.ends_with(expected), "{problem:?}");
        }
    }

    #[test]
    fn a_box_that_is_listed_twice_is_one_object() {
        let line = "Car 0 0 0 0 0 0 0 1.5 1.6 4.0 2.0 1.7 9.7 0\n";
        let dir = build(&line.repeat(2));
        let frame = crate::open(dir.path()).unwrap().scenarios[0]
            .load(0, 0, &LoadOptions::default())
            .unwrap();
        assert_eq!((frame.objects.len(), frame.problems.len()), (1, 1));
        let message = &frame.problems[0].message;
        assert!(
            message.contains("with the id or the box of object 0 at ")
                && message.ends_with("m: the object is left out"),
            "{message}"
        );
    }

    #[test]
    fn an_unknown_type_is_named_and_counts_as_other() {
        let dir = build("Ufo 0 0 0 0 0 0 0 1.5 1.6 4.0 2.0 1.7 9.7 0\n");
        let frame = crate::open(dir.path()).unwrap().scenarios[0]
            .load(0, 0, &LoadOptions::default())
            .unwrap();
        assert_eq!(frame.objects[0].class, ObjectClass::Other);
        assert!(
            frame.problems[0]
                .message
                .contains("type: \"Ufo\" is an unknown type of object"),
            "{:?}",
            frame.problems
        );
    }

    #[test]
    fn copies_are_no_sweeps() {
        let dir = build("");
        fs::write(dir.path().join("training/velodyne/000000 (1).bin"), "").unwrap();
        let dataset = crate::open(dir.path()).unwrap();
        assert_eq!(
            (dataset.scenarios[0].ticks.len(), dataset.problems.len()),
            (1, 1)
        );
        assert!(
            dataset.problems[0]
                .to_string()
                .ends_with("first: 000000 (1).bin"),
            "{:?}",
            dataset.problems
        );
    }

    #[test]
    fn a_folder_without_sweeps_is_no_split() {
        let dir = build("");
        fs::rename(
            dir.path().join("training/velodyne/000000.bin"),
            dir.path().join("training/velodyne/000000.pcd"),
        )
        .unwrap();
        assert!(
            crate::open(dir.path())
                .unwrap_err()
                .to_string()
                .contains("no supported layout")
        );
    }
}
