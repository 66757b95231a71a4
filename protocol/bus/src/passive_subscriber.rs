//! Passive subscriber: captures all messages of a run for recorders and viewers.
//!
//! Captured messages are outside the message accounting, so that a passive subscriber may join late, leave early and
//! overwrite messages without loss in the ledgers; it counts overwritten messages itself.

use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use protocol::{Control, Key, KeyExpr, Kind, Limits, Topic, wire};
use zenoh::bytes::ZBytes;
use zenoh::sample::Sample;

use support::sync::lock;

use super::bounded_queue::{BoundedQueue, Pop, PushOutcome};
use super::delivery_gaps::DeliveryGaps;
use super::session::declare_subscriber;
use super::status_publisher::StatusPublisher;
use super::subscriber::has_notifications;
use super::{BusError, unix_nanos};

/// Maximum number of topics with a queue of their own: more than a run of 65 vehicles has.
const MAX_TOPICS: usize = 1024;
/// Maximum bytes waiting, over all keys: a stalled disk must not use up the memory of the run.
const MAX_WAITING: usize = 512 << 20;

/// A captured message, unchecked except for its key.
#[derive(Debug)]
pub struct RawMessage {
    /// Its key.
    pub key: Key,
    /// Arrival time, nanoseconds on the Unix clock.
    pub arrived_nanos: u64,
    payload: ZBytes,
}

impl RawMessage {
    /// The bytes, in the pieces in which they arrived.
    pub fn pieces(&self) -> Vec<&[u8]> {
        self.payload.slices().collect()
    }

    /// The bytes in one piece; copied if they arrived in several.
    pub fn bytes(&self) -> std::borrow::Cow<'_, [u8]> {
        self.payload.to_bytes()
    }
}

/// All messages on the keys of some selectors, in bounded queues, one per key, that keep the newest.
pub struct PassiveSubscriber {
    shared: Arc<Shared>,
    _subscribers: Vec<zenoh::pubsub::Subscriber<()>>,
}

struct Shared {
    queue: BoundedQueue<Topic, RawMessage>,
    waiting_bytes: AtomicUsize,
    overwritten: AtomicU64,
    gaps: Mutex<DeliveryGaps>,
    undelivered: AtomicU64,
}

impl PassiveSubscriber {
    /// Subscribes to `selectors`; at most `places` messages of each key are queued. With `status` probes are answered,
    /// so that a barrier can wait for this subscriber.
    pub(super) fn open(
        session: &zenoh::Session,
        selectors: &[KeyExpr],
        places: usize,
        status: &StatusPublisher,
    ) -> Result<Self, BusError> {
        let shared = Arc::new(Shared {
            queue: BoundedQueue::new(places, MAX_TOPICS),
            waiting_bytes: AtomicUsize::new(0),
            overwritten: AtomicU64::new(0),
            gaps: Mutex::default(),
            undelivered: AtomicU64::new(0),
        });
        let subscribers = selectors.iter().map(|selector| {
            let (shared, status) = (Arc::clone(&shared), status.clone());
            declare_subscriber(session, selector.as_str(), move |sample| {
                shared.admit(&sample, &status);
            })
        });
        let subscribers = subscribers.collect::<Result<_, _>>()?;
        Ok(Self {
            shared,
            _subscribers: subscribers,
        })
    }

    /// The oldest message, waiting until `deadline` for one.
    pub fn take(&self, deadline: Option<Instant>) -> Pop<Topic, RawMessage> {
        let taken = self.shared.queue.take(deadline);
        if let Pop::Item(_, raw_message) = &taken {
            let waiting = &self.shared.waiting_bytes;
            waiting.fetch_sub(raw_message.payload.len(), Ordering::Relaxed);
        }
        taken
    }

    /// Number of messages that were replaced by newer ones of the same key, or for which there was no room.
    pub fn overwritten(&self) -> u64 {
        self.shared.overwritten.load(Ordering::Relaxed)
    }

    /// Number of messages that the router has not handed on, because this subscriber took earlier ones too slowly.
    pub fn undelivered(&self) -> u64 {
        self.shared.undelivered.load(Ordering::Relaxed)
    }

    /// A function that stops capturing; queued messages can still be taken.
    pub fn closer(&self) -> impl FnOnce() + Send + 'static {
        let shared = Arc::clone(&self.shared);
        move || shared.queue.close()
    }
}

impl Shared {
    /// Runs on zenoh's receive thread: reads headers only and waits for nothing.
    fn admit(&self, sample: &Sample, status: &StatusPublisher) {
        let Ok(key) = sample.key_expr().as_str().parse::<Key>() else {
            return;
        };
        if has_notifications(&key.topic) && !key.topic.is_json() {
            let header = wire::decode_header(sample.payload().slices());
            let is_notice = header
                .as_ref()
                .is_ok_and(|header| header.kind == Kind::Control);
            let skipped = lock(&self.gaps).note(&key.topic, sample.source_info(), is_notice);
            self.undelivered
                .fetch_add(u64::from(skipped), Ordering::Relaxed);
            match header {
                Ok(_) if is_notice => return note(&key.topic, sample, status),
                Ok(_) => status.confirm_route(&key.topic),
                // Not counted here: the receiver of the message counts it.
                Err(_) => {}
            }
        }
        self.keep(RawMessage {
            key,
            arrived_nanos: unix_nanos(),
            payload: sample.payload().clone(),
        });
    }

    fn keep(&self, raw_message: RawMessage) {
        let len = raw_message.payload.len();
        // Added before the push: the consumer may take the message, and subtract its bytes, at once.
        let waiting = self.waiting_bytes.fetch_add(len, Ordering::Relaxed);
        let (left_out, is_lost) = if waiting + len > MAX_WAITING {
            (len, true)
        } else {
            match self.queue.push(raw_message.key.topic.clone(), raw_message) {
                PushOutcome::Queued => return,
                PushOutcome::Replaced(lost) | PushOutcome::NoLane(lost) => {
                    (lost.payload.len(), true)
                }
                // Sent after the end of the capture, such as the last reports of other processes.
                PushOutcome::Closed(late) => (late.payload.len(), false),
            }
        };
        self.waiting_bytes.fetch_sub(left_out, Ordering::Relaxed);
        self.overwritten
            .fetch_add(u64::from(is_lost), Ordering::Relaxed);
    }
}

/// Probes and end notifications concern the route and are not recorded.
fn note(topic: &Topic, sample: &Sample, status: &StatusPublisher) {
    if let Ok((_, Control::Probe)) = wire::decode(sample.payload().slices(), &Limits::DEFAULT) {
        status.probed(topic);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn passive(places: usize) -> PassiveSubscriber {
        let shared = Shared {
            queue: BoundedQueue::new(places, MAX_TOPICS),
            waiting_bytes: AtomicUsize::new(0),
            overwritten: AtomicU64::new(0),
            gaps: Mutex::default(),
            undelivered: AtomicU64::new(0),
        };
        PassiveSubscriber {
            shared: Arc::new(shared),
            _subscribers: Vec::new(),
        }
    }

    fn raw_message(vehicle: usize, payload: &ZBytes) -> RawMessage {
        let key = format!("v2v/test/{vehicle}/lidar").parse().unwrap();
        RawMessage {
            key,
            arrived_nanos: 0,
            payload: payload.clone(),
        }
    }

    #[test]
    fn the_queue_is_bounded_in_messages_and_bytes() {
        let passive = passive(2);
        let payload = ZBytes::from(vec![0_u8; 64 << 20]);
        (0..3).for_each(|_| passive.shared.keep(raw_message(0, &payload)));
        assert_eq!(passive.overwritten(), 1, "two places for a key");
        (1..10).for_each(|vehicle| passive.shared.keep(raw_message(vehicle, &payload)));
        assert_eq!(passive.overwritten(), 1 + 3, "eight of them fill the queue");
        let at_once = Some(Instant::now());
        assert_eq!(
            (0..9)
                .filter(|_| matches!(passive.take(at_once), Pop::Item(..)))
                .count(),
            8
        );
        assert_eq!(passive.shared.waiting_bytes.load(Ordering::Relaxed), 0);
        passive.shared.keep(raw_message(9, &payload));
        assert_eq!(passive.overwritten(), 4, "there is room again");
        passive.closer()();
        passive.shared.keep(raw_message(10, &payload));
        assert_eq!(passive.overwritten(), 4, "after the end of the capture");
    }
}
