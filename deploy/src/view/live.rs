//! A live run, as it goes.

use std::io::{self, Write};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use protocol::{Kind, RunId, Selector, Stream, wire};
use sim_replay::bus::mailbox::Taken;
use sim_replay::bus::{Bus, BusError, Overheard, Tap};

use super::assembly::{Assembly, Seen};

/// Messages of one key that may wait to be looked at.
const PLACES: usize = 4;
/// A page is given no more than this: ten moments a second.
const SHORTEST_PERIOD: Duration = Duration::from_millis(95);
/// How often a page is told that nothing has come, which also finds out that it is gone.
const HEARTBEAT: Duration = Duration::from_secs(1);
/// How often the thread looks whether somebody looks.
const LOOK_ROUND: Duration = Duration::from_millis(100);

/// The newest moment of a run, for any number of pages. Sweeps are listened to only while somebody looks: nobody pays for a
/// page that is not open.
pub struct LiveRun {
    shared: Arc<Shared>,
    run: RunId,
    thread: Option<JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    newest: Mutex<(u64, Arc<Vec<u8>>)>,
    changed: Condvar,
    watchers: AtomicUsize,
    ending: AtomicBool,
}

impl LiveRun {
    /// Listens to the run of `bus`.
    ///
    /// # Errors
    /// [`BusError`] when the bus refuses or the system gives no thread.
    pub fn start(bus: Bus) -> Result<Self, BusError> {
        let shared = Arc::<Shared>::default();
        let run = bus.identity().run.clone();
        let streams = [Stream::Pose, Stream::Boxes, Stream::Detections];
        let mut selectors: Vec<Selector> = streams.map(|stream| Selector::stream(&run, stream)).into();
        selectors.extend([
            Selector::received_by_anyone(&run, Stream::Pose),
            Selector::truth(&run),
            Selector::stats(&run),
        ]);
        let tap = bus.tap(&selectors, PLACES)?;
        let listener = Listener { bus, run: run.clone(), shared: Arc::clone(&shared), assembly: Assembly::default() };
        let thread = thread::Builder::new()
            .name("view".into())
            .spawn(move || listener.run(&tap))
            .map_err(|cause| BusError::Thread { what: "the view".into(), cause })?;
        Ok(Self { shared, run, thread: Some(thread) })
    }

    /// Name of the run.
    #[must_use]
    pub fn name(&self) -> &str {
        self.run.as_str()
    }

    /// Pages that are open.
    #[must_use]
    pub fn watchers(&self) -> usize {
        self.shared.watchers.load(Ordering::Relaxed)
    }

    /// Writes moments, each behind its length (32 bits, little-endian; 0: nothing new), the newest whenever the reader has
    /// taken the one before, until `limit` of them, the reader's end, or that of the run.
    ///
    /// # Errors
    /// What the reader's connection says.
    pub fn write_to(&self, out: &mut dyn Write, limit: Option<u64>) -> io::Result<()> {
        Shared::write_to(&self.shared, out, limit)
    }

    /// A function that writes as [`Self::write_to`] does, for another thread.
    pub(super) fn writer(&self, limit: Option<u64>) -> impl FnOnce(&mut dyn Write) -> io::Result<()> + Send + 'static {
        let shared = Arc::clone(&self.shared);
        move |out| Shared::write_to(&shared, out, limit)
    }
}

impl Drop for LiveRun {
    fn drop(&mut self) {
        self.shared.ending.store(true, Ordering::Relaxed);
        self.shared.changed.notify_all();
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the view's thread panicked");
        }
    }
}

impl Shared {
    fn write_to(&self, out: &mut dyn Write, limit: Option<u64>) -> io::Result<()> {
        self.watchers.fetch_add(1, Ordering::Relaxed);
        let written = self.write_newest(out, limit);
        self.watchers.fetch_sub(1, Ordering::Relaxed);
        written
    }

    fn write_newest(&self, out: &mut dyn Write, limit: Option<u64>) -> io::Result<()> {
        let (mut last, mut count) = (0, 0);
        while limit.is_none_or(|limit| count < limit) && !self.ending.load(Ordering::Relaxed) {
            match self.newer_than(last) {
                Some((version, frame)) => {
                    last = version;
                    count += 1;
                    out.write_all(&(frame.len() as u32).to_le_bytes())?;
                    out.write_all(&frame)?;
                    thread::sleep(SHORTEST_PERIOD);
                }
                None => out.write_all(&0_u32.to_le_bytes())?,
            }
            out.flush()?;
        }
        Ok(())
    }

    fn newer_than(&self, version: u64) -> Option<(u64, Arc<Vec<u8>>)> {
        let newest = self.newest.lock().unwrap_or_else(PoisonError::into_inner);
        let waited = self.changed.wait_timeout_while(newest, HEARTBEAT, |newest| {
            newest.0 <= version && !self.ending.load(Ordering::Relaxed)
        });
        let newest = waited.unwrap_or_else(PoisonError::into_inner).0;
        (newest.0 > version).then(|| newest.clone())
    }

    fn show(&self, frame: Vec<u8>) {
        let mut newest = self.newest.lock().unwrap_or_else(PoisonError::into_inner);
        *newest = (newest.0 + 1, Arc::new(frame));
        self.changed.notify_all();
    }
}

/// The thread's side.
struct Listener {
    bus: Bus,
    run: RunId,
    shared: Arc<Shared>,
    assembly: Assembly,
}

impl Listener {
    fn run(mut self, tap: &Tap) {
        let mut sweeps: Option<Tap> = None;
        while !self.shared.ending.load(Ordering::Relaxed) {
            let is_watched = self.shared.watchers.load(Ordering::Relaxed) > 0;
            if is_watched && sweeps.is_none() {
                let opened = self.bus.tap(&[Selector::stream(&self.run, Stream::Lidar)], 2);
                sweeps = opened.map_err(|error| tracing::error!("no points are shown: {error}")).ok();
            } else if !is_watched {
                sweeps = None;
            }
            // Sweeps first: a moment is shown when its result is taken, and its sweeps have come long before.
            if let Taken::Item(_, overheard) = tap.take(Some(Instant::now() + LOOK_ROUND)) {
                while let Some(Taken::Item(_, sweep)) = sweeps.as_ref().map(|tap| tap.take(Some(Instant::now()))) {
                    self.take(&sweep);
                }
                self.take(&overheard);
            }
        }
        drop(sweeps);
        if let Err(overdue) = self.bus.leave(Duration::from_millis(500)) {
            tracing::warn!("{overdue}");
        }
    }

    fn take(&mut self, overheard: &Overheard) {
        let bytes = overheard.bytes();
        let Ok(header) = wire::decode_header([bytes.as_ref()]) else { return };
        if header.kind == Kind::Control {
            return;
        }
        let topic = &overheard.key.topic;
        let (arrived_nanos, payload) = (overheard.arrived_nanos, Some(bytes.as_ref()));
        if let Some(frame) = self.assembly.add(&Seen { topic, header: &header, arrived_nanos, payload }) {
            self.shared.show(frame.to_bytes());
        }
    }
}
