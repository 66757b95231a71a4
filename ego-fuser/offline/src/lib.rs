//! Offline evaluation: methods, alignments and delays on recorded or generated scenes, without a network.
//!
//! - [`evaluation`]: average precision, pose errors and bytes of a method; the same with delays in simulation time.
//! - [`alignment`]: pose correction between two vehicles without GNSS, compared.
//! - [`alignment_error`]: the error that a method's own alignment leaves.
//! - [`scale_search`]: scales of activations for 8-bit inference.
//! - [`multi_scale`]: fusion on every level of the backbone, as the original detectors have it.
//!
//! The ego's process does not link this crate, and with it none of the data-set readers.

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod alignment;
pub mod alignment_error;
pub mod evaluation;
pub mod multi_scale;
pub mod scale_search;
