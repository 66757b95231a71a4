//! From options to folders: scenes one after another, the frames of each on several threads.

use std::collections::BTreeMap;
use std::fs;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use nalgebra::Vector3;
use protocol::{CavId, Handedness, PointCloud, Pose};

use super::cast::{Body, Placement};
use super::error::SynthError;
use super::layout::{
    AgentFrame, BoxAnchor, Moment, Omissions, SceneAgent, SceneHeader, SceneLayout, SceneWriter, Simulated,
    SweepVariant, Unfinished, make_folder,
};
use super::lidar::{LIDAR_MOUNT_M, Lidar, lidar_motion};
use super::options::{Subset, SynthOptions};
use super::positioning::{Fix, Positioning};
use super::protocol_file::protocol_yaml;
use super::radar::{Radar, velocity_to_red};
use super::recording::{RecordedFrame, Recording, SceneSpec, record};
use super::traffic::STEP_S;
use super::vehicle::{Vehicle, VehicleKind};
use super::world::World;
use crate::frame::{Frame, Object, ObjectClass};
use crate::random::derive_seed;
use crate::town::{self, Finding, Town, TownSource};

/// The farthest that any sensor looks, metres.
const SIGHT_M: f64 = 152.0;
/// Length of a step of the simulation, nanoseconds.
const STEP_NANOS: u64 = (STEP_S * 1e9) as u64;

/// What was generated.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Summary {
    /// Layout of the files.
    pub layout: SceneLayout,
    /// Scenarios.
    pub scenarios: usize,
    /// Frames of all agents together.
    pub agent_frames: usize,
    /// LiDAR points of all agent-frames.
    pub points: usize,
    /// Annotated vehicles of all agent-frames.
    pub annotations: usize,
    /// What the layout has no place for, and how often it was left out.
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

/// Generates everything that `options` ask for. `progress` hears how many scenarios of how many are done, in thousandths
/// of one, from any thread.
///
/// # Errors
/// [`SynthError`] where an option makes no sense, the town cannot be built or a file cannot be written.
pub fn generate(options: &SynthOptions, progress: &(dyn Fn(u64) + Sync)) -> Result<Summary, SynthError> {
    options.validate()?;
    check_folder(&options.out, options.force)?;
    let unfinished = Unfinished::mark(&options.out)?;
    let mut writer = options.layout.writer(&options.out);
    let omitted = Omissions::default();
    let mut total = Summary { layout: options.layout, ..Summary::default() };
    for (place, source) in sources(options).iter().enumerate() {
        let town = town::build(source, options.town_seed)?;
        total.findings.extend(town.findings.iter().cloned());
        let world = World::new(&town);
        let places = sources(options).len();
        for number in (place..options.scenarios()).step_by(places) {
            let before = total.scenarios as u64 * 1000;
            let spec = spec(options, &town, number);
            let scene = Scene { options, world: &world, spec };
            let progress = |thousandths| progress(before + thousandths);
            total.add(&scene.write(writer.as_mut(), &omitted, &progress)?);
        }
    }
    writer.finish()?;
    unfinished.clear()?;
    total.omitted = omitted.into_counts();
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

/// Makes the folder of the output, or refuses one that holds something.
pub(super) fn check_folder(out: &std::path::Path, force: bool) -> Result<(), SynthError> {
    make_folder(out)?;
    let entries = fs::read_dir(out);
    let mut entries = entries.map_err(|source| SynthError::Write { path: out.to_owned(), source })?;
    if entries.next().is_some() && !force {
        return Err(SynthError::NotEmpty(out.to_owned()));
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
    cav: CavId,
    fixes: Vec<Fix>,
}

/// A vehicle that a sensor may see, as an annotation has it.
#[derive(Debug, Clone, Copy)]
struct Annotation<'a> {
    id: i64,
    vehicle: &'a Vehicle,
    placement: Placement,
    speed_mps: f64,
}

/// The sensors and buffers of one thread.
#[derive(Default)]
struct Bench {
    lidar: Lidar,
    radar: Radar,
}

impl Scene<'_, '_> {
    fn write(
        &self,
        writer: &mut dyn SceneWriter,
        omitted: &Omissions,
        progress: &(dyn Fn(u64) + Sync),
    ) -> Result<Summary, SynthError> {
        let recording = record(self.world, &self.spec)?;
        let agents = self.agents(&recording)?;
        writer.begin(&self.header(&recording, &agents))?;
        let mut summary = self.write_moments(&recording, &agents, (writer, omitted), progress)?;
        writer.end()?;
        summary.scenarios = 1;
        Ok(summary)
    }

    fn header(&self, recording: &Recording, agents: &[Agent]) -> SceneHeader {
        SceneHeader {
            name: self.spec.name.clone(),
            agents: agents.iter().map(|agent| SceneAgent { id: agent.cav.clone(), is_roadside: false }).collect(),
            capture_nanos: recording.frames.iter().map(capture_nanos).collect(),
            tick_nanos: STEP_NANOS,
            origin: protocol_yaml(self.options, &self.spec, self.world.town),
        }
    }

    fn agents(&self, recording: &Recording) -> Result<Vec<Agent>, SynthError> {
        let mut agents = Vec::new();
        for &vehicle in &recording.agents {
            // Agents are chosen among those that are present from the first frame to the last.
            let id = recording.frames[0].of(vehicle).map_or(0, |moving| moving.id);
            let mut positioning = Positioning::new(derive_seed(self.spec.seed, &[4, id as u64]));
            let moving = recording.frames.iter().filter_map(|frame| frame.of(vehicle));
            let fixes =
                moving.map(|moving| positioning.fix(&moving.motion.end, moving.speed_mps, self.options.period_s));
            let cav = CavId::new(&id.to_string()).map_err(|error| SynthError::Layout {
                layout: self.options.layout.name(),
                reason: error.to_string(),
            })?;
            agents.push(Agent { vehicle, id, cav, fixes: fixes.collect() });
        }
        Ok(agents)
    }

    /// Writes every moment. Each frame is made from the recording and a seed of its own, so the number of threads and their
    /// order change nothing.
    fn write_moments(
        &self,
        recording: &Recording,
        agents: &[Agent],
        (writer, omitted): (&dyn SceneWriter, &Omissions),
        progress: &(dyn Fn(u64) + Sync),
    ) -> Result<Summary, SynthError> {
        let moments = recording.frames.len();
        let (next, done) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let total = Mutex::new(Ok(Summary::default()));
        let work = || {
            let mut bench = Bench::default();
            loop {
                let index = next.fetch_add(1, Ordering::Relaxed);
                if index >= moments {
                    return;
                }
                let moment = self.moment(recording, agents, index, &mut bench);
                let result = writer.write(&moment, omitted).map(|()| counts(&moment));
                let mut total = total.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
                match (&mut *total, result) {
                    (Ok(total), Ok(summary)) => total.add(&summary),
                    (Ok(_), Err(error)) => *total = Err(error),
                    (Err(_), _) => return,
                }
                drop(total);
                progress(1000 * (done.fetch_add(1, Ordering::Relaxed) + 1) as u64 / moments as u64);
            }
        };
        std::thread::scope(|scope| {
            for _ in 1..self.options.threads.min(moments) {
                scope.spawn(work);
            }
            work();
        });
        total.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    fn moment(&self, recording: &Recording, agents: &[Agent], index: usize, bench: &mut Bench) -> Moment {
        let frames = agents.iter().enumerate().filter_map(|(place, agent)| {
            let (frame, variants, simulated) = self.frame(recording, agent, index, bench)?;
            Some(AgentFrame { agent: place, frame, variants, simulated: Some(simulated) })
        });
        Moment { index, frames: frames.collect() }
    }

    fn frame(
        &self,
        recording: &Recording,
        agent: &Agent,
        index: usize,
        bench: &mut Bench,
    ) -> Option<(Frame, Vec<SweepVariant>, Simulated)> {
        let moment = &recording.frames[index];
        let own = moment.of(agent.vehicle)?;
        let here = own.motion.end.position_m;
        let (mut bodies, seen) = vehicles_around(recording, moment, agent.vehicle);
        self.world.standing_near(here.x, here.y, SIGHT_M, &mut bodies);

        let noise = |sensor: u64| derive_seed(self.spec.seed, &[sensor, agent.id as u64, moment.tick]);
        let ground = self.world.ground();
        let sensor = lidar_motion(&own.motion);
        let sweep = bench.lidar.sweep(&sensor, ground, &bodies, self.options.weather, noise(5));
        let (points, hits) = (sweep.points.to_vec(), sweep.hits.to_vec());
        let mut variants = Vec::with_capacity(self.options.copies.len());
        for (&weather, name) in self.options.copies.iter().filter_map(|weather| Some((weather, weather.variant()?))) {
            let copy = bench.lidar.again(&sensor, &bodies, weather, noise(7 + weather as u64));
            let (points, labels) = (copy.points.to_vec(), copy.labels.to_vec());
            variants.push(SweepVariant { name: name.to_owned(), points, labels });
        }
        let half_length_m = 0.5 * recording.vehicles[agent.vehicle].size_m[0];
        let radar = (self.options.layout == SceneLayout::Opv2v).then(|| {
            let mount = LIDAR_MOUNT_M;
            let returns = bench.radar.returns(&own.motion, half_length_m, mount, STEP_S, ground, &bodies, noise(6));
            let red = |&[x, y, z, velocity]: &[f32; 4]| [x, y, z, velocity_to_red(velocity)];
            PointCloud { xyzi: returns.iter().map(red).collect() }
        });

        let is_hit = |(_, hits): &(Annotation<'_>, &u32)| **hits > 0;
        let mut annotations: Vec<Annotation<'_>> =
            seen.into_iter().zip(&hits).filter(is_hit).map(|(annotation, _)| annotation).collect();
        annotations.sort_unstable_by_key(|annotation| annotation.id);
        let fix = agent.fixes[index];
        let frame = Frame {
            points: PointCloud { xyzi: points },
            radar,
            world_from_lidar: Some(own.motion.end.mounted(LIDAR_MOUNT_M).isometry().into()),
            world_from_vehicle: Some(own.motion.end.isometry().into()),
            gnss_world_from_vehicle: Some(fix.estimate.isometry().into()),
            speed_mps: Some(own.speed_mps),
            objects: annotations.iter().map(object).collect(),
            ..Frame::empty(agent.cav.clone(), capture_nanos(moment), Handedness::Right)
        };
        let anchors = annotations.iter().map(anchor).collect();
        Some((frame, variants, Simulated { fix, anchors }))
    }
}

fn capture_nanos(frame: &RecordedFrame) -> u64 {
    frame.tick * STEP_NANOS
}

fn counts(moment: &Moment) -> Summary {
    let sum = |count: fn(&Frame) -> usize| moment.frames.iter().map(|agent| count(&agent.frame)).sum();
    Summary {
        agent_frames: moment.frames.len(),
        points: sum(|frame| frame.points.len()),
        annotations: sum(|frame| frame.objects.len()),
        ..Summary::default()
    }
}

/// The origin of a vehicle, and the way from there to the centre of its box.
fn anchor(annotation: &Annotation<'_>) -> BoxAnchor {
    let up = annotation.placement.rotation() * Vector3::new(0.0, 0.0, annotation.vehicle.size_m[2] / 2.0);
    BoxAnchor { location_m: annotation.placement.position_m.into(), center_offset_m: up.into() }
}

fn object(annotation: &Annotation<'_>) -> Object {
    let BoxAnchor { location_m, center_offset_m } = anchor(annotation);
    let pose: Pose = annotation.placement.isometry().into();
    let translation_m = std::array::from_fn(|axis| location_m[axis] + center_offset_m[axis]);
    Object {
        id: annotation.id,
        class: class(annotation.vehicle.kind),
        world_from_object: Pose { translation_m, ..pose },
        size_m: annotation.vehicle.size_m,
        speed_mps: Some(annotation.speed_mps),
    }
}

fn class(kind: VehicleKind) -> ObjectClass {
    match kind {
        VehicleKind::Sedan | VehicleKind::Hatchback | VehicleKind::Suv | VehicleKind::Pickup => ObjectClass::Car,
        VehicleKind::Van => ObjectClass::Van,
        VehicleKind::Truck => ObjectClass::Truck,
        VehicleKind::Bus => ObjectClass::Bus,
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
