//! Poses of the OPV2V family: six numbers, or a 4x4 matrix. The shape distinguishes OPV2V from V2V4Real, in any storage
//! of the numbers.

use nalgebra::{Matrix4, RowVector4};
use protocol::Pose;

use super::Result;
use super::yaml::YamlField;
use super::yaml::numpy_tags;
use crate::carla_pose::CarlaPose;

/// A pose in the numbers of its file.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum WrittenPose {
    /// x, y, z in metres and roll, yaw, pitch in degrees, as OPV2V.
    SixNumbers(CarlaPose),
    /// A transform, as V2V4Real.
    Matrix(Matrix4<f64>),
}

impl WrittenPose {
    /// Reads six numbers, sixteen, or four rows of four: lists, arrays, or lists of arrays.
    pub(super) fn read(field: &YamlField<'_>) -> Result<Self> {
        let (shape, values) = field.array()?;
        if let Some(number) = values.iter().find(|number| !number.is_finite()) {
            return Err(field.error(format!("{number}, expected finite numbers")));
        }
        // Axes of length 1 say nothing: (6, 1) and (1, 6) are six numbers.
        let sizes: Vec<usize> = shape.iter().copied().filter(|&size| size != 1).collect();
        match (&sizes[..], values.first_chunk::<6>()) {
            ([6], Some(numbers)) => (CarlaPose::from(*numbers).in_degrees())
                .map(Self::SixNumbers)
                .map_err(|reason| field.error(reason)),
            // Row by row in the file, while nalgebra stores columns.
            ([4, 4] | [16], _) => Ok(Self::Matrix(Matrix4::from_row_slice(&values))),
            _ if numpy_tags::is_call(field.node) => Err(field.error(format!(
                "an array of shape {shape:?}, expected 6 numbers or a 4x4 matrix"
            ))),
            _ => Err(field.expected("6 numbers or a 4x4 matrix")),
        }
    }
}

/// A rigid transform from a matrix of a file.
pub(super) fn rigid(matrix: &Matrix4<f64>, field: &YamlField<'_>) -> Result<Pose> {
    let mut matrix = *matrix;
    let last = RowVector4::new(0.0, 0.0, 0.0, 1.0);
    // Inverting and multiplying matrices leaves rounding errors in the last row.
    if (matrix.row(3) - last).amax() < 1e-8 {
        matrix.set_row(3, &last);
    }
    Pose::from_matrix(&matrix).map_err(|error| field.error(error.to_string()))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::super::yaml;
    use super::super::yaml::numpy_tags::tests::pickled_array;
    use super::*;

    fn read(text: &str) -> Result<WrittenPose> {
        let path = Path::new("0.yaml");
        let node = yaml::parse(path, text.as_bytes())?;
        WrittenPose::read(&YamlField::root(path, &node).required("pose")?)
    }

    const SIX: [f64; 6] = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];

    #[test]
    fn shape_decides_and_not_how_numbers_are_stored() {
        let six = WrittenPose::SixNumbers(CarlaPose::from(SIX));
        let values: Vec<f64> = (0..16).map(f64::from).collect();
        let matrix = WrittenPose::Matrix(Matrix4::from_row_slice(&values));
        let nested = values
            .chunks(4)
            .map(|row| format!("{row:?}"))
            .collect::<Vec<_>>()
            .join(", ");
        let rows: String = values
            .chunks(4)
            .map(|row| format!("- {}", pickled_array(&[4], row, "  ")))
            .collect();
        for (text, expected) in [
            (format!("pose: {SIX:?}\n"), six),
            (format!("pose: !!python/tuple {SIX:?}\n"), six),
            (format!("pose: {}", pickled_array(&[6], &SIX, "  ")), six),
            (format!("pose: {}", pickled_array(&[1, 6], &SIX, "  ")), six),
            (
                format!("pose: {}", pickled_array(&[4, 4], &values, "  ")),
                matrix,
            ),
            (
                format!("pose: {}", pickled_array(&[16], &values, "  ")),
                matrix,
            ),
            (format!("pose: [{nested}]\n"), matrix),
            (format!("pose: {values:?}\n"), matrix),
            (format!("pose:\n{rows}"), matrix),
        ] {
            assert_eq!(read(&text).unwrap(), expected, "{text}");
        }
    }

    #[test]
    fn other_shapes_are_named() {
        for (text, expected) in [
            (
                "pose: [1, 2, 3]\n".to_owned(),
                "0.yaml:1: pose: a list of 3, expected 6 numbers or a 4x4 matrix",
            ),
            (
                "pose: [[1, 2], [3]]\n".into(),
                "pose: rows of different lengths",
            ),
            (
                "pose: [1, 2, .inf, 4, 5, 6]\n".into(),
                "pose.2: inf, expected a finite number",
            ),
            (
                "pose: [1, 2, 3, 0, 3.6e15, 0]\n".into(),
                "pose: [0.0, 3600000000000000.0, 0.0], expected angles in degrees",
            ),
            (
                "pose: far\n".into(),
                "pose: the text \"far\", expected numbers",
            ),
            (
                format!("pose: {}", pickled_array(&[3], &SIX[..3], "  ")),
                "pose: an array of shape [3], expected 6",
            ),
            (
                format!("pose: {}", pickled_array(&[6], &[f64::NAN; 6], "  ")),
                "pose: NaN, expected finite numbers",
            ),
        ] {
            let message = read(&text).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }
}
