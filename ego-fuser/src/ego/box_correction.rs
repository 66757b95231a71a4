//! Pose correction by the boxes that neighbours' maps show.
//!
//! The head applied to a single vehicle's map gives that vehicle's ego-only boxes. The ego has both, map and head: it
//! detects in a neighbour's map the boxes that the neighbour would have sent, without waiting for another message.

use perception::boxes::postprocess::{PostprocessConfig, detections};
use perception::detector::{Detector, DetectorError};
use protocol::Detection;
use tch::Tensor;

use fusion::MapMetadata;
use fusion::pose_graph::{Observer, PoseGraphConfig, correct};

/// Boxes at or below this score are no landmarks: the reference's threshold for boxes that correct poses. It is
/// independent of the boxes that are scored.
const LANDMARK_SCORE: f32 = 0.2;

/// Corrects the poses in `metadata` by the boxes in each map `[1, C, H, W]`; the ego's pose is fixed.
pub(super) fn correct_by_boxes(
    metadata: &mut [MapMetadata],
    maps: &[Tensor],
    detector: &Detector,
    config: &PoseGraphConfig,
) -> Result<(), DetectorError> {
    if metadata.len() < 2 {
        return Ok(());
    }
    let boxes = maps
        .iter()
        .map(|map| boxes_in(map, detector))
        .collect::<Result<Vec<_>, _>>()?;
    let observers: Vec<Observer<'_>> = (metadata.iter().zip(&boxes))
        .map(|(map, boxes)| Observer {
            ego_from_agent: map.ego_from_cav,
            boxes,
        })
        .collect();
    for (map, corrected) in metadata.iter_mut().zip(correct(&observers, config)) {
        map.ego_from_cav = corrected.ego_from_agent;
    }
    Ok(())
}

/// Ego-only detections of a vehicle, in its own frame.
fn boxes_in(map: &Tensor, detector: &Detector) -> Result<Vec<Detection>, DetectorError> {
    let limits = PostprocessConfig {
        score_threshold: LANDMARK_SCORE,
        ..PostprocessConfig::for_late_fusion(detector.config())
    };
    let boxes = detector.boxes(&detector.heads(map)?, limits.score_threshold)?;
    Ok(detections(&boxes, &limits))
}
