//! Common parts of all trainings: options, steps and checkpoints, prefetched batches, results.

pub mod checkpoint;

mod adamw;
mod card;
mod curve;
mod data_listing;
mod error;
mod interruption;
mod options;
mod prefetch;
mod run_config;
mod schedule;
mod task;
mod trainer;

pub use adamw::{AdamW, AdamWConfig};
pub use card::ModelCard;
pub use curve::Curve;
pub use data_listing::DataListing;
pub use error::TrainingError;
pub use interruption::Interruption;
pub use options::{OptionsError, TrainingOptions, check_out};
pub use prefetch::Prefetch;
pub use run_config::{Length, RunConfig};
pub use schedule::{RateSchedule, one_cycle};
pub use task::{Means, Observe, SaveEvery, StepReport, Task, TrainingEvent};
pub use trainer::{Trained, Trainer};
