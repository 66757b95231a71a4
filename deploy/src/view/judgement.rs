//! Judgement of the detections of a frame: true and false positives, missed objects, and the average precision so far.

use std::collections::BTreeMap;

use dataset::average_precision::{Ordering, Scorer, Verdict};
use dataset::evaluation_protocol::EvaluationProtocol;
use dataset::ground_truth::GroundTruthRule;
use protocol::{BevGrid, Detections, Truth};
use serde::Serialize;

use crate::score::ground_truth;

/// IoU from which a detection is a true positive.
const IOU: f64 = 0.5;

/// Rectangle in which an ego detects, in the frame of its LiDAR, metres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DetectionArea {
    /// Lower and upper end of x.
    pub x_m: [f64; 2],
    /// The same for y.
    pub y_m: [f64; 2],
}

impl From<&BevGrid> for DetectionArea {
    fn from(grid: &BevGrid) -> Self {
        let [x_m, y_m] = [(grid.x_min_m, grid.width), (grid.y_min_m, grid.height)]
            .map(|(low_m, cells)| [low_m, low_m + f64::from(cells) * grid.cell_m]);
        Self { x_m, y_m }
    }
}

/// Judgement of one frame.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Judgement {
    /// For each detection.
    pub(super) verdicts: Vec<Verdict>,
    /// For each object that counts, by id, the score of the detection that found it.
    pub(super) found: BTreeMap<i64, Option<f32>>,
}

impl Judgement {
    /// True and false positives from a score on, and missed objects.
    pub(super) fn counts(&self, result: &Detections, least_score: f32) -> [usize; 3] {
        let all = result.detections.iter().zip(&self.verdicts);
        let shown = all.filter(|(detection, _)| detection.score >= least_score);
        let matches = shown
            .clone()
            .filter(|(_, verdict)| matches!(verdict, Verdict::Match(_)));
        let wrong = shown.filter(|(_, verdict)| **verdict == Verdict::FalsePositive);
        let scores = self.found.values();
        let missed = scores.filter(|score| score.is_none_or(|score| score < least_score));
        [matches.count(), wrong.count(), missed.count()]
    }
}

/// Judge of the frames of a run: objects of its protocol within the area count.
pub(super) struct Judge {
    scorer: Scorer,
    pub(super) protocol: Option<EvaluationProtocol>,
}

impl Default for Judge {
    fn default() -> Self {
        Self::new(None)
    }
}

impl Judge {
    /// A judge by the protocol of a run; `None`: by that of OPV2V.
    pub(super) fn new(protocol: Option<EvaluationProtocol>) -> Self {
        Self {
            scorer: Scorer::new(&[IOU]),
            protocol,
        }
    }

    /// Name of the protocol.
    pub(super) fn protocol(&self) -> &str {
        self.protocol
            .as_ref()
            .map_or("opv2v", |protocol| &protocol.name)
    }

    fn rule(&self, area: &DetectionArea) -> GroundTruthRule {
        let ([x0, x1], [y0, y1]) = (area.x_m, area.y_m);
        // Lower corner, then upper corner. The height is not limited.
        let area_m = [x0, y0, f64::NEG_INFINITY, x1, y1, f64::INFINITY];
        match &self.protocol {
            Some(protocol) => protocol.rule_within(area_m),
            None => GroundTruthRule {
                x_m: area.x_m,
                y_m: area.y_m,
                ..GroundTruthRule::OPV2V
            },
        }
    }

    /// Judges a frame and adds it to those before.
    pub(super) fn judge(
        &mut self,
        result: &Detections,
        truth: &Truth,
        area: &DetectionArea,
    ) -> Judgement {
        let objects = ground_truth(truth, &result.ego, &self.rule(area));
        // The scorer has one threshold.
        let verdicts = self.scorer.add(&result.detections, &objects);
        let verdicts = verdicts.into_iter().next().unwrap_or_default();
        let unfound = objects.objects.iter().map(|object| (object.id, None));
        let mut found: BTreeMap<i64, Option<f32>> = unfound.collect();
        for (detection, verdict) in result.detections.iter().zip(&verdicts) {
            if let Verdict::Match(index) = verdict
                && let Some(object) = objects.objects.get(*index)
            {
                found.insert(object.id, Some(detection.score));
            }
        }
        Judgement { verdicts, found }
    }

    /// Average precision of the frames so far, in the order of the protocol; `None` without an object.
    pub(super) fn average_precision(&self) -> Option<f64> {
        let tally = self.scorer.tallies.first()?;
        let ordering = Ordering::of(self.protocol.as_ref());
        tally.curve(ordering).average_precision
    }
}

#[cfg(test)]
mod tests {
    use protocol::{AgentTruth, Box3d, CavId, Detection, Pose, PoseEstimate, TrueObject};

    use super::*;

    #[test]
    fn positives_and_missed_objects_are_counted_by_score_within_area_and_classes() {
        let ego = CavId::new("7").unwrap();
        let objects = [
            (1, "car", 10.0),
            (2, "car", 20.0),
            (3, "car", 80.0),
            (4, "other", 30.0),
        ]
        .map(|(id, class, x_m)| TrueObject {
            id,
            class: class.into(),
            world_from_object: Pose::from_xyz_yaw([x_m, 0.0, 0.0], 0.0),
            size_m: [4.0, 2.0, 1.5],
            speed_mps: None,
        });
        let agent = AgentTruth {
            cav: ego.clone(),
            world_from_lidar: Pose::IDENTITY,
            objects: objects.into(),
        };
        let truth = Truth {
            tick: 0,
            agents: vec![agent],
        };
        let detections = [
            (10.2, 0.9),
            (40.0, 0.6),
            (20.0, 0.3),
            (50.0, 0.3),
            (30.0, 0.3),
        ]
        .map(|(x_m, score)| Detection {
            box3d: Box3d {
                center_m: [x_m, 0.0, 0.0],
                size_m: [4.0, 2.0, 1.5],
                heading_rad: 0.0,
            },
            score,
            source: None,
        });
        let result = Detections {
            ego,
            agent_frame: 0,
            method: "max".into(),
            pose: PoseEstimate::new(Pose::IDENTITY, 1.0),
            detections: detections.into(),
            fused: vec![],
            skipped: vec![],
            neighbours: vec![],
            stages: vec![],
        };
        let grid = BevGrid {
            x_min_m: -51.2,
            y_min_m: -38.4,
            cell_m: 0.8,
            width: 128,
            height: 96,
        };
        let mut judge = Judge::default();
        assert_eq!(judge.average_precision(), None);
        let judgement = judge.judge(&result, &truth, &DetectionArea::from(&grid));
        let ignored = Verdict::Ignored;
        assert_eq!(
            judgement.verdicts,
            [
                Verdict::Match(0),
                Verdict::FalsePositive,
                Verdict::Match(1),
                ignored,
                ignored
            ]
        );
        assert_eq!(
            judgement.found,
            BTreeMap::from([(1, Some(0.9)), (2, Some(0.3))])
        );
        assert_eq!(judgement.counts(&result, 0.2), [2, 1, 0]);
        assert_eq!(judgement.counts(&result, 0.5), [1, 1, 1]);
        assert!(judge.average_precision().unwrap() > 0.8);

        let mut by_frame = EvaluationProtocol::preset("opv2v").unwrap();
        by_frame.ap_order = Ordering::Frame;
        let wrong = Detections {
            detections: vec![Detection {
                score: 0.1,
                ..result.detections[1].clone()
            }],
            ..result.clone()
        };
        let by_order = [None, Some(by_frame)].map(|protocol| {
            let mut judge = Judge::new(protocol);
            judge.judge(&wrong, &truth, &DetectionArea::from(&grid));
            judge.judge(&result, &truth, &DetectionArea::from(&grid));
            judge.average_precision().unwrap()
        });
        assert!(by_order[0] > by_order[1] + 0.1, "{by_order:?}");

        let mut protocol = EvaluationProtocol::preset("v2v4real").unwrap();
        protocol.ground_truth.x_m = [-15.0, 15.0];
        let mut judge = Judge::new(Some(protocol));
        assert_eq!(judge.protocol(), "v2v4real");
        let judgement = judge.judge(&result, &truth, &DetectionArea::from(&grid));
        assert_eq!(judgement.found, BTreeMap::from([(1, Some(0.9))]));
        assert_eq!(judgement.verdicts[2], ignored, "beyond the range");
    }
}
