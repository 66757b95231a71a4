//! Operation of a fleet: its processes, network, keys, health and files.

pub mod progress;
mod run_error;
pub use run_error::RunError;
pub(crate) mod agent_pool;
pub(crate) mod failures;
pub mod fleet;
pub mod health;
pub mod keys;
pub mod network;
pub mod remote_status;
pub mod run_folder;
pub mod security;
pub mod status;
pub(crate) mod status_reporter;
pub(crate) mod supervise;
