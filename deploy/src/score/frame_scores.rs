//! Scores of a run, tick by tick, from detections and ground truth. Uses no network and no file.

use std::collections::BTreeMap;

use dataset::average_precision::{Breakdown, Ordering, Scorer};
use dataset::ground_truth::{GroundTruth, GroundTruthRule};
use protocol::{CavId, Detections, DropReason, Pose, PoseError, PoseEstimate, Stamp, Truth};
use support::csv_file::CsvText;

use super::frame_record::{FrameRecord, JudgedFrame};
use super::live_precision::{EgoTick, LivePrecision};
use super::neighbours::{self, NeighbourRecord};
use super::open_ticks::{OpenTick, OpenTicks};
use super::precision::{FrameCounts, by_iou};
use super::stage_stamps::StageStamps;
use super::true_boxes::ground_truth;
use super::truth_line::TruthLine;
use crate::score::metrics::{ByIou, PartPrecision};

/// Gap between two frames beyond which they belong to two scenarios, or to two rounds of one, nanoseconds.
const SCENARIO_GAP_NANOS: u64 = 10_000_000_000;

/// Scores so far. Ticks are scored in the order of their capture times, independent of the order of their messages.
pub struct FrameScores {
    pub(super) ego: CavId,
    rule: GroundTruthRule,
    pub(super) nominal_values: u64,
    open: OpenTicks,
    pub(super) scorer: Scorer,
    pub(super) live: LivePrecision,
    records: Vec<FrameRecord>,
    pub(super) pose_errors: Vec<PoseError>,
    pub(super) no_pose: u64,
    unplaced: Vec<u64>,
    pub(super) bytes: Vec<(u64, u64)>,
    pub(super) ages_ms: Vec<f64>,
    pub(super) neighbours: BTreeMap<CavId, NeighbourRecord>,
    best: Option<JudgedFrame>,
}

impl FrameScores {
    /// Empty scores for the detections of `ego`, with the ground-truth `rule`; a feature map of the model has
    /// `nominal_values` values.
    pub fn new(ego: CavId, rule: GroundTruthRule, nominal_values: u64) -> Self {
        Self {
            ego,
            rule,
            nominal_values,
            open: OpenTicks::default(),
            scorer: Scorer::default().with_breakdowns(),
            live: LivePrecision::default(),
            records: Vec::new(),
            pose_errors: Vec::new(),
            no_pose: 0,
            unplaced: Vec::new(),
            bytes: Vec::new(),
            ages_ms: Vec::new(),
            neighbours: BTreeMap::new(),
            best: None,
        }
    }

    /// Continues with the results of another vehicle: in another scenario.
    pub fn change_ego(&mut self, ego: &CavId) {
        self.ego.clone_from(ego);
        self.live.forget();
    }

    /// The ground truth of a tick as it is scored; `None` where the ego takes no part.
    pub fn truth_line(&self, stamp: &Stamp, truth: &Truth) -> Option<TruthLine> {
        let ego = truth.agents.iter().find(|agent| agent.cav == self.ego)?;
        Some(TruthLine {
            tick: truth.tick,
            capture_nanos: stamp.capture_nanos,
            publish_nanos: stamp.publish_nanos,
            ego: self.ego.clone(),
            world_from_ego: Some(ego.world_from_lidar),
            truth: ground_truth(truth, &self.ego, &self.rule),
        })
    }

    /// Adds the ground truth of a tick.
    pub fn truth(&mut self, stamp: &Stamp, truth: Truth) {
        self.add(stamp, |tick| {
            tick.truth.get_or_insert((stamp.publish_nanos, truth));
        });
    }

    /// Adds the ego's result of a tick. A second result of the same tick (of a restarted ego) does not count.
    pub fn result(&mut self, stamp: &Stamp, result: Detections) {
        self.add(stamp, |tick| {
            tick.result.get_or_insert((stamp.publish_nanos, result));
        });
    }

    /// Adds the pose estimate of a vehicle at a tick.
    pub fn pose(&mut self, stamp: &Stamp, estimate: PoseEstimate) {
        let posed_nanos = (stamp.cav == self.ego).then_some(stamp.publish_nanos);
        self.add(stamp, |tick| {
            if tick.poses.iter().all(|(known, _)| *known != stamp.cav) {
                tick.poses.push((stamp.cav.clone(), estimate));
                tick.posed_nanos = tick.posed_nanos.or(posed_nanos);
            }
        });
    }

    /// Scores the ticks that are still open: no further message will arrive.
    pub fn close(&mut self) {
        while let Some((capture_nanos, tick)) = self.open.close_oldest() {
            self.judge(capture_nanos, tick);
        }
    }

    /// Ticks scored so far, in order, those without a result of the ego included.
    pub fn records(&self) -> &[FrameRecord] {
        &self.records
    }

    /// Number of ticks so far at which the truth has the ego, and of those with a result of it.
    pub fn ticks(&self) -> (u64, u64) {
        self.live.ticks()
    }

    /// Ticks at which the truth lacks the ego: it has no sweep there, or the recording has no true pose of it. They
    /// count in no precision, and only those with a result have a record.
    pub fn unplaced(&self) -> &[u64] {
        &self.unplaced
    }

    /// Number of ticks without a result of the ego.
    pub fn missed(&self) -> u64 {
        let (ticks, answered) = self.live.ticks();
        ticks - answered
    }

    /// Frame for the picture so far: the one with the most neighbours, then true boxes.
    pub fn showpiece(&self) -> Option<&JudgedFrame> {
        self.best.as_ref()
    }

    /// Average precision over the answered ticks, ordered by score over all frames, and ordered by frame.
    pub fn average_precision(&self) -> [ByIou; 2] {
        [Ordering::Global, Ordering::Frame].map(|by| by_iou(&self.scorer.tallies, by))
    }

    /// Average precision over the answered ticks by distance and by class, of the parts that have objects, ordered by
    /// score over all frames.
    pub fn average_precision_by_part(&self) -> [BTreeMap<String, PartPrecision>; 2] {
        let mut by_part = [BTreeMap::new(), BTreeMap::new()];
        let [distances, classes] = &mut by_part;
        for (part, tallies) in &self.scorer.parts {
            let objects = tallies.first().map_or(0, |tally| tally.objects);
            if objects > 0 {
                let precision = PartPrecision {
                    objects,
                    ap: by_iou(tallies, Ordering::Global),
                };
                match part {
                    Breakdown::Distance(_) => distances.insert(part.to_string(), precision),
                    Breakdown::Class(_) => classes.insert(part.to_string(), precision),
                };
            }
        }
        by_part
    }

    /// Precision over recall at the three IoU thresholds as a table, a row per detection by falling score; precision is
    /// made non-increasing in recall, as for [`Self::average_precision`].
    pub fn precision_recall_csv(&self) -> String {
        let mut text = CsvText::new("iou,score,recall,precision");
        for tally in &self.scorer.tallies {
            let curve = tally.curve(Ordering::Global);
            let mut scores: Vec<f32> = tally.matched.iter().map(|matched| matched.score).collect();
            scores.sort_by(|a, b| b.total_cmp(a));
            // The curve has a point more at each end.
            let points = curve.recall.iter().zip(&curve.precision).skip(1);
            for (score, (recall, precision)) in scores.iter().zip(points) {
                let numbers =
                    [f64::from(*score), *recall, *precision].map(|number| format!("{number:.6}"));
                text.row([tally.iou_threshold.to_string()].into_iter().chain(numbers));
            }
        }
        text.finish()
    }

    /// From the first to the last frame on the scene's clock, seconds; scenarios that follow one another add up.
    pub fn seconds(&self) -> f64 {
        let times = self.records.iter().map(|record| record.capture_nanos);
        let pairs = times.clone().zip(times.skip(1));
        let steps = pairs.map(|(from, to)| to.saturating_sub(from));
        // The clock jumps at the start of another scenario, ahead or back.
        let steps = steps.filter(|nanos| *nanos < SCENARIO_GAP_NANOS);
        steps.map(|nanos| nanos as f64 * 1e-9).sum()
    }

    fn add(&mut self, stamp: &Stamp, fill: impl FnOnce(&mut OpenTick)) {
        if let Some((capture_nanos, tick)) = self.open.add(stamp, fill) {
            self.judge(capture_nanos, tick);
        }
    }

    fn judge(&mut self, capture_nanos: u64, tick: OpenTick) {
        let Some((began_nanos, truth)) = tick.truth else {
            return;
        };
        let agents = truth.agents.iter();
        let world_from_lidar: Vec<(CavId, Pose)> = agents
            .map(|agent| (agent.cav.clone(), agent.world_from_lidar))
            .collect();
        // Poses count whether or not the ego has answered.
        self.judge_poses(&tick.poses, &world_from_lidar);
        let objects = ground_truth(&truth, &self.ego, &self.rule);
        let answer = tick.result.map(|(done_nanos, result)| {
            let stamps = StageStamps::of(began_nanos, tick.posed_nanos, done_nanos, &result.stages);
            (stamps, Some(done_nanos), result)
        });
        let at = (truth.tick, capture_nanos, began_nanos);
        self.judge_tick(at, answer, &objects, world_from_lidar);
    }

    /// Scores a frame whose truth is known already, at once; `result` is `None` if the ego has none, `poses` are the
    /// estimates of all vehicles. The same frame must not be given to [`Self::truth`], [`Self::result`] and
    /// [`Self::pose`].
    pub fn judge_whole(
        &mut self,
        (tick, capture_nanos): (u64, u64),
        latency_ms: Option<f64>,
        result: Option<Detections>,
        objects: &GroundTruth,
        poses: &[(CavId, PoseEstimate)],
        world_from_lidar: Vec<(CavId, Pose)>,
    ) {
        self.judge_poses(poses, &world_from_lidar);
        let answer = result.map(|result| {
            let stamps = StageStamps {
                detected_ms: latency_ms,
                ..StageStamps::default()
            };
            let latency_nanos = latency_ms.map(|latency_ms| (latency_ms * 1e6) as u64);
            let published_nanos = latency_nanos.map(|nanos| capture_nanos.saturating_add(nanos));
            (stamps, published_nanos, result)
        });
        // Without a network a tick is published at its capture time.
        let at = (tick, capture_nanos, capture_nanos);
        self.judge_tick(at, answer, objects, world_from_lidar);
    }

    /// Scores a tick, of a number, capture time and time of publication; the answer is the result with its stamps and
    /// its time of publication.
    fn judge_tick(
        &mut self,
        (tick, capture_nanos, began_nanos): (u64, u64, u64),
        answer: Option<(StageStamps, Option<u64>, Detections)>,
        objects: &GroundTruth,
        world_from_lidar: Vec<(CavId, Pose)>,
    ) {
        let last_nanos = self.records.last().map(|last| last.capture_nanos);
        if last_nanos.is_some_and(|last| last.abs_diff(capture_nanos) >= SCENARIO_GAP_NANOS) {
            self.live.forget();
        }
        let world_from_ego = true_pose(&world_from_lidar, &self.ego).copied();
        self.unplaced
            .extend(world_from_ego.is_none().then_some(tick));
        // The ego may take no part at this tick, so no result is missing.
        if world_from_ego.is_none() && answer.is_none() {
            return;
        }
        let published_nanos = answer.as_ref().and_then(|(_, nanos, _)| *nanos);
        let detections = answer.as_ref().map(|(.., result)| &result.detections[..]);
        let streamed = world_from_ego.and_then(|world_from_ego| {
            let ego_tick = EgoTick {
                number: tick,
                began_nanos,
                world_from_ego,
            };
            self.live
                .add(ego_tick, objects, detections, published_nanos)
        });
        let mut record = FrameRecord {
            tick,
            capture_nanos,
            truth: objects.objects.len(),
            streamed,
            ..FrameRecord::default()
        };
        let Some((stamps, _, result)) = answer else {
            record.stamps.began_nanos = Some(began_nanos);
            return self.records.push(record);
        };
        let counts = FrameCounts::of(&mut self.scorer, &result.detections, objects);
        let fused = result.fused.iter();
        let bytes = fused.clone().map(|of| (of.payload_bytes, of.wire_bytes));
        let ages_ms = fused.map(|of| of.age_nanos as f64 * 1e-6);
        let poses = result.pose.world_from_cav().zip(world_from_ego.as_ref());
        let ego_error = poses.map(|(found, truth)| PoseError::between(found, truth));
        let skipped = result.skipped.iter();
        let stale = skipped.filter(|one| one.reason == Some(DropReason::Stale));
        self.records.push(FrameRecord {
            agent_frame: Some(result.agent_frame),
            latency_ms: stamps.detected_ms,
            stamps,
            detected: counts.detected,
            found: counts.found,
            fused: result.fused.len(),
            skipped: result.skipped.len(),
            oldest_ms: ages_ms.clone().max_by(f64::total_cmp),
            stale: stale.count(),
            payload_bytes: bytes.clone().map(|(payload, _)| payload).sum(),
            wire_bytes: bytes.clone().map(|(_, wire)| wire).sum(),
            ego_error_m: ego_error.map(|error| error.distance_m),
            ego_error_deg: ego_error.map(|error| error.angle_deg),
            ..record
        });
        neighbours::add(&mut self.neighbours, &result);
        self.bytes.extend(bytes);
        self.ages_ms.extend(ages_ms);
        // Without the ego's pose nothing tells where to draw the others.
        if world_from_ego.is_some() {
            self.keep_showpiece(JudgedFrame {
                tick,
                result,
                truth: objects.boxes().collect(),
                world_from_lidar,
            });
        }
    }

    fn judge_poses(&mut self, poses: &[(CavId, PoseEstimate)], truth: &[(CavId, Pose)]) {
        for (cav, estimate) in poses {
            match (estimate.world_from_cav(), true_pose(truth, cav)) {
                (Some(found), Some(truth)) => {
                    self.pose_errors.push(PoseError::between(found, truth))
                }
                (None, Some(_)) => self.no_pose += 1,
                // A vehicle that is not in the scene has no truth.
                (_, None) => {}
            }
        }
    }

    fn keep_showpiece(&mut self, frame: JudgedFrame) {
        let rank = |frame: &JudgedFrame| (frame.result.fused.len(), frame.truth.len());
        let best = self.best.as_ref();
        // Strictly better, so of equal frames the first one stays.
        if best.is_none_or(|best| rank(&frame) > rank(best)) {
            self.best = Some(frame);
        }
    }
}

fn true_pose<'a>(truth: &'a [(CavId, Pose)], cav: &CavId) -> Option<&'a Pose> {
    let (_, pose) = truth.iter().find(|(known, _)| known == cav)?;
    Some(pose)
}

#[cfg(test)]
mod tests;
