//! Sensor simulation: the frames of all agents at one capture time.

use nalgebra::Vector3;
use protocol::{Camera, Handedness, PointCloud, Pose};

use super::camera::{self, CameraRig, GroundPaint, ImageSize, Surroundings};
use super::layout::{AgentFrame, BoxAnchor, Moment, SceneLayout, Simulated, SweepVariant};
use super::lidar::{LIDAR_MOUNT_M, Lidar, lidar_motion};
use super::radar::{Radar, velocity_to_red};
use super::raycast::{Body, Placement, Sweep};
use super::recording::{Moving, RecordedFrame, Recording};
use super::scenes::{Agent, Scene, capture_nanos};
use super::traffic::STEP_S;
use super::vehicle::{Vehicle, VehicleKind};
use super::world::World;
use dataset::frame::{Frame, Object, ObjectClass};
use support::random::derive_seed;

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

/// Points of the LiDAR, copies of them in other weather, and the number of points on each body.
struct LidarSweeps {
    points: PointCloud,
    variants: Vec<SweepVariant>,
    hits: Vec<u32>,
}

impl Scene<'_, '_> {
    /// The frames of all agents at a capture time.
    pub(super) fn moment(
        &self,
        recording: &Recording,
        agents: &[Agent],
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
        recording: &Recording,
        (place, agent): (usize, &Agent),
        (index, own): (usize, &Moving),
        bench: &mut Bench<'_>,
    ) -> AgentFrame {
        let moment = &recording.frames[index];
        let (mut bodies, seen) = vehicles_around(recording, moment, agent.vehicle);
        let here = own.motion.end.position_m;
        self.world
            .standing_near(here.x, here.y, SIGHT_M, &mut bodies);

        let noise =
            |sensor: u64| derive_seed(self.spec.seed, &[sensor, agent.id as u64, moment.tick]);
        let LidarSweeps {
            points,
            variants,
            hits,
        } = self.lidar_sweeps(&own.motion, &bodies, bench, &noise);
        let half_length_m = 0.5 * recording.vehicles[agent.vehicle].size_m[0];
        // No other layout can hold radar.
        let has_radar = self.options.layout == SceneLayout::Opv2v;
        let radar = has_radar
            .then(|| self.radar_points(&own.motion, half_length_m, &bodies, bench, noise(6)));

        let cameras = self.images(&own.motion.end, &bodies, &seen, bench, noise(8));

        let is_hit = |(_, hits): &(Annotation<'_>, &u32)| **hits > 0;
        let mut annotations: Vec<Annotation<'_>> = seen
            .into_iter()
            .zip(&hits)
            .filter(is_hit)
            .map(|(annotation, _)| annotation)
            .collect();
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
        vehicle: &Sweep,
        bodies: &[Body<'_>],
        bench: &mut Bench<'_>,
        noise: &dyn Fn(u64) -> u64,
    ) -> LidarSweeps {
        let sensor = lidar_motion(vehicle);
        let sweep = bench.lidar.sweep(
            &sensor,
            self.world.ground(),
            bodies,
            self.options.weather,
            noise(5),
        );
        let (points, hits) = (
            PointCloud {
                xyzi: sweep.points.to_vec(),
            },
            sweep.hits.to_vec(),
        );
        let named = self
            .options
            .copies
            .iter()
            .filter_map(|weather| Some((*weather, weather.variant()?)));
        let variants = named.map(|(weather, name)| {
            let copy = bench
                .lidar
                .again(&sensor, bodies, weather, noise(7 + weather as u64));
            SweepVariant {
                name: name.to_owned(),
                points: copy.points.to_vec(),
                labels: copy.labels.to_vec(),
            }
        });
        LidarSweeps {
            points,
            variants: variants.collect(),
            hits,
        }
    }

    /// The images of the cameras; `seen` are the annotations of the first bodies.
    fn images(
        &self,
        vehicle: &Placement,
        bodies: &[Body<'_>],
        seen: &[Annotation<'_>],
        bench: &mut Bench<'_>,
        noise: u64,
    ) -> Vec<(u8, Camera)> {
        let Some((rig, ground_paint)) = &mut bench.cameras else {
            return Vec::new();
        };
        let standing = bodies.iter().skip(seen.len()).map(|body| {
            let [x, y] =
                [body.motion.end.position_m.x, body.motion.end.position_m.y].map(f64::to_bits);
            camera::of_shape(body.shape, x ^ y.rotate_left(17))
        });
        let paints: Vec<_> = seen
            .iter()
            .map(|annotation| camera::of_vehicle(annotation.id))
            .chain(standing)
            .collect();
        let (ground, weather) = (self.world.ground(), self.options.weather);
        rig.images(
            vehicle,
            &Surroundings {
                ground,
                bodies,
                paints: &paints,
                weather,
            },
            ground_paint,
            noise,
        )
    }

    /// The radar's points; the fourth value is the radial velocity as stored in the red channel.
    fn radar_points(
        &self,
        vehicle: &Sweep,
        half_length_m: f64,
        bodies: &[Body<'_>],
        bench: &mut Bench<'_>,
        noise: u64,
    ) -> PointCloud {
        let ground = self.world.ground();
        let returns = bench.radar.returns(
            vehicle,
            half_length_m,
            LIDAR_MOUNT_M,
            STEP_S,
            ground,
            bodies,
            noise,
        );
        let red = |&[x, y, z, velocity]: &[f32; 4]| [x, y, z, velocity_to_red(velocity)];
        PointCloud {
            xyzi: returns.iter().map(red).collect(),
        }
    }
}

/// The origin of a vehicle, and the offset from there to the centre of its box.
fn anchor(annotation: &Annotation<'_>) -> BoxAnchor {
    let up = annotation.placement.rotation()
        * Vector3::new(0.0, 0.0, annotation.vehicle.size_m[2] / 2.0);
    BoxAnchor {
        location_m: annotation.placement.position_m.into(),
        center_offset_m: up.into(),
    }
}

fn object(annotation: &Annotation<'_>) -> Object {
    let BoxAnchor {
        location_m,
        center_offset_m,
    } = anchor(annotation);
    let pose: Pose = annotation.placement.isometry().into();
    let translation_m = std::array::from_fn(|axis| location_m[axis] + center_offset_m[axis]);
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
    recording: &'a Recording,
    frame: &'a RecordedFrame,
    own: usize,
) -> (Vec<Body<'a>>, Vec<Annotation<'a>>) {
    let here = frame
        .of(own)
        .map_or_else(Default::default, |moving| moving.motion.end.position_m);
    let near = |motion: &Sweep| (motion.end.position_m - here).xy().norm() < SIGHT_M + 10.0;
    let moving = frame
        .moving
        .iter()
        .filter(|moving| moving.vehicle != own && near(&moving.motion));
    let moving = moving.map(|moving| {
        let vehicle: &Vehicle = &recording.vehicles[moving.vehicle];
        (vehicle, moving.motion, moving.id, moving.speed_mps)
    });
    let parked = recording.parked.iter().map(|parked| {
        (
            &parked.vehicle,
            Sweep::still(parked.placement),
            parked.id,
            0.0,
        )
    });
    let parked = parked.filter(|(_, motion, ..)| near(motion));
    moving
        .chain(parked)
        .map(|(vehicle, motion, id, speed_mps)| {
            let annotation = Annotation {
                id,
                vehicle,
                placement: motion.end,
                speed_mps,
            };
            (
                Body {
                    shape: &vehicle.shape,
                    motion,
                },
                annotation,
            )
        })
        .unzip()
}
