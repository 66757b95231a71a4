//! One moment of a run as the page gets it.

use std::collections::BTreeMap;

use protocol::{
    Box3d, CavId, DropReason, MisbehaviourReason, NoPoseReason, PointCloud, Pose, StageSummary, StageTiming,
};
use serde::{Serialize, Serializer};

/// Points of one sweep that the page is given at most: more than a screen has pixels for them.
const MAX_POINTS: usize = 12_000;
/// Bytes of a point on its way to the page.
pub(super) const POINT_BYTES: usize = 6;

/// One moment: numbers for the panels, boxes and poses in the world's frame, and everyone's points.
///
/// On its way it is a JSON document behind its length (32 bits, little-endian), then the points.
#[derive(Debug, Clone, Default, Serialize)]
pub struct SceneFrame {
    /// Capture time on the scene's clock, seconds.
    pub capture_s: f64,
    /// Tick of the scene, where the truth says so.
    pub tick: Option<u64>,
    /// The fusing vehicle.
    pub ego: Option<CavId>,
    /// Fusion method.
    pub method: Option<String>,
    /// From the publication of the tick to that of its detections, milliseconds.
    pub latency_ms: Option<f64>,
    /// From the publication of the tick until its sweep had reached the ego's agent, milliseconds; known only afterwards.
    pub swept_ms: Option<f64>,
    /// From the publication of the tick until the ego's agent said where it is, milliseconds.
    pub posed_ms: Option<f64>,
    /// Every vehicle that was heard of.
    pub vehicles: Vec<Vehicle>,
    /// What is there, every object once.
    pub truth: Vec<ShownBox>,
    /// What the ego detects, where it believes to be.
    pub detections: Vec<ShownBox>,
    /// What single vehicles detect and send, where they do (late fusion).
    pub single: Vec<ShownBox>,
    /// What crosses the air.
    pub links: Vec<Link>,
    /// What the ego spent its time with.
    pub stages: Vec<StageTiming>,
    /// How long the stages of each process take.
    pub processes: Vec<Process>,
    /// Messages of all processes so far, by topic and receiver.
    pub messages: Vec<Messages>,
    /// Bytes of points behind the JSON document, in order of `vehicles`; three 16-bit numbers each, centimetres.
    #[serde(skip)]
    pub points: Vec<u8>,
}

/// A vehicle at this moment.
#[derive(Debug, Clone, Serialize)]
pub struct Vehicle {
    /// Who.
    pub cav: CavId,
    /// Where it believes to be.
    pub pose: Option<Planar>,
    /// How sure it is of that, 0..=1.
    pub confidence: Option<f32>,
    /// Why it has no pose.
    pub no_pose: Option<NoPoseReason>,
    /// Where it is.
    pub truth: Option<Planar>,
    /// Distance between the two, metres.
    pub error_m: Option<f64>,
    /// By which its points are shown; the page gets the first two rows of it.
    #[serde(serialize_with = "first_two_rows")]
    pub world_from_lidar: Option<Pose>,
    /// How many points of it follow.
    pub points: usize,
}

/// A pose seen from above.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Planar {
    /// Metres.
    pub x_m: f64,
    /// Metres.
    pub y_m: f64,
    /// Radians.
    pub yaw_rad: f64,
}

/// A box in the world's frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ShownBox {
    /// Where.
    #[serde(flatten)]
    pub box3d: Box3d,
    /// Confidence of a detection, 0..1.
    pub score: Option<f32>,
    /// Whose detection it is, where one vehicle alone saw it.
    pub source: Option<CavId>,
    /// Class of a true object.
    pub class: Option<String>,
}

/// What came from one vehicle to an ego for this moment.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Link {
    /// Who sent.
    pub from: String,
    /// Who received.
    pub to: String,
    /// From publication to arrival, milliseconds, of what was seen here.
    pub latency_ms: Option<f64>,
    /// Of which stream that is.
    pub stream: Option<String>,
    /// Bytes on the wire that were fused.
    pub wire_bytes: Option<u64>,
    /// How much older than the ego's sweep it was, milliseconds.
    pub age_ms: Option<f64>,
    /// Whether it was fused.
    pub is_fused: bool,
    /// Why it was not.
    pub skipped: Option<DropReason>,
    /// How likely the receiver thinks the sender honest, 0..=1, where it asks.
    pub trust: Option<f64>,
    /// Why it does not believe it.
    pub doubt: Option<MisbehaviourReason>,
    /// The sender's clock less the receiver's, less the shortest time a message was under way, milliseconds.
    pub clock_ms: Option<f64>,
}

/// The stages of a process.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Process {
    /// Its name.
    pub process: String,
    /// Its stages.
    pub stages: Vec<StageSummary>,
}

/// What was counted on one topic towards one receiver, or by its sender.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Messages {
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
    /// Every vehicle with its points, metres in the frame of its LiDAR.
    pub fn clouds(&self) -> impl Iterator<Item = (&Vehicle, Vec<[f32; 3]>)> {
        let mut rest = self.points.as_slice();
        self.vehicles.iter().map(move |vehicle| {
            let (points, behind) = rest.split_at((vehicle.points * POINT_BYTES).min(rest.len()));
            rest = behind;
            let metres = |bytes: &[u8]| f32::from(i16::from_le_bytes([bytes[0], bytes[1]])) / 100.0;
            let point = |bytes: &[u8]| [metres(&bytes[..2]), metres(&bytes[2..4]), metres(&bytes[4..])];
            (vehicle, points.chunks_exact(POINT_BYTES).map(point).collect())
        })
    }

    /// The frame as the page gets it.
    ///
    /// # Panics
    /// Never: every field has a spelling in JSON.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        let json = serde_json::to_vec(self).expect("plain structs, texts and numbers");
        let mut bytes = (json.len() as u32).to_le_bytes().to_vec();
        bytes.extend(json);
        bytes.extend(&self.points);
        bytes
    }
}

impl Planar {
    pub(super) fn of(pose: &Pose) -> Self {
        Self { x_m: pose.translation_m[0], y_m: pose.translation_m[1], yaw_rad: pose.yaw_rad() }
    }
}

fn first_two_rows<S: Serializer>(pose: &Option<Pose>, serializer: S) -> Result<S::Ok, S::Error> {
    let rows = |pose: &Pose| {
        let rotation = pose.isometry().rotation.to_rotation_matrix();
        let row = |index: usize| {
            [rotation[(index, 0)], rotation[(index, 1)], rotation[(index, 2)], pose.translation_m[index]]
        };
        let ([a, b, c, d], [e, f, g, h]) = (row(0), row(1));
        [a, b, c, d, e, f, g, h]
    };
    pose.as_ref().map(rows).serialize(serializer)
}

/// The points of a sweep as the page gets them, evenly decimate out where there are many.
pub(super) fn decimate(points: &PointCloud) -> Vec<u8> {
    let centimetres = |metres: f32| ((metres * 100.0).round() as i16).to_le_bytes();
    let decimate = points.decimate(MAX_POINTS);
    decimate.xyzi.iter().flat_map(|[x, y, z, _]| [*x, *y, *z].map(centimetres)).flatten().collect()
}
