//! Bus between the processes of a run, on zenoh, with every default that loses data replaced by an explicit rule.
//!
//! - One process routes on a fixed endpoint, the others connect to it; there is no discovery ([`open`]).
//! - No producer waits for the network and no callback of zenoh waits for a consumer: between them are bounded queues
//!   that keep the newest message ([`bounded_queue`], [`Publisher`], [`Inbox`]).
//! - Overwritten, rejected and in-flight messages are counted ([`MessageStats`]), and the ledger is published.
//! - No receiver stops the messages of the others; what a router drops for one is counted there (`egress`,
//!   `delivery_gaps`).
//! - A scene starts when every route has carried a message ([`Barrier`]).
//! - With keys every process is authenticated, and the router restricts it to its own topics ([`Credentials`],
//!   [`AccessControl`]); rejected messages are counted ([`RejectionLog`]).
//! - Shutdown takes a bounded time, whatever the state of the network ([`shutdown`]).
//!
//! The crate is not async: zenoh has its own runtimes, and a `put` that waits for a slow network must not block an
//! executor. Inside tokio it needs the multi-thread runtime.
//!
//! ```
//! use bus::bounded_queue::{BoundedQueue, PushOutcome};
//!
//! // KEEP_LAST(1) for each of at most 64 senders: the caller counts the message that was replaced.
//! let queue = BoundedQueue::new(1, 64);
//! assert_eq!(queue.push("4279", "map of frame 1"), PushOutcome::Queued);
//! assert_eq!(queue.push("4279", "map of frame 2"), PushOutcome::Replaced("map of frame 1"));
//! ```

// This crate reads what other processes and people wrote: an index or a cast that does not fit is an error there, not
// a panic or another number.
#![cfg_attr(not(test), deny(clippy::cast_possible_truncation))]
#![cfg_attr(not(test), deny(clippy::cast_sign_loss))]
#![cfg_attr(not(test), deny(clippy::indexing_slicing))]

mod access_control;
mod args;
mod batch_scheduling;
pub mod bounded_queue;
mod bus;
mod clock_offset;
mod credentials;
mod delivery_gaps;
mod egress;
mod endpoint;
mod error;
mod flush_barrier;
mod frame_stats;
mod handshake_failures;
mod heartbeat;
mod inbox_limits;
mod liveliness;
pub mod malloc_settings;
mod membership;
mod message_stats;
mod metrics;
mod passive_subscriber;
mod plain_tcp;
mod process_config;
mod process_usage;
mod publisher;
mod readiness;
mod rejection_log;
mod replay_window;
mod router_contact;
mod router_probe;
mod session;
mod shared_pool;
pub mod shutdown;
mod status_publisher;
mod subscriber;
mod watchdog;
pub mod web;

pub use access_control::AccessControl;
pub use args::{BusConfig, InboxConfig, log_to_stderr};
pub use bus::{Bus, Identity};
pub use clock_offset::{NETWORK_TRANSIT_S, is_same_clock, longest_transit_s};
pub use credentials::{
    AUTHORITY_FILE, CERTIFICATE_FILE, Credentials, KEY_FILE, MEMBERS_FILE, ROUTER,
};
pub use endpoint::Endpoint;
pub use error::{BusError, Result};
pub use frame_stats::FrameStats;
pub use heartbeat::Heartbeat;
pub use inbox_limits::InboxLimits;
pub use liveliness::{LivelinessToken, present, tokens};
pub use membership::Membership;
pub use message_stats::{MessageStats, SharedMemoryUse};
pub use metrics::MetricsPeer;
pub use passive_subscriber::{PassiveSubscriber, RawMessage};
pub use process_config::{Configured, ProcessConfig, minimal};
pub use process_usage::{process_cpu_s, process_usage};
pub use publisher::{Publisher, PublisherOptions, has_subscribers, unix_nanos};
pub use readiness::{Barrier, NotReady, Route, RoutesReady, process_id};
pub use rejection_log::{RejectionLog, RouterRejection};
pub use router_probe::RouterProbe;
pub use session::{BusOptions, Role as SessionRole, SharedMemory, free_address, open, open_unless};
pub use shared_pool::check_room;
pub use shutdown::STOP_LIMIT;
pub use subscriber::{Arrival, Event, Inbox, Subscription};
