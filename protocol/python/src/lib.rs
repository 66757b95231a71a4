//! Python package `v2vloc`: messages, live fleets, recordings, data sets and average precision as NumPy arrays.
//!
//! Names, shapes and units are documented where Python shows them: in `v2vloc.pyi`. Every conversion to Python is in a
//! file of its own; what they convert are the types of [`protocol`] and [`dataset`].

mod arrays;
mod average_precision;
mod data_set;
mod decode;
mod error;
mod frame;
mod frame_parts;
mod json;
mod listener;
mod live_frames;
mod payload;
mod recording_frames;
mod subscriptions;

use pyo3::pymodule;

/// Live fleets, recordings and data sets of v2vloc as NumPy arrays.
///
/// Frames are right-handed: x forward, y left, z up; metres, radians, nanoseconds. A transform is named
/// target-from-source: `world_from_cav` moves points of a vehicle's LiDAR frame to the world. A box is
/// `x, y, z, dx, dy, dz, heading`: centre, full length, width and height, rotation from x towards y.
#[pymodule(name = "v2vloc")]
mod package {
    #[pymodule_export]
    use crate::average_precision::average_precision;
    #[pymodule_export]
    use crate::data_set::{DataSet, read};
    #[pymodule_export]
    use crate::decode::{PyMessage, decode};
    #[pymodule_export]
    use crate::error::Error;
    #[pymodule_export]
    use crate::frame::{FleetFrame, PyAgent};
    #[pymodule_export]
    use crate::listener::{Listener, MessageIterator, listen};
    #[pymodule_export]
    use crate::payload::{Objects, PyBev, PyCamera, PyDetections, PyPoseEstimate, PyTracks};
}
