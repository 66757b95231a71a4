//! NumPy arrays as PyYAML pickles them into text: the few node shapes that V2V4Real's files contain.
//!
//! V2V4Real writes its pose matrices as `!!python/object/apply:numpy.core.multiarray._reconstruct` with a dtype and
//! base64 data. A Python loader would call what the tag names. Here the tag is compared with the few that are known,
//! every part of the node is checked, and anything else is an error: nothing is ever looked up or called by name.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use super::ReadError;
use super::yaml::{Field, Value};

const TAG_PREFIX: &str = "tag:yaml.org,2002:";
/// The module of NumPy's multiarray before and since 2.0.
const MULTIARRAY: [&str; 2] = ["numpy.core.multiarray", "numpy._core.multiarray"];
/// Most numbers in an array; a pose has 16.
const MAX_NUMBERS: usize = 4096;

/// An array of numbers, row-major.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct NumpyArray {
    pub(super) shape: Vec<usize>,
    pub(super) values: Vec<f64>,
}

/// Little-endian number formats.
#[derive(Debug, Clone, Copy)]
enum Dtype {
    F4,
    F8,
    I4,
    I8,
}

/// Whether the node carries a tag of Python's at all.
pub(super) fn is_python(field: &Field<'_>) -> bool {
    tag(field).is_some_and(|tag| tag.starts_with("python/"))
}

/// Reads `_reconstruct(ndarray, (0,), b'b')` with its state `(1, shape, dtype, is_fortran, data)`.
pub(super) fn array(field: &Field<'_>) -> Result<NumpyArray, ReadError> {
    expect_call(field, "_reconstruct")?;
    let parts = field.entries()?;
    if parts.len() != 2 {
        return Err(field.error(format!("{} parts, expected args and state", parts.len())));
    }
    check_args(&field.required("args")?)?;
    let state_field = field.required("state")?;
    let [version, shape, dtype, is_fortran, data] = tuple::<5>(&state_field)?;
    if version.integer()? != 1 {
        return Err(version.error(format!("pickle version {}, expected 1", version.integer()?)));
    }
    let shape = read_shape(&shape)?;
    let values = numbers(&data, read_dtype(&dtype)?, shape.iter().product())?;
    let values = match is_fortran.node().value {
        Value::Bool(false) => values,
        Value::Bool(true) => row_major(&shape, &values),
        _ => return Err(is_fortran.error("expected true or false: is the array in Fortran order?")),
    };
    Ok(NumpyArray { shape, values })
}

/// Reads `scalar(dtype, data)`, a finite number.
pub(super) fn scalar(field: &Field<'_>) -> Result<f64, ReadError> {
    expect_call(field, "scalar")?;
    let args = match field.node().value {
        Value::Map(_) => field.required("args")?,
        _ => field.clone(),
    };
    let [dtype, data] = items::<2>(&args)?;
    let values = numbers(&data, read_dtype(&dtype)?, 1)?;
    match values.first() {
        Some(value) if value.is_finite() => Ok(*value),
        Some(value) => Err(data.error(format!("{value}, expected a finite number"))),
        None => Err(data.error("no number")),
    }
}

fn tag<'a>(field: &Field<'a>) -> Option<&'a str> {
    field.node().tag.as_deref().map(|tag| tag.strip_prefix(TAG_PREFIX).unwrap_or(tag))
}

fn expect_tag(field: &Field<'_>, expected: &str) -> Result<(), ReadError> {
    match tag(field) {
        Some(tag) if tag == expected => Ok(()),
        tag => Err(field.error(format!("tag {}, expected !!{expected}", shown(tag)))),
    }
}

fn expect_call(field: &Field<'_>, function: &str) -> Result<(), ReadError> {
    let known = MULTIARRAY.map(|module| format!("python/object/apply:{module}.{function}"));
    if tag(field).is_some_and(|tag| known.iter().any(|known| known == tag)) {
        return Ok(());
    }
    Err(field.error(format!("tag {} is none of those that are known, expected !!{}", shown(tag(field)), known[0])))
}

fn shown(tag: Option<&str>) -> String {
    tag.map_or("is missing".into(), |tag| format!("{:?}", tag.chars().take(80).collect::<String>()))
}

fn items<'a, const N: usize>(field: &Field<'a>) -> Result<[Field<'a>; N], ReadError> {
    let items = field.items()?;
    let found = items.len();
    items.try_into().map_err(|_| field.error(format!("{found} items, expected {N}")))
}

fn tuple<'a, const N: usize>(field: &Field<'a>) -> Result<[Field<'a>; N], ReadError> {
    expect_tag(field, "python/tuple")?;
    items(field)
}

/// `args` of `_reconstruct` are always the same: an empty array to be filled by the state.
fn check_args(args: &Field<'_>) -> Result<(), ReadError> {
    let [class, shape, code] = items::<3>(args)?;
    expect_tag(&class, "python/name:numpy.ndarray")?;
    let [zero] = tuple::<1>(&shape)?;
    if zero.integer()? != 0 {
        return Err(zero.error("expected 0: the shape comes with the state"));
    }
    match base64(&code)?.as_slice() {
        b"b" => Ok(()),
        _ => Err(code.error("expected the code b")),
    }
}

fn read_shape(field: &Field<'_>) -> Result<Vec<usize>, ReadError> {
    expect_tag(field, "python/tuple")?;
    let shape: Vec<usize> = field
        .items()?
        .iter()
        .map(|item| usize::try_from(item.integer()?).map_err(|_| item.error("a shape is not negative")))
        .collect::<Result<_, _>>()?;
    let count = shape.iter().try_fold(1usize, |count, &size| count.checked_mul(size));
    match count.filter(|&count| count <= MAX_NUMBERS && shape.len() <= 4) {
        Some(_) => Ok(shape),
        None => Err(field.error(format!("shape {shape:?} is larger than {MAX_NUMBERS} numbers"))),
    }
}

/// `dtype('f8', False, True)` with a state whose second item is the byte order.
fn read_dtype(field: &Field<'_>) -> Result<Dtype, ReadError> {
    expect_tag(field, "python/object/apply:numpy.dtype")?;
    let [name, ..] = items::<3>(&field.required("args")?)?;
    let dtype = match name.text()? {
        "f4" => Dtype::F4,
        "f8" => Dtype::F8,
        "i4" => Dtype::I4,
        "i8" => Dtype::I8,
        other => return Err(name.error(format!("dtype {other:?}, expected f4, f8, i4 or i8"))),
    };
    let state = field.required("state")?;
    expect_tag(&state, "python/tuple")?;
    match state.items()?.get(1) {
        Some(order) if order.text()? == "<" => Ok(dtype),
        Some(order) => Err(order.error(format!("byte order {:?}, expected little-endian \"<\"", order.text()?))),
        None => Err(state.error("no byte order")),
    }
}

fn base64(field: &Field<'_>) -> Result<Vec<u8>, ReadError> {
    expect_tag(field, "binary")?;
    // The lines of a block are part of the text.
    let text: String = field.text()?.split_ascii_whitespace().collect();
    STANDARD.decode(text).map_err(|error| field.error(format!("no base64: {error}")))
}

fn numbers(field: &Field<'_>, dtype: Dtype, count: usize) -> Result<Vec<f64>, ReadError> {
    let bytes = base64(field)?;
    let values: Vec<f64> = match dtype {
        Dtype::F4 => chunks(&bytes, |bytes| f64::from(f32::from_le_bytes(bytes))),
        Dtype::F8 => chunks(&bytes, f64::from_le_bytes),
        Dtype::I4 => chunks(&bytes, |bytes| f64::from(i32::from_le_bytes(bytes))),
        Dtype::I8 => chunks(&bytes, |bytes| i64::from_le_bytes(bytes) as f64),
    };
    let size = match dtype {
        Dtype::F4 | Dtype::I4 => 4,
        Dtype::F8 | Dtype::I8 => 8,
    };
    if bytes.len() == count * size {
        Ok(values)
    } else {
        Err(field.error(format!("{} bytes for {count} numbers of {size} bytes", bytes.len())))
    }
}

fn chunks<const N: usize>(bytes: &[u8], from: impl Fn([u8; N]) -> f64) -> Vec<f64> {
    bytes.as_chunks::<N>().0.iter().map(|&chunk| from(chunk)).collect()
}

/// Turns the order in which the first index runs fastest into the usual one.
fn row_major(shape: &[usize], values: &[f64]) -> Vec<f64> {
    let place = |index: usize| {
        let (mut rest, mut place, mut stride) = (index, 0, values.len());
        // Digits of the row-major index, weighed as Fortran weighs them.
        let mut weight = 1;
        for &size in shape {
            stride /= size.max(1);
            place += (rest / stride.max(1)) * weight;
            rest %= stride.max(1);
            weight *= size;
        }
        place
    };
    (0..values.len()).map(|index| values[place(index)]).collect()
}

#[cfg(test)]
pub(super) mod tests {
    use std::path::Path;

    use proptest::prelude::*;

    use super::*;
    use crate::dataset::yaml;

    /// A 4x4 matrix as V2V4Real has it, under `lidar_pose`, with the dtype anchored as `id002`.
    pub(in crate::dataset) fn pickled_matrix(values: &[f64; 16]) -> String {
        let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        let data = STANDARD.encode(bytes);
        let (first, second) = data.split_at(76);
        let (before, _) = MATRIX.trim_end().rsplit_once("!!binary |").unwrap();
        format!("{before}!!binary |\n    {first}\n    {second}\n")
    }

    /// As Python wrote one.
    const MATRIX: &str = include_str!("numpy_matrix.yaml");

    const NUMBERS: [f64; 16] =
        [0.0, -1.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 1e-300];

    fn read(text: &str) -> Result<NumpyArray, ReadError> {
        let path = Path::new("000000.yaml");
        let node = yaml::parse(path, text.as_bytes())?;
        array(&Field::root(path, &node).required("lidar_pose")?)
    }

    #[test]
    fn a_pickled_matrix_is_read_and_so_are_aliases() {
        let text = pickled_matrix(&NUMBERS)
            + "true_ego_pos: *id003\nlon: !!python/object/apply:numpy.core.multiarray.scalar\n- *id002\n- !!binary |\n  AAAAAAAA+D8=\n";
        let expected = NumpyArray { shape: vec![4, 4], values: NUMBERS.to_vec() };
        assert_eq!(read(&text).unwrap(), expected);
        let path = Path::new("000000.yaml");
        let node = yaml::parse(path, text.as_bytes()).unwrap();
        let root = Field::root(path, &node);
        assert_eq!(array(&root.required("true_ego_pos").unwrap()).unwrap(), expected);
        assert_eq!(scalar(&root.required("lon").unwrap()).unwrap(), 1.5);
        for not_finite in [f64::NAN, f64::INFINITY] {
            let text = text.replace("AAAAAAAA+D8=", &STANDARD.encode(not_finite.to_le_bytes()));
            let node = yaml::parse(path, text.as_bytes()).unwrap();
            let error = scalar(&Field::root(path, &node).required("lon").unwrap()).unwrap_err().to_string();
            assert!(error.contains("lon") && error.contains("expected a finite number"), "{error}");
        }
    }

    #[test]
    fn newer_numpy_has_another_module() {
        assert!(read(&pickled_matrix(&NUMBERS).replace("numpy.core.", "numpy._core.")).is_ok());
    }

    #[test]
    fn fortran_order_is_turned() {
        let text = pickled_matrix(&NUMBERS).replace("  - false\n  - !!binary", "  - true\n  - !!binary");
        let values = read(&text).unwrap().values;
        assert_eq!((values[1], values[4], values[15]), (NUMBERS[4], NUMBERS[1], NUMBERS[15]));
        assert_eq!(row_major(&[2, 3], &[0.0, 3.0, 1.0, 4.0, 2.0, 5.0]), [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]);
    }

    #[test]
    fn anything_else_is_an_error_that_names_the_field() {
        let cases = [
            ("numpy.core.multiarray._reconstruct", "os.system", "is none of those that are known"),
            ("python/name:numpy.ndarray", "python/name:subprocess.Popen", "expected !!python/name:numpy.ndarray"),
            ("    Yg==", "    Yw==", "expected the code b"),
            ("- f8", "- O8", "dtype \"O8\", expected f4, f8, i4 or i8"),
            ("- <", "- '>'", "byte order \">\""),
            ("    - 4\n    - 4\n", "    - 4\n    - 5\n", "128 bytes for 20 numbers of 8 bytes"),
            ("    - 4\n    - 4\n", "    - 4000000000\n    - 4000000000\n", "is larger than 4096 numbers"),
            ("    - 4\n    - 4\n", "    - -4\n    - -4\n", "a shape is not negative"),
            ("  - false\n  - !!binary", "  - maybe\n  - !!binary", "Fortran order"),
            ("  state: !!python/tuple\n  - 1", "  state: !!python/tuple\n  - 2", "pickle version 2, expected 1"),
        ];
        for (from, to, expected) in cases {
            let text = pickled_matrix(&NUMBERS).replacen(from, to, 1);
            let message = read(&text).unwrap_err().to_string();
            assert!(message.contains(expected) && message.contains("lidar_pose"), "{message}");
        }
    }

    proptest! {
        #[test]
        fn damage_never_panics(at in any::<prop::sample::Index>(), byte in 0x20..0x7fu8) {
            let mut text = pickled_matrix(&NUMBERS).into_bytes();
            let at = at.index(text.len());
            text[at] = byte;
            let _ = read(std::str::from_utf8(&text).unwrap());
        }
    }
}
