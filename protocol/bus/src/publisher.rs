//! Publisher: publishes from a thread of its own, so that the caller never waits for the network.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, UNIX_EPOCH};

use protocol::wire::{self, Encoded};
use protocol::{
    CavId, Control, DropReason, HEADER_LEN, Key, Payload, Stamp, Topic, TopicCount, WireError,
};
use zenoh::Wait;
use zenoh::bytes::{Encoding, ZBytes};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::sample::SourceInfo;

use super::bounded_queue::{BoundedQueue, Pop, PushOutcome};
use super::flush_barrier::FlushBarrier;
use super::session::LONGEST_MESSAGE;
use super::shared_pool::SharedPool;
use super::{Arrival, BusError, MessageStats};
use crate::batch_scheduling;
use support::nanos;
use support::sync::spawn;

/// Interval between two probes of a publisher that has sent nothing yet.
const PROBE_PERIOD: Duration = Duration::from_millis(50);
/// Size below which no confirmation is awaited, bytes: the confirmation of a small message costs about as much as the
/// message.
const SMALL_BYTES: usize = 16 << 10;

/// Options of a publisher.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PublisherOptions {
    /// Behaviour when the network still takes an earlier message. `None`, KEEP_LAST: the newest message replaces the one
    /// that waits, which is counted as superseded; for data that are measured periodically. Otherwise the length of a
    /// bounded queue, and the producer waits when it is full; for messages that must not be lost, and for paced runs.
    pub waiting_places: Option<usize>,
    /// Priority in the transport; a large message does not delay one of higher priority.
    pub priority: Priority,
    /// Sends at once rather than after the batching timer.
    pub express: bool,
    /// For viewers: zenoh may drop a message rather than wait, there are no probes and no end notifications, and
    /// [`Publisher::is_wanted`] is true while there are subscribers.
    pub is_for_onlookers: bool,
    /// Tells receivers when it ends. Without it they neither end with it nor count messages lost at its very end.
    pub announces_end: bool,
}

impl PublisherOptions {
    /// Poses, estimated and of GNSS: small, highest priority.
    pub const POSE: Self = Self::new(Priority::InteractiveHigh, true);
    /// Detections and truth: small, before all bulk data.
    pub const DETECTIONS: Self = Self::new(Priority::DataHigh, true);
    /// Features, boxes and points from an agent to an ego.
    pub const FEATURES: Self = Self::new(Priority::Data, false);
    /// Sweeps to an agent.
    pub const SENSOR: Self = Self::new(Priority::DataLow, false);
    /// Radar points to an agent: some kilobytes.
    pub const RADAR: Self = Self::new(Priority::InteractiveLow, false);
    /// Camera images, which no computation waits for.
    pub const CAMERA: Self = Self::new(Priority::Background, false);

    /// Previews for people, not used in any computation.
    pub const PREVIEW: Self = Self {
        is_for_onlookers: true,
        ..Self::new(Priority::Background, false)
    };

    const fn new(priority: Priority, express: bool) -> Self {
        Self {
            waiting_places: None,
            priority,
            express,
            is_for_onlookers: false,
            announces_end: true,
        }
    }

    /// The same of a source that may stop and come back, as a sensor does and a replay does not: its receivers stay.
    #[must_use]
    pub const fn live(mut self) -> Self {
        self.announces_end = false;
        self
    }

    /// The same, but the producer waits for a place among `places` instead of replacing a message.
    #[must_use]
    pub const fn waiting(mut self, places: usize) -> Self {
        self.waiting_places = Some(places);
        self
    }

    /// The same, and the router waits for every receiver: no message is dropped, and a receiver that takes nothing
    /// stops the publisher until its connection is closed. For paced runs.
    #[must_use]
    pub const fn lossless(mut self, places: usize) -> Self {
        self.priority = Priority::RealTime;
        self.waiting(places)
    }
}

type Encode = Box<dyn FnOnce(&Stamp, &SharedPool) -> Result<ZBytes, WireError> + Send>;

/// Capture time of a message, and what makes its bytes.
type Submission = (u64, Encode);

/// Publisher of one topic of this process. A thread of its own encodes and sends submitted messages.
///
/// `put` is called with `CongestionControl::Block`, so that zenoh never drops: by default it loses, without an error,
/// every message that takes longer than 50 ms. A router hands over differently ([`crate`]'s `egress`); each message has
/// a number by which receivers count what it has dropped for them. As a consequence `put` waits for the network, for seconds on a slow one,
/// so neither a clock nor a network thread nor an async task may call it.
///
/// Without [`PublisherOptions::waiting_places`] the next large message is taken only when the router has the previous
/// one: `put` returns as soon as a message is in the buffers of zenoh and of the system, which hold a megabyte, and
/// feature maps would become stale there on a slow link.
pub struct Publisher {
    topic: Topic,
    waits: bool,
    queue: Arc<BoundedQueue<(), Submission>>,
    stats: MessageStats,
    /// True while there are subscribers; only for droppable topics.
    has_subscribers: Option<Arc<AtomicBool>>,
    thread: Option<JoinHandle<()>>,
}

impl Publisher {
    pub(super) fn new(
        session: &zenoh::Session,
        (key, cav): (&Key, &CavId),
        epoch: u64,
        (stats, pool): (&MessageStats, &SharedPool),
        options: PublisherOptions,
    ) -> Result<Self, BusError> {
        let topic = key.topic.clone();
        // JSON is read by programs outside this project, which do not expect probes.
        let is_json = topic.is_json();
        let encoding = if is_json {
            Encoding::APPLICATION_JSON
        } else {
            Encoding::APPLICATION_OCTET_STREAM
        };
        let congestion = if options.is_for_onlookers {
            CongestionControl::Drop
        } else {
            CongestionControl::Block
        };
        let publisher = session
            .declare_publisher(key.to_string())
            .encoding(encoding)
            .congestion_control(congestion)
            .priority(options.priority)
            .express(options.express)
            .wait()
            .map_err(|cause| BusError::zenoh(format!("declaring a publisher on {key}"), &cause))?;
        let has_subscribers = options
            .is_for_onlookers
            .then(|| has_subscribers(&publisher))
            .transpose()
            .map_err(|cause| BusError::zenoh(format!("asking for subscribers of {key}"), &cause))?;
        let queue = Arc::new(BoundedQueue::new(options.waiting_places.unwrap_or(1), 1));
        let sender = SendingThread {
            topic: topic.clone(),
            cav: cav.clone(),
            epoch,
            sequence: 0,
            has_notifications: !is_json && !options.is_for_onlookers,
            announces_end: options.announces_end,
            queue: Arc::clone(&queue),
            stats: stats.clone(),
            pool: pool.clone(),
            handed_over: 0,
            publisher,
            receipt: FlushBarrier::new(session, &key.run, options.priority),
            is_one_at_a_time: options.waiting_places.is_none() && !options.is_for_onlookers,
        };
        let thread = spawn(format!("send {topic}"), move || sender.run());
        let thread = thread.map_err(BusError::thread(format!("sending {key}")))?;
        Ok(Self {
            topic,
            waits: options.waiting_places.is_some(),
            queue,
            stats: stats.clone(),
            has_subscribers,
            thread: Some(thread),
        })
    }

    /// True if messages should be submitted: always, except for viewer topics without subscribers.
    pub fn is_wanted(&self) -> bool {
        self.has_subscribers
            .as_ref()
            .is_none_or(|has_subscribers| has_subscribers.load(Ordering::Relaxed))
    }

    /// Topic of the publisher.
    pub fn topic(&self) -> &Topic {
        &self.topic
    }

    /// Submits a message captured at `capture_nanos`. Returns at once, except with
    /// [`PublisherOptions::waiting_places`] and a full queue.
    pub fn submit<M: Payload + Send + 'static>(&self, capture_nanos: u64, message: M) {
        self.submit_encoded(capture_nanos, move |stamp| wire::encode(stamp, message));
    }

    /// Submits a message that `encode` makes from its stamp on the sending thread.
    pub fn submit_encoded(
        &self,
        capture_nanos: u64,
        encode: impl FnOnce(&Stamp) -> Result<Encoded, WireError> + Send + 'static,
    ) {
        self.push(
            capture_nanos,
            Box::new(|stamp, pool| Ok(pool.payload(encode(stamp)?))),
        );
    }

    /// Forwards a message unchanged, under the stamp of its sender; nothing is copied.
    pub fn relay(&self, arrival: &Arrival) {
        let bytes = arrival.payload.clone();
        let capture_nanos = arrival.header.stamp.capture_nanos;
        self.push(capture_nanos, Box::new(|_, _| Ok(bytes)));
    }

    /// The same with another capture time, that of an erroneous clock.
    pub fn relay_as(&self, arrival: &Arrival, capture_nanos: u64) {
        if arrival.header.stamp.capture_nanos == capture_nanos {
            return self.relay(arrival);
        }
        let mut header = arrival.header.clone();
        header.stamp.capture_nanos = capture_nanos;
        let whole = arrival.payload.to_bytes();
        let rest = whole.get(HEADER_LEN..).unwrap_or_default();
        let mut writer = ZBytes::writer();
        // The checksum of the payload does not cover the header, which has a new one of its own.
        writer.append(header.to_bytes().to_vec().into());
        writer.append(rest.to_vec().into());
        let bytes = writer.finish();
        self.push(capture_nanos, Box::new(|_, _| Ok(bytes)));
    }

    fn push(&self, capture_nanos: u64, encode: Encode) {
        self.stats.submitted(&self.topic);
        let submission = (capture_nanos, encode);
        let pushed = match self.waits {
            true => self.queue.push_waiting((), submission),
            false => self.queue.push((), submission),
        };
        // Replaced, or refused after the end: in either case one submitted message is not sent.
        if !matches!(pushed, PushOutcome::Queued) {
            self.stats.suppressed(&self.topic, DropReason::Superseded);
        }
    }

    /// Sends queued messages, then a notification with the number of messages if it announces its end, and ends. Waits
    /// for the network.
    pub fn finish(mut self) {
        self.queue.close();
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!(topic = %self.topic, "the sending thread panicked");
        }
    }
}

impl Drop for Publisher {
    /// Without [`Self::finish`] the thread sends queued messages and ends by itself.
    fn drop(&mut self) {
        self.queue.close();
    }
}

/// State of the sending thread.
struct SendingThread {
    topic: Topic,
    cav: CavId,
    epoch: u64,
    sequence: u64,
    has_notifications: bool,
    announces_end: bool,
    queue: Arc<BoundedQueue<(), Submission>>,
    stats: MessageStats,
    pool: SharedPool,
    /// Messages that zenoh has taken, without notifications.
    handed_over: u32,
    publisher: zenoh::pubsub::Publisher<'static>,
    receipt: FlushBarrier,
    /// True if the router must have a large message before the next one is taken from the queue.
    is_one_at_a_time: bool,
}

impl SendingThread {
    fn run(mut self) {
        batch_scheduling::use_batch_scheduling();
        if self.has_notifications {
            self.notify(Control::Probe);
        }
        loop {
            // The first message confirms the route as a probe does, so probes end with it.
            let probing = self.has_notifications && self.sequence == 0;
            let deadline = probing.then(|| Instant::now() + PROBE_PERIOD);
            match self.queue.take(deadline) {
                Pop::Item((), submission) => self.send(submission),
                Pop::TimedOut => self.notify(Control::Probe),
                Pop::Closed => break,
            }
        }
        if self.has_notifications && self.announces_end {
            let (topic, messages) = (self.topic.clone(), self.sequence);
            let sent = vec![TopicCount { topic, messages }];
            self.notify(Control::End {
                ticks: self.sequence,
                sent,
            });
        }
    }

    fn send(&mut self, (capture_nanos, encode): Submission) {
        let began = Instant::now();
        match encode(&self.stamp(capture_nanos), &self.pool) {
            Ok(bytes) => {
                self.stats.timed("encode", began.elapsed());
                // Only now: a message that cannot be encoded leaves no gap in the sequence.
                self.sequence += 1;
                let length = bytes.len();
                let is_large = length >= SMALL_BYTES;
                if self.put(bytes) {
                    self.handed_over = self.handed_over.wrapping_add(1);
                    self.stats.delivered(&self.topic);
                    self.stats.published(&self.topic, length);
                    if is_large && self.is_one_at_a_time {
                        self.receipt.wait(LONGEST_MESSAGE);
                    }
                } else {
                    // The session is closed: there is no transport.
                    self.stats.suppressed(&self.topic, DropReason::PeerOffline);
                }
            }
            Err(error) => {
                tracing::error!(topic = %self.topic, capture_nanos, "message cannot be sent: {error}");
                self.stats.suppressed(&self.topic, error.drop_reason());
            }
        }
    }

    /// Notifications on the data key keep their order among the data; they are not counted.
    fn notify(&self, control: Control) {
        match wire::encode(&self.stamp(0), control) {
            Ok(encoded) => {
                self.put(payload(encoded));
            }
            Err(error) => {
                tracing::error!(topic = %self.topic, "notification cannot be sent: {error}")
            }
        }
    }

    fn put(&self, bytes: ZBytes) -> bool {
        // Receivers count gaps by this number, not by that of the header.
        // A relayed message keeps the header of its sender.
        let number = SourceInfo::new(self.publisher.id(), self.handed_over);
        let sent = self.publisher.put(bytes).source_info(number).wait();
        if let Err(cause) = &sent {
            tracing::error!(topic = %self.topic, "zenoh rejected a message: {cause}");
        }
        sent.is_ok()
    }

    fn stamp(&self, capture_nanos: u64) -> Stamp {
        stamp_now(&self.cav, self.epoch, self.sequence, capture_nanos)
    }
}

/// Stamp of a message that is published now.
pub(super) fn stamp_now(cav: &CavId, epoch: u64, sequence: u64, capture_nanos: u64) -> Stamp {
    Stamp {
        cav: cav.clone(),
        epoch,
        sequence,
        capture_nanos,
        publish_nanos: unix_nanos(),
    }
}

/// True while a publisher has subscribers, updated for its lifetime.
///
/// # Errors
/// Those of zenoh.
pub fn has_subscribers(publisher: &zenoh::pubsub::Publisher<'_>) -> zenoh::Result<Arc<AtomicBool>> {
    let has_subscribers = Arc::<AtomicBool>::default();
    let noted = Arc::clone(&has_subscribers);
    // It is told of subscribers from before, too: the answer of a query could overwrite a newer change.
    let listener = publisher.matching_listener();
    listener
        .callback(move |status| noted.store(status.matching(), Ordering::Relaxed))
        .background()
        .wait()?;
    Ok(has_subscribers)
}

/// Head and body concatenated, without copying the body.
pub(super) fn payload(encoded: Encoded) -> ZBytes {
    SharedPool::default().payload(encoded)
}

/// Current time on the Unix clock, nanoseconds.
pub fn unix_nanos() -> u64 {
    nanos::of(UNIX_EPOCH.elapsed().unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use protocol::{Account, Counts, Gnss, GnssSource, Pose};

    use super::*;
    use crate::{BusOptions, Endpoint, open};

    #[test]
    fn subscribers_from_before_are_known_at_once() {
        let session = open(&BusOptions::router(Endpoint::loopback(0))).unwrap();
        let publisher = session.declare_publisher("v2v/test/truth").wait().unwrap();
        let is_known = has_subscribers(&publisher).unwrap();
        assert!(!is_known.load(Ordering::Relaxed));
        let _subscriber = session.declare_subscriber("v2v/test/truth").wait().unwrap();
        let is_known = has_subscribers(&publisher).unwrap();
        assert!(is_known.load(Ordering::Relaxed));
    }

    #[test]
    fn messages_rejected_by_zenoh_are_not_in_flight() {
        let session = open(&BusOptions::router(Endpoint::loopback(0))).unwrap();
        let (key, stats): (Key, _) = (
            "v2v/test/7/gnss".parse().unwrap(),
            MessageStats::new("replay".parse().unwrap()),
        );
        let cav = CavId::new("7").unwrap();
        let publisher = Publisher::new(
            &session,
            (&key, &cav),
            1,
            (&stats, &SharedPool::default()),
            PublisherOptions::POSE,
        )
        .unwrap();
        session.close().wait().unwrap();
        let source = GnssSource::Recorded;
        let gnss = Gnss {
            world_from_lidar: Pose::IDENTITY,
            position_std_m: 0.0,
            heading_std_rad: 0.0,
            source,
        };
        publisher.submit(5, gnss);
        publisher.finish();
        let lost = Counts {
            sent: 1,
            dropped: [(DropReason::PeerOffline, 1)].into(),
            ..Counts::default()
        };
        assert_eq!(
            stats.ledger().get(&Account::published(key.topic)),
            Some(&lost)
        );
    }
}
