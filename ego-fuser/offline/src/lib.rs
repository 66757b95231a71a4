//! Offline evaluation: methods, alignments and delays on recorded or generated scenes, without a network.
//!
//! - [`evaluation`]: average precision, pose errors and bytes of a method; the same with delays in simulation time.
//! - [`alignment`]: pose correction between two vehicles without GNSS, compared.
//! - [`alignment_error`]: the error that a method's own alignment leaves.
//! - [`scale_search`]: scales of activations for 8-bit inference.
//! - [`multi_scale`]: fusion on every level of the backbone, as the original detectors have it.
//!
//! The ego's process does not link this crate, and with it none of the data-set readers.
//!
//! ```
//! use ego_fuser_offline::alignment::{align_boxes, free_align::MIN_MATCHES};
//! use protocol::Box3d;
//!
//! # fn main() -> Result<(), ego_fuser_offline::alignment::NoAlignment> {
//! // The same parked cars, seen by the ego and by a neighbour 20 m behind it.
//! let cars = [[3.0, 4.0], [17.0, -4.0], [29.0, 9.0], [8.0, -15.0], [41.0, 2.0], [12.0, 21.0]];
//! let boxes = |ahead_m: f64| {
//!     let size_m = [4.5, 1.9, 1.6];
//!     cars.map(|[x, y]| Box3d { center_m: [x + ahead_m, y, -1.0], size_m, heading_rad: 0.0 })
//! };
//! let aligned = align_boxes(&boxes(0.0), &boxes(20.0), MIN_MATCHES)?;
//! assert!((aligned.ego_from_neighbour.translation.vector.x + 20.0).abs() < 0.01);
//! # Ok(())
//! # }
//! ```

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod alignment;
pub mod alignment_error;
pub mod evaluation;
pub mod multi_scale;
pub mod scale_search;
