//! Replay of a scene as live traffic: every vehicle's sensors on the bus, at the recorded pace or another.
//!
//! - [`Schedule`]: order of the ticks, and their time on the replay's clock.
//! - `ReplayClock`: wall-clock time of a tick; pause, step, rate.
//! - `ReadAhead`: reads the next ticks during the wait for the current one.
//! - [`SensorLinkReport`]: counters of frames on an emulated link to the agents.
//! - [`Place`]: state of the replay, from which a restarted one resumes.
//! - [`Replay`]: the main loop, controlled over `control/*`.

mod checkpoint;
mod clock;
mod read_ahead;
mod replay;
mod report;
mod schedule;
mod sensor_link;
mod sensor_publisher;

pub use checkpoint::Place;
pub(crate) use clock::ReplayClock;
pub use replay::{Replay, StreamError, StreamOptions};
pub use report::{Lateness, StreamReport, Unreadable};
pub use schedule::{Planned, Position, Schedule};
pub use sensor_link::SensorLinkReport;
