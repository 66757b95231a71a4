//! Pose correction by boxes: those that neighbours' maps show, and those that neighbours send.
//!
//! The head applied to a single vehicle's map gives that vehicle's ego-only boxes. The ego has both, map and head: it
//! detects in a neighbour's map the boxes that the neighbour would have sent, without waiting for another message.

use perception::boxes::postprocess::{PostprocessConfig, detections};
use perception::detector::{Detector, DetectorError};
use protocol::{Detection, Pose};
use tch::Tensor;

use fusion::MapMetadata;
use fusion::pose_graph::{Observer, PoseGraphConfig, correct};

/// Boxes at or below this score are no landmarks: the reference's threshold for boxes that correct poses. It is
/// independent of the boxes that are scored.
const LANDMARK_SCORE: f32 = 0.2;
/// Largest distance between the centres of two boxes that match, metres in the plane. Chosen on validation scenes, as the next one.
const MATCHED_M: f64 = 0.7;
/// Number of boxes that a correction has to match in addition.
const MORE_MATCHES: usize = 2;

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
    let boxes = maps.iter().map(|map| boxes_in(map, detector));
    let boxes = boxes.collect::<Result<Vec<_>, _>>()?;
    let observers: Vec<Observer<'_>> = (metadata.iter().zip(&boxes))
        .map(|(map, boxes)| Observer {
            ego_from_agent: map.ego_from_cav,
            boxes,
        })
        .collect();
    for (map, corrected) in metadata.iter_mut().zip(correct(&observers, config)) {
        map.ego_from_cav = corrected;
    }
    Ok(())
}

/// The pose of a neighbour that sent boxes, corrected by those that the ego detects, too, if at least [`MORE_MATCHES`] more
/// of them match then. Each neighbour by itself: a false message moves no other.
pub(super) fn corrected(ego_from_cav: Pose, received: &[Detection], own: &[Detection]) -> Pose {
    let config = PoseGraphConfig {
        min_score: LANDMARK_SCORE,
        ..PoseGraphConfig::default()
    };
    let pair = [(Pose::IDENTITY, own), (ego_from_cav, received)];
    let pair = pair.map(|(ego_from_agent, boxes)| Observer {
        ego_from_agent,
        boxes,
    });
    let corrected = correct(&pair, &config)[1];
    let before = matched_boxes(&ego_from_cav, received, own);
    match matched_boxes(&corrected, received, own) >= before + MORE_MATCHES {
        true => corrected,
        false => ego_from_cav,
    }
}

/// Number of sent landmarks that match a box of the ego where a pose places them.
fn matched_boxes(ego_from_cav: &Pose, received: &[Detection], own: &[Detection]) -> usize {
    let ego_from_cav = ego_from_cav.isometry();
    let landmarks = received.iter().filter(|one| one.score >= LANDMARK_SCORE);
    let centres = landmarks.map(|one| one.box3d.transformed(&ego_from_cav).center_m);
    let matched = centres.filter(|[x, y, _]| {
        let mut own = own.iter().map(|own| own.box3d.center_m);
        own.any(|[own_x, own_y, _]| (own_x - x).hypot(own_y - y) < MATCHED_M)
    });
    matched.count()
}

/// Ego-only detections of a vehicle, in its own frame.
pub(super) fn boxes_in(map: &Tensor, detector: &Detector) -> Result<Vec<Detection>, DetectorError> {
    let limits = PostprocessConfig {
        score_threshold: LANDMARK_SCORE,
        ..PostprocessConfig::for_late_fusion(detector.config())
    };
    let boxes = detector.boxes(&detector.heads(map)?, limits.score_threshold)?;
    let mut found = detector.refined(map, detections(&boxes, &limits))?;
    found.retain(|found| found.score > LANDMARK_SCORE);
    Ok(found)
}

#[cfg(test)]
mod tests {
    use protocol::Box3d;

    use super::*;

    fn car([x, y]: [f64; 2], score: f32) -> Detection {
        Detection {
            box3d: Box3d {
                center_m: [x, y, -1.0],
                size_m: [4.4, 1.9, 1.6],
                heading_rad: 0.0,
            },
            score,
            source: None,
        }
    }

    const PLACES: [[f64; 2]; 6] = [
        [12.0, 3.0],
        [-9.0, -4.0],
        [25.0, 8.0],
        [4.0, -12.0],
        [-20.0, 9.0],
        [33.0, -6.0],
    ];

    const TRUE: Pose = Pose {
        translation_m: [20.0, 0.0, 0.0],
        ..Pose::IDENTITY
    };
    const STATED: Pose = Pose {
        translation_m: [21.2, -0.9, 0.0],
        ..Pose::IDENTITY
    };

    #[test]
    fn a_pose_is_corrected_where_its_boxes_match_better_then() {
        let [own, received] =
            [0.0, 20.0].map(|from_m| PLACES.map(|[x, y]| car([x - from_m, y], 0.8)));
        let [x, y, _] = corrected(STATED, &received, &own).translation_m;
        assert!((x - 20.0).abs() < 0.1 && y.abs() < 0.1, "{x} {y}");
        assert_eq!(corrected(TRUE, &received, &own), TRUE);
        // Two common boxes, or weak ones, are no evidence.
        assert_eq!(corrected(STATED, &received, &own[..2]), STATED);
        let weak = received.map(|found| Detection {
            score: 0.1,
            ..found
        });
        assert_eq!(corrected(STATED, &weak, &own), STATED);
        assert_eq!(corrected(STATED, &[], &own), STATED);
    }
}
