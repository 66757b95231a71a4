//! OPV2V, V2XSet, V2X-R: a folder per agent, a YAML and a PCD per frame, with radar and copies of the sweep beside it.
//!
//! The world of the files is CARLA's: left-handed, degrees, half extents. This is the only writer that mirrors.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use protocol::{PointCloud, Pose};

use super::disk::{Unfinished, make_folder, make_fresh_folder, scene_path, write_file};
use super::yaml_text::{KMH_PER_MPS, ObjectEntry, agent_folders, anchors, write_list};
use super::{AgentFrame, Moment, Omissions, SceneHeader, SceneWriter, SweepVariant};
use crate::carla_pose::{CarlaPose, mirrored_point};
use crate::frame::ObjectClass;
use crate::pcd::{self, Encoding, IntensityField};
use crate::synth::error::SynthError;
use crate::synth::positioning::Fix;
use crate::synth::protocol_file::FILE_NAME;

/// The folders of a scene in the layouts of the OPV2V family.
#[derive(Debug)]
pub(super) struct AgentFolders {
    agents: Vec<PathBuf>,
    is_roadside: Vec<bool>,
    /// Number of the moment's tick, by index.
    ticks: Vec<u64>,
    mark: Unfinished,
}

impl AgentFolders {
    /// Makes the folders anew.
    pub(super) fn make(root: &Path, scene: &SceneHeader) -> Result<Self, SynthError> {
        let folder = scene_path(root, &scene.name);
        make_fresh_folder(&folder)?;
        let mark = Unfinished::mark(&folder)?;
        write_file(&folder.join(FILE_NAME), &scene.origin)?;
        let agents: Vec<PathBuf> = agent_folders(scene).iter().map(|name| folder.join(name)).collect();
        agents.iter().try_for_each(|folder| make_folder(folder))?;
        let ticks = scene.capture_nanos.iter().map(|nanos| nanos / scene.tick_nanos).collect();
        let is_roadside = scene.agents.iter().map(|agent| agent.is_roadside).collect();
        Ok(Self { agents, is_roadside, ticks, mark })
    }

    /// Whether an agent is a unit at the roadside.
    pub(super) fn is_roadside(&self, frame: &AgentFrame) -> bool {
        self.is_roadside[frame.agent]
    }

    /// A file of an agent's frame: `suffix` follows the number of the tick.
    pub(super) fn file(&self, moment: &Moment, frame: &AgentFrame, suffix: &str) -> PathBuf {
        self.agents[frame.agent].join(format!("{:06}{suffix}", self.ticks[moment.index]))
    }

    /// All is written.
    pub(super) fn close(self) -> Result<(), SynthError> {
        self.mark.clear()
    }
}

/// The writer.
#[derive(Debug)]
pub(super) struct Opv2v {
    root: PathBuf,
    folders: Option<AgentFolders>,
}

impl Opv2v {
    pub(super) fn new(root: &Path) -> Self {
        Self { root: root.to_owned(), folders: None }
    }
}

impl SceneWriter for Opv2v {
    fn begin(&mut self, scene: &SceneHeader) -> Result<(), SynthError> {
        self.folders = Some(AgentFolders::make(&self.root, scene)?);
        Ok(())
    }

    fn write(&self, moment: &Moment, _: &Omissions) -> Result<(), SynthError> {
        let Some(folders) = &self.folders else { return Ok(()) };
        for frame in &moment.frames {
            let points = pcd_of(&frame.frame.points.xyzi, IntensityField::Intensity);
            write_file(&folders.file(moment, frame, ".pcd"), points)?;
            for SweepVariant { name, points, labels } in &frame.variants {
                let bytes = pcd_of(points, IntensityField::RedAndLabel(labels));
                write_file(&folders.file(moment, frame, &format!("_{name}.pcd")), bytes)?;
            }
            if let Some(radar) = &frame.frame.radar {
                write_file(&folders.file(moment, frame, "_radar.pcd"), pcd_of(&radar.xyzi, IntensityField::Red))?;
            }
            write_file(&folders.file(moment, frame, ".yaml"), frame_yaml(frame, folders.is_roadside(frame)))?;
        }
        Ok(())
    }

    fn end(&mut self) -> Result<(), SynthError> {
        self.folders.take().map_or(Ok(()), AgentFolders::close)
    }
}

fn pcd_of(points: &[[f32; 4]], intensity: IntensityField<'_>) -> Vec<u8> {
    let xyzi = points.iter().map(|&[x, y, z, fourth]| [x, -y, z, fourth]).collect();
    pcd::encode(&PointCloud { xyzi }, Encoding::Binary, intensity)
}

fn frame_yaml(frame: &AgentFrame, is_roadside: bool) -> String {
    let mut yaml = String::with_capacity(512 + 400 * frame.frame.objects.len());
    write_frame(&mut yaml, frame, is_roadside).expect("a String takes all that is written to it");
    yaml
}

fn six(pose: &Pose) -> [f64; 6] {
    CarlaPose::from_pose(pose).into()
}

fn write_frame(yaml: &mut String, agent: &AgentFrame, is_roadside: bool) -> std::fmt::Result {
    let frame = &agent.frame;
    writeln!(yaml, "RSU: {is_roadside}")?;
    if let Some(speed_mps) = frame.speed_mps {
        writeln!(yaml, "ego_speed: {}", KMH_PER_MPS * speed_mps)?;
    }
    if let Some(simulated) = &agent.simulated {
        write_receivers(yaml, &simulated.fix)?;
    }
    let poses = [
        ("lidar_pose", frame.world_from_lidar),
        ("predicted_ego_pos", frame.gnss_world_from_vehicle),
        ("true_ego_pos", frame.world_from_vehicle),
    ];
    for (key, pose) in poses.iter().filter_map(|(key, pose)| Some((key, pose.as_ref()?))) {
        write_list(yaml, "", key, &six(pose))?;
        if *key == "lidar_pose" {
            writeln!(yaml, "plan_trajectory: []")?;
        }
    }
    write_vehicles(yaml, agent)
}

fn write_receivers(yaml: &mut String, fix: &Fix) -> std::fmt::Result {
    let [latitude, longitude, altitude] = fix.geodetic();
    writeln!(yaml, "gnss:\n  altitude: {altitude}\n  latitude: {latitude}\n  longitude: {longitude}")?;
    // Left-handed like everything in these files.
    let (heading, rate) = (-fix.heading_rad.to_degrees(), -fix.yaw_rate_radps.to_degrees());
    writeln!(yaml, "imu:\n  heading_deg: {heading}\n  speed_mps: {}\n  yaw_rate_degps: {rate}", fix.speed_mps)
}

fn write_vehicles(yaml: &mut String, agent: &AgentFrame) -> std::fmt::Result {
    if agent.frame.objects.is_empty() {
        return writeln!(yaml, "vehicles: {{}}");
    }
    writeln!(yaml, "vehicles:")?;
    for (object, anchor) in agent.frame.objects.iter().zip(anchors(agent)) {
        let mut more = vec![("class", class(object.class).to_owned())];
        // What is no vehicle must not count as one.
        if let ObjectClass::TwoWheeler | ObjectClass::Pedestrian | ObjectClass::Other = object.class {
            more.push(("obj_type", super::boxes::real_type(object.class).to_owned()));
        }
        let entry = ObjectEntry {
            id: object.id,
            angle_deg: CarlaPose::from_pose(&object.world_from_object).roll_yaw_pitch_deg,
            // Readers add the offset of the centre without turning it, so it is turned here.
            location_m: mirrored_point(anchor.location_m),
            center_m: mirrored_point(anchor.center_offset_m),
            size_m: object.size_m,
            speed_mps: object.speed_mps,
            more: &more,
        };
        entry.write(yaml)?;
    }
    Ok(())
}

fn class(class: ObjectClass) -> &'static str {
    match class {
        ObjectClass::Car => "car",
        ObjectClass::Van => "van",
        ObjectClass::Truck => "truck",
        ObjectClass::Bus => "bus",
        ObjectClass::TwoWheeler => "two_wheeler",
        ObjectClass::Pedestrian => "pedestrian",
        ObjectClass::Other => "other",
    }
}
