//! JSON of DAIR-V2X and V2X-Seq: calibrations and labels.

use protocol::{Box3d, Pose};
use serde_json::{Value, json};

use super::boxes::{real_type, world_corners};
use dataset::frame::{Object, ObjectClass};

/// The type of an object as one side labels it; `None` where the data sets have none.
pub(super) fn side_type(class: ObjectClass) -> Option<&'static str> {
    match class {
        ObjectClass::TwoWheeler => Some("Cyclist"),
        ObjectClass::Other => None,
        _ => Some(real_type(class)),
    }
}

/// The type of an object as both sides together label it: vehicles alone.
pub(super) fn cooperative_type(class: ObjectClass) -> Option<&'static str> {
    let is_vehicle = ObjectClass::VEHICLES.contains(&class);
    is_vehicle.then(|| real_type(class))
}

/// Rotation as 3 rows and translation as 3 rows of one number.
pub(super) fn transform(pose: &Pose) -> Value {
    let rotation = pose.isometry().rotation.to_rotation_matrix();
    // Stored by columns.
    let rows = rotation.matrix().transpose().data.0;
    json!({ "rotation": rows, "translation": pose.translation_m.map(|metres| [metres]) })
}

/// The label of an upright box: its position is the centre, `rotation` turns it about z.
pub(super) fn upright_label(kind: &str, id: i64, upright: &Box3d) -> Value {
    let [length, width, height] = upright.size_m;
    let [x, y, z] = upright.center_m;
    json!({
        "type": kind,
        "track_id": id.to_string(),
        "occluded_state": 0,
        "truncated_state": 0,
        "2d_box": { "xmin": 0.0, "ymin": 0.0, "xmax": 0.0, "ymax": 0.0 },
        "3d_dimensions": { "h": height, "w": width, "l": length },
        "3d_location": { "x": x, "y": y, "z": z },
        "rotation": upright.heading_rad,
    })
}

/// The cooperative label of DAIR-V2X: readers use its corners in the world.
pub(super) fn world_label(kind: &str, object: &Object, upright_in_world: &Box3d) -> Value {
    let mut label = upright_label(kind, object.id, upright_in_world);
    label["world_8_points"] = json!(world_corners(object));
    label["system_error_offset"] = json!("");
    label
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_transform_has_rows() {
        let quarter = Pose::from_xyz_yaw([1.0, 2.0, 3.5], std::f64::consts::FRAC_PI_2);
        let json = transform(&quarter);
        assert_eq!(json["translation"], json!([[1.0], [2.0], [3.5]]));
        let rows: [[f64; 3]; 3] = serde_json::from_value(json["rotation"].clone()).unwrap();
        // The x axis of the source points along y of the target.
        assert!((rows[1][0] - 1.0).abs() < 1e-12 && (rows[0][1] + 1.0).abs() < 1e-12);
    }

    #[test]
    fn corners_are_those_of_the_box() {
        let object = Object {
            id: 7,
            class: ObjectClass::Bus,
            world_from_object: Pose::from_xyz_yaw([10.0, 20.0, 1.0], std::f64::consts::FRAC_PI_2),
            size_m: [4.0, 2.0, 1.0],
            speed_mps: None,
        };
        let upright = Box3d {
            center_m: [10.0, 20.0, 1.0],
            size_m: [4.0, 2.0, 1.0],
            heading_rad: 1.5,
        };
        let label = world_label("Bus", &object, &upright);
        let corners: [[f64; 3]; 8] =
            serde_json::from_value(label["world_8_points"].clone()).unwrap();
        // Front left of the bottom: the front is towards y, left towards -x.
        for (index, expected) in [
            (0, [9.0, 22.0, 0.5]),
            (1, [11.0, 22.0, 0.5]),
            (6, [11.0, 18.0, 1.5]),
        ] {
            let corner = corners[index];
            assert!(
                corner
                    .iter()
                    .zip(expected)
                    .all(|(a, b)| (a - b).abs() < 1e-12),
                "{corner:?}"
            );
        }
        assert_eq!(
            (
                label["3d_dimensions"]["l"].as_f64(),
                label["track_id"].as_str()
            ),
            (Some(4.0), Some("7"))
        );
    }
}
