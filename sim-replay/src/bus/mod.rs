//! The bus between the processes of a run: zenoh, with every default that loses data replaced by a rule of ours.
//!
//! - One process routes on a fixed endpoint, the others connect to it; nothing is discovered ([`session`]).
//! - No producer waits for the network and no callback of zenoh's waits for a consumer: between them lie bounded
//!   mailboxes in which the newest wins, and whatever is overwritten is counted ([`mailbox`]).
//! - Ending takes a bounded time, whatever the network does ([`shutdown`]).

pub mod mailbox;
mod session;
pub mod shutdown;

pub use session::{BusError, BusOptions, Endpoint, Role, open};
