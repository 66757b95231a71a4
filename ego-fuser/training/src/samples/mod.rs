//! Training samples: scenes on disk become batches of pillars, poses and targets.
//!
//! Everything random about a sample follows from the seed and the sample's number, so a resumed training gets the same
//! samples as an uninterrupted one, whatever the number of loader threads.

mod augment;
mod builder;
mod loader;
mod moments;
mod neighbour_boxes;
mod poses;
mod refined_boxes;
mod scenes;

pub use augment::{Augmentation, ViewAugment};
pub use builder::{Sample, SampleBuilder, SampleConfig, SampleKind, Views};
pub use loader::{Batch, batches};
pub use moments::Moments;
pub(crate) use neighbour_boxes::augmentation_summary as box_augmentation;
pub use poses::{PoseOffset, SamplePoses};
pub use scenes::{SceneSet, TickRef};
