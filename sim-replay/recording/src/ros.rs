//! Conversion of messages to ROS 2: clouds, poses and boxes, for Foxglove, Rerun and RViz.
//!
//! Frames: `map` is the world, `<cav>/lidar` a LiDAR at the pose estimated by its vehicle, `<cav>/truth` at the true
//! one.

use protocol::{Box3d, CavId, Detection, Message, PointCloud, Pose, Stream, Topic};
use re_cdr::{CdrWriter, LittleEndian};

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

/// Encoding of ROS 2 messages: classic CDR.
type Cdr<'a> = CdrWriter<'a, LittleEndian>;
/// Encapsulation header: plain CDR, little-endian, no options.
const CDR_HEADER: [u8; 4] = [0, 1, 0, 0];

/// A message for ROS 2 tools.
#[derive(Debug, Clone)]
pub(super) struct RosMessage {
    /// Topic, for example `/4279/points`.
    pub(super) topic: String,
    pub(super) ros_type: RosType,
    /// The message in CDR.
    pub(super) cdr: Vec<u8>,
}

/// True if ROS 2 has a type for the messages of `topic`.
pub(super) fn has_type_for(topic: &Topic) -> bool {
    let streams = [Stream::Lidar, Stream::Pose, Stream::Detections];
    matches!(topic, Topic::Truth) || matches!(topic, Topic::Stream { stream, .. } if streams.contains(stream))
}

/// The ROS 2 messages for a message published on `topic`; empty if ROS has no type for it.
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
                    id: Some(marker_id(object.id)),
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

fn in_cdr(topic: String, ros_type: RosType, write: impl FnOnce(&mut Cdr<'_>)) -> RosMessage {
    let mut cdr = CDR_HEADER.to_vec();
    write(&mut CdrWriter::new(&mut cdr));
    RosMessage { topic, ros_type, cdr }
}

fn frame(cav: &CavId) -> String {
    format!("{cav}/lidar")
}

fn header(cdr: &mut Cdr<'_>, nanos: u64, frame_id: &str) {
    time(cdr, nanos);
    cdr.write_string(frame_id);
}

fn time(cdr: &mut Cdr<'_>, nanos: u64) {
    // Seconds beyond 2038 do not fit into the message.
    cdr.write_i32(i32::try_from(nanos / 1_000_000_000).unwrap_or(i32::MAX));
    cdr.write_u32((nanos % 1_000_000_000) as u32);
}

fn xyz(cdr: &mut Cdr<'_>, values: [f64; 3]) {
    values.into_iter().for_each(|value| cdr.write_f64(value));
}

fn pose(cdr: &mut Cdr<'_>, pose: &Pose) {
    let [w, x, y, z] = pose.rotation_wxyz;
    xyz(cdr, pose.translation_m);
    [x, y, z, w].into_iter().for_each(|value| cdr.write_f64(value));
}

fn point_cloud(topic: String, frame_id: &str, nanos: u64, cloud: &PointCloud) -> RosMessage {
    let count = u32::try_from(cloud.len()).unwrap_or(u32::MAX);
    in_cdr(topic, RosType::PointCloud2, |cdr| {
        cdr.buffer_mut().reserve(cloud.len() * POINT_STEP as usize + 256);
        header(cdr, nanos, frame_id);
        cdr.write_u32(1);
        cdr.write_u32(count);
        let fields = ["x", "y", "z", "intensity"];
        cdr.write_sequence_length(fields.len());
        for (offset, name) in (0..).step_by(4).zip(fields) {
            cdr.write_string(name);
            cdr.write_u32(offset);
            cdr.write_u8(FLOAT32);
            cdr.write_u32(1);
        }
        cdr.write_bool(false);
        cdr.write_u32(POINT_STEP);
        cdr.write_u32(count.saturating_mul(POINT_STEP));
        // All supported machines are little-endian, as the header states.
        cdr.write_bytes(bytemuck::cast_slice(&cloud.xyzi));
        cdr.write_bool(true);
    })
}

fn pose_stamped(topic: String, nanos: u64, world_from_cav: &Pose) -> RosMessage {
    in_cdr(topic, RosType::PoseStamped, |cdr| {
        header(cdr, nanos, MAP);
        pose(cdr, world_from_cav);
    })
}

fn transforms(nanos: u64, children: &[(String, Pose)]) -> RosMessage {
    in_cdr("/tf".into(), RosType::TfMessage, |cdr| {
        cdr.write_sequence_length(children.len());
        for (child, world_from_child) in children {
            header(cdr, nanos, MAP);
            cdr.write_string(child);
            pose(cdr, world_from_child);
        }
    })
}

/// A box with its marker's properties.
struct Marked {
    /// Id; `None`: its index in the list.
    id: Option<i32>,
    box3d: Box3d,
    alpha: f32,
    /// Class or score: viewers show it on selection.
    text: String,
}

/// All boxes of a capture time: the first marker deletes those of the previous one.
fn markers(topic: String, frame_id: &str, ns: &str, rgb: [f32; 3], nanos: u64, boxes: &[Marked]) -> RosMessage {
    let nothing = Box3d { center_m: [0.0; 3], size_m: [0.0; 3], heading_rad: 0.0 };
    let sweep = Marked { id: Some(0), box3d: nothing, alpha: 0.0, text: String::new() };
    in_cdr(topic, RosType::MarkerArray, |cdr| {
        cdr.write_sequence_length(boxes.len() + 1);
        marker(cdr, (frame_id, ns, nanos), (0, DELETE_ALL), rgb, &sweep);
        for (place, marked) in (0..).zip(boxes) {
            marker(cdr, (frame_id, ns, nanos), (marked.id.unwrap_or(place), ADD), rgb, marked);
        }
    })
}

fn marker(
    cdr: &mut Cdr<'_>,
    (frame_id, ns, nanos): (&str, &str, u64),
    (id, action): (i32, i32),
    rgb: [f32; 3],
    marked: &Marked,
) {
    let Marked { id: _, box3d, alpha, text } = marked;
    header(cdr, nanos, frame_id);
    cdr.write_string(ns);
    cdr.write_i32(id);
    cdr.write_i32(CUBE);
    cdr.write_i32(action);
    pose(cdr, &Pose::from_xyz_yaw(box3d.center_m, box3d.heading_rad));
    xyz(cdr, box3d.size_m);
    rgb.into_iter().chain([*alpha]).for_each(|value| cdr.write_f32(value));
    // Lifetime: until it is deleted.
    cdr.write_i32(0);
    cdr.write_u32(0);
    cdr.write_bool(false);
    cdr.write_sequence_length(0); // points
    cdr.write_sequence_length(0); // colours
    cdr.write_string(""); // texture
    header(cdr, 0, "");
    cdr.write_string("");
    cdr.write_sequence_length(0);
    cdr.write_sequence_length(0); // coordinates in it
    cdr.write_string(text);
    cdr.write_string(""); // mesh
    cdr.write_string("");
    cdr.write_sequence_length(0);
    cdr.write_bool(false);
}

/// ROS has 32 bits for it; larger ids are truncated, which affects viewers only.
#[expect(clippy::cast_possible_truncation, reason = "wanted")]
fn marker_id(id: i64) -> i32 {
    id as i32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_transform_is_laid_out_as_ros_lays_it_out() {
        let RosMessage { cdr, .. } =
            transforms(1_000_000_002, &[("ab".into(), Pose::from_xyz_yaw([1.0, 2.0, 3.0], 0.0))]);
        let mut expected = vec![0, 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0];
        expected.extend(b"\x04\0\0\0map\0\x03\0\0\0ab\0");
        // Numbers are aligned to multiples of their size, counted from the end of the header.
        expected.extend([0; 5]);
        expected.extend([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0].map(f64::to_le_bytes).as_flattened());
        assert_eq!(cdr, expected);
    }
}
