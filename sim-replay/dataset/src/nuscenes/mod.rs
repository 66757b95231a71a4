//! Data sets with the tables of nuScenes: V2X-Sim 2.0, Open MARS and nuScenes itself,
//! `<root>/<version>/{scene,sample,sample_data,..}.json` and sweeps below the root.
//!
//! A scene is a scenario, a key frame of the ego a tick. The channel of a LiDAR names its agent: `LIDAR_TOP_id_<agent>`
//! (V2X-Sim; 0 is the roadside unit), `LIDAR_FRONT_CENTER_<vehicle>` (Open MARS). Annotations are those of the whole
//! scene; an agent lists the objects hit by its sweep, as in the public converter of V2X-Sim. Open MARS has none.

mod annotations;
mod rig;
mod tables;
#[cfg(test)]
mod tests;

use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use nalgebra::Isometry3;
use protocol::{CavId, Handedness};

use self::rig::QuarterTurns;
use self::tables::{Sample, Scene, Sweep, Tables};
use super::layouts::{LayoutRow, Reader};
use super::open::opened;
use super::points::{SweepStorage, Sweeps};
use super::presence::Absences;
use super::{
    Dataset, FrameSource, Layout, MissingFrame, OpenOptions, ReadError, Scenario, Tick, files,
    roots,
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
    reader: Some(Reader::DataSet(open)),
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
/// Width up to which a vehicle of V2X-Sim has two wheels, metres (the public converter drops narrower ones).
const TWO_WHEELER_WIDTH_M: f64 = 1.5;

/// Opens the data sets at or below `dir`; `None` if there are none.
pub(super) fn open(dir: &Path, options: &OpenOptions) -> Result<Option<Dataset>, ReadError> {
    let (mut scenarios, mut problems) = (Vec::new(), Vec::new());
    for version in &roots::find(dir, is_version) {
        match open_version(dir, version, options, &mut problems) {
            Ok(found) => scenarios.extend(found),
            Err(error) => problems.push(error),
        }
    }
    opened(dir, scenarios, problems)
}

fn is_version(dir: &Path) -> bool {
    TABLES.iter().all(|table| dir.join(table).is_file())
}

fn open_version(
    opened: &Path,
    version: &Path,
    options: &OpenOptions,
    problems: &mut Vec<ReadError>,
) -> Result<Vec<Scenario>, ReadError> {
    let root = files::above(version)
        .find(|root| root.is_dir())
        .unwrap_or_else(|| version.to_owned());
    let Tables {
        scenes,
        samples,
        objects,
    } = tables::read(version, problems)?;
    let layout = layout(version, &samples)?;
    let mut moments: Vec<Vec<(Sample, Vec<Object>)>> = scenes.iter().map(|_| Vec::new()).collect();
    for (sample, objects) in samples.into_iter().zip(objects) {
        if let Some(moments) = moments.get_mut(sample.scene) {
            moments.push((sample, objects));
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
        scenarios.extend(
            Builder {
                root: &root,
                version,
                layout,
                scene,
                name,
            }
            .build(moments, options, problems)?,
        );
    }
    scenarios.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(scenarios)
}

/// The layout of the first supported channel.
fn layout(version: &Path, samples: &[Sample]) -> Result<Layout, ReadError> {
    let channels: BTreeSet<&str> = samples
        .iter()
        .flat_map(|sample| sample.sweeps.keys().map(String::as_str))
        .collect();
    channels.iter().find_map(|channel| Some(rig::agent_of(channel)?.0)).ok_or_else(|| {
        let reason = format!(
            "nuScenes tables without a supported LiDAR: {channels:?}, expected LIDAR_TOP_id_<agent> (V2X-Sim), \
             LIDAR_FRONT_CENTER_<vehicle> (Open MARS), LIDAR_TOP (nuScenes) or LIDAR_CONCAT (T4)"
        );
        ReadError::Layout { path: version.to_owned(), reason }
    })
}

/// Inputs of a scenario.
struct Builder<'a> {
    root: &'a Path,
    version: &'a Path,
    layout: Layout,
    scene: &'a Scene,
    name: String,
}

/// Ticks and contents of a scenario.
#[derive(Default)]
struct Parts {
    /// Ticks of the ego.
    ticks: Vec<Tick>,
    /// Capture times of any agent.
    moments: Vec<Tick>,
    missing: Vec<MissingFrame>,
    /// Contents by stem.
    contents: HashMap<String, Moment>,
}

impl Builder<'_> {
    /// The scenario of a scene; nothing if no vehicle has a sweep.
    fn build(
        self,
        mut samples: Vec<(Sample, Vec<Object>)>,
        options: &OpenOptions,
        problems: &mut Vec<ReadError>,
    ) -> Result<Option<Scenario>, ReadError> {
        samples.sort_by_key(|(sample, _)| sample.micros);
        let agents = self.agents(&samples)?;
        let Some((ego, _)) = agents.first() else {
            let reason = format!(
                "scene {}: no sweep of a supported LiDAR: left out",
                self.scene.name
            );
            problems.push(ReadError::malformed(
                &self.version.join("sample_data.json"),
                reason,
            ));
            return Ok(None);
        };
        let capture_nanos = self.capture_times(&samples, options, problems);
        let mut scenario = Parts::default();
        for ((sample, objects), capture_nanos) in samples.into_iter().zip(capture_nanos) {
            let stem = agents
                .iter()
                .find_map(|(_, channel)| Some(sample.sweeps.get(channel)?.stem()));
            let tick = Tick {
                stem: stem.unwrap_or_else(|| sample.micros.to_string()),
                capture_nanos,
            };
            let mut sweeps = HashMap::new();
            for (agent, channel) in &agents {
                match sample.sweeps.get(channel) {
                    Some(sweep) if self.root.join(&sweep.file).is_file() => {
                        sweeps.insert(agent.clone(), sweep.clone());
                        continue;
                    }
                    Some(sweep) => {
                        let reason =
                            format!("does not exist: agent {agent} is absent at {}", tick.stem);
                        problems.push(ReadError::malformed(&self.root.join(&sweep.file), reason));
                    }
                    None => {}
                }
                scenario.missing.push(MissingFrame {
                    agent: agent.clone(),
                    stem: tick.stem.clone(),
                });
            }
            if sweeps.contains_key(ego) {
                scenario.ticks.push(tick.clone());
            }
            scenario
                .contents
                .insert(tick.stem.clone(), Moment { sweeps, objects });
            scenario.moments.push(tick);
        }
        let agents: Vec<CavId> = agents.into_iter().map(|(agent, _)| agent).collect();
        Ok(Some(self.scenario(agents, scenario, options)))
    }

    fn scenario(self, agents: Vec<CavId>, parts: Parts, options: &OpenOptions) -> Scenario {
        let Parts {
            ticks,
            moments,
            missing,
            contents,
        } = parts;
        let is_unit = |agent: &&CavId| rig::is_roadside_unit(self.layout, agent.as_str());
        let sweeps = agents.iter().fold(
            Sweeps::new(SweepStorage::ByName, options),
            |sweeps, agent| {
                let file = |tick: &Tick| {
                    Some(
                        self.root
                            .join(&contents.get(&tick.stem)?.sweeps.get(agent)?.file),
                    )
                };
                sweeps.with_agent(agent.clone(), moments.iter().filter_map(file))
            },
        );
        Scenario {
            absences: Absences::new(&agents, &ticks, &missing).among(moments),
            roadside_units: agents.iter().filter(is_unit).cloned().collect(),
            name: self.name,
            agents,
            ticks,
            missing,
            lidar_variants: Vec::new(),
            has_radar: false,
            cameras: Vec::new(),
            layout: self.layout,
            source_handedness: Handedness::Right,
            joins: Vec::new(),
            contradicted: BTreeSet::new(),
            source: Arc::new(Source {
                root: self.root.to_owned(),
                version: self.version.to_owned(),
                layout: self.layout,
                moments: contents,
                sweeps,
            }),
        }
    }

    /// Agents with the channels of their LiDARs, ego first: vehicles in the order of the data set or of their names, a
    /// roadside unit last.
    fn agents(&self, moments: &[(Sample, Vec<Object>)]) -> Result<Vec<(CavId, String)>, ReadError> {
        let channels: BTreeSet<&String> = moments
            .iter()
            .flat_map(|(sample, _)| sample.sweeps.keys())
            .collect();
        let mut agents = Vec::new();
        for channel in channels {
            let Some((_, name)) =
                rig::agent_of(channel).filter(|(layout, _)| *layout == self.layout)
            else {
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
        let listed = |name: &str| {
            self.scene
                .vehicles
                .iter()
                .position(|vehicle| vehicle == name)
                .unwrap_or(usize::MAX)
        };
        agents.sort_by_key(|(id, _)| {
            let name = id.as_str();
            (
                rig::is_roadside_unit(self.layout, name),
                listed(name),
                name.parse::<u64>().unwrap_or(u64::MAX),
                name.to_owned(),
            )
        });
        Ok(agents)
    }

    /// Times from the first on. If time stamps do not increase, capture times are assumed to be evenly spaced.
    fn capture_times(
        &self,
        moments: &[(Sample, Vec<Object>)],
        options: &OpenOptions,
        problems: &mut Vec<ReadError>,
    ) -> Vec<u64> {
        let micros: Vec<u64> = moments.iter().map(|(sample, _)| sample.micros).collect();
        if micros.array_windows().all(|[a, b]| a < b) {
            let start = micros.first().copied().unwrap_or(0);
            return micros
                .iter()
                .map(|micros| (micros - start).saturating_mul(1000))
                .collect();
        }
        let reason = format!(
            "scene {}: time stamps that repeat: its moments are taken as evenly spaced",
            self.scene.name
        );
        problems.push(ReadError::malformed(
            &self.version.join("sample.json"),
            reason,
        ));
        (0..moments.len() as u64)
            .map(|index| index.saturating_mul(options.period_nanos))
            .collect()
    }
}

impl Sweep {
    /// The name of its file without suffixes.
    fn stem(&self) -> String {
        let name = self.file.rsplit('/').next().unwrap_or(&self.file);
        name.trim_end_matches(".bin")
            .trim_end_matches(".pcd")
            .to_owned()
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
struct Moment {
    sweeps: HashMap<CavId, Sweep>,
    objects: Vec<Object>,
}

/// A scene.
#[derive(Debug)]
struct Source {
    root: PathBuf,
    /// Folder of the tables.
    version: PathBuf,
    layout: Layout,
    /// By the stem of the tick.
    moments: HashMap<String, Moment>,
    sweeps: Sweeps,
}

impl Source {
    fn sweep(&self, agent: &CavId, tick: &Tick) -> Result<(&Moment, &Sweep), ReadError> {
        let found = self
            .moments
            .get(&tick.stem)
            .and_then(|moment| Some((moment, moment.sweeps.get(agent)?)));
        found.ok_or_else(|| {
            ReadError::malformed(
                &self.root,
                format!("no sweep of agent {agent} at {}", tick.stem),
            )
        })
    }

    /// V2X-Sim classifies all wheeled objects as vehicles.
    fn with_class(&self, object: &Object) -> Object {
        let is_narrow = self.layout == Layout::V2XSIM && object.size_m[1] <= TWO_WHEELER_WIDTH_M;
        let class = if is_narrow && object.class.is_vehicle() {
            ObjectClass::TwoWheeler
        } else {
            object.class
        };
        Object {
            class,
            ..object.clone()
        }
    }
}

impl FrameSource for Source {
    /// Reads the sweep as well: an agent lists the objects hit by it.
    fn frame(&self, agent: &CavId, tick: &Tick) -> Result<Frame, ReadError> {
        let (moment, sweep) = self.sweep(agent, tick)?;
        let world_from_lidar = sweep.world_from_lidar();
        let mut frame = Frame::empty(agent.clone(), tick.capture_nanos, Handedness::Right);
        frame.world_from_lidar = Some(world_from_lidar.into());
        frame.world_from_vehicle = Some(sweep.world_from_vehicle.into());
        if !moment.objects.is_empty() {
            let cloud = self.points(agent, tick, None)?;
            let seen = annotations::seen(&moment.objects, &cloud.points, &world_from_lidar);
            frame.objects = seen.map(|object| self.with_class(object)).collect();
        }
        Ok(frame)
    }

    fn points(
        &self,
        agent: &CavId,
        tick: &Tick,
        _variant: Option<&str>,
    ) -> Result<PcdCloud, ReadError> {
        let (_, sweep) = self.sweep(agent, tick)?;
        let mut cloud = self.sweeps.read(agent, &self.root.join(&sweep.file))?;
        sweep.turns().apply(&mut cloud.points);
        Ok(cloud)
    }

    fn shared_files(&self, agent: &CavId) -> Vec<PathBuf> {
        let mut files = self.sweeps.samples(agent);
        files.extend(tables::NAMES.map(|name| self.version.join(name)));
        files
    }

    fn points_path(&self, agent: &CavId, tick: &Tick, _variant: Option<&str>) -> PathBuf {
        self.sweep(agent, tick).map_or_else(
            |_| self.root.clone(),
            |(_, sweep)| self.root.join(&sweep.file),
        )
    }
}
