//! Ego of a collaborating fleet: received BEV feature maps, poses and boxes in, detections around the ego out.
//!
//! - [`ego`]: the pipeline, the same live and offline; [`node`]: the process around it.
//! - [`pairing`]: the messages that belong to a frame.
//! - [`misbehaviour`]: neighbours whose messages contradict the ego's perception.
//!
//! Conventions of axes, units and boxes are those of [`protocol`].

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod config;
pub mod ego;
pub mod misbehaviour;
mod neighbourhood;
pub mod node;
pub(crate) mod pace_control;
pub mod pairing;
mod peer_models;
pub mod view;
