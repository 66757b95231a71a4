//! Listening in on a whole run without a part in it: for recorders and viewers.
//!
//! What a tap hears is in nobody's books, so that it may come late, leave early and overwrite what it has no time for
//! without a message seeming lost; it keeps its own count of that.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::Instant;

use protocol::{Control, Key, KeyExpr, Kind, Limits, Stream, Topic, wire};
use zenoh::Wait;
use zenoh::bytes::ZBytes;
use zenoh::sample::Sample;

use super::bounded_queue::{BoundedQueue, Pop, PushOutcome};
use super::status_publisher::StatusPublisher;
use super::subscriber::has_notices;
use super::{BusError, unix_nanos};

/// Topics that a tap keeps apart at most: more than a run of 65 vehicles has.
const MAX_TOPICS: usize = 1024;
/// Bytes that may wait in a tap, whatever their keys: a disk that stands still must not take the memory of the run.
const MAX_WAITING: usize = 512 << 20;

/// A message as it came by, unchecked but for its key.
#[derive(Debug)]
pub struct RawMessage {
    /// Its key.
    pub key: Key,
    /// When it came, nanoseconds on the Unix clock.
    pub arrived_nanos: u64,
    payload: ZBytes,
}

impl RawMessage {
    /// The bytes, in the pieces they came in.
    #[must_use]
    pub fn pieces(&self) -> Vec<&[u8]> {
        self.payload.slices().collect()
    }

    /// The bytes in one piece; copies them where they came in several.
    #[must_use]
    pub fn bytes(&self) -> std::borrow::Cow<'_, [u8]> {
        self.payload.to_bytes()
    }

    /// How many bytes there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.payload.len()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.payload.is_empty()
    }
}

/// Everything on the keys of some selectors, in bounded lanes, one per key, in which the newest wins.
pub struct PassiveSubscriber {
    shared: Arc<Shared>,
    _subscribers: Vec<zenoh::pubsub::Subscriber<()>>,
}

struct Shared {
    mailbox: BoundedQueue<Topic, RawMessage>,
    waiting_bytes: AtomicUsize,
    overwritten: AtomicU64,
}

impl PassiveSubscriber {
    /// Listens to `selectors`; of each key `places` messages may wait. With `notices` probes are answered, so that a
    /// barrier can wait for the tap.
    pub(super) fn open(
        session: &zenoh::Session,
        selectors: &[KeyExpr],
        places: usize,
        notices: &StatusPublisher,
    ) -> Result<Self, BusError> {
        let shared = Arc::new(Shared {
            mailbox: BoundedQueue::new(places, MAX_TOPICS),
            waiting_bytes: AtomicUsize::new(0),
            overwritten: AtomicU64::new(0),
        });
        let subscribe = |selector: &KeyExpr| {
            let (shared, notices) = (Arc::clone(&shared), notices.clone());
            let subscriber = session.declare_subscriber(selector.as_str());
            let subscriber = subscriber.callback(move |sample| shared.admit(&sample, &notices)).wait();
            subscriber.map_err(|cause| BusError::zenoh(format!("listening to {}", selector.as_str()), &cause))
        };
        let subscribers = selectors.iter().map(subscribe).collect::<Result<_, _>>()?;
        Ok(Self { shared, _subscribers: subscribers })
    }

    /// The message that has waited longest, waiting until `deadline` for one.
    pub fn take(&self, deadline: Option<Instant>) -> Pop<Topic, RawMessage> {
        let taken = self.shared.mailbox.take(deadline);
        if let Pop::Item(_, overheard) = &taken {
            self.shared.waiting_bytes.fetch_sub(overheard.len(), Ordering::Relaxed);
        }
        taken
    }

    /// Messages that newer ones of the same key have taken the place of, or for which there was no room.
    #[must_use]
    pub fn overwritten(&self) -> u64 {
        self.shared.overwritten.load(Ordering::Relaxed)
    }

    /// A function that makes the tap take no more; what is inside can still be taken.
    pub fn closer(&self) -> impl FnOnce() + Send + 'static {
        let shared = Arc::clone(&self.shared);
        move || shared.mailbox.close()
    }
}

impl Shared {
    /// RunScope on zenoh's receive thread: looks at headers only and waits for nothing.
    fn admit(&self, sample: &Sample, notices: &StatusPublisher) {
        let Ok(key) = sample.key_expr().as_str().parse::<Key>() else { return };
        if has_notices(&key.topic) && !is_json(&key.topic) {
            match wire::decode_header(sample.payload().slices()) {
                Ok(header) if header.kind == Kind::Control => return note(&key.topic, sample, notices),
                Ok(_) => notices.heard(&key.topic),
                // Not ours to judge: whoever the message is for counts it.
                Err(_) => {}
            }
        }
        self.keep(RawMessage { key, arrived_nanos: unix_nanos(), payload: sample.payload().clone() });
    }

    fn keep(&self, overheard: RawMessage) {
        let len = overheard.len();
        let waiting = self.waiting_bytes.fetch_add(len, Ordering::Relaxed);
        let lost = if waiting + len > MAX_WAITING {
            Some(len)
        } else {
            match self.mailbox.push(overheard.key.topic.clone(), overheard) {
                PushOutcome::Queued => None,
                PushOutcome::Replaced(lost) | PushOutcome::NoLane(lost) | PushOutcome::Closed(lost) => Some(lost.len()),
            }
        };
        if let Some(len) = lost {
            self.waiting_bytes.fetch_sub(len, Ordering::Relaxed);
            self.overwritten.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// Probes and ends are about the route, not of the run.
fn note(topic: &Topic, sample: &Sample, notices: &StatusPublisher) {
    if let Ok((_, Control::Probe)) = wire::decode(sample.payload().slices(), &Limits::DEFAULT) {
        notices.probed(topic);
    }
}

fn is_json(topic: &Topic) -> bool {
    matches!(topic, Topic::Stream { stream: Stream::DetectionsJson, .. })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tap(places: usize) -> PassiveSubscriber {
        let shared = Shared {
            mailbox: BoundedQueue::new(places, MAX_TOPICS),
            waiting_bytes: AtomicUsize::new(0),
            overwritten: AtomicU64::new(0),
        };
        PassiveSubscriber { shared: Arc::new(shared), _subscribers: Vec::new() }
    }

    fn overheard(vehicle: usize, payload: &ZBytes) -> RawMessage {
        let key = format!("v2v/test/{vehicle}/lidar").parse().unwrap();
        RawMessage { key, arrived_nanos: 0, payload: payload.clone() }
    }

    #[test]
    fn what_waits_is_bounded_in_number_and_in_bytes() {
        let tap = tap(2);
        let payload = ZBytes::from(vec![0_u8; 64 << 20]);
        (0..3).for_each(|_| tap.shared.keep(overheard(0, &payload)));
        assert_eq!(tap.overwritten(), 1, "two places for a key");
        (1..10).for_each(|vehicle| tap.shared.keep(overheard(vehicle, &payload)));
        assert_eq!(tap.overwritten(), 1 + 3, "eight of them fill the tap");
        let at_once = Some(Instant::now());
        assert_eq!((0..9).filter(|_| matches!(tap.take(at_once), Pop::Item(..))).count(), 8);
        assert_eq!(tap.shared.waiting_bytes.load(Ordering::Relaxed), 0);
        tap.shared.keep(overheard(9, &payload));
        assert_eq!(tap.overwritten(), 4, "there is room again");
    }
}
