//! Baselines of the paper's localization tables, small, and the floor that a regression has to beat.

mod by_kind;
pub mod diffloc;
pub mod hypliloc;
mod layers;
mod lightloc;
pub mod place_classes;
mod polar_retrieval;
mod regressed_pose;
mod retrieval;
pub mod sgloc;
pub mod tokens;

pub use by_kind::{load_baseline, load_descriptor};
pub use hypliloc::HypLiLocLocalizer;
pub use lightloc::LightLoc;
pub use polar_retrieval::{DescribePolar, PolarRetrieval, ScanContext};
pub use regressed_pose::{PoseRegressor, PoseRegressorConfig, RegressPose};
pub use retrieval::{Retrieval, SweepDatabase};
