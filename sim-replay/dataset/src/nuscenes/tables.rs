//! Tables of nuScenes: JSON lists whose rows refer to each other by tokens. Each table determines the needed rows of
//! the next one that is read: a table may have gigabytes, most of it about cameras.

use std::collections::HashMap;
use std::path::{Component, Path};

use nalgebra::Isometry3;

use super::annotations;
use super::rows::{Indices, MAX_BYTES, read_all, referred, transform};
use super::samples::{SampleSweep, SceneSample};
use crate::json_table::{self, RowKeys};
use crate::time_stamps::Unit;
use crate::{ReadError, Result};

/// The tables that are read.
pub(super) const NAMES: [&str; 9] = [
    "sensor.json",
    "calibrated_sensor.json",
    "scene.json",
    "sample.json",
    "sample_data.json",
    "ego_pose.json",
    "sample_annotation.json",
    "category.json",
    "instance.json",
];

/// A drive.
#[derive(Debug)]
pub(super) struct Scene {
    pub(super) name: String,
    /// Vehicles in the order of the data set, where it names them (Open MARS).
    pub(super) vehicles: Vec<String>,
}

/// The channel of a LiDAR, and the LiDAR's pose on its vehicle.
type SensorMount = (String, Isometry3<f64>);

/// A sweep before the pose of its vehicle is known.
struct SweepRow {
    sample: usize,
    file: String,
    /// Its time, microseconds, where the row has one.
    micros: Option<u64>,
    mount: SensorMount,
}

/// Reads the drives and their samples from the tables in the folder `version`. Unusable rows are left out, with a
/// problem each.
///
/// # Errors
/// If a table is missing or broken before its first row. Annotations may be missing.
pub(super) fn read(
    version: &Path,
    problems: &mut Vec<ReadError>,
) -> Result<(Vec<Scene>, Vec<SceneSample>)> {
    let mounts = read_mounts(version, problems)?;
    let (scenes, scene_indices) = read_scenes(version, problems)?;
    let (mut samples, sample_indices, unit) = read_samples(version, &scene_indices, problems)?;
    let rows = read_sweeps(version, &mounts, &sample_indices, unit, problems)?;
    place(version, rows, &mut samples, problems)?;
    annotations::read(version, &sample_indices, &mut samples, problems);
    Ok((scenes, samples))
}

/// LiDARs by the token of their calibration.
fn read_mounts(
    version: &Path,
    problems: &mut Vec<ReadError>,
) -> Result<HashMap<String, SensorMount>> {
    let mut channels = HashMap::new();
    read_all(version, "sensor.json", problems, |row| {
        let channel = row.required("channel")?.text()?;
        let is_lidar = match row.optional("modality")? {
            Some(modality) => modality.text()?.eq_ignore_ascii_case("lidar"),
            None => channel.starts_with("LIDAR"),
        };
        if is_lidar {
            channels.insert(row.required("token")?.id()?, channel.to_owned());
        }
        Ok(())
    })?;
    let mut mounts = HashMap::new();
    read_all(version, "calibrated_sensor.json", problems, |row| {
        if let Some(channel) = channels.get(&row.required("sensor_token")?.id()?) {
            let mount = (channel.clone(), transform(row)?);
            mounts.insert(row.required("token")?.id()?, mount);
        }
        Ok(())
    })?;
    Ok(mounts)
}

fn read_scenes(version: &Path, problems: &mut Vec<ReadError>) -> Result<(Vec<Scene>, Indices)> {
    let (mut scenes, mut indices) = (Vec::new(), Indices::new());
    read_all(version, "scene.json", problems, |row| {
        let vehicles = row.optional_of("vehicle_list", |list| {
            list.items()?.map(|vehicle| vehicle.id()).collect()
        });
        let vehicles: Vec<String> = vehicles?.unwrap_or_default();
        let name = row.required("name")?.id()?;
        indices.insert(row.required("token")?.id()?, scenes.len());
        scenes.push(Scene { name, vehicles });
        Ok(())
    })?;
    Ok((scenes, indices))
}

fn read_samples(
    version: &Path,
    scenes: &Indices,
    problems: &mut Vec<ReadError>,
) -> Result<(Vec<SceneSample>, Indices, Unit)> {
    let (mut samples, mut stamps, mut indices) = (Vec::new(), Vec::new(), Indices::new());
    read_all(version, "sample.json", problems, |row| {
        let scene = referred(row, "scene_token", scenes)?;
        let stamp = row.required("timestamp")?.time()?;
        indices.insert(row.required("token")?.id()?, samples.len());
        stamps.push((scene, stamp));
        samples.push(SceneSample {
            scene,
            ..SceneSample::default()
        });
        Ok(())
    })?;
    // Scene by scene in the order of time: rows may have any order, and scenes the same times.
    let mut in_order = stamps.clone();
    in_order.sort_by(|(a, first), (b, second)| a.cmp(b).then(first.total_cmp(second)));
    let in_order: Vec<f64> = in_order.into_iter().map(|(_, stamp)| stamp).collect();
    let unit = Unit::of_file(&version.join("sample.json"), &in_order, problems);
    for (sample, (_, stamp)) in samples.iter_mut().zip(stamps) {
        sample.micros = unit.micros(stamp);
    }
    Ok((samples, indices, unit))
}

/// Sweeps of key frames by the token of their vehicle's pose.
fn read_sweeps(
    version: &Path,
    mounts: &HashMap<String, SensorMount>,
    samples: &Indices,
    unit: Unit,
    problems: &mut Vec<ReadError>,
) -> Result<HashMap<String, Vec<SweepRow>>> {
    let mut sweeps: HashMap<String, Vec<SweepRow>> = HashMap::new();
    let is_needed = |keys: &RowKeys<'_>| {
        // A row without this key counts as one of a key frame.
        keys.is_key_frame != Some(false) && mounts.contains_key(&*keys.calibrated_sensor_token)
    };
    let path = version.join("sample_data.json");
    json_table::read(&path, MAX_BYTES, problems, is_needed, |row| {
        let token = row.required("calibrated_sensor_token")?;
        let mount = mounts.get(&token.id()?);
        let mount = mount.ok_or_else(|| token.error("no row of calibrated_sensor.json has it"))?;
        let file = row.required("filename")?;
        let name = file.text()?;
        let mut parts = Path::new(name).components();
        // An absolute path or `..` would lead out of the data set.
        if !parts.all(|part| matches!(part, Component::Normal(_))) {
            return Err(file.error(format!("{name:?}, expected a path below the data set")));
        }
        // One that cannot be read counts as missing: of a single sweep it is not needed.
        let stamp = row.optional_of("timestamp", |stamp| stamp.time());
        let stamp = stamp.unwrap_or_default();
        let sweep = SweepRow {
            sample: referred(row, "sample_token", samples)?,
            file: name.to_owned(),
            micros: stamp.map(|stamp| unit.micros(stamp)),
            mount: mount.clone(),
        };
        let pose = row.required("ego_pose_token")?.id()?;
        sweeps.entry(pose).or_default().push(sweep);
        Ok(())
    })?;
    Ok(sweeps)
}

/// Assigns the sweeps to the samples, with the poses of the vehicles. Of several sweeps of a LiDAR that refer to one
/// sample, the one nearest to it in time is used.
fn place(
    version: &Path,
    mut rows: HashMap<String, Vec<SweepRow>>,
    samples: &mut [SceneSample],
    problems: &mut Vec<ReadError>,
) -> Result<()> {
    let tokens: std::collections::HashSet<String> = rows.keys().cloned().collect();
    let is_needed = |keys: &RowKeys<'_>| tokens.contains(&*keys.token);
    let [path, of_sweeps] = ["ego_pose.json", "sample_data.json"].map(|name| version.join(name));
    let mut further = 0;
    json_table::read(&path, MAX_BYTES, problems, is_needed, |row| {
        let world_from_vehicle = transform(row)?;
        let token = row.required("token")?.id()?;
        for row in rows.remove(&token).unwrap_or_default() {
            let Some(sample) = samples.get_mut(row.sample) else {
                continue;
            };
            let off_micros = row.micros.map(|micros| micros.abs_diff(sample.micros));
            let (channel, vehicle_from_lidar) = row.mount;
            let sweep = SampleSweep {
                file: row.file,
                off_micros: off_micros.unwrap_or(u64::MAX),
                world_from_vehicle,
                vehicle_from_lidar,
            };
            let known = sample.sweeps.get(&channel);
            further += usize::from(known.is_some());
            // Of equally near ones the name decides, not the order of the table.
            let rank = |sweep: &SampleSweep| (sweep.off_micros, sweep.file.clone());
            if known.is_none_or(|known| rank(&sweep) < rank(known)) {
                sample.sweeps.insert(channel, sweep);
            }
        }
        Ok(())
    })?;
    if further > 0 {
        let reason = format!(
            "{further} sweeps of a sample and LiDAR that have one nearer in time: left out"
        );
        problems.push(ReadError::malformed(&of_sweeps, reason));
    }
    let without_pose = rows.values().flatten().map(|row| row.file.as_str());
    if let Some(first) = without_pose.clone().min() {
        let count = without_pose.count();
        let reason = format!("no pose for {count} sweeps, the first {first}: left out");
        problems.push(ReadError::malformed(&path, reason));
    }
    Ok(())
}
