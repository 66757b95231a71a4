//! Live run: follows the newest scene frame.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use bus::bounded_queue::Pop;
use bus::{Bus, BusError, PassiveSubscriber, RawMessage};
use bytes::Bytes;
use futures_util::{Stream as Pieces, stream};
use protocol::{KeyExpr, Kind, RunId, Stream, Topic, Verb, wire};
use serde::Serialize;
use tokio::sync::watch;
use tokio::time::{sleep, timeout};
use zenoh::Wait;

use super::frame_assembler::{FrameAssembler, ReceivedMessage};
use super::images::NewestImages;

/// Largest number of waiting messages of one key.
const PLACES: usize = 4;
/// The same for previews, which are taken only with the next other message.
const PREVIEW_PLACES: usize = 2;
/// Shortest time between two scene frames of a page: ten a second.
const SHORTEST_PERIOD: Duration = Duration::from_millis(95);
/// Interval between empty messages to a page without a new frame, which also detect that it has closed.
const HEARTBEAT: Duration = Duration::from_secs(1);
/// Empty message.
const NOTHING_NEW: [u8; 4] = [0; 4];
/// Interval at which the thread checks for open pages.
const CHECK_PERIOD: Duration = Duration::from_millis(100);

/// Newest scene frame of a run, for any number of pages. The run is subscribed to only while a page is open, so that a
/// closed page costs nothing. Points are those of previews, which are sent only while they have a subscriber.
pub struct LiveRun {
    /// Newest scene frame after its length; empty: none so far.
    newest: Arc<watch::Sender<Bytes>>,
    run: RunId,
    activity: Arc<Mutex<RunActivity>>,
    images: Arc<NewestImages>,
    ending: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// Status of a live run: time since its last message, end, connection.
#[derive(Debug, Clone, Serialize)]
pub(super) struct RunStatus {
    /// Time since the last message of the scene, seconds; `None`: there was none since a page is open.
    pub(super) silent_s: Option<f64>,
    /// True if its scene has been played to the end.
    pub(super) is_over: bool,
    /// True while there is a connection to its router.
    pub(super) has_router: bool,
    /// Number of cameras whose images are not shown.
    pub(super) images_left_out: usize,
}

/// State behind [`RunStatus`].
#[derive(Debug, Default)]
struct RunActivity {
    last_message: Option<Instant>,
    is_over: bool,
    has_router: bool,
}

impl LiveRun {
    /// Starts the thread that follows the run of `bus`.
    ///
    /// # Errors
    /// [`BusError`] when the system gives no thread.
    pub fn start(bus: Bus) -> Result<Self, BusError> {
        let run = bus.identity().run.clone();
        let newest = Arc::new(watch::Sender::default());
        let ending = Arc::<AtomicBool>::default();
        let (activity, images) = (Arc::default(), Arc::default());
        let listener = Listener {
            bus,
            run: run.clone(),
            newest: Arc::clone(&newest),
            ending: Arc::clone(&ending),
            assembly: FrameAssembler::default(),
            activity: Arc::clone(&activity),
            images: Arc::clone(&images),
        };
        let thread = thread::Builder::new()
            .name("view".into())
            .spawn(move || listener.run())
            .map_err(|cause| BusError::Thread { what: "the view".into(), cause })?;
        Ok(Self { newest, run, activity, images, ending, thread: Some(thread) })
    }

    /// Name of the run.
    #[must_use]
    pub fn name(&self) -> &str {
        self.run.as_str()
    }

    /// State of the run.
    pub(super) fn status(&self) -> RunStatus {
        let activity = self.activity.lock().unwrap_or_else(PoisonError::into_inner);
        RunStatus {
            silent_s: activity.last_message.map(|at| at.elapsed().as_secs_f64()),
            is_over: activity.is_over,
            has_router: activity.has_router,
            images_left_out: self.images.left_out(),
        }
    }

    /// Newest images of the cameras.
    pub(super) fn images(&self) -> &NewestImages {
        &self.images
    }

    /// Number of open pages.
    #[cfg(test)]
    pub(crate) fn watchers(&self) -> usize {
        self.newest.receiver_count()
    }

    /// Scene frames for one page, each after its length (32 bits, little-endian; 0: nothing new): the newest whenever
    /// the page has taken the previous one, until `limit` of them or the end of the run.
    pub fn moments(&self, limit: Option<u64>) -> impl Pieces<Item = Bytes> + Send + use<> {
        let newest = self.newest.subscribe();
        stream::unfold((newest, limit, Duration::ZERO), |(mut newest, left, pause)| async move {
            if left == Some(0) {
                return None;
            }
            sleep(pause).await;
            match timeout(HEARTBEAT, newest.changed()).await {
                Err(_) => Some((Bytes::from_static(&NOTHING_NEW), (newest, left, Duration::ZERO))),
                Ok(Err(_)) => None,
                Ok(Ok(())) => {
                    let moment = newest.borrow_and_update().clone();
                    Some((moment, (newest, left.map(|left| left - 1), SHORTEST_PERIOD)))
                }
            }
        })
    }
}

impl Drop for LiveRun {
    fn drop(&mut self) {
        self.ending.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the view's thread panicked");
        }
    }
}

/// State of the thread.
struct Listener {
    bus: Bus,
    run: RunId,
    newest: Arc<watch::Sender<Bytes>>,
    ending: Arc<AtomicBool>,
    assembly: FrameAssembler,
    activity: Arc<Mutex<RunActivity>>,
    images: Arc<NewestImages>,
}

/// Subscriptions while a page is open.
struct Subscriptions {
    previews: PassiveSubscriber,
    rest: PassiveSubscriber,
}

impl Subscriptions {
    fn open(bus: &Bus, run: &RunId) -> Result<Self, BusError> {
        let streams = [Stream::Pose, Stream::Boxes, Stream::Detections, Stream::Descriptor];
        let mut selectors: Vec<KeyExpr> = streams.map(|stream| KeyExpr::stream(run, stream)).into();
        selectors.extend([KeyExpr::received_by_anyone(run, Stream::Pose), KeyExpr::truth(run), KeyExpr::stats(run)]);
        selectors.push(KeyExpr::control(run));
        let previews = bus.tap(&[KeyExpr::stream(run, Stream::Preview)], PREVIEW_PLACES)?;
        Ok(Self { previews, rest: bus.tap(&selectors, PLACES)? })
    }
}

impl Listener {
    fn run(mut self) {
        let mut ears: Option<Subscriptions> = None;
        let mut cameras: Option<PassiveSubscriber> = None;
        while !self.ending.load(Ordering::Relaxed) {
            self.watch_router();
            if !self.is_watched() {
                (ears, cameras) = (None, None);
                thread::sleep(CHECK_PERIOD);
                continue;
            }
            let Some(Subscriptions { previews, rest }) = &ears else {
                match Subscriptions::open(&self.bus, &self.run) {
                    Ok(opened) => ears = Some(opened),
                    Err(error) => {
                        tracing::error!("nothing is shown: {error}");
                        thread::sleep(HEARTBEAT);
                    }
                }
                continue;
            };
            self.follow_cameras(&mut cameras);
            // Previews first: a scene frame is shown when its result is taken, and its sweeps have arrived long before.
            if let Pop::Item(_, message) = rest.take(Some(Instant::now() + CHECK_PERIOD)) {
                while let Pop::Item(_, preview) = previews.take(Some(Instant::now())) {
                    self.take(&preview);
                }
                self.take(&message);
            }
        }
        drop(ears);
        if let Err(overdue) = self.bus.leave(Duration::from_millis(500)) {
            tracing::warn!("{overdue}");
        }
    }

    fn watch_router(&self) {
        let has_router = self.bus.session().info().routers_zid().wait().next().is_some();
        self.activity().has_router = has_router;
    }

    fn activity(&self) -> MutexGuard<'_, RunActivity> {
        self.activity.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Receives images only while a page shows them: they are the largest stream after sweeps.
    fn follow_cameras(&self, cameras: &mut Option<PassiveSubscriber>) {
        if !self.images.are_wanted() {
            *cameras = None;
            return;
        }
        if cameras.is_none() {
            match self.bus.tap(&[KeyExpr::cameras(&self.run)], PREVIEW_PLACES) {
                Ok(opened) => *cameras = Some(opened),
                Err(error) => tracing::error!("no images are shown: {error}"),
            }
        }
        let Some(cameras) = cameras else { return };
        while let Pop::Item(_, message) = cameras.take(Some(Instant::now())) {
            self.images.keep(&message.key.topic, &message.bytes());
        }
    }

    fn is_watched(&self) -> bool {
        self.newest.receiver_count() > 0
    }

    /// Reports of processes are no activity: a viewer reports too, for as long as its page is open.
    fn note(&self, topic: &Topic) {
        if let Topic::Stats(_) = topic {
            return;
        }
        let mut activity = self.activity();
        activity.last_message = Some(Instant::now());
        match topic {
            Topic::Control(Verb::End) => activity.is_over = true,
            Topic::Truth => activity.is_over = false,
            _ => {}
        }
    }

    fn take(&mut self, message: &RawMessage) {
        let bytes = message.bytes();
        let Ok(header) = wire::decode_header([bytes.as_ref()]) else { return };
        let topic = &message.key.topic;
        self.note(topic);
        if header.kind == Kind::Control {
            return;
        }
        let (arrived_nanos, payload) = (message.arrived_nanos, Some(bytes.as_ref()));
        let seen = ReceivedMessage { topic, header: &header, arrived_nanos, payload };
        if let Some(frame) = self.assembly.add(&seen).filter(|_| self.is_watched()) {
            let frame = frame.to_bytes();
            let len = (frame.len() as u32).to_le_bytes();
            self.newest.send_replace([len.as_slice(), &frame].concat().into());
        }
    }
}
