//! Pipeline of one vehicle: from a sweep to its pose, its BEV feature map and its own detections.
//!
//! Synchronous and without any network: live process, offline evaluation, tests and benches run the same lines.

use std::time::Instant;

use protocol::{
    Boxes, CavId, Detection, EgoMotion, Gnss, PointCloud, Pose, PoseEstimate, StageTiming,
};
use support::stage_times::StageTimes;
use tch::Tensor;

use crate::agent_output::{AgentOutput, Perception};
use crate::attack::Attack;
use localization::pose_source::{PoseInput, PoseSource};
use localization::tracker::PoseMeasurement;
use perception::boxes::postprocess::{PostprocessConfig, detections};
use perception::detector::{BackboneLevel, Detector, DetectorError, EncoderOutput};
use tracking::Tracker;

/// All inputs of one sweep.
#[derive(Debug, Clone, Copy)]
pub struct AgentInput<'a> {
    /// Capture time on the clock of the scene, nanoseconds.
    pub capture_nanos: u64,
    /// The sweep, in the LiDAR frame.
    pub cloud: &'a PointCloud,
    /// `world_from_lidar` as recorded or measured, if there is one.
    pub measured_pose: Option<&'a Pose>,
    /// Speed and yaw rate of the vehicle, where its sensors measure them.
    pub motion: EgoMotion,
}

/// A sweep between the steps of its computation: it is encoded once, for its pose, its feature map and the measurement
/// after them.
#[derive(Debug)]
pub(crate) struct EncodedSweep {
    /// Beginning of the first step.
    pub(crate) began: Instant,
    /// Feature map and levels of the detector; `None` before they are computed.
    encoded: Option<EncoderOutput>,
}

/// One vehicle: estimates its pose and perceives its surroundings.
#[derive(Debug)]
pub struct Agent {
    cav: CavId,
    pub(crate) pose_source: Box<dyn PoseSource>,
    detector: Option<Detector>,
    object_tracker: Tracker,
    /// Falsifies everything that is published.
    pub(crate) attack: Option<Attack>,
    /// Feature map `[1, C, H, W]` of the next sweep, where its encoder computed it before.
    pub(crate) known_map: Option<Tensor>,
    /// False for maps that are sent whole: neither confidence nor detections are computed.
    pub(crate) has_head: bool,
    /// True if the pose source takes the levels of this detector.
    shares_encoder: bool,
}

impl Agent {
    /// A vehicle with its pose source and its detector.
    pub fn new(cav: CavId, pose_source: Box<dyn PoseSource>, detector: Detector) -> Self {
        let shares_encoder = pose_source.detector_encoder() == Some(detector.encoder_sha256());
        Self {
            detector: Some(detector),
            shares_encoder,
            ..Self::without_detector(cav, pose_source)
        }
    }

    /// A vehicle that localizes itself and perceives nothing.
    pub fn without_detector(cav: CavId, pose_source: Box<dyn PoseSource>) -> Self {
        Self {
            cav,
            pose_source,
            detector: None,
            object_tracker: Tracker::default(),
            attack: None,
            known_map: None,
            has_head: true,
            shares_encoder: false,
        }
    }

    /// The same with an attack on everything that it publishes.
    pub fn with_attack(self, attack: Option<Attack>) -> Self {
        Self { attack, ..self }
    }

    /// The points that the vehicle shares: those that are not on its own body, whose extent its detector knows.
    pub fn share_points(&mut self, cloud: &PointCloud) -> PointCloud {
        let points = self.detector.as_ref().map_or_else(
            || cloud.clone(),
            |detector| detector.crop().without_own_body(cloud),
        );
        match &mut self.attack {
            Some(attack) => attack.points(points),
            None => points,
        }
    }

    /// Id of the vehicle.
    pub fn cav(&self) -> &CavId {
        &self.cav
    }

    /// Detector of the vehicle, if it has one.
    pub fn detector(&self) -> Option<&Detector> {
        self.detector.as_ref()
    }

    /// Perceives an empty sweep, so that the first sweep does not wait for the tensor library's preparations.
    ///
    /// # Errors
    /// See [`Self::perceive`].
    pub(crate) fn warm_up(&mut self) -> Result<(), DetectorError> {
        let detector = self.detector.as_mut().ok_or(DetectorError::Absent)?;
        // Not `encode_sweep`, which refuses a sweep without points.
        let encoded = detector.encode(&PointCloud::default())?;
        // Past the attack, which could store this empty map as its own first frame.
        self.own_perception(&encoded.features)?;
        Ok(())
    }

    /// First step of a sweep: its pose, which goes out before anything else is computed, and the durations. The sweep is
    /// encoded before if the pose is estimated from the detector's levels.
    pub(crate) fn localize(
        &mut self,
        input: &AgentInput<'_>,
    ) -> (PoseEstimate, Vec<StageTiming>, EncodedSweep) {
        let began = Instant::now();
        let is_needed = self.shares_encoder && self.pose_source.computes_from_sweep();
        // An error comes again, and is returned, when the sweep is perceived.
        let encoded = (self.detector.as_mut())
            .filter(|_| is_needed)
            .and_then(|detector| detector.encode_sweep(input.cloud).ok());
        let sweep = EncodedSweep { began, encoded };
        // The encoder's times are those of the perception: the time of the pose begins after it.
        let began = Instant::now();
        let input = pose_input(&self.cav, input, self.levels(&sweep));
        let pose = self.pose_source.estimate(&input);
        let pose = self
            .attack
            .as_ref()
            .map_or(pose, |attack| attack.pose(pose));
        (pose, self.pose_stages("pose", began), sweep)
    }

    /// Second step: feature map, confidence and own detections.
    ///
    /// # Errors
    /// See [`Self::perceive`].
    pub(crate) fn perceive_encoded(
        &mut self,
        cloud: &PointCloud,
        sweep: &mut EncodedSweep,
    ) -> Result<Perception, DetectorError> {
        if let Some(map) = self.known_map.take() {
            return self.perceive_map(&map);
        }
        let detector = self.detector.as_mut().ok_or(DetectorError::Absent)?;
        let encoded = sweep
            .encoded
            .take()
            .map_or_else(|| detector.encode_sweep(cloud), Ok)?;
        let mut perception = self.perceive_map(&encoded.features)?;
        // The encoder ran first, here or for the pose: its times belong to the sweep.
        perception.times = [encoded.times.as_slice(), &perception.times].concat();
        sweep.encoded = Some(encoded);
        Ok(perception)
    }

    /// Last step, after everything of the sweep was published: measures for the poses of later sweeps. Returns the
    /// durations, none if nothing was measured.
    pub(crate) fn observe_encoded(
        &mut self,
        input: &AgentInput<'_>,
        sweep: &EncodedSweep,
    ) -> Vec<StageTiming> {
        let began = Instant::now();
        let input = pose_input(&self.cav, input, self.levels(sweep));
        match self.pose_source.observe(&input) {
            true => self.pose_stages("pose measurement", began),
            false => Vec::new(),
        }
    }

    /// Levels of an encoded sweep, if the pose source takes those of this detector.
    fn levels<'a>(&self, sweep: &'a EncodedSweep) -> Option<&'a [BackboneLevel]> {
        let encoded = sweep.encoded.as_ref().filter(|_| self.shares_encoder);
        encoded.map(|encoded| encoded.levels.as_slice())
    }

    /// Duration of a step of the pose source since `began`, and of its stages if it computes.
    fn pose_stages(&self, step: &str, began: Instant) -> Vec<StageTiming> {
        let whole = StageTiming::new(step, began.elapsed());
        [&[whole][..], self.pose_source.stages()].concat()
    }

    /// Starts the pose source anew at a pose that a person states, with its standard deviations. False if the source
    /// starts at none.
    pub(crate) fn start_at(&mut self, capture_nanos: u64, stated: &Gnss) -> bool {
        self.pose_source.start_at(&PoseMeasurement {
            capture_nanos,
            world_from_lidar: stated.world_from_lidar.isometry(),
            position_std_m: stated.position_std_m,
            yaw_std_rad: stated.heading_std_rad,
        })
    }

    /// The message of a sweep's detections, with the tracks of objects that were detected before.
    pub fn boxes(
        &mut self,
        capture_nanos: u64,
        pose: PoseEstimate,
        detections: Vec<Detection>,
    ) -> Boxes {
        let objects = self
            .object_tracker
            .objects(capture_nanos, &pose, detections);
        let boxes = Boxes::new(pose, &objects);
        match &self.attack {
            Some(attack) => attack.boxes(boxes),
            None => boxes,
        }
    }

    /// Feature map, confidence and own detections of a sweep by itself.
    ///
    /// # Errors
    /// [`DetectorError`] if the vehicle has no detector, the sweep has no point in the area, a value is not valid, or the
    /// tensor library fails.
    pub fn perceive(&mut self, cloud: &PointCloud) -> Result<Perception, DetectorError> {
        let mut sweep = EncodedSweep {
            began: Instant::now(),
            encoded: None,
        };
        self.perceive_encoded(cloud, &mut sweep)
    }

    /// The same from a feature map `[1, C, H, W]` that the encoder computed before, as the encoder returned it.
    ///
    /// # Errors
    /// [`DetectorError::Shape`] if it is not a feature map of this detector.
    pub fn perceive_map(&mut self, map: &Tensor) -> Result<Perception, DetectorError> {
        let perception = self.own_perception(map)?;
        Ok(match &mut self.attack {
            Some(attack) => attack.perception(perception),
            None => perception,
        })
    }

    fn own_perception(&self, map: &Tensor) -> Result<Perception, DetectorError> {
        let detector = self.detector.as_ref().ok_or(DetectorError::Absent)?;
        let mut times = StageTimes::start();
        // The own head sees what neighbours receive, so that both judge the same map.
        let sent = detector.compressed(map)?;
        let features = detector.to_message(&sent)?;
        times.lap("message");
        let (confidence, detections) = match self.has_head {
            true => self.detect(detector, &detector.decompressed(&sent)?, &mut times)?,
            false => Default::default(),
        };
        Ok(Perception {
            features,
            confidence,
            detections,
            times: times.into_timings(),
        })
    }

    /// Confidence and detections of the map that receivers have.
    fn detect(
        &self,
        detector: &Detector,
        map: &Tensor,
        times: &mut StageTimes,
    ) -> Result<(Vec<f32>, Vec<Detection>), DetectorError> {
        let settings = PostprocessConfig::for_late_fusion(detector.config());
        let heads = detector.heads(map)?;
        times.lap("head");
        let boxes = detector.boxes(&heads, settings.score_threshold)?;
        let mut found = detections(&boxes, &settings);
        for detection in &mut found {
            detection.source = Some(self.cav.clone());
        }
        let mut detections = detector.refined(map, found)?;
        // The refinement changes scores, so the threshold applies again.
        detections.retain(|detection| detection.score > settings.score_threshold);
        times.lap("boxes");
        Ok((heads.confidence, detections))
    }

    /// All steps.
    ///
    /// # Errors
    /// See [`Self::perceive`].
    pub fn process(&mut self, input: &AgentInput<'_>) -> Result<AgentOutput, DetectorError> {
        let (pose, _, mut sweep) = self.localize(input);
        let perception = self.perceive_encoded(input.cloud, &mut sweep)?;
        self.observe_encoded(input, &sweep);
        Ok(AgentOutput { pose, perception })
    }
}

fn pose_input<'a>(
    cav: &'a CavId,
    input: &AgentInput<'a>,
    levels: Option<&'a [BackboneLevel]>,
) -> PoseInput<'a> {
    PoseInput {
        cav,
        capture_nanos: input.capture_nanos,
        cloud: input.cloud,
        levels,
        measured: input.measured_pose,
        motion: input.motion,
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use protocol::DecodedFeatures;
    use tch::Device;
    use tch::nn::VarStore;

    use super::*;
    use localization::pose_source::{NO_SOURCE, RecordedPose};
    use perception::model_config::DetectorConfig;
    use perception::pillars::point_pillars::PointPillars;
    use perception::weights::{CONFIG_KEY, Precision, save};

    fn agent() -> Agent {
        agent_with(None)
    }

    fn small_network(compress_ratio: Option<i64>) -> (VarStore, DetectorConfig, PointPillars) {
        tch::set_num_threads(1);
        tch::manual_seed(11);
        let lidar_range_m = [-12.8, -6.4, -3.0, 12.8, 6.4, 1.0];
        let config = DetectorConfig {
            lidar_range_m,
            compress_ratio,
            ..DetectorConfig::lean()
        };
        let network = VarStore::new(Device::Cpu);
        let pillars = PointPillars::new(&network.root(), &config).unwrap();
        // A head with vehicles everywhere gives non-maximum suppression something to do.
        let _ = tch::no_grad(|| {
            network.variables()["cls_head.bias"]
                .shallow_clone()
                .fill_(0.5)
        });
        (network, config, pillars)
    }

    fn agent_with(compress_ratio: Option<i64>) -> Agent {
        let (_network, _, pillars) = small_network(compress_ratio);
        Agent::new(
            CavId::new("4279").unwrap(),
            Box::new(RecordedPose),
            Detector::from_network(pillars),
        )
    }

    #[test]
    fn a_sweep_without_a_point_in_the_area_is_an_error_of_the_frame() {
        let mut agent = agent();
        let far = PointCloud {
            xyzi: vec![[4.0e6, 5.4e5, 30.0, 0.2]; 3],
        };
        let nothing = PointCloud::default();
        for (cloud, start) in [
            (&far, "none of the 3 points"),
            (&nothing, "none of the 0 points"),
        ] {
            let error = agent.perceive(cloud).unwrap_err();
            assert!(
                error.is_of_frame() && error.to_string().starts_with(start),
                "{error}"
            );
        }
        agent.warm_up().unwrap();
    }

    #[test]
    fn without_its_head_an_agent_sends_the_same_map() {
        let cloud = PointCloud {
            xyzi: vec![[3.0, 2.0, -1.0, 0.2]; 5],
        };
        let mut agent = agent();
        let whole = agent.perceive(&cloud).unwrap();
        agent.has_head = false;
        let map = agent.perceive(&cloud).unwrap();
        assert_eq!(map.features, whole.features);
        assert!(map.confidence.is_empty() && map.detections.is_empty());
        assert!(map.times.iter().all(|stage| stage.stage != "head"));
    }

    fn stage_names(times: &[StageTiming]) -> Vec<&str> {
        times.iter().map(|timing| timing.stage.as_str()).collect()
    }

    #[test]
    fn a_sweep_becomes_pose_map_and_detections() {
        let mut agent = agent();
        let points = (0..3000).map(|k| {
            [
                (k % 83) as f32 * 0.3 - 12.0,
                (k % 41) as f32 * 0.3 - 6.0,
                -1.5,
                0.2,
            ]
        });
        let cloud = PointCloud {
            xyzi: points.collect(),
        };
        let pose = Pose::from_xyz_yaw([5.0, 6.0, 0.0], 0.3);
        let input = AgentInput {
            capture_nanos: 0,
            cloud: &cloud,
            measured_pose: Some(&pose),
            motion: EgoMotion::default(),
        };
        let first = agent.process(&input).unwrap();
        assert_eq!(first.pose.world_from_cav(), Some(&pose));
        let Perception {
            features,
            confidence,
            detections,
            times,
        } = &first.perception;
        let [channels, height, width] = agent.detector().unwrap().map_shape();
        assert_eq!(features.values.len() as i64, channels * height * width);
        assert_eq!(confidence.len(), features.grid.cells());
        assert!(!detections.is_empty() && detections.len() <= 1000);
        assert!(
            detections
                .windows(2)
                .all(|pair| pair[0].score >= pair[1].score)
        );
        assert!(
            detections
                .iter()
                .all(|detection| detection.source.as_ref() == Some(agent.cav()))
        );
        assert_eq!(
            stage_names(times),
            [
                "voxelise", "pillars", "backbone", "message", "head", "boxes"
            ]
        );
        let second = agent.process(&input).unwrap();
        assert_eq!(
            (second.perception.features, second.perception.detections),
            (features.clone(), detections.clone())
        );
    }

    /// A pose source that takes levels, and notes the steps in which it gets them.
    #[derive(Debug)]
    struct TakesLevels {
        encoder: String,
        computes_first: bool,
        given: Arc<Mutex<Vec<bool>>>,
    }

    impl PoseSource for TakesLevels {
        fn estimate(&mut self, input: &PoseInput<'_>) -> PoseEstimate {
            self.given.lock().unwrap().push(input.levels.is_some());
            NO_SOURCE
        }

        fn observe(&mut self, input: &PoseInput<'_>) -> bool {
            self.given.lock().unwrap().push(input.levels.is_some());
            true
        }

        fn detector_encoder(&self) -> Option<&str> {
            Some(&self.encoder)
        }

        fn computes_from_sweep(&self) -> bool {
            self.computes_first
        }
    }

    #[test]
    fn a_pose_source_gets_the_levels_of_its_own_encoder_as_soon_as_it_computes() {
        let folder = tempfile::tempdir().unwrap();
        let weights = folder.path().join("detector.safetensors");
        let (network, config, _) = small_network(None);
        let metadata = [(
            CONFIG_KEY.to_owned(),
            serde_json::to_string(&config).unwrap(),
        )]
        .into();
        save(&weights, &network, &metadata, Precision::Single).unwrap();
        let cloud = PointCloud {
            xyzi: (0..500)
                .map(|k| [(k % 83) as f32 * 0.1 + 3.0, 0.5, -1.5, 0.2])
                .collect(),
        };
        let input = AgentInput {
            capture_nanos: 0,
            cloud: &cloud,
            measured_pose: None,
            motion: EgoMotion::default(),
        };
        let detector = Detector::load(&weights, Device::Cpu).unwrap();
        let mut plain = Agent::new(CavId::new("7").unwrap(), Box::new(RecordedPose), detector);
        let expected = plain.perceive(&cloud).unwrap();
        for (is_own, computes_first, steps) in [
            (true, true, [true, true]),
            (true, false, [false, true]),
            (false, true, [false, false]),
        ] {
            let detector = Detector::load(&weights, Device::Cpu).unwrap();
            let encoder = if is_own {
                detector.encoder_sha256().to_owned()
            } else {
                "other".to_owned()
            };
            let given = Arc::<Mutex<Vec<bool>>>::default();
            let source = TakesLevels {
                encoder,
                computes_first,
                given: Arc::clone(&given),
            };
            let mut agent = Agent::new(CavId::new("7").unwrap(), Box::new(source), detector);
            let seen = agent.process(&input).unwrap().perception;
            assert_eq!(
                (&seen.features, stage_names(&seen.times)),
                (&expected.features, stage_names(&expected.times))
            );
            // Levels are those of one sweep.
            let later = EncodedSweep {
                began: Instant::now(),
                encoded: None,
            };
            agent.observe_encoded(&input, &later);
            assert_eq!(
                *given.lock().unwrap(),
                [steps.as_slice(), &[false]].concat()
            );
        }
    }

    #[test]
    fn neighbours_get_the_code_and_the_own_head_gets_what_they_decode() {
        let mut agent = agent_with(Some(4));
        let cloud = PointCloud {
            xyzi: (0..500)
                .map(|k| [(k % 83) as f32 * 0.1 + 3.0, 0.5, -1.5, 0.2])
                .collect(),
        };
        let detector = agent.detector.as_mut().unwrap();
        let encoded = detector.encode(&cloud).unwrap().features;
        let shared = detector
            .to_message(&detector.compressed(&encoded).unwrap())
            .unwrap();
        let received = detector
            .received(&DecodedFeatures {
                features: shared.clone(),
                sent: None,
            })
            .unwrap();
        let heads = detector.heads(&received).unwrap();
        let undecoded = detector.heads(&encoded).unwrap();
        let seen = agent.perceive(&cloud).unwrap();
        assert_eq!(
            (&seen.features, &seen.confidence),
            (&shared, &heads.confidence)
        );
        assert_eq!((shared.channels, shared.code_of), (16, Some(64)));
        assert_ne!(seen.confidence, undecoded.confidence);
    }

    #[test]
    fn a_vehicle_without_a_detector_has_poses_and_no_perception() {
        let mut agent = Agent::without_detector(CavId::new("7").unwrap(), Box::new(RecordedPose));
        let pose = Pose::from_xyz_yaw([5.0, 6.0, 0.0], 0.3);
        let input = AgentInput {
            capture_nanos: 0,
            cloud: &PointCloud::default(),
            measured_pose: Some(&pose),
            motion: EgoMotion::default(),
        };
        assert_eq!(agent.localize(&input).0.world_from_cav(), Some(&pose));
        assert!(matches!(
            agent.perceive(input.cloud),
            Err(DetectorError::Absent)
        ));
    }

    #[test]
    fn a_sweep_without_a_point_is_an_error_that_names_the_area() {
        let mut agent = agent();
        let input = AgentInput {
            capture_nanos: 0,
            cloud: &PointCloud::default(),
            measured_pose: None,
            motion: EgoMotion::default(),
        };
        let error = agent.process(&input).unwrap_err().to_string();
        assert!(error.contains("12.8"), "{error}");
    }
}
