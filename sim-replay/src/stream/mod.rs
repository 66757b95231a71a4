//! A scene as live traffic: every vehicle's sensors on the bus, at the pace they were recorded at or another.
//!
//! - [`Schedule`]: which tick comes next, and its time on the replay's clock.
//! - [`ReplayClock`]: when that is on the wall; pause, step, rate.
//! - [`ReadAhead`]: the next ticks are read while the current one is waited for.
//! - [`AirReport`]: what became of frames that cross an emulated link on their way.
//! - [`Place`]: how far it is, for one that falls and is started again.
//! - [`Replay`]: the loop over them, steered over `control/*`.

mod checkpoint;
mod clock;
mod read_ahead;
mod replay;
mod report;
mod schedule;
mod sensor_link;
mod sensor_publisher;

pub use checkpoint::{BookmarkError, Place};
pub use clock::ReplayClock;
pub use read_ahead::{ReadAhead, TickFrames};
pub use replay::{Replay, StreamError, StreamOptions};
pub use report::{Lateness, StreamReport, Unreadable};
pub use schedule::{Planned, Position, Schedule};
pub use sensor_link::AirReport;
