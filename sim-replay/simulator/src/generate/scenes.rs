//! Scene generation from options to folders: scenes one after another, the frames of each on several threads.

use std::collections::BTreeMap;
use std::fs;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use protocol::CavId;

use super::data_protocol::protocol_yaml;
use super::error::SynthError;
use super::layout::{
    Moment, Omissions, SceneAgent, SceneHeader, SceneWriter, Unfinished, locked, make_folder,
    written,
};
use super::options::{Subset, SynthOptions};
use super::positioning::Positioning;
use super::recording::{SceneRecording, SceneSpec, record};
use super::sensing::{Bench, STEP_NANOS, SensingAgent, SynthScene, capture_nanos};
use super::world::World;
use crate::generate::Result;
use crate::map::{self, Finding, MapModel, RoadMapSource};
use dataset::UNFINISHED;
use support::atomic_file;
use support::random::derive_seed;

/// Summary of generation.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Summary {
    /// Scenarios.
    pub scenarios: usize,
    /// Frames of all agents together.
    pub agent_frames: usize,
    /// LiDAR points of all agent-frames.
    pub points: usize,
    /// Annotated vehicles of all agent-frames.
    pub annotations: usize,
    /// Data that the layout cannot hold, with the number of times that it was left out.
    pub omitted: BTreeMap<&'static str, u64>,
    /// Parts of the map that were not built as its file gives them.
    pub findings: Vec<Finding>,
}

impl Summary {
    fn add(&mut self, other: &Self) {
        self.scenarios += other.scenarios;
        self.agent_frames += other.agent_frames;
        self.points += other.points;
        self.annotations += other.annotations;
    }
}

/// Generates all scenes of `options`. `progress` receives the progress in thousandths of a scenario, from any thread.
///
/// # Errors
/// [`SynthError`] if an option is invalid, the map cannot be built or a file cannot be written.
pub fn generate(options: &SynthOptions, progress: &(dyn Fn(u64) + Sync)) -> Result<Summary> {
    options.validate()?;
    let unfinished = begin_folder(&options.out, options.force)?;
    let mut writer = options.layout.writer(&options.out);
    let omitted = Omissions::default();
    let mut total = Summary::default();
    for (place, source) in sources(options).iter().enumerate() {
        let map_model = map::build(source, options.map_seed)?;
        total.findings.extend(map_model.findings.iter().cloned());
        let world = World::new(&map_model);
        let places = sources(options).len();
        // Numbers alternate between the maps. All scenes of one map go together, so that it is built once.
        for number in (place..options.scenes).step_by(places) {
            let before = total.scenarios as u64 * 1000;
            let scene = SynthScene {
                options,
                world: &world,
                spec: spec(options, &map_model, number),
            };
            total.add(&scene.write(writer.as_mut(), &omitted, &|thousandths| {
                progress(before + thousandths)
            })?);
        }
    }
    writer.finish()?;
    end_folder(&options.out, unfinished)?;
    total.omitted = omitted.into_counts();
    Ok(total)
}

/// The maps of the scenarios, used in turn.
pub(super) fn sources(options: &SynthOptions) -> Vec<RoadMapSource> {
    match (&options.map, options.subset) {
        (Some(map), _) => vec![map.clone()],
        (None, Subset::Town1loc) => vec![RoadMapSource::Town1],
        (None, Subset::Town4loc) => vec![RoadMapSource::Town4],
        (None, Subset::V2vdet) => vec![RoadMapSource::Town1, RoadMapSource::Town4],
    }
}

fn spec(options: &SynthOptions, map_model: &MapModel, number: usize) -> SceneSpec {
    // Every scene has its own seed, independent of the numbers of scenes and agents before it.
    let seed = derive_seed(options.seed, &[options.subset as u64, number as u64]);
    let (low, high) = (*options.agents.start(), *options.agents.end());
    let is_detection = options.subset == Subset::V2vdet;
    let (subset, map_name) = (options.subset.name(), map_model.name.to_lowercase());
    let choice = (derive_seed(seed, &[0]) % (high - low + 1) as u64) as usize;
    SceneSpec {
        name: format!("{subset}_{map_name}_s{}_{number:04}", options.seed),
        seed,
        agents: if is_detection { low + choice } else { 1 },
        frames: options.frames,
        steps_per_frame: options.steps_per_frame(),
        explores: !is_detection,
    }
}

/// Creates the output folder and marks it as unfinished; refuses one that is not empty.
pub(super) fn begin_folder(out: &std::path::Path, force: bool) -> Result<Unfinished> {
    make_folder(out)?;
    let mut entries = written(out, fs::read_dir(out))?;
    if entries.next().is_some() && !force {
        return Err(SynthError::NotEmpty(out.to_owned()));
    }
    Unfinished::mark(out)
}

/// Removes the mark of the output folder when all its files are on the disk: until then readers report it as unfinished,
/// also after a power cut.
pub(super) fn end_folder(out: &std::path::Path, unfinished: Unfinished) -> Result<()> {
    written(out, atomic_file::sync(out))?;
    unfinished.clear()?;
    written(out, atomic_file::sync_name(&out.join(UNFINISHED)))
}

impl SynthScene<'_, '_> {
    fn write(
        &self,
        writer: &mut dyn SceneWriter,
        omitted: &Omissions,
        progress: &(dyn Fn(u64) + Sync),
    ) -> Result<Summary> {
        let recording = record(self.world, &self.spec)?;
        let agents = self.agents(&recording)?;
        writer.begin(&self.header(&recording, &agents))?;
        let mut summary = self.write_moments(&recording, &agents, (writer, omitted), progress)?;
        writer.end()?;
        summary.scenarios = 1;
        Ok(summary)
    }

    fn header(&self, recording: &SceneRecording, agents: &[SensingAgent]) -> SceneHeader {
        let agents = agents.iter().map(|agent| SceneAgent {
            id: agent.cav.clone(),
            is_roadside: false,
        });
        SceneHeader {
            name: self.spec.name.clone(),
            agents: agents.collect(),
            capture_nanos: recording.frames.iter().map(capture_nanos).collect(),
            tick_nanos: STEP_NANOS,
            origin: protocol_yaml(self.options, &self.spec, self.world.map_model),
        }
    }

    fn agents(&self, recording: &SceneRecording) -> Result<Vec<SensingAgent>> {
        let mut agents = Vec::new();
        for &vehicle in &recording.agents {
            // Agents are chosen among those that are present from the first frame to the last.
            let first = recording.frames[0].of(vehicle);
            let id = first.map_or(0, |moving| moving.id);
            let mut positioning = Positioning::new(derive_seed(self.spec.seed, &[4, id as u64]));
            let frames = recording.frames.iter();
            let moving = frames.filter_map(|frame| frame.of(vehicle));
            let fixes = moving.map(|moving| {
                positioning.fix(&moving.motion, moving.speed_mps, self.options.period_s)
            });
            let layout = self.options.layout.name();
            let cav = CavId::new(&id.to_string())
                .map_err(|error| SynthError::Layout(format!("{layout}: {error}")))?;
            agents.push(SensingAgent {
                vehicle,
                id,
                cav,
                fixes: fixes.collect(),
            });
        }
        Ok(agents)
    }

    /// Writes every capture time. Each frame depends on the recording and its own seed only, so the number of threads
    /// and their order change nothing.
    fn write_moments(
        &self,
        recording: &SceneRecording,
        agents: &[SensingAgent],
        (writer, omitted): (&dyn SceneWriter, &Omissions),
        progress: &(dyn Fn(u64) + Sync),
    ) -> Result<Summary> {
        let moments = recording.frames.len();
        let (next, done) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let total = Mutex::new(Ok(Summary::default()));
        let work = || {
            let mut bench = Bench::new(self.world, self.options.cameras);
            loop {
                let index = next.fetch_add(1, Ordering::Relaxed);
                if index >= moments {
                    return;
                }
                let moment = self.moment(recording, agents, index, &mut bench);
                let result = writer.write(&moment, omitted).map(|_| counts(&moment));
                let mut total = locked(&total);
                match (&mut *total, result) {
                    (Ok(total), Ok(summary)) => total.add(&summary),
                    (Ok(_), Err(error)) => *total = Err(error),
                    // Another thread has failed: the other frames need not be written.
                    (Err(_), _) => return,
                }
                drop(total);
                progress(1000 * (done.fetch_add(1, Ordering::Relaxed) + 1) as u64 / moments as u64);
            }
        };
        std::thread::scope(|scope| {
            // One thread fewer, as this one works too.
            for _ in 1..self.options.threads.min(moments) {
                scope.spawn(work);
            }
            work();
        });
        total.into_inner().unwrap_or_else(PoisonError::into_inner)
    }
}

fn counts(moment: &Moment) -> Summary {
    let frames = moment.frames.iter().map(|agent| &agent.frame);
    Summary {
        agent_frames: moment.frames.len(),
        points: frames.clone().map(|frame| frame.points.len()).sum(),
        annotations: frames.map(|frame| frame.objects.len()).sum(),
        ..Summary::default()
    }
}
