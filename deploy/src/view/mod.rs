//! A run to look at: a page with the scene from above, what crosses every link, and where the time goes.
//!
//! The page is part of this program and loads nothing from anywhere else. What it shows comes from a live run
//! ([`LiveRun`]), over a tap that nobody's books know of, or from a recorded one ([`RecordedRun`]); both put their messages
//! through the same [`FrameAssembler`], and a [`SceneFrame`] is what comes out.

pub mod demo;
mod frame_assembler;
mod live;
pub mod picture;
mod recorded;
mod scene_frame;
mod server;
#[cfg(test)]
mod tests;

pub use frame_assembler::{FrameAssembler, Seen};
pub use live::LiveRun;
pub use recorded::{RecordedRun, ViewError};
pub use scene_frame::SceneFrame;
pub use server::{serve_live, serve_recorded};
