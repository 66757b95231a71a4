//! The ego's pipeline: its own view and those of its neighbours in, boxes around it out.
//!
//! Synchronous and without any network: live process, offline evaluation, tests and benches run the same code, and the
//! same views give the same bits.

mod box_correction;
mod error;
mod latency_compensation;

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::path::Path;

use nalgebra::Isometry3;
use perception::boxes::decode::Decoded;
use perception::boxes::postprocess::{AgentBoxes, PostprocessConfig, detections, postprocess};
use perception::detector::{Detector, Heads, check_values};
use perception::weights::Weights;
use protocol::{
    CavId, DecodedFeatures, Detection, DropReason, PointCloud, Pose, PoseEstimate, StageTiming,
};
use support::file_error::AtFile;
use support::stage_times::StageTimes;
use tch::{Device, Kind, Tensor, no_grad};

use self::box_correction::{boxes_in, corrected};
use self::latency_compensation::{LatencyCompensation, probability_carried_right};
use crate::misbehaviour::{Assessment, MisbehaviourDetector};
use fusion::box_input::{PlacedBox, placed};
use fusion::f64_tensor::{as_batch, one_after_another};
use fusion::history::{History, KeptMap};
use fusion::method::{Exchange, Method};
use fusion::model::FusionStage;
use fusion::points::merge_points;
use fusion::{AlignedMaps, MapMetadata, ReceivedMaps};

pub use crate::view::{Content, View};
pub use error::EgoError;

/// Lag of a neighbour's newest map behind its newest boxes beyond which the boxes alone are fused, nanoseconds: at 10 Hz
/// one sweep.
const MAP_LAG_NANOS: i64 = 100_000_000;
/// Boxes of one sender that are read beyond the number that the ego detects itself, so that no flood of them outweighs the
/// ego's own. On validation scenes a sender has at most 6 more.
const MORE_BOXES: usize = 32;

/// One frame's result.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct EgoOutput {
    /// Boxes in the ego's LiDAR frame, best first.
    pub detections: Vec<Detection>,
    /// Indices of the neighbours that are in it.
    pub fused: Vec<usize>,
    /// The other neighbours, each with the reason why its message cannot be used, out of range included; `None`: the method
    /// exchanges nothing.
    pub skipped: Vec<(usize, Option<DropReason>)>,
    /// Assessment of each neighbour that could be fused; empty without misbehaviour detection.
    pub beliefs: Vec<(usize, Assessment)>,
    /// Boxes of neighbours beyond the limit, which were not read.
    pub refused_boxes: usize,
    /// Messages of boxes whose velocities were not taken.
    pub refused_velocities: usize,
    /// Durations of the stages.
    pub stages: Vec<StageTiming>,
}

/// Fuses views and detects.
#[derive(Debug)]
pub struct Ego {
    method: Method,
    detector: Detector,
    fusion: FusionStage,
    history: History,
    trust: Option<MisbehaviourDetector>,
    /// Absent: boxes stay where they were detected.
    compensation: Option<LatencyCompensation>,
    /// Senders of more boxes than are read.
    over_limit: BTreeSet<CavId>,
    limits: PostprocessConfig,
    comm_range_m: f64,
}

impl Ego {
    /// The communication range of OPV2V and related data sets, metres: the default.
    pub const COMM_RANGE_M: f64 = 70.0;

    /// Reads the weights, to compute on `device`; `method` overrides the one that the file names.
    ///
    /// # Errors
    /// [`EgoError`] names the file, the tensor and both shapes.
    pub fn load(path: &Path, method: Option<Method>, device: Device) -> Result<Self, EgoError> {
        Self::from_weights(&Weights::load(path)?, method, device)
    }

    /// The same from a file already read.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn from_weights(
        weights: &Weights,
        method: Option<Method>,
        device: Device,
    ) -> Result<Self, EgoError> {
        let method = Method::of_weights(weights, method)?;
        // Methods without a fusion of maps run with the detector of any network.
        if method.exchange() == Exchange::Features && method.script_file().is_none() {
            method.check_training(weights)?;
        }
        let detector = Detector::from_weights(weights, &weights.detector_config()?, device)?;
        let fusion = FusionStage::from_weights(weights, method, detector.config(), device)?;
        Ok(Self::assembled(detector, method, fusion))
    }

    /// The pipeline of a method around a detector, with an untrained fusion and unmixed channels of neighbours.
    ///
    /// # Errors
    /// [`EgoError`] when no fusion can be built behind the detector.
    pub fn new(detector: Detector, method: Method) -> Result<Self, EgoError> {
        let fusion = FusionStage::untrained(method, detector.config(), detector.device())
            .at(Path::new("untrained network"))?;
        Ok(Self::assembled(detector, method, fusion))
    }

    fn assembled(detector: Detector, method: Method, fusion: FusionStage) -> Self {
        let reads_boxes = method.own_content() == Exchange::Features && fusion.reads_boxes();
        Self {
            method,
            limits: PostprocessConfig::for_detector(detector.config()),
            history: History::new(fusion.requirements.history.frames),
            detector,
            fusion,
            trust: None,
            compensation: reads_boxes.then(LatencyCompensation::default),
            over_limit: BTreeSet::new(),
            comm_range_m: Self::COMM_RANGE_M,
        }
    }

    /// The same with another communication range: neighbours farther away, metres in the plane, are ignored.
    pub fn with_comm_range(mut self, comm_range_m: f64) -> Self {
        self.comm_range_m = comm_range_m;
        self
    }

    /// The same with misbehaviour detection, if it is enabled: leaves out neighbours whose messages contradict the
    /// ego's perception.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn with_misbehaviour_detection(mut self, is_enabled: bool) -> Result<Self, EgoError> {
        self.trust = is_enabled
            .then(|| MisbehaviourDetector::new(&mut self.detector))
            .transpose()?;
        Ok(self)
    }

    /// The same with box alignment, if it is enabled: boxes of neighbours are carried to the time of the ego's frame by
    /// their velocities, and placed by a pose that is corrected by the boxes that the ego detects, too. Where the weights
    /// have a box input they always are.
    pub fn with_box_alignment(mut self, is_enabled: bool) -> Self {
        if is_enabled {
            self.compensation = Some(LatencyCompensation::default());
        }
        self
    }

    /// Its method.
    pub fn method(&self) -> Method {
        self.method
    }

    /// True if neighbours may send boxes in place of maps.
    pub fn reads_boxes(&self) -> bool {
        self.method.own_content() == Exchange::Features && self.fusion.reads_boxes()
    }

    /// Its detector.
    pub fn detector(&self) -> &Detector {
        &self.detector
    }

    /// Its fusion, to search the scales of activations.
    pub fn fusion_mut(&mut self) -> &mut FusionStage {
        &mut self.fusion
    }

    /// Removes the maps of earlier frames: another scene begins.
    pub fn forget(&mut self) {
        self.history.clear();
        self.trust.iter_mut().for_each(MisbehaviourDetector::clear);
        let is_compensated = self.compensation.is_some();
        self.compensation = is_compensated.then(LatencyCompensation::default);
    }

    /// Detects once without real data, so that the first frame does not wait for the tensor library's preparations.
    ///
    /// # Errors
    /// As [`Self::detect`].
    pub fn warm_up(&mut self, cav: &CavId) -> Result<(), EgoError> {
        let content = match self.method.own_content() {
            Exchange::Boxes => Content::Boxes(Vec::new()),
            Exchange::Points => Content::Points(self.one_point()),
            Exchange::Features | Exchange::Nothing => {
                let [channels, height, width] = self.detector.sent_shape();
                let map =
                    Tensor::f_zeros([1, channels, height, width], (Kind::Float, Device::Cpu))?;
                Content::Features(DecodedFeatures {
                    features: self.detector.to_message(&map)?,
                    sent: None,
                })
            }
        };
        // Twice: methods with a history use the first frame in the second.
        for capture_nanos in [0, 100_000_000] {
            let view = View {
                cav: cav.clone(),
                pose: PoseEstimate::new(Pose::IDENTITY, 1.0),
                capture_nanos,
                content: content.clone(),
            };
            self.detect(&view, std::slice::from_ref(&view))?;
        }
        self.forget();
        Ok(())
    }

    /// A cloud with one point, in the middle of the area.
    fn one_point(&self) -> PointCloud {
        let [x0, y0, z0, x1, y1, z1] = self.detector.config().lidar_range_m;
        let middle = [(x0, x1), (y0, y1), (z0, z1)].map(|(low, high)| f64::midpoint(low, high));
        let [x, y, z] = middle.map(|value| value as f32);
        PointCloud {
            xyzi: vec![[x, y, z, 0.0]],
        }
    }

    /// Detects around the ego. Neighbours that cannot be used are left out; with none left the result is ego-only.
    ///
    /// # Errors
    /// [`EgoError`] when the ego's own view does not have the content that the method needs, and when values of the
    /// frame are not valid ([`EgoError::is_of_frame`]).
    pub fn detect(&mut self, own: &View, neighbours: &[View]) -> Result<EgoOutput, EgoError> {
        let needed = self.method.own_content();
        let (method, found) = (self.method, own.content.exchange());
        if found != needed {
            let problem = format!("method {method} needs the ego's own {needed:?}, not {found:?}");
            return Err(EgoError::OwnView(problem));
        }
        self.history.advance(own.capture_nanos);
        if let Some(compensation) = &mut self.compensation {
            compensation.forget_absent(own.capture_nanos);
        }
        let carried: Vec<Cow<'_, View>> = neighbours
            .iter()
            .map(|view| match &mut self.compensation {
                Some(compensation) => compensation.carried(view, own.capture_nanos),
                None => Cow::Borrowed(view),
            })
            .collect();
        let mut chosen = self.choose(own, &carried);
        let mut stages = StageTimes::start();
        let mut beliefs = Vec::new();
        if let Some(trust) = &mut self.trust
            && !chosen.fused.is_empty()
        {
            let others = chosen.aligned[1..].iter();
            let others: Vec<_> = others.map(|one| (one.view, one.ego_from_cav)).collect();
            let found = no_grad(|| trust.judge(own, &others, &mut self.detector))?;
            let is_out: Vec<bool> = found.iter().map(|one| one.misbehaviour.is_some()).collect();
            beliefs = chosen.fused.iter().copied().zip(found).collect();
            chosen.leave_out(&is_out, DropReason::Misbehaviour);
            stages.lap("trust");
        }
        let compensation = self.compensation.as_mut();
        let refused_velocities = compensation.map_or(0, |one| std::mem::take(&mut one.refused));
        let mut own_boxes = 0;
        if self.compensation.is_some() {
            own_boxes = no_grad(|| self.correct_poses_of_boxes(&mut chosen.aligned, &mut stages))?;
        }
        let aligned = &chosen.aligned;
        let most_boxes = own_boxes + MORE_BOXES;
        let refused_boxes = self.boxes_over_limit(aligned, most_boxes);
        let detections = no_grad(|| match needed {
            Exchange::Boxes => Ok(self.merge_boxes(aligned, &mut stages)),
            Exchange::Points => self.merge_points(aligned, &mut stages),
            Exchange::Features | Exchange::Nothing => {
                self.merge_features(aligned, most_boxes, &mut stages)
            }
        })?;
        Ok(EgoOutput {
            detections,
            fused: chosen.fused,
            skipped: chosen.skipped,
            beliefs,
            refused_boxes,
            refused_velocities,
            stages: stages.into_timings(),
        })
    }

    /// The views that can be fused: of each neighbour its map and its boxes, or its boxes alone where its map is outdated.
    fn choose<'a>(&self, own: &'a View, neighbours: &'a [Cow<'_, View>]) -> ChosenViews<'a> {
        let ego_from_cav = Pose::IDENTITY;
        let mut choice = ChosenViews {
            aligned: vec![Aligned {
                view: own,
                ego_from_cav,
            }],
            fused: Vec::new(),
            skipped: Vec::new(),
        };
        for (index, view) in neighbours.iter().map(Cow::as_ref).enumerate() {
            match self.align(own, view) {
                Ok(ego_from_cav) => {
                    choice.aligned.push(Aligned { view, ego_from_cav });
                    choice.fused.push(index);
                }
                Err(reason) => choice.skipped.push((index, reason)),
            }
        }
        let others = choice.aligned[1..].iter();
        let is_unneeded = others.map(|view| view.is_outdated_beside(&choice.aligned));
        let is_unneeded: Vec<bool> = is_unneeded.collect();
        choice.leave_out(&is_unneeded, DropReason::Unneeded);
        choice
    }

    /// Pose of a neighbour relative to the ego, or the reason why it is left out, `None` if the method exchanges nothing.
    fn align(&self, own: &View, view: &View) -> Result<Pose, Option<DropReason>> {
        if self.method.exchange() == Exchange::Nothing {
            return Err(None);
        }
        let no_pose = Some(DropReason::NoPose);
        let world_from_ego = own.pose.world_from_cav().ok_or(no_pose)?;
        let world_from_cav = view.pose.world_from_cav().ok_or(no_pose)?;
        if world_from_ego.planar_distance_m(world_from_cav) > self.comm_range_m {
            return Err(Some(DropReason::OutOfRange));
        }
        let fits = match (&own.content, &view.content) {
            (Content::Features(_), Content::Features(map)) => self.is_own_shape(map),
            (Content::Features(_), Content::Boxes(_)) => self.fusion.reads_boxes(),
            (own, other) => own.exchange() == other.exchange(),
        };
        if !fits {
            return Err(Some(DropReason::Shape));
        }
        Ok(world_from_ego.from_world(world_from_cav))
    }

    fn is_own_shape(&self, map: &DecodedFeatures) -> bool {
        let DecodedFeatures { features, sent } = map;
        let [channels, ..] = self.detector.sent_shape();
        let cells = features.grid.cells();
        features.grid == self.detector.grid()
            && i64::from(features.channels) == channels
            && features.code_of == self.detector.code_of()
            && features.values.len() == cells * features.channels as usize
            && sent.as_ref().is_none_or(|sent| sent.len() == cells)
    }

    /// Corrects the poses at which neighbours' boxes are placed by those that the ego detects itself, and returns their
    /// number. Maps keep the stated pose.
    fn correct_poses_of_boxes(
        &self,
        aligned: &mut [Aligned<'_>],
        stages: &mut StageTimes,
    ) -> Result<usize, EgoError> {
        let mut others = aligned[1..].iter();
        if others.all(|other| other.view.content.objects().is_empty()) {
            return Ok(0);
        }
        let own = match &aligned[0].view.content {
            Content::Features(map) => boxes_in(&self.tensors(map, true)?.0, &self.detector)?,
            own => own.detections().cloned().collect(),
        };
        for sender in &mut aligned[1..] {
            let received: Vec<Detection> = sender.view.content.detections().cloned().collect();
            sender.ego_from_cav = corrected(sender.ego_from_cav, &received, &own);
        }
        stages.lap("correct");
        Ok(own.len())
    }

    /// Intermediate fusion, and ego-only detection; boxes of neighbours, at most `most_boxes` of each, change the output of the
    /// head.
    fn merge_features(
        &mut self,
        all: &[Aligned<'_>],
        most_boxes: usize,
        stages: &mut StageTimes,
    ) -> Result<Vec<Detection>, EgoError> {
        let boxes: Vec<PlacedBox> = (1..all.len())
            .flat_map(|sender| all[sender].boxes(sender, all[0].view, most_boxes))
            .collect();
        let (mut aligned, mut maps, mut sent) = (Vec::new(), Vec::new(), Vec::new());
        for one in all {
            if let Content::Features(map) = &one.view.content {
                let (values, cells) = self.tensors(map, maps.is_empty())?;
                aligned.push(*one);
                maps.push(values);
                sent.push(cells);
            }
        }
        let numbered = aligned.iter().enumerate();
        let metadata = numbered.map(|(agent, view)| view.metadata(agent, aligned[0].view));
        let mut metadata: Vec<MapMetadata> = metadata.collect();
        if let Some(pose_graph) = &self.fusion.requirements.pose_graph {
            box_correction::correct_by_boxes(&mut metadata, &maps, &self.detector, pose_graph)?;
            stages.lap("correct");
        }
        let (earlier, of_earlier): (Vec<_>, Vec<_>) = self.earlier(&aligned).into_iter().unzip();
        metadata.extend(of_earlier);
        let newest = ReceivedMaps::new(one_after_another(&maps)?, Some(one_after_another(&sent)?));
        let earlier = (!earlier.is_empty())
            .then(|| ReceivedMaps::together(&earlier))
            .transpose()?;
        let on_grid = self.fusion.align_with(&newest, earlier, &metadata)?;
        stages.lap("align");
        let fused = self.fusion.fuse(&on_grid)?.map;
        let fused = as_batch(&fused)?;
        check_values("the fused feature map", &fused)?;
        stages.lap("fuse");
        let detections = self.boxes_of(&fused, &boxes, stages)?;
        self.keep(&aligned, maps.into_iter().zip(sent), &on_grid)?;
        Ok(detections)
    }

    /// Number of boxes beyond `most` of a sender, which are not read. Names each such sender once.
    fn boxes_over_limit(&mut self, all: &[Aligned<'_>], most: usize) -> usize {
        if self.method.own_content() != Exchange::Features || self.compensation.is_none() {
            return 0;
        }
        let mut refused = 0;
        for Aligned { view, .. } in &all[1..] {
            let boxes = view.content.objects().len();
            refused += boxes.saturating_sub(most);
            if boxes > most && self.over_limit.insert(view.cav.clone()) {
                tracing::warn!(cav = %view.cav, boxes, "more than {most} boxes: those of the lowest scores are left out");
            }
        }
        refused
    }

    /// A feature map `[1, C, H, W]` and the mask of its sent cells `[1, 1, H, W]`.
    fn tensors(&self, map: &DecodedFeatures, is_ego: bool) -> Result<(Tensor, Tensor), EgoError> {
        let [channels, height, width] = self.detector.sent_shape();
        if !self.is_own_shape(map) {
            let (found, own) = (&map.features, self.detector.grid());
            return Err(EgoError::OwnView(format!(
                "the ego's own map is {} x {}, the network's is {channels} x {own}",
                found.channels, found.grid
            )));
        }
        let sent = match &map.sent {
            Some(sent) if !is_ego => Tensor::f_from_slice(sent)?.f_to_kind(Kind::Float)?,
            // The ego has all of its own map.
            _ => Tensor::f_ones([height, width], (Kind::Float, Device::Cpu))?,
        };
        let sent = sent.f_view([1, 1, height, width])?;
        let sent = sent.f_to_device(self.detector.device())?;
        Ok((self.detector.received(map)?, sent))
    }

    /// The kept maps of the vehicles that take part, with their poses in the ego's current frame. An ego without a pose
    /// has none.
    fn earlier(&self, aligned: &[Aligned<'_>]) -> Vec<(&ReceivedMaps, MapMetadata)> {
        let ego = aligned[0].view;
        let Some(world_from_ego) = ego.pose.world_from_cav() else {
            return Vec::new();
        };
        let mut earlier = Vec::new();
        for (agent, Aligned { view, .. }) in aligned.iter().enumerate() {
            for kept in self.history.before(&view.cav, view.capture_nanos) {
                let age_nanos = ego.capture_nanos as i64 - kept.capture_nanos as i64;
                let metadata = MapMetadata {
                    agent,
                    ego_from_cav: world_from_ego.from_world(&kept.world_from_cav),
                    confidence: kept.confidence,
                    age_secs: age_nanos as f64 * 1e-9,
                };
                earlier.push((&kept.map, metadata));
            }
        }
        earlier
    }

    /// Keeps the maps of this frame for later frames.
    fn keep(
        &mut self,
        aligned: &[Aligned<'_>],
        maps: impl Iterator<Item = (Tensor, Tensor)>,
        on_grid: &AlignedMaps,
    ) -> Result<(), EgoError> {
        if self.fusion.requirements.history.frames < 2 {
            return Ok(());
        }
        for ((Aligned { view, .. }, (map, sent)), index) in aligned.iter().zip(maps).zip(0..) {
            let Some(world_from_cav) = view.pose.world_from_cav().copied() else {
                continue;
            };
            let turned = on_grid.received.only(index, index + 1)?;
            let received = ReceivedMaps::new(map, Some(sent));
            let kept = KeptMap {
                capture_nanos: view.capture_nanos,
                world_from_cav,
                confidence: f64::from(view.pose.confidence()),
                map: self.fusion.kept(&received, &turned)?,
            };
            self.history.keep(&view.cav, kept);
        }
        Ok(())
    }

    /// Early fusion: one cloud in the ego frame.
    fn merge_points(
        &mut self,
        aligned: &[Aligned<'_>],
        stages: &mut StageTimes,
    ) -> Result<Vec<Detection>, EgoError> {
        let clouds = aligned
            .iter()
            .filter_map(|Aligned { view, .. }| match &view.content {
                Content::Points(points) => Some(points),
                Content::Features(_) | Content::Boxes(_) => None,
            });
        let poses: Vec<Pose> = aligned.iter().map(|view| view.ego_from_cav).collect();
        let merged = merge_points(clouds, &poses);
        stages.lap("align");
        let encoded = self.detector.encode_merged(&merged)?.features;
        let features = self.detector.through_compressor(&encoded)?;
        stages.lap("encode");
        self.boxes_of(&features, &[], stages)
    }

    /// Late fusion: the boxes of all in the ego frame, the best of those that overlap.
    fn merge_boxes(&self, aligned: &[Aligned<'_>], stages: &mut StageTimes) -> Vec<Detection> {
        let decoded: Vec<(Vec<Decoded>, Isometry3<f64>)> = (aligned.iter())
            .map(|Aligned { view, ego_from_cav }| {
                let age_s = view.age_nanos(aligned[0].view) as f64 * 1e-9;
                let boxes = view.content.objects().iter().map(|object| {
                    let right = match &self.compensation {
                        Some(_) => probability_carried_right(object, age_s),
                        None => 1.0,
                    };
                    Decoded {
                        anchor: 0,
                        score: object.detection.score * right as f32,
                        box3d: object.detection.box3d,
                    }
                });
                let found = boxes.filter(|found| found.score > self.limits.score_threshold);
                (found.collect(), ego_from_cav.isometry())
            })
            .collect();
        let boxes: Vec<AgentBoxes<'_>> = (decoded.iter())
            .map(|(boxes, output_from_agent)| AgentBoxes {
                boxes,
                output_from_agent: *output_from_agent,
            })
            .collect();
        let merged = postprocess(&boxes, &self.limits);
        let detections = merged
            .iter()
            .map(|found| found.detection(Some(aligned[found.agent].view.cav.clone())))
            .collect();
        stages.lap("boxes");
        detections
    }

    fn boxes_of(
        &self,
        fused: &Tensor,
        of_neighbours: &[PlacedBox],
        stages: &mut StageTimes,
    ) -> Result<Vec<Detection>, EgoError> {
        let mut head = self.detector.head_output(fused)?;
        if !of_neighbours.is_empty() {
            head = tch::no_grad(|| self.fusion.with_boxes(fused, head, of_neighbours))?;
        }
        let heads = Heads::new(&head)?;
        stages.lap("head");
        let decoded = self.detector.boxes(&heads, self.limits.score_threshold)?;
        let detections = detections(&decoded, &self.limits);
        stages.lap("boxes");
        Ok(detections)
    }
}

/// Views of a frame.
struct ChosenViews<'a> {
    /// The ego's own, then one for each of `fused`.
    aligned: Vec<Aligned<'a>>,
    /// Indices of the neighbours that are fused.
    fused: Vec<usize>,
    /// The others, each with its reason.
    skipped: Vec<(usize, Option<DropReason>)>,
}

impl ChosenViews<'_> {
    /// Leaves the marked of the fused neighbours out; one mark for each of them.
    fn leave_out(&mut self, is_out: &[bool], reason: DropReason) {
        debug_assert_eq!(self.fused.len(), is_out.len());
        // The ego's own view stays.
        let mut marks = [false].iter().chain(is_out);
        self.aligned.retain(|_| marks.next() == Some(&false));
        let mut marks = is_out.iter();
        let left_out = self.fused.extract_if(.., |_| marks.next() != Some(&false));
        let skipped = left_out.map(|index| (index, Some(reason)));
        self.skipped.extend(skipped);
    }
}

/// A view and its pose.
#[derive(Clone, Copy)]
struct Aligned<'a> {
    view: &'a View,
    ego_from_cav: Pose,
}

impl Aligned<'_> {
    fn has_map(&self) -> bool {
        matches!(self.view.content, Content::Features(_))
    }

    /// True for a map of a neighbour whose boxes are newer by more than [`MAP_LAG_NANOS`]. Older boxes are read beside a
    /// newer map: they are carried to the time of the frame by their velocities.
    fn is_outdated_beside(&self, all: &[Self]) -> bool {
        self.has_map()
            && all[1..].iter().any(|other| {
                let lag_nanos = self.view.age_nanos(other.view);
                other.view.cav == self.view.cav && !other.has_map() && lag_nanos > MAP_LAG_NANOS
            })
    }

    /// Its best boxes, at most as many, if it has sent boxes; `sender` is its number.
    fn boxes(&self, sender: usize, ego: &View, most: usize) -> Vec<PlacedBox> {
        let metadata = self.metadata(sender, ego);
        let (age_secs, confidence) = (metadata.age_secs, metadata.confidence);
        let found = self.view.content.detections();
        let mut boxes = placed(found, &self.ego_from_cav, sender, age_secs, confidence);
        boxes.truncate(most);
        boxes
    }

    fn metadata(&self, agent: usize, ego: &View) -> MapMetadata {
        MapMetadata {
            agent,
            ego_from_cav: self.ego_from_cav,
            confidence: f64::from(self.view.pose.confidence()),
            age_secs: self.view.age_nanos(ego) as f64 * 1e-9,
        }
    }
}

#[cfg(test)]
pub(crate) mod tests;
