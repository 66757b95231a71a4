//! Taking messages off the network's hands at once, and handing them to the thread that works on them.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use protocol::{Control, DropReason, Header, Key, KeyExpr, Kind, Limits, Payload, Stream, Topic, WireError, wire};
use zenoh::Wait;
use zenoh::bytes::ZBytes;
use zenoh::sample::Sample;

use super::bounded_queue::{BoundedQueue, Pop, PushOutcome};
use super::inbox_limits::{InboxLimits, RateLimiter};
use super::publisher::unix_nanos;
use super::replay_window::{Admission, ReplayWindow};
use super::status_publisher::StatusPublisher;
use super::watchdog::Watchdog;
use super::{BusError, MessageStats};

/// Where a message waits: data and notices of one topic apart, so that a notice never takes the place of data.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Lane {
    topic: Topic,
    is_notice: bool,
}

/// What came in.
#[derive(Debug)]
pub enum Event {
    /// A message, its header checked.
    Message(Arrival),
    /// The publisher of `topic` has ended.
    End {
        /// Its topic.
        topic: Topic,
        /// Its epoch.
        epoch: u64,
        /// Messages it sent.
        sent: u64,
    },
}

impl Event {
    /// Bytes that it holds on to.
    fn bytes(&self) -> usize {
        match self {
            Self::Message(arrival) => arrival.payload.len(),
            Self::End { .. } => 0,
        }
    }
}

/// A message whose header is sound; whether the rest is, decoding tells.
#[derive(Debug)]
pub struct Arrival {
    /// Where it was published.
    pub topic: Topic,
    /// Its header.
    pub header: Header,
    /// When it arrived.
    pub at: Instant,
    payload: ZBytes,
}

impl Arrival {
    /// Bytes on the wire, without what the transport adds.
    #[must_use]
    pub fn wire_bytes(&self) -> u64 {
        self.payload.len() as u64
    }

    pub(super) fn payload(&self) -> &ZBytes {
        &self.payload
    }

    /// Decodes the message from the pieces it arrived in, copying its tensor once.
    ///
    /// # Errors
    /// [`WireError`] as [`wire::decode`].
    pub fn decode<M: Payload>(&self, limits: &Limits) -> Result<M, WireError> {
        wire::decode(self.payload.slices(), limits).map(|(_, message)| message)
    }
}

/// What a thread works on: the messages of all topics it subscribed to, in bounded lanes.
pub struct Inbox {
    mailbox: BoundedQueue<Lane, Event>,
    freshness: Mutex<ReplayWindow>,
    books: MessageStats,
    meters: RateLimiter,
    max_waiting: usize,
    waiting_bytes: AtomicUsize,
    pulse: Arc<Watchdog>,
}

impl Inbox {
    pub(super) fn new(places: usize, max_topics: usize, books: &MessageStats) -> Arc<Self> {
        Self::within(InboxLimits::NONE, places, max_topics, books)
    }

    pub(super) fn within(limits: InboxLimits, places: usize, max_topics: usize, books: &MessageStats) -> Arc<Self> {
        Arc::new(Self {
            // Two lanes a topic: data and notices.
            mailbox: BoundedQueue::new(places, max_topics.saturating_mul(2)),
            freshness: Mutex::default(),
            books: books.clone(),
            meters: RateLimiter::new(limits),
            max_waiting: limits.waiting_bytes,
            waiting_bytes: AtomicUsize::new(0),
            pulse: Arc::default(),
        })
    }

    /// Bytes of the messages that wait.
    #[must_use]
    pub fn waiting_bytes(&self) -> usize {
        self.waiting_bytes.load(Ordering::Relaxed)
    }

    /// The oldest event, waiting until `deadline` for one.
    pub fn take(&self, deadline: Option<Instant>) -> Pop<Topic, Event> {
        match self.pulse.wait(|| self.mailbox.take(deadline)) {
            Pop::Item(lane, event) => {
                self.waiting_bytes.fetch_sub(event.bytes(), Ordering::Relaxed);
                Pop::Item(lane.topic, event)
            }
            Pop::TimedOut => Pop::TimedOut,
            Pop::Closed => Pop::Closed,
        }
    }

    /// Of the thread that takes.
    pub(super) fn pulse(&self) -> &Arc<Watchdog> {
        &self.pulse
    }

    /// Takes no more; what is inside can still be taken.
    pub fn close(&self) {
        self.mailbox.close();
    }

    /// Decodes `arrival`; an unsound one is counted, logged and answered with `None`.
    pub fn decode<M: Payload>(&self, arrival: &Arrival, limits: &Limits) -> Option<M> {
        arrival.decode(limits).map_err(|error| self.books.rejected(&arrival.topic, &error)).ok()
    }

    /// `topic` brought what is not its sender's to say: counted and logged.
    pub(super) fn reject_invalid(&self, topic: &Topic, why: &'static str) {
        self.books.reject_invalid(topic, why);
    }

    fn deliver(&self, topic: &Topic, event: Event, places: Option<usize>) {
        let is_notice = matches!(event, Event::End { .. });
        let lane = Lane { topic: topic.clone(), is_notice };
        // A bound on what all topics hold together; a message that finds it reached is lost, and so is room for it.
        let bytes = event.bytes();
        let waiting = self.waiting_bytes.fetch_add(bytes, Ordering::Relaxed).saturating_add(bytes);
        if waiting > self.max_waiting && !is_notice {
            self.waiting_bytes.fetch_sub(bytes, Ordering::Relaxed);
            return self.books.limited(topic, "too much waits here already");
        }
        let pushed = match places {
            Some(places) => self.mailbox.push_within(places, lane, event),
            None => self.mailbox.push(lane, event),
        };
        let lost = match pushed {
            PushOutcome::Queued => return,
            PushOutcome::Replaced(event) | PushOutcome::NoLane(event) | PushOutcome::Closed(event) => event,
        };
        self.waiting_bytes.fetch_sub(lost.bytes(), Ordering::Relaxed);
        if let Event::Message(arrival) = lost {
            self.books.dropped(&arrival.topic, DropReason::Superseded);
        }
    }
}

/// A subscription; ends when dropped.
#[must_use = "the subscription ends when this is dropped"]
pub struct Subscription(#[expect(dead_code, reason = "held for its lifetime only")] zenoh::pubsub::Subscriber<()>);

impl Subscription {
    pub(super) fn to_key(
        session: &zenoh::Session,
        key: &Key,
        (inbox, places): (&Arc<Inbox>, Option<usize>),
        notices: &StatusPublisher,
    ) -> Result<Self, BusError> {
        inbox.books.subscribed(&key.topic);
        let topic = key.topic.clone();
        Self::declare(session, &key.to_string(), IngressFilter::new(inbox, places, notices), move |_| {
            Some(topic.clone())
        })
    }

    pub(super) fn to_all(
        session: &zenoh::Session,
        selector: &KeyExpr,
        inbox: &Arc<Inbox>,
        notices: &StatusPublisher,
    ) -> Result<Self, BusError> {
        // A key that is none of ours tells of no message of ours either.
        let topic = |sample: &Sample| sample.key_expr().as_str().parse::<Key>().ok().map(|key| key.topic);
        Self::declare(session, selector.as_str(), IngressFilter::new(inbox, None, notices), topic)
    }

    fn declare(
        session: &zenoh::Session,
        key: &str,
        door: IngressFilter,
        topic: impl Fn(&Sample) -> Option<Topic> + Send + Sync + 'static,
    ) -> Result<Self, BusError> {
        let subscriber = session.declare_subscriber(key).callback(move |sample| {
            if let Some(topic) = topic(&sample) {
                door.admit(topic, sample.payload());
            }
        });
        subscriber.wait().map(Self).map_err(|cause| BusError::zenoh(format!("subscribing to {key}"), &cause))
    }
}

/// Whether notices about a topic's publisher travel on it too: not where notices are all there is.
pub(super) fn has_notices(topic: &Topic) -> bool {
    match topic {
        Topic::Stream { stream: Stream::Preview, .. } => false,
        Topic::Stream { .. } | Topic::Received { .. } | Topic::Truth => true,
        Topic::Control(_) | Topic::Ready(_) | Topic::Stats(_) | Topic::Alive { .. } => false,
    }
}

/// The callback's side: runs on zenoh's receive thread, so it looks at headers only, waits for nothing and calls no
/// zenoh.
struct IngressFilter {
    inbox: Arc<Inbox>,
    places: Option<usize>,
    notices: StatusPublisher,
}

impl IngressFilter {
    fn new(inbox: &Arc<Inbox>, places: Option<usize>, notices: &StatusPublisher) -> Self {
        Self { inbox: Arc::clone(inbox), places, notices: notices.clone() }
    }

    fn admit(&self, topic: Topic, payload: &ZBytes) {
        // Before anything of it is looked at: a flood must cost next to nothing.
        if !self.inbox.meters.admit(&topic, payload.len(), Instant::now()) {
            return self.reject(&topic, payload);
        }
        let header = match header_of(&topic, payload) {
            Ok(header) => header,
            Err(error) => return self.refuse(&topic, &error),
        };
        if is_notice(&topic, &header) {
            return self.note(topic, &header, payload);
        }
        let at = Instant::now();
        if has_notices(&topic) {
            self.inbox.books.arrived(&topic);
            self.notices.heard(&topic);
            if let Some(reason) = self.reject_stale(&topic, &header, at) {
                return self.inbox.books.dropped(&topic, reason);
            }
        }
        let arrival = Arrival { topic: topic.clone(), header, at, payload: payload.clone() };
        self.inbox.deliver(&topic, Event::Message(arrival), self.places);
    }

    /// More than the sender may send. The header alone says whether that is in the sender's books.
    fn reject(&self, topic: &Topic, payload: &ZBytes) {
        const WHY: &str = "more than its sender may send in that time";
        if header_of(topic, payload).is_ok_and(|header| is_notice(topic, &header)) {
            return self.inbox.books.limited_notice(topic, WHY);
        }
        self.inbox.books.arrived(topic);
        self.inbox.books.limited(topic, WHY);
    }

    fn refuse(&self, topic: &Topic, error: &WireError) {
        self.inbox.books.arrived(topic);
        self.inbox.books.rejected(topic, error);
    }

    fn note(&self, topic: Topic, header: &Header, payload: &ZBytes) {
        match wire::decode(payload.slices(), &Limits::DEFAULT) {
            Ok((_, Control::Probe)) => self.notices.probed(&topic),
            Ok((_, Control::End { ticks: sent, .. })) => {
                let end = Event::End { topic: topic.clone(), epoch: header.stamp.epoch, sent };
                self.inbox.deliver(&topic, end, None);
            }
            Ok(_) => {}
            Err(error) => self.refuse(&topic, &error),
        }
    }

    /// Why a message is not to be used, where it is not news.
    fn reject_stale(&self, topic: &Topic, header: &Header, at: Instant) -> Option<DropReason> {
        let stamp = &header.stamp;
        let Admission { dropped, quarantine } = {
            let mut freshness = self.inbox.freshness.lock().unwrap_or_else(PoisonError::into_inner);
            freshness.admit(topic, stamp.epoch, stamp.sequence, at)
        };
        match quarantine {
            Some(true) => {
                tracing::warn!(%topic, "two senders speak under one name: neither is heard until one is silent")
            }
            Some(false) => tracing::info!(%topic, "one sender is left under this name: it is heard again"),
            None => {}
        }
        if dropped.is_none() {
            self.inbox.books.heard_clock(&stamp.cav, stamp.publish_nanos, unix_nanos(), at);
        }
        dropped
    }
}

/// The header of a message on `topic`, if it is one that may come there.
fn header_of(topic: &Topic, payload: &ZBytes) -> Result<Header, WireError> {
    wire::decode_header(payload.slices()).and_then(|header| check(topic, header))
}

/// Whether a message is about its publisher, and so in nobody's books.
fn is_notice(topic: &Topic, header: &Header) -> bool {
    header.kind == Kind::Control && has_notices(topic)
}

/// Who may speak on `topic`, and of what.
fn check(topic: &Topic, header: Header) -> Result<Header, WireError> {
    let expected = match topic {
        Topic::Stream { cav, stream } | Topic::Received { cav, stream, .. } => {
            header.check_sender(cav)?;
            stream.kind()
        }
        Topic::Truth => Some(Kind::Truth),
        Topic::Control(_) | Topic::Ready(_) => Some(Kind::Control),
        Topic::Stats(_) => Some(Kind::Stats),
        Topic::Alive { .. } => None,
    };
    match expected {
        Some(expected) if header.kind != expected && header.kind != Kind::Control => {
            Err(WireError::Kind { expected, found: header.kind })
        }
        _ => Ok(header),
    }
}

#[cfg(test)]
mod tests {
    use protocol::{Account, CavId, Counts, Gnss, GnssSource, Pose, Stamp};

    use super::super::publisher::payload;
    use super::*;

    fn bytes<M: Payload>(sequence: u64, message: M) -> ZBytes {
        let cav = CavId::new("7").unwrap();
        let stamp = Stamp { cav, epoch: 1, sequence, capture_nanos: sequence, publish_nanos: 5 };
        payload(wire::encode(&stamp, message).unwrap())
    }

    fn gnss() -> Gnss {
        let source = GnssSource::Recorded;
        Gnss { world_from_lidar: Pose::IDENTITY, position_std_m: 0.0, heading_std_rad: 0.0, source }
    }

    #[test]
    fn of_what_is_beyond_the_limit_only_data_are_booked() {
        let books = MessageStats::new("ego-9".parse().unwrap());
        let limits = InboxLimits { messages_per_s: 1e-3, ..InboxLimits::PEERS };
        let (inbox, topic) = (Inbox::within(limits, 4, 4, &books), "7/gnss".parse::<Topic>().unwrap());
        let door = IngressFilter::new(&inbox, None, &StatusPublisher::new());
        let counts = || books.ledger().get(&Account::towards(topic.clone(), books.process())).cloned();
        books.subscribed(&topic);
        for _ in 0..3 {
            door.admit(topic.clone(), &bytes(0, Control::Probe));
            door.admit(topic.clone(), &bytes(0, Control::End { ticks: 0, sent: Vec::new() }));
        }
        assert_eq!(counts(), Some(Counts::default()));
        door.admit(topic.clone(), &bytes(0, gnss()));
        assert_eq!(counts(), Some(Counts { dropped: [(DropReason::RateLimit, 1)].into(), ..Counts::default() }));
    }
}
