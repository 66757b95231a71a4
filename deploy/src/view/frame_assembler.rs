//! Assembles scene frames from messages in any order.

use std::collections::{BTreeMap, BTreeSet};

use dataset::average_precision::Verdict;
use dataset::evaluation_protocol::EvaluationProtocol;
use protocol::{
    Box3d, Boxes, CavId, Descriptor, Detection, Detections, Header, Ledger, Lidar, Limits, Payload,
    Pose, PoseEstimate, StageSummary, Stats, Stream, Topic, TrueObject, Truth, wire,
};

use super::judgement::{DetectionArea, Judge, Judgement};
use super::pace_counter::{PaceCounter, ShownPace};
use super::scene_frame::{
    Link, Messages, POINT_BYTES, Planar, Process, SceneFrame, ShownBox, Vehicle, decimate,
};

/// Largest number of incomplete scene frames.
const MOST_OPEN: usize = 16;
/// Largest number of processes whose ledgers are kept: more than a run of 65 vehicles has.
const MOST_LEDGERS: usize = 1024;
/// Largest number of vehicles that are shown: twice as many as an ego accepts.
const MOST_VEHICLES: usize = 128;

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
    ledgers: BTreeMap<String, (Ledger, Vec<StageSummary>)>,
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
}

/// Messages of one scene frame.
#[derive(Default)]
struct OpenFrame {
    truth: Option<(u64, Truth)>,
    result: Option<(u64, Detections)>,
    /// Each with its time of publication.
    poses: BTreeMap<CavId, (u64, PoseEstimate)>,
    /// Encoded: most scene frames of a busy run are never shown, and decoding is the largest cost.
    sweeps: BTreeMap<CavId, Vec<u8>>,
    own_boxes: BTreeMap<CavId, Boxes>,
    /// Latest arrival from a vehicle: after the link, if there is one.
    arrivals: BTreeMap<CavId, Arrival>,
}

/// Arrival of a message from a vehicle.
struct Arrival {
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
        let (areas, ledgers, egos) = (self.areas.clone(), self.ledgers.clone(), self.egos.clone());
        Self {
            areas,
            ledgers,
            egos,
            ego,
            judge: self.judge.renewed(),
            ..Self::default()
        }
    }

    /// Adds a message. A result of the ego completes its scene frame, which is returned; so is a scene frame without a
    /// result when too many wait. Invalid messages are ignored here and counted by their receivers.
    pub(crate) fn add(&mut self, seen: &ReceivedMessage<'_>) -> Option<SceneFrame> {
        if let Topic::Stats(_) = seen.topic {
            self.keep_ledger(seen);
            return None;
        }
        if let Topic::Stream { cav, .. } | Topic::Received { cav, .. } = seen.topic
            && !self.admits(cav)
        {
            return None;
        }
        if let Topic::Stream {
            cav,
            stream: Stream::Descriptor,
        } = seen.topic
        {
            if let Some(Descriptor { grid, .. }) = decode(seen) {
                self.areas.insert(cav.clone(), DetectionArea::from(&grid));
            }
            return None;
        }
        if *seen.topic == Topic::Truth {
            self.begin_again_with(seen.header.stamp.epoch);
        }
        let at = seen.header.stamp.capture_nanos;
        if self.shown_until.is_some_and(|shown| at <= shown) {
            return None;
        }
        if self.fill(at, seen) {
            return self.show(at);
        }
        if self.open.len() > MOST_OPEN {
            let oldest = *self.open.keys().next()?;
            return self.show(oldest);
        }
        None
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
        let ticks = closed
            .values()
            .chain([&frame])
            .filter(|frame| frame.truth.is_some());
        ticks.for_each(|frame| {
            self.pace
                .tick(frame.result.as_ref().map(|(published, _)| *published))
        });
        self.shown_until = Some(capture_nanos);
        let area = frame
            .result
            .as_ref()
            .and_then(|(_, result)| self.areas.get(&result.ego))
            .copied();
        let judgement = frame.judged(area.as_ref(), &mut self.judge);
        let shown = frame.frame(capture_nanos, &self.ledgers, &judgement);
        let (pace, ap_50) = (self.pace.pace(), self.judge.average_precision());
        Some(SceneFrame {
            pace,
            area,
            ap_50,
            protocol: self.judge.protocol().to_owned(),
            egos: self.egos.iter().cloned().collect(),
            ..shown
        })
    }

    fn keep_ledger(&mut self, seen: &ReceivedMessage<'_>) {
        let Some(Stats {
            process,
            ledger,
            stages,
            ..
        }) = decode(seen)
        else {
            return;
        };
        let process = process.to_string();
        if self.ledgers.len() < MOST_LEDGERS || self.ledgers.contains_key(&process) {
            self.ledgers.insert(process, (ledger, stages));
        }
    }

    /// Another replay of the same run begins at its own first tick, which the frames shown so far do not hide.
    fn begin_again_with(&mut self, epoch: u64) {
        if self
            .replay_epoch
            .replace(epoch)
            .is_some_and(|known| known != epoch)
        {
            self.open.clear();
            self.shown_until = None;
        }
    }

    /// Adds a message to its scene frame; returns true if that is complete now.
    fn fill(&mut self, at: u64, seen: &ReceivedMessage<'_>) -> bool {
        let published = seen.header.stamp.publish_nanos;
        match seen.topic {
            Topic::Truth => {
                if let Some(truth) = decode(seen) {
                    self.frame(at).truth = Some((published, truth));
                }
            }
            Topic::Stream {
                cav,
                stream: Stream::Detections,
            } => {
                self.egos.insert(cav.clone());
                if self.ego.is_none() {
                    self.ego = Some(cav.clone());
                }
                if let Some(result) = decode(seen).filter(|_| self.ego.as_ref() == Some(cav)) {
                    self.frame(at).result = Some((published, result));
                    return true;
                }
            }
            Topic::Stream {
                cav,
                stream: Stream::Lidar | Stream::Preview,
            } => {
                if let Some(payload) = seen.payload {
                    self.frame(at).sweeps.insert(cav.clone(), payload.to_vec());
                }
            }
            Topic::Stream { cav, stream } => {
                match stream {
                    Stream::Pose => {
                        if let Some(estimate) = decode(seen) {
                            self.frame(at)
                                .poses
                                .insert(cav.clone(), (published, estimate));
                        }
                    }
                    Stream::Boxes => {
                        if let Some(boxes) = decode(seen) {
                            self.frame(at).own_boxes.insert(cav.clone(), boxes);
                        }
                    }
                    _ => {}
                }
                self.arrived(at, cav, *stream, 0, seen);
            }
            Topic::Received { ego, cav, stream } => {
                if self.ego.as_ref().is_none_or(|shown| shown == ego) {
                    self.arrived(at, cav, *stream, 2, seen);
                }
            }
            Topic::Control(_) | Topic::Ready(_) | Topic::Stats(_) | Topic::Alive { .. } => {}
        }
        false
    }

    fn arrived(
        &mut self,
        at: u64,
        cav: &CavId,
        stream: Stream,
        rank: u8,
        seen: &ReceivedMessage<'_>,
    ) {
        let rank = match stream {
            Stream::Bev | Stream::Boxes | Stream::Points => rank + 1,
            Stream::Pose => rank,
            _ => return,
        };
        let latency_ms = (seen.arrived_nanos as f64 - seen.header.stamp.publish_nanos as f64) / 1e6;
        let arrivals = &mut self.frame(at).arrivals;
        if arrivals.get(cav).is_none_or(|known| known.rank <= rank) {
            arrivals.insert(
                cav.clone(),
                Arrival {
                    rank,
                    stream,
                    latency_ms,
                },
            );
        }
    }

    fn frame(&mut self, at: u64) -> &mut OpenFrame {
        self.open.entry(at).or_default()
    }
}

/// True for a true positive, false for a false one; `None` if the detection counts neither way.
fn is_hit(verdict: Verdict) -> Option<bool> {
    match verdict {
        Verdict::Match(_) => Some(true),
        Verdict::FalsePositive => Some(false),
        Verdict::Ignored => None,
    }
}

fn decode<M: Payload>(seen: &ReceivedMessage<'_>) -> Option<M> {
    wire::decode([seen.payload?], &Limits::DEFAULT)
        .map(|(_, message)| message)
        .ok()
}

impl OpenFrame {
    /// The judgement of the result; empty without truth, result or area.
    fn judged(&self, area: Option<&DetectionArea>, judge: &mut Judge) -> Judgement {
        match (&self.result, &self.truth, area) {
            (Some((_, result)), Some((_, truth)), Some(area)) => judge.judge(result, truth, area),
            _ => Judgement::default(),
        }
    }

    fn frame(
        &self,
        capture_nanos: u64,
        ledgers: &BTreeMap<String, (Ledger, Vec<StageSummary>)>,
        judgement: &Judgement,
    ) -> SceneFrame {
        let result = self.result.as_ref().map(|(_, result)| result);
        let (vehicles, points) = self.vehicles();
        let began = self.truth.as_ref().map(|(began, _)| *began);
        let since_began_ms = |nanos: u64| began.map(|began| (nanos as f64 - began as f64) / 1e6);
        let posed = result
            .and_then(|result| self.poses.get(&result.ego))
            .map(|(posed, _)| *posed);
        SceneFrame {
            capture_s: capture_nanos as f64 / 1e9,
            tick: self.truth.as_ref().map(|(_, truth)| truth.tick),
            ego: result.map(|result| result.ego.clone()),
            method: result.map(|result| result.method.clone()),
            latency_ms: self
                .result
                .as_ref()
                .and_then(|(done, _)| since_began_ms(*done)),
            swept_ms: None,
            posed_ms: posed.and_then(since_began_ms),
            vehicles,
            truth: self.true_boxes(judgement),
            detections: self.detections(judgement),
            single: self.single(),
            links: self.links(),
            stages: result.map_or(Vec::new(), |result| result.stages.clone()),
            pace: ShownPace::default(),
            egos: Vec::new(),
            area: None,
            ap_50: None,
            protocol: String::new(),
            processes: ledgers
                .iter()
                .map(|(process, (_, stages))| Process {
                    process: process.clone(),
                    stages: stages.clone(),
                })
                .collect(),
            messages: messages(ledgers.values().map(|(ledger, _)| ledger)),
            points,
        }
    }

    /// Every vehicle, the ego first, and their points.
    fn vehicles(&self) -> (Vec<Vehicle>, Vec<u8>) {
        let ego = self.result.as_ref().map(|(_, result)| &result.ego);
        let in_truth = self
            .truth
            .iter()
            .flat_map(|(_, truth)| truth.agents.iter().map(|agent| &agent.cav));
        let mut cavs: Vec<&CavId> = Vec::new();
        for cav in ego
            .into_iter()
            .chain(in_truth)
            .chain(self.poses.keys())
            .chain(self.sweeps.keys())
        {
            if !cavs.contains(&cav) {
                cavs.push(cav);
            }
        }
        let mut points = Vec::new();
        let vehicles = cavs
            .into_iter()
            .map(|cav| self.vehicle(cav, &mut points))
            .collect();
        (vehicles, points)
    }

    fn vehicle(&self, cav: &CavId, points: &mut Vec<u8>) -> Vehicle {
        let agents = self.truth.iter().flat_map(|(_, truth)| &truth.agents);
        let truth = agents
            .into_iter()
            .find(|agent| agent.cav == *cav)
            .map(|agent| &agent.world_from_lidar);
        let estimate = self
            .poses
            .get(cav)
            .map(|(_, estimate)| estimate)
            .or_else(|| {
                self.result
                    .as_ref()
                    .map(|(_, result)| result)
                    .filter(|result| result.ego == *cav)
                    .map(|result| &result.pose)
            });
        let pose = estimate.and_then(PoseEstimate::world_from_cav);
        let sweep = self.sweep(cav);
        points.extend(&sweep);
        let distance = |found: &Pose, truth: &Pose| {
            found
                .translation_m
                .iter()
                .zip(truth.translation_m)
                .map(|(a, b)| (a - b).powi(2))
                .sum::<f64>()
                .sqrt()
        };
        Vehicle {
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
            error_m: pose.zip(truth).map(|(found, truth)| distance(found, truth)),
            world_from_lidar: pose.or(truth).copied(),
            points: sweep.len() / POINT_BYTES,
        }
    }

    fn sweep(&self, cav: &CavId) -> Vec<u8> {
        let payload = self.sweeps.get(cav).map(Vec::as_slice);
        let decoded =
            payload.and_then(|payload| wire::decode::<Lidar>([payload], &Limits::DEFAULT).ok());
        decoded.map_or(Vec::new(), |(_, Lidar { points })| decimate(&points))
    }

    fn true_boxes(&self, judgement: &Judgement) -> Vec<ShownBox> {
        let mut objects: BTreeMap<i64, &TrueObject> = BTreeMap::new();
        for object in self
            .truth
            .iter()
            .flat_map(|(_, truth)| truth.agents.iter().flat_map(|agent| &agent.objects))
        {
            objects.entry(object.id).or_insert(object);
        }
        let shown = |object: &TrueObject| ShownBox {
            id: Some(object.id),
            is_counted: judgement.found.contains_key(&object.id),
            found_score: judgement.found.get(&object.id).copied().flatten(),
            is_hit: None,
            speed_mps: object.speed_mps,
            box3d: Box3d {
                center_m: object.world_from_object.translation_m,
                size_m: object.size_m,
                heading_rad: object.world_from_object.yaw_rad(),
            },
            score: None,
            source: None,
            class: Some(object.class.clone()),
        };
        objects.into_values().map(shown).collect()
    }

    /// The ego's detections, placed by its estimated pose.
    fn detections(&self, judgement: &Judgement) -> Vec<ShownBox> {
        let Some((_, result)) = &self.result else {
            return Vec::new();
        };
        let mut shown = self.placed(&result.ego, &result.pose, &result.detections, None);
        shown
            .iter_mut()
            .zip(&judgement.verdicts)
            .for_each(|(shown, verdict)| shown.is_hit = is_hit(*verdict));
        shown
    }

    /// Detections that single vehicles sent.
    fn single(&self) -> Vec<ShownBox> {
        let each = |(cav, boxes): (&CavId, &Boxes)| {
            self.placed(cav, &boxes.pose, &boxes.detections, Some(cav))
        };
        self.own_boxes.iter().flat_map(each).collect()
    }

    /// Detections in the frame of a vehicle, placed by its estimated pose, or else by its true one.
    fn placed(
        &self,
        cav: &CavId,
        pose: &PoseEstimate,
        found: &[Detection],
        source: Option<&CavId>,
    ) -> Vec<ShownBox> {
        let truth = self
            .truth
            .iter()
            .flat_map(|(_, truth)| &truth.agents)
            .find(|agent| agent.cav == *cav);
        let pose = pose
            .world_from_cav()
            .or(truth.map(|agent| &agent.world_from_lidar));
        let Some(world_from_cav) = pose.map(Pose::isometry) else {
            return Vec::new();
        };
        let shown = |detection: &Detection| ShownBox {
            box3d: detection.box3d.transformed(&world_from_cav),
            score: Some(detection.score),
            source: source.or(detection.source.as_ref()).cloned(),
            class: None,
            id: None,
            is_counted: false,
            found_score: None,
            is_hit: None,
            speed_mps: None,
        };
        found.iter().map(shown).collect()
    }

    fn links(&self) -> Vec<Link> {
        let Some((_, result)) = &self.result else {
            return Vec::new();
        };
        let mut links: BTreeMap<String, Link> = BTreeMap::new();
        let to = result.ego.to_string();
        for (cav, arrival) in self.arrivals.iter().filter(|(cav, _)| **cav != result.ego) {
            let (latency_ms, stream) = (Some(arrival.latency_ms), Some(arrival.stream.to_string()));
            let link = Link {
                from: cav.to_string(),
                to: to.clone(),
                latency_ms,
                stream,
                ..Link::default()
            };
            links.insert(link.from.clone(), link);
        }
        let mut link = |cav: &CavId| {
            let new = || Link {
                from: cav.to_string(),
                to: to.clone(),
                ..Link::default()
            };
            links.remove(cav.as_str()).unwrap_or_else(new)
        };
        let fused: Vec<Link> = result
            .fused
            .iter()
            .map(|neighbour| Link {
                wire_bytes: Some(neighbour.wire_bytes),
                age_ms: Some(neighbour.age_nanos as f64 / 1e6),
                is_fused: true,
                ..link(&neighbour.cav)
            })
            .collect();
        let skipped: Vec<Link> = result
            .skipped
            .iter()
            .map(|neighbour| Link {
                skipped: neighbour.reason,
                ..link(&neighbour.cav)
            })
            .collect();
        let mut all: Vec<Link> = fused
            .into_iter()
            .chain(skipped)
            .chain(links.into_values())
            .collect();
        for link in &mut all {
            let Some(known) = result
                .neighbours
                .iter()
                .find(|state| state.cav.as_str() == link.from)
            else {
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
fn messages<'a>(ledgers: impl Iterator<Item = &'a Ledger>) -> Vec<Messages> {
    let mut sum = Ledger::default();
    ledgers.for_each(|ledger| sum.merge(ledger));
    let line = |(account, counts): (&protocol::Account, &protocol::Counts)| Messages {
        topic: account.topic.to_string(),
        to: account.to.as_ref().map(ToString::to_string),
        sent: counts.sent,
        received: counts.received,
        dropped: counts.dropped.clone(),
    };
    sum.iter().map(line).collect()
}
