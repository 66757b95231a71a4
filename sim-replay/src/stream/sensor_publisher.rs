//! The topics of a replayed scene: each vehicle's sensors, and the truth.

use protocol::message::{AgentTruth, TrueObject};
use protocol::{CavId, Gnss, GnssSource, Lidar, Radar, Stream, Topic, TopicCount, Truth};

use bus::{Bus, BusError, Publisher, PublisherOptions};
use dataset::frame::{Frame, Object};
use dataset::ground_truth::annotations;

/// Places in the queue of a topic of which nothing may be lost.
const LOSSLESS_PLACES: usize = 16;
/// Points of a preview: so many that it still fits into one batch of zenoh's.
const PREVIEW_POINTS: usize = 4_000;

/// The sensors of one vehicle.
struct Sensors {
    lidar: Publisher,
    gnss: Publisher,
    radar: Option<Publisher>,
    preview: Publisher,
}

/// Everything a replay publishes.
pub(super) struct SensorPublisher {
    sensors: Vec<Sensors>,
    truth: Publisher,
    sent: Vec<TopicCount>,
}

impl SensorPublisher {
    /// Publishers for `agents`. Under `is_paced` the sender waits rather than that a sweep be superseded.
    pub(super) fn open(bus: &Bus, agents: &[CavId], with_radar: bool, is_paced: bool) -> Result<Self, BusError> {
        let options =
            if is_paced { PublisherOptions::SENSOR.lossless(LOSSLESS_PLACES) } else { PublisherOptions::SENSOR };
        let sensors = agents.iter().map(|cav| {
            let publisher = |stream| bus.publisher(Topic::Stream { cav: cav.clone(), stream }, options);
            Ok(Sensors {
                lidar: publisher(Stream::Lidar)?,
                gnss: publisher(Stream::Gnss)?,
                radar: with_radar.then(|| publisher(Stream::Radar)).transpose()?,
                preview: bus.publisher(
                    Topic::Stream { cav: cav.clone(), stream: Stream::Preview },
                    PublisherOptions::PREVIEW,
                )?,
            })
        });
        let truth = bus.publisher(Topic::Truth, PublisherOptions::FEATURES.lossless(LOSSLESS_PLACES))?;
        Ok(Self { sensors: sensors.collect::<Result<_, _>>()?, truth, sent: Vec::new() })
    }

    /// Offers what one vehicle measured, as captured at `capture_nanos`.
    pub(super) fn offer(&mut self, agent: usize, capture_nanos: u64, frame: Frame) {
        let Some(sensors) = self.sensors.get(agent) else { return };
        if let Some(world_from_lidar) = frame.world_from_lidar {
            // The pose goes first: it is small, and the sweep is of no use without it.
            let source = GnssSource::Recorded;
            let gnss = Gnss { world_from_lidar, position_std_m: 0.0, heading_std_rad: 0.0, source };
            sensors.gnss.offer(capture_nanos, gnss);
            count(&mut self.sent, sensors.gnss.topic());
        }
        if sensors.preview.is_wanted() {
            sensors.preview.offer(capture_nanos, Lidar { points: frame.points.decimate(PREVIEW_POINTS) });
        }
        sensors.lidar.offer(capture_nanos, Lidar { points: frame.points });
        count(&mut self.sent, sensors.lidar.topic());
        if let (Some(publisher), Some(points)) = (&sensors.radar, frame.radar) {
            publisher.offer(capture_nanos, Radar { points });
            count(&mut self.sent, publisher.topic());
        }
    }

    /// Offers the truth of one tick.
    pub(super) fn offer_truth(&mut self, capture_nanos: u64, truth: Truth) {
        self.truth.offer(capture_nanos, truth);
        count(&mut self.sent, self.truth.topic());
    }

    /// Sends what is queued and ends every topic; says how much was offered on each.
    pub(super) fn finish(self) -> Vec<TopicCount> {
        for Sensors { lidar, gnss, radar, preview } in self.sensors {
            [Some(lidar), Some(gnss), radar, Some(preview)].into_iter().flatten().for_each(Publisher::finish);
        }
        self.truth.finish();
        self.sent
    }
}

fn count(sent: &mut Vec<TopicCount>, topic: &Topic) {
    match sent.iter_mut().find(|count| count.topic == *topic) {
        Some(count) => count.messages += 1,
        None => sent.push(TopicCount { topic: topic.clone(), messages: 1 }),
    }
}

/// What of the frames of a tick is true: where their vehicles are, and what each of them adds to the truth of the tick.
/// Vehicles whose pose the recording does not know are left out.
pub(super) fn truth_of(frames_of_tick: &[&Frame]) -> Vec<AgentTruth> {
    let truth = |(frame, objects): (&&Frame, &[Object])| {
        let world_from_lidar = frame.world_from_lidar?;
        let objects = objects.iter().map(true_object).collect();
        Some(AgentTruth { cav: frame.cav.clone(), world_from_lidar, objects })
    };
    frames_of_tick.iter().zip(annotations(frames_of_tick)).filter_map(truth).collect()
}

fn true_object(object: &Object) -> TrueObject {
    TrueObject {
        id: object.id,
        class: object.class.name().to_owned(),
        world_from_object: object.world_from_object,
        size_m: object.size_m,
        speed_mps: object.speed_mps,
    }
}
