//! Localization of one vehicle from its LiDAR sweep.
//!
//! - [`pgc`]: pose generation with confidence, the method of the paper: scene-coordinate regression and a robust
//!   solver.
//! - [`map_search`]: the pose of a sweep on a surfel map, without any training.
//! - [`baselines`]: networks that the paper compares it with.
//! - [`registration`]: pose from correspondences (Kabsch, RANSAC, SC2-PCR) and ICP.
//! - [`pose_source`]: origins of a vehicle's pose: recorded, noisy, estimated by one of the above.
//! - [`tracker`]: the pose from sweep to sweep, with its covariance.
//! - [`pose_covariance`]: covariance of the pose of one sweep; [`covariance_scale`]: its fitted size.
//! - [`statistics`]: measures of their accuracy.
//!
//! ```
//! use localization::registration::kabsch::PairMoments;
//! use nalgebra::Vector3;
//! use protocol::{Pose, PoseError};
//!
//! # fn main() -> Result<(), localization::registration::kabsch::Degenerate> {
//! // Points of a sweep and the same points in the world, 2 m to the north.
//! let mut pairs = PairMoments::default();
//! for point in [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]] {
//!     let lidar = Vector3::from(point);
//!     pairs.add(&lidar, &(lidar + Vector3::new(0.0, 2.0, 0.0)), 1.0);
//! }
//! let world_from_lidar = pairs.fit()?;
//! assert!((world_from_lidar.translation.y - 2.0).abs() < 1e-9);
//!
//! let error = PoseError::between(&Pose::from_xyz_yaw([0.0, 2.1, 0.0], 0.0), &Pose::from_xyz_yaw([0.0, 2.0, 0.0], 0.0));
//! assert!((error.distance_m - 0.1).abs() < 1e-9);
//! # Ok(())
//! # }
//! ```

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod baselines;
pub mod covariance_scale;
pub mod map_registration;
pub mod map_search;
pub mod pgc;
pub mod place_localizer;
pub mod pose_covariance;
pub mod pose_source;
pub mod registration;
pub mod statistics;
pub mod tracker;
