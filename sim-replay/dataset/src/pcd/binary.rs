//! Points as little-endian numbers, plain or packed.
//!
//! The points may be followed by zeros: PCL's writers extend files to whole pages. Further points are an error. The
//! unpacked length determines the positions of fields.

use super::header::{IntensitySource, PcdField, PcdHeader};
use super::{MAX_BYTES, PcdCloud, PcdError, lzf, unpack_rgb};
use crate::scalar::{ScalarKind, check_end};

/// Position of a field's numbers: that of point `i` at `first + i * step`.
#[derive(Debug, Clone, Copy)]
struct BinaryColumn<'a> {
    field: &'a PcdField,
    first: usize,
    step: usize,
}

/// Points one after another.
pub(super) fn decode(header: &PcdHeader, body: &[u8]) -> Result<PcdCloud, PcdError> {
    let (points, stride) = (header.points, header.stride());
    let expected = points.checked_mul(stride);
    if expected.is_none_or(|expected| body.len() < expected) {
        let reason = format!(
            "{points} points of {stride} bytes stated, but only {} bytes follow the header: the file is cut off",
            body.len()
        );
        return Err(PcdError::of("POINTS", reason));
    }
    let rest = body.get(expected.unwrap_or_default()..);
    let end = check_end(rest.unwrap_or_default(), points, stride);
    end.map_err(|reason| PcdError::of("POINTS", reason))?;
    Ok(gather(header, body, |(field, first)| BinaryColumn {
        field,
        first,
        step: stride,
    }))
}

/// Two lengths, then LZF; once unpacked, fields one after another, each for all points.
pub(super) fn decode_compressed(header: &PcdHeader, body: &[u8]) -> Result<PcdCloud, PcdError> {
    let Some((lengths, packed)) = body.split_first_chunk::<8>() else {
        let found = body.len();
        let reason = format!("{found} bytes after the header, expected two lengths");
        return Err(PcdError::of("DATA", reason));
    };
    let [a, b, c, d, e, f, g, h] = *lengths;
    let packed_len = u32::from_le_bytes([a, b, c, d]) as usize;
    let unpacked_len = u32::from_le_bytes([e, f, g, h]) as usize;
    let Some(packed) = packed.get(..packed_len) else {
        let reason = format!(
            "{packed_len} packed bytes stated, but only {} follow: the file is cut off",
            packed.len()
        );
        return Err(PcdError::of("DATA", reason));
    };
    if unpacked_len as u64 > MAX_BYTES {
        let reason = format!("{unpacked_len} bytes unpacked, at most {MAX_BYTES} are read");
        return Err(PcdError::of("DATA", reason));
    }
    let (points, stride) = (header.points, header.stride());
    let expected = points.checked_mul(stride);
    if expected != Some(unpacked_len) {
        let way = match expected.is_none_or(|expected| unpacked_len < expected) {
            true => "fewer",
            false => "more",
        };
        let reason = format!(
            "{points} points of {stride} bytes stated, but unpacked they are {unpacked_len} bytes: {way}"
        );
        return Err(PcdError::of("DATA", reason));
    }
    let unpacked =
        lzf::decompress(packed, unpacked_len).map_err(|reason| PcdError::of("DATA", reason))?;
    Ok(gather(header, &unpacked, |(field, first)| BinaryColumn {
        field,
        // A field begins behind the numbers of all points of those before it.
        first: first * points,
        step: field.size * field.count,
    }))
}

/// A field, and the number of bytes of a point before it.
#[expect(
    clippy::indexing_slicing,
    reason = "the header's indices are of its fields"
)]
fn field_at(header: &PcdHeader, index: usize) -> (&PcdField, usize) {
    let before = header.fields[..index].iter();
    let before = before.map(|field| field.size * field.count).sum();
    (&header.fields[index], before)
}

/// `column` gives the place of a field from the bytes of a point before it. `data` holds every number that it points
/// at: its length has been checked.
fn gather(
    header: &PcdHeader,
    data: &[u8],
    column: impl Fn((&PcdField, usize)) -> BinaryColumn<'_>,
) -> PcdCloud {
    let mut points = vec![[0.0; 4]; header.points];
    for (component, index) in header.xyz.into_iter().enumerate() {
        column(field_at(header, index)).fill(data, &mut points, component);
    }
    let mut labels = Vec::new();
    match header.intensity {
        IntensitySource::Value(index) => column(field_at(header, index)).fill(data, &mut points, 3),
        // The four bytes of a packed colour, whether declared a float or an integer.
        IntensitySource::Red(index) => {
            labels.reserve_exact(points.len());
            column(field_at(header, index)).each(data, &mut points, |point, bytes| {
                let (red, label) = unpack_rgb(u32::from_le_bytes(bytes));
                point[3] = red;
                labels.push(label);
            });
        }
        IntensitySource::None => {}
    }
    PcdCloud::of_finite(points, labels)
}

impl BinaryColumn<'_> {
    /// Sets one component of all points. Integers beyond 2^24 and doubles are rounded.
    #[expect(clippy::cast_possible_truncation, reason = "rounded to f32")]
    #[expect(clippy::indexing_slicing, reason = "a component is 0 to 3")]
    fn fill(self, data: &[u8], points: &mut [[f32; 4]], component: usize) {
        macro_rules! numbers {
            ($number:ty) => {
                self.each(data, points, |point, bytes| {
                    point[component] = <$number>::from_le_bytes(bytes) as f32
                })
            };
        }
        match (self.field.kind, self.field.size) {
            (ScalarKind::Float, 4) => self.each(data, points, |point, bytes| {
                point[component] = f32::from_le_bytes(bytes)
            }),
            (ScalarKind::Float, _) => numbers!(f64),
            (ScalarKind::Unsigned, 1) => numbers!(u8),
            (ScalarKind::Unsigned, 2) => numbers!(u16),
            (ScalarKind::Unsigned, 4) => numbers!(u32),
            (ScalarKind::Signed, 1) => numbers!(i8),
            (ScalarKind::Signed, 2) => numbers!(i16),
            (ScalarKind::Signed, 4) => numbers!(i32),
            (ScalarKind::Signed, _) => numbers!(i64),
            // The header accepts no other type.
            (ScalarKind::Unsigned | ScalarKind::Padding, _) => numbers!(u64),
        }
    }

    /// Passes on each point with its bytes.
    fn each<const N: usize>(
        self,
        data: &[u8],
        points: &mut [[f32; 4]],
        mut take: impl FnMut(&mut [f32; 4], [u8; N]),
    ) {
        let chunks = data.get(self.first..).unwrap_or_default().chunks(self.step);
        for (point, chunk) in points.iter_mut().zip(chunks) {
            if let Some(&bytes) = chunk.first_chunk() {
                take(point, bytes);
            }
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use protocol::PointCloud;

    use crate::pcd::{PcdPlace, decode, lzf};

    fn header(
        fields: &str,
        sizes: &str,
        types: &str,
        counts: &str,
        points: usize,
        data: &str,
    ) -> Vec<u8> {
        format!(
            "VERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\nCOUNT {counts}\nWIDTH {points}\nHEIGHT 1\n\
             VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n"
        )
        .into_bytes()
    }

    /// The cloud as PCL packs it: fields one after another.
    pub(in crate::pcd) fn compressed(cloud: &PointCloud) -> Vec<u8> {
        let columns: Vec<u8> = (0..4)
            .flat_map(|field| {
                cloud
                    .xyzi
                    .iter()
                    .flat_map(move |point| point[field].to_le_bytes())
            })
            .collect();
        let packed = lzf::tests::compress(&columns);
        let mut file = header(
            "x y z intensity",
            "4 4 4 4",
            "F F F F",
            "1 1 1 1",
            cloud.len(),
            "binary_compressed",
        );
        file.extend((packed.len() as u32).to_le_bytes());
        file.extend((columns.len() as u32).to_le_bytes());
        file.extend(packed);
        file
    }

    #[test]
    fn compressed_fields_come_back_as_points() {
        let cloud = PointCloud {
            xyzi: (0..500)
                .map(|i| [i as f32, 0.0, -(i as f32), 0.5])
                .collect(),
        };
        let file = compressed(&cloud);
        assert!(file.len() < 500 * 16, "something was packed");
        assert_eq!(decode(&file).unwrap().points, cloud);
    }

    #[test]
    fn widths_types_and_padding_are_honoured() {
        let mut file = header(
            "x _ y z rgb ring",
            "8 1 2 4 4 2",
            "F U I F U U",
            "1 3 1 1 1 2",
            1,
            "binary",
        );
        file.extend(1.5f64.to_le_bytes());
        file.extend([9, 9, 9]);
        file.extend((-7i16).to_le_bytes());
        file.extend(2.5f32.to_le_bytes());
        file.extend(0x0033_0000_u32.to_le_bytes());
        file.extend([1, 0, 2, 0]);
        assert_eq!(
            decode(&file).unwrap().points.xyzi,
            [[1.5, -7.0, 2.5, 51.0 / 255.0]]
        );
    }

    #[test]
    fn a_body_of_the_wrong_length_is_named() {
        let mut file = header("x y z", "4 4 4", "F F F", "1 1 1", 2, "binary");
        file.extend([0; 20]);
        assert_eq!(
            decode(&file).unwrap_err().to_string(),
            "POINTS: 2 points of 12 bytes stated, but only 20 bytes follow the header: the file is cut off"
        );
        file.extend([0; 4]);
        assert_eq!(decode(&file).unwrap().points.len(), 2);
        file.extend([0; 4096]);
        assert_eq!(decode(&file).unwrap().points.len(), 2, "a page of zeros");
        file.extend([7; 8]);
        assert_eq!(
            decode(&file).unwrap_err().to_string(),
            "POINTS: 2 points stated, 344 found: the header is not of this file"
        );
    }

    #[test]
    fn not_a_number_is_counted_by_point() {
        let mut file = header("x y z", "4 4 4", "F F F", "1 1 1", 3, "binary");
        for value in [1.0, 2.0, 3.0, 1.0, f32::NAN, 3.0, 4.0, 5.0, 6.0f32] {
            file.extend(value.to_le_bytes());
        }
        let cloud = decode(&file).unwrap();
        assert_eq!(
            (cloud.points.len(), cloud.dropped, cloud.first_dropped),
            (2, 1, Some(PcdPlace::Point(1)))
        );
    }

    #[test]
    fn lengths_of_a_packed_body_must_fit() {
        let cloud = PointCloud {
            xyzi: vec![[1.0; 4]; 10],
        };
        let file = compressed(&cloud);
        let lengths_at = file.len() - decode_packed_len(&file) - 8;
        let mut cut = file.clone();
        cut.truncate(file.len() - 1);
        let packed = decode_packed_len(&file);
        assert_eq!(
            decode(&cut).unwrap_err().to_string(),
            format!(
                "DATA: {packed} packed bytes stated, but only {} follow: the file is cut off",
                packed - 1
            )
        );
        let stretched = [&file[..], &[0; 3731]].concat();
        assert_eq!(decode(&stretched).unwrap().points, cloud);
        for (unpacked, message) in [
            (
                100_000,
                "DATA: 10 points of 16 bytes stated, but unpacked they are 100000 bytes: more",
            ),
            (
                u32::MAX,
                "DATA: 4294967295 bytes unpacked, at most 1073741824 are read",
            ),
        ] {
            let mut absurd = file.clone();
            absurd[lengths_at + 4..lengths_at + 8].copy_from_slice(&unpacked.to_le_bytes());
            assert_eq!(decode(&absurd).unwrap_err().to_string(), message);
        }
    }

    fn decode_packed_len(file: &[u8]) -> usize {
        let start = file
            .windows(18)
            .position(|window| window == b"binary_compressed\n")
            .unwrap()
            + 18;
        u32::from_le_bytes(file[start..start + 4].try_into().unwrap()) as usize
    }
}
