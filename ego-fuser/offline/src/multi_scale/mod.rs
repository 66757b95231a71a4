//! Networks that fuse at every level of the backbone, as Where2comm and CoAlign were published: imported weights run
//! here, offline.
//!
//! Every level's maps are fused on their way to the up-sampling branch, while each agent's own go on down; so an agent
//! would have to send its first level's map, and the ego to run the rest of the backbone for everyone. That map is what
//! their bytes are counted by ([`MultiScaleOutput::sent_bytes`]); a live agent sends its last. What runs live of these
//! methods is the same fusion at a single scale ([`fusion::where2comm`], [`fusion::coalign`]), with weights
//! that were trained for it.

mod fuse;
mod network;
mod offline;

pub use fuse::{Levels, Placement, fuse_levels};
pub use network::{MULTI_SCALE_KIND, MultiScaleConfig, MultiScaleNetwork, MultiScaleOutput, Senders};
pub use offline::OfflineDetector;
