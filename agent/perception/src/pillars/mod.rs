//! Pillars: from a point cloud to the BEV feature map that a backbone takes.

pub mod batch;
pub mod encoder;
pub mod point_pillars;
pub mod projection;
pub mod voxels;
