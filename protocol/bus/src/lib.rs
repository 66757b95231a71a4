//! The bus between the processes of a run: zenoh, with every default that loses data replaced by a rule of ours.
//!
//! - One process routes on a fixed endpoint, the others connect to it; nothing is discovered ([`open`]).
//! - No producer waits for the network and no callback of zenoh's waits for a consumer: between them lie bounded
//!   mailboxes in which the newest wins ([`mailbox`], [`Publisher`], [`Inbox`]).
//! - What is overwritten, refused or still under way is counted ([`MessageStats`]), and the books are published.
//! - A scene starts when every route has carried something ([`Barrier`]).
//! - With keys every process shows who it is, and the router lets it say only what is its to say ([`Credentials`],
//!   [`AccessControl`]); what it refused is counted ([`RejectionLog`]).
//! - Ending takes a bounded time, whatever the network does ([`shutdown`]).
//!
//! Nothing here is async: zenoh brings its own runtimes, and a `put` that waits for a slow network must not hold up an
//! executor. Inside tokio it needs the multi-thread runtime.

mod access_control;
mod args;
mod batch_scheduling;
pub mod bounded_queue;
mod bus;
mod clock_offset;
pub mod config_file;
mod credentials;
mod endpoint;
mod error;
mod flush_barrier;
mod handshake_failures;
mod inbox_limits;
mod liveliness;
pub mod malloc_settings;
mod membership;
mod message_stats;
mod metrics;
mod passive_subscriber;
mod plain_tcp;
mod process_config;
mod publisher;
mod readiness;
mod rejection_log;
mod replay_window;
mod session;
pub mod shutdown;
mod status_publisher;
mod subscriber;
mod watchdog;
pub mod web;

pub use access_control::AccessControl;
pub use args::{BusConfig, InboxConfig, STOP_LIMIT, log_to_stderr};
pub use bus::{Bus, Identity};
pub use credentials::{AUTHORITY_FILE, CERTIFICATE_FILE, Credentials, KEY_FILE, MEMBERS_FILE, ROUTER};
pub use endpoint::Endpoint;
pub use error::BusError;
pub use inbox_limits::InboxLimits;
pub use liveliness::{LivelinessEvent, LivelinessSubscription, LivelinessToken, present};
pub use membership::Membership;
pub use message_stats::{MessageStats, PeerSummary, StageHistogram};
pub use metrics::{MetricsServer, exposition};
pub use passive_subscriber::{PassiveSubscriber, RawMessage};
pub use process_config::{Configured, ProcessConfig, minimal};
pub use publisher::{Overflow, Publisher, PublisherOptions, unix_nanos};
pub use readiness::{Barrier, NotReady, Route, RouteError, RoutesReady, process_id};
pub use rejection_log::{Rejection, RejectionLog, STRANGER};
pub use session::{BusOptions, Role as SessionRole, open};
pub use subscriber::{Arrival, Event, Inbox, Subscription};
pub use watchdog::Heartbeat;
