//! Subscriptions: filter messages on the network's thread, and queue them for the thread that processes them.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use protocol::{
    Control, DropReason, Header, Key, KeyExpr, Kind, Limits, Payload, Stream, Topic, WireError,
    wire,
};
use support::nanos;
use support::sync::lock;
use zenoh::bytes::ZBytes;
use zenoh::sample::{Sample, SourceInfo};

use super::bounded_queue::{BoundedQueue, Pop, PushOutcome};
use super::delivery_gaps::DeliveryGaps;
use super::inbox_limits::{InboxLimits, RateLimiter};
use super::publisher::unix_nanos;
use super::replay_window::ReplayWindow;
use super::session::declare_subscriber;
use super::status_publisher::StatusPublisher;
use super::watchdog::Watchdog;
use super::{BusError, MessageStats};

/// Maximum size of a notification. Larger messages are not read to find out whether they are one.
const MAX_NOTICE_BYTES: usize = 16 << 10;

/// An item of an inbox.
#[derive(Debug)]
pub enum Event {
    /// A message with a checked header.
    Message(Arrival),
    /// The publisher of the topic has ended.
    End {
        /// Number of messages that it sent.
        sent: u64,
    },
}

impl Event {
    /// Bytes that the event holds.
    fn bytes(&self) -> usize {
        match self {
            Self::Message(arrival) => arrival.payload.len(),
            Self::End { .. } => 0,
        }
    }
}

/// A message with a valid header; the payload is checked when it is decoded.
#[derive(Debug)]
pub struct Arrival {
    /// Topic on which it was published.
    pub topic: Topic,
    /// Its header.
    pub header: Header,
    /// Arrival time.
    pub at: Instant,
    pub(super) payload: ZBytes,
}

impl Arrival {
    /// Arrival time on the system clock, nanoseconds.
    pub fn unix_nanos(&self) -> u64 {
        unix_nanos().saturating_sub(nanos::of(self.at.elapsed()))
    }

    /// Time from the publication to the arrival; what the message waits for here is no part of it.
    pub(super) fn transport(&self) -> Duration {
        let published = self.header.stamp.publish_nanos;
        Duration::from_nanos(self.unix_nanos().saturating_sub(published))
    }

    /// Bytes on the wire, without the overhead of the transport.
    pub fn wire_bytes(&self) -> u64 {
        self.payload.len() as u64
    }

    /// The message on the wire, header included, in the pieces in which it was received.
    pub fn pieces(&self) -> impl Iterator<Item = &[u8]> {
        self.payload.slices()
    }

    /// Decodes the message from its pieces, copying its tensor once.
    ///
    /// # Errors
    /// [`WireError`] as [`wire::decode`].
    pub fn decode<M: Payload>(&self, limits: &Limits) -> Result<M, WireError> {
        wire::decode(self.payload.slices(), limits).map(|(_, message)| message)
    }
}

/// Inbox of a thread: the messages of all topics that it subscribed to, in bounded lanes.
pub struct Inbox {
    /// A lane is a topic, and true for its notifications: separate from its data, which they must never replace.
    queue: BoundedQueue<(Topic, bool), Event>,
    replay_window: Mutex<ReplayWindow>,
    gaps: Mutex<DeliveryGaps>,
    pub(super) stats: MessageStats,
    meters: RateLimiter,
    max_waiting: usize,
    waiting_bytes: AtomicUsize,
    /// Watchdog of the consuming thread.
    pub(super) watchdog: Arc<Watchdog>,
}

impl Inbox {
    pub(super) fn within(
        limits: InboxLimits,
        places: usize,
        max_topics: usize,
        stats: &MessageStats,
    ) -> Arc<Self> {
        Arc::new(Self {
            // Two lanes per topic: data and notifications.
            queue: BoundedQueue::new(places, max_topics.saturating_mul(2)),
            replay_window: Mutex::default(),
            gaps: Mutex::default(),
            stats: stats.clone(),
            meters: RateLimiter::new(limits),
            max_waiting: limits.waiting_bytes,
            waiting_bytes: AtomicUsize::new(0),
            watchdog: Arc::default(),
        })
    }

    /// Bytes of the queued messages.
    pub fn waiting_bytes(&self) -> usize {
        self.waiting_bytes.load(Ordering::Relaxed)
    }

    /// The oldest event, waiting until `deadline` for one.
    pub fn take(&self, deadline: Option<Instant>) -> Pop<Topic, Event> {
        match self.watchdog.wait(|| self.queue.take(deadline)) {
            Pop::Item((topic, _), event) => {
                self.waiting_bytes
                    .fetch_sub(event.bytes(), Ordering::Relaxed);
                Pop::Item(topic, event)
            }
            Pop::TimedOut => Pop::TimedOut,
            Pop::Closed => Pop::Closed,
        }
    }

    /// Rejects further events; queued ones can still be taken.
    pub fn close(&self) {
        self.queue.close();
    }

    /// Decodes `arrival`; `None` for a malformed message, which is counted and logged.
    pub fn decode<M: Payload>(&self, arrival: &Arrival, limits: &Limits) -> Option<M> {
        arrival
            .decode(limits)
            .map_err(|error| self.stats.rejected(&arrival.topic, &error))
            .ok()
    }

    fn deliver(&self, topic: &Topic, event: Event, places: Option<usize>) {
        let is_notice = matches!(event, Event::End { .. });
        let lane = (topic.clone(), is_notice);
        // Limit on the bytes of all topics together; a message beyond it is lost.
        let bytes = event.bytes();
        // Added before the push: the consumer may take the event, and subtract its bytes, at once.
        let waiting = self.waiting_bytes.fetch_add(bytes, Ordering::Relaxed);
        if waiting.saturating_add(bytes) > self.max_waiting && !is_notice {
            self.waiting_bytes.fetch_sub(bytes, Ordering::Relaxed);
            let why = "the limit of queued bytes is reached";
            return self.stats.reject(topic, DropReason::RateLimit, why);
        }
        let lost = match self.queue.push_within(places, lane, event) {
            PushOutcome::Queued => return,
            PushOutcome::Replaced(event)
            | PushOutcome::NoLane(event)
            | PushOutcome::Closed(event) => event,
        };
        self.waiting_bytes
            .fetch_sub(lost.bytes(), Ordering::Relaxed);
        if let Event::Message(arrival) = lost {
            self.stats.dropped(&arrival.topic, DropReason::Superseded);
        }
    }
}

/// A subscription; ends when dropped.
#[must_use = "the subscription ends when this is dropped"]
pub struct Subscription {
    pub(super) _held: zenoh::pubsub::Subscriber<()>,
}

impl Subscription {
    pub(super) fn to_key(
        session: &zenoh::Session,
        key: &Key,
        (inbox, places): (&Arc<Inbox>, Option<usize>),
        status: &StatusPublisher,
    ) -> Result<Self, BusError> {
        inbox.stats.subscribed(&key.topic);
        let topic = key.topic.clone();
        let filter = IngressFilter::new(inbox, places, status);
        Self::declare(session, &key.to_string(), filter, move |_| {
            Some(topic.clone())
        })
    }

    pub(super) fn to_all(
        session: &zenoh::Session,
        selector: &KeyExpr,
        inbox: &Arc<Inbox>,
        status: &StatusPublisher,
    ) -> Result<Self, BusError> {
        Self::declare(
            session,
            selector.as_str(),
            IngressFilter::new(inbox, None, status),
            // Keys outside this grammar carry none of our messages.
            |sample| Some(sample.key_expr().as_str().parse::<Key>().ok()?.topic),
        )
    }

    fn declare(
        session: &zenoh::Session,
        key: &str,
        filter: IngressFilter,
        topic: impl Fn(&Sample) -> Option<Topic> + Send + Sync + 'static,
    ) -> Result<Self, BusError> {
        let declared = declare_subscriber(session, key, move |sample| {
            if let Some(topic) = topic(&sample) {
                filter.admit(topic, sample.payload(), sample.source_info());
            }
        });
        declared.map(|_held| Self { _held })
    }
}

/// True if notifications about a topic's publisher are sent on the topic itself: not if the topic carries notifications
/// only.
pub(super) fn has_notifications(topic: &Topic) -> bool {
    match topic {
        Topic::Stream { stream, .. } => *stream != Stream::Preview,
        Topic::Received { .. } | Topic::Truth => true,
        Topic::Control(_) | Topic::Ready(_) | Topic::Stats(_) | Topic::Alive { .. } => false,
    }
}

/// Ingress filter, run on zenoh's receive thread: reads headers only, waits for nothing and does not call zenoh.
struct IngressFilter {
    inbox: Arc<Inbox>,
    places: Option<usize>,
    status: StatusPublisher,
}

impl IngressFilter {
    fn new(inbox: &Arc<Inbox>, places: Option<usize>, status: &StatusPublisher) -> Self {
        Self {
            inbox: Arc::clone(inbox),
            places,
            status: status.clone(),
        }
    }

    fn admit(&self, topic: Topic, payload: &ZBytes, source: Option<&SourceInfo>) {
        // First: messages that are refused below have numbers too, and must not look like gaps.
        self.count_gap(&topic, payload, source);
        // Before the message is read: a flood must cost next to nothing.
        let meters = &self.inbox.meters;
        if !meters.admit(&topic, payload.len(), Instant::now()) {
            return self.reject(&topic, payload);
        }
        let header = match header_of(&topic, payload) {
            Ok(header) => header,
            Err(error) => return self.refuse(&topic, &error),
        };
        if is_notice(&topic, &header) {
            return self.note(&topic, payload);
        }
        let at = Instant::now();
        if has_notifications(&topic) {
            self.inbox.stats.arrived(&topic);
            self.status.confirm_route(&topic);
            if let Some(reason) = self.reject_stale(&topic, &header, at) {
                return self.inbox.stats.dropped(&topic, reason);
            }
        }
        let arrival = Arrival {
            topic: topic.clone(),
            header,
            at,
            payload: payload.clone(),
        };
        self.inbox
            .deliver(&topic, Event::Message(arrival), self.places);
    }

    /// Counts the messages that the router has dropped before this one.
    fn count_gap(&self, topic: &Topic, payload: &ZBytes, source: Option<&SourceInfo>) {
        if !has_notifications(topic) || source.is_none() {
            return;
        }
        // A notification has the number of the message after it, so its kind has to be known here.
        let is_notice = payload.len() <= MAX_NOTICE_BYTES
            && header_of(topic, payload).is_ok_and(|header| is_notice(topic, &header));
        let skipped = lock(&self.inbox.gaps).note(topic, source, is_notice);
        if skipped > 0 {
            self.inbox.stats.undelivered(topic, skipped);
        }
    }

    /// Rejects a message above the rate limit. Its header decides whether the sender has counted it.
    fn reject(&self, topic: &Topic, payload: &ZBytes) {
        const WHY: &str = "above the rate limit of its sender";
        let (stats, reason) = (&self.inbox.stats, DropReason::RateLimit);
        if header_of(topic, payload).is_ok_and(|header| is_notice(topic, &header)) {
            // Not counted, as no sender counts its own notifications.
            return stats.warn_rejected(topic, reason, WHY);
        }
        stats.arrived(topic);
        stats.reject(topic, reason, WHY);
    }

    fn refuse(&self, topic: &Topic, error: &WireError) {
        self.inbox.stats.arrived(topic);
        self.inbox.stats.rejected(topic, error);
    }

    fn note(&self, topic: &Topic, payload: &ZBytes) {
        match wire::decode(payload.slices(), &Limits::DEFAULT) {
            Ok((_, Control::Probe)) => self.status.probed(topic),
            Ok((_, Control::End { ticks: sent, .. })) => {
                self.inbox.deliver(topic, Event::End { sent }, None);
            }
            Ok(_) => {}
            Err(error) => self.refuse(topic, &error),
        }
    }

    /// Drop reason of a duplicate or stale message, or of one under quarantine.
    fn reject_stale(&self, topic: &Topic, header: &Header, at: Instant) -> Option<DropReason> {
        let stamp = &header.stamp;
        let window = &self.inbox.replay_window;
        let admission = lock(window).admit(topic, stamp.epoch, stamp.sequence, at);
        if let Some(is_twice) = admission.quarantine {
            let text = format!("two senders use {topic}: both are rejected");
            let problem = is_twice.then(|| (text.clone(), at));
            self.inbox.stats.set_problems(&text, problem);
        }
        // Under quarantine two senders, each with a clock of its own, use the id.
        if admission.dropped.is_none() {
            self.inbox
                .stats
                .observe_clock(&stamp.cav, stamp.publish_nanos, unix_nanos(), at);
        }
        admission.dropped
    }
}

/// The header of a message on `topic`, if it is allowed there.
fn header_of(topic: &Topic, payload: &ZBytes) -> Result<Header, WireError> {
    let header = wire::decode_header(payload.slices())?;
    if let Topic::Stream { cav, .. } | Topic::Received { cav, .. } = topic {
        header.check_sender(cav)?;
    }
    // Probes and end notifications are of kind control on the keys of data.
    if let Some(expected) = topic.kind().filter(|_| header.kind != Kind::Control) {
        header.check_kind(expected)?;
    }
    Ok(header)
}

/// True if a message is a notification about its publisher, which is not counted.
fn is_notice(topic: &Topic, header: &Header) -> bool {
    header.kind == Kind::Control && has_notifications(topic)
}

#[cfg(test)]
mod tests {
    use protocol::{Account, CavId, Counts, Gnss, GnssSource, Pose, Stamp};

    use super::super::publisher::payload;
    use super::*;

    fn bytes<M: Payload>(sequence: u64, message: M) -> ZBytes {
        let cav = CavId::new("7").unwrap();
        let stamp = Stamp {
            cav,
            epoch: 1,
            sequence,
            capture_nanos: sequence,
            publish_nanos: 5,
        };
        payload(wire::encode(&stamp, message).unwrap())
    }

    fn gnss() -> Gnss {
        let source = GnssSource::Recorded;
        Gnss {
            world_from_lidar: Pose::IDENTITY,
            position_std_m: 0.0,
            heading_std_rad: 0.0,
            source,
        }
    }

    #[test]
    fn transport_ends_at_the_arrival_and_not_where_the_message_is_used() {
        let topic = "7/gnss".parse::<Topic>().unwrap();
        let payload = bytes(0, gnss());
        let mut header = header_of(&topic, &payload).unwrap();
        header.stamp.publish_nanos = unix_nanos() - 60_000_000_000;
        let arrival = Arrival {
            topic,
            header,
            at: Instant::now() - Duration::from_secs(50),
            payload,
        };
        let transport_s = arrival.transport().as_secs_f64();
        assert!((9.9..30.0).contains(&transport_s), "{transport_s} s");
    }

    #[test]
    fn only_data_beyond_the_limit_are_counted() {
        let stats = MessageStats::new("ego-9".parse().unwrap());
        let limits = InboxLimits {
            messages_per_s: 1e-3,
            ..InboxLimits::PEERS
        };
        let (inbox, topic) = (
            Inbox::within(limits, 4, 4, &stats),
            "7/gnss".parse::<Topic>().unwrap(),
        );
        let filter = IngressFilter::new(&inbox, None, &StatusPublisher::new());
        let account = Account::towards(topic.clone(), stats.process());
        stats.subscribed(&topic);
        for _ in 0..3 {
            filter.admit(topic.clone(), &bytes(0, Control::Probe), None);
            filter.admit(
                topic.clone(),
                &bytes(
                    0,
                    Control::End {
                        ticks: 0,
                        sent: Vec::new(),
                    },
                ),
                None,
            );
        }
        assert_eq!(stats.ledger().get(&account), Some(&Counts::default()));
        filter.admit(topic.clone(), &bytes(0, gnss()), None);
        let refused = Counts {
            dropped: [(DropReason::RateLimit, 1)].into(),
            ..Counts::default()
        };
        assert_eq!(stats.ledger().get(&account), Some(&refused));
    }
}
