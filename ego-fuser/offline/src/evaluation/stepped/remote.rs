//! Remote agents: vehicles' pipelines in processes of their own; sweeps are sent over the bus, their messages come
//! back.
//!
//! All advance in lockstep: no process gets the next sweep before all have answered to this one. So nothing is
//! overwritten in a queue, and no wall clock affects the result; send times are simulation time.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bus::bounded_queue::Pop;
use bus::shutdown::Stop;
use bus::{
    Arrival, Barrier, Bus, BusError, Event, Inbox, NotReady, Publisher, PublisherOptions, Route,
    Subscription, process_id,
};
use dataset::frame::Frame;
use protocol::message::{Bev, Boxes, GnssSource, Points};
use protocol::{
    CavId, Gnss, Lidar, Limits, PoseEstimate, ProcessId, Role, Stream, Topic, WireError,
};

use super::super::sent::{Sent, SentMessage};
use ego_fuser::ego::Content;

/// Timeout of all vehicles together for a tick: for a busy machine, but not for one that has lost a process.
const TIMEOUT: Duration = Duration::from_secs(120);

/// Error of the remote agents.
#[derive(Debug, thiserror::Error)]
pub enum RemoteError {
    /// The bus reported an error.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// Not all processes joined.
    #[error(transparent)]
    NotReady(#[from] NotReady),
    /// A vehicle does not answer.
    #[error("no answer of {cavs} to the sweep of {capture_nanos} ns; see their logs")]
    Silent {
        /// Vehicles without an answer, separated by commas.
        cavs: String,
        /// Capture time of the sweep.
        capture_nanos: u64,
    },
    /// A vehicle's message is invalid.
    #[error("{topic}: {source}")]
    Unsound {
        /// Topic of the message.
        topic: Topic,
        /// Cause.
        source: WireError,
    },
}

/// Publishers of a vehicle's sweeps.
struct Sensors {
    gnss: Publisher,
    imu: Publisher,
    lidar: Publisher,
}

/// All vehicles of a run in simulation time, each a process.
pub struct RemotePool {
    inbox: Arc<Inbox>,
    sensors: BTreeMap<CavId, Sensors>,
    /// Streams of each vehicle beside its pose, in the order of sending.
    streams: BTreeMap<CavId, Vec<Stream>>,
    _subscriptions: Vec<Subscription>,
}

impl fmt::Debug for RemotePool {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RemotePool")
            .field("vehicles", &self.sensors.keys())
            .finish_non_exhaustive()
    }
}

/// The messages of an answer so far.
#[derive(Default)]
struct Answer {
    pose: Option<(PoseEstimate, u64)>,
    messages: BTreeMap<Stream, SentMessage>,
}

impl RemotePool {
    /// Waits until the process of every vehicle has joined, for `timeout` at most. Each sends the streams named beside
    /// it. The wait ends when `stop` is requested.
    ///
    /// # Errors
    /// [`RemoteError`] names those that have not joined.
    pub fn connect(
        bus: &Bus,
        vehicles: &[(CavId, Vec<Stream>)],
        timeout: Duration,
        stop: &Stop,
    ) -> Result<Self, RemoteError> {
        let inbox = bus.inbox(2, 3 * vehicles.len());
        stop.on_request({
            let inbox = Arc::clone(&inbox);
            move || inbox.close()
        });
        let (mut sensors, mut subscriptions, mut routes) =
            (BTreeMap::new(), Vec::new(), Vec::new());
        let here = bus.identity().process.clone();
        for (cav, streams) in vehicles {
            let topic = |stream| Topic::Stream {
                cav: cav.clone(),
                stream,
            };
            let publisher =
                |stream| bus.publisher(topic(stream), PublisherOptions::SENSOR.lossless(1));
            sensors.insert(
                cav.clone(),
                Sensors {
                    gnss: publisher(Stream::Gnss)?,
                    imu: publisher(Stream::Imu)?,
                    lidar: publisher(Stream::Lidar)?,
                },
            );
            let there = process_id(Role::Agent, cav);
            let route = |stream, receiver: &ProcessId| Route {
                topic: topic(stream),
                receiver: receiver.clone(),
            };
            routes.extend(
                [Stream::Gnss, Stream::Imu, Stream::Lidar].map(|stream| route(stream, &there)),
            );
            for stream in [Stream::Pose].into_iter().chain(streams.iter().copied()) {
                subscriptions.push(bus.subscribe(topic(stream), &inbox)?);
                routes.push(route(stream, &here));
            }
        }
        Barrier::new(routes).await_routes(bus)?.wait(timeout)?;
        Ok(Self {
            inbox,
            sensors,
            streams: vehicles.iter().cloned().collect(),
            _subscriptions: subscriptions,
        })
    }

    /// Ends the streams of sweeps.
    pub(in super::super) fn finish(self) {
        self.sensors
            .into_values()
            .flat_map(|Sensors { gnss, imu, lidar }| [gnss, imu, lidar])
            .for_each(Publisher::finish);
    }

    /// Sends the sweeps of a tick and waits for all answers, in the same order.
    pub(super) fn request(&self, frames: &[&Frame]) -> Result<Vec<Sent>, RemoteError> {
        for frame in frames {
            let Some(Sensors { gnss, imu, lidar }) = self.sensors.get(&frame.cav) else {
                continue;
            };
            if let Some(world_from_lidar) = frame.world_from_lidar {
                let source = GnssSource::Recorded;
                let measured = Gnss {
                    world_from_lidar,
                    position_std_m: 0.0,
                    heading_std_rad: 0.0,
                    source,
                };
                gnss.submit(frame.capture_nanos, measured);
            }
            imu.submit(frame.capture_nanos, frame.motion());
            lidar.submit(
                frame.capture_nanos,
                Lidar {
                    points: frame.points.clone(),
                },
            );
        }
        let deadline = Instant::now() + TIMEOUT;
        let mut answers: BTreeMap<&CavId, Answer> = frames
            .iter()
            .map(|frame| (&frame.cav, Answer::default()))
            .collect();
        let is_open = |(cav, answer): &(&&CavId, &Answer)| {
            let mut streams = self.streams.get(**cav).into_iter().flatten();
            answer.pose.is_none() || streams.any(|stream| !answer.messages.contains_key(stream))
        };
        while answers.iter().any(|entry| is_open(&entry)) {
            match self.inbox.take(Some(deadline)) {
                Pop::Item(topic, Event::Message(arrival)) => {
                    let Topic::Stream { cav, stream } = &topic else {
                        continue;
                    };
                    let asked = frames.iter().any(|frame| {
                        frame.cav == *cav
                            && frame.capture_nanos == arrival.header.stamp.capture_nanos
                    });
                    if let Some(answer) = answers.get_mut(cav).filter(|_| asked) {
                        answer
                            .note(*stream, &arrival)
                            .map_err(|source| RemoteError::Unsound {
                                topic: topic.clone(),
                                source,
                            })?;
                    }
                }
                Pop::Item(..) => {}
                Pop::TimedOut | Pop::Closed => {
                    let silent = answers
                        .iter()
                        .filter(is_open)
                        .map(|(cav, _)| cav.to_string());
                    let cavs = silent.collect::<Vec<_>>().join(", ");
                    return Err(RemoteError::Silent {
                        cavs,
                        capture_nanos: frames.first().map_or(0, |f| f.capture_nanos),
                    });
                }
            }
        }
        Ok(frames
            .iter()
            .filter_map(|frame| {
                let streams = self.streams.get(&frame.cav)?;
                answers.remove(&frame.cav)?.into_sent(frame, streams)
            })
            .collect())
    }
}

impl Answer {
    fn note(&mut self, stream: Stream, arrival: &Arrival) -> Result<(), WireError> {
        let (limits, bytes) = (Limits::default(), arrival.wire_bytes());
        let (content, rate) = match stream {
            Stream::Bev => {
                let message: Bev = arrival.decode(&limits)?;
                let rate = message.features.rate;
                (Content::Features(message.features.decode(&limits)?), rate)
            }
            Stream::Boxes => {
                let message: Boxes = arrival.decode(&limits)?;
                (Content::Boxes(message.into_objects()), None)
            }
            Stream::Points => {
                let message: Points = arrival.decode(&limits)?;
                (Content::Points(message.points), None)
            }
            Stream::Pose => {
                self.pose = Some((arrival.decode(&limits)?, bytes));
                return Ok(());
            }
            _ => return Ok(()),
        };
        let message = SentMessage {
            content,
            bytes,
            rate,
        };
        self.messages.insert(stream, message);
        Ok(())
    }

    /// The answer with its messages in the order of these streams, whatever the order of their arrival.
    fn into_sent(mut self, frame: &Frame, streams: &[Stream]) -> Option<Sent> {
        let (pose, pose_bytes) = self.pose?;
        let messages = streams.iter().map(|stream| self.messages.remove(stream));
        Some(Sent {
            cav: frame.cav.clone(),
            capture_nanos: frame.capture_nanos,
            pose,
            pose_bytes,
            messages: messages.collect::<Option<_>>()?,
            failure: None,
        })
    }
}
