//! Sensor simulation: the frames of all agents at one capture time.

use nalgebra::Vector3;
use protocol::{Camera, CavId, Handedness, PointCloud, Pose};

use super::camera::{self, CameraRig, GroundPaint, ImageSize, Surroundings};
use super::layout::{AgentFrame, BoxAnchor, Moment, SceneLayout, Simulated, SweepVariant};
use super::lidar::{LIDAR_MOUNT_M, Lidar};
use super::options::SynthOptions;
use super::positioning::Fix;
use super::radar::{Radar, velocity_to_red};
use super::raycast::{Course, Placement, RayBody};
use super::recording::{Moving, RecordedFrame, SceneRecording, SceneSpec};
use super::traffic::STEP_S;
use super::vehicle::{Vehicle, VehicleKind};
use super::world::World;
use dataset::frame::{Frame, Object, ObjectClass};
use support::random::derive_seed;

/// Length of a step of the simulation, nanoseconds.
pub(super) const STEP_NANOS: u64 = (STEP_S * 1e9) as u64;
/// Largest range of any sensor, metres.
const SIGHT_M: f64 = 152.0;

/// A vehicle that a sensor may see, in the form of an annotation.
#[derive(Debug, Clone, Copy)]
struct Annotation<'a> {
    id: i64,
    vehicle: &'a Vehicle,
    placement: Placement,
    speed_mps: f64,
}

/// One scenario to be written.
pub(super) struct SynthScene<'a, 't> {
    pub(super) options: &'a SynthOptions,
    pub(super) world: &'a World<'t>,
    pub(super) spec: SceneSpec,
}

/// One agent over the whole scene.
pub(super) struct SensingAgent {
    /// Index among the recording's vehicles.
    pub(super) vehicle: usize,
    pub(super) id: i64,
    pub(super) cav: CavId,
    /// One fix for each capture time.
    pub(super) fixes: Vec<Fix>,
}

/// End of the sweeps of a capture time, on the clock of the scene.
pub(super) fn capture_nanos(frame: &RecordedFrame) -> u64 {
    frame.tick * STEP_NANOS
}

/// The sensors and buffers of one thread.
pub(super) struct Bench<'w> {
    lidar: Lidar,
    radar: Radar,
    cameras: Option<(CameraRig, GroundPaint<'w>)>,
}

impl<'w> Bench<'w> {
    /// Sensors in a world, with cameras of this image size.
    pub(super) fn new(world: &'w World<'w>, cameras: Option<ImageSize>) -> Self {
        let cameras = cameras.map(|size| (CameraRig::new(size), GroundPaint::new(world)));
        Self {
            lidar: Lidar::default(),
            radar: Radar::default(),
            cameras,
        }
    }
}

impl SynthScene<'_, '_> {
    /// The frames of all agents at a capture time.
    pub(super) fn moment(
        &self,
        recording: &SceneRecording,
        agents: &[SensingAgent],
        index: usize,
        bench: &mut Bench<'_>,
    ) -> Moment {
        let frames = agents.iter().enumerate().filter_map(|(place, agent)| {
            let own = recording.frames[index].of(agent.vehicle)?;
            Some(self.agent_frame(recording, (place, agent), (index, own), bench))
        });
        Moment {
            index,
            frames: frames.collect(),
        }
    }

    fn agent_frame(
        &self,
        recording: &SceneRecording,
        (place, agent): (usize, &SensingAgent),
        (index, own): (usize, &Moving),
        bench: &mut Bench<'_>,
    ) -> AgentFrame {
        let moment = &recording.frames[index];
        // Vehicles come first in the list: hits and paints are matched to annotations by place.
        let (mut bodies, seen) = vehicles_around(recording, moment, own);
        let here = own.motion.end.position_m;
        bodies.extend(self.world.standing_near([here.x, here.y], SIGHT_M));

        // One stream per sensor, agent and tick, so that no draw depends on other sensors or on threads.
        let noise =
            |sensor: u64| derive_seed(self.spec.seed, &[sensor, agent.id as u64, moment.tick]);
        let (points, variants, hits) = self.lidar_sweeps(&own.motion, &bodies, bench, &noise);
        let half_length_m = 0.5 * recording.vehicles[agent.vehicle].size_m[0];
        // No other layout can hold radar.
        let has_radar = self.options.layout == SceneLayout::Opv2v;
        let radar = has_radar
            .then(|| self.radar_points(&own.motion, half_length_m, &bodies, bench, noise(6)));

        // 7, 8 and 9 are those of the sweeps in other weather.
        let cameras = self.images(&own.motion.end, &bodies, &seen, bench, noise(10));

        // Only vehicles with a point in the plain sweep are annotated.
        let mut hits = hits.iter();
        let mut annotations = seen;
        annotations.retain(|_| hits.next().is_some_and(|hits| *hits > 0));
        annotations.sort_unstable_by_key(|annotation| annotation.id);
        let fix = agent.fixes[index];
        let frame = Frame {
            points,
            radar,
            cameras,
            world_from_lidar: Some(own.motion.end.mounted(LIDAR_MOUNT_M).isometry().into()),
            world_from_vehicle: Some(own.motion.end.isometry().into()),
            gnss_world_from_vehicle: Some(fix.estimate.isometry().into()),
            speed_mps: Some(own.speed_mps),
            objects: annotations.iter().map(object).collect(),
            ..Frame::empty(agent.cav.clone(), capture_nanos(moment), Handedness::Right)
        };
        let anchors = annotations.iter().map(anchor).collect();
        AgentFrame {
            agent: place,
            frame,
            variants,
            simulated: Some(Simulated { fix, anchors }),
        }
    }

    fn lidar_sweeps(
        &self,
        vehicle: &Course,
        bodies: &[RayBody<'_>],
        bench: &mut Bench<'_>,
        noise: &dyn Fn(u64) -> u64,
    ) -> (PointCloud, Vec<SweepVariant>, Vec<u32>) {
        let sensor = vehicle.mounted(LIDAR_MOUNT_M);
        let (lidar, weather) = (&mut bench.lidar, self.options.weather);
        lidar.cast(&sensor, &*self.world.ground, bodies);
        let sweep = lidar.sweep(&sensor, bodies, weather, noise(5));
        let (points, hits) = (sweep.points.clone(), sweep.hits.clone());
        let copies = self.options.copies.iter();
        let named = copies.filter_map(|weather| Some((*weather, weather.variant()?)));
        let variants = named.map(|(weather, name)| {
            let seed = noise(7 + weather as u64);
            let copy = lidar.sweep(&sensor, bodies, weather, seed);
            SweepVariant {
                name: name.to_owned(),
                points: copy.points.clone(),
                labels: copy.labels.clone(),
            }
        });
        (PointCloud { xyzi: points }, variants.collect(), hits)
    }

    /// The images of the cameras; `seen` are the annotations of the first bodies.
    fn images(
        &self,
        vehicle: &Placement,
        bodies: &[RayBody<'_>],
        seen: &[Annotation<'_>],
        bench: &mut Bench<'_>,
        noise: u64,
    ) -> Vec<(u8, Camera)> {
        let Some((rig, ground_paint)) = &mut bench.cameras else {
            return Vec::new();
        };
        let standing = bodies.iter().skip(seen.len()).map(|body| {
            // Standing objects have no id. Their position serves as one and is the same in every frame.
            let place = body.motion.end.position_m;
            let [x, y] = [place.x, place.y].map(f64::to_bits);
            camera::of_shape(body.shape, x ^ y.rotate_left(17))
        });
        let vehicles = seen
            .iter()
            .map(|annotation| camera::of_vehicle(annotation.id));
        let paints: Vec<_> = vehicles.chain(standing).collect();
        let surroundings = Surroundings {
            ground: &*self.world.ground,
            bodies,
            paints: &paints,
            weather: self.options.weather,
        };
        rig.images(vehicle, &surroundings, ground_paint, noise)
    }

    /// The radar's points; the fourth value is the radial velocity as stored in the red channel.
    fn radar_points(
        &self,
        vehicle: &Course,
        half_length_m: f64,
        bodies: &[RayBody<'_>],
        bench: &mut Bench<'_>,
        noise: u64,
    ) -> PointCloud {
        let (radar, ground) = (&mut bench.radar, &*self.world.ground);
        let returns = radar.returns(vehicle, half_length_m, ground, bodies, noise);
        let returns = returns.iter();
        let xyzi = returns.map(|&[x, y, z, velocity]| [x, y, z, velocity_to_red(velocity)]);
        let xyzi = xyzi.collect();
        PointCloud { xyzi }
    }
}

/// The origin of a vehicle, and the offset from there to the centre of its box.
fn anchor(annotation: &Annotation<'_>) -> BoxAnchor {
    let half_m = annotation.vehicle.size_m[2] / 2.0;
    let up = annotation.placement.rotation() * Vector3::new(0.0, 0.0, half_m);
    BoxAnchor {
        location_m: annotation.placement.position_m.into(),
        center_offset_m: up.into(),
    }
}

fn object(annotation: &Annotation<'_>) -> Object {
    let anchor = anchor(annotation);
    let pose: Pose = annotation.placement.isometry().into();
    let translation_m =
        std::array::from_fn(|axis| anchor.location_m[axis] + anchor.center_offset_m[axis]);
    Object {
        id: annotation.id,
        class: class(annotation.vehicle.kind),
        world_from_object: Pose {
            translation_m,
            ..pose
        },
        size_m: annotation.vehicle.size_m,
        speed_mps: Some(annotation.speed_mps),
    }
}

fn class(kind: VehicleKind) -> ObjectClass {
    match kind {
        VehicleKind::Sedan | VehicleKind::Hatchback | VehicleKind::Suv | VehicleKind::Pickup => {
            ObjectClass::Car
        }
        VehicleKind::Van => ObjectClass::Van,
        VehicleKind::Truck => ObjectClass::Truck,
        VehicleKind::Bus => ObjectClass::Bus,
    }
}

/// All vehicles within sensor range except the sensor's own, as bodies and as annotations.
fn vehicles_around<'a>(
    recording: &'a SceneRecording,
    frame: &'a RecordedFrame,
    own: &Moving,
) -> (Vec<RayBody<'a>>, Vec<Annotation<'a>>) {
    let here = own.motion.end.position_m;
    let moving = frame.moving.iter();
    let moving = moving.filter(|moving| moving.vehicle != own.vehicle);
    let moving = moving.map(|moving| {
        let vehicle: &Vehicle = &recording.vehicles[moving.vehicle];
        (vehicle, moving.motion, moving.id, moving.speed_mps)
    });
    let parked = recording.parked.iter().map(|parked| {
        let motion = Course::still(parked.placement);
        (&parked.vehicle, motion, parked.id, 0.0)
    });
    // Positions are centres: the margin covers half of the longest vehicle.
    let near = moving
        .chain(parked)
        .filter(|(_, motion, ..)| (motion.end.position_m - here).xy().norm() < SIGHT_M + 10.0);
    let all = near.map(|(vehicle, motion, id, speed_mps)| {
        let annotation = Annotation {
            id,
            vehicle,
            placement: motion.end,
            speed_mps,
        };
        let shape = &vehicle.shape;
        (RayBody { shape, motion }, annotation)
    });
    all.unzip()
}
