//! Networks that fuse at every level of the backbone, as Where2comm and CoAlign were published: imported weights run
//! here, offline.
//!
//! Every level's maps are fused before the up-sampling branch, while each agent's own maps continue to the next level;
//! so an agent would have to send its first level's map, and the ego to run the rest of the backbone for all agents.
//! Their bytes are those of that map ([`MultiScaleOutput::sent_bytes`]); a live agent sends its last. Live, these
//! methods run the same fusion at a single scale ([`fusion::where2comm`], [`fusion::coalign`]), with weights that were
//! trained for it.

mod fuse;
mod network;
mod offline;

pub use fuse::{MapAlignment, fuse_levels};
pub use network::{
    MULTI_SCALE_KIND, MultiScaleConfig, MultiScaleNetwork, MultiScaleOutput, Senders,
};
pub use offline::OfflineDetector;
