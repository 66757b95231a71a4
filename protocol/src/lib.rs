//! What crosses the air between connected automated vehicles (CAVs), and in which convention.
//!
//! This crate holds plain data and the two doors between that data and bytes. It knows no network, no clock, no file
//! and no tensor library.
//!
//! # Conventions
//!
//! They hold everywhere behind the readers of `sim-replay`, where the conventions of the datasets end.
//!
//! - Frames are right-handed: x forward, y left, z up. Lengths are metres, angles radians (degrees only where a name
//!   says `_deg` or a number is printed), heading and yaw turn x towards y.
//! - A transform is named target-from-source: `ego_from_cav` takes points of the CAV's LiDAR frame to the ego's.
//!   `world_from_cav` is the pose of a CAV, always of its LiDAR.
//! - A box is `(x, y, z, dx, dy, dz, heading)`: centre, full length, width and height.
//! - BEV maps are `[C, H, W]`: the row grows with y, the column with x.
//! - Times are nanoseconds: capture times on the clock of the scene, everything else on the Unix clock.

mod bev;
mod box3d;
mod id;
mod point_cloud;
mod pose;

pub use bev::{BevFeatures, BevGrid};
pub use box3d::{Box3d, Detection};
pub use id::{CavId, IdError, RunId};
pub use point_cloud::{Handedness, PointCloud};
pub use pose::{Pose, PoseError};
