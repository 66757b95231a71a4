//! Listening in on a whole run without a part in it: for recorders and viewers.
//!
//! What a tap hears is in nobody's books, so that it may come late, leave early and overwrite what it has no time for
//! without a message seeming lost; it keeps its own count of that.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use protocol::{Control, Key, Kind, Limits, Selector, Stream, Topic, wire};
use zenoh::Wait;
use zenoh::bytes::ZBytes;
use zenoh::sample::Sample;

use super::mailbox::{Mailbox, Pushed, Taken};
use super::notices::Notices;
use super::subscriber::has_notices;
use super::{BusError, unix_nanos};

/// Topics that a tap keeps apart at most: more than a run of 65 vehicles has.
const MAX_TOPICS: usize = 1024;

/// A message as it came by, unchecked but for its key.
#[derive(Debug)]
pub struct Overheard {
    /// Its key.
    pub key: Key,
    /// When it came, nanoseconds on the Unix clock.
    pub arrived_nanos: u64,
    payload: ZBytes,
}

impl Overheard {
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
pub struct Tap {
    shared: Arc<Shared>,
    _subscribers: Vec<zenoh::pubsub::Subscriber<()>>,
}

struct Shared {
    mailbox: Mailbox<Topic, Overheard>,
    overwritten: AtomicU64,
}

impl Tap {
    /// Listens to `selectors`; of each key `places` messages may wait. With `notices` probes are answered, so that a
    /// barrier can wait for the tap.
    pub(super) fn open(
        session: &zenoh::Session,
        selectors: &[Selector],
        places: usize,
        notices: &Notices,
    ) -> Result<Self, BusError> {
        let shared = Arc::new(Shared { mailbox: Mailbox::new(places, MAX_TOPICS), overwritten: AtomicU64::new(0) });
        let subscribe = |selector: &Selector| {
            let (shared, notices) = (Arc::clone(&shared), notices.clone());
            let subscriber = session.declare_subscriber(selector.as_str());
            let subscriber = subscriber.callback(move |sample| shared.admit(&sample, &notices)).wait();
            subscriber.map_err(|cause| BusError::zenoh(format!("listening to {}", selector.as_str()), &cause))
        };
        let subscribers = selectors.iter().map(subscribe).collect::<Result<_, _>>()?;
        Ok(Self { shared, _subscribers: subscribers })
    }

    /// The message that has waited longest, waiting until `deadline` for one.
    pub fn take(&self, deadline: Option<Instant>) -> Taken<Topic, Overheard> {
        self.shared.mailbox.take(deadline)
    }

    /// Messages that newer ones of the same key have taken the place of.
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
    /// Runs on zenoh's receive thread: looks at headers only and waits for nothing.
    fn admit(&self, sample: &Sample, notices: &Notices) {
        let Ok(key) = sample.key_expr().as_str().parse::<Key>() else { return };
        if has_notices(&key.topic) && !is_json(&key.topic) {
            match wire::decode_header(sample.payload().slices()) {
                Ok(header) if header.kind == Kind::Control => return note(&key.topic, sample, notices),
                Ok(_) => notices.heard(&key.topic),
                // Not ours to judge: whoever the message is for counts it.
                Err(_) => {}
            }
        }
        let topic = key.topic.clone();
        let overheard = Overheard { key, arrived_nanos: unix_nanos(), payload: sample.payload().clone() };
        match self.mailbox.push(topic, overheard) {
            Pushed::Queued => {}
            Pushed::Displaced(_) | Pushed::NoLane(_) | Pushed::Closed(_) => {
                self.overwritten.fetch_add(1, Ordering::Relaxed);
            }
        }
    }
}

/// Probes and ends are about the route, not of the run.
fn note(topic: &Topic, sample: &Sample, notices: &Notices) {
    if let Ok((_, Control::Probe)) = wire::decode(sample.payload().slices(), &Limits::DEFAULT) {
        notices.probed(topic);
    }
}

fn is_json(topic: &Topic) -> bool {
    matches!(topic, Topic::Stream { stream: Stream::DetectionsJson, .. })
}
