//! One process on the bus of one run.

use std::hash::{BuildHasher, RandomState};
use std::net::SocketAddr;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use protocol::{CavId, Control, Key, KeyExpr, ProcessId, Role, RunId, Topic};
use zenoh::qos::Priority;
use zenoh::{Session, Wait};

use super::flush_barrier::FlushBarrier;
use super::inbox_limits::InboxLimits;
use super::liveliness::{LivelinessEvent, LivelinessSubscription, LivelinessToken};
use super::metrics::MetricsServer;
use super::passive_subscriber::PassiveSubscriber;
use super::publisher::{Publisher, PublisherOptions, unix_nanos};
use super::shutdown::{self, Overdue};
use super::status_publisher::{StatusPublisher, StatusSender};
use super::subscriber::{Inbox, Subscription};
use super::watchdog::Heartbeat;
use super::{BusError, BusOptions, MessageStats, open};

/// Who joins which run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// The run.
    pub run: RunId,
    /// The process, for the ledger: `agent-4279`.
    pub process: ProcessId,
    /// The vehicle it speaks for, or a name of its own: `replay`.
    pub cav: CavId,
}

/// A process's place on the bus: everything it publishes, subscribes to and says goes through here.
pub struct Bus {
    session: Session,
    identity: Identity,
    epoch: u64,
    books: MessageStats,
    notices: StatusPublisher,
    speaking: JoinHandle<()>,
    metrics: Option<MetricsServer>,
}

impl Bus {
    /// Opens a session and joins the run.
    ///
    /// # Errors
    /// [`BusError`], as [`open`].
    pub fn join(options: &BusOptions, identity: Identity) -> Result<Self, BusError> {
        Self::over(open(options)?, identity)
    }

    /// Joins the run over a session that is open already.
    ///
    /// # Errors
    /// [`BusError::Thread`] when the system gives no thread.
    pub fn over(session: Session, identity: Identity) -> Result<Self, BusError> {
        let (epoch, books, notices) =
            (new_epoch(), MessageStats::new(identity.process.clone()), StatusPublisher::new());
        let speaking = notices.speak(StatusSender {
            session: session.clone(),
            run: identity.run.clone(),
            cav: identity.cav.clone(),
            epoch,
            books: books.clone(),
        })?;
        Ok(Self { session, identity, epoch, books, notices, speaking, metrics: None })
    }

    /// Serves the books to Prometheus for as long as this is; tells where.
    ///
    /// # Errors
    /// [`BusError::Metrics`] when the address cannot be listened at.
    pub fn serve_metrics(&mut self, address: SocketAddr) -> Result<SocketAddr, BusError> {
        let server =
            MetricsServer::start(address, &self.books).map_err(|cause| BusError::Metrics { address, cause })?;
        Ok(self.metrics.insert(server).address())
    }

    /// Who this process is.
    #[must_use]
    pub fn identity(&self) -> &Identity {
        &self.identity
    }

    /// Its ledger and stage timings.
    #[must_use]
    pub fn books(&self) -> &MessageStats {
        &self.books
    }

    /// The session, for what this type does not do.
    #[must_use]
    pub fn session(&self) -> &Session {
        &self.session
    }

    /// A publisher of `topic` that speaks for this process's vehicle.
    ///
    /// # Errors
    /// [`BusError`] when zenoh or the system refuses.
    pub fn publisher(&self, topic: Topic, options: PublisherOptions) -> Result<Publisher, BusError> {
        // A sensor message is sent under the vehicle it belongs to.
        let cav = match &topic {
            Topic::Stream { cav, .. } | Topic::Received { cav, .. } => cav.clone(),
            _ => self.identity.cav.clone(),
        };
        let key = topic.in_run(&self.identity.run);
        Publisher::new(&self.session, (&key, &cav), self.epoch, &self.books, options)
    }

    /// An inbox of `places` messages for each of at most `max_topics` topics.
    #[must_use]
    pub fn inbox(&self, places: usize, max_topics: usize) -> Arc<Inbox> {
        Inbox::new(places, max_topics, &self.books)
    }

    /// An inbox that takes no more than `limits` from anyone.
    #[must_use]
    pub fn limited_inbox(&self, places: usize, max_topics: usize, limits: InboxLimits) -> Arc<Inbox> {
        Inbox::within(limits, places, max_topics, &self.books)
    }

    /// Until what is returned is dropped, this process says how it is only while a thread works from `inbox`: waits there or
    /// has come back since the last time. One whose work stands still falls silent so, and whoever watches over it can tell.
    pub fn works_from(&self, inbox: &Inbox) -> Heartbeat {
        Heartbeat::begin(&self.notices, inbox.pulse())
    }

    /// Delivers `topic` into `inbox`.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn subscribe(&self, topic: Topic, inbox: &Arc<Inbox>) -> Result<Subscription, BusError> {
        Subscription::to_key(&self.session, &topic.in_run(&self.identity.run), (inbox, None), &self.notices)
    }

    /// [`Self::subscribe`] with another number of places than the inbox's other topics have.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn subscribe_keeping(&self, topic: Topic, places: usize, inbox: &Arc<Inbox>) -> Result<Subscription, BusError> {
        Subscription::to_key(&self.session, &topic.in_run(&self.identity.run), (inbox, Some(places)), &self.notices)
    }

    /// Delivers every topic of `selector` into `inbox`.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn subscribe_all(&self, selector: &KeyExpr, inbox: &Arc<Inbox>) -> Result<Subscription, BusError> {
        Subscription::to_all(&self.session, selector, inbox, &self.notices)
    }

    /// Listens in on `selectors` without a line in the books; of each key `places` messages may wait.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn tap(&self, selectors: &[KeyExpr], places: usize) -> Result<PassiveSubscriber, BusError> {
        PassiveSubscriber::open(&self.session, selectors, places, &self.notices)
    }

    /// Says `control` to all who listen, without waiting.
    pub fn say(&self, control: Control, capture_nanos: u64) {
        self.notices.say(control, capture_nanos);
    }

    /// Shows this process, in its role, to those who watch.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn announce(&self, role: Role) -> Result<LivelinessToken, BusError> {
        LivelinessToken::announce(&self.session, &self.identity.run, role, &self.identity.cav)
    }

    /// Watches the processes of a role come and go, those already there first. `report` must not wait or call zenoh.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn watch(
        &self,
        role: Role,
        report: impl Fn(LivelinessEvent) + Send + Sync + 'static,
    ) -> Result<LivelinessSubscription, BusError> {
        LivelinessSubscription::begin(&self.session, &KeyExpr::alive(&self.identity.run, role), report)
    }

    /// The key of a topic in this run.
    #[must_use]
    pub fn key(&self, topic: Topic) -> Key {
        topic.in_run(&self.identity.run)
    }

    /// Says how the books stand at the end, and closes the session, in at most `limit`. Publishers and subscriptions
    /// are to be ended before.
    ///
    /// # Errors
    /// [`Overdue`] when the network does not let go; the end of the process will.
    pub fn leave(self, limit: Duration) -> Result<(), Overdue> {
        let Self { session, identity, notices, speaking, .. } = self;
        notices.close();
        shutdown::within(limit, "the zenoh session", move || {
            if speaking.join().is_err() {
                tracing::error!("the thread for notices panicked");
            }
            // A connection that is closed throws away what still lies in its buffers.
            FlushBarrier::new(&session, &identity.run, Priority::Background).wait(limit);
            if let Err(cause) = session.close().wait() {
                tracing::warn!("closing the zenoh session: {cause}");
            }
        })
    }
}

/// A number that no other start of a process has: the standard library seeds its hashers from the system's randomness.
fn new_epoch() -> u64 {
    RandomState::new().hash_one(unix_nanos())
}
