//! Link emulation: the effect of a wireless link on messages, message by message, above zenoh.
//!
//! Stages, in order: queue and rate limit, outages, loss, propagation delay, reordering, duplication. Every decision
//! follows from the seed, the link and the message's own numbers, so the same messages get the same results on either
//! clock, in one process or in many.
//!
//! - [`LinkConfig`]: the stages, with [`LinkConfig::preset`] for published link models.
//! - [`LinkEmulator`]: takes [`Packet`]s and returns their arrivals and losses.
//! - `sim_replay::link_node`: the same between the agents and an ego of a live run.
//! - [`DeviceClock`]: offset and drift of the senders' clock, which shift their capture times.
//!
//! ```
//! use link::{Delivery, LinkEmulator, Packet};
//! use protocol::{CavId, Stream};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // OpenCOOD's constant delay of 100 ms; the seed decides losses and delays of other models.
//! let mut link = LinkEmulator::open("opencood-sim", 1)?;
//! let (from, to) = (CavId::new("4288")?, CavId::new("4279")?);
//! let (id, sequence, submitted_nanos) = (1, 0, 0);
//! link.submit(Packet { id, from, to, stream: Stream::Bev, sequence, bytes: 75_000, submitted_nanos, distance_m: 20.0 });
//! let outcomes = link.advance(1_000_000_000);
//! assert_eq!(outcomes[0].nanos, 100_000_000);
//! assert!(matches!(outcomes[0].delivery, Delivery::Arrived { .. }));
//! # Ok(())
//! # }
//! ```

// This crate reads what other processes and people wrote: an index or a cast that does not fit is an error there, not
// a panic or another number.
#![cfg_attr(not(test), deny(clippy::cast_possible_truncation))]
#![cfg_attr(not(test), deny(clippy::cast_sign_loss))]
#![cfg_attr(not(test), deny(clippy::indexing_slicing))]

mod capacity;
mod config;
mod device_clock;
mod emulator;
mod latency;
mod loss;
mod packet;
mod preset;
mod queue_server;
mod trace;
mod trace_config;

pub use config::{
    CapacityConfig, LatencyModel, LinkConfig, LinkError, LossModel, LossUnit, Medium, Outage,
    QueueConfig, QueueDrop, ReorderConfig,
};
pub use device_clock::{ClockStep, DeviceClock};
pub use emulator::{Delivery, LinkEmulator, PacketOutcome};
pub use packet::Packet;
pub use preset::PRESETS;
pub use trace::{Step, Trace};
pub use trace_config::TraceConfig;
