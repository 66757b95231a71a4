//! Localization of one vehicle from its LiDAR sweep.
//!
//! - [`pgc`]: pose generation with confidence, the method of the paper: scene-coordinate regression and a robust
//!   solver.
//! - [`competitors`]: networks that the paper compares it with.
//! - [`registration`]: pose from correspondences (Kabsch, RANSAC, SC2-PCR) and ICP.
//! - [`pose_source`]: origins of a vehicle's pose: recorded, noisy, estimated by one of the above.
//! - [`tracker`]: the pose from sweep to sweep, with its covariance.
//! - [`pose_covariance`]: covariance of the pose of one sweep.
//! - [`pose_error`], [`statistics`]: measures of their accuracy.

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod competitors;
pub mod pgc;
pub mod pose_covariance;
pub mod pose_error;
pub mod pose_source;
pub mod registration;
pub mod statistics;
pub mod tracker;
