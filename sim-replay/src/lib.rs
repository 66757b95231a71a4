//! Scenes as live traffic: replay, inspection and recording, and the link process between agents and ego.
//!
//! - [`stream`]: publishes the sensor data of a scene at the pace of its capture times, or in lockstep.
//! - [`link_node`]: link emulation between the agents and an ego of a live run.
//! - [`inspect`]: contents and problems of a data set.
//! - [`recorder`]: every message of a run in one MCAP file.

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod config;
pub mod inspect;
pub mod link_node;
pub mod recorder;
pub mod stream;
