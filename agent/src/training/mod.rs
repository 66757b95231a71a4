//! What every training here has in common: optimizer, learning rate, checkpoints.

pub mod checkpoint;

mod adamw;
mod schedule;

pub use adamw::{AdamW, AdamWConfig, Step};
pub use checkpoint::CheckpointError;
pub use schedule::OneCycle;
