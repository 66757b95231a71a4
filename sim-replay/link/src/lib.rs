//! The emulated air: what a wireless link does to messages, message by message, above zenoh.
//!
//! Stages, in order: queue and rate cap, outages, loss, propagation delay, reordering, duplication. Every decision follows
//! from the seed, the link and the message's own numbers, so the same messages meet the same fate on either clock, in one
//! process or in many.
//!
//! - [`LinkConfig`]: the stages, with [`LinkConfig::preset`] for links that others have described.
//! - [`LinkEmulator`]: takes [`Packet`]s and says when and whether they arrive.
//! - [`node`]: the same between the agents and an ego of a live run.
//! - [`DeviceClock`]: offset and drift of the clock of those who send, by which their capture times are off.

mod capacity;
mod chance;
mod config;
mod delay;
mod device_clock;
mod emulator;
mod loss;
mod preset;
mod queue_server;
mod trace;
mod trace_config;

pub use config::{
    CapacityConfig, DelayModel, LinkConfig, LinkError, LossModel, LossUnit, Medium, Outage, QueueConfig, QueueDrop,
    ReorderConfig,
};
pub use device_clock::{ClockStep, DeviceClock};
pub use emulator::{Delivery, LinkEmulator, Outcome, Packet};
pub use preset::PRESETS;
pub use trace::{Step, Trace, TraceError};
pub use trace_config::TraceConfig;
