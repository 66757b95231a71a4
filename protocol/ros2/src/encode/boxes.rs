//! Boxes: `vision_msgs/Detection3DArray` for programs, `visualization_msgs/MarkerArray` for viewers.

use protocol::{Box3d, Detection, Pose, Track, TrueObject};

use super::motion::pose_covariance;
use crate::cdr;
use crate::cdr::Cdr;

/// `visualization_msgs/Marker::CUBE`.
const CUBE: i32 = 1;
/// `visualization_msgs/Marker::ADD` and `DELETEALL`.
const ADD: i32 = 0;
const DELETE_ALL: i32 = 3;
/// The one class of the detectors.
const CLASS: &str = "vehicle";

/// Detections in the frame `frame_id`. The id of a detection is the vehicle that alone made it, if one did.
pub(crate) fn detections(nanos: u64, frame_id: &str, detections: &[Detection]) -> Vec<u8> {
    let found = detections.iter().map(|detection| {
        let source = detection.source.as_ref().map(ToString::to_string);
        // The covariance is not known: zeros, as other detectors write.
        let (score, covariance) = (f64::from(detection.score), [[0.0; 6]; 6]);
        let id = source.unwrap_or_default();
        (detection.box3d, score, covariance, id)
    });
    array(nanos, frame_id, found)
}

/// Tracks in the frame `frame_id`, each with its identity and the covariance of its place. The type has no velocity.
pub(crate) fn tracks(nanos: u64, frame_id: &str, tracks: &[Track]) -> Vec<u8> {
    let found = tracks.iter().map(|track| {
        // A track has a covariance of x and y only.
        let mut covariance = pose_covariance(None);
        let [[xx, xy, ..], [_, yy, ..], ..] = track.covariance.map(|row| row.map(f64::from));
        (covariance[0][0], covariance[0][1]) = (xx, xy);
        (covariance[1][0], covariance[1][1]) = (xy, yy);
        (track.box3d, track.score, covariance, track.id.to_string())
    });
    array(nanos, frame_id, found)
}

/// Box, score, covariance of its pose, id.
type Found = (Box3d, f64, [[f64; 6]; 6], String);

fn array(nanos: u64, frame_id: &str, found: impl ExactSizeIterator<Item = Found>) -> Vec<u8> {
    cdr::message(|cdr| {
        cdr::header(cdr, nanos, frame_id);
        cdr.write_sequence_length(found.len());
        for (box3d, score, covariance, id) in found {
            let pose = Pose::from_xyz_yaw(box3d.center_m, box3d.heading_rad);
            cdr::header(cdr, nanos, frame_id);
            // One hypothesis with its pose, then the box, whose centre is the same pose.
            cdr.write_sequence_length(1);
            cdr.write_string(CLASS);
            cdr.write_f64(score);
            cdr::pose(cdr, &pose);
            cdr::f64s(cdr, covariance.as_flattened());
            cdr::pose(cdr, &pose);
            cdr::f64s(cdr, &box3d.size_m);
            cdr.write_string(&id);
        }
    })
}

/// A box with its marker's properties.
#[derive(Default)]
pub(crate) struct Marked {
    /// Id; `None`: its index in the list.
    pub(crate) id: Option<i32>,
    pub(crate) box3d: Box3d,
    pub(crate) alpha: f32,
    /// Class or score: viewers show it on selection.
    pub(crate) text: String,
}

impl From<&Detection> for Marked {
    fn from(detection: &Detection) -> Self {
        Self {
            id: None,
            box3d: detection.box3d,
            alpha: 0.25 + 0.6 * detection.score,
            text: detection.score.to_string(),
        }
    }
}

impl From<&Track> for Marked {
    #[expect(clippy::cast_possible_truncation, reason = "wanted")]
    fn from(track: &Track) -> Self {
        let [x, y] = track.velocity_mps;
        Self {
            id: Some(marker_id(track.id.cast_signed())),
            box3d: track.box3d,
            alpha: 0.25 + 0.6 * track.score as f32,
            text: format!("{}: {:.1} m/s", track.id, x.hypot(y)),
        }
    }
}

/// An object of the ground truth.
pub(crate) fn truth_marker(object: &TrueObject) -> Marked {
    Marked {
        id: Some(marker_id(object.id)),
        box3d: object.box3d(),
        alpha: 0.35,
        text: object.class.clone(),
    }
}

/// ROS has 32 bits for it; larger ids are truncated, which affects viewers only.
#[expect(clippy::cast_possible_truncation, reason = "wanted")]
fn marker_id(id: i64) -> i32 {
    id as i32
}

/// All boxes of a capture time: the first marker deletes those of the previous one.
pub(crate) fn markers(
    nanos: u64,
    frame_id: &str,
    ns: &str,
    rgb: [f32; 3],
    boxes: &[Marked],
) -> Vec<u8> {
    let sweep = Marked::default();
    cdr::message(|cdr| {
        cdr.write_sequence_length(boxes.len() + 1);
        marker(cdr, (frame_id, ns, nanos), (0, DELETE_ALL), rgb, &sweep);
        for (place, marked) in (0..).zip(boxes) {
            // A marker replaces one of the same namespace and id: without an id its place serves.
            let id = marked.id.unwrap_or(place);
            marker(cdr, (frame_id, ns, nanos), (id, ADD), rgb, marked);
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
    let box3d = marked.box3d;
    cdr::header(cdr, nanos, frame_id);
    cdr.write_string(ns);
    cdr.write_i32(id);
    cdr.write_i32(CUBE);
    cdr.write_i32(action);
    cdr::pose(cdr, &Pose::from_xyz_yaw(box3d.center_m, box3d.heading_rad));
    cdr::f64s(cdr, &box3d.size_m);
    rgb.into_iter()
        .chain([marked.alpha])
        .for_each(|value| cdr.write_f32(value));
    // Lifetime: until it is deleted.
    cdr.write_i32(0);
    cdr.write_u32(0);
    cdr.write_bool(false);
    cdr.write_sequence_length(0); // points
    cdr.write_sequence_length(0); // colours
    cdr.write_string(""); // texture
    // Texture: an empty `sensor_msgs/CompressedImage`.
    cdr::header(cdr, 0, "");
    cdr.write_string("");
    cdr.write_sequence_length(0);
    cdr.write_sequence_length(0); // coordinates in it
    cdr.write_string(&marked.text);
    cdr.write_string(""); // mesh
    cdr.write_string("");
    cdr.write_sequence_length(0);
    cdr.write_bool(false);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn f64_bytes(values: &[f64]) -> Vec<u8> {
        values
            .iter()
            .flat_map(|value| value.to_le_bytes())
            .collect()
    }

    #[test]
    fn a_track_has_its_identity_and_the_covariance_of_its_place() {
        let box3d = Box3d {
            center_m: [1.0, 2.0, 3.0],
            size_m: [4.0, 5.0, 6.0],
            heading_rad: 0.0,
        };
        let mut covariance = [[0.0; 4]; 4];
        (covariance[0][0], covariance[0][1]) = (0.5, 0.25);
        (covariance[1][0], covariance[1][1]) = (0.25, 1.0);
        let track = Track {
            id: 417,
            box3d,
            velocity_mps: [3.0, 4.0],
            covariance,
            score: 0.75,
            hits: 3,
            age_s: 0.2,
            unseen_s: 0.0,
        };
        let cdr = tracks(7, "f", std::slice::from_ref(&track));
        for bytes in [
            b"\x04\0\0\x00417\0".to_vec(),
            f64_bytes(&[0.5, 0.25]),
            f64_bytes(&[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1e6]),
            f64_bytes(&[0.75]),
        ] {
            assert!(
                cdr.windows(bytes.len()).any(|window| window == bytes),
                "{bytes:?}"
            );
        }
        let marked = Marked::from(&track);
        assert_eq!(
            (marked.id, marked.text.as_str()),
            (Some(417), "417: 5.0 m/s")
        );
    }

    #[test]
    fn a_detection_is_laid_out_as_vision_msgs_lays_it_out() {
        let box3d = Box3d {
            center_m: [1.0, 2.0, 3.0],
            size_m: [4.0, 5.0, 6.0],
            heading_rad: 0.0,
        };
        let cdr = detections(
            7_000_000_008,
            "f",
            &[Detection {
                box3d,
                score: 0.5,
                source: None,
            }],
        );
        let header = b"\x07\0\0\0\x08\0\0\0\x02\0\0\0f\0";
        let mut expected = vec![0, 1, 0, 0];
        expected.extend(header);
        expected.extend([0, 0, 1, 0, 0, 0]);
        expected.extend(header);
        expected.extend([0, 0, 1, 0, 0, 0]);
        expected.extend(b"\x08\0\0\0vehicle\0");
        // Aligned to 8, counted from the end of the encapsulation header.
        expected.extend([0; 4]);
        expected.extend(f64_bytes(&[0.5, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]));
        expected.extend([0; 36 * 8]);
        expected.extend(f64_bytes(&[
            1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0, 4.0, 5.0, 6.0,
        ]));
        expected.extend(b"\x01\0\0\0\0");
        assert_eq!(cdr, expected);
    }
}
