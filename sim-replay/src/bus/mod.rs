//! The bus between the processes of a run: zenoh, with every default that loses data replaced by a rule of ours.
//!
//! - One process routes on a fixed endpoint, the others connect to it; nothing is discovered ([`open`]).
//! - No producer waits for the network and no callback of zenoh's waits for a consumer: between them lie bounded
//!   mailboxes in which the newest wins ([`mailbox`], [`Publisher`], [`Inbox`]).
//! - What is overwritten, refused or still under way is counted ([`Books`]), and the books are published.
//! - A scene starts when every route has carried something ([`Barrier`]).
//! - With keys every process shows who it is, and the router lets it say only what is its to say ([`Credentials`],
//!   [`Guard`]); what it refused is counted ([`Refusals`]).
//! - Ending takes a bounded time, whatever the network does ([`shutdown`]).
//!
//! Nothing here is async: zenoh brings its own runtimes, and a `put` that waits for a slow network must not hold up an
//! executor. Inside tokio it needs the multi-thread runtime.

mod args;
mod books;
mod clock_offset;
mod credentials;
mod endpoint;
mod error;
mod freshness;
mod guard;
mod handshakes;
mod inbox_limits;
mod liveliness;
pub mod mailbox;
mod membership;
mod metrics;
mod notices;
mod plain_tcp;
mod publisher;
mod pulse;
mod readiness;
mod receipt;
mod refusals;
mod roll_call;
mod session;
pub mod shutdown;
mod subscriber;
mod tap;
mod yielding;

pub use args::{BusArgs, PeerArgs, STOP_LIMIT, log_to_stderr};
pub use books::{Books, PeerSummary, StageHistogram};
pub use credentials::{AUTHORITY_FILE, CERTIFICATE_FILE, Credentials, KEY_FILE, MEMBERS_FILE, ROUTER};
pub use endpoint::Endpoint;
pub use error::BusError;
pub use guard::Guard;
pub use inbox_limits::InboxLimits;
pub use liveliness::{Presence, Sighting, Watch, present};
pub use membership::{Bus, Identity};
pub use metrics::{MetricsServer, exposition};
pub use publisher::{Overflow, Publisher, PublisherOptions, unix_nanos};
pub use pulse::Working;
pub use readiness::{Attended, Barrier, NotReady, Route, RouteError, process_id};
pub use refusals::{Refusal, Refusals, STRANGER};
pub use roll_call::RollCall;
pub use session::{BusOptions, Role as SessionRole, open};
pub use subscriber::{Arrival, Event, Inbox, Subscription};
pub use tap::{Overheard, Tap};
