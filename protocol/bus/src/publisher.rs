//! Publishing without ever waiting for the network on the caller's thread.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use protocol::wire::{self, Encoded};
use protocol::{CavId, Control, DropReason, HEADER_LEN, Key, Payload, Stamp, Topic, TopicCount, WireError};
use zenoh::Wait;
use zenoh::bytes::{Encoding, ZBytes};
use zenoh::qos::{CongestionControl, Priority};

use super::bounded_queue::{BoundedQueue, Pop, PushOutcome};
use super::flush_barrier::FlushBarrier;
use super::session::LONGEST_MESSAGE;
use super::{Arrival, BusError, MessageStats};
use crate::batch_scheduling;
use support::nanos;

/// Between two probes of a publisher that has sent nothing yet.
const PROBE_PERIOD: Duration = Duration::from_millis(50);
/// Messages of fewer bytes wait for nobody: asking whether they have come costs about as much as they do.
const SMALL_BYTES: usize = 16 << 10;

/// What happens to a message offered while the network still takes an earlier one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Overflow {
    /// It waits in a queue of this many places; in a full one it takes the place of the oldest, which is counted as
    /// superseded. For everything that is measured anew all the time.
    KeepNewest(usize),
    /// It waits in a queue of this many places, and so does its producer when that is full. For what must not be lost,
    /// and for paced runs.
    Wait(usize),
}

/// How a topic is published.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PublisherOptions {
    /// What an overload does.
    pub overflow: Overflow,
    /// Which queue of the transport it goes through; a large message does not hold up one of higher priority.
    pub priority: Priority,
    /// Sends at once rather than after the batching timer.
    pub express: bool,
    /// For people who look on: zenoh may throw a message away rather than wait for anyone, there are no probes and no end
    /// markers, and [`Publisher::is_wanted`] tells whether somebody listens.
    pub is_for_onlookers: bool,
}

impl PublisherOptions {
    /// Poses: small, first of all.
    pub const POSE: Self = Self::new(Priority::InteractiveHigh, true);
    /// Detections: small, before all bulk.
    pub const DETECTIONS: Self = Self::new(Priority::DataHigh, true);
    /// Features, boxes and points on their way to an ego.
    pub const FEATURES: Self = Self::new(Priority::Data, false);
    /// Sensor data on their way to an agent.
    pub const SENSOR: Self = Self::new(Priority::DataLow, false);

    /// What people look at, and nobody computes with.
    pub const PREVIEW: Self = Self { is_for_onlookers: true, ..Self::new(Priority::Background, false) };

    const fn new(priority: Priority, express: bool) -> Self {
        Self { overflow: Overflow::KeepNewest(1), priority, express, is_for_onlookers: false }
    }

    /// The same, but the producer waits rather than that anything be dropped.
    #[must_use]
    pub const fn lossless(self, places: usize) -> Self {
        Self { overflow: Overflow::Wait(places), ..self }
    }
}

type Encode = Box<dyn FnOnce(&Stamp) -> Result<ZBytes, WireError> + Send>;

struct Offer {
    capture_nanos: u64,
    encode: Encode,
}

/// One topic of this process. A thread of its own encodes and sends what is offered.
///
/// `put` is called under `CongestionControl::Block`, so that zenoh never drops: with its default it loses, without an
/// error, every message that takes longer than 50 ms. The price is that `put` waits for the network, for seconds on a
/// slow one, which is why neither a clock nor a network thread nor an async task may call it.
///
/// Where the newest wins, the next large message is taken only when the router has the one before: `put` is content with
/// a place in the buffers of zenoh and of the system, a megabyte of them, in which maps would grow old on a slow link.
pub struct Publisher {
    topic: Topic,
    overflow: Overflow,
    queue: Arc<BoundedQueue<(), Offer>>,
    books: MessageStats,
    /// Whether somebody listens, where that matters.
    audience: Option<Arc<AtomicBool>>,
    thread: Option<JoinHandle<()>>,
}

impl Publisher {
    pub(super) fn new(
        session: &zenoh::Session,
        (key, cav): (&Key, &CavId),
        epoch: u64,
        books: &MessageStats,
        options: PublisherOptions,
    ) -> Result<Self, BusError> {
        let PublisherOptions { overflow, priority, express, is_for_onlookers } = options;
        let topic = key.topic.clone();
        // JSON has readers outside this program, to whom a probe would be noise.
        let is_json = matches!(&topic, Topic::Stream { stream, .. } if stream.kind().is_none());
        let encoding = if is_json { Encoding::APPLICATION_JSON } else { Encoding::APPLICATION_OCTET_STREAM };
        let congestion = if is_for_onlookers { CongestionControl::Drop } else { CongestionControl::Block };
        let publisher = session
            .declare_publisher(key.to_string())
            .encoding(encoding)
            .congestion_control(congestion)
            .priority(priority)
            .express(express)
            .wait()
            .map_err(|cause| BusError::zenoh(format!("declaring a publisher on {key}"), &cause))?;
        let places = match overflow {
            Overflow::KeepNewest(places) | Overflow::Wait(places) => places,
        };
        let audience = is_for_onlookers.then(|| audience(&publisher)).transpose();
        let audience = audience.map_err(|cause| BusError::zenoh(format!("asking who listens to {key}"), &cause))?;
        let queue = Arc::new(BoundedQueue::new(places, 1));
        let sender = Sender {
            topic: topic.clone(),
            cav: cav.clone(),
            epoch,
            sequence: 0,
            has_notices: !is_json && !is_for_onlookers,
            queue: Arc::clone(&queue),
            books: books.clone(),
            publisher,
            receipt: FlushBarrier::new(session, &key.run, priority),
            is_one_at_a_time: matches!(overflow, Overflow::KeepNewest(_)) && !is_for_onlookers,
        };
        let thread = thread::Builder::new()
            .name(format!("send {topic}"))
            .spawn(move || sender.run())
            .map_err(|cause| BusError::Thread { what: format!("sending {key}"), cause })?;
        Ok(Self { topic, overflow, queue, books: books.clone(), audience, thread: Some(thread) })
    }

    /// Whether it is worth while to offer anything: always, but for what is for onlookers when there are none.
    #[must_use]
    pub fn is_wanted(&self) -> bool {
        self.audience.as_ref().is_none_or(|audience| audience.load(Ordering::Relaxed))
    }

    /// What is published here.
    #[must_use]
    pub fn topic(&self) -> &Topic {
        &self.topic
    }

    /// Offers a message measured at `capture_nanos`. Returns at once, except under [`Overflow::Wait`] with a full queue.
    pub fn offer<M: Payload + Send + 'static>(&self, capture_nanos: u64, message: M) {
        self.offer_encoded(capture_nanos, move |stamp| wire::encode(stamp, message));
    }

    /// Offers what `encode` makes of the stamp when it is the message's turn, on the sending thread.
    pub fn offer_encoded(
        &self,
        capture_nanos: u64,
        encode: impl FnOnce(&Stamp) -> Result<Encoded, WireError> + Send + 'static,
    ) {
        self.push(Offer { capture_nanos, encode: Box::new(|stamp| encode(stamp).map(payload)) });
    }

    /// Passes on a message as it came, under the stamp of its sender; nothing is copied.
    pub fn relay(&self, arrival: &Arrival) {
        let bytes = arrival.payload().clone();
        self.push(Offer { capture_nanos: arrival.header.stamp.capture_nanos, encode: Box::new(|_| Ok(bytes)) });
    }

    /// The same with another capture time: that of a clock which is off.
    pub fn relay_as(&self, arrival: &Arrival, capture_nanos: u64) {
        if arrival.header.stamp.capture_nanos == capture_nanos {
            return self.relay(arrival);
        }
        let mut header = arrival.header.clone();
        header.stamp.capture_nanos = capture_nanos;
        let rest = arrival.payload().to_bytes().get(HEADER_LEN..).unwrap_or_default().to_vec();
        let mut writer = ZBytes::writer();
        writer.append(header.to_bytes().to_vec().into());
        writer.append(rest.into());
        let bytes = writer.finish();
        self.push(Offer { capture_nanos, encode: Box::new(|_| Ok(bytes)) });
    }

    fn push(&self, offer: Offer) {
        self.books.offered(&self.topic);
        let pushed = match self.overflow {
            Overflow::KeepNewest(_) => self.queue.push((), offer),
            Overflow::Wait(_) => self.queue.push_waiting((), offer),
        };
        match pushed {
            PushOutcome::Queued => {}
            PushOutcome::Replaced(_) | PushOutcome::NoLane(_) | PushOutcome::Closed(_) => {
                self.books.withheld(&self.topic, DropReason::Superseded);
            }
        }
    }

    /// Sends what is still queued, then a notice of how many messages there were, and ends. Waits for the network.
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
    /// Without [`Self::finish`] the thread sends what is left and ends by itself.
    fn drop(&mut self) {
        self.queue.close();
    }
}

/// The sending thread's side.
struct Sender {
    topic: Topic,
    cav: CavId,
    epoch: u64,
    sequence: u64,
    has_notices: bool,
    queue: Arc<BoundedQueue<(), Offer>>,
    books: MessageStats,
    publisher: zenoh::pubsub::Publisher<'static>,
    receipt: FlushBarrier,
    /// Whether the router must have a large message before the next one is taken from the queue.
    is_one_at_a_time: bool,
}

impl Sender {
    fn run(mut self) {
        batch_scheduling::use_batch_scheduling();
        if self.has_notices {
            self.notify(Control::Probe);
        }
        loop {
            let probing = self.has_notices && self.sequence == 0;
            match self.queue.take(probing.then(|| Instant::now() + PROBE_PERIOD)) {
                Pop::Item((), offer) => self.send(offer),
                Pop::TimedOut => self.notify(Control::Probe),
                Pop::Closed => break,
            }
        }
        if self.has_notices {
            let sent = vec![TopicCount { topic: self.topic.clone(), messages: self.sequence }];
            self.notify(Control::End { ticks: self.sequence, sent });
        }
    }

    fn send(&mut self, Offer { capture_nanos, encode }: Offer) {
        let began = Instant::now();
        match encode(&self.stamp(capture_nanos)) {
            Ok(bytes) => {
                self.books.timed("encode", began.elapsed());
                self.sequence += 1;
                let is_large = bytes.len() >= SMALL_BYTES;
                if self.put(bytes) {
                    self.books.delivered(&self.topic);
                    if is_large && self.is_one_at_a_time {
                        self.receipt.wait(LONGEST_MESSAGE);
                    }
                } else {
                    // The session is closed: nothing carries it.
                    self.books.withheld(&self.topic, DropReason::PeerOffline);
                }
            }
            Err(error) => {
                tracing::error!(topic = %self.topic, capture_nanos, "message cannot be sent: {error}");
                self.books.withheld(&self.topic, error.drop_reason());
            }
        }
    }

    /// Markers on the data key keep their place among the data; they are not counted.
    fn notify(&self, control: Control) {
        match wire::encode(&self.stamp(0), control) {
            Ok(encoded) => {
                self.put(payload(encoded));
            }
            Err(error) => tracing::error!(topic = %self.topic, "notice cannot be sent: {error}"),
        }
    }

    fn put(&self, bytes: ZBytes) -> bool {
        let sent = self.publisher.put(bytes).wait();
        if let Err(cause) = &sent {
            tracing::error!(topic = %self.topic, "zenoh refuses a message: {cause}");
        }
        sent.is_ok()
    }

    fn stamp(&self, capture_nanos: u64) -> Stamp {
        Stamp {
            cav: self.cav.clone(),
            epoch: self.epoch,
            sequence: self.sequence,
            capture_nanos,
            publish_nanos: unix_nanos(),
        }
    }
}

/// Whether somebody listens, kept up to date for as long as the publisher lives.
fn audience(publisher: &zenoh::pubsub::Publisher<'_>) -> zenoh::Result<Arc<AtomicBool>> {
    let audience = Arc::<AtomicBool>::default();
    let noted = Arc::clone(&audience);
    let listener = publisher.matching_listener();
    listener.callback(move |status| noted.store(status.matching(), Ordering::Relaxed)).background().wait()?;
    if publisher.matching_status().wait()?.matching() {
        audience.store(true, Ordering::Relaxed);
    }
    Ok(audience)
}

/// Head and body one after the other, without copying the body.
pub(super) fn payload(encoded: Encoded) -> ZBytes {
    let mut writer = ZBytes::writer();
    writer.append(encoded.head.into());
    if !encoded.body.is_empty() {
        writer.append(bytes::Bytes::from_owner(encoded.body).into());
    }
    writer.finish()
}

/// Now, on the Unix clock.
#[must_use]
pub fn unix_nanos() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    nanos::of(since)
}

#[cfg(test)]
mod tests {
    use protocol::{Account, Counts, Gnss, GnssSource, Pose};

    use super::*;
    use crate::{BusOptions, Endpoint, open};

    #[test]
    fn what_zenoh_refuses_is_no_longer_in_flight() {
        let session = open(&BusOptions::router(Endpoint::loopback(0))).unwrap();
        let (key, books): (Key, _) = ("v2v/test/7/gnss".parse().unwrap(), MessageStats::new("replay".parse().unwrap()));
        let cav = CavId::new("7").unwrap();
        let publisher = Publisher::new(&session, (&key, &cav), 1, &books, PublisherOptions::POSE).unwrap();
        session.close().wait().unwrap();
        let source = GnssSource::Recorded;
        let gnss = Gnss { world_from_lidar: Pose::IDENTITY, position_std_m: 0.0, heading_std_rad: 0.0, source };
        publisher.offer(5, gnss);
        publisher.finish();
        let lost = Counts { sent: 1, dropped: [(DropReason::PeerOffline, 1)].into(), ..Counts::default() };
        assert_eq!(books.ledger().get(&Account::published(key.topic)), Some(&lost));
    }
}
