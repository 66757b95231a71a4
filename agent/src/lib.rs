//! Agent of one connected vehicle: pose and BEV features of each of its sweeps, published on the bus.
//!
//! - [`agent`]: the pipeline, synchronous and without a network; [`node`]: the process around it.
//! - [`rate`]: bytes per message under a byte budget; `sweep_pairing`: sweep and starting pose of one capture time.
//! - [`attack`]: falsified messages, for experiments on misbehaviour detection.

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod agent;
pub mod attack;
pub mod config;
pub mod node;
pub mod output_filter;
pub mod rate;
pub mod sweep_log;
pub(crate) mod sweep_pairing;
pub(crate) mod sweep_selection;
