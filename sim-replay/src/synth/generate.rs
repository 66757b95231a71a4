//! From options to folders: scenes one after another, the frames of each on several threads.

use std::fs;
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::cast::Body;
use super::error::SynthError;
use super::lidar::{LIDAR_MOUNT_M, Lidar, lidar_motion};
use super::options::{Subset, SynthOptions};
use super::positioning::{Fix, Positioning};
use super::protocol_file::{FILE_NAME, protocol_yaml};
use super::radar::Radar;
use super::recording::{RecordedFrame, Recording, SceneSpec, record};
use super::traffic::STEP_S;
use super::vehicle::Vehicle;
use super::world::World;
use super::writer::{AgentFolder, Annotation, FrameFacts, make_folder, write_file};
use crate::random::derive_seed;
use crate::town::{self, Finding, Town, TownSource};

/// The farthest that any sensor looks, metres.
const SIGHT_M: f64 = 152.0;

/// What was generated.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Summary {
    /// Scenario folders.
    pub scenarios: usize,
    /// Frames of all agents together.
    pub agent_frames: usize,
    /// LiDAR points of all agent-frames.
    pub points: usize,
    /// Annotated vehicles of all agent-frames.
    pub annotations: usize,
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

/// Generates everything that `options` ask for. `progress` hears how many scenarios of how many are done, in thousandths
/// of one, from any thread.
///
/// # Errors
/// [`SynthError`] where an option makes no sense, the town cannot be built or a file cannot be written.
pub fn generate(options: &SynthOptions, progress: &(dyn Fn(u64) + Sync)) -> Result<Summary, SynthError> {
    options.validate()?;
    check_folder(options)?;
    let mut total = Summary::default();
    for (place, source) in sources(options).iter().enumerate() {
        let town = town::build(source, options.town_seed)?;
        total.findings.extend(town.findings.iter().cloned());
        let world = World::new(&town);
        let places = sources(options).len();
        for number in (place..options.scenarios()).step_by(places) {
            let before = total.scenarios as u64 * 1000;
            let spec = spec(options, &town, number);
            let scene = Scene { options, world: &world, spec };
            total.add(&scene.write(&|thousandths| progress(before + thousandths))?);
        }
    }
    Ok(total)
}

/// The towns of the scenarios, which take them in turn.
pub(super) fn sources(options: &SynthOptions) -> Vec<TownSource> {
    match (&options.town, options.subset) {
        (Some(town), _) => vec![town.clone()],
        (None, Subset::Town1loc) => vec![TownSource::Town1],
        (None, Subset::Town4loc) => vec![TownSource::Town4],
        (None, Subset::V2vdet) => vec![TownSource::Town1, TownSource::Town4],
    }
}

fn spec(options: &SynthOptions, town: &Town, number: usize) -> SceneSpec {
    // Every scene has a seed of its own, whatever the number of scenes and the number of agents before it.
    let seed = derive_seed(options.seed, &[options.subset as u64, number as u64]);
    let (low, high) = (*options.agents.start(), *options.agents.end());
    let is_detection = options.subset == Subset::V2vdet;
    let choice = (derive_seed(seed, &[0]) % (high - low + 1) as u64) as usize;
    SceneSpec {
        name: format!("{}_{}_s{}_{number:04}", options.subset.name(), town.name.to_lowercase(), options.seed),
        seed,
        agents: if is_detection { low + choice } else { 1 },
        frames: options.frames,
        steps_per_frame: options.steps_per_frame(),
        explores: !is_detection,
    }
}

fn check_folder(options: &SynthOptions) -> Result<(), SynthError> {
    make_folder(&options.out)?;
    let entries = fs::read_dir(&options.out);
    let mut entries = entries.map_err(|source| SynthError::Write { path: options.out.clone(), source })?;
    if entries.next().is_some() && !options.force {
        return Err(SynthError::NotEmpty(options.out.clone()));
    }
    Ok(())
}

/// One scenario to be written.
struct Scene<'a, 't> {
    options: &'a SynthOptions,
    world: &'a World<'t>,
    spec: SceneSpec,
}

/// One agent over the whole scene.
struct Agent {
    vehicle: usize,
    id: i64,
    folder: AgentFolder,
    fixes: Vec<Fix>,
}

/// The sensors and buffers of one thread.
#[derive(Default)]
struct Bench {
    lidar: Lidar,
    radar: Radar,
}

impl Scene<'_, '_> {
    fn write(&self, progress: &(dyn Fn(u64) + Sync)) -> Result<Summary, SynthError> {
        let recording = record(self.world, &self.spec)?;
        let folder = self.options.out.join(&self.spec.name);
        if folder.exists() {
            fs::remove_dir_all(&folder).map_err(|source| SynthError::Write { path: folder.clone(), source })?;
        }
        make_folder(&folder)?;
        write_file(&folder.join(FILE_NAME), protocol_yaml(self.options, &self.spec, self.world.town))?;
        let agents = self.agents(&recording, &folder)?;
        let mut summary = self.write_frames(&recording, &agents, progress)?;
        summary.scenarios = 1;
        Ok(summary)
    }

    fn agents(&self, recording: &Recording, folder: &Path) -> Result<Vec<Agent>, SynthError> {
        let mut agents = Vec::new();
        for &vehicle in &recording.agents {
            // Agents are chosen among those that are present from the first frame to the last.
            let id = recording.frames[0].of(vehicle).map_or(0, |moving| moving.id);
            let mut positioning = Positioning::new(derive_seed(self.spec.seed, &[4, id as u64]));
            let moving = recording.frames.iter().filter_map(|frame| frame.of(vehicle));
            let fixes =
                moving.map(|moving| positioning.fix(&moving.motion.end, moving.speed_mps, self.options.period_s));
            agents.push(Agent { vehicle, id, fixes: fixes.collect(), folder: AgentFolder::create(folder, id)? });
        }
        Ok(agents)
    }

    /// Writes every frame of every agent. Each is made from the recording and a seed of its own, so the number of threads
    /// and their order change nothing.
    fn write_frames(
        &self,
        recording: &Recording,
        agents: &[Agent],
        progress: &(dyn Fn(u64) + Sync),
    ) -> Result<Summary, SynthError> {
        let jobs = recording.frames.len() * agents.len();
        let (next, done) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let total = Mutex::new(Ok(Summary::default()));
        let work = || {
            let mut bench = Bench::default();
            loop {
                let job = next.fetch_add(1, Ordering::Relaxed);
                if job >= jobs {
                    return;
                }
                let result = self.write_frame(recording, &agents[job % agents.len()], job / agents.len(), &mut bench);
                let mut total = total.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
                match (&mut *total, result) {
                    (Ok(total), Ok(summary)) => total.add(&summary),
                    (Ok(_), Err(error)) => *total = Err(error),
                    (Err(_), _) => return,
                }
                drop(total);
                progress(1000 * (done.fetch_add(1, Ordering::Relaxed) + 1) as u64 / jobs as u64);
            }
        };
        std::thread::scope(|scope| {
            for _ in 1..self.options.threads.min(jobs) {
                scope.spawn(work);
            }
            work();
        });
        total.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    fn write_frame(
        &self,
        recording: &Recording,
        agent: &Agent,
        number: usize,
        bench: &mut Bench,
    ) -> Result<Summary, SynthError> {
        let frame = &recording.frames[number];
        let Some(own) = frame.of(agent.vehicle) else { return Ok(Summary::default()) };
        let here = own.motion.end.position_m;
        let (mut bodies, seen) = vehicles_around(recording, frame, agent.vehicle);
        self.world.standing_near(here.x, here.y, SIGHT_M, &mut bodies);

        let noise = |sensor: u64| derive_seed(self.spec.seed, &[sensor, agent.id as u64, frame.tick]);
        let ground = self.world.ground();
        let sensor = lidar_motion(&own.motion);
        let sweep = bench.lidar.sweep(&sensor, ground, &bodies, self.options.weather, noise(5));
        agent.folder.write_lidar(frame.tick, None, &sweep)?;
        let (points, hits) = (sweep.points.len(), sweep.hits.to_vec());
        for &weather in &self.options.copies {
            let copy = bench.lidar.again(&sensor, &bodies, weather, noise(7 + weather as u64));
            agent.folder.write_lidar(frame.tick, weather.variant(), &copy)?;
        }
        let half_length_m = 0.5 * recording.vehicles[agent.vehicle].size_m[0];
        let returns = bench.radar.returns(&own.motion, half_length_m, LIDAR_MOUNT_M, STEP_S, ground, &bodies, noise(6));
        agent.folder.write_radar(frame.tick, returns)?;

        let is_hit = |(_, hits): &(Annotation<'_>, &u32)| **hits > 0;
        let mut annotations: Vec<Annotation<'_>> =
            seen.into_iter().zip(&hits).filter(is_hit).map(|(annotation, _)| annotation).collect();
        annotations.sort_unstable_by_key(|annotation| annotation.id);
        let summary = Summary { agent_frames: 1, points, annotations: annotations.len(), ..Summary::default() };
        let facts =
            FrameFacts { vehicle: own.motion.end, speed_mps: own.speed_mps, fix: agent.fixes[number], annotations };
        agent.folder.write_facts(frame.tick, &facts)?;
        Ok(summary)
    }
}

/// All vehicles but one's own that any sensor may see, as bodies and as what an annotation would say.
fn vehicles_around<'a>(
    recording: &'a Recording,
    frame: &'a RecordedFrame,
    own: usize,
) -> (Vec<Body<'a>>, Vec<Annotation<'a>>) {
    let here = frame.of(own).map_or_else(Default::default, |moving| moving.motion.end.position_m);
    let near = |motion: &super::cast::Sweep| (motion.end.position_m - here).xy().norm() < SIGHT_M + 10.0;
    let moving = frame.moving.iter().filter(|moving| moving.vehicle != own && near(&moving.motion));
    let moving = moving.map(|moving| {
        let vehicle: &Vehicle = &recording.vehicles[moving.vehicle];
        (vehicle, moving.motion, moving.id, moving.speed_mps)
    });
    let parked = recording
        .parked
        .iter()
        .map(|parked| (&parked.vehicle, super::cast::Sweep::still(parked.placement), parked.id, 0.0));
    let parked = parked.filter(|(_, motion, ..)| near(motion));
    moving
        .chain(parked)
        .map(|(vehicle, motion, id, speed_mps)| {
            let annotation = Annotation { id, vehicle, placement: motion.end, speed_mps };
            (Body { shape: &vehicle.shape, motion }, annotation)
        })
        .unzip()
}
