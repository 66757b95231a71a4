//! NumPy files (`.npy`) of points: an array of N x 3, N x 4 or more columns of numbers, or named fields `x`, `y`, `z`.
//!
//! Columns are x, y, z and intensity; others are skipped. An organised array of rows x columns x numbers is flattened;
//! 3 x N and 4 x N are read component by component. Points stay in the frame of the file.

use protocol::INTENSITY_FIELDS;

use crate::pcd::{IntensityOrigin, PcdCloud};
use crate::scalar::{Scalar, ScalarKind, check_end, find, place, read_point, size_of};

/// Numbers of a point that are accepted.
const COLUMNS: std::ops::RangeInclusive<usize> = 3..=32;
const MAGIC: &[u8] = b"\x93NUMPY";

/// Places of the numbers of a point: `first + index * step`, bytes.
#[derive(Debug)]
struct NpyColumns {
    places: [Option<(usize, Scalar)>; 4],
    step: usize,
    /// Size of an entry of the array, bytes.
    entry_size: usize,
    points: usize,
    /// Name of the intensity.
    intensity: Option<String>,
}

/// Reads a file in memory; intensities are as stored.
///
/// # Errors
/// The fault with the found and the expected value. No allocation relies on the header alone.
pub(super) fn decode(bytes: &[u8]) -> Result<PcdCloud, String> {
    let (header, body) = split(bytes)?;
    let descr = entry(header, "descr").ok_or("no entry descr")?;
    let shape = shape_of(header)?;
    let columns = match descr.strip_prefix('[') {
        Some(fields) => named(fields, &shape)?,
        None => numbered(number_of(descr)?, &shape, is_fortran(header))?,
    };
    let (stated, found) = (product(columns.entry_size, &shape), body.len());
    // Before anything is allocated by the shape. No product means that the shape overflows.
    if stated.is_none_or(|stated| found < stated) {
        return Err(format!(
            "shape {shape:?} stated, {found} bytes found: the file is cut off"
        ));
    }
    let rest = body.get(stated.unwrap_or_default()..).unwrap_or_default();
    let size = stated.and_then(|stated| stated.checked_div(columns.points));
    // Another array may follow, as NumPy itself writes several into one file.
    if !rest.starts_with(MAGIC) {
        check_end(rest, columns.points, size.unwrap_or_default())?;
    }
    let points = (0..columns.points).map(|index| {
        let bytes = body.get(index * columns.step..).unwrap_or_default();
        read_point(bytes, &columns.places)
    });
    let [.., intensity] = columns.places;
    let intensity = intensity.map(|(_, scalar)| {
        let name = columns.intensity.as_deref().unwrap_or("4th column");
        IntensityOrigin::stored(name, scalar.intensity_kind())
    });
    let points = points.collect();
    Ok(PcdCloud::of_points(points, intensity, "NumPy array"))
}

/// Text of the header and the bytes behind it.
fn split(bytes: &[u8]) -> Result<(&str, &[u8]), String> {
    let rest = bytes.strip_prefix(MAGIC);
    let rest = rest.ok_or("it does not begin as a NumPy file")?;
    let (length, rest) = match rest {
        // Version 1 states the length of the header in two bytes, later ones in four.
        [1, _, a, b, rest @ ..] => (usize::from(u16::from_le_bytes([*a, *b])), rest),
        [2 | 3, _, a, b, c, d, rest @ ..] => (u32::from_le_bytes([*a, *b, *c, *d]) as usize, rest),
        [version, ..] => return Err(format!("version {version} of the format, expected 1 to 3")),
        [] => return Err("it ends after its first bytes".to_owned()),
    };
    let header = rest
        .get(..length)
        .ok_or_else(|| format!("header of {length} bytes stated, {} found", rest.len()))?;
    let header = std::str::from_utf8(header).map_err(|_| "the header is no text".to_owned())?;
    Ok((header, rest.get(length..).unwrap_or_default()))
}

/// The text behind a key of the header, a Python dictionary.
fn entry<'a>(header: &'a str, key: &str) -> Option<&'a str> {
    let (_, after) = header.split_once(&format!("'{key}'"))?;
    Some(after.trim_start().strip_prefix(':')?.trim_start())
}

fn quoted(text: &str) -> Option<&str> {
    let first = text.chars().next();
    let quote = first.filter(|quote| matches!(quote, '\'' | '"'))?;
    text.get(1..)?.split(quote).next()
}

fn is_fortran(header: &str) -> bool {
    entry(header, "fortran_order").is_some_and(|text| text.starts_with("True"))
}

fn shape_of(header: &str) -> Result<Vec<usize>, String> {
    let text = entry(header, "shape")
        .and_then(|text| text.strip_prefix('(')?.split_once(')'))
        .ok_or("no shape")?
        .0;
    let words = text.split(',').map(str::trim);
    let sizes = words.filter(|size| !size.is_empty());
    let sizes = sizes.map(|size| {
        let number = size.parse();
        number.map_err(|_| format!("shape ({text}): {size:?} is no size"))
    });
    sizes.collect()
}

/// The type of an array of plain numbers. Bytes without a meaning (`|V8`) are none, and may be of size 0.
fn number_of(descr: &str) -> Result<Scalar, String> {
    let code = quoted(descr).unwrap_or_default();
    let scalar = scalar_of(code)?;
    match scalar.kind {
        ScalarKind::Padding => Err(no_number(code)),
        _ => Ok(scalar),
    }
}

fn no_number(code: &str) -> String {
    format!("numbers of type {code:?}, expected integers, or floats of 4 or 8 bytes")
}

/// The number type of NumPy's code, for example `<f4`.
fn scalar_of(code: &str) -> Result<Scalar, String> {
    let (order, rest) = code.split_at_checked(1).ok_or_else(|| no_number(code))?;
    let (kind, size) = rest.split_at_checked(1).ok_or_else(|| no_number(code))?;
    let size = size.parse().map_err(|_| no_number(code))?;
    let kind = match (kind, size) {
        ("f", 4 | 8) => ScalarKind::Float,
        ("i", 1 | 2 | 4 | 8) => ScalarKind::Signed,
        ("u", 1 | 2 | 4 | 8) => ScalarKind::Unsigned,
        ("V", _) => ScalarKind::Padding,
        _ => return Err(no_number(code)),
    };
    Ok(Scalar::new(kind, size, order == ">"))
}

/// Fields of a structured array: name and type.
fn fields_of(text: &str) -> Result<Vec<(String, Scalar)>, String> {
    let list = text.split_once(']').map_or(text, |(list, _)| list);
    let tuples = list.split('(').skip(1).map(|tuple| {
        let words: Vec<&str> = tuple.split(['\'', '"']).collect();
        match words[..] {
            [_, name, _, code, end] if end.trim().starts_with(')') => {
                Ok((name.to_owned(), scalar_of(code)?))
            }
            _ => {
                let tuple = tuple.trim_end();
                Err(format!("field ({tuple}, expected a name and a type"))
            }
        }
    });
    tuples.collect()
}

/// The product of `one` and sizes, unless it overflows.
pub(super) fn product(one: usize, sizes: &[usize]) -> Option<usize> {
    let mut sizes = sizes.iter();
    sizes.try_fold(one, |product, &size| product.checked_mul(size))
}

fn named(fields: &str, shape: &[usize]) -> Result<NpyColumns, String> {
    let fields = fields_of(fields)?;
    let [x, y, z] = ["x", "y", "z"].map(|name| {
        let names: Vec<&str> = fields.iter().map(|(name, _)| name.as_str()).collect();
        find(&fields, &[name]).ok_or_else(|| format!("no field {name}, there are {names:?}"))
    });
    let intensity = find(&fields, &INTENSITY_FIELDS);
    Ok(NpyColumns {
        places: [Some(x?), Some(y?), Some(z?), intensity].map(|index| place(&fields, index?)),
        step: size_of(&fields),
        entry_size: size_of(&fields),
        points: product(1, shape).unwrap_or(usize::MAX),
        intensity: intensity.and_then(|index| Some(fields.get(index)?.0.clone())),
    })
}

fn numbered(scalar: Scalar, shape: &[usize], is_fortran: bool) -> Result<NpyColumns, String> {
    let (&last, before) = shape.split_last().ok_or_else(|| wrong_shape(shape))?;
    // 3 x 4 could be either: rows are points then.
    let is_by_component = matches!(before, [3 | 4]) && !COLUMNS.contains(&last);
    let (count, columns, is_planar) = match before {
        [components] if is_by_component => (last, *components, !is_fortran),
        [_, ..] if COLUMNS.contains(&last) => {
            let count = product(1, before).ok_or_else(|| wrong_shape(shape))?;
            (count, last, is_fortran)
        }
        _ => return Err(wrong_shape(shape)),
    };
    // C order by component and Fortran order by point are the same bytes: all x, then all y.
    let (column_step, point_step) = if is_planar { (count, 1) } else { (1, columns) };
    Ok(NpyColumns {
        places: [0, 1, 2, 3].map(|column: usize| {
            let first = column.checked_mul(column_step)?.checked_mul(scalar.size)?;
            (column < columns).then_some((first, scalar))
        }),
        step: point_step * scalar.size,
        entry_size: scalar.size,
        points: count,
        intensity: None,
    })
}

fn wrong_shape(shape: &[usize]) -> String {
    format!("shape {shape:?}, expected N x 3 or N x 4 numbers")
}

#[cfg(test)]
mod tests {
    use protocol::IntensityKind;

    use super::*;

    fn file(header: &str, body: &[u8]) -> Vec<u8> {
        let length = u16::try_from(header.len()).unwrap().to_le_bytes();
        [MAGIC, &[1, 0], &length, header.as_bytes(), body].concat()
    }

    fn floats(values: &[f32]) -> Vec<u8> {
        values
            .iter()
            .flat_map(|value| value.to_le_bytes())
            .collect()
    }

    fn array(
        descr: &str,
        is_fortran: bool,
        shape: &str,
        body: &[u8],
    ) -> Result<Vec<[f32; 4]>, String> {
        let order = if is_fortran { "True" } else { "False" };
        let header =
            format!("{{'descr': '{descr}', 'fortran_order': {order}, 'shape': ({shape}), }}\n");
        decode(&file(&header, body)).map(|cloud| cloud.points.xyzi)
    }

    #[test]
    fn every_order_gives_the_same_points() {
        let expected = vec![[1.0, 2.0, 3.0, 0.5], [4.0, 5.0, 6.0, 0.25]];
        let by_point = floats(&[1.0, 2.0, 3.0, 0.5, 4.0, 5.0, 6.0, 0.25]);
        let by_component = floats(&[1.0, 4.0, 2.0, 5.0, 3.0, 6.0, 0.5, 0.25]);
        assert_eq!(array("<f4", false, "2, 4", &by_point), Ok(expected.clone()));
        assert_eq!(
            array("<f4", false, "1, 2, 4", &by_point),
            Ok(expected.clone())
        );
        assert_eq!(
            array("<f4", true, "2, 4", &by_component),
            Ok(expected.clone())
        );
        assert_eq!(array("<f4", false, "4, 2", &by_component), Ok(expected));
        let doubles: Vec<u8> = [1.0, 2.0, 3.0_f64]
            .iter()
            .flat_map(|value| value.to_be_bytes())
            .collect();
        assert_eq!(
            array(">f8", false, "1, 3", &doubles),
            Ok(vec![[1.0, 2.0, 3.0, 0.0]])
        );
        let shorts: Vec<u8> = [-1, 2, 3, 9, 9_i16]
            .iter()
            .flat_map(|value| value.to_le_bytes())
            .collect();
        assert_eq!(
            array("<i2", false, "1, 5", &shorts),
            Ok(vec![[-1.0, 2.0, 3.0, 9.0]])
        );
    }

    #[test]
    fn named_fields_are_found_in_any_order() {
        let header = "{'descr': [('intensity', '|u1'), ('x', '<f4'), ('', '|V4'), ('y', '<f4'), ('z', '<f4')], \
                      'fortran_order': False, 'shape': (1,), }";
        let body = [&[7][..], &floats(&[1.0, 9.0, 2.0, 3.0])].concat();
        let cloud = decode(&file(header, &body)).unwrap();
        assert_eq!(
            (cloud.points.xyzi, cloud.intensity.unwrap().kind),
            (vec![[1.0, 2.0, 3.0, 7.0]], IntensityKind::Byte)
        );
    }

    #[test]
    fn further_rows_than_stated_are_an_error() {
        let rows = floats(&[1.0, 2.0, 3.0, 0.5, 4.0, 5.0, 6.0, 0.25]);
        assert_eq!(
            array("<f4", false, "1, 4", &rows),
            Err("1 points stated, 2 found: the header is not of this file".into())
        );
        let filled = [&rows[..], b"\n\0\0"].concat();
        assert_eq!(array("<f4", false, "2, 4", &filled).unwrap().len(), 2);
        let two_arrays = [&rows[..], &file("{}", &rows)].concat();
        assert_eq!(array("<f4", false, "2, 4", &two_arrays).unwrap().len(), 2);
    }

    #[test]
    fn faults_are_named_with_both_values() {
        assert!(
            array("<f4", false, "3, 4", &[0; 47])
                .unwrap_err()
                .starts_with("shape [3, 4] stated, 47 bytes found")
        );
        for (shape, bytes) in [("7", 28), ("9, 2", 72)] {
            let fault = array("<f4", false, shape, &vec![0; bytes]).unwrap_err();
            assert!(
                fault.starts_with(&format!("shape [{shape}], expected N x 3")),
                "{fault}"
            );
        }
        for (descr, shape, expected) in [
            ("|O", "1, 4", "numbers of type \"|O\""),
            ("<f4", "18446744073709551615, 4", "cut off"),
            ("|V0", "1000000000000, 3", "numbers of type \"|V0\""),
            ("|V8", "1000000000000, 3", "numbers of type \"|V8\""),
        ] {
            let fault = array(descr, false, shape, &[]).unwrap_err();
            assert!(fault.contains(expected), "{fault}");
        }
        assert!(
            decode(b"\x93NUMPY\x01\x00\xff\xff")
                .unwrap_err()
                .contains("header of 65535 bytes stated")
        );
        assert!(decode(b"PK").is_err());
        let padding = "{'descr': [('x', '|V0'), ('y', '|V0'), ('z', '|V0')], 'fortran_order': False, 'shape': (9,), }";
        assert!(
            decode(&file(padding, b""))
                .unwrap_err()
                .contains("no field x")
        );
    }
}
