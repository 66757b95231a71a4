//! Operation of a fleet: its processes, network, keys, health and files.

pub(crate) mod failures;
pub mod health;
pub mod keys;
pub mod network;
pub mod progress;
pub mod remote_status;
pub(crate) mod router_panic;
pub mod router_report;
pub(crate) mod router_watch;
pub mod run_folder;
pub mod security;
pub mod status;
pub mod status_reporter;
pub mod supervise;
pub mod timeouts;

/// Name of the process that plays the scene.
pub const REPLAY: &str = "replay";
/// Name of the process that records all messages.
pub const RECORDER: &str = "recorder";
