//! Objects that a list holds twice: under one id, or one box under two.

use std::path::Path;

use nalgebra::Isometry3;

use super::{Problem, ReadError};
use crate::frame::Object;
use crate::ground_truth::upright_box;

/// Boxes whose corners are at most this far apart along each axis are the same, metres. Lists round to a millimetre or
/// so; no two objects stand as close.
const SAME_BOX_M: f64 = 0.01;

/// Leaves out the objects of a frame's list that repeat one before them, with a problem each.
pub(super) fn leave_out(path: &Path, objects: &mut Vec<Object>, problems: &mut Vec<Problem>) {
    let mut kept: Vec<(Object, [[f64; 3]; 8])> = Vec::with_capacity(objects.len());
    for object in objects.drain(..) {
        let corners = upright_box(&object, &Isometry3::identity()).corners();
        let mut before = kept.iter();
        let first =
            before.find(|(first, box3d)| first.id == object.id || are_same(box3d, &corners));
        let Some((first, _)) = first else {
            kept.push((object, corners));
            continue;
        };
        let [here, there] = [&object, first].map(|object| object.world_from_object.translation_m);
        let (field, first) = (format!("object {}", object.id), first.id);
        let reason =
            format!("at {here:.2?} m, with the id or the box of object {first} at {there:.2?} m");
        let fault = ReadError::malformed_at(path, None, Some(&field), reason);
        problems.push(Problem::left_out("object", fault));
    }
    *objects = kept.into_iter().map(|(object, _)| object).collect();
}

fn are_same(first: &[[f64; 3]; 8], second: &[[f64; 3]; 8]) -> bool {
    let mut pairs = first.as_flattened().iter().zip(second.as_flattened());
    pairs.all(|(a, b)| (a - b).abs() <= SAME_BOX_M)
}

#[cfg(test)]
mod tests {
    use protocol::Pose;

    use super::*;
    use crate::frame::ObjectClass;

    fn object(id: i64, x_m: f64, yaw_rad: f64) -> Object {
        let (sin, cos) = (yaw_rad / 2.0).sin_cos();
        let pose = Pose {
            translation_m: [x_m, 2.0, 1.0],
            rotation_wxyz: [cos, 0.0, 0.0, sin],
        };
        Object::new(id, ObjectClass::Car, pose, [4.0, 2.0, 1.5])
    }

    #[test]
    fn a_second_object_of_one_id_or_box_is_left_out_and_named() {
        let mut objects = vec![
            object(7, 0.0, 0.0),
            object(7, 20.0, 0.0),
            object(8, 0.004, 0.0),
            object(9, 20.0, 0.0),
        ];
        let mut problems = Vec::new();
        leave_out(Path::new("a.json"), &mut objects, &mut problems);
        let ids: Vec<i64> = objects.iter().map(|object| object.id).collect();
        assert_eq!(ids, [7, 9], "the first of each; 20 m is taken by none");
        let problems: Vec<String> = problems.iter().map(ToString::to_string).collect();
        assert_eq!(
            problems,
            [
                "a.json: object 7: at [20.00, 2.00, 1.00] m, with the id or the box of object 7 at [0.00, 2.00, 1.00] m: the object is left out",
                "a.json: object 8: at [0.00, 2.00, 1.00] m, with the id or the box of object 7 at [0.00, 2.00, 1.00] m: the object is left out",
            ]
        );
    }

    #[test]
    fn objects_close_to_each_other_are_two() {
        let mut objects = vec![
            object(1, 0.0, 0.0),
            object(2, 0.05, 0.0),
            object(3, 0.0, 0.02),
            object(4, 0.0, std::f64::consts::PI),
        ];
        let mut problems = Vec::new();
        leave_out(Path::new("a.json"), &mut objects, &mut problems);
        assert_eq!((objects.len(), problems.len()), (4, 0));
    }
}
