//! NumPy arrays and scalars pickled by PyYAML into text: the few node shapes that data sets contain.
//!
//! V2V4Real writes its pose matrices as `!!python/object/apply:numpy.core.multiarray._reconstruct` with a dtype and
//! base64 data; converters of other data sets do so for any number. A Python loader would call the function named by
//! the tag. Here the tag is compared with the few supported ones, every part of the node is checked, and anything else
//! is an error: nothing is ever looked up or called by name.
//!
//! [`super::numbers`] calls [`array()`] and [`scalar()`] for the numbers of a field, [`super::tree`] calls
//! [`key_text()`] for keys. Nothing else of the YAML is called here but a field's entries, items and texts.

mod data;

use std::path::Path;

use protocol::text::excerpt;

use super::field::YamlField;
use super::node::{Value, YamlNode};
use crate::{Result, npy};
use data::{binary, numbers, read_dtype};

/// Prefix of tags of Python calls.
const APPLY: &str = "python/object/apply:";
/// The modules of NumPy before and since 2.0.
const PACKAGES: [&str; 2] = ["numpy.core", "numpy._core"];
/// Most numbers in an array; a pose has 16.
const MAX_NUMBERS: usize = 4096;

/// Shape and numbers of an array, row-major.
pub(crate) type NumpyArray = (Vec<usize>, Vec<f64>);

/// True if the node carries a tag of Python's.
pub(crate) fn is_python(node: &YamlNode) -> bool {
    let tag = node.tag.as_deref();
    tag.is_some_and(|tag| tag.starts_with("python/"))
}

/// True if the node is a pickled call, and not a tuple or list of Python's.
pub(crate) fn is_call(node: &YamlNode) -> bool {
    let tag = node.tag.as_deref();
    tag.is_some_and(|tag| tag.starts_with(APPLY))
}

/// The text of a key that is a NumPy scalar; `None` if it is none.
pub(crate) fn key_text(node: &YamlNode) -> Option<String> {
    let number = scalar(&YamlField::root(Path::new(""), node)).ok()?;
    Some(number.to_string())
}

/// Reads `_reconstruct`, `_frombuffer` and `scalar(dtype, data)`, an array without dimensions.
pub(crate) fn array(field: &YamlField<'_>) -> Result<NumpyArray> {
    match function(field) {
        Some("multiarray._reconstruct") => reconstruct(field),
        Some("numeric._frombuffer") => from_buffer(field),
        Some("multiarray.scalar") => {
            let [dtype, data] = items::<2>(&args(field)?)?;
            let values = numbers(&data, read_dtype(&dtype)?, 1)?;
            Ok((vec![], values))
        }
        _ => {
            let tag = shown(field.node.tag.as_deref());
            Err(field.error(format!(
                "tag {tag} is not supported, expected numbers or NumPy's arrays of them"
            )))
        }
    }
}

/// Reads `scalar(dtype, data)` or an array with one number; it must be finite.
pub(crate) fn scalar(field: &YamlField<'_>) -> Result<f64> {
    let (shape, values) = array(field)?;
    match values[..] {
        [value] if value.is_finite() => Ok(value),
        [value] => Err(field.error(format!("{value}, expected a finite number"))),
        _ => Err(field.error(format!("an array of shape {shape:?}, expected a number"))),
    }
}

/// Module and name of the function of NumPy that a node calls.
fn function<'a>(field: &YamlField<'a>) -> Option<&'a str> {
    let call = field.node.tag.as_deref()?.strip_prefix(APPLY)?;
    let mut packages = PACKAGES.iter();
    packages.find_map(|package| call.strip_prefix(package)?.strip_prefix('.'))
}

/// `_reconstruct(ndarray, (0,), b'b')` with its state `(1, shape, dtype, is_fortran, data)`.
fn reconstruct(field: &YamlField<'_>) -> Result<NumpyArray> {
    let parts = field.entries()?;
    if parts.len() != 2 {
        return Err(field.error(format!("{} parts, expected args and state", parts.len())));
    }
    check_args(&field.required("args")?)?;
    let [version, shape, dtype, is_fortran, data] = tuple::<5>(&field.required("state")?)?;
    let number = integer(&version)?;
    if number != 1 {
        return Err(version.error(format!("pickle version {number}, expected 1")));
    }
    let shape = read_shape(&shape)?;
    let values = numbers(&data, read_dtype(&dtype)?, shape.iter().product())?;
    let is_fortran = match is_fortran.node.value {
        Value::Bool(flag) => flag,
        Value::Integer(0) => false,
        Value::Integer(1) => true,
        _ => return Err(is_fortran.error("expected true or false: is the array in Fortran order?")),
    };
    Ok(ordered(shape, values, is_fortran))
}

/// `_frombuffer(data, dtype, shape, order)`.
fn from_buffer(field: &YamlField<'_>) -> Result<NumpyArray> {
    let [data, dtype, shape, order] = items::<4>(&args(field)?)?;
    let shape = read_shape(&shape)?;
    let values = numbers(&data, read_dtype(&dtype)?, shape.iter().product())?;
    match order.text()? {
        "C" => Ok(ordered(shape, values, false)),
        "F" => Ok(ordered(shape, values, true)),
        other => Err(order.error(format!("order {other:?}, expected C or F"))),
    }
}

/// Arguments of a call without state are its items, or the entry `args`.
fn args<'a>(field: &YamlField<'a>) -> Result<YamlField<'a>> {
    if matches!(field.node.value, Value::Map(_)) {
        field.required("args")
    } else {
        Ok(field.clone())
    }
}

fn expect_tag(field: &YamlField<'_>, expected: &str) -> Result<()> {
    match field.node.tag.as_deref() {
        Some(tag) if tag == expected => Ok(()),
        tag => Err(field.error(format!("tag {}, expected !!{expected}", shown(tag)))),
    }
}

/// Only a plain integer: what NumPy writes beside its numbers.
fn integer(field: &YamlField<'_>) -> Result<i64> {
    match field.node.value {
        Value::Integer(value) => Ok(value),
        _ => Err(field.expected("an integer")),
    }
}

fn shown(tag: Option<&str>) -> String {
    tag.map_or("is missing".into(), |tag| format!("{:?}", excerpt(tag, 80)))
}

fn items<'a, const N: usize>(field: &YamlField<'a>) -> Result<[YamlField<'a>; N]> {
    let items = <[YamlField<'a>; N]>::try_from(field.items()?);
    items.map_err(|items| field.error(format!("{} items, expected {N}", items.len())))
}

fn tuple<'a, const N: usize>(field: &YamlField<'a>) -> Result<[YamlField<'a>; N]> {
    expect_tag(field, "python/tuple")?;
    items(field)
}

/// `args` of `_reconstruct` are always the same: an empty array to be filled by the state.
fn check_args(args: &YamlField<'_>) -> Result<()> {
    let [class, shape, code] = items::<3>(args)?;
    expect_tag(&class, "python/name:numpy.ndarray")?;
    let [zero] = tuple::<1>(&shape)?;
    if integer(&zero)? != 0 {
        return Err(zero.error("expected 0: the shape comes with the state"));
    }
    match binary(&code)?.as_slice() {
        b"b" => Ok(()),
        _ => Err(code.error("expected the code b")),
    }
}

fn read_shape(field: &YamlField<'_>) -> Result<Vec<usize>> {
    expect_tag(field, "python/tuple")?;
    let items = field.items()?;
    let sizes = items.iter().map(|item| {
        usize::try_from(integer(item)?).map_err(|_| item.error("a shape is not negative"))
    });
    let shape = sizes.collect::<Result<Vec<usize>>>()?;
    // Checked here: readers multiply the sizes without a check.
    let count = npy::product(1, &shape);
    match count.filter(|&count| count <= MAX_NUMBERS && shape.len() <= 4) {
        Some(_) => Ok(shape),
        None => Err(field.error(format!(
            "shape {shape:?} is larger than {MAX_NUMBERS} numbers"
        ))),
    }
}

fn ordered(shape: Vec<usize>, values: Vec<f64>, is_fortran: bool) -> NumpyArray {
    let values = match is_fortran {
        true => row_major(&shape, &values),
        false => values,
    };
    (shape, values)
}

/// Converts the order in which the first index runs fastest to row-major.
fn row_major(shape: &[usize], values: &[f64]) -> Vec<f64> {
    let values = (0..values.len()).map(|index| {
        let (mut rest, mut place, mut stride) = (index, 0, values.len());
        // Digits of the row-major index, weighed as Fortran weighs them.
        let mut weight = 1;
        for &size in shape {
            stride /= size.max(1);
            place += (rest / stride.max(1)) * weight;
            rest %= stride.max(1);
            weight *= size;
        }
        // Every place is below the product of the sizes, the number of values.
        values.get(place).copied().unwrap_or(f64::NAN)
    });
    values.collect()
}

#[cfg(test)]
pub(crate) mod tests;
