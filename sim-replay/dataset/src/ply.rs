//! PLY point files: ASCII and binary in either byte order, as CloudCompare, Open3D, MeshLab and PCL write them.
//!
//! The element `vertex` holds the points: properties `x`, `y`, `z`, and an intensity by any of its usual names. Other
//! properties and elements are skipped. Points stay in the frame of the file.

use protocol::INTENSITY_FIELDS;

use crate::pcd::{IntensityOrigin, PcdCloud};
use crate::scalar::{Scalar, ScalarKind, check_end, find, place, read_point, size_of};

/// Longest header that is read, bytes.
const MAX_HEADER: usize = 64 << 10;
/// Most properties of an element.
const MAX_PROPERTIES: usize = 256;

/// Storage of the numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, strum::EnumString)]
#[strum(serialize_all = "snake_case")]
enum PlyFormat {
    Ascii,
    BinaryLittleEndian,
    BinaryBigEndian,
}

/// Elements of one kind.
#[derive(Debug)]
struct PlyElement {
    name: String,
    count: usize,
    properties: Vec<(String, Scalar)>,
    /// Name of the first list: elements with lists have no fixed size.
    list: Option<String>,
}

/// Reads a PLY file in memory; intensities are as stored.
///
/// # Errors
/// The fault with the found and the expected value. No allocation relies on the header alone.
pub(super) fn decode(bytes: &[u8]) -> Result<PcdCloud, String> {
    let (storage, elements, body) = header(bytes)?;
    let mut from_vertex = elements
        .iter()
        .skip_while(|element| element.name != "vertex");
    let vertex = from_vertex.next().ok_or_else(|| {
        let names = elements.iter().map(|element| element.name.as_str());
        let names: Vec<&str> = names.collect();
        format!("no element vertex, there are {names:?}")
    })?;
    let is_last = from_vertex.all(|element| element.count == 0);
    let before = elements.split(|element| element.name == "vertex").next();
    let around = (before.unwrap_or_default(), is_last);
    if let Some(list) = &vertex.list {
        return Err(format!(
            "element vertex has the list {list:?}, expected numbers only"
        ));
    }
    let [x, y, z] = ["x", "y", "z"].map(|name| {
        let found = find(&vertex.properties, &[name]);
        found.ok_or_else(|| format!("element vertex has no property {name}"))
    });
    let intensity = find(&vertex.properties, &INTENSITY_FIELDS);
    let columns = [Some(x?), Some(y?), Some(z?), intensity];
    let (points, form) = match storage {
        PlyFormat::Ascii => (ascii(vertex, around, body, &columns)?, "PLY, ascii"),
        _ => (binary(vertex, around, body, &columns)?, "PLY, binary"),
    };
    let intensity = intensity
        .and_then(|index| vertex.properties.get(index))
        .map(|(name, scalar)| IntensityOrigin::stored(name, scalar.intensity_kind()));
    Ok(PcdCloud::of_points(points, intensity, form))
}

/// Storage, elements, and the bytes behind the header.
fn header(bytes: &[u8]) -> Result<(PlyFormat, Vec<PlyElement>, &[u8]), String> {
    const END: &[u8] = b"end_header";
    const TOO_EARLY: &str = "a property before the first element";
    // A binary body may have no line end for long: the search for `end_header` is bounded.
    let start = bytes.get(..bytes.len().min(MAX_HEADER)).unwrap_or_default();
    if !start.starts_with(b"ply") {
        return Err("the first line is not ply".to_owned());
    }
    let mut len = 0;
    let has_end = start.split_inclusive(|&byte| byte == b'\n').any(|line| {
        len += line.len();
        line.trim_ascii() == END
    });
    if !has_end {
        return Err("no line end_header".to_owned());
    }
    let (text, body) = bytes.split_at_checked(len).unwrap_or_default();
    let text = String::from_utf8_lossy(text);
    let (mut format, mut elements) = (None, Vec::<PlyElement>::new());
    for (number, line) in (1..).zip(text.lines()) {
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match *words {
            ["format", name, _] => format = Some(name),
            ["element", name, count] => {
                let count = count
                    .parse()
                    .map_err(|_| format!("line {number}: {count:?} is no number of elements"))?;
                elements.push(PlyElement {
                    name: name.to_owned(),
                    count,
                    properties: Vec::new(),
                    list: None,
                });
            }
            ["property", "list", _, _, name] => {
                let element = elements.last_mut();
                let element = element.ok_or_else(|| format!("line {number}: {TOO_EARLY}"))?;
                element.list.get_or_insert_with(|| name.to_owned());
            }
            ["property", kind, name] => {
                let scalar = scalar_of(kind)
                    .ok_or_else(|| format!("line {number}: {kind:?} is no type of a number"))?;
                let element = elements.last_mut();
                let element = element.ok_or_else(|| format!("line {number}: {TOO_EARLY}"))?;
                if element.properties.len() >= MAX_PROPERTIES {
                    return Err(format!(
                        "line {number}: more than {MAX_PROPERTIES} properties"
                    ));
                }
                element.properties.push((name.to_owned(), scalar));
            }
            _ => {}
        }
    }
    let format = format.ok_or("no line format")?;
    let storage: PlyFormat = format.parse().map_err(|_| {
        format!("format {format:?}, expected ascii, binary_little_endian or binary_big_endian")
    })?;
    // After all lines: `format` may come behind the elements.
    for element in &mut elements {
        for (_, scalar) in &mut element.properties {
            scalar.is_big_endian = storage == PlyFormat::BinaryBigEndian;
        }
    }
    Ok((storage, elements, body))
}

fn scalar_of(name: &str) -> Option<Scalar> {
    let (kind, size) = match name {
        "char" | "int8" => (ScalarKind::Signed, 1),
        "uchar" | "uint8" => (ScalarKind::Unsigned, 1),
        "short" | "int16" => (ScalarKind::Signed, 2),
        "ushort" | "uint16" => (ScalarKind::Unsigned, 2),
        "int" | "int32" => (ScalarKind::Signed, 4),
        "uint" | "uint32" => (ScalarKind::Unsigned, 4),
        "float" | "float32" => (ScalarKind::Float, 4),
        "double" | "float64" => (ScalarKind::Float, 8),
        _ => return None,
    };
    Some(Scalar::new(kind, size, false))
}

#[expect(clippy::cast_possible_truncation, reason = "rounded to f32")]
fn ascii(
    vertex: &PlyElement,
    (before, is_last): (&[PlyElement], bool),
    body: &[u8],
    columns: &[Option<usize>; 4],
) -> Result<Vec<[f32; 4]>, String> {
    // ASCII has one line for each element, so those before the vertices are skipped by lines, lists too.
    let counts = before.iter().map(|element| element.count);
    let skipped = counts.fold(0, usize::saturating_add);
    let text = String::from_utf8_lossy(body);
    let lines = text.lines().filter(|line| !line.trim().is_empty());
    let is_vertex = |(index, _): &(usize, &str)| is_last || *index < vertex.count;
    let mut points = Vec::new();
    for (index, line) in lines.skip(skipped).enumerate().take_while(is_vertex) {
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        let mut point = [0.0; 4];
        for (value, column) in point.iter_mut().zip(columns) {
            let Some(column) = column else { continue };
            let word = words.get(*column).ok_or_else(|| {
                let (found, expected) = (words.len(), vertex.properties.len());
                format!("vertex {index}: {found} numbers, expected {expected}")
            })?;
            let number = word.parse::<f64>();
            *value = number.map_err(|_| format!("vertex {index}: {word:?} is no number"))? as f32;
        }
        points.push(point);
    }
    match (points.len(), vertex.count) {
        (found, stated) if found == stated => Ok(points),
        (found, stated) => Err(format!("{stated} vertices stated, {found} found")),
    }
}

fn binary(
    vertex: &PlyElement,
    (before, is_last): (&[PlyElement], bool),
    body: &[u8],
    columns: &[Option<usize>; 4],
) -> Result<Vec<[f32; 4]>, String> {
    let mut skipped = 0_usize;
    for element in before {
        if let Some(list) = &element.list {
            let name = &element.name;
            return Err(format!(
                "element {name} before the vertices has the list {list:?}: their place is unknown"
            ));
        }
        let bytes = element.count.saturating_mul(size_of(&element.properties));
        skipped = skipped.saturating_add(bytes);
    }
    let stride = size_of(&vertex.properties);
    let body = body.get(skipped..).unwrap_or_default();
    let length = vertex.count.checked_mul(stride);
    let Some((body, rest)) = length.and_then(|length| body.split_at_checked(length)) else {
        let (count, found) = (vertex.count, body.len());
        return Err(format!(
            "{count} vertices of {stride} bytes stated, {found} bytes found: the file is cut off"
        ));
    };
    if is_last {
        check_end(rest, vertex.count, stride)?;
    }
    let places = columns.map(|index| place(&vertex.properties, index?));
    let points = body.chunks_exact(stride.max(1));
    Ok(points.map(|bytes| read_point(bytes, &places)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEAD: &str = "comment made by hand\nelement vertex 2\nproperty double x\nproperty double y\n\
                        property double z\nproperty uchar red\nproperty uint16 scalar_Intensity\n";

    fn file(format: &str, body: &[u8]) -> Vec<u8> {
        let head = format!(
            "ply\nformat {format} 1.0\n{HEAD}element face 0\nproperty list uchar int v\nend_header\n"
        );
        [head.as_bytes(), body].concat()
    }

    fn body(double: fn(f64) -> [u8; 8], short: fn(u16) -> [u8; 2]) -> Vec<u8> {
        let points = [(1.25, 7), (f64::NAN, 8)].map(|(x, intensity)| {
            [
                &double(x)[..],
                &double(-2.0),
                &double(3.5),
                &[9],
                &short(intensity),
            ]
            .concat()
        });
        points.concat()
    }

    #[test]
    fn all_storages_give_the_same_points() {
        let files = [
            file(
                "binary_little_endian",
                &body(f64::to_le_bytes, u16::to_le_bytes),
            ),
            file(
                "binary_big_endian",
                &body(f64::to_be_bytes, u16::to_be_bytes),
            ),
            file("ascii", b"1.25 -2 3.5e0 9 7\nnan -2 3.5 9 8\n"),
        ];
        for file in files {
            let cloud = decode(&file).unwrap();
            assert_eq!(cloud.points.xyzi, [[1.25, -2.0, 3.5, 7.0]]);
            assert_eq!(
                (cloud.dropped, cloud.intensity.unwrap().field.as_str()),
                (1, "scalar_Intensity")
            );
        }
    }

    #[test]
    fn the_header_ends_at_a_line_and_not_within_a_comment() {
        let head = HEAD.replace("made by hand", "before end_header of the header");
        let file = format!("ply\r\nformat ascii 1.0\n{head}end_header\r\n1 2 3 9 7\n4 5 6 9 8\n");
        assert_eq!(decode(file.as_bytes()).unwrap().points.len(), 2);
    }

    fn refusal(bytes: &[u8]) -> String {
        decode(bytes).unwrap_err()
    }

    #[test]
    fn further_vertices_than_stated_are_an_error_unless_another_element_follows() {
        let points = body(f64::to_le_bytes, u16::to_le_bytes);
        let lines = b"1.25 -2 3.5e0 9 7\nnan -2 3.5 9 8\n".to_vec();
        for (format, points, expected) in [
            (
                "binary_little_endian",
                points,
                "2 points stated, 4 found: the header is not of this file",
            ),
            ("ascii", lines, "2 vertices stated, 4 found"),
        ] {
            let more = file(format, &points.repeat(2));
            assert_eq!(refusal(&more), expected);
            let faces = String::from_utf8_lossy(&file(format, &[])).replace("face 0", "face 2");
            let followed = [faces.as_bytes(), &points.repeat(2)].concat();
            assert_eq!(decode(&followed).unwrap().points.len(), 1);
        }
    }

    #[test]
    fn faults_are_named_with_both_values() {
        assert_eq!(refusal(b"ply\n"), "no line end_header");
        assert_eq!(refusal(b"PLY\n"), "the first line is not ply");
        let cut = file("binary_little_endian", &[0; 53]);
        assert_eq!(
            refusal(&cut),
            "2 vertices of 27 bytes stated, 53 bytes found: the file is cut off"
        );
        assert!(refusal(&file("ascii", b"1 2 3 4 5\n")).starts_with("2 vertices stated, 1 found"));
        assert_eq!(
            refusal(&file("ascii", b"1 2 3 4 5\n1 2\n")),
            "vertex 1: 2 numbers, expected 5"
        );
        assert!(refusal(&file("binary", b"")).starts_with("format \"binary\", expected ascii"));
        let huge = b"ply\nformat binary_little_endian 1.0\nelement vertex 18446744073709551615\nproperty float x\n\
                     property float y\nproperty float z\nend_header\n";
        assert!(refusal(huge).contains("the file is cut off"));
        assert_eq!(
            refusal(b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n"),
            "element vertex has no property x"
        );
    }
}
