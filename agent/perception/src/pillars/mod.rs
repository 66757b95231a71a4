//! Pillars: from a point cloud to the canvas of the backbone.

pub mod batch;
pub mod encoder;
pub mod point_pillars;
pub mod projection;
pub mod voxels;
