//! Buses for tests: a router on a free port of this machine and any number of clients.

use std::net::TcpListener;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use bus::{
    self, Bus, BusConfig, BusOptions, Endpoint, Event, Identity, Inbox, InboxLimits,
    bounded_queue::Pop,
};
use ego_fuser::config::EgoSettings;
use ego_fuser::node::NodeOptions;
use protocol::{CavId, ProcessId, RunId, Stream, Topic};
use sim_replay::config::{RecorderConfig, RecordingConfig};
use sim_replay::link_node;
use sim_replay::stream::StreamOptions;
use zenoh::Session;

/// Longer than any step of a test takes, on a machine however busy.
pub const TIMEOUT: Duration = Duration::from_secs(60);

/// Options of an ego's node whose frames wait that long for their neighbours.
#[must_use]
pub fn ego_options(deadline: Duration) -> NodeOptions {
    NodeOptions::from(&EgoSettings {
        deadline_ms: u64::try_from(deadline.as_millis()).unwrap_or(u64::MAX),
        ..EgoSettings::default()
    })
}

/// Options of a replay of all vehicles once, at the recorded pace.
#[must_use]
pub fn stream_options() -> StreamOptions {
    StreamOptions {
        ready_timeout: TIMEOUT,
        answer_timeout: TIMEOUT,
        ..StreamOptions::default()
    }
}

/// Options of the link of one stream to an ego, until all agents of a run have ended, with at most 1 GiB in flight.
#[must_use]
pub fn link_options(ego: CavId, stream: Stream) -> link_node::NodeOptions {
    link_node::NodeOptions {
        ego,
        streams: vec![stream],
        keeps_running: false,
        max_kept_bytes: 1 << 30,
        inbox: InboxLimits::PEERS,
    }
}

/// Configuration of a recorder of everything, until it is stopped.
#[must_use]
pub fn recorder_config(bus: &Bus, out: PathBuf) -> RecorderConfig {
    RecorderConfig {
        run: bus.identity().run.clone(),
        out,
        record: RecordingConfig::default(),
        keep_running: true,
        bus: BusConfig::default(),
    }
}

/// Router for the clients of one test.
pub struct TestRouter {
    /// Endpoint at which it listens.
    pub endpoint: Endpoint,
    _session: Session,
}

impl TestRouter {
    /// Opens a router on a port that was free at that moment.
    ///
    /// # Panics
    /// When there is no free port.
    #[must_use]
    pub fn open() -> Self {
        Self::with(|options| options)
    }

    /// The same, with other options.
    ///
    /// # Panics
    /// When there is no free port.
    #[must_use]
    pub fn with(change: impl Fn(BusOptions) -> BusOptions) -> Self {
        // Another process may take the port between the two calls.
        let opened = (0..20).find_map(|_| {
            let endpoint = Endpoint::loopback(free_port());
            // A pause of the whole machine must not count as a stalled receiver.
            let options = BusOptions {
                stall_limit: TIMEOUT,
                ..BusOptions::router(endpoint.clone())
            };
            bus::open(&change(options))
                .ok()
                .map(|session| (endpoint, session))
        });
        let (endpoint, session) = opened.expect("a free port on loopback");
        Self {
            endpoint,
            _session: session,
        }
    }

    /// A client of this router in the run `test`, named `<role>-<cav>` or, for processes without a vehicle, `<cav>`.
    ///
    /// # Panics
    /// When it cannot connect.
    #[must_use]
    pub fn join(&self, process: &str, cav: &str) -> Bus {
        let identity = Identity {
            run: RunId::new("test").expect("an identifier"),
            process: ProcessId::new(process).expect("an identifier"),
            cav: CavId::new(cav).expect("an identifier"),
        };
        Bus::join(&BusOptions::client(self.endpoint.clone()), identity)
            .expect("the router is there")
    }
}

/// A port on loopback that is free at this moment.
///
/// # Panics
/// When there is none.
#[must_use]
pub fn free_port() -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    listener
        .local_addr()
        .expect("a bound socket has an address")
        .port()
}

/// The next event.
///
/// # Panics
/// When none comes.
#[must_use]
pub fn next_event(inbox: &Inbox) -> (Topic, Event) {
    match inbox.take(Some(Instant::now() + TIMEOUT)) {
        Pop::Item(topic, event) => (topic, event),
        Pop::TimedOut => panic!("nothing came within {TIMEOUT:?}"),
        Pop::Closed => panic!("the inbox is closed"),
    }
}

/// Waits until `condition` holds.
///
/// # Panics
/// When it does not hold in time.
pub fn wait_for(what: &str, mut condition: impl FnMut() -> bool) {
    let deadline = Instant::now() + TIMEOUT;
    while !condition() {
        assert!(Instant::now() < deadline, "{what}: not within {TIMEOUT:?}");
        std::thread::sleep(Duration::from_millis(2));
    }
}
