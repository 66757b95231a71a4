//! Bus: connection of one process to one run.

use std::hash::{BuildHasher, RandomState};
use std::net::SocketAddr;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use protocol::{CavId, Control, Key, KeyExpr, ProcessId, Role, RunId, Topic};
use zenoh::qos::Priority;
use zenoh::{Session, Wait};

use super::flush_barrier::FlushBarrier;
use super::heartbeat::Heartbeat;
use super::inbox_limits::InboxLimits;
use super::liveliness::present;
use super::metrics::{self, MetricsPeer};
use super::passive_subscriber::PassiveSubscriber;
use super::publisher::{Publisher, PublisherOptions, unix_nanos};
use super::router_contact::RouterContact;
use super::shared_pool::SharedPool;
use super::shutdown::{self, Overdue, Stop};
use super::status_publisher::{StatusPublisher, StatusSender};
use super::subscriber::{Inbox, Subscription};
use super::{BusError, BusOptions, MessageStats, open, open_unless};
use crate::Result;
use crate::web::WebServer;

/// Longest wait for the end of another process of a name: longer than a router takes to notice that one was killed.
const NAME_LIMIT: Duration = Duration::from_secs(11);
/// Interval at which the name is looked for.
const NAME_PERIOD: Duration = Duration::from_millis(250);

/// Identity of a process in a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// The run.
    pub run: RunId,
    /// The process, for the ledger: `agent-4279`.
    pub process: ProcessId,
    /// The vehicle of the process, or a name of its own: `replay`.
    pub cav: CavId,
}

impl Identity {
    /// The identity of `process`, which is of the vehicle `cav`.
    pub fn new(run: RunId, process: ProcessId, cav: CavId) -> Self {
        Self { run, process, cav }
    }
}

/// Connection of a process to the bus: everything that it publishes and subscribes to passes through it.
pub struct Bus {
    session: Session,
    identity: Identity,
    epoch: u64,
    stats: MessageStats,
    pool: SharedPool,
    contact: RouterContact,
    status: StatusPublisher,
    status_thread: JoinHandle<()>,
    metrics: Option<WebServer>,
}

impl Bus {
    /// Opens a session and joins the run.
    ///
    /// # Errors
    /// [`BusError`], as [`open`].
    pub fn join(options: &BusOptions, identity: Identity) -> Result<Self> {
        Self::with_pool(open(options)?, options, identity)
    }

    /// [`Self::join`], or the end at once when `stop` is requested before the router is reached.
    ///
    /// # Errors
    /// [`BusError`], as [`open_unless`].
    pub fn join_unless(stop: &Stop, options: &BusOptions, identity: Identity) -> Result<Self> {
        Self::with_pool(open_unless(stop, options)?, options, identity)
    }

    fn with_pool(session: Session, options: &BusOptions, identity: Identity) -> Result<Self> {
        let mut bus = Self::over(session, identity)?;
        bus.pool = SharedPool::open(&bus.session, options.shared_memory, &bus.stats)?;
        Ok(bus)
    }

    /// Joins the run over a session that is open already, without a pool of shared memory.
    ///
    /// # Errors
    /// [`BusError`] when the system cannot start a thread, or the session is closed.
    pub fn over(session: Session, identity: Identity) -> Result<Self> {
        // Differs for every process instance: the standard library seeds its hashers from the system's randomness.
        let epoch = RandomState::new().hash_one(unix_nanos());
        let stats = MessageStats::new(identity.process.clone());
        let status = StatusPublisher::new();
        let status_thread = status.start(StatusSender {
            session: session.clone(),
            identity: identity.clone(),
            epoch,
            stats: stats.clone(),
            sequence: 0,
            is_start_reported: false,
        })?;
        let (pool, contact) = (SharedPool::default(), RouterContact::watch(&session)?);
        Ok(Self {
            session,
            identity,
            epoch,
            stats,
            pool,
            contact,
            status,
            status_thread,
            metrics: None,
        })
    }

    /// Waits until no other process of the run has this name, for [`NAME_LIMIT`] at most: one that was killed may count
    /// as present for some seconds.
    ///
    /// # Errors
    /// [`BusError::NameTaken`] if one still has it.
    pub(super) fn check_name(&self, role: Role, stop: &Stop) -> Result<()> {
        let Identity { run, process, cav } = &self.identity;
        let token = Key::alive(run, role, cav).to_string();
        let until = Instant::now() + NAME_LIMIT;
        let mut is_first = true;
        while !present(&self.session, &token)?.is_empty() {
            if std::mem::take(&mut is_first) {
                tracing::warn!("{process} is live in run {run} already: waiting for its end");
            }
            if Instant::now() > until || stop.wait_until(Instant::now() + NAME_PERIOD) {
                let problem = format!("{process} is live in run {run}");
                return Err(BusError::NameTaken(problem));
            }
        }
        Ok(())
    }

    /// Serves the counters, and those of other processes, to Prometheus until this is dropped; returns the address.
    ///
    /// # Errors
    /// [`BusError::Metrics`] when the address cannot be bound.
    pub fn serve_metrics(
        &mut self,
        address: SocketAddr,
        others: Vec<MetricsPeer>,
    ) -> Result<SocketAddr> {
        let server = metrics::serve(address, &self.stats, others);
        let server = server.map_err(|cause| BusError::Metrics { address, cause })?;
        Ok(self.metrics.insert(server).address())
    }

    /// Identity of this process.
    pub fn identity(&self) -> &Identity {
        &self.identity
    }

    /// Its ledger and stage timings.
    pub fn stats(&self) -> &MessageStats {
        &self.stats
    }

    /// Time since which the process has had no connection to its router.
    pub fn router_lost_since(&self) -> Option<Instant> {
        self.contact.lost_since()
    }

    /// Time without a connection to the router so far.
    pub fn router_lost(&self) -> Duration {
        self.contact.lost()
    }

    /// The zenoh session, for operations that this type does not offer.
    pub fn session(&self) -> &Session {
        &self.session
    }

    /// A publisher of `topic` on behalf of this process's vehicle.
    ///
    /// # Errors
    /// [`BusError`] when zenoh or the system fails.
    pub fn publisher(&self, topic: Topic, options: PublisherOptions) -> Result<Publisher> {
        // A sensor message names the vehicle that it belongs to.
        let cav = match &topic {
            Topic::Stream { cav, .. } | Topic::Received { cav, .. } => cav.clone(),
            _ => self.identity.cav.clone(),
        };
        let key = self.key(topic);
        Publisher::new(
            &self.session,
            (&key, &cav),
            self.epoch,
            (&self.stats, &self.pool),
            options,
        )
    }

    /// An inbox of `places` messages for each of at most `max_topics` topics.
    pub fn inbox(&self, places: usize, max_topics: usize) -> Arc<Inbox> {
        self.limited_inbox(places, max_topics, InboxLimits::NONE)
    }

    /// An inbox with `limits` on each sender.
    pub fn limited_inbox(
        &self,
        places: usize,
        max_topics: usize,
        limits: InboxLimits,
    ) -> Arc<Inbox> {
        Inbox::within(limits, places, max_topics, &self.stats)
    }

    /// Until the heartbeat is dropped, this process publishes its status only while a thread works from `inbox`: it
    /// waits there or has returned since the last status. A stalled process thus stops its heartbeats, which a
    /// supervisor detects.
    pub fn works_from(&self, inbox: &Inbox) -> Heartbeat {
        let (status, watchdog) = (self.status.clone(), Arc::clone(&inbox.watchdog));
        status.watch(Some(Arc::clone(&watchdog)));
        Heartbeat { status, watchdog }
    }

    /// Delivers `topic` into `inbox`.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn subscribe(&self, topic: Topic, inbox: &Arc<Inbox>) -> Result<Subscription> {
        let key = self.key(topic);
        Subscription::to_key(&self.session, &key, (inbox, None), &self.status)
    }

    /// [`Self::subscribe`] with another queue length than that of the inbox.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn subscribe_keeping(
        &self,
        topic: Topic,
        places: usize,
        inbox: &Arc<Inbox>,
    ) -> Result<Subscription> {
        let key = self.key(topic);
        Subscription::to_key(&self.session, &key, (inbox, Some(places)), &self.status)
    }

    /// Delivers every topic of `selector` into `inbox`.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn subscribe_all(&self, selector: &KeyExpr, inbox: &Arc<Inbox>) -> Result<Subscription> {
        Subscription::to_all(&self.session, selector, inbox, &self.status)
    }

    /// Subscribes passively to `selectors`, outside the message accounting; at most `places` messages of each key are
    /// queued.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn tap(&self, selectors: &[KeyExpr], places: usize) -> Result<PassiveSubscriber> {
        PassiveSubscriber::open(&self.session, selectors, places, &self.status)
    }

    /// Publishes `control` without waiting.
    pub fn publish_control(&self, control: Control, capture_nanos: u64) {
        self.status.publish(control, capture_nanos);
    }

    /// The key of a topic in this run.
    pub fn key(&self, topic: Topic) -> Key {
        topic.in_run(&self.identity.run)
    }

    /// [`Self::leave`] at the end of a program: a session that does not close in time ends with the process.
    pub fn leave_at_end(self) {
        if let Err(overdue) = self.leave(shutdown::STOP_LIMIT) {
            tracing::warn!("{overdue}");
        }
    }

    /// Publishes the final ledger and closes the session, in at most `limit`. Publishers and subscriptions have to be
    /// ended before.
    ///
    /// # Errors
    /// [`Overdue`] when the session does not close in time; the end of the process closes it.
    pub fn leave(self, limit: Duration) -> Result<(), Overdue> {
        drop(self.pool);
        // Order: the final ledger goes out, then the flush is confirmed, then the session closes.
        self.status.close();
        shutdown::within(limit, "the zenoh session", move || {
            if self.status_thread.join().is_err() {
                tracing::error!("the status thread panicked");
            }
            // A connection that is closed discards the messages in its buffers.
            FlushBarrier::new(&self.session, &self.identity.run, Priority::Background).wait(limit);
            if let Err(cause) = self.session.close().wait() {
                tracing::warn!("closing the zenoh session: {cause}");
            }
        })
    }
}
