//! Decoding of boxes from the output of the head.

use protocol::Box3d;

use crate::boxes::anchors::Anchors;

/// The output of a head does not fit its anchors: name and values of the output, number of anchors, values needed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("head output {0} has {1} values, {2} anchors need {3}")]
pub struct DecodeError(&'static str, usize, usize, usize);

/// A decoded box of one anchor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Decoded {
    /// Index of the anchor, see [`Anchors`].
    pub anchor: usize,
    /// Sigmoid of its logit, 0..1.
    pub score: f32,
    /// The box in the frame of the BEV feature map.
    pub box3d: Box3d,
}

/// Largest exponent of a size that is decoded: a box of `e^8` times the anchor is no vehicle, but a finite number.
const MAX_LOG_SIZE: f32 = 8.0;

/// Decodes the anchors whose score is above `threshold`; the others, nearly all, cost one comparison each.
///
/// x and y are offsets in diagonals of the anchor, z in its heights; sizes are logarithms; yaw is added and not
/// wrapped. Values that are not finite give no detection.
///
/// # Shapes
/// - `scores`: `[A, H, W]` logits
/// - `offsets`: `[7 A, H, W]`, channel `7 * anchor + component` of x, y, z, h, w, l, yaw
/// - returns: in the order of the anchors
///
/// # Errors
/// [`DecodeError`] when the number of values does not fit the anchors.
pub fn decode(
    scores: &[f32],
    offsets: &[f32],
    anchors: &Anchors,
    threshold: f32,
) -> Result<Vec<Decoded>, DecodeError> {
    for (field, found, of_anchor) in [("scores", scores.len(), 1), ("offsets", offsets.len(), 7)] {
        let (anchors, expected) = (anchors.len(), anchors.len() * of_anchor);
        if found != expected {
            return Err(DecodeError(field, found, anchors, expected));
        }
    }
    let per_cell = anchors.yaws_rad.len();
    let cells = anchors.len() / per_cell.max(1);
    // The sigmoid is increasing: a logit clearly below the threshold's needs no exponential.
    // The margin covers the rounding of this logit.
    let lowest = (threshold / (1.0 - threshold)).ln() - 1e-3;
    let mut decoded = Vec::new();
    for cell in 0..cells {
        for anchor in 0..per_cell {
            // The head is channel by channel, `[A, H, W]`, while anchors are numbered cell by cell.
            let logit = scores[anchor * cells + cell];
            // Both comparisons are false for NaN.
            if logit < lowest || sigmoid(logit) <= threshold || logit.is_nan() {
                continue;
            }
            let offsets: [f32; 7] =
                std::array::from_fn(|component| offsets[(7 * anchor + component) * cells + cell]);
            let index = cell * per_cell + anchor;
            if let Some(box3d) = decode_box(offsets, &anchors.box_at(index)) {
                decoded.push(Decoded {
                    anchor: index,
                    score: sigmoid(logit),
                    box3d,
                });
            }
        }
    }
    Ok(decoded)
}

/// One box from its offsets x, y, z, h, w, l, yaw and its anchor; `None` when an offset is not finite.
pub fn decode_box(offsets: [f32; 7], anchor: &Box3d) -> Option<Box3d> {
    if offsets.iter().any(|offset| !offset.is_finite()) {
        return None;
    }
    let ([x, y, z], [l, w, h]) = (anchor.center_m, anchor.size_m);
    let diagonal = (l * l + w * w).sqrt();
    let [dx, dy, dz, _, _, _, dyaw] = offsets.map(f64::from);
    Some(Box3d {
        center_m: [dx * diagonal + x, dy * diagonal + y, dz * h + z],
        // The code is in the order h, w, l, the box in the order l, w, h.
        size_m: [(5, l), (4, w), (3, h)].map(|(component, prior): (usize, f64)| {
            f64::from(offsets[component].min(MAX_LOG_SIZE)).exp() * prior
        }),
        heading_rad: dyaw + anchor.heading_rad,
    })
}

/// `1 / (1 + e^-x)`.
pub fn sigmoid(logit: f32) -> f32 {
    (1.0 / (1.0 + (-f64::from(logit)).exp())) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model_config::DetectorConfig;

    fn anchors() -> Anchors {
        let config = DetectorConfig {
            lidar_range_m: [0.0, 0.0, -3.0, 3.2, 3.2, 1.0],
            ..DetectorConfig::lean()
        };
        Anchors::for_detector(&config)
    }

    #[test]
    fn only_scores_above_the_threshold_are_decoded() {
        let anchors = anchors();
        let cells = anchors.len() / 2;
        let mut scores = vec![-5.0; anchors.len()];
        scores[cells + 3] = 2.0; // anchor 1 of cell 3
        scores[4] = 0.0; // exactly 0.5
        scores[5] = f32::NAN;
        let decoded = decode(&scores, &vec![0.0; anchors.len() * 7], &anchors, 0.5).unwrap();
        assert_eq!(decoded.len(), 1);
        assert_eq!(decoded[0].anchor, 7);
        assert!((decoded[0].score - 0.880_797).abs() < 1e-6);
        assert_eq!(decoded[0].box3d.size_m, [3.9, 1.6, 1.56]);
    }

    #[test]
    fn offsets_scale_with_the_anchor() {
        let anchor = &Box3d {
            center_m: [1.0, 2.0, -1.0],
            size_m: [4.0, 3.0, 1.5],
            heading_rad: 0.5,
        };
        let box3d = decode_box([1.0, -1.0, 2.0, 0.0, 0.0, 2.0_f32.ln(), 0.25], anchor).unwrap();
        assert_eq!(box3d.center_m, [6.0, -3.0, 2.0]);
        assert!((box3d.size_m[0] - 8.0).abs() < 1e-6 && box3d.heading_rad == 0.75);
        assert!(decode_box([0.0, 0.0, f32::NAN, 0.0, 0.0, 0.0, 0.0], anchor).is_none());
        assert!(
            decode_box([0.0, 0.0, 0.0, f32::MAX, 0.0, 0.0, 0.0], anchor)
                .unwrap()
                .size_m[2]
                .is_finite()
        );
    }

    #[test]
    fn a_map_of_another_size_is_rejected() {
        let message = decode(&[0.0; 3], &[], &anchors(), 0.5)
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("scores has 3") && message.contains("32"),
            "{message}"
        );
    }
}
