//! The operator's side of the fleet: reads a scenario, starts and supervises the processes, scores what the ego
//! reports and writes it down.

pub mod metrics;
pub mod picture;
pub mod scenario;
pub mod supervise;
