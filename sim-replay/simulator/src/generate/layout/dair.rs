//! DAIR-V2X-C and V2X-Seq SPD: the ego as the vehicle, one other agent as the roadside unit, and labels of both
//! together.
//!
//! All scenes of a data set are in one root, each as a batch (DAIR) or a sequence (SPD). Frames have numbers of six
//! digits; the numbers of the unit differ from those of the vehicle. Intensities are 0 to 255. There are no images, but
//! the lists hold paths of images, since loaders parse numbers from them.

use std::path::{Path, PathBuf};
use std::sync::Mutex;

use nalgebra::Isometry3;
use protocol::{Box3d, PointCloud, Pose};
use serde_json::{Value, json};

use super::boxes::{of_255, upright_in};
use super::dair_json::{cooperative_type, side_type, transform, upright_label, world_label};
use super::disk::{make_folder, make_fresh_folder, write_file, write_origin};
use super::{AgentFrame, DAY_MICROS, Moment, Omissions, SceneHeader, SceneWriter, locked};
use crate::generate::error::SynthError;
use dataset::frame::Object;
use dataset::ground_truth::upright_box;
use dataset::pcd::{self, Encoding, IntensityField};

/// First number of the unit's frames; also the upper limit of the number of vehicle frames.
const FIRST_UNIT_FRAME: usize = 500_000;
/// Time stamps of the first scene start here, microseconds.
const EPOCH_MICROS: u64 = 1_626_155_000_000_000;

/// Variant of the layout, which has its name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, strum::IntoStaticStr)]
#[strum(serialize_all = "lowercase")]
pub(super) enum Edition {
    /// Pairs by paths, cooperative labels in the world.
    #[default]
    Dair,
    /// Pairs by numbers of frames and sequences, cooperative labels in the frame of the vehicle's LiDAR, with track
    /// ids.
    V2xSeq,
}

/// One of the two agents.
struct DairSide {
    folder: &'static str,
    labels: &'static str,
    calibrations: &'static [&'static str],
    /// First number of its frames.
    first_number: usize,
}

const VEHICLE: DairSide = DairSide {
    folder: "vehicle-side",
    labels: "lidar",
    calibrations: &["lidar_to_novatel", "novatel_to_world"],
    first_number: 0,
};
const UNIT: DairSide = DairSide {
    folder: "infrastructure-side",
    labels: "virtuallidar",
    calibrations: &["virtuallidar_to_world"],
    first_number: FIRST_UNIT_FRAME,
};
/// Folder of what concerns both agents.
const COOPERATIVE: &str = "cooperative";

/// The writer.
#[derive(Debug, Default)]
pub(super) struct Dair {
    root: PathBuf,
    edition: Edition,
    /// Number of the scene that is being written, and of its first frame.
    scene: usize,
    first_frame: usize,
    /// Index of the agent that is the roadside unit.
    unit: usize,
    capture_nanos: Vec<u64>,
    /// Rows of the lists of vehicle, unit and pairs, by number of the vehicle's frame.
    rows: Mutex<Vec<(usize, [Value; 3])>>,
}

impl Dair {
    pub(super) fn new(root: &Path, edition: Edition) -> Self {
        Self {
            root: root.to_owned(),
            edition,
            ..Self::default()
        }
    }

    fn make_folders(&self) -> Result<(), SynthError> {
        for side in [VEHICLE, UNIT] {
            let folder = self.root.join(side.folder);
            make_fresh_folder(&folder)?;
            make_folder(&folder.join("velodyne"))?;
            for name in side.calibrations {
                make_folder(&folder.join("calib").join(name))?;
            }
            make_folder(&folder.join("label").join(side.labels))?;
        }
        let cooperative = self.root.join(COOPERATIVE);
        make_fresh_folder(&cooperative)?;
        make_folder(&cooperative.join(self.cooperative_labels()))
    }

    fn cooperative_labels(&self) -> &'static str {
        match self.edition {
            Edition::Dair => "label_world",
            Edition::V2xSeq => "label",
        }
    }

    fn write_json(&self, path: &str, value: &Value) -> Result<(), SynthError> {
        write_file(&self.root.join(path), value.to_string())
    }

    /// The sweep and the labels of one side.
    fn write_side(
        &self,
        side: &DairSide,
        id: &str,
        frame: &AgentFrame,
        omitted: &Omissions,
    ) -> Result<(), SynthError> {
        let points = frame.frame.points.xyzi.iter();
        let scaled = points.map(|&[x, y, z, intensity]| [x, y, z, of_255(intensity)]);
        let xyzi = scaled.collect();
        let (points, intensity) = (PointCloud { xyzi }, IntensityField::Intensity);
        let cloud = pcd::encode(&points, Encoding::Binary, intensity);
        let path = format!("{}/velodyne/{id}.pcd", side.folder);
        write_file(&self.root.join(path), cloud)?;
        let mut labels = Vec::new();
        for object in &frame.frame.objects {
            match side_type(object.class) {
                Some(kind) => {
                    labels.push(upright_label(kind, object.id, &upright_in(frame, object)))
                }
                None => omitted.add("objects of a class without a name in the labels", 1),
            }
        }
        let path = format!("{}/label/{}/{id}.json", side.folder, side.labels);
        self.write_json(&path, &Value::Array(labels))
    }

    /// Writes the pose of the vehicle's LiDAR, in the two steps of the data set.
    fn write_vehicle_pose(&self, id: &str, frame: &AgentFrame) -> Result<(), SynthError> {
        let world_from_lidar = frame.world_from_lidar();
        let vehicle = frame.frame.world_from_vehicle;
        // Without a pose of the vehicle, the LiDAR takes its place and the mount is the identity.
        let world_from_novatel = vehicle.map_or(world_from_lidar, |pose| pose.isometry());
        let novatel_from_lidar: Pose = world_from_novatel.inv_mul(&world_from_lidar).into();
        let mount = json!({ "transform": transform(&novatel_from_lidar) });
        let path = format!("vehicle-side/calib/lidar_to_novatel/{id}.json");
        self.write_json(&path, &mount)?;
        let path = format!("vehicle-side/calib/novatel_to_world/{id}.json");
        self.write_json(&path, &transform(&world_from_novatel.into()))
    }

    /// The label of an object that either side lists.
    fn cooperative_label(&self, kind: &str, object: &Object, vehicle: &AgentFrame) -> Value {
        match self.edition {
            Edition::Dair => {
                let upright: Box3d = upright_box(object, &Isometry3::identity());
                world_label(kind, object, &upright)
            }
            Edition::V2xSeq => upright_label(kind, object.id, &upright_in(vehicle, object)),
        }
    }

    /// The rows of a capture time in the lists of vehicle, unit and pairs.
    fn rows_of(&self, moment: &Moment, id: &str, unit_id: &str) -> [Value; 3] {
        let begin_micros = EPOCH_MICROS + self.scene as u64 * DAY_MICROS;
        let micros = begin_micros + self.capture_nanos[moment.index] / 1000;
        let vehicle = self.side_row(&VEHICLE, id, micros);
        let unit = self.side_row(&UNIT, unit_id, micros);
        let offset = json!({ "delta_x": 0.0, "delta_y": 0.0 });
        let pair = match self.edition {
            Edition::Dair => json!({
                "infrastructure_image_path": format!("infrastructure-side/image/{unit_id}.jpg"),
                "infrastructure_pointcloud_path": format!("infrastructure-side/velodyne/{unit_id}.pcd"),
                "vehicle_image_path": format!("vehicle-side/image/{id}.jpg"),
                "vehicle_pointcloud_path": format!("vehicle-side/velodyne/{id}.pcd"),
                "cooperative_label_path": format!("cooperative/label_world/{id}.json"),
                "system_error_offset": offset,
            }),
            Edition::V2xSeq => json!({
                "vehicle_frame": id,
                "infrastructure_frame": unit_id,
                "vehicle_sequence": format!("{:04}", self.scene),
                "infrastructure_sequence": format!("{:04}", self.scene),
                "system_error_offset": offset,
            }),
        };
        [vehicle, unit, pair]
    }

    /// The row of one side.
    fn side_row(&self, side: &DairSide, id: &str, micros: u64) -> Value {
        let [first, last] = [0, self.capture_nanos.len() - 1]
            .map(|frame| format!("{:06}", side.first_number + self.first_frame + frame));
        let mut row = json!({
            "image_path": format!("image/{id}.jpg"),
            "image_timestamp": micros.to_string(),
            "pointcloud_path": format!("velodyne/{id}.pcd"),
            "pointcloud_timestamp": micros.to_string(),
            "intersection_loc": "generated",
        });
        let labels = format!("label/{}/{id}.json", side.labels);
        for name in side.calibrations {
            row[format!("calib_{name}_path")] = json!(format!("calib/{name}/{id}.json"));
        }
        match self.edition {
            Edition::Dair => {
                row["label_lidar_path"] = json!(labels);
                row["batch_id"] = json!(self.scene.to_string());
                row["batch_start_id"] = json!(first);
                row["batch_end_id"] = json!(last);
            }
            Edition::V2xSeq => {
                row["label_lidar_std_path"] = json!(labels);
                row["frame_id"] = json!(id);
                row["sequence_id"] = json!(format!("{:04}", self.scene));
                row["num_frames"] = json!(self.capture_nanos.len().to_string());
                row["start_frame_id"] = json!(first);
                row["end_frame_id"] = json!(last);
            }
        }
        row
    }
}

impl SceneWriter for Dair {
    fn begin(&mut self, scene: &SceneHeader) -> Result<(), SynthError> {
        let layout: &'static str = self.edition.into();
        if scene.agents.len() < 2 {
            return Err(SynthError::Layout(format!(
                "{layout}: scene {} has one agent; a vehicle and a roadside unit are needed",
                scene.name
            )));
        }
        if self.first_frame + scene.capture_nanos.len() > FIRST_UNIT_FRAME {
            return Err(SynthError::Layout(format!(
                "{layout}: more than {FIRST_UNIT_FRAME} frames have no numbers of six digits"
            )));
        }
        if self.scene == 0 {
            self.make_folders()?;
        }
        write_origin(&self.root, scene)?;
        // A roadside unit if there is one, else the second agent.
        let unit = (1..scene.agents.len()).find(|&agent| scene.agents[agent].is_roadside);
        self.unit = unit.unwrap_or(1);
        self.capture_nanos.clone_from(&scene.capture_nanos);
        Ok(())
    }

    fn write(&self, moment: &Moment, omitted: &Omissions) -> Result<usize, SynthError> {
        let frames = moment.frames.len();
        let (Some(vehicle), Some(unit)) = (moment.of(0), moment.of(self.unit)) else {
            omitted.add("frames of moments without vehicle or roadside unit", frames);
            return Ok(0);
        };
        let what = "frames of agents beyond one vehicle and one roadside unit";
        // Both were found above, so there are at least two.
        omitted.add(what, frames - 2);
        let number = self.first_frame + moment.index;
        let [id, unit_id] =
            [VEHICLE, UNIT].map(|side| format!("{:06}", side.first_number + number));
        self.write_side(&VEHICLE, &id, vehicle, omitted)?;
        self.write_side(&UNIT, &unit_id, unit, omitted)?;
        self.write_vehicle_pose(&id, vehicle)?;
        let mut pose = transform(&unit.world_from_lidar().into());
        pose["relative_error"] = json!({ "delta_x": 0.0, "delta_y": 0.0 });
        let path = format!("infrastructure-side/calib/virtuallidar_to_world/{unit_id}.json");
        self.write_json(&path, &pose)?;
        let mut labels = Vec::new();
        for object in Moment::union([vehicle, unit]) {
            match cooperative_type(object.class) {
                Some(kind) => labels.push(self.cooperative_label(kind, object, vehicle)),
                None => omitted.add(
                    "objects that are no vehicles, in the labels of both sides",
                    1,
                ),
            }
        }
        let path = format!("cooperative/{}/{id}.json", self.cooperative_labels());
        self.write_json(&path, &Value::Array(labels))?;
        locked(&self.rows).push((number, self.rows_of(moment, &id, &unit_id)));
        Ok(2)
    }

    fn end(&mut self) -> Result<(), SynthError> {
        self.first_frame += self.capture_nanos.len();
        self.scene += 1;
        Ok(())
    }

    fn finish(&mut self) -> Result<(), SynthError> {
        let mut rows = std::mem::take(&mut *locked(&self.rows));
        // Moments are written by several threads, in any order.
        rows.sort_by_key(|(number, _)| *number);
        let folders = [VEHICLE.folder, UNIT.folder, COOPERATIVE];
        folders.iter().enumerate().try_for_each(|(list, folder)| {
            let rows = rows.iter().map(|(_, rows)| rows[list].clone());
            self.write_json(&format!("{folder}/data_info.json"), &rows.collect())
        })
    }
}
