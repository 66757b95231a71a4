//! Publishers of a replayed scene: each vehicle's sensors, and the ground truth.

use protocol::message::{AgentTruth, Payload, TrueObject};
use protocol::{CavId, Lidar, Radar, Stream, Topic, TopicCount, Truth};

use bus::{Bus, BusError, Publisher, PublisherOptions};
use dataset::LoadOptions;
use dataset::frame::Frame;
use dataset::ground_truth::annotations;

/// Queue length of a lossless topic.
const LOSSLESS_PLACES: usize = 16;
/// Points of a preview: it must fit into one batch of zenoh.
const PREVIEW_POINTS: usize = 4_000;

/// The sensors of one vehicle.
struct VehiclePublishers {
    lidar: Publisher,
    gnss: Publisher,
    imu: Publisher,
    radar: Option<Publisher>,
    /// By number.
    cameras: Vec<(u8, Publisher)>,
    preview: Publisher,
}

/// All publishers of a replay.
pub(super) struct SensorPublisher {
    sensors: Vec<VehiclePublishers>,
    truth: Publisher,
    sent: Vec<TopicCount>,
}

impl SensorPublisher {
    /// Publishers for `agents` and what is loaded of them, `cameras` among it. With `is_paced` the sender waits instead of replacing a sweep.
    pub(super) fn open(
        bus: &Bus,
        agents: &[CavId],
        load: &LoadOptions,
        cameras: &[u8],
        is_paced: bool,
    ) -> Result<Self, BusError> {
        let [sweep, pose, radar, camera] = [
            PublisherOptions::SENSOR,
            PublisherOptions::POSE,
            PublisherOptions::RADAR,
            PublisherOptions::CAMERA,
        ]
        .map(|options| match is_paced {
            true => options.lossless(LOSSLESS_PLACES),
            false => options,
        });
        let sensors = agents.iter().map(|cav| {
            Ok(VehiclePublishers {
                // Small messages have other priorities than sweeps: they do not wait for one on its way to a slow receiver.
                lidar: bus.publisher(Topic::stream(cav, Stream::Lidar), sweep)?,
                gnss: bus.publisher(Topic::stream(cav, Stream::Gnss), pose)?,
                imu: bus.publisher(Topic::stream(cav, Stream::Imu), pose)?,
                radar: load
                    .radar
                    .then(|| bus.publisher(Topic::stream(cav, Stream::Radar), radar))
                    .transpose()?,
                cameras: cameras
                    .iter()
                    .filter(|_| load.cameras)
                    .map(|&number| {
                        let topic = Topic::stream(cav, Stream::Camera(number));
                        Ok((number, bus.publisher(topic, camera)?))
                    })
                    .collect::<Result<_, BusError>>()?,
                // Never paced: a slow viewer must not hold back the replay.
                preview: bus.publisher(
                    Topic::stream(cav, Stream::Preview),
                    PublisherOptions::PREVIEW,
                )?,
            })
        });
        // Waits for a place even in a replay that is not paced: a tick without truth cannot be scored.
        let waiting = PublisherOptions::DETECTIONS.waiting(LOSSLESS_PLACES);
        let truth = bus.publisher(Topic::Truth, waiting)?;
        Ok(Self {
            sensors: sensors.collect::<Result<_, _>>()?,
            truth,
            sent: Vec::new(),
        })
    }

    /// Submits the data of one vehicle captured at `capture_nanos`.
    pub(super) fn submit(&mut self, agent: usize, capture_nanos: u64, frame: Frame) {
        let Some(sensors) = self.sensors.get(agent) else {
            return;
        };
        if let Some(gnss) = frame.gnss() {
            // The pose is sent first: it is small, and the sweep cannot be used without it.
            send(&mut self.sent, &sensors.gnss, capture_nanos, gnss);
        }
        // Empty where nothing is recorded: the agent need not wait for it.
        send(&mut self.sent, &sensors.imu, capture_nanos, frame.motion());
        // Not counted as sent, since zenoh may drop previews.
        if sensors.preview.is_wanted() {
            let points = frame.points.decimate(PREVIEW_POINTS);
            sensors.preview.submit(capture_nanos, Lidar { points });
        }
        let points = frame.points;
        let sweep = Lidar { points };
        send(&mut self.sent, &sensors.lidar, capture_nanos, sweep);
        if let (Some(publisher), Some(points)) = (&sensors.radar, frame.radar) {
            send(&mut self.sent, publisher, capture_nanos, Radar { points });
        }
        for (number, image) in frame.cameras {
            let mut cameras = sensors.cameras.iter();
            if let Some((_, publisher)) = cameras.find(|(known, _)| *known == number) {
                send(&mut self.sent, publisher, capture_nanos, image);
            }
        }
    }

    /// Submits the ground truth of one tick.
    pub(super) fn submit_truth(&mut self, capture_nanos: u64, truth: Truth) {
        send(&mut self.sent, &self.truth, capture_nanos, truth);
    }

    /// Sends queued messages and ends every topic; returns the number of submitted messages by topic.
    pub(super) fn finish(self) -> Vec<TopicCount> {
        for all in self.sensors {
            let single = [Some(all.lidar), Some(all.gnss), Some(all.imu), all.radar];
            let cameras = all.cameras.into_iter().map(|(_, camera)| camera);
            let single = single.into_iter().flatten().chain([all.preview]);
            single.chain(cameras).for_each(Publisher::finish);
        }
        self.truth.finish();
        self.sent
    }
}

/// Submits a message and counts it as sent.
fn send<M: Payload + Send + 'static>(
    sent: &mut Vec<TopicCount>,
    publisher: &Publisher,
    capture_nanos: u64,
    message: M,
) {
    publisher.submit(capture_nanos, message);
    let topic = publisher.topic();
    match sent.iter_mut().find(|count| count.topic == *topic) {
        Some(count) => count.messages += 1,
        None => sent.push(TopicCount {
            topic: topic.clone(),
            messages: 1,
        }),
    }
}

/// The ground truth of the frames of a tick: poses of the vehicles, and the objects that each of them contributes.
/// Vehicles without a recorded pose are left out.
pub(super) fn truth_of(frames_of_tick: &[&Frame]) -> Vec<AgentTruth> {
    frames_of_tick
        .iter()
        .zip(annotations(frames_of_tick))
        .filter_map(|(frame, objects)| {
            let world_from_lidar = frame.world_from_lidar?;
            let objects = objects.iter().map(|object| TrueObject {
                id: object.id,
                class: object.class.name().to_owned(),
                world_from_object: object.world_from_object,
                size_m: object.size_m,
                speed_mps: object.speed_mps,
            });
            Some(AgentTruth {
                cav: frame.cav.clone(),
                world_from_lidar,
                objects: objects.collect(),
            })
        })
        .collect()
}
