//! Baselines of the paper's localization tables, small, and the floor that a regression has to beat.

mod by_kind;
pub mod diffloc;
pub mod hypliloc;
mod layers;
mod lightloc;
mod regressed_pose;
mod retrieval;
pub mod sgloc;

pub use by_kind::load_baseline;
pub use hypliloc::HypLiLocLocalizer;
pub use lightloc::LightLoc;
pub use regressed_pose::{PoseRegressor, RegressPose};
pub use retrieval::{DescribedSweep, Retrieval, SweepDatabase};
