//! Pose source that passes the measured pose on.

use perception::inference::Inference;
use protocol::PoseEstimate;

use super::settings::{PoseBasis, PoseSettings};
use super::{NO_SOURCE, PoseInput, PoseSource, PoseSourceError};

/// Returns the measured pose unchanged, with full confidence.
#[derive(Debug, Clone, Copy, Default)]
pub struct RecordedPose;

impl PoseSource for RecordedPose {
    fn estimate(&mut self, input: &PoseInput<'_>) -> PoseEstimate {
        input
            .measured
            .map_or(NO_SOURCE, |pose| PoseEstimate::new(*pose, 1.0))
    }
}

impl PoseSettings for RecordedPose {
    fn basis(&self) -> PoseBasis {
        PoseBasis::MeasuredPose
    }

    fn build(&self, _: Inference) -> Result<Box<dyn PoseSource>, PoseSourceError> {
        Ok(Box::new(*self))
    }
}
