//! Translator: what a message of a run is in ROS 2.

use std::collections::{BTreeMap, BTreeSet};

use protocol::{
    Camera, CavId, EgoMotion, Message, PoseEstimate, ProcessId, RunId, Stats, Stream, Topic, Truth,
};

use super::encode::{self, FrameInParent, Marked, Status};
use super::names::{FrameNames, MAP_FRAME};
use super::topic::{RosTopic, VehicleTopic};

const DETECTION_RGB: [f32; 3] = [1.0, 0.37, 0.30];
const TRACK_RGB: [f32; 3] = [0.91, 0.30, 0.74];
const TRUTH_RGB: [f32; 3] = [0.25, 0.81, 0.47];

/// A message of ROS 2.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RosMessage {
    /// Topic on which it is published.
    pub topic: RosTopic,
    /// The message in CDR, with its encapsulation header.
    pub cdr: Vec<u8>,
}

impl RosMessage {
    /// `cdr` for `topic`.
    pub fn new(topic: RosTopic, cdr: Vec<u8>) -> Self {
        Self { topic, cdr }
    }
}

/// Translator of the messages of one run. It remembers the last motion of each vehicle, for its odometry, and the losses
/// of each process, for its diagnosis.
#[derive(Debug)]
pub struct Translator {
    run: RunId,
    names: FrameNames,
    /// Vehicles whose LiDARs have a place in a tree of frames that others publish.
    placed: BTreeSet<CavId>,
    motions: BTreeMap<CavId, (u64, EgoMotion)>,
    losses: BTreeMap<ProcessId, u64>,
    /// Latest capture time so far: the stamp of messages without one.
    latest_nanos: u64,
}

impl Translator {
    /// A translator for `run`.
    pub fn new(run: &RunId) -> Self {
        Self {
            run: run.clone(),
            names: FrameNames::default(),
            placed: BTreeSet::new(),
            motions: BTreeMap::new(),
            losses: BTreeMap::new(),
            latest_nanos: 0,
        }
    }

    /// The same with other names of frames, and without transforms from `map` to the LiDARs of `placed` vehicles, which
    /// hang elsewhere: a frame has one parent.
    #[must_use]
    pub fn with_frames(self, names: FrameNames, placed: BTreeSet<CavId>) -> Self {
        Self {
            names,
            placed,
            ..self
        }
    }

    /// True if messages of `topic` have to be passed to [`Self::translate`].
    pub fn wants(topic: &Topic) -> bool {
        use Stream::{Camera, Detections, Imu, Lidar, Pose, Tracks};

        match topic {
            Topic::Truth | Topic::Stats(_) => true,
            Topic::Stream { stream, .. } => {
                matches!(stream, Lidar | Imu | Camera(_) | Pose | Detections | Tracks)
            }
            _ => false,
        }
    }

    /// The ROS 2 messages for a message published on `topic`, captured at `capture_nanos`; empty if ROS has none for it.
    pub fn translate(
        &mut self,
        topic: &Topic,
        capture_nanos: u64,
        message: &Message,
    ) -> Vec<RosMessage> {
        match (topic, message) {
            (Topic::Stream { cav, stream }, message) => {
                self.latest_nanos = capture_nanos;
                self.stream(cav, *stream, capture_nanos, message)
            }
            (Topic::Truth, Message::Truth(truth)) => self.truth_messages(capture_nanos, truth),
            (Topic::Stats(_), Message::Stats(stats)) => {
                let status = self.status(stats);
                let cdr = encode::diagnostics(self.latest_nanos, &status);
                vec![RosMessage::new(RosTopic::Diagnostics, cdr)]
            }
            _ => Vec::new(),
        }
    }

    /// [`Self::translate`] of a message of a vehicle, captured at `at`, nanoseconds.
    fn stream(
        &mut self,
        cav: &CavId,
        stream: Stream,
        at: u64,
        message: &Message,
    ) -> Vec<RosMessage> {
        let frame = self.names.lidar(cav);
        match (stream, message) {
            (Stream::Lidar, Message::Lidar(lidar)) => {
                let cdr = encode::point_cloud(at, &frame, &lidar.points);
                vec![of_vehicle(cav, VehicleTopic::Points, cdr)]
            }
            (Stream::Camera(number), Message::Camera(image)) => {
                self.image_messages(cav, number, at, image)
            }
            (Stream::Imu, Message::Imu(motion)) => {
                self.motions.insert(cav.clone(), (at, *motion));
                Vec::new()
            }
            (Stream::Pose, Message::Pose(estimate)) => self.pose(cav, at, estimate),
            (Stream::Detections, Message::Detections(result)) => {
                let boxes: Vec<Marked> = result.detections.iter().map(Marked::from).collect();
                let detections = encode::detections(at, &frame, &result.detections);
                let markers = encode::markers(at, &frame, "detections", DETECTION_RGB, &boxes);
                vec![
                    of_vehicle(cav, VehicleTopic::Detections, detections),
                    of_vehicle(cav, VehicleTopic::Markers, markers),
                ]
            }
            (Stream::Tracks, Message::Tracks(tracks)) => {
                let boxes: Vec<Marked> = tracks.tracks.iter().map(Marked::from).collect();
                let markers = encode::markers(at, &frame, "tracks", TRACK_RGB, &boxes);
                let tracks = encode::tracks(at, &frame, &tracks.tracks);
                vec![
                    of_vehicle(cav, VehicleTopic::Tracks, tracks),
                    of_vehicle(cav, VehicleTopic::TrackMarkers, markers),
                ]
            }
            _ => Vec::new(),
        }
    }

    fn pose(&self, cav: &CavId, at: u64, estimate: &PoseEstimate) -> Vec<RosMessage> {
        let Some(pose) = estimate.world_from_cav() else {
            return Vec::new();
        };
        // A motion of another capture time would state a speed that was not measured with this pose.
        let motion = self.motions.get(cav).filter(|(nanos, _)| *nanos == at);
        let motion = motion.map_or(EgoMotion::default(), |(_, motion)| *motion);
        let covariance = estimate.covariance();
        let frame = self.names.lidar(cav);
        let odometry = encode::odometry(at, &frame, pose, covariance, motion);
        // The transform first: a receiver of the others can use them at once.
        let transform = (!self.placed.contains(cav))
            .then(|| transforms(at, &[(MAP_FRAME.into(), frame, *pose)]));
        transform
            .into_iter()
            .chain([
                of_vehicle(cav, VehicleTopic::Pose, encode::pose(at, pose, covariance)),
                of_vehicle(cav, VehicleTopic::Odometry, odometry),
            ])
            .collect()
    }

    /// An image, and the calibration that is known of its camera: projection and place on the vehicle.
    fn image_messages(&self, cav: &CavId, number: u8, at: u64, image: &Camera) -> Vec<RosMessage> {
        let (frame, metadata) = (self.names.camera(cav, number), &image.metadata);
        let place = metadata
            .lidar_from_camera
            .map(|pose| transforms(at, &[(self.names.lidar(cav), frame.clone(), pose)]));
        let info = metadata.pinhole.map(|pinhole| {
            let cdr = encode::camera_info(at, &frame, metadata, &pinhole);
            of_vehicle(cav, VehicleTopic::CameraInfo(number), cdr)
        });
        let image = encode::compressed_image(at, &frame, image);
        let encoded = of_vehicle(cav, VehicleTopic::Image(number), image);
        place.into_iter().chain(info).chain([encoded]).collect()
    }

    fn truth_messages(&self, at: u64, truth: &Truth) -> Vec<RosMessage> {
        let mut seen = BTreeSet::new();
        let objects = truth
            .agents
            .iter()
            .flat_map(|agent| &agent.objects)
            // Several agents annotate the same object, and its id is the same in all.
            .filter(|object| seen.insert(object.id));
        let boxes: Vec<Marked> = objects.map(encode::truth_marker).collect();
        let frames = truth.agents.iter().map(|agent| {
            let name = self.names.truth(&agent.cav);
            (MAP_FRAME.to_owned(), name, agent.world_from_lidar)
        });
        let frames: Vec<_> = frames.collect();
        let markers = encode::markers(at, MAP_FRAME, "truth", TRUTH_RGB, &boxes);
        vec![
            transforms(at, &frames),
            RosMessage::new(RosTopic::Truth, markers),
        ]
    }

    /// Status of a process: a warning if it has lost messages since its last report.
    fn status(&mut self, stats: &Stats) -> Status {
        let total = stats.ledger.total();
        let lost = total.dropped_total();
        // The ledger of a restarted process begins at 0, below the losses before.
        let new = lost.saturating_sub(self.losses.insert(stats.process.clone(), lost).unwrap_or(0));
        let mut values = vec![
            ("messages sent".to_owned(), total.sent.to_string()),
            ("messages received".to_owned(), total.received.to_string()),
        ];
        values.extend(
            total
                .dropped
                .iter()
                .map(|(reason, count)| (format!("dropped: {reason}"), count.to_string())),
        );
        values.extend(stats.stages.iter().flat_map(|stage| {
            [("median", stage.p50_ms), ("95th percentile", stage.p95_ms)]
                .map(|(what, ms)| (format!("{} {what} (ms)", stage.stage), format!("{ms:.2}")))
        }));
        values.push(("CPU time (s)".into(), format!("{:.1}", stats.usage.cpu_s)));
        let resident = stats.usage.resident_bytes.to_string();
        values.push(("resident memory (bytes)".into(), resident));
        Status {
            is_warning: new > 0,
            name: format!("v2vloc: {}", stats.process),
            message: if new > 0 {
                format!("{new} messages dropped since the last report")
            } else {
                "running".into()
            },
            hardware_id: self.run.to_string(),
            values,
        }
    }
}

fn of_vehicle(cav: &CavId, topic: VehicleTopic, cdr: Vec<u8>) -> RosMessage {
    RosMessage::new(RosTopic::Vehicle(cav.clone(), topic), cdr)
}

fn transforms(at: u64, frames: &[FrameInParent]) -> RosMessage {
    RosMessage::new(RosTopic::Tf, encode::transforms(at, frames))
}

#[cfg(test)]
mod tests {
    use protocol::{
        Account, CameraMetadata, DropReason, ImageFormat, Ledger, NoPoseReason, Pinhole, Pose,
        ProcessUsage,
    };

    use super::*;

    fn topic(stream: Stream) -> Topic {
        Topic::Stream {
            cav: CavId::new("1").unwrap(),
            stream,
        }
    }

    fn translator() -> Translator {
        Translator::new(&RunId::new("test").unwrap())
    }

    fn topic_names(messages: &[RosMessage]) -> Vec<String> {
        messages
            .iter()
            .map(|message| message.topic.name(None).to_string())
            .collect()
    }

    /// Speed in the odometry that a pose at this time gives.
    fn speed_in_odometry(translator: &mut Translator, pose: &Message, nanos: u64) -> f64 {
        let messages = translator.translate(&topic(Stream::Pose), nanos, pose);
        assert_eq!(
            topic_names(&messages),
            ["/tf", "/cav_1/pose", "/cav_1/odometry"]
        );
        let cdr = &messages[2].cdr;
        f64::from_le_bytes(*cdr[cdr.len() - 8 * (6 + 36)..].first_chunk().unwrap())
    }

    /// Names of the topics that an image of the camera is published on.
    fn topics_of_image(camera: &Camera) -> Vec<String> {
        let image = Message::Camera(camera.clone());
        topic_names(&translator().translate(&topic(Stream::Camera(2)), 5, &image))
    }

    #[test]
    fn a_pose_is_a_transform_a_pose_and_an_odometry_with_the_motion_of_its_time() {
        let mut translator = translator();
        let motion = Message::Imu(EgoMotion {
            speed_mps: Some(7.0),
            yaw_rate_rad_s: Some(0.5),
        });
        assert_eq!(translator.translate(&topic(Stream::Imu), 100, &motion), []);
        let pose = Message::Pose(PoseEstimate::new(Pose::IDENTITY, 0.9));
        for (nanos, speed_mps) in [(100, 7.0), (200, 0.0)] {
            let found = speed_in_odometry(&mut translator, &pose, nanos);
            assert_eq!(found, speed_mps, "{nanos} ns");
        }
        let none = Message::Pose(PoseEstimate::NoPose {
            reason: NoPoseReason::TooFewInliers,
            inlier_count: 3,
        });
        assert_eq!(translator.translate(&topic(Stream::Pose), 300, &none), []);
    }

    #[test]
    fn a_lidar_has_one_parent_and_frames_are_in_the_namespace() {
        let placed = [CavId::new("1").unwrap()].into();
        let fleet = "/fleet".parse().unwrap();
        let names = FrameNames::within(Some(&fleet));
        let pose = Message::Pose(PoseEstimate::new(Pose::IDENTITY, 0.9));
        let mut translator = translator().with_frames(names, placed);
        let messages = translator.translate(&topic(Stream::Pose), 1, &pose);
        assert_eq!(topic_names(&messages), ["/cav_1/pose", "/cav_1/odometry"]);
        let frame = b"fleet/cav_1/lidar\0";
        assert!(
            messages[1]
                .cdr
                .windows(frame.len())
                .any(|bytes| bytes == frame)
        );
    }

    #[test]
    fn a_process_that_loses_messages_is_a_warning_once() {
        let mut translator = translator();
        let process = ProcessId::new("agent-1").unwrap();
        let mut stats = Stats {
            process: process.clone(),
            ledger: Ledger::default(),
            stages: Vec::new(),
            usage: ProcessUsage::default(),
            traffic: Vec::new(),
            problems: Vec::new(),
        };
        assert!(!translator.status(&stats).is_warning);
        stats.ledger.dropped(
            &Account::towards(topic(Stream::Lidar), &process),
            DropReason::Superseded,
        );
        let warnings = [(); 2].map(|()| translator.status(&stats).is_warning);
        assert_eq!(warnings, [true, false]);
        let message = Message::Stats(stats);
        let messages = translator.translate(&Topic::Stats(process), 0, &message);
        for text in ["v2vloc: agent-1\0", "dropped: superseded\0", "test\0"] {
            let mut windows = messages[0].cdr.windows(text.len());
            assert!(windows.any(|bytes| bytes == text.as_bytes()), "{text}");
        }
    }

    #[test]
    fn an_image_brings_the_place_and_the_projection_of_its_camera() {
        let metadata = CameraMetadata {
            format: ImageFormat::Png,
            width_px: 8,
            height_px: 4,
            pinhole: Some(Pinhole {
                fx_px: 4.0,
                fy_px: 5.0,
                cx_px: 6.0,
                cy_px: 7.0,
            }),
            lidar_from_camera: Some(Pose::IDENTITY),
        };
        let mut camera = Camera {
            metadata,
            image: vec![1, 2, 3],
        };
        assert_eq!(
            topics_of_image(&camera),
            [
                "/tf",
                "/cav_1/camera_2/camera_info",
                "/cav_1/camera_2/image/compressed"
            ]
        );
        (camera.metadata.pinhole, camera.metadata.lidar_from_camera) = (None, None);
        assert_eq!(
            topics_of_image(&camera),
            ["/cav_1/camera_2/image/compressed"]
        );
        assert!(Translator::wants(&topic(Stream::Camera(0))));
    }

    #[test]
    fn only_streams_that_ros_has_types_for_are_wanted() {
        assert!(Translator::wants(&topic(Stream::Lidar)) && Translator::wants(&Topic::Truth));
        assert!(Translator::wants(&topic(Stream::Tracks)));
        assert!(
            !Translator::wants(&topic(Stream::Bev))
                && !Translator::wants(&topic(Stream::DetectionsJson))
        );
    }
}
