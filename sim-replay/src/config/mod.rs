//! Configurations of the processes of this crate: replay, link emulation, recorder. One type each for file, options and
//! schema.

mod link;
mod recorder;
mod replay;
mod scene;

pub use link::{LinkProcessConfig, LinkSelection};
pub use recorder::{RecorderConfig, RecordingConfig};
pub use replay::{ReplayConfig, SensorLinkConfig, WaitConfig};
pub use scene::SceneConfig;
