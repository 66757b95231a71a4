//! Extensions of PGC: steps that are not in the paper. Each file states the gain where it was measured.
//!
//! The first three search on while few cells of a sweep are inliers of its refined pose.

pub(super) mod along_street;
pub(super) mod levelling;
pub(super) mod other_parts;
pub mod wider_search;
