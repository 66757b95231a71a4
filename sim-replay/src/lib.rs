//! Scenes as live traffic: reading recorded scenes, generating new ones, streaming both, and the emulated air between
//! vehicles.
//!
//! Recorded datasets differ in axes, units, pose formats and file layouts. All of that ends at this crate's readers:
//! behind [`dataset::open`] there is one [`frame::Frame`], in the conventions of [`protocol`].

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod bounded;
pub mod bus;
pub mod carla_pose;
pub mod class_set;
pub mod dataset;
pub mod evaluation_protocol;
pub mod frame;
pub mod ground_truth;
pub mod inspect;
pub mod link;
pub mod output;
pub mod pcd;
pub mod random;
pub mod recording;
pub mod stream;
pub mod synth;
pub mod town;
pub mod web;
pub mod whole_file;
