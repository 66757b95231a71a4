//! Sample builder: turns one tick of a scene into one sample.

use std::sync::Arc;

use dataset::class_set::ClassSet;
use dataset::frame::Frame;
use dataset::ground_truth::{GroundTruth, GroundTruthRule};
use perception::crop::Crop;
use perception::pillars::voxels::{Pillars, Voxeliser};
use protocol::{Box3d, NoPoseReason, Pose, PoseEstimate};
use rand::Rng;
use tch::Tensor;

use super::augment::{Augmentation, ViewAugment};
use super::moments::Moments;
use super::poses::{DrawnError, PoseOffset, SamplePoses, known, without_pose};
use super::scenes::{SceneSet, TickRef};
use crate::feature_store::MapSource;
use crate::{Error, Result};
use fusion::MapMetadata;
use fusion::model::CooperativeModel;
use fusion::points::merge_points;
use fusion::targets::{Labels, TargetAssigner};

/// Beyond any BEV grid, metres: the objects that count are selected after the augmentation.
const ANYWHERE_M: [f64; 2] = [-1e3, 1e3];

/// Views of a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SampleKind {
    /// One vehicle, and the objects that it has annotated itself.
    Single,
    /// One sweep: the points of all vehicles in the ego frame.
    Merged,
    /// The sweeps of all vehicles, each in its own frame.
    Cooperative,
}

/// Configuration of samples.
#[derive(Debug, Clone)]
pub struct SampleConfig {
    /// Views of a sample.
    pub kind: SampleKind,
    /// Random changes of the scene.
    pub augmentation: Augmentation,
    /// Probability that a neighbour is missing.
    pub drop_neighbour: f64,
    /// The poses by which maps are aligned.
    pub poses: SamplePoses,
    /// Time steps of the maps.
    pub moments: Moments,
    /// Largest number of vehicles of a sample, the ego included.
    pub max_agents: usize,
    /// Vehicles farther away do not take part, metres in the plane.
    pub comm_range_m: f64,
    /// Classes of the target objects.
    pub classes: ClassSet,
    /// True if objects that only neighbours have annotated are targets of a single vehicle too: the rule of the
    /// evaluation. The samples of such a training are of single vehicles, whatever their method shares; a dropped
    /// neighbour annotates nothing.
    pub merged_truth: bool,
}

impl SampleConfig {
    /// Samples for training.
    pub fn training(kind: SampleKind) -> Self {
        Self {
            kind,
            augmentation: Augmentation::default(),
            drop_neighbour: 0.1,
            poses: SamplePoses::default(),
            moments: Moments::default(),
            max_agents: 5,
            comm_range_m: GroundTruthRule::OPV2V.comm_range_m,
            classes: ClassSet::VEHICLES,
            merged_truth: false,
        }
    }
}

/// Form of the views of a sample, or of all samples of a batch.
#[derive(Debug)]
pub enum Views<P> {
    /// Pillars, to be encoded.
    Pillars(P),
    /// `[N, C, H, W]` maps of a frozen encoder.
    Maps(Tensor),
}

/// Views of one tick with their targets.
#[derive(Debug)]
pub struct Sample {
    /// Every view, the ego's newest first, then the neighbours' newest, then older ones.
    pub views: Views<Vec<Pillars>>,
    /// Metadata of every view, the ego's pose being the identity.
    pub facts: Vec<MapMetadata>,
    /// Error that was added to each view's pose.
    pub offsets: Vec<PoseOffset>,
    /// True boxes in the ego frame with their centre on the BEV grid.
    pub truth: GroundTruth,
    /// Targets of those boxes.
    pub labels: Labels,
}

/// Makes samples; one per loader thread, as it keeps the tables of the voxeliser.
#[derive(Debug, Clone)]
pub struct SampleBuilder {
    /// The scenes it draws from.
    pub(crate) scenes: Arc<SceneSet>,
    config: SampleConfig,
    /// Area of the network.
    lidar_range_m: [f64; 6],
    assigner: Arc<TargetAssigner>,
    crop: Crop,
    voxeliser: Voxeliser,
    /// Maps of a frozen encoder, in place of pillars.
    pub(crate) maps: Option<MapSource>,
}

/// One view on its way into a sample.
struct RawView {
    /// Index of its vehicle in the scenario.
    agent: usize,
    /// Index of its vehicle in the sample, the ego's being 0.
    place: usize,
    tick: usize,
    world_from_cav: Pose,
    /// Its pose without the added error.
    found: Pose,
    confidence: f64,
    age_secs: f64,
}

impl SampleBuilder {
    /// A builder over `scenes` of samples for a model.
    pub fn new(scenes: Arc<SceneSet>, config: SampleConfig, model: &CooperativeModel) -> Self {
        let detector = model.config();
        Self {
            scenes,
            config,
            lidar_range_m: detector.lidar_range_m,
            assigner: Arc::new(model.assigner()),
            crop: Crop::for_detector(detector),
            voxeliser: Voxeliser::for_detector(detector),
            maps: None,
        }
    }

    /// The sample of a tick, seen from a random vehicle.
    ///
    /// # Errors
    /// [`Error`] when a file is missing or malformed, or a vehicle has no pose.
    pub fn build(&mut self, tick: TickRef, rng: &mut impl Rng) -> Result<Sample> {
        let frames = self.scenes.annotations(tick);
        let present = (0..frames.len()).filter(|&agent| frames[agent].is_some());
        let present: Vec<usize> = present.collect();
        if present.is_empty() {
            let (tick, scenario) = (tick.tick, &self.scenes.scenario(tick).name);
            let problem = format!("no readable frame at tick {tick} of scenario {scenario}");
            return Err(Error::Data(problem));
        }
        let ego = present[rng.random_range(0..present.len())];
        let agents = self.choose_agents(tick, &frames, ego, rng)?;
        let single = self.config.kind == SampleKind::Single;
        let viewers = if single { &agents[..1] } else { &agents[..] };
        let merged = self.config.merged_truth;
        let annotators = if merged { &agents[..] } else { viewers };
        let entries = self.entries(tick, viewers, rng)?;
        let changes = self.config.augmentation.views(entries.len(), rng);
        let truth = self.truth(&frames, annotators, &changes[0]);
        let objects: Vec<Box3d> = truth.boxes().collect();
        let (mut facts, offsets) = metadata(&entries, &changes);
        // Exactly, not up to rounding: the warp recognises the identity.
        facts[0].ego_from_cav = Pose::IDENTITY;
        let views = match &mut self.maps {
            Some(maps) => {
                let scenario = self.scenes.scenario(tick);
                let maps = entries
                    .iter()
                    .map(|entry| maps.map(tick.scenario, scenario, entry.agent, entry.tick));
                Views::Maps(Tensor::f_cat(&maps.collect::<Result<Vec<_>>>()?, 0)?)
            }
            None => Views::Pillars(self.pillars(tick.scenario, &entries, &changes, &mut facts)?),
        };
        Ok(Sample {
            views,
            facts,
            offsets,
            labels: self.assigner.assign(&objects),
            truth,
        })
    }

    /// Views of a sample: the newest of every vehicle, the ego first, then older ones. Vehicles without a pose have no
    /// part; an ego without a pose is alone with its newest view.
    fn entries(&self, now: TickRef, agents: &[usize], rng: &mut impl Rng) -> Result<Vec<RawView>> {
        let ticks = &self.scenes.scenario(now).ticks;
        let gap = rng.random_range(1..=self.config.moments.gap.max(1));
        let error = self.config.poses.draw(rng)?;
        let (mut newest, mut older) = (Vec::new(), Vec::new());
        for (index, &agent) in agents.iter().enumerate() {
            let is_ego = index == 0;
            let last = match is_ego {
                true => now.tick,
                false => self.config.moments.draw_newest(ticks, now.tick, rng),
            };
            // Vehicles without a pose get no number: numbers have no gaps.
            let place = newest.len();
            let steps = self.config.moments.steps(ticks, now.tick, last, gap);
            for (step, tick) in steps.into_iter().enumerate() {
                let at = TickRef { tick, ..now };
                let [found, pose] = self.pose_at(at, agent, [index, agents.len()], &error)?;
                let Some((world_from_cav, confidence)) = known(&pose) else {
                    // Without its newest view a vehicle has no part; an older one may be missing.
                    match step {
                        0 => break,
                        _ => continue,
                    }
                };
                let age_nanos = ticks[now.tick].capture_nanos - ticks[tick].capture_nanos;
                let entry = RawView {
                    agent,
                    place,
                    tick,
                    world_from_cav,
                    found: found.world_from_cav().copied().unwrap_or(world_from_cav),
                    confidence: f64::from(confidence),
                    age_secs: age_nanos as f64 * 1e-9,
                };
                match step {
                    0 => newest.push(entry),
                    _ => older.push(entry),
                }
            }
            if is_ego && newest.is_empty() {
                return Ok(vec![RawView {
                    agent,
                    place,
                    tick: now.tick,
                    world_from_cav: Pose::IDENTITY,
                    found: Pose::IDENTITY,
                    confidence: 0.0,
                    age_secs: 0.0,
                }]);
            }
        }
        newest.append(&mut older);
        Ok(newest)
    }

    /// The found pose, and the same with the added error; `place` is the index of the agent and the number of agents.
    fn pose_at(
        &self,
        tick: TickRef,
        agent: usize,
        place: [usize; 2],
        error: &DrawnError,
    ) -> Result<[PoseEstimate; 2]> {
        let frames = self.scenes.annotations(tick);
        let Some(frame) = &frames[agent] else {
            return Ok([PoseEstimate::no_pose(NoPoseReason::NoSource, 0); 2]);
        };
        let scenario = &self.scenes.scenario(tick).name;
        let found = self.config.poses.found(scenario, frame)?;
        let moved = error.added(found, &frame.cav, frame.capture_nanos, place);
        Ok([found, moved])
    }

    /// The pillars of all views; of one view where all points are merged.
    fn pillars(
        &mut self,
        scenario: usize,
        entries: &[RawView],
        changes: &[ViewAugment],
        facts: &mut Vec<MapMetadata>,
    ) -> Result<Vec<Pillars>> {
        let mut clouds = Vec::with_capacity(entries.len());
        for (entry, change) in entries.iter().zip(changes) {
            let tick = entry.tick;
            let points = self
                .scenes
                .points(TickRef { scenario, tick }, entry.agent)?;
            // Hits on the vehicle that carries the LiDAR are removed before any rotation.
            let mut points = self.crop.without_own_body(&points);
            change.points(&mut points.xyzi);
            clouds.push(points);
        }
        if self.config.kind == SampleKind::Merged {
            let poses: Vec<Pose> = facts.iter().map(|facts| facts.ego_from_cav).collect();
            clouds = vec![merge_points(&clouds, &poses)];
            // One view is left: that of the ego.
            facts.truncate(1);
        }
        let pillars = clouds.iter();
        let pillars = pillars.map(|cloud| self.voxeliser.voxelise(&cloud.xyzi));
        Ok(pillars.collect())
    }

    /// The ego, then the neighbours in range that are not dropped.
    fn choose_agents(
        &self,
        tick: TickRef,
        frames: &[Option<Frame>],
        ego: usize,
        rng: &mut impl Rng,
    ) -> Result<Vec<usize>> {
        let mut agents = vec![ego];
        let Some(ego_frame) = &frames[ego] else {
            return Ok(agents);
        };
        let ego_pose = self.world_from_lidar(tick, ego_frame)?;
        for (agent, frame) in frames.iter().enumerate() {
            let Some(frame) = frame else { continue };
            let pose = self.world_from_lidar(tick, frame)?;
            let in_reach = ego_pose.planar_distance_m(&pose) <= self.config.comm_range_m;
            // Drawn for every vehicle, in reach or not: later draws do not depend on distances.
            let dropped = rng.random_bool(self.config.drop_neighbour);
            if agent != ego && in_reach && !dropped && agents.len() < self.config.max_agents {
                agents.push(agent);
            }
        }
        Ok(agents)
    }

    fn world_from_lidar(&self, tick: TickRef, frame: &Frame) -> Result<Pose> {
        let (pose, scenario) = (frame.world_from_lidar, self.scenes.scenario(tick));
        pose.ok_or_else(|| without_pose(&scenario.name, frame))
    }

    /// Objects annotated by `annotators`, the ego first, in the changed ego frame; those that count are on the BEV grid.
    fn truth(
        &self,
        frames: &[Option<Frame>],
        annotators: &[usize],
        ego_view: &ViewAugment,
    ) -> GroundTruth {
        let range = self.lidar_range_m;
        let rule = GroundTruthRule {
            x_m: ANYWHERE_M,
            y_m: ANYWHERE_M,
            z_m: [range[2], range[5]],
            comm_range_m: self.config.comm_range_m,
            min_corners: 8,
            classes: self.config.classes,
        };
        let views = annotators
            .iter()
            .filter_map(|&agent| frames[agent].as_ref());
        let mut truth = GroundTruth::of_tick(&views.collect::<Vec<_>>(), 0, &rule);
        for object in truth.objects.iter_mut().chain(&mut truth.ignored) {
            object.box3d = ego_view.box3d(&object.box3d);
        }
        truth.objects.retain(|object| {
            // By its centre: a box across the edge of the grid is still a target.
            let center = object.box3d.center_m;
            (0..2).all(|axis| (range[axis]..range[axis + 3]).contains(&center[axis]))
        });
        truth.area_m = [range[0], range[1], range[3], range[4]];
        truth
    }
}

/// Metadata of the views, and their pose errors; both after the changes of the scene.
fn metadata(entries: &[RawView], changes: &[ViewAugment]) -> (Vec<MapMetadata>, Vec<PoseOffset>) {
    let of_entries = entries.iter().zip(changes).map(|(entry, change)| {
        let reported = entries[0].world_from_cav.from_world(&entry.world_from_cav);
        let real = entries[0].found.from_world(&entry.found);
        let [ego_from_cav, real] = [reported, real].map(|pose| changes[0].pose(&pose, change));
        let facts = MapMetadata {
            agent: entry.place,
            ego_from_cav,
            confidence: entry.confidence,
            age_secs: entry.age_secs,
        };
        (facts, PoseOffset::between(&ego_from_cav, &real))
    });
    of_entries.unzip()
}
