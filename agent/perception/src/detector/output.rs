//! Output of a detector.

use protocol::StageTiming;
use tch::Tensor;

use super::backbone_level::BackboneLevel;
use super::error::DetectorError;
use crate::boxes::decode::Decoded;
use crate::layers::head::HeadOutput;
use crate::tensor_values::values;

/// Output of the encoder for one sweep.
#[derive(Debug)]
pub struct EncoderOutput {
    /// `[1, C, H, W]` `f32`, contiguous, before the compressor if there is one:
    /// [`Detector::compressed`](super::Detector::compressed) gives the transmitted feature map.
    pub features: Tensor,
    /// Levels of the backbone, from fine to coarse.
    pub levels: Vec<BackboneLevel>,
    /// Number of points inside the area.
    pub points: usize,
    /// Number of pillars.
    pub pillars: usize,
    /// Durations of crop with sorting into pillars, pillar features, and 2D convolutions.
    pub times: Vec<StageTiming>,
}

/// Output of the head for a feature map.
#[derive(Debug, Clone, PartialEq)]
pub struct Heads {
    /// `[A, H, W]` logits.
    pub scores: Vec<f32>,
    /// `[7 A, H, W]` offsets.
    pub offsets: Vec<f32>,
    /// `[H, W]`, 0..1: confidence of a vehicle around each cell.
    pub confidence: Vec<f32>,
}

impl Heads {
    /// Copies the output for one feature map to plain values.
    ///
    /// # Errors
    /// [`DetectorError::Values`] for values that are not valid; those of the tensor library.
    pub fn new(output: &HeadOutput) -> Result<Self, DetectorError> {
        check_values("the output of the head (scores)", &output.scores)?;
        check_values("the output of the head (offsets of boxes)", &output.offsets)?;
        Ok(Self {
            scores: values(&output.scores)?,
            offsets: values(&output.offsets)?,
            confidence: values(&output.confidence())?,
        })
    }
}

/// Largest absolute value inside a network; trained ones stay below 1e4, and messages have a lower limit of their own.
const MAX_ABS_VALUE: f64 = 1e9;

/// Checks that all values of a tensor are finite and at most 1e9.
///
/// # Errors
/// [`DetectorError::Values`] with `what` and the value.
pub fn check_values(what: &'static str, tensor: &Tensor) -> Result<(), DetectorError> {
    let limit = MAX_ABS_VALUE;
    // Both are NaN for a tensor with NaN. In either memory order they are read without a copy.
    let axes: &[i64] = &[];
    let most = tensor.f_amax(axes, false)?.f_double_value(&[])?;
    let least = tensor.f_amin(axes, false)?.f_double_value(&[])?;
    let value = most.max(-least);
    match value <= limit {
        true => Ok(()),
        false => Err(DetectorError::Values { what, value, limit }),
    }
}

/// Farthest centre of a box along an axis, metres: beyond any area of a detector.
const MAX_CENTRE_M: f64 = 1e4;

/// Checks that messages accept decoded boxes, and that their centres are near the detector: other ones could not be
/// published, and would be left out without a word offline.
///
/// # Errors
/// [`DetectorError::Box`] or [`DetectorError::Values`] with the first value that is not valid.
pub(super) fn check_boxes(boxes: &[Decoded]) -> Result<(), DetectorError> {
    for Decoded { box3d, .. } in boxes {
        box3d.check().map_err(DetectorError::Box)?;
        let mut centre_m = box3d.center_m.into_iter();
        if let Some(value) = centre_m.find(|along_m| along_m.abs() > MAX_CENTRE_M) {
            let (what, limit) = ("a detected box (centre, metres)", MAX_CENTRE_M);
            return Err(DetectorError::Values { what, value, limit });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use protocol::Box3d;

    use super::*;

    fn decoded(center_m: [f64; 3], size_m: [f64; 3], heading_rad: f64) -> Decoded {
        Decoded {
            anchor: 0,
            score: 0.9,
            box3d: Box3d {
                center_m,
                size_m,
                heading_rad,
            },
        }
    }

    #[test]
    fn boxes_that_no_vehicle_has_are_an_error() {
        let bus = decoded([140.0, -39.0, -1.0], [18.0, 2.5, 3.0], 0.5);
        assert!(check_boxes(&[bus]).is_ok());
        for wrong in [
            decoded([1.0, 2.0, -1.0], [4.0, 11_000.0, 1.5], 0.5),
            decoded([1.0, 2.0, -1.0], [4.0, 1e-9, 1.5], 0.5),
            decoded([1.0, -3e5, -1.0], [4.0, 2.0, 1.5], 0.5),
            decoded([1.0, 2.0, -1.0], [4.0, 2.0, 1.5], -1e4),
        ] {
            let error = check_boxes(&[bus, wrong]).unwrap_err();
            assert!(error.is_of_frame(), "{error}");
            assert!(error.to_string().starts_with("a detected box"), "{error}");
        }
    }

    #[test]
    fn values_that_are_not_valid_are_stated_in_either_memory_order() {
        for wrong in [f64::NAN, f64::INFINITY, -2e9] {
            let map = Tensor::from_slice(&[1.0_f32; 24]).view([2, 3, 4]);
            assert!(check_values("a map", &map).is_ok());
            let _ = map.get(1).get(2).get(0).fill_(wrong);
            for map in [map.permute([1, 2, 0]), map] {
                let error = check_values("a map", &map).unwrap_err();
                let DetectorError::Values { value, .. } = error else {
                    panic!("{error}");
                };
                assert!(
                    value.is_nan() == wrong.is_nan() && (value.is_nan() || value == wrong.abs())
                );
            }
        }
    }
}
