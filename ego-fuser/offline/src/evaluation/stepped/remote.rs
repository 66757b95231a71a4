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
    Barrier, Bus, BusError, Event, Inbox, NotReady, Publisher, PublisherOptions, Route,
    Subscription, process_id,
};
use dataset::frame::Frame;
use protocol::{CavId, Lidar, Limits, Role, Stream, Topic, wire};

use super::super::sent::{Replies, Sent};

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
    /// Vehicles do not answer, or a message of one is invalid: the text names them, or its topic.
    #[error("{0}")]
    Answer(String),
}

/// Streams of a vehicle's sweeps.
const SENSORS: [Stream; 3] = [Stream::Gnss, Stream::Imu, Stream::Lidar];

/// All vehicles of a run in simulation time, each a process.
pub struct RemotePool {
    inbox: Arc<Inbox>,
    /// A publisher for each of [`SENSORS`].
    sensors: BTreeMap<CavId, [Publisher; 3]>,
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
        let closed = Arc::clone(&inbox);
        stop.on_request(move || closed.close());
        let (mut sensors, mut subscriptions, mut routes) =
            (BTreeMap::new(), Vec::new(), Vec::new());
        let here = bus.identity().process.clone();
        for (cav, streams) in vehicles {
            let options = PublisherOptions::SENSOR.lossless(1);
            let topics = SENSORS.map(|stream| Topic::stream(cav, stream));
            let [gnss, imu, lidar] = topics.map(|topic| bus.publisher(topic, options));
            sensors.insert(cav.clone(), [gnss?, imu?, lidar?]);
            let there = process_id(Role::Agent, cav);
            for stream in SENSORS {
                routes.push(Route::new(Topic::stream(cav, stream), there.clone()));
            }
            for stream in [Stream::Pose].into_iter().chain(streams.iter().copied()) {
                let (topic, receiver) = (Topic::stream(cav, stream), here.clone());
                subscriptions.push(bus.subscribe(topic.clone(), &inbox)?);
                routes.push(Route { topic, receiver });
            }
        }
        // No sweep is sent before both directions are connected: nothing would receive it.
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
        let publishers = self.sensors.into_values().flatten();
        publishers.for_each(Publisher::finish);
    }

    /// True while messages of a vehicle are missing in its answer.
    fn awaits(&self, cav: &CavId, answer: &Replies) -> bool {
        let streams = self.streams.get(cav);
        !answer.is_complete(streams.map_or(&[], Vec::as_slice))
    }

    /// Sends the sweeps of a tick and waits for all answers, in the same order.
    pub(super) fn request(&self, frames: &[&Frame]) -> Result<Vec<Sent>, RemoteError> {
        for frame in frames {
            let Some([gnss, imu, lidar]) = self.sensors.get(&frame.cav) else {
                continue;
            };
            // As in this process: the measurement is the recorded pose, without error.
            if let Some(measured) = frame.gnss() {
                gnss.submit(frame.capture_nanos, measured);
            }
            imu.submit(frame.capture_nanos, frame.motion());
            let points = frame.points.clone();
            lidar.submit(frame.capture_nanos, Lidar { points });
        }
        let deadline = Instant::now() + TIMEOUT;
        let answers = frames.iter().map(|frame| (&frame.cav, Replies::default()));
        let mut answers: BTreeMap<&CavId, Replies> = answers.collect();
        while answers.iter().any(|(cav, answer)| self.awaits(cav, answer)) {
            match self.inbox.take(Some(deadline)) {
                Pop::Item(topic, Event::Message(arrival)) => {
                    let Topic::Stream { cav, .. } = &topic else {
                        continue;
                    };
                    // A late answer to an earlier sweep is none to this one.
                    let asked = frames.iter().any(|frame| {
                        frame.cav == *cav
                            && frame.capture_nanos == arrival.header.stamp.capture_nanos
                    });
                    if let Some(answer) = answers.get_mut(cav).filter(|_| asked) {
                        let message = wire::decode_any(arrival.pieces(), &Limits::DEFAULT);
                        message
                            .and_then(|(_, message)| answer.note(message, arrival.wire_bytes()))
                            .map_err(|error| RemoteError::Answer(format!("{topic}: {error}")))?;
                    }
                }
                Pop::Item(..) => {}
                Pop::TimedOut | Pop::Closed => {
                    answers.retain(|cav, answer| self.awaits(cav, answer));
                    let silent: Vec<String> = answers.keys().map(ToString::to_string).collect();
                    let capture_nanos = frames.first().map_or(0, |f| f.capture_nanos);
                    return Err(RemoteError::Answer(format!(
                        "no answer of {} to the sweep of {capture_nanos} ns; see their logs",
                        silent.join(", ")
                    )));
                }
            }
        }
        let sent = frames.iter().filter_map(|frame| {
            let streams = self.streams.get(&frame.cav)?;
            Some(answers.remove(&frame.cav)?.into_sent(frame, streams))
        });
        Ok(sent.collect())
    }
}
