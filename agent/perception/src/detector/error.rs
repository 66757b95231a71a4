//! Errors of a detector.

use protocol::WireError;
use tch::TchError;

use crate::boxes::decode::DecodeError;
use crate::model_config::ConfigError;
use crate::torch_error::first_line;
use crate::weights::FileError;

/// Result of loading or running a detector: a [`DetectorError`] if nothing else is named.
pub(crate) type Result<T, E = DetectorError> = std::result::Result<T, E>;

/// Error of loading a detector or of running it.
#[derive(Debug, thiserror::Error)]
pub enum DetectorError {
    /// The weights are not readable or made for another model.
    #[error(transparent)]
    Weights(#[from] FileError),
    /// The configuration does not describe a network.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The vehicle has no detector.
    #[error("this vehicle has no detector: it gives poses only")]
    Absent,
    /// A feature map, by its name, has a shape other than that of this detector's, which follows it.
    #[error("{0} is {1:?}, this detector's is {2:?} (channels, height, width)")]
    Shape(&'static str, Vec<i64>, [i64; 3]),
    /// A sweep has no point that the detector could use: a blind sensor, or coordinates of another frame or unit.
    #[error(
        "none of the {points} points of the sweep lies in the area of the detector, {area_m:?} m (x, y, z low, then high)"
    )]
    NoPoints {
        /// Number of points of the sweep.
        points: usize,
        /// Area of the detector, metres in the frame of the LiDAR.
        area_m: [f64; 6],
    },
    /// A feature map or an output of the head is NaN, infinite or absurdly large.
    #[error("{what} holds {value}, valid are absolute values up to {limit}")]
    Values {
        /// Name of the tensor.
        what: &'static str,
        /// Value that is not valid.
        value: f64,
        /// Largest valid absolute value.
        limit: f64,
    },
    /// A detected box that a message refuses.
    #[error("a detected box: {0}")]
    Box(WireError),
    /// Most values of a level of the backbone, by its number from 0, are the largest that 8 bits hold.
    #[error(
        "most values of level {0} of the backbone exceed 8 bits: the scales of its activations are too small"
    )]
    Saturated(usize),
    /// The output of the head does not fit the anchors.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// The tensor library failed.
    #[error("tensor library: {}", first_line(.0))]
    Tensor(#[from] TchError),
}

impl DetectorError {
    /// True if one frame cannot be computed, and others may be: its data or values are not usable.
    pub fn is_of_frame(&self) -> bool {
        matches!(
            self,
            Self::NoPoints { .. } | Self::Values { .. } | Self::Box(_) | Self::Saturated(_)
        )
    }
}
