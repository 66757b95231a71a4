//! Our messages as ROS 2 has them: clouds, poses and boxes, for Foxglove, Rerun and RViz.
//!
//! Frames: `map` is the world, `<cav>/lidar` a LiDAR at the pose that its vehicle believes in, `<cav>/truth` at the true one.

use protocol::{Box3d, CavId, Detection, Message, PointCloud, Pose, Stream, Topic};

use super::CdrWriter;
use super::ros_schema::RosType;

/// The world's frame.
const MAP: &str = "map";
/// Bytes of a point: x, y, z, intensity.
const POINT_STEP: u32 = 16;
/// `sensor_msgs/PointField::FLOAT32`.
const FLOAT32: u8 = 7;
/// `visualization_msgs/Marker::CUBE`.
const CUBE: i32 = 1;
/// `visualization_msgs/Marker::ADD` and `DELETEALL`.
const ADD: i32 = 0;
const DELETE_ALL: i32 = 3;

const DETECTION_RGB: [f32; 3] = [1.0, 0.37, 0.30];
const TRUTH_RGB: [f32; 3] = [0.25, 0.81, 0.47];

/// A message for ROS 2 tools.
#[derive(Debug, Clone)]
pub struct RosMessage {
    /// Topic, for example `/4279/points`.
    pub topic: String,
    pub(super) ros_type: RosType,
    /// The message in CDR.
    pub cdr: Vec<u8>,
}

/// Whether ROS 2 has a word for what is published on `topic`.
pub(super) fn has_word_for(topic: &Topic) -> bool {
    let streams = [Stream::Lidar, Stream::Pose, Stream::Detections];
    matches!(topic, Topic::Truth) || matches!(topic, Topic::Stream { stream, .. } if streams.contains(stream))
}

/// What ROS 2 tools can be told of a message that was published on `topic`; nothing where ROS has no word for it.
pub(super) fn translate(topic: &Topic, capture_nanos: u64, message: &Message) -> Vec<RosMessage> {
    let at = capture_nanos;
    match (topic, message) {
        (Topic::Stream { cav, stream: Stream::Lidar }, Message::Lidar(lidar)) => {
            vec![point_cloud(format!("/{cav}/points"), &frame(cav), at, &lidar.points)]
        }
        (Topic::Stream { cav, stream: Stream::Pose }, Message::Pose(estimate)) => {
            let Some(pose) = estimate.world_from_cav() else { return Vec::new() };
            vec![pose_stamped(format!("/{cav}/pose"), at, pose), transforms(at, &[(frame(cav), *pose)])]
        }
        (Topic::Stream { cav, stream: Stream::Detections }, Message::Detections(result)) => {
            let mark = |detection: &Detection| Marked {
                id: None,
                box3d: detection.box3d,
                alpha: 0.25 + 0.6 * detection.score,
                text: detection.score.to_string(),
            };
            let boxes: Vec<_> = result.detections.iter().map(mark).collect();
            vec![markers(format!("/{cav}/detections"), &frame(cav), "detections", DETECTION_RGB, at, &boxes)]
        }
        (Topic::Truth, Message::Truth(truth)) => {
            let mut seen = std::collections::BTreeSet::new();
            let objects = truth.agents.iter().flat_map(|agent| &agent.objects).filter(|object| seen.insert(object.id));
            let boxes: Vec<_> = objects
                .map(|object| Marked {
                    // ROS has 32 bits for it; ids beyond them are shortened, which only a viewer sees.
                    id: Some(object.id as i32),
                    box3d: Box3d {
                        center_m: object.world_from_object.translation_m,
                        size_m: object.size_m,
                        heading_rad: object.world_from_object.yaw_rad(),
                    },
                    alpha: 0.35,
                    text: object.class.clone(),
                })
                .collect();
            let poses: Vec<_> =
                truth.agents.iter().map(|agent| (format!("{}/truth", agent.cav), agent.world_from_lidar)).collect();
            vec![markers("/truth".into(), MAP, "truth", TRUTH_RGB, at, &boxes), transforms(at, &poses)]
        }
        _ => Vec::new(),
    }
}

fn frame(cav: &CavId) -> String {
    format!("{cav}/lidar")
}

fn header(cdr: &mut CdrWriter, nanos: u64, frame_id: &str) {
    time(cdr, nanos);
    cdr.string(frame_id);
}

fn time(cdr: &mut CdrWriter, nanos: u64) {
    // Seconds beyond 2038 do not fit into the message.
    cdr.i32(i32::try_from(nanos / 1_000_000_000).unwrap_or(i32::MAX));
    cdr.u32((nanos % 1_000_000_000) as u32);
}

fn xyz(cdr: &mut CdrWriter, values: [f64; 3]) {
    values.into_iter().for_each(|value| cdr.f64(value));
}

fn pose(cdr: &mut CdrWriter, pose: &Pose) {
    let [w, x, y, z] = pose.rotation_wxyz;
    xyz(cdr, pose.translation_m);
    [x, y, z, w].into_iter().for_each(|value| cdr.f64(value));
}

fn point_cloud(topic: String, frame_id: &str, nanos: u64, cloud: &PointCloud) -> RosMessage {
    let count = u32::try_from(cloud.len()).unwrap_or(u32::MAX);
    let mut cdr = CdrWriter::with_capacity(cloud.len() * POINT_STEP as usize + 256);
    header(&mut cdr, nanos, frame_id);
    cdr.u32(1);
    cdr.u32(count);
    let fields = ["x", "y", "z", "intensity"];
    cdr.len(fields.len());
    for (offset, name) in (0..).step_by(4).zip(fields) {
        cdr.string(name);
        cdr.u32(offset);
        cdr.u8(FLOAT32);
        cdr.u32(1);
    }
    cdr.bool(false);
    cdr.u32(POINT_STEP);
    cdr.u32(count.saturating_mul(POINT_STEP));
    // All machines this builds for are little-endian, as the header says.
    cdr.bytes(bytemuck::cast_slice(&cloud.xyzi));
    cdr.bool(true);
    RosMessage { topic, ros_type: RosType::PointCloud2, cdr: cdr.finish() }
}

fn pose_stamped(topic: String, nanos: u64, world_from_cav: &Pose) -> RosMessage {
    let mut cdr = CdrWriter::default();
    header(&mut cdr, nanos, MAP);
    pose(&mut cdr, world_from_cav);
    RosMessage { topic, ros_type: RosType::PoseStamped, cdr: cdr.finish() }
}

fn transforms(nanos: u64, children: &[(String, Pose)]) -> RosMessage {
    let mut cdr = CdrWriter::default();
    cdr.len(children.len());
    for (child, world_from_child) in children {
        header(&mut cdr, nanos, MAP);
        cdr.string(child);
        pose(&mut cdr, world_from_child);
    }
    RosMessage { topic: "/tf".into(), ros_type: RosType::TfMessage, cdr: cdr.finish() }
}

/// A box and how to show it.
struct Marked {
    /// `None`: its place in the list.
    id: Option<i32>,
    box3d: Box3d,
    alpha: f32,
    /// Class or score: viewers show it on selection.
    text: String,
}

/// All boxes of a moment: first a marker that takes away those of the moment before.
fn markers(topic: String, frame_id: &str, ns: &str, rgb: [f32; 3], nanos: u64, boxes: &[Marked]) -> RosMessage {
    let mut cdr = CdrWriter::with_capacity(256 * (boxes.len() + 1));
    cdr.len(boxes.len() + 1);
    let nothing = Box3d { center_m: [0.0; 3], size_m: [0.0; 3], heading_rad: 0.0 };
    let sweep = Marked { id: Some(0), box3d: nothing, alpha: 0.0, text: String::new() };
    marker(&mut cdr, (frame_id, ns, nanos), (0, DELETE_ALL), rgb, &sweep);
    for (place, marked) in (0..).zip(boxes) {
        marker(&mut cdr, (frame_id, ns, nanos), (marked.id.unwrap_or(place), ADD), rgb, marked);
    }
    RosMessage { topic, ros_type: RosType::MarkerArray, cdr: cdr.finish() }
}

fn marker(
    cdr: &mut CdrWriter,
    (frame_id, ns, nanos): (&str, &str, u64),
    (id, action): (i32, i32),
    rgb: [f32; 3],
    marked: &Marked,
) {
    let Marked { id: _, box3d, alpha, text } = marked;
    header(cdr, nanos, frame_id);
    cdr.string(ns);
    cdr.i32(id);
    cdr.i32(CUBE);
    cdr.i32(action);
    pose(cdr, &Pose::from_xyz_yaw(box3d.center_m, box3d.heading_rad));
    xyz(cdr, box3d.size_m);
    rgb.into_iter().chain([*alpha]).for_each(|value| cdr.f32(value));
    // Lifetime: until it is taken away.
    cdr.i32(0);
    cdr.u32(0);
    cdr.bool(false);
    cdr.len(0); // points
    cdr.len(0); // colours
    cdr.string(""); // texture
    header(cdr, 0, "");
    cdr.string("");
    cdr.len(0);
    cdr.len(0); // coordinates in it
    cdr.string(text);
    cdr.string(""); // mesh
    cdr.string("");
    cdr.len(0);
    cdr.bool(false);
}
