//! Assembles scene frames from messages in any order.

use std::collections::{BTreeMap, BTreeSet};

use dataset::average_precision::Verdict;
use dataset::evaluation_protocol::EvaluationProtocol;
use nalgebra::Vector3;
use protocol::message::AgentTruth;
use protocol::{
    Boxes, CavId, Descriptor, Detection, Detections, Header, Ledger, Lidar, Limits, Payload, Pose,
    PoseEstimate, StageSummary, Stats, Stream, Topic, Tracks, TrueObject, Truth, wire,
};
use support::sampling::distinct;

use super::judgement::{DetectionArea, Judge, Judgement};
use super::pace_counter::PaceCounter;
use super::scene_frame::{
    Link, MessageCounts, POINT_BYTES, Planar, Process, SceneFrame, ShownBox, ShownTrack,
    ShownVehicle, decimate,
};
use super::trails::Trails;
use crate::score::{StageStamps, ms_between};

/// Largest number of incomplete scene frames.
const MOST_OPEN: usize = 16;
/// Largest number of processes whose ledgers are kept: more than a run of 65 vehicles has.
const MOST_LEDGERS: usize = 1024;
/// Largest number of vehicles that are shown: twice as many as an ego accepts.
const MOST_VEHICLES: usize = 128;

/// Ledger and stages of each process, by name.
type Ledgers = BTreeMap<String, (Ledger, Vec<StageSummary>)>;

/// A captured message.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ReceivedMessage<'a> {
    /// Topic of its publication.
    pub topic: &'a Topic,
    /// Header of the message.
    pub header: &'a Header,
    /// Time of its capture, nanoseconds on the Unix clock.
    pub arrived_nanos: u64,
    /// Complete message, if its content is needed.
    pub payload: Option<&'a [u8]>,
}

/// Messages so far, by capture time.
#[derive(Default)]
pub(crate) struct FrameAssembler {
    open: BTreeMap<u64, OpenFrame>,
    shown_until: Option<u64>,
    /// Epoch of the replay that publishes the truth.
    replay_epoch: Option<u64>,
    ledgers: Ledgers,
    /// Vehicles with at least one message.
    vehicles: BTreeSet<CavId>,
    pace: PaceCounter,
    /// Area in which each vehicle detects, from its descriptor.
    areas: BTreeMap<CavId, DetectionArea>,
    judge: Judge,
    /// The ego whose results are shown; `None`: that of the next result.
    ego: Option<CavId>,
    /// All egos with results.
    egos: BTreeSet<CavId>,
    trails: Trails,
    /// True if tracks follow the results of the ego.
    awaits_tracks: bool,
}

/// Messages of one scene frame.
#[derive(Default)]
struct OpenFrame {
    truth: Option<(u64, Truth)>,
    result: Option<(u64, Detections)>,
    tracks: Option<Vec<ShownTrack>>,
    /// Each with its time of publication.
    poses: BTreeMap<CavId, (u64, PoseEstimate)>,
    /// Encoded: most scene frames of a busy run are never shown, and decoding is the largest cost.
    sweeps: BTreeMap<CavId, Vec<u8>>,
    own_boxes: BTreeMap<CavId, Boxes>,
    /// Latest arrival from a vehicle: after the link, if there is one.
    arrivals: BTreeMap<CavId, LatestArrival>,
}

/// Arrival of a message from a vehicle.
struct LatestArrival {
    /// Preference: after the link before ahead of it, data before poses.
    rank: u8,
    stream: Stream,
    latency_ms: f64,
}

impl FrameAssembler {
    /// An assembler that knows the protocol of the run and in which area each vehicle detects.
    pub(crate) fn new(
        protocol: Option<EvaluationProtocol>,
        areas: BTreeMap<CavId, DetectionArea>,
    ) -> Self {
        Self {
            areas,
            judge: Judge::new(protocol),
            ..Self::default()
        }
    }

    /// An assembler of the scene frames of another ego, which knows what this one knows of the run.
    pub(crate) fn for_ego(&self, ego: Option<CavId>) -> Self {
        let (ledgers, egos) = (self.ledgers.clone(), self.egos.clone());
        Self {
            ledgers,
            egos,
            ego,
            ..Self::new(self.judge.protocol.clone(), self.areas.clone())
        }
    }

    /// Adds a message. A result of the ego, with its tracks if the ego tracks, completes its scene frame, which is returned;
    /// so is a scene frame without a result when too many wait. Invalid messages are ignored here and counted by their receivers.
    pub(crate) fn add(&mut self, seen: &ReceivedMessage<'_>) -> Option<SceneFrame> {
        let at = seen.header.stamp.capture_nanos;
        match seen.topic {
            Topic::Stats(_) => {
                if let Some(stats) = decode::<Stats>(seen) {
                    let process = stats.process.to_string();
                    if self.ledgers.len() < MOST_LEDGERS || self.ledgers.contains_key(&process) {
                        self.ledgers.insert(process, (stats.ledger, stats.stages));
                    }
                }
                return None;
            }
            Topic::Truth => self.begin_again_with(seen.header.stamp.epoch),
            Topic::Stream { cav, .. } | Topic::Received { cav, .. } if !self.admits(cav) => {
                return None;
            }
            Topic::Stream { cav, stream } if *stream == Stream::Descriptor => {
                if let Some(Descriptor { grid, .. }) = decode(seen) {
                    self.areas.insert(cav.clone(), DetectionArea::from(&grid));
                }
                return None;
            }
            Topic::Stream { cav, stream } if *stream == Stream::Tracks => self.track(at, cav, seen),
            _ => {}
        }
        // Frames are shown in the order of capture: a late message of an earlier one has no place.
        if self.shown_until.is_some_and(|shown| at <= shown) {
            return None;
        }
        if self.fill(at, seen) && self.is_complete(at) {
            return self.show(at);
        }
        if self.open.len() > MOST_OPEN {
            return self.show(*self.open.keys().next()?);
        }
        None
    }

    /// Adds tracks of the ego, also late ones: the trails of the next frames have them.
    fn track(&mut self, at: u64, cav: &CavId, seen: &ReceivedMessage<'_>) {
        let is_of_ego = self.ego.as_ref() == Some(cav);
        if let Some(tracks) = decode::<Tracks>(seen).filter(|_| is_of_ego) {
            self.awaits_tracks = true;
            let shown = self.trails.add(at, &tracks);
            if self.shown_until.is_none_or(|until| at > until) {
                self.frame(at).tracks = Some(shown);
            }
        }
    }

    /// True if nothing is missing at `at`: results come before their tracks.
    fn is_complete(&mut self, at: u64) -> bool {
        // An earlier result is still without: the ego tracks no more.
        self.awaits_tracks &= !self
            .open
            .range(..at)
            .any(|(_, it)| it.result.is_some() && it.tracks.is_none());
        let frame = self.open.get(&at);
        frame.is_some_and(|it| it.result.is_some() && !(self.awaits_tracks && it.tracks.is_none()))
    }

    fn admits(&mut self, cav: &CavId) -> bool {
        let is_known = self.vehicles.contains(cav);
        is_known || (self.vehicles.len() < MOST_VEHICLES && self.vehicles.insert(cav.clone()))
    }

    /// The scene frame at `capture_nanos` with the messages so far; older ones are dropped.
    pub(crate) fn show(&mut self, capture_nanos: u64) -> Option<SceneFrame> {
        let frame = self.open.remove(&capture_nanos)?;
        let later = self.open.split_off(&capture_nanos);
        // Older ones will have no result any more.
        let closed = std::mem::replace(&mut self.open, later);
        for frame in closed.values().chain([&frame]) {
            if frame.truth.is_some() {
                let result = frame.result.as_ref();
                self.pace.tick(result.map(|(published, _)| *published));
            }
        }
        self.shown_until = Some(capture_nanos);
        let result = frame.result();
        let area = result.and_then(|result| self.areas.get(&result.ego).copied());
        let judgement = frame.judged(area.as_ref(), &mut self.judge);
        Some(SceneFrame {
            pace: self.pace.pace(),
            area,
            ap_50: self.judge.average_precision(),
            protocol: self.judge.protocol().to_owned(),
            egos: self.egos.iter().cloned().collect(),
            ..frame.frame(capture_nanos, &self.ledgers, &judgement)
        })
    }

    /// Another replay of the same run begins at its own first tick, which the frames shown so far do not hide.
    fn begin_again_with(&mut self, epoch: u64) {
        let known = self.replay_epoch.replace(epoch);
        if known.is_some_and(|known| known != epoch) {
            self.open.clear();
            self.trails = Trails::default();
            self.shown_until = None;
        }
    }

    /// Adds a message to its scene frame; returns true for a result or tracks of the ego.
    fn fill(&mut self, at: u64, seen: &ReceivedMessage<'_>) -> bool {
        let published = seen.header.stamp.publish_nanos;
        let (cav, stream) = match seen.topic {
            Topic::Truth => {
                if let Some(truth) = decode(seen) {
                    self.frame(at).truth = Some((published, truth));
                }
                return false;
            }
            Topic::Stream { cav, stream } => (cav, *stream),
            Topic::Received { ego, cav, stream } => {
                if self.ego.as_ref().is_none_or(|shown| shown == ego) {
                    self.arrived(cav, *stream, 2, seen);
                }
                return false;
            }
            Topic::Control(_) | Topic::Ready(_) | Topic::Stats(_) | Topic::Alive { .. } => {
                return false;
            }
        };
        match stream {
            Stream::Detections => {
                self.egos.insert(cav.clone());
                let is_shown = self.ego.get_or_insert_with(|| cav.clone()) == cav;
                if let Some(result) = decode(seen).filter(|_| is_shown) {
                    self.frame(at).result = Some((published, result));
                    return true;
                }
            }
            Stream::Tracks => return self.ego.as_ref() == Some(cav),
            Stream::Lidar | Stream::Preview => {
                if let Some(payload) = seen.payload {
                    self.frame(at).sweeps.insert(cav.clone(), payload.to_vec());
                }
            }
            Stream::Pose => {
                if let Some(estimate) = decode(seen) {
                    let poses = &mut self.frame(at).poses;
                    poses.insert(cav.clone(), (published, estimate));
                }
            }
            Stream::Boxes => {
                if let Some(boxes) = decode(seen) {
                    self.frame(at).own_boxes.insert(cav.clone(), boxes);
                }
            }
            _ => {}
        }
        self.arrived(cav, stream, 0, seen);
        false
    }

    fn arrived(&mut self, cav: &CavId, stream: Stream, rank: u8, seen: &ReceivedMessage<'_>) {
        let rank = match stream {
            Stream::Bev | Stream::Boxes | Stream::Points => rank + 1,
            Stream::Pose => rank,
            _ => return,
        };
        let stamp = &seen.header.stamp;
        let latency_ms = ms_between(stamp.publish_nanos, seen.arrived_nanos);
        let arrivals = &mut self.frame(stamp.capture_nanos).arrivals;
        // Of equal rank the later message counts.
        if arrivals.get(cav).is_none_or(|known| known.rank <= rank) {
            let arrival = LatestArrival {
                rank,
                stream,
                latency_ms,
            };
            arrivals.insert(cav.clone(), arrival);
        }
    }

    fn frame(&mut self, at: u64) -> &mut OpenFrame {
        self.open.entry(at).or_default()
    }
}

fn decode<M: Payload>(seen: &ReceivedMessage<'_>) -> Option<M> {
    decoded(seen.payload?)
}

/// Content of an encoded message; `None` if it is damaged.
pub(super) fn decoded<M: Payload>(bytes: &[u8]) -> Option<M> {
    let (_, message) = wire::decode([bytes], &Limits::DEFAULT).ok()?;
    Some(message)
}

impl OpenFrame {
    /// The judgement of the result; empty without truth, result or area.
    fn judged(&self, area: Option<&DetectionArea>, judge: &mut Judge) -> Judgement {
        match (&self.result, &self.truth, area) {
            (Some((_, result)), Some((_, truth)), Some(area)) => judge.judge(result, truth, area),
            _ => Judgement::default(),
        }
    }

    fn frame(&self, capture_nanos: u64, ledgers: &Ledgers, judgement: &Judgement) -> SceneFrame {
        let result = self.result();
        let (vehicles, points) = self.vehicles();
        let ends = self.truth.as_ref().zip(self.result.as_ref());
        let stamps = ends.map(|((began, _), (done, result))| {
            let posed = self.poses.get(&result.ego).map(|(posed, _)| *posed);
            StageStamps::of(*began, posed, *done, &result.stages)
        });
        let stamps = stamps.unwrap_or_default();
        let processes = ledgers.iter().map(|(process, (_, stages))| Process {
            process: process.clone(),
            stages: stages.clone(),
        });
        SceneFrame {
            capture_s: capture_nanos as f64 / 1e9,
            tick: self.truth.as_ref().map(|(_, truth)| truth.tick),
            ego: result.map(|result| result.ego.clone()),
            method: result.map(|result| result.method.clone()),
            latency_ms: stamps.detected_ms,
            posed_ms: stamps.posed_ms,
            vehicles,
            truth: self.true_boxes(judgement),
            detections: self.detections(judgement),
            single: self.single(),
            tracks: self.tracks.clone().unwrap_or_default(),
            links: self.links(),
            stages: result.map_or(Vec::new(), |result| result.stages.clone()),
            processes: processes.collect(),
            messages: messages(ledgers.values().map(|(ledger, _)| ledger)),
            points,
            ..SceneFrame::default()
        }
    }

    fn result(&self) -> Option<&Detections> {
        self.result.as_ref().map(|(_, result)| result)
    }

    fn true_agents(&self) -> impl Iterator<Item = &AgentTruth> {
        self.truth.iter().flat_map(|(_, truth)| &truth.agents)
    }

    /// True pose of a vehicle's LiDAR.
    fn true_pose(&self, cav: &CavId) -> Option<&Pose> {
        let agent = self.true_agents().find(|agent| agent.cav == *cav);
        agent.map(|agent| &agent.world_from_lidar)
    }

    /// Every vehicle, the ego first, and their points.
    fn vehicles(&self) -> (Vec<ShownVehicle>, Vec<u8>) {
        let ego = self.result().map(|result| &result.ego);
        let in_truth = self.true_agents().map(|agent| &agent.cav);
        let with_messages = self.poses.keys().chain(self.sweeps.keys());
        let cavs = distinct(ego.into_iter().chain(in_truth).chain(with_messages));
        let mut points = Vec::new();
        let vehicles = cavs.into_iter().map(|cav| self.vehicle(cav, &mut points));
        (vehicles.collect(), points)
    }

    fn vehicle(&self, cav: &CavId, points: &mut Vec<u8>) -> ShownVehicle {
        let truth = self.true_pose(cav);
        let own_result = self.result().filter(|result| result.ego == *cav);
        // The ego's result repeats its pose, for ticks whose pose message is missing.
        let estimate = self
            .poses
            .get(cav)
            .map(|(_, estimate)| estimate)
            .or(own_result.map(|result| &result.pose));
        let pose = estimate.and_then(PoseEstimate::world_from_cav);
        let payload = self.sweeps.get(cav);
        let sweep = payload.and_then(|payload| decoded::<Lidar>(payload));
        let sweep = sweep.map_or(Vec::new(), |Lidar { points }| decimate(&points));
        points.extend(&sweep);
        ShownVehicle {
            cav: cav.clone(),
            pose: pose.map(Planar::of),
            confidence: pose.and(estimate).map(PoseEstimate::confidence),
            covariance_m2: estimate
                .and_then(PoseEstimate::covariance)
                .map(|of| [of.xx_m2, of.xy_m2, of.yy_m2]),
            no_pose: match estimate {
                Some(PoseEstimate::NoPose { reason, .. }) => Some(*reason),
                _ => None,
            },
            truth: truth.map(Planar::of),
            error_m: pose.zip(truth).map(|(found, truth)| {
                (Vector3::from(found.translation_m) - Vector3::from(truth.translation_m)).norm()
            }),
            // Points of a vehicle without an estimate are shown where it truly is.
            world_from_lidar: pose.or(truth).map(|pose| pose.matrix_rows()[..2].concat()),
            points: sweep.len() / POINT_BYTES,
        }
    }

    fn true_boxes(&self, judgement: &Judgement) -> Vec<ShownBox> {
        let mut objects: BTreeMap<i64, &TrueObject> = BTreeMap::new();
        for object in self.true_agents().flat_map(|agent| &agent.objects) {
            objects.entry(object.id).or_insert(object);
        }
        let shown = objects.into_values().map(|object| ShownBox {
            box3d: object.box3d(),
            id: Some(object.id),
            is_counted: judgement.found.contains_key(&object.id),
            found_score: judgement.found.get(&object.id).copied().flatten(),
            speed_mps: object.speed_mps,
            class: Some(object.class.clone()),
            ..ShownBox::default()
        });
        shown.collect()
    }

    /// The ego's detections, placed by its estimated pose.
    fn detections(&self, judgement: &Judgement) -> Vec<ShownBox> {
        let Some(result) = self.result() else {
            return Vec::new();
        };
        let mut shown = self.placed(&result.ego, &result.pose, result.detections.iter(), None);
        for (shown, verdict) in shown.iter_mut().zip(&judgement.verdicts) {
            shown.is_hit = match verdict {
                Verdict::Match(_) => Some(true),
                Verdict::FalsePositive => Some(false),
                Verdict::Ignored => None,
            };
        }
        shown
    }

    /// Detections that single vehicles sent.
    fn single(&self) -> Vec<ShownBox> {
        let all = self.own_boxes.iter();
        all.flat_map(|(cav, boxes)| self.placed(cav, &boxes.pose, boxes.detections(), Some(cav)))
            .collect()
    }

    /// Detections in the frame of a vehicle, placed by its estimated pose, or else by its true one.
    fn placed<'a>(
        &self,
        cav: &CavId,
        pose: &PoseEstimate,
        found: impl Iterator<Item = &'a Detection>,
        source: Option<&CavId>,
    ) -> Vec<ShownBox> {
        let pose = pose.world_from_cav().or(self.true_pose(cav));
        let Some(world_from_cav) = pose.map(Pose::isometry) else {
            return Vec::new();
        };
        let shown = found.map(|detection| ShownBox {
            box3d: detection.box3d.transformed(&world_from_cav),
            score: Some(detection.score),
            source: source.or(detection.source.as_ref()).cloned(),
            ..ShownBox::default()
        });
        shown.collect()
    }

    fn links(&self) -> Vec<Link> {
        let Some(result) = self.result() else {
            return Vec::new();
        };
        let mut links: BTreeMap<&CavId, Link> = BTreeMap::new();
        for (cav, arrival) in self.arrivals.iter().filter(|(cav, _)| **cav != result.ego) {
            let link = Link {
                from: cav.to_string(),
                latency_ms: Some(arrival.latency_ms),
                stream: Some(arrival.stream.to_string()),
                ..Link::default()
            };
            links.insert(cav, link);
        }
        let mut all = Vec::new();
        for fused in &result.fused {
            all.push(Link {
                from: fused.cav.to_string(),
                wire_bytes: Some(fused.wire_bytes),
                age_ms: Some(fused.age_nanos as f64 / 1e6),
                is_fused: true,
                ..links.remove(&fused.cav).unwrap_or_default()
            });
        }
        for skipped in &result.skipped {
            all.push(Link {
                from: skipped.cav.to_string(),
                skipped: skipped.reason,
                ..links.remove(&skipped.cav).unwrap_or_default()
            });
        }
        // From these something has arrived, but the result does not name them.
        all.extend(links.into_values());
        for link in &mut all {
            link.to = result.ego.to_string();
            let mut neighbours = result.neighbours.iter();
            let Some(known) = neighbours.find(|known| known.cav.as_str() == link.from) else {
                continue;
            };
            (link.trust, link.misbehaviour) = (known.trust, known.misbehaviour);
            link.clock_ms = known.clock_offset_s.map(|seconds| seconds * 1e3);
            link.capture_ms = known.capture_offset_s.map(|seconds| seconds * 1e3);
        }
        all
    }
}

/// Sum of all ledgers.
fn messages<'a>(ledgers: impl Iterator<Item = &'a Ledger>) -> Vec<MessageCounts> {
    let mut sum = Ledger::default();
    ledgers.for_each(|ledger| sum.merge(ledger));
    let lines = sum.iter().map(|(account, counts)| MessageCounts {
        topic: account.topic.to_string(),
        to: account.to.as_ref().map(ToString::to_string),
        sent: counts.sent,
        received: counts.received,
        dropped: counts.dropped.clone(),
    });
    lines.collect()
}
