//! One run of a fleet, live or in simulation time: from a scenario to the metrics in its run folder.

pub mod capacity;
pub mod demo;
pub(crate) mod ledger_report;
pub(crate) mod loss;
pub(crate) mod machine;
pub mod report;
pub mod run_fleet;
pub mod stepped;
