//! Data sets with the tables of nuScenes: V2X-Sim 2.0, Open MARS and nuScenes itself,
//! `<root>/<version>/{scene,sample,sample_data,..}.json` and sweeps below the root.
//!
//! A scene is a scenario, a key frame of the ego a tick. The channel of a LiDAR names its agent: `LIDAR_TOP_id_<agent>`
//! (V2X-Sim; 0 is the roadside unit), `LIDAR_FRONT_CENTER_<vehicle>` (Open MARS). Annotations are those of the whole
//! scene; an agent lists the objects hit by its sweep, as in the public converter of V2X-Sim. Open MARS has none.

mod annotations;
mod rig;
mod rows;
mod samples;
mod tables;
#[cfg(test)]
mod tests;

use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use nalgebra::Isometry3;
use protocol::{CavId, Handedness};

use self::rig::QuarterTurns;
use self::samples::{SampleSweep, SceneSample};
use self::tables::Scene;
use super::layout::{LayoutReader, LayoutRow, opened};
use super::points::{SweepStorage, Sweeps};
use super::{
    Dataset, FrameSource, Layout, MissingFrame, OpenOptions, ReadError, Result, Scenario, Tick,
    files, repeats, roots,
};
use crate::frame::{Frame, Object, ObjectClass};
use crate::pcd::PcdCloud;

/// V2X-Sim 2.0: nuScenes tables and sweeps of several agents.
pub(crate) static V2XSIM: LayoutRow = LayoutRow {
    key: "v2x_sim",
    name: "V2X-Sim",
    data_sets: "V2X-Sim 2.0",
    files: "<version>/sample.json and sample_data.json (nuScenes tables), a LiDAR LIDAR_TOP_id_<agent>",
    protocol: "v2xsim",
    reader: Some(LayoutReader::DataSet(open)),
};

/// Open MARS: nuScenes tables of several vehicles.
pub(crate) static MARS: LayoutRow = LayoutRow {
    key: "mars",
    name: "Open MARS",
    data_sets: "Open MARS",
    files: "<version>/sample.json and sample_data.json (nuScenes tables), a LiDAR LIDAR_FRONT_CENTER or LIDAR_FRONT_CENTER_<vehicle>",
    protocol: "mars",
    reader: None,
};

/// nuScenes: tables of one vehicle.
pub(crate) static NUSCENES: LayoutRow = LayoutRow {
    key: "nu_scenes",
    name: "nuScenes",
    data_sets: "nuScenes, T4",
    files: "<version>/sample.json and sample_data.json (nuScenes tables), the LiDAR LIDAR_TOP or LIDAR_CONCAT",
    protocol: "opv2v",
    reader: None,
};

/// Tables that identify the layout: a folder with these is a version of a data set.
const TABLES: [&str; 2] = ["sample.json", "sample_data.json"];
/// The table of annotated objects.
const ANNOTATIONS: &str = "sample_annotation.json";
/// Width up to which a vehicle of V2X-Sim has two wheels, metres (the public converter drops narrower ones).
const TWO_WHEELER_WIDTH_M: f64 = 1.5;

/// Opens the data sets at or below `dir`; `None` if there are none.
pub(super) fn open(dir: &Path, options: &OpenOptions) -> Result<Option<Dataset>> {
    let (mut scenarios, mut problems) = (Vec::new(), Vec::new());
    for version in &files::each_once(roots::find(dir, is_version), &mut problems) {
        match open_version(dir, version, options, &mut problems) {
            Ok(found) => scenarios.extend(found),
            Err(error) => problems.push(error),
        }
    }
    leave_copies_out(&mut scenarios, &mut problems);
    opened(dir, scenarios, problems)
}

/// Leaves out the scenes whose first sweep is that of a scene before: versions of one root may share scenes.
fn leave_copies_out(scenarios: &mut Vec<Scenario>, problems: &mut Vec<ReadError>) {
    let mut names = HashMap::new();
    scenarios.retain(|scenario| {
        let Ok(path) = scenario.points_path(0, 0, None) else {
            return true;
        };
        let known = names.get(&path).cloned();
        if known.is_none() {
            names.insert(path.clone(), scenario.name.clone());
        }
        problems.extend(known.iter().map(|known| {
            let again = &scenario.name;
            let reason = format!("first sweep of scene {known}: scene {again}, too, is left out");
            ReadError::malformed(&path, reason)
        }));
        known.is_none()
    });
}

fn is_version(dir: &Path) -> bool {
    TABLES.iter().all(|table| dir.join(table).is_file())
}

fn open_version(
    opened: &Path,
    version: &Path,
    options: &OpenOptions,
    problems: &mut Vec<ReadError>,
) -> Result<Vec<Scenario>> {
    let root = files::above(version)
        .find(|root| root.is_dir())
        .unwrap_or_else(|| version.to_owned());
    let (scenes, samples) = tables::read(version, problems)?;
    let layout = layout(version, &samples)?;
    let mut moments: Vec<Vec<SceneSample>> = scenes.iter().map(|_| Vec::new()).collect();
    for sample in samples {
        if let Some(moments) = moments.get_mut(sample.scene) {
            moments.push(sample);
        }
    }
    let prefix = files::name_below(opened, version);
    let mut taken = BTreeSet::new();
    let mut scenarios = Vec::with_capacity(scenes.len());
    for (index, (scene, moments)) in scenes.iter().zip(moments).enumerate() {
        let mut name = format!("{prefix}/{}", scene.name);
        if !taken.insert(name.clone()) {
            name = format!("{name}_{index}");
        }
        let builder = SceneBuilder {
            root: &root,
            version,
            layout,
            scene,
            name,
        };
        scenarios.extend(builder.build(moments, options, problems)?);
    }
    scenarios.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(scenarios)
}

/// The layout of the first supported channel.
fn layout(version: &Path, samples: &[SceneSample]) -> Result<Layout> {
    let channels = samples.iter().flat_map(|sample| sample.sweeps.keys());
    let channels: BTreeSet<&str> = channels.map(String::as_str).collect();
    channels.iter().find_map(|channel| Some(rig::agent_of(channel)?.0)).ok_or_else(|| {
        let reason = format!(
            "nuScenes tables without a supported LiDAR: {channels:?}, expected LIDAR_TOP_id_<agent> (V2X-Sim), \
             LIDAR_FRONT_CENTER_<vehicle> (Open MARS), LIDAR_TOP (nuScenes) or LIDAR_CONCAT (T4)"
        );
        ReadError::malformed(version, reason)
    })
}

/// Inputs of a scenario.
struct SceneBuilder<'a> {
    root: &'a Path,
    version: &'a Path,
    layout: Layout,
    scene: &'a Scene,
    name: String,
}

impl SceneBuilder<'_> {
    /// The scenario of a scene; nothing if no vehicle has a sweep.
    fn build(
        self,
        mut samples: Vec<SceneSample>,
        options: &OpenOptions,
        problems: &mut Vec<ReadError>,
    ) -> Result<Option<Scenario>> {
        samples.sort_by_key(|sample| sample.micros);
        let agents = self.agents(&samples)?;
        if agents.is_empty() {
            let scene = &self.scene.name;
            let reason = format!("scene {scene}: no sweep of a supported LiDAR: left out");
            let path = self.version.join("sample_data.json");
            problems.push(ReadError::malformed(&path, reason));
            return Ok(None);
        }
        let capture_nanos = self.capture_times(&samples, options, problems);
        let (mut moments, mut missing, mut contents) = (Vec::new(), Vec::new(), HashMap::new());
        for (mut sample, capture_nanos) in samples.into_iter().zip(capture_nanos) {
            let mut channels = agents.iter().map(|(_, channel)| channel);
            // The first sweep in the order of the agents gives the name: the ego may lack one.
            let stem = channels.find_map(|channel| Some(sample.sweeps.get(channel)?.stem()));
            let mut stem = stem.unwrap_or_else(|| sample.micros.to_string());
            // The files of several samples may have one name, in folders of their own.
            if contents.contains_key(&stem) {
                stem = format!("{stem}_{:06}", moments.len());
            }
            let tick = Tick::new(stem, capture_nanos);
            let mut sweeps = HashMap::new();
            for (agent, channel) in &agents {
                if let Some(sweep) = sample.sweeps.remove(channel) {
                    let path = self.root.join(&sweep.file);
                    if path.is_file() {
                        sweeps.insert(agent.clone(), sweep);
                        continue;
                    }
                    let reason =
                        format!("does not exist: agent {agent} is absent at {}", tick.stem);
                    problems.push(ReadError::malformed(&path, reason));
                }
                missing.push(MissingFrame::new(agent, &tick.stem));
            }
            let objects = sample.objects;
            contents.insert(tick.stem.clone(), TickContents { sweeps, objects });
            moments.push(tick);
        }
        let agents = agents.into_iter().map(|(agent, _)| agent).collect();
        let scenario = self.scenario(agents, &moments, contents, options);
        Ok(Some(scenario.among(moments, missing)))
    }

    /// The scenario without its ticks, from the contents of `moments` by their stems.
    fn scenario(
        self,
        agents: Vec<CavId>,
        moments: &[Tick],
        contents: HashMap<String, TickContents>,
        options: &OpenOptions,
    ) -> Scenario {
        let units = agents.iter();
        let units = units.filter(|agent| rig::is_roadside_unit(self.layout, agent.as_str()));
        let roadside_units = units.cloned().collect();
        let mut sweeps = Sweeps::new(SweepStorage::ByName, options);
        for agent in &agents {
            let files = moments.iter().filter_map(|tick| {
                let sweep = contents.get(&tick.stem)?.sweeps.get(agent)?;
                Some(self.root.join(&sweep.file))
            });
            sweeps = sweeps.with_agent(agent.clone(), files);
        }
        let source = Arc::new(SceneSource {
            root: self.root.to_owned(),
            version: self.version.to_owned(),
            layout: self.layout,
            moments: contents,
            sweeps,
        });
        Scenario {
            roadside_units,
            ..Scenario::new(self.name, self.layout, agents, Vec::new(), source)
        }
    }

    /// Agents with the channels of their LiDARs, ego first: vehicles in the order of the data set or of their names, a
    /// roadside unit last.
    fn agents(&self, samples: &[SceneSample]) -> Result<Vec<(CavId, String)>> {
        let channels = samples.iter().flat_map(|sample| sample.sweeps.keys());
        let mut agents = Vec::new();
        for channel in channels.collect::<BTreeSet<&String>>() {
            let agent = rig::agent_of(channel);
            let Some((_, name)) = agent.filter(|(layout, _)| *layout == self.layout) else {
                continue;
            };
            let id = CavId::new(name).map_err(|error| {
                let reason = format!("channel {channel}: {error}");
                ReadError::malformed(&self.version.join("sensor.json"), reason)
            })?;
            // One cloud of all LiDARs comes before that of one.
            if agents.iter().all(|(known, _)| *known != id) {
                agents.push((id, channel.clone()));
            }
        }
        let vehicles = &self.scene.vehicles;
        agents.sort_by_key(|(id, _)| {
            let name = id.as_str();
            let listed = vehicles.iter().position(|vehicle| vehicle == name);
            let number = name.parse::<u64>().unwrap_or(u64::MAX);
            let is_unit = rig::is_roadside_unit(self.layout, name);
            (is_unit, listed.unwrap_or(usize::MAX), number, id.clone())
        });
        Ok(agents)
    }

    /// Times from the first on. If time stamps do not increase, capture times are assumed to be evenly spaced.
    fn capture_times(
        &self,
        samples: &[SceneSample],
        options: &OpenOptions,
        problems: &mut Vec<ReadError>,
    ) -> Vec<u64> {
        let micros: Vec<u64> = samples.iter().map(|sample| sample.micros).collect();
        if micros.array_windows().all(|[a, b]| a < b) {
            let start = micros.first().copied().unwrap_or(0);
            let since = micros.iter().map(|micros| micros - start);
            return since.map(|micros| micros.saturating_mul(1000)).collect();
        }
        let scene = &self.scene.name;
        let reason = format!(
            "scene {scene}: time stamps that repeat: its moments are taken as evenly spaced"
        );
        let path = self.version.join("sample.json");
        problems.push(ReadError::malformed(&path, reason));
        let indices = 0..samples.len() as u64;
        indices
            .map(|index| index.saturating_mul(options.period_nanos))
            .collect()
    }
}

impl SampleSweep {
    /// The name of its file without suffixes.
    fn stem(&self) -> String {
        let name = self.file.rsplit('/').next().unwrap_or(&self.file);
        let name = name.trim_end_matches(".bin");
        name.trim_end_matches(".pcd").to_owned()
    }

    fn turns(&self) -> QuarterTurns {
        QuarterTurns::to_forward(&self.vehicle_from_lidar)
    }

    /// Pose of the LiDAR frame turned to x forward.
    fn world_from_lidar(&self) -> Isometry3<f64> {
        self.world_from_vehicle * self.vehicle_from_lidar * self.turns().lidar_from_turned()
    }
}

/// A tick: sweeps of the agents that are present, and all annotations.
#[derive(Debug)]
struct TickContents {
    sweeps: HashMap<CavId, SampleSweep>,
    objects: Vec<Object>,
}

/// A scene.
#[derive(Debug)]
struct SceneSource {
    root: PathBuf,
    /// Folder of the tables.
    version: PathBuf,
    layout: Layout,
    /// By the stem of the tick.
    moments: HashMap<String, TickContents>,
    sweeps: Sweeps,
}

impl SceneSource {
    fn sweep(&self, agent: &CavId, tick: &Tick) -> Result<(&TickContents, &SampleSweep)> {
        let moment = self.moments.get(&tick.stem);
        let found = moment.and_then(|moment| Some((moment, moment.sweeps.get(agent)?)));
        found.ok_or_else(|| {
            let reason = format!("no sweep of agent {agent} at {}", tick.stem);
            ReadError::malformed(&self.root, reason)
        })
    }

    /// V2X-Sim classifies all wheeled objects as vehicles.
    fn with_class(&self, object: &Object) -> Object {
        let is_narrow = self.layout == Layout::V2XSIM && object.size_m[1] <= TWO_WHEELER_WIDTH_M;
        let mut object = object.clone();
        if is_narrow && ObjectClass::VEHICLES.contains(&object.class) {
            object.class = ObjectClass::TwoWheeler;
        }
        object
    }
}

impl FrameSource for SceneSource {
    /// Reads the sweep as well: an agent lists the objects hit by it.
    fn frame(&self, agent: &CavId, tick: &Tick) -> Result<Frame> {
        let (moment, sweep) = self.sweep(agent, tick)?;
        let world_from_lidar = sweep.world_from_lidar();
        let mut frame = Frame::empty(agent.clone(), tick.capture_nanos, Handedness::Right);
        frame.world_from_lidar = Some(world_from_lidar.into());
        frame.world_from_vehicle = Some(sweep.world_from_vehicle.into());
        if !moment.objects.is_empty() {
            let cloud = self.points(agent, tick, None)?;
            let (table, mut objects) = (self.version.join(ANNOTATIONS), moment.objects.clone());
            repeats::leave_out(&table, &mut objects, &mut frame.problems);
            let (seen, missed) = annotations::seen(&objects, &cloud.points, &world_from_lidar);
            let seen = seen.into_iter().map(|object| self.with_class(object));
            (frame.objects, frame.missed_objects) = (seen.collect(), missed);
        }
        Ok(frame)
    }

    fn points(&self, agent: &CavId, tick: &Tick, _variant: Option<&str>) -> Result<PcdCloud> {
        let (_, sweep) = self.sweep(agent, tick)?;
        let mut cloud = self.sweeps.read(agent, &self.root.join(&sweep.file))?;
        // By the turns that `SampleSweep::world_from_lidar` takes back in the pose.
        sweep.turns().apply(&mut cloud.points);
        Ok(cloud)
    }

    fn shared_files(&self, agent: &CavId) -> Vec<PathBuf> {
        let tables = tables::NAMES.map(|name| self.version.join(name));
        self.sweeps.samples(agent, tables)
    }

    fn points_path(&self, agent: &CavId, tick: &Tick, _variant: Option<&str>) -> PathBuf {
        match self.sweep(agent, tick) {
            Ok((_, sweep)) => self.root.join(&sweep.file),
            Err(_) => self.root.clone(),
        }
    }
}
