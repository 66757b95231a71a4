//! Live run: follows the newest scene frame.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use bus::bounded_queue::Pop;
use bus::{Bus, BusError, PassiveSubscriber, RawMessage};
use bytes::Bytes;
use dataset::evaluation_protocol::EvaluationProtocol;
use futures_util::stream::{self, BoxStream, StreamExt};
use protocol::{
    Camera, CavId, ImageFormat, KeyExpr, Kind, ProcessId, RunId, Stats, Stream, Topic, Verb, wire,
};
use serde::Serialize;
use support::sync::{lock, spawn};
use tokio::sync::watch;
use tokio::time::{sleep, timeout};
use zenoh::Wait;

use crate::operate::router_watch::{LIMIT, TimeSum};

use super::frame_assembler::{FrameAssembler, ReceivedMessage, decoded};
use super::on_demand::OnDemand;

/// Largest number of waiting messages of one key.
const PLACES: usize = 4;
/// The same for previews, which are taken only with the next other message.
const PREVIEW_PLACES: usize = 2;
/// Shortest time between two scene frames of a page: ten a second.
const SHORTEST_PERIOD: Duration = Duration::from_millis(95);
/// Interval between empty messages to a page without a new frame, which also detect that it has closed.
const HEARTBEAT: Duration = Duration::from_secs(1);
/// Largest number of images that are kept: 16 vehicles of four cameras.
const MOST_IMAGES: usize = 64;
/// Largest number of feature maps that are kept.
const MOST_MAPS: usize = 16;
/// Largest number of egos of which pages are served at the same time.
const MOST_EGOS: usize = 16;
/// Empty message.
const NOTHING_NEW: [u8; 4] = [0; 4];
/// Processes whose problems are kept at most.
const MAX_REPORTERS: usize = 128;
/// Interval at which the thread checks for open pages.
const CHECK_PERIOD: Duration = Duration::from_millis(100);

/// Format and content of an image.
pub(super) type Image = (ImageFormat, Bytes);

/// Newest scene frame of a run, for any number of pages. The run is subscribed to only while a page is open, so that a
/// closed page costs nothing. Points are those of previews, which are sent only while they have a subscriber.
pub struct LiveRun {
    run: RunId,
    pub(super) shared: Arc<LiveState>,
    thread: Option<JoinHandle<()>>,
}

/// State of a live run: the thread writes it, pages read it.
pub(super) struct LiveState {
    /// Newest scene frame, after its length, of each ego that a page shows; of no name: the first with results. Empty:
    /// none so far.
    newest: Mutex<BTreeMap<Option<CavId>, watch::Sender<Bytes>>>,
    activity: Mutex<RunActivity>,
    /// Newest image of each camera.
    pub(super) images: OnDemand<(CavId, u8), Image>,
    /// Newest feature map of each vehicle, as a message.
    pub(super) maps: OnDemand<CavId, Bytes>,
    ending: AtomicBool,
}

/// Status of a live run: time since its last message, end, connection.
#[derive(Debug, Clone, Serialize)]
pub(super) struct LiveStatus {
    /// Time since the last message of the scene, seconds; `None`: there was none since a page is open.
    pub(super) silent_s: Option<f64>,
    /// Time since the last result, or since the first message where there was no result, seconds.
    pub(super) unanswered_s: Option<f64>,
    /// Problems that processes report.
    pub(super) problems: Vec<String>,
    /// Outages of the router so far, as text; `None`: there was none.
    pub(super) router_outages: Option<String>,
    /// True if its scene has been played to the end.
    pub(super) is_over: bool,
    /// True while there is a connection to its router.
    pub(super) has_router: bool,
    /// Number of cameras whose images are not shown.
    pub(super) images_left_out: usize,
}

/// State behind [`LiveStatus`].
#[derive(Debug, Default)]
struct RunActivity {
    last_message: Option<Instant>,
    /// Last message of any kind while a page is open: every process reports twice a second, this one too.
    last_received: Option<Instant>,
    /// Last result, or the first message.
    answered: Option<Instant>,
    /// Problems that each process reports.
    problems: BTreeMap<ProcessId, Vec<String>>,
    is_over: bool,
    router: RouterConnection,
}

/// Connection to the router, and the times without it.
#[derive(Debug, Default)]
struct RouterConnection {
    is_there: bool,
    /// When the last message came or the connection ended, whichever was earlier; `None`: there is one, or there was never
    /// one.
    lost: Option<Instant>,
    outages: TimeSum,
}

impl RouterConnection {
    /// Takes note of whether there is a connection `now`. A router that passes nothing is gone from its last message on.
    fn note(&mut self, is_there: bool, last_received: Option<Instant>, now: Instant) {
        if self.is_there && !is_there {
            let silent_since = last_received.filter(|last| now.duration_since(*last) > LIMIT);
            self.lost = Some(silent_since.unwrap_or(now));
        } else if is_there && let Some(lost) = self.lost.take() {
            self.outages.add([now.duration_since(lost)]);
        }
        self.is_there = is_there;
    }
}

impl LiveRun {
    /// Starts the thread that follows the run of `bus`, which is judged by `protocol`.
    ///
    /// # Errors
    /// [`BusError`] when the system gives no thread.
    pub fn start(bus: Bus, protocol: Option<EvaluationProtocol>) -> Result<Self, BusError> {
        let run = bus.identity().run.clone();
        let shared = Arc::new(LiveState {
            newest: Mutex::default(),
            activity: Mutex::default(),
            images: OnDemand::new(MOST_IMAGES),
            maps: OnDemand::new(MOST_MAPS),
            ending: AtomicBool::new(false),
        });
        let listener = LiveListener {
            bus,
            shared: Arc::clone(&shared),
            assembly: FrameAssembler::new(protocol, BTreeMap::new()),
            others: BTreeMap::new(),
        };
        let thread = spawn("view", move || listener.run());
        let thread = thread.map_err(BusError::thread("the view"))?;
        Ok(Self {
            run,
            shared,
            thread: Some(thread),
        })
    }

    /// Name of the run.
    pub fn name(&self) -> &str {
        self.run.as_str()
    }

    /// State of the run.
    pub(super) fn status(&self) -> LiveStatus {
        let activity = lock(&self.shared.activity);
        LiveStatus {
            silent_s: activity.last_message.map(|at| at.elapsed().as_secs_f64()),
            unanswered_s: activity.answered.map(|at| at.elapsed().as_secs_f64()),
            problems: activity
                .problems
                .iter()
                .flat_map(|(name, of)| of.iter().map(move |problem| format!("{name}: {problem}")))
                .collect(),
            is_over: activity.is_over,
            router_outages: activity.router.outages.sentence("router gone"),
            has_router: activity.router.is_there,
            images_left_out: self.shared.images.left_out(),
        }
    }

    /// Number of open pages.
    #[cfg(test)]
    pub(crate) fn watchers(&self) -> usize {
        let newest = lock(&self.shared.newest);
        newest.values().map(watch::Sender::receiver_count).sum()
    }

    /// Scene frames of an ego (`None`: the first with results) for one page, each after its length (32 bits,
    /// little-endian; 0: nothing new): the newest whenever the page has taken the previous one, until `limit` of them or
    /// the end of the run.
    pub fn moments(&self, limit: Option<u64>, ego: Option<CavId>) -> BoxStream<'static, Bytes> {
        let newest = self.subscribe(ego);
        let begun = (newest, limit, Duration::ZERO);
        stream::unfold(begun, |(mut newest, left, pause)| async move {
            if left == Some(0) {
                return None;
            }
            // The pause comes before the next frame is taken, so that the page gets the newest one then.
            sleep(pause).await;
            match timeout(HEARTBEAT, newest.changed()).await {
                Err(_) => {
                    let nothing_new = Bytes::from_static(&NOTHING_NEW);
                    Some((nothing_new, (newest, left, Duration::ZERO)))
                }
                Ok(Err(_)) => None,
                Ok(Ok(())) => {
                    let frame = newest.borrow_and_update().clone();
                    Some((frame, (newest, left.map(|left| left - 1), SHORTEST_PERIOD)))
                }
            }
        })
        .boxed()
    }

    /// Beyond [`MOST_EGOS`], those of the first ego with results.
    fn subscribe(&self, ego: Option<CavId>) -> watch::Receiver<Bytes> {
        let mut newest = lock(&self.shared.newest);
        let has_room = newest.len() <= MOST_EGOS || newest.contains_key(&ego);
        let ego = ego.filter(|_| has_room);
        newest.entry(ego).or_default().subscribe()
    }
}

impl Drop for LiveRun {
    fn drop(&mut self) {
        self.shared.ending.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the view's thread panicked");
        }
    }
}

/// State of the thread.
struct LiveListener {
    bus: Bus,
    shared: Arc<LiveState>,
    /// Scene frames of the first ego with results.
    assembly: FrameAssembler,
    /// Scene frames of the egos that pages name.
    others: BTreeMap<CavId, FrameAssembler>,
}

/// Subscribes to previews, and to all else that is shown.
fn subscribe(bus: &Bus) -> Result<[PassiveSubscriber; 2], BusError> {
    use Stream::{Boxes, Descriptor, Detections, Pose, Tracks};
    let run = &bus.identity().run;
    let streams = [Pose, Boxes, Detections, Tracks, Descriptor];
    let mut selectors: Vec<KeyExpr> = streams.map(|stream| KeyExpr::stream(run, stream)).into();
    selectors.extend([
        KeyExpr::received_by_anyone(run, Stream::Pose),
        KeyExpr::truth(run),
        KeyExpr::stats(run),
        KeyExpr::control(run),
    ]);
    let previews = bus.tap(&[KeyExpr::stream(run, Stream::Preview)], PREVIEW_PLACES)?;
    Ok([previews, bus.tap(&selectors, PLACES)?])
}

impl LiveListener {
    fn run(mut self) {
        let mut subscriptions: Option<[PassiveSubscriber; 2]> = None;
        let (mut cameras, mut maps) = (None, None);
        while !self.shared.ending.load(Ordering::Relaxed) {
            self.watch_router();
            if !self.is_watched() {
                (subscriptions, cameras, maps) = (None, None, None);
                lock(&self.shared.activity).last_received = None;
                thread::sleep(CHECK_PERIOD);
                continue;
            }
            let Some([previews, rest]) = &subscriptions else {
                match subscribe(&self.bus) {
                    Ok(opened) => subscriptions = Some(opened),
                    Err(error) => {
                        tracing::error!("nothing is shown: {error}");
                        thread::sleep(HEARTBEAT);
                    }
                }
                continue;
            };
            self.follow_cameras(&mut cameras);
            self.follow_maps(&mut maps);
            // Previews first: a scene frame is shown when its result is taken, and its sweeps have arrived long before.
            if let Pop::Item(_, message) = rest.take(Some(Instant::now() + CHECK_PERIOD)) {
                while let Pop::Item(_, preview) = previews.take(Some(Instant::now())) {
                    self.take(&preview);
                }
                self.take(&message);
            }
        }
        drop(subscriptions);
        if let Err(overdue) = self.bus.leave(Duration::from_millis(500)) {
            tracing::warn!("{overdue}");
        }
    }

    fn watch_router(&self) {
        let mut routers = self.bus.session().info().routers_zid().wait();
        let mut activity = lock(&self.shared.activity);
        let last_received = activity.last_received;
        let is_there = routers.next().is_some();
        activity
            .router
            .note(is_there, last_received, Instant::now());
    }

    /// Receives images only while a page shows them: they are the largest stream after sweeps.
    fn follow_cameras(&self, cameras: &mut Option<PassiveSubscriber>) {
        if self.shared.images.wanted().is_empty() {
            *cameras = None;
            return;
        }
        if cameras.is_none() {
            *cameras = self.open(&[KeyExpr::cameras(&self.bus.identity().run)], "images");
        }
        let Some(cameras) = cameras else { return };
        while let Pop::Item(_, message) = cameras.take(Some(Instant::now())) {
            if let Topic::Stream { cav, stream } = &message.key.topic
                && let Stream::Camera(number) = stream
                && let Some(Camera { metadata, image }) = decoded(&message.bytes())
            {
                let image = (metadata.format, image.into());
                self.shared.images.keep((cav.clone(), *number), image);
            }
        }
    }

    /// Receives the feature maps of the vehicles of which a page shows one.
    fn follow_maps(&self, maps: &mut Option<(BTreeSet<CavId>, PassiveSubscriber)>) {
        let wanted = self.shared.maps.wanted();
        // Another selection of vehicles needs another subscription.
        maps.take_if(|(subscribed, _)| *subscribed != wanted);
        if wanted.is_empty() {
            return;
        }
        if maps.is_none() {
            let topics = wanted.iter().map(|cav| Topic::stream(cav, Stream::Bev));
            let keys = topics.map(|topic| KeyExpr::one(&self.bus.key(topic)));
            let selectors: Vec<KeyExpr> = keys.collect();
            let opened = self.open(&selectors, "feature maps");
            *maps = opened.map(|opened| (wanted, opened));
        }
        let Some((_, maps)) = maps else { return };
        while let Pop::Item(_, message) = maps.take(Some(Instant::now())) {
            if let Topic::Stream { cav, stream } = &message.key.topic
                && *stream == Stream::Bev
            {
                let map = Bytes::copy_from_slice(&message.bytes());
                self.shared.maps.keep(cav.clone(), map);
            }
        }
    }

    fn open(&self, selectors: &[KeyExpr], what: &str) -> Option<PassiveSubscriber> {
        let opened = self.bus.tap(selectors, PREVIEW_PLACES);
        opened
            .inspect_err(|error| tracing::error!("no {what} are shown: {error}"))
            .ok()
    }

    fn is_watched(&self) -> bool {
        let newest = lock(&self.shared.newest);
        newest.values().any(|newest| newest.receiver_count() > 0)
    }

    /// Reports of processes are no activity: a viewer reports too, for as long as its page is open.
    fn note(&self, topic: &Topic, bytes: &[u8]) {
        let now = Instant::now();
        let mut activity = lock(&self.shared.activity);
        activity.last_received = Some(now);
        if let Topic::Stats(name) = topic {
            let report = decoded::<Stats>(bytes);
            let known = &mut activity.problems;
            let has_room = known.len() < MAX_REPORTERS || known.contains_key(name);
            if let Some(report) = report
                && has_room
                && report.process == *name
            {
                known.insert(name.clone(), report.problems);
            }
            return;
        }
        activity.last_message = Some(now);
        activity.answered.get_or_insert(now);
        match topic {
            Topic::Stream { stream, .. } if *stream == Stream::Detections => {
                activity.answered = Some(now);
            }
            Topic::Control(Verb::End) => activity.is_over = true,
            Topic::Truth => activity.is_over = false,
            _ => {}
        }
    }

    fn take(&mut self, message: &RawMessage) {
        let bytes = message.bytes();
        let Ok(header) = wire::decode_header([bytes.as_ref()]) else {
            return;
        };
        let topic = &message.key.topic;
        self.note(topic, &bytes);
        if header.kind == Kind::Control {
            return;
        }
        let seen = ReceivedMessage {
            topic,
            header: &header,
            arrived_nanos: message.arrived_nanos,
            payload: Some(bytes.as_ref()),
        };
        let mut newest = lock(&self.shared.newest);
        newest.retain(|ego, frames| ego.is_none() || frames.receiver_count() > 0);
        self.others
            .retain(|ego, _| newest.contains_key(&Some(ego.clone())));
        for (ego, frames) in newest.iter() {
            let assembly = match ego {
                None => &mut self.assembly,
                Some(cav) => self
                    .others
                    .entry(cav.clone())
                    .or_insert_with(|| self.assembly.for_ego(ego.clone())),
            };
            // Without a reader too: the assembler has to see every message.
            if let Some(frame) = assembly.add(&seen).filter(|_| frames.receiver_count() > 0) {
                let frame = frame.to_bytes();
                let len = (frame.len() as u32).to_le_bytes();
                frames.send_replace([len.as_slice(), &frame].concat().into());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_outage_begins_with_the_last_message_while_a_page_is_open() {
        let begin = Instant::now();
        let after = |seconds: u64| begin + Duration::from_secs(seconds);
        let mut router = RouterConnection::default();
        let mut sentence = |is_there: bool, last_received: Option<Instant>, now: Instant| {
            router.note(is_there, last_received, now);
            router.outages.sentence("gone")
        };
        assert_eq!(sentence(true, None, begin), None);
        // Nothing came through it for 3 s before the connection ended.
        assert_eq!(sentence(false, Some(after(1)), after(4)), None);
        assert_eq!(
            sentence(true, Some(after(1)), after(6)).as_deref(),
            Some("gone for 5.0 s")
        );
        // No page was open: silence says nothing.
        sentence(false, None, after(100));
        assert_eq!(
            sentence(true, None, after(101)).as_deref(),
            Some("gone for 6.0 s in all (2 times)")
        );
    }
}
