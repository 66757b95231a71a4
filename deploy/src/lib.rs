//! The operator's side of the fleet: reads a scenario, starts and supervises the processes, scores what the ego
//! reports and writes it down.

pub mod fingerprint;
pub mod fleet;
pub mod metrics;
pub mod picture;
pub mod run_folder;
pub mod scenario;
pub mod score;
pub mod supervise;
