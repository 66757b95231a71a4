//! Boxes: from the outputs of the heads to detections.

pub mod anchors;
pub mod decode;
pub mod nms;
pub mod postprocess;
pub mod refinement;
pub mod roi;
