//! Publishers of a replayed scene: each vehicle's sensors, and the ground truth.

use std::collections::BTreeMap;

use protocol::message::{AgentTruth, Payload, TrueObject};
use protocol::{CavId, Lidar, Radar, Stream, Topic, TopicCount, Truth};

use super::sensor_link::Sweep;
use bus::{Bus, BusError, Publisher, PublisherOptions};
use dataset::LoadOptions;
use dataset::frame::Frame;
use dataset::ground_truth::annotations;

/// Queue length of a lossless topic.
const LOSSLESS_PLACES: usize = 16;
/// Points of a preview: it must fit into one batch of zenoh.
const PREVIEW_POINTS: usize = 4_000;

/// All publishers of a replay.
pub(super) struct SensorPublisher {
    /// By index of the vehicle among those that take part, and by stream.
    sensors: BTreeMap<(usize, Stream), Publisher>,
    truth: Publisher,
    sent: BTreeMap<Topic, u64>,
}

impl SensorPublisher {
    /// Opens the publishers of the truth and of the sensors of `agents`: radar and `cameras` only if `load` has them
    /// read. With `is_paced` sensor messages wait for a place in their queue instead of replacing older ones.
    pub(super) fn open(
        bus: &Bus,
        agents: &[CavId],
        load: &LoadOptions,
        cameras: &[u8],
        is_paced: bool,
    ) -> Result<Self, BusError> {
        let always = [
            (Stream::Lidar, PublisherOptions::SENSOR),
            // Small messages have other priorities than sweeps: they do not wait for one on its way to a slow receiver.
            (Stream::Gnss, PublisherOptions::POSE),
            (Stream::Imu, PublisherOptions::POSE),
            (Stream::Preview, PublisherOptions::PREVIEW),
        ];
        let radar = (Stream::Radar, PublisherOptions::RADAR);
        let radar = load.radar.then_some(radar);
        let cameras = cameras.iter().filter(|_| load.cameras);
        let cameras = cameras.map(|&number| (Stream::Camera(number), PublisherOptions::CAMERA));
        let streams: Vec<_> = always.into_iter().chain(radar).chain(cameras).collect();
        // Waits for a place even in a replay that is not paced: a tick without truth cannot be scored.
        let waiting = PublisherOptions::DETECTIONS.waiting(LOSSLESS_PLACES);
        let truth = bus.publisher(Topic::Truth, waiting)?;
        let mut sensors = BTreeMap::new();
        for (agent, cav) in agents.iter().enumerate() {
            for &(stream, options) in &streams {
                // Previews are never paced: a slow viewer must not hold back the replay.
                let options = match is_paced && stream != Stream::Preview {
                    true => options.lossless(LOSSLESS_PLACES),
                    false => options,
                };
                let publisher = bus.publisher(Topic::stream(cav, stream), options)?;
                sensors.insert((agent, stream), publisher);
            }
        }
        Ok(Self {
            sensors,
            truth,
            sent: BTreeMap::new(),
        })
    }

    /// Submits the data of one vehicle.
    pub(super) fn submit(&mut self, sweep: Sweep) {
        let (agent, capture_nanos, frame) = (sweep.agent, sweep.capture_nanos, sweep.frame);
        if let Some(gnss) = frame.gnss() {
            // The pose is sent first: it is small, and the sweep cannot be used without it.
            self.send((agent, Stream::Gnss), capture_nanos, gnss);
        }
        // Empty where nothing is recorded: the agent need not wait for it.
        self.send((agent, Stream::Imu), capture_nanos, frame.motion());
        // Not counted as sent, since zenoh may drop previews.
        let preview = self.sensors.get(&(agent, Stream::Preview));
        if let Some(preview) = preview.filter(|preview| preview.is_wanted()) {
            let points = frame.points.decimate(PREVIEW_POINTS);
            preview.submit(capture_nanos, Lidar { points });
        }
        let points = frame.points;
        self.send((agent, Stream::Lidar), capture_nanos, Lidar { points });
        if let Some(points) = frame.radar {
            self.send((agent, Stream::Radar), capture_nanos, Radar { points });
        }
        for (number, image) in frame.cameras {
            self.send((agent, Stream::Camera(number)), capture_nanos, image);
        }
    }

    /// Submits a message of a vehicle's stream, if it is published, and counts it as sent.
    fn send<M: Payload + Send + 'static>(
        &mut self,
        of: (usize, Stream),
        capture_nanos: u64,
        message: M,
    ) {
        if let Some(publisher) = self.sensors.get(&of) {
            publisher.submit(capture_nanos, message);
            *self.sent.entry(publisher.topic().clone()).or_default() += 1;
        }
    }

    /// Submits the ground truth of one tick.
    pub(super) fn submit_truth(&mut self, capture_nanos: u64, truth: Truth) {
        self.truth.submit(capture_nanos, truth);
        *self.sent.entry(self.truth.topic().clone()).or_default() += 1;
    }

    /// Sends queued messages and ends every topic; returns the number of submitted messages by topic.
    pub(super) fn finish(self) -> Vec<TopicCount> {
        for publisher in self.sensors.into_values() {
            publisher.finish();
        }
        self.truth.finish();
        let sent = self.sent.into_iter();
        sent.map(|(topic, messages)| TopicCount { topic, messages })
            .collect()
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
