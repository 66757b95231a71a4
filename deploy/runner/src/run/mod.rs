//! One run of a fleet, live or in simulation time: from a scenario to the metrics in its run folder.

pub(crate) mod agent_pool;
pub mod capacity;
mod common;
pub mod demo;
pub(crate) mod ledger_report;
pub(crate) mod loss;
pub mod machine;
mod picture;
pub(crate) mod router_process;
mod run_error;
pub mod run_fleet;
pub mod stepped;

pub(crate) use run_error::Result;
pub use run_error::RunError;
