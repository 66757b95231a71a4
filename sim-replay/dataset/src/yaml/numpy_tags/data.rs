//! Number formats and base64 data of pickled arrays.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use super::super::field::YamlField;
use super::super::node::Value;
use super::{APPLY, args, expect_tag, items};
use crate::Result;
use crate::scalar::{Scalar, ScalarKind};

/// `dtype('f8', False, True)` with a state whose second item is the byte order.
pub(super) fn read_dtype(field: &YamlField<'_>) -> Result<Scalar> {
    expect_tag(field, "python/object/apply:numpy.dtype")?;
    let [name, ..] = items::<3>(&field.required("args")?)?;
    let text = name.text()?;
    let (kind, size) = match text.as_bytes() {
        [b'f', size @ (b'2' | b'4' | b'8')] => (ScalarKind::Float, size),
        [b'i', size @ (b'1' | b'2' | b'4' | b'8')] => (ScalarKind::Signed, size),
        [b'u', size @ (b'1' | b'2' | b'4' | b'8')] => (ScalarKind::Unsigned, size),
        [b'b', size @ b'1'] => (ScalarKind::Unsigned, size),
        _ => {
            return Err(name.error(format!(
                "dtype {text:?}, expected f2 to f8, i1 to i8, u1 to u8 or b1"
            )));
        }
    };
    let state = field.required("state")?;
    expect_tag(&state, "python/tuple")?;
    let order = state.items()?.into_iter().nth(1);
    let order = order.ok_or_else(|| state.error("no byte order"))?;
    let is_big_endian = match order.text()? {
        // `=` is the order of the machine that wrote it, `|` that of single bytes.
        "<" | "=" | "|" => false,
        ">" => true,
        other => {
            let expected = "expected \"<\", \">\", \"=\" or \"|\"";
            return Err(order.error(format!("byte order {other:?}, {expected}")));
        }
    };
    Ok(Scalar::new(kind, usize::from(size - b'0'), is_big_endian))
}

/// Bytes in base64, on their own or as the one argument of `bytearray`.
pub(super) fn binary(field: &YamlField<'_>) -> Result<Vec<u8>> {
    let tag = field.node.tag.as_deref();
    let function = tag.and_then(|tag| tag.strip_prefix(APPLY));
    if function == Some("builtins.bytearray") && !matches!(field.node.value, Value::Text(_)) {
        let [inner] = items::<1>(&args(field)?)?;
        return base64(&inner);
    }
    base64(field)
}

fn base64(field: &YamlField<'_>) -> Result<Vec<u8>> {
    expect_tag(field, "binary")?;
    // The lines of a block are part of the text.
    let text: String = field.text()?.split_ascii_whitespace().collect();
    let bytes = STANDARD.decode(text);
    bytes.map_err(|error| field.error(format!("no base64: {error}")))
}

/// Exactly `count` numbers.
pub(super) fn numbers(field: &YamlField<'_>, dtype: Scalar, count: usize) -> Result<Vec<f64>> {
    let bytes = binary(field)?;
    let (found, size) = (bytes.len(), dtype.size);
    if count.checked_mul(size) != Some(found) {
        let reason = format!("{found} bytes for {count} numbers of {size} bytes");
        return Err(field.error(reason));
    }
    let chunks = bytes.chunks_exact(size);
    Ok(chunks.filter_map(|chunk| dtype.read(chunk)).collect())
}
