//! Output of an agent: what it finds in one sweep.

use protocol::{BevFeatures, Detection, PoseEstimate, StageTiming};

/// Result of the detector for one sweep.
#[derive(Debug, Clone, PartialEq)]
pub struct Perception {
    /// The BEV feature map for intermediate fusion as it is transmitted: with a compressor, its code.
    pub features: BevFeatures,
    /// `[H, W]`, 0..1: probability of a vehicle per cell; selects the cells that are sent. Empty without head.
    pub confidence: Vec<f32>,
    /// Detections of this vehicle by itself, in its own LiDAR frame, for late fusion. Empty without head.
    pub detections: Vec<Detection>,
    /// Durations: the encoder's stages, the copy of the map out of the tensor library, the head, and decoding with
    /// suppression.
    pub times: Vec<StageTiming>,
}

/// Pose and perception of one sweep.
#[derive(Debug, Clone, PartialEq)]
pub struct AgentOutput {
    /// Pose of the vehicle, or the reason why there is none.
    pub pose: PoseEstimate,
    /// Perception of the vehicle.
    pub perception: Perception,
}
