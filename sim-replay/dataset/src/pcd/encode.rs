//! Writing PCD files.

use std::io::Write;

use protocol::PointCloud;

/// Encoding of points.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Encoding {
    /// A line of shortest decimal numbers per point: every `f32` is restored bit by bit.
    Ascii,
    /// Little-endian numbers.
    Binary,
}

/// Field of the intensity.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum IntensityField<'a> {
    /// A float field `intensity`, exact.
    Intensity,
    /// The red byte of a float field `rgb`, as OPV2V's tools expect it: 0..1 in steps of 1/255.
    Red,
    /// The same, and in its green byte a label for each point, as in V2X-R's weather. Points beyond the labels have 0.
    RedAndLabel(&'a [u8]),
}

/// A PCD file of these points, in their frame and handedness.
pub fn encode(cloud: &PointCloud, encoding: Encoding, intensity: IntensityField<'_>) -> Vec<u8> {
    let (data, bytes_per_point) = match encoding {
        Encoding::Ascii => ("ascii", 48),
        Encoding::Binary => ("binary", 16),
    };
    let field = match intensity {
        IntensityField::Intensity => "intensity",
        IntensityField::Red | IntensityField::RedAndLabel(_) => "rgb",
    };
    let points = cloud.len();
    let header = format!(
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z {field}\nSIZE 4 4 4 4\nTYPE F F F F\n\
         COUNT 1 1 1 1\nWIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n"
    );
    let stored = cloud
        .xyzi
        .iter()
        .enumerate()
        .map(|(index, &[x, y, z, fourth])| {
            let green = match intensity {
                IntensityField::Intensity => return [x, y, z, fourth],
                IntensityField::Red => 0,
                IntensityField::RedAndLabel(labels) => labels.get(index).copied().unwrap_or(0),
            };
            let packed = red_byte(fourth) << 16 | u32::from(green) << 8;
            [x, y, z, f32::from_bits(packed)]
        });
    let mut bytes = header.into_bytes();
    bytes.reserve_exact(points * bytes_per_point);
    match encoding {
        Encoding::Ascii => {
            // With exponents: colours are subnormal numbers, whose plain decimals have over 40 digits.
            for [x, y, z, fourth] in stored {
                // Writing to a Vec does not fail.
                let _ = writeln!(bytes, "{x:e} {y:e} {z:e} {fourth:e}");
            }
        }
        Encoding::Binary => bytes.extend(stored.flatten().flat_map(f32::to_le_bytes)),
    }
    bytes
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a cast from a float saturates"
)]
fn red_byte(intensity: f32) -> u32 {
    // NaN becomes 0.
    (intensity.clamp(0.0, 1.0) * 255.0).round() as u32
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::pcd::decode;

    fn bits(point: &[f32; 4]) -> [u32; 4] {
        point.map(f32::to_bits)
    }

    proptest! {
        #[test]
        fn finite_points_come_back_bit_by_bit(
            points in prop::collection::vec(prop::array::uniform4(any::<f32>()), 0..50),
            encoding in prop::sample::select(vec![Encoding::Ascii, Encoding::Binary]),
        ) {
            let file = encode(&PointCloud { xyzi: points.clone() }, encoding, IntensityField::Intensity);
            let back = decode(&file).unwrap();
            let finite = points.iter().filter(|point| point.iter().all(|value| value.is_finite()));
            let expected: Vec<_> = finite.map(bits).collect();
            prop_assert_eq!(back.points.xyzi.iter().map(bits).collect::<Vec<_>>(), expected);
            prop_assert_eq!(back.dropped, points.len() - back.points.len());
        }

        #[test]
        fn a_red_byte_keeps_intensity_to_half_a_step(
            intensity in 0.0..=1.0f32, encoding in prop::sample::select(vec![Encoding::Ascii, Encoding::Binary]),
        ) {
            let file = encode(&PointCloud { xyzi: vec![[1.0, 2.0, 3.0, intensity]] }, encoding, IntensityField::Red);
            let back = decode(&file).unwrap().points.xyzi[0][3];
            prop_assert!((back - intensity).abs() <= 0.5 / 255.0 + 1e-6);
        }
    }

    #[test]
    fn labels_come_back_beside_intensity() {
        let cloud = PointCloud {
            xyzi: vec![
                [1.0, 2.0, 3.0, 0.2],
                [4.0, 5.0, 6.0, 1.0],
                [7.0, 8.0, 9.0, 0.0],
            ],
        };
        for encoding in [Encoding::Ascii, Encoding::Binary] {
            let back = decode(&encode(
                &cloud,
                encoding,
                IntensityField::RedAndLabel(&[0, 1]),
            ))
            .unwrap();
            assert_eq!(
                (back.points, back.labels),
                (cloud.clone(), Some(vec![0, 1, 0]))
            );
            let back = decode(&encode(
                &cloud,
                encoding,
                IntensityField::RedAndLabel(&[0; 3]),
            ))
            .unwrap();
            assert_eq!(back.labels, None);
        }
    }

    #[test]
    fn an_empty_sweep_is_a_file_too() {
        for encoding in [Encoding::Ascii, Encoding::Binary] {
            let file = encode(&PointCloud::default(), encoding, IntensityField::Red);
            assert!(decode(&file).unwrap().points.is_empty());
        }
    }
}
