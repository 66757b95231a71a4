//! Accuracy of a model on validation frames.

use serde::Serialize;

/// AP over the frames of a validation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Accuracy {
    /// Frames.
    pub frames: usize,
    /// AP at 0.3, 0.5 and 0.7, sorted over all frames.
    pub ap_global: [f64; 3],
    /// The same in the order of frames.
    pub ap_frame_order: [f64; 3],
}
