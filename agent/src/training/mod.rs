//! What every training here has in common: optimizer, learning rate, checkpoints, batches ahead, a progress bar.

pub mod checkpoint;

mod adamw;
mod bar;
mod options;
mod prefetch;
mod schedule;

pub use adamw::{AdamW, AdamWConfig, Step};
pub use bar::TrainingBar;
pub use checkpoint::CheckpointError;
pub use options::{ComputePrecision, Length};
pub use prefetch::Prefetch;
pub use schedule::OneCycle;
