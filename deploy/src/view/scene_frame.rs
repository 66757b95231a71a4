//! Scene frame: the state of a run at one capture time, as sent to the page.

use std::collections::BTreeMap;

use protocol::{
    Box3d, CavId, DropReason, MisbehaviourReason, NoPoseReason, PointCloud, Pose, StageSummary,
    StageTiming,
};
use serde::Serialize;

use super::judgement::DetectionArea;
use super::pace_counter::ShownPace;

/// Largest number of points of one sweep on the page: more than a screen has pixels for them.
const MAX_POINTS: usize = 12_000;
/// Bytes of a point as sent to the page.
pub(super) const POINT_BYTES: usize = 6;

/// Scene frame: values for the panels, boxes and poses in the world frame, and the points of all vehicles.
///
/// Sent as a JSON document after its length (32 bits, little-endian), then the points.
#[derive(Debug, Clone, Default, Serialize)]
pub struct SceneFrame {
    /// Capture time on the scene's clock, seconds.
    pub capture_s: f64,
    /// Tick of the scene, from the truth.
    pub tick: Option<u64>,
    /// The fusing vehicle; `None` at a tick without a result of the ego that is shown.
    pub ego: Option<CavId>,
    /// All vehicles that fuse.
    pub egos: Vec<CavId>,
    /// Fusion method.
    pub method: Option<String>,
    /// From the publication of the tick to that of its detections, milliseconds.
    pub latency_ms: Option<f64>,
    /// From the publication of the tick to the arrival of its sweep at the ego's agent, milliseconds; known only in
    /// recorded runs.
    pub swept_ms: Option<f64>,
    /// From the publication of the tick to that of the ego's pose, milliseconds.
    pub posed_ms: Option<f64>,
    /// Every vehicle from which a message was captured.
    pub vehicles: Vec<ShownVehicle>,
    /// True objects, each once.
    pub truth: Vec<ShownBox>,
    /// Detections of the ego, placed by its estimated pose.
    pub detections: Vec<ShownBox>,
    /// Detections that single vehicles send (late fusion).
    pub single: Vec<ShownBox>,
    /// Tracks of the ego, placed by its estimated pose.
    pub tracks: Vec<ShownTrack>,
    /// Traffic of each link.
    pub links: Vec<Link>,
    /// Durations of the ego's stages.
    pub stages: Vec<StageTiming>,
    /// Answered ticks and rate: live until this frame, recorded of the whole run.
    pub pace: ShownPace,
    /// Rectangle in which the ego detects, if its descriptor is known.
    pub area: Option<DetectionArea>,
    /// Average precision at an IoU of 0.5 of the frames until this one: live of those shown, recorded of the whole run.
    pub ap_50: Option<f64>,
    /// Name of the evaluation protocol whose objects count.
    pub protocol: String,
    /// Durations of the stages of each process.
    pub processes: Vec<Process>,
    /// Messages of all processes so far, by topic and receiver.
    pub messages: Vec<MessageCounts>,
    /// Points after the JSON document, in order of `vehicles`; three 16-bit numbers each, centimetres.
    #[serde(skip)]
    pub points: Vec<u8>,
}

/// A vehicle in a scene frame.
#[derive(Debug, Clone, Serialize)]
pub struct ShownVehicle {
    /// Id of the vehicle.
    pub cav: CavId,
    /// Estimated pose.
    pub pose: Option<Planar>,
    /// Confidence of that pose, 0..=1.
    pub confidence: Option<f32>,
    /// Covariance of the position: xx, xy, yy, square metres, if the pose source gives one.
    pub covariance_m2: Option<[f32; 3]>,
    /// Reason for a missing pose.
    pub no_pose: Option<NoPoseReason>,
    /// True pose.
    pub truth: Option<Planar>,
    /// Distance between the two, metres.
    pub error_m: Option<f64>,
    /// The first two rows of the transform of its points.
    pub world_from_lidar: Option<Vec<f64>>,
    /// Number of its points that follow.
    pub points: usize,
}

/// A pose seen from above.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Planar {
    /// x in the world frame, metres.
    pub x_m: f64,
    /// y in the world frame, metres.
    pub y_m: f64,
    /// Heading, radians.
    pub yaw_rad: f64,
}

/// A box in the world frame.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct ShownBox {
    /// Its rectangle.
    #[serde(flatten)]
    pub box3d: Box3d,
    /// Confidence of a detection, 0..1.
    pub score: Option<f32>,
    /// Vehicle that sent the detection, for those of single vehicles.
    pub source: Option<CavId>,
    /// Class of a true object.
    pub class: Option<String>,
    /// Id of a true object.
    pub id: Option<i64>,
    /// Speed of a true object, metres per second, if recorded.
    pub speed_mps: Option<f64>,
    /// True for a true object that the ego is expected to find.
    pub is_counted: bool,
    /// Score of the detection that found a true object.
    pub found_score: Option<f32>,
    /// True if a detection is a true positive; `None` if that is not known, or if it counts neither way.
    pub is_hit: Option<bool>,
}

/// A track in the world frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ShownTrack {
    /// Its identity.
    pub id: u64,
    /// Its places in the last seconds, x, y in metres, the newest last.
    pub trail_m: Vec<[f64; 2]>,
    /// Speed over ground, metres per second.
    pub speed_mps: f64,
    /// True if it is detected in this frame, false if its place is predicted.
    pub is_seen: bool,
}

/// Traffic from one vehicle to an ego for one frame.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Link {
    /// Id of the sender.
    pub from: String,
    /// Id of the receiver.
    pub to: String,
    /// From publication to arrival, milliseconds, of the captured message.
    pub latency_ms: Option<f64>,
    /// Stream of that message.
    pub stream: Option<String>,
    /// Wire bytes of the fused messages.
    pub wire_bytes: Option<u64>,
    /// Age relative to the ego's sweep, milliseconds.
    pub age_ms: Option<f64>,
    /// True if it was fused.
    pub is_fused: bool,
    /// Reason for which it was not.
    pub skipped: Option<DropReason>,
    /// Trust score of the sender, 0..=1, if the receiver uses misbehaviour detection.
    pub trust: Option<f64>,
    /// Misbehaviour reason, if the sender was excluded.
    pub misbehaviour: Option<MisbehaviourReason>,
    /// Offset of the sender's clock from the receiver's, less the shortest transmission time, milliseconds.
    pub clock_ms: Option<f64>,
    /// Offset of the sender's capture times from the receiver's that the receiver corrects, milliseconds.
    pub capture_ms: Option<f64>,
}

/// The stages of a process.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Process {
    /// Name of the process.
    pub process: String,
    /// Its stages.
    pub stages: Vec<StageSummary>,
}

/// Counters of one topic towards one receiver, or at its sender.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct MessageCounts {
    /// The topic.
    pub topic: String,
    /// The receiving process; `None`: counted by the sender.
    pub to: Option<String>,
    /// Published.
    pub sent: u64,
    /// Used.
    pub received: u64,
    /// Lost, by reason.
    pub dropped: BTreeMap<DropReason, u64>,
}

impl SceneFrame {
    /// The frame as sent to the page.
    ///
    /// # Panics
    /// Never: every field has a spelling in JSON.
    pub fn to_bytes(&self) -> Vec<u8> {
        let json = serde_json::to_vec(self).expect("plain structs, texts and numbers");
        let length = (json.len() as u32).to_le_bytes();
        [&length, json.as_slice(), &self.points].concat()
    }
}

impl Planar {
    pub(super) fn of(pose: &Pose) -> Self {
        Self {
            x_m: pose.translation_m[0],
            y_m: pose.translation_m[1],
            yaw_rad: pose.yaw_rad(),
        }
    }
}

/// The points of a sweep as sent to the page, evenly decimated if there are many.
pub(super) fn decimate(points: &PointCloud) -> Vec<u8> {
    let decimated = points.decimate(MAX_POINTS);
    let coordinates = decimated.xyzi.iter().flat_map(|[x, y, z, _]| [*x, *y, *z]);
    // The cast saturates: beyond 327.67 m a coordinate stays at that limit.
    let bytes = coordinates.flat_map(|metres| ((metres * 100.0).round() as i16).to_le_bytes());
    bytes.collect()
}
