//! Scenes on disk, in the layout of OPV2V: a folder per agent, a YAML and two PCD files per frame.
//!
//! The world of the files is CARLA's: left-handed, degrees, half extents. This is the only place that mirrors.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use nalgebra::Vector3;
use protocol::PointCloud;

use super::cast::Placement;
use super::error::SynthError;
use super::lidar::{LIDAR_MOUNT_M, LidarSweep};
use super::positioning::Fix;
use super::radar::velocity_to_red;
use super::vehicle::{Vehicle, VehicleKind};
use crate::carla_pose::CarlaPose;
use crate::pcd::{self, Encoding, IntensityField};

/// A vehicle that an agent's LiDAR hit.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Annotation<'a> {
    pub(crate) id: i64,
    pub(crate) vehicle: &'a Vehicle,
    pub(crate) placement: Placement,
    pub(crate) speed_mps: f64,
}

/// What one agent knows at one capture time, besides its points.
#[derive(Debug)]
pub(crate) struct FrameFacts<'a> {
    pub(crate) vehicle: Placement,
    pub(crate) speed_mps: f64,
    pub(crate) fix: Fix,
    pub(crate) annotations: Vec<Annotation<'a>>,
}

/// Writes `text` or bytes, naming the file where that fails.
pub(crate) fn write_file(path: &Path, bytes: impl AsRef<[u8]>) -> Result<(), SynthError> {
    fs::write(path, bytes).map_err(|source| SynthError::Write { path: path.to_owned(), source })
}

/// Makes a folder and those above it.
pub(crate) fn make_folder(path: &Path) -> Result<(), SynthError> {
    fs::create_dir_all(path).map_err(|source| SynthError::Write { path: path.to_owned(), source })
}

/// The folder of one agent's files.
#[derive(Debug, Clone)]
pub(crate) struct AgentFolder(PathBuf);

impl AgentFolder {
    pub(crate) fn create(scenario: &Path, id: i64) -> Result<Self, SynthError> {
        let folder = scenario.join(id.to_string());
        make_folder(&folder)?;
        Ok(Self(folder))
    }

    /// The plain sweep of a tick, or a copy of it in another weather: as in V2X-R, with a label that says which points are
    /// clutter in the green byte beside intensity in the red one.
    pub(crate) fn write_lidar(
        &self,
        tick: u64,
        variant: Option<&str>,
        sweep: &LidarSweep<'_>,
    ) -> Result<(), SynthError> {
        let xyzi = sweep.points.iter().map(|&[x, y, z, intensity]| [x, -y, z, intensity]).collect();
        let field = variant.map_or(IntensityField::Intensity, |_| IntensityField::RedAndLabel(sweep.labels));
        let bytes = pcd::encode(&PointCloud { xyzi }, Encoding::Binary, field);
        let suffix = variant.map(|variant| format!("_{variant}")).unwrap_or_default();
        write_file(&self.0.join(format!("{tick:06}{suffix}.pcd")), bytes)
    }

    /// `points` hold radial velocities in metres per second; see [`super::radar::velocity_to_red`].
    pub(crate) fn write_radar(&self, tick: u64, points: &[[f32; 4]]) -> Result<(), SynthError> {
        let xyzi = points.iter().map(|&[x, y, z, velocity]| [x, -y, z, velocity_to_red(velocity)]).collect();
        let bytes = pcd::encode(&PointCloud { xyzi }, Encoding::Binary, IntensityField::Red);
        write_file(&self.0.join(format!("{tick:06}_radar.pcd")), bytes)
    }

    pub(crate) fn write_facts(&self, tick: u64, facts: &FrameFacts<'_>) -> Result<(), SynthError> {
        write_file(&self.0.join(format!("{tick:06}.yaml")), frame_yaml(facts))
    }
}

fn frame_yaml(facts: &FrameFacts<'_>) -> String {
    let mut yaml = String::with_capacity(512 + 400 * facts.annotations.len());
    write_frame(&mut yaml, facts).expect("a String takes all that is written to it");
    yaml
}

fn write_frame(yaml: &mut String, facts: &FrameFacts<'_>) -> std::fmt::Result {
    let pose = |placement: &Placement| <[f64; 6]>::from(CarlaPose::from_pose(&placement.isometry().into()));
    let fix = &facts.fix;
    writeln!(yaml, "RSU: false")?;
    writeln!(yaml, "ego_speed: {}", 3.6 * facts.speed_mps)?;
    let [latitude, longitude, altitude] = fix.geodetic();
    writeln!(yaml, "gnss:\n  altitude: {altitude}\n  latitude: {latitude}\n  longitude: {longitude}")?;
    // Left-handed like everything in these files.
    let (heading, rate) = (-fix.heading_rad.to_degrees(), -fix.yaw_rate_radps.to_degrees());
    writeln!(yaml, "imu:\n  heading_deg: {heading}\n  speed_mps: {}\n  yaw_rate_degps: {rate}", fix.speed_mps)?;
    write_list(yaml, "", "lidar_pose", &pose(&facts.vehicle.mounted(LIDAR_MOUNT_M)))?;
    writeln!(yaml, "plan_trajectory: []")?;
    write_list(yaml, "", "predicted_ego_pos", &pose(&fix.estimate))?;
    write_list(yaml, "", "true_ego_pos", &pose(&facts.vehicle))?;
    if facts.annotations.is_empty() {
        return writeln!(yaml, "vehicles: {{}}");
    }
    writeln!(yaml, "vehicles:")?;
    for annotation in &facts.annotations {
        let [x, y, z, roll, yaw, pitch] = pose(&annotation.placement);
        let [length, width, height] = annotation.vehicle.size_m.map(|size| size / 2.0);
        // Readers add the offset of the centre without turning it, so it is turned here.
        let center: Vector3<f64> = annotation.placement.rotation() * Vector3::new(0.0, 0.0, height);
        writeln!(yaml, "  {}:", annotation.id)?;
        write_list(yaml, "    ", "angle", &[roll, yaw, pitch])?;
        write_list(yaml, "    ", "center", &[center.x, -center.y, center.z])?;
        writeln!(yaml, "    class: {}", class(annotation.vehicle.kind))?;
        write_list(yaml, "    ", "extent", &[length, width, height])?;
        write_list(yaml, "    ", "location", &[x, y, z])?;
        writeln!(yaml, "    speed: {}", 3.6 * annotation.speed_mps)?;
    }
    Ok(())
}

fn write_list(yaml: &mut String, indent: &str, key: &str, values: &[f64]) -> std::fmt::Result {
    writeln!(yaml, "{indent}{key}:")?;
    // Minus zero would be another text for the same number; `{:?}` keeps a point in whole numbers.
    values.iter().try_for_each(|value| writeln!(yaml, "{indent}- {:?}", value + 0.0))
}

fn class(kind: VehicleKind) -> &'static str {
    match kind {
        VehicleKind::Sedan | VehicleKind::Hatchback | VehicleKind::Suv | VehicleKind::Pickup => "car",
        VehicleKind::Van => "van",
        VehicleKind::Truck => "truck",
        VehicleKind::Bus => "bus",
    }
}
