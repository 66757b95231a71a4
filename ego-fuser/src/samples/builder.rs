//! One tick of a scene becomes one sample.

use std::sync::Arc;

use agent::crop::Crop;
use agent::model_config::DetectorConfig;
use agent::pillars::{Pillars, Voxeliser};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use protocol::{Box3d, PointCloud, Pose};
use rand::Rng;
use rand_distr::StandardNormal;
use sim_replay::frame::Frame;
use sim_replay::ground_truth::{self, GroundTruthRule};

use super::{Augmentation, SampleError, SceneSet, TickRef, ViewAugment};
use crate::fusion::ViewFacts;
use crate::targets::{Labels, TargetAssigner};

/// Beyond any lattice, metres: which objects count is decided after the augmentation.
const ANYWHERE_M: [f64; 2] = [-1e3, 1e3];

/// Which views a sample has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SampleKind {
    /// One vehicle, and the objects that it has annotated itself.
    Single,
    /// One sweep: the points of all vehicles in the ego frame.
    Merged,
    /// The sweeps of all vehicles, each in its own frame.
    Cooperative,
}

/// Normal noise on the poses of neighbours.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PoseNoise {
    /// Standard deviation of x and y, metres.
    pub position_m: f64,
    /// Standard deviation of yaw, radians.
    pub yaw_rad: f64,
}

/// How samples are made.
#[derive(Debug, Clone, PartialEq)]
pub struct SampleConfig {
    /// Which views.
    pub kind: SampleKind,
    /// Random changes of the scene.
    pub augmentation: Augmentation,
    /// Probability that a neighbour is missing.
    pub drop_neighbour: f64,
    /// Error of the poses that maps are aligned by.
    pub pose_noise: PoseNoise,
    /// Vehicles of a sample at most, the ego included.
    pub max_agents: usize,
    /// Vehicles farther away do not take part, metres in the plane.
    pub comm_range_m: f64,
    /// Whether a single vehicle is also to find what only its neighbours have annotated: the rule of the evaluation.
    pub merged_truth: bool,
}

impl SampleConfig {
    /// Samples for training.
    #[must_use]
    pub fn training(kind: SampleKind) -> Self {
        Self {
            kind,
            augmentation: Augmentation::default(),
            drop_neighbour: 0.1,
            pose_noise: PoseNoise::default(),
            max_agents: 5,
            comm_range_m: 70.0,
            merged_truth: false,
        }
    }
}

/// Views of one tick with what is to be found in them.
#[derive(Debug, Clone)]
pub struct Sample {
    /// Pillars of every view, the ego first.
    pub pillars: Vec<Pillars>,
    /// What is known of every view, the ego's pose being the identity.
    pub facts: Vec<ViewFacts>,
    /// True boxes in the ego frame with their centre on the lattice.
    pub objects: Vec<Box3d>,
    /// Targets of those boxes.
    pub labels: Labels,
}

/// Makes samples; one per loader thread, as it keeps the tables of the voxeliser.
#[derive(Debug, Clone)]
pub struct SampleBuilder {
    scenes: Arc<SceneSet>,
    config: SampleConfig,
    detector: DetectorConfig,
    assigner: Arc<TargetAssigner>,
    crop: Crop,
    voxeliser: Voxeliser,
}

impl SampleBuilder {
    /// A builder over `scenes`; `assigner` holds the anchors of `detector`.
    #[must_use]
    pub fn new(
        scenes: Arc<SceneSet>,
        config: SampleConfig,
        detector: DetectorConfig,
        assigner: Arc<TargetAssigner>,
    ) -> Self {
        let voxeliser = Voxeliser::for_detector(&detector);
        let crop = Crop::for_detector(&detector);
        Self { scenes, config, detector, assigner, crop, voxeliser }
    }

    /// The scenes it draws from.
    #[must_use]
    pub fn scenes(&self) -> &SceneSet {
        &self.scenes
    }

    /// The sample of a tick, seen from a random vehicle.
    ///
    /// # Errors
    /// [`SampleError`] when a file is missing or malformed, or a vehicle has no pose.
    pub fn build(&mut self, tick: TickRef, rng: &mut impl Rng) -> Result<Sample, SampleError> {
        let frames = self.scenes.annotations(tick)?;
        let ego = rng.random_range(0..frames.len());
        let agents = self.choose_agents(tick, &frames, ego, rng)?;
        let world_from_ego = self.world_from_lidar(tick, &frames[ego])?;
        let scene = self.config.augmentation.scene(rng);
        let ego_view = scene.view(rng);
        let single = self.config.kind == SampleKind::Single;
        let views = if single { &agents[..1] } else { &agents[..] };
        let annotators = if single && !self.config.merged_truth { &agents[..1] } else { &agents[..] };
        let mut clouds = Vec::with_capacity(views.len());
        let mut ego_from_cav = Vec::with_capacity(views.len());
        for &agent in views {
            let view = if agent == ego { ego_view } else { scene.view(rng) };
            // Hits on the vehicle that carries the LiDAR are cut out before anything turns.
            let mut points = self.crop.without_own_body(&self.scenes.points(tick, agent)?);
            view.points(&mut points.xyzi);
            clouds.push(points);
            let pose = if agent == ego {
                Pose::IDENTITY
            } else {
                let pose = world_from_ego.from_world(&self.world_from_lidar(tick, &frames[agent])?);
                self.disturb(&ego_view.pose(&pose, &view), rng)
            };
            ego_from_cav.push(pose);
        }
        if self.config.kind == SampleKind::Merged {
            clouds = vec![merge_points(&clouds, &ego_from_cav)];
            ego_from_cav.truncate(1);
        }
        let objects = self.objects(&frames, annotators, &ego_view);
        Ok(Sample {
            pillars: clouds.iter().map(|cloud| self.voxeliser.voxelise(&cloud.xyzi)).collect(),
            facts: ego_from_cav.into_iter().enumerate().map(|(agent, pose)| ViewFacts::fresh(agent, pose)).collect(),
            labels: self.assigner.assign(&objects),
            objects,
        })
    }

    /// The ego, then the neighbours in reach that are not dropped.
    fn choose_agents(
        &self,
        tick: TickRef,
        frames: &[Frame],
        ego: usize,
        rng: &mut impl Rng,
    ) -> Result<Vec<usize>, SampleError> {
        let mut agents = vec![ego];
        let [ego_x, ego_y, _] = self.world_from_lidar(tick, &frames[ego])?.translation_m;
        for (agent, frame) in frames.iter().enumerate() {
            let [x, y, _] = self.world_from_lidar(tick, frame)?.translation_m;
            let in_reach = (x - ego_x).hypot(y - ego_y) <= self.config.comm_range_m;
            let dropped = rng.random_bool(self.config.drop_neighbour);
            if agent != ego && in_reach && !dropped && agents.len() < self.config.max_agents {
                agents.push(agent);
            }
        }
        Ok(agents)
    }

    fn world_from_lidar(&self, tick: TickRef, frame: &Frame) -> Result<Pose, SampleError> {
        frame.world_from_lidar.ok_or_else(|| {
            let scenario = self.scenes.scenario(tick);
            SampleError::NoPose {
                scenario: scenario.name.clone(),
                stem: scenario.ticks[tick.tick].stem.clone(),
                cav: frame.cav.to_string(),
            }
        })
    }

    fn disturb(&self, pose: &Pose, rng: &mut impl Rng) -> Pose {
        let noise = self.config.pose_noise;
        if noise == PoseNoise::default() {
            return *pose;
        }
        let mut normal = |deviation: f64| deviation * rng.sample::<f64, _>(StandardNormal);
        let shift = Vector3::new(normal(noise.position_m), normal(noise.position_m), 0.0);
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), normal(noise.yaw_rad));
        let isometry = pose.isometry();
        let translation = Translation3::from(isometry.translation.vector + shift);
        Isometry3::from_parts(translation, turn * isometry.rotation).into()
    }

    /// What `annotators`, the ego first, have annotated, in the changed ego frame, on the lattice.
    fn objects(&self, frames: &[Frame], annotators: &[usize], ego_view: &ViewAugment) -> Vec<Box3d> {
        let range = self.detector.lidar_range_m;
        let rule = GroundTruthRule {
            x_m: ANYWHERE_M,
            y_m: ANYWHERE_M,
            z_m: [range[2], range[5]],
            comm_range_m: self.config.comm_range_m,
            min_corners: 8,
        };
        let views: Vec<&Frame> = annotators.iter().map(|&agent| &frames[agent]).collect();
        let on_lattice =
            |object: &Box3d| (0..2).all(|axis| (range[axis]..range[axis + 3]).contains(&object.center_m[axis]));
        let merged = ground_truth::merge(&views, 0, &rule);
        merged.iter().map(|(_, object)| ego_view.box3d(object)).filter(on_lattice).collect()
    }
}

/// The points of several sweeps in the frame of the ego.
#[must_use]
pub fn merge_points<'a>(clouds: impl IntoIterator<Item = &'a PointCloud>, ego_from_cav: &[Pose]) -> PointCloud {
    let mut merged = PointCloud::default();
    for (cloud, pose) in clouds.into_iter().zip(ego_from_cav) {
        if *pose == Pose::IDENTITY {
            merged.xyzi.extend(&cloud.xyzi);
            continue;
        }
        let ego_from_cav = pose.isometry().cast::<f32>();
        merged.xyzi.extend(cloud.xyzi.iter().map(|&[x, y, z, intensity]| {
            let moved = ego_from_cav * Point3::new(x, y, z);
            [moved.x, moved.y, moved.z, intensity]
        }));
    }
    merged
}
