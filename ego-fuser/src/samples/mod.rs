//! Training samples: scenes on disk become batches of pillars, poses and targets.
//!
//! Everything random about a sample follows from the seed and the sample's number, so a resumed training sees what an
//! uninterrupted one would have seen, whatever the number of loader threads.

mod augment;
mod builder;
mod loader;
mod scenes;

pub use augment::{Augmentation, SceneAugment, ViewAugment};
pub use builder::{PoseNoise, Sample, SampleBuilder, SampleConfig, SampleKind, merge_points};
pub use loader::{Batch, batches};
pub use scenes::{SceneSet, TickRef};

use sim_replay::dataset::ReadError;

use crate::targets::LatticeError;

/// Why there is no next sample.
#[derive(Debug, thiserror::Error)]
pub enum SampleError {
    /// A file of a dataset is missing or malformed.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// A dataset has nothing to learn from.
    #[error("{0}")]
    Empty(String),
    /// A frame has no pose, so views cannot be put together.
    #[error("scenario {scenario}, tick {stem}: agent {cav} has no pose in the recording")]
    NoPose {
        /// The scenario.
        scenario: String,
        /// The tick.
        stem: String,
        /// The agent.
        cav: String,
    },
    /// The anchors of the configuration are no lattice.
    #[error(transparent)]
    Lattice(#[from] LatticeError),
}
