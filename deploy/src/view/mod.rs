//! Page of a run: the scene from above, the traffic of every link, and the latency of each stage.
//!
//! The page is part of this program and loads nothing from anywhere else. Its data come from a live run ([`LiveRun`]),
//! through a passive subscriber outside the message accounting, or from a recorded one ([`RecordedRun`]); both feed the
//! same `FrameAssembler`, which returns [`SceneFrame`]s.

mod frame_assembler;
mod heat_map;
mod judgement;
mod link_series;
mod live;
mod on_demand;
mod pace_counter;
mod recorded;
mod scene_frame;
mod server;
mod show;
#[cfg(test)]
mod tests;
mod trails;

pub use judgement::DetectionArea;
pub use live::LiveRun;
pub use pace_counter::ShownPace;
pub use recorded::{RecordedRun, ViewError};
pub use scene_frame::SceneFrame;
pub use server::{serve_live, serve_recorded};
pub use show::{show_recorded, until_stopped};
